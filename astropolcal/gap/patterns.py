# Licensed under a 3-clause BSD style license - see LICENSE
"""Patterns over the frames of a dataset: harmonics of the angles, trends, products."""

import numpy as np

__all__ = ["SAME_ANGLE", "badly_separated", "frame_blocks", "frame_patterns"]

# harmonics in the order of who gives a name to what the angles cannot tell apart
_PLATE = (0, 4, 2, 8, 1, 3, 5, 6, 7, 12)
_DEROTATOR = (2, 4, 1)
# condition number of a constant, harmonic 4 and another one, beyond which they are hardly told
_POOR = 10.0
_ORDER = "the order of frames within a block at one derotator angle"
_SAME_ORDER = "the plate angles come in the same order in every block"
_NOTE = "these angles hardly tell it from a constant and harmonic 4"
#: Angles closer than this (radian) are the same.
SAME_ANGLE = np.deg2rad(0.5)


def frame_patterns(observations):
    """
    Return patterns over the frames of a dataset.

    Parameters
    ----------
    observations : Observations
        The dataset.

    Returns
    -------
    dict of tuple to `~numpy.ndarray`
        Axis and words to functions of the frame, shape (k, F). What the angles
        taken cannot tell from an earlier pattern is left out.

    Examples
    --------
    >>> from astropolcal.gap.patterns import frame_patterns
    >>> from astropolcal.observations import Observations, example_table
    >>> list(frame_patterns(Observations.from_table(example_table())))[1]
    ('hwp', 'harmonic 4 of the half-wave-plate angle')
    """
    found, known = {}, observations.frames.colnames
    if "hwp" in known:
        found |= _harmonics(observations.position("hwp"), "hwp", "half-wave-plate", _PLATE)
    if "derotator" in known:
        angle = observations.position("derotator")
        found |= _harmonics(angle, "derotator", "derotator", _DEROTATOR)
    for name in ("altitude", "parallactic"):
        if name in known:
            found |= _harmonics(observations.position(name), name, name, (2, 4))
    found |= _products(found)
    time = 2 * observations.position("sequence") - 1
    found["time", "a trend through the run"] = _legendre(time)
    plate4 = found.get(("hwp", "harmonic 4 of the half-wave-plate angle"))
    if plate4 is not None:
        words = "harmonic 4 of the half-wave-plate angle with a trend through the run"
        found["time x hwp", words] = plate4 * time
    order = _order(observations)
    if order is not None:
        found["time", _ORDER] = order
    return {
        key: columns
        for key, columns in found.items()
        if np.ptp(columns, axis=1).any() or key[1].startswith("what is constant")
    }


def _harmonics(angle, axis, title, orders):
    """Return the harmonics of an angle that differ from one another where it was sampled."""
    found, spans = {}, []
    for k in orders:
        waves = [np.cos(k * angle), np.sin(k * angle)] if k else [np.ones_like(angle)]
        columns = np.array([w for w in waves if np.abs(w).max() > 1e-6])
        # the simpler name was given already: at steps of 22.5 deg harmonic 12 is harmonic 4
        if k and _within(columns, spans, angle.size):
            continue
        words = (
            f"harmonic {k} of the {title} angle" if k else f"what is constant in the {title} angle"
        )
        found[axis, words] = columns
        spans.append(columns)
    return found


def _within(columns, spans, n):
    """Whether all columns are constant or lie in the span of one of the others."""
    for other in [np.ones((1, n)), *spans]:
        left = columns - columns @ np.linalg.pinv(other) @ other
        if np.abs(left).max() < 1e-6:
            return True
    return False


def badly_separated(observations):
    """
    Return the patterns that the plate angles taken separate badly from simpler ones.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets; the one with the better angles counts.

    Returns
    -------
    dict of str to str
        Words of `frame_patterns` to a note, for harmonics whose condition number
        together with a constant and harmonic 4 is large, and for the order of
        frames where the angles always come in the same one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.patterns import badly_separated
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> data = simulate(charis.chain(), charis.wavelength, half_wave_plate_cycles(), seed=1)
    >>> badly_separated([data])["harmonic 2 of the half-wave-plate angle"]
    'these angles hardly tell it from a constant and harmonic 4'
    """
    angles = [o.position("hwp") for o in observations if "hwp" in o.frames.colnames]
    found = {}
    for k in _PLATE[2:] if angles else ():
        poor = min(_condition(angle, (0, 4, k)) for angle in angles)
        if poor > _POOR:
            found[f"harmonic {k} of the half-wave-plate angle"] = _NOTE
    if angles and all(map(_same_order, observations)):
        found[_ORDER] = _SAME_ORDER
    return found


def _same_order(observations):
    """Whether the place of a frame in its block tells the plate angle."""
    if "hwp" not in observations.frames.colnames:
        return True
    angle, place = observations.position("hwp"), _places(observations)
    first = np.array([angle[place == p][0] for p in range(place.max() + 1)])
    # the sine, for a plate turned by half a turn is the same plate
    return bool(np.all(np.abs(np.sin(angle - first[place])) < SAME_ANGLE))


def _condition(angle, orders):
    columns = [part(k * angle) for k in sorted(orders) if k for part in (np.cos, np.sin)]
    singular = np.linalg.svd(np.array([np.ones_like(angle), *columns]), compute_uv=False)
    return singular[0] / max(singular[-1], 1e-12 * singular[0])


def _products(found):
    """Return the products of the harmonics of two angles."""
    out = {}
    for k in (2, 4):
        one = next((v for (a, w), v in found.items() if a == "hwp" and f"ic {k} " in w), None)
        for (axis, words), other in found.items():
            if one is None or axis == "hwp" or "harmonic 1 " in words:
                continue
            both = (one[:, None] * other[None]).reshape(-1, one.shape[1])
            title = f"harmonic {k} of the half-wave-plate angle times {words}"
            out[f"hwp x {axis}", title] = both
    return out


def _legendre(values):
    return np.polynomial.legendre.legvander(values, 2)[:, 1:].T


def _order(observations):
    """Return the place of each frame in its block, None if blocks are single frames."""
    blocks = frame_blocks(observations)
    size = np.bincount(blocks)[blocks]
    if size.max() < 3:
        return None
    place = _places(observations)
    return _legendre(2 * place / np.maximum(size - 1, 1) - 1) * (size > 1)


def _places(observations):
    """Return the place of each frame in its block, from 0."""
    blocks = frame_blocks(observations)
    return np.arange(blocks.size) - np.searchsorted(blocks, blocks)


def frame_blocks(observations):
    """
    Return the number of the run of frames at one derotator angle of each frame.

    Parameters
    ----------
    observations : Observations
        The dataset.

    Returns
    -------
    `~numpy.ndarray`
        Integers from 0, shape (F,); each frame is its own where there is no
        derotator angle.

    Examples
    --------
    >>> from astropolcal.gap.patterns import frame_blocks
    >>> from astropolcal.observations import Observations, example_table
    >>> frame_blocks(Observations.from_table(example_table())).tolist()
    [0, 0, 0, 0]
    """
    if "derotator" not in observations.frames.colnames:
        return np.arange(observations.n_frames)
    # the first frame begins a run but is no step
    step = np.abs(np.diff(observations.position("derotator"), prepend=np.nan)) > SAME_ANGLE
    step[0] = False
    return np.cumsum(step)
