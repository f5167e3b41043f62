# Licensed under a 3-clause BSD style license - see LICENSE
"""
What a set of half-wave-plate angles can separate.

A perfect plate puts the polarization into harmonic 4 of its angle, an imperfect
one also into 2, and a wedge or dust into 1. Angles from 0 to 78.75 deg cover
one period of harmonic 4 only: there the others look alike.
"""

import numpy as np

__all__ = ["harmonic_conditions", "harmonic_words"]

#: Sets of harmonics that a model may need to tell apart, with what brings the last one in.
SETS = (
    ((0, 4), "the polarization"),
    ((0, 2, 4), "a half-wave plate that is not perfect"),
    ((0, 1, 2, 4), "a wedge, dust or beam wander"),
)
# beyond this condition number errors grow too much to call the harmonics separate
_POOR = 10.0


def harmonic_conditions(angles):
    """
    Return how well harmonics of the half-wave-plate angle can be separated.

    Parameters
    ----------
    angles : array_like
        Angles in radian, one a frame.

    Returns
    -------
    dict of tuple to float
        Set of harmonics to the condition number of their design matrix;
        infinite where there are too few angles.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import harmonic_conditions
    >>> found = harmonic_conditions(np.deg2rad(np.arange(8) * 11.25))
    >>> [round(value, 1) for value in found.values()]
    [1.4, 27.5, 14184.1]
    """
    return {
        harmonics: _condition(np.asarray(angles, dtype=float), harmonics) for harmonics, _ in SETS
    }


def _condition(angles, harmonics):
    columns = []
    for k in harmonics:
        # the frames' brightness or polarization as a Fourier series of the plate angle
        columns += [np.cos(k * angles), np.sin(k * angles)] if k else [np.ones_like(angles)]
    singular = np.linalg.svd(np.column_stack(columns), compute_uv=False)
    if len(angles) < len(columns) or singular[-1] < 1e-12 * singular[0]:
        return np.inf
    return float(singular[0] / singular[-1])


def harmonic_words(angles):
    """
    Say which harmonics the angles cannot separate, and which angles to add.

    Parameters
    ----------
    angles : array_like
        Angles in radian, one a frame.

    Returns
    -------
    list of str
        One sentence a set of harmonics that is poorly separated.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import harmonic_words
    >>> print(harmonic_words(np.deg2rad(np.arange(8) * 11.25))[0])
    half-wave-plate angles 0 to 78.75 deg separate harmonic 2 badly from 0, 4 (condition 27, \
from a half-wave plate that is not perfect): add 90 to 168.75 deg
    """
    degrees = np.unique(np.round(np.rad2deg(angles), 3))
    words = []
    for harmonics, origin in SETS:
        condition = _condition(np.deg2rad(degrees), harmonics)
        if condition > _POOR:
            span = f"{degrees[0]:g} to {degrees[-1]:g} deg"
            new = ", ".join(str(k) for k in harmonics if k not in (0, 4)) or "4"
            rest = ", ".join(str(k) for k in harmonics if str(k) not in new.split(", "))
            size = f"{condition:.2g}" if np.isfinite(condition) else "infinite"
            words.append(
                f"half-wave-plate angles {span} separate harmonic {new} badly from {rest} "
                f"(condition {size}, from {origin}): add {_missing(degrees, harmonics)}"
            )
    return words


def _missing(degrees, harmonics):
    """Return the angles, in even steps, that complete a period of the lowest harmonic."""
    lowest = min(k for k in harmonics if k)
    period = 360.0 / lowest
    steps = np.diff(degrees)
    step = float(np.median(steps)) if steps.size else 22.5
    # a step that does not divide the period, or that is too coarse for harmonic 4
    # Nyquist: two angles a period of the highest harmonic, and one more
    count = max(round(period / step), 2 * max(harmonics) // lowest + 1, 4)
    wanted = np.arange(count) * period / count + degrees[0]
    new = [angle for angle in wanted if np.abs(degrees - angle).min() > 0.1]
    if len(new) > 3 and np.allclose(np.diff(new), new[1] - new[0]):
        return f"{new[0]:g} to {new[-1]:g} deg"
    return ", ".join(f"{angle:g}" for angle in new) + " deg"
