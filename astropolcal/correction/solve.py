# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Stokes parameters by weighted least squares over frames, where the frames determine them.

With rows :math:`A` and weights :math:`W`, the solution is :math:`\hat{\mathbf S} = G\,\mathbf d`
with :math:`G = (A^\mathsf{T} W A)^{-1} A^\mathsf{T} W`. It is found by singular values;
what belongs to values that are too small is reported, never divided by.
"""

from dataclasses import dataclass

import numpy as np

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.correction.channels import Channels
from astropolcal.exceptions import ObservationError, ParameterError

__all__ = ["COMPONENTS", "Estimator", "estimator"]

#: What may be solved for; without V it is taken as zero.
COMPONENTS = ("IQU", "IQUV")

# a component whose share in a poorly determined direction is larger than this is not determined
_SHARE = 1e-3
# the worst combination has so much more noise than the best; good cycles have 1.5 to 3
_MAX_CONDITION = 30.0
_MAX_NAMED = 8


@dataclass
class Estimator:
    """
    What turns the fluxes of all frames into Stokes parameters.

    Attributes
    ----------
    components : str
        The Stokes parameters, such as ``"IQU"``.
    gain : `~numpy.ndarray`
        Shape (n_wavelengths, n_components, 2, n_frames); NaN where a component is not
        determined.
    rows : `~numpy.ndarray`
        The rows solved, with the brightness of the frames, (2, n_wavelengths, n_frames, 4).
    channels : Channels
        Of what the solution was made.
    channel_rows : `~numpy.ndarray`
        The rows of the channels, (2, n_wavelengths, n_units, 4).
    weights : `~numpy.ndarray`
        Of the channels, (2, n_wavelengths, n_units).
    condition : `~numpy.ndarray`
        Largest over smallest singular value for each wavelength, of all components asked for.
    determined : `~numpy.ndarray` of bool
        Shape (n_wavelengths, n_components).
    leakage : `~numpy.ndarray`
        What each component takes from a V that is taken as zero, (n_wavelengths, n_components).
    weak : list of str
        The combinations that are poorly determined, in words, one a wavelength; else "".
    max_condition : float
        What was allowed.
    scale : `~numpy.ndarray` or None
        Relative brightness of the frames, (n_wavelengths, n_frames).
    beam_weights : `~numpy.ndarray` or None
        Of the fluxes, (2, n_wavelengths, n_frames).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.correction import estimator, measurement_rows
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> rows = measurement_rows(chain, {"hwp": [0, 45, 22.5, 67.5] * u.deg}, [1.6] * u.um)
    >>> estimator(rows).apply([[[1.0], [0.5], [1.0], [0.5]], [[0.5], [1.0], [0.5], [1.0]]]).tolist()
    [[1.5], [0.5], [0.5]]
    """

    components: str
    gain: np.ndarray
    rows: np.ndarray
    channels: Channels
    channel_rows: np.ndarray
    weights: np.ndarray
    condition: np.ndarray
    determined: np.ndarray
    leakage: np.ndarray
    weak: list
    max_condition: float = _MAX_CONDITION
    scale: np.ndarray | None = None
    beam_weights: np.ndarray | None = None

    def apply(self, fluxes):
        """
        Return the Stokes parameters of fluxes.

        Parameters
        ----------
        fluxes : array_like
            Shape (2, n_frames, n_wavelengths, ...), the right beam first.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_components, n_wavelengths, ...).
        """
        return np.einsum("wkbf,bfw...->kw...", self.gain, np.asarray(fluxes, dtype=float))

    def flags(self):
        """Return what is poorly determined, in words, by the index of the wavelength."""
        return {i: words for i, words in enumerate(self.weak) if words}


def estimator(
    rows,
    *,
    components="IQU",
    observable="intensity",
    pairs=None,
    weights=None,
    scale=None,
    max_condition=_MAX_CONDITION,
    labels=None,
):
    """
    Solve for what turns fluxes into Stokes parameters, wavelength by wavelength.

    Parameters
    ----------
    rows : `~numpy.ndarray`
        As `measurement_rows` gives them, (2, n_wavelengths, n_frames, 4).
    components : {"IQU", "IQUV"}
        What to solve for. Without V it is taken as zero, see ``leakage``. Where V is asked for
        and cannot be determined, it is taken as zero and flagged.
    observable : {"intensity", "single", "double"}
        What is fitted, see ``Channels``.
    pairs : array_like of int, optional
        Frames of the pairs of double differences, (n_pairs, 2).
    weights : array_like, optional
        Of the fluxes: (n_frames,), (n_wavelengths, n_frames) or (2, n_wavelengths, n_frames);
        the inverse of their variance. By default all weigh the same.
    scale : array_like, optional
        Relative brightness of the frames, (n_frames,) or (n_wavelengths, n_frames).
    max_condition : float
        A combination is poorly determined if its singular value is smaller than the largest
        by more than this.
    labels : sequence, optional
        What to call the frames in messages.

    Returns
    -------
    Estimator

    Raises
    ------
    ObservationError
        If Q and U are not determined at any wavelength.
    ParameterError
        If a choice is unknown, or weights or brightness are of wrong shape or negative.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.correction import estimator, measurement_rows
    >>> charis = instruments.get("charis")
    >>> positions = {"hwp": [0, 22.5, 45, 67.5] * u.deg, "derotator": [60] * 4 * u.deg,
    ...              "parallactic": [10] * 4 * u.deg, "altitude": [70] * 4 * u.deg}
    >>> sky = charis.on_sky(charis.published())
    >>> solution = estimator(measurement_rows(sky, positions, charis.wavelength))
    >>> bool(solution.determined.all()), bool(solution.condition.max() < 3)
    (True, True)
    """
    # rows are (2 beams, n_wavelengths, n_frames, 4)
    rows = np.asarray(rows, dtype=float)
    if components not in COMPONENTS:
        raise ParameterError(f"components = {components!r}; allowed are {', '.join(COMPONENTS)}")
    if not max_condition > 1:
        raise ParameterError(f"max_condition = {max_condition}; it must be above 1")
    shape = rows.shape[1:3]
    channels = Channels(observable, shape[1], pairs)
    weights = _weights(weights, shape)
    if scale is not None:
        scale = _positive("scale", scale, shape)
        rows = rows * scale[None, :, :, None]
    combined = channels.combine(np.moveaxis(rows, 1, 2))
    combined = np.moveaxis(combined, 2, 1)
    inverse = _inverse_variances(channels, weights)
    solved = [
        _solve(combined[:, w].reshape(-1, 4), inverse[:, w].ravel(), components, max_condition)
        for w in range(shape[0])
    ]
    gains, condition, determined, weak = zip(*solved, strict=True)
    gain = np.stack(gains).reshape(shape[0], len(components), 2, -1)
    gain = channels.to_beams(gain)
    found = Estimator(
        components,
        gain,
        rows,
        channels,
        combined,
        inverse,
        np.array(condition),
        np.array(determined),
        _leakage(gain, rows, components),
        list(weak),
        max_condition,
        scale,
        weights,
    )
    _refuse_undetermined(found, labels)
    return found


def _solve(rows, weights, components, max_condition):
    """Return gain, condition, what is determined, and in words what is not."""
    n = len(components)
    gain, values, weak = _pseudo_inverse(rows[:, :n], weights, max_condition)
    condition = values[0] / values[-1] if values[-1] > 0 else np.inf
    words = "; ".join(_in_words(direction, components) for direction in _led(weak))
    determined = _determined(weak, n)
    if len(weak) and n == 4 and not determined[3]:
        # V is what most often is open: the others are solved as without it
        gain = np.zeros((n, len(rows)))
        gain[:3], _, weak = _pseudo_inverse(rows[:, :3], weights, max_condition)
        determined = np.append(_determined(weak, 3), False)
    gain[~determined] = np.nan
    return gain, condition, determined, words


def _pseudo_inverse(rows, weights, max_condition):
    """Return the truncated inverse, the singular values and the directions left out."""
    root = np.sqrt(weights)
    # weights of 1e-300 or 1e300 must not under- or overflow in the singular values
    size = max(root.max(), np.finfo(float).tiny)
    count, n = rows.shape
    # rows of zeros, so that there is a singular value for each component
    scaled = np.zeros((max(count, n), n))
    scaled[:count] = rows * (root / size)[:, None]
    left, values, right = np.linalg.svd(scaled, full_matrices=False)
    # the largest always counts, unless all rows are zero
    good = (values * max_condition > values[0]) & (values > 0)
    gain = (right[good].T / values[good]) @ left[:count, good].T * (root / size)
    return gain, values, right[~good]


def _determined(weak, n):
    # a component that leans on an open direction is open itself
    return np.abs(weak).max(axis=0, initial=0.0) < _SHARE if len(weak) else np.ones(n, dtype=bool)


def _led(weak):
    """Return a basis of the same directions in which one component after the other leads."""
    # singular vectors of equal values are any basis, and each has any sign: their projector is one
    projector, basis = weak.T @ weak, []
    for _ in weak:
        lead = ranked(np.diag(projector))[0]
        basis.append(projector[lead] / np.sqrt(projector[lead, lead]))
        projector = projector - np.outer(basis[-1], basis[-1])
    return basis


def _in_words(direction, components):
    parts = [
        f"{value:+.2f} {name}"
        for name, value in zip(components, direction, strict=True)
        if abs(value) >= 0.005
    ]
    return " ".join(parts).removeprefix("+")


def _leakage(gain, rows, components):
    if "V" in components:
        leakage = np.zeros(gain.shape[:2])
        # where V was solved for, nothing leaks; where it was given up, it does as without it
        assumed = np.isnan(gain).any(axis=(2, 3))[:, 3]
        leakage[assumed] = np.einsum("wkbf,bwf->wk", gain, rows[..., 3])[assumed]
        return leakage
    return np.einsum("wkbf,bwf->wk", gain, rows[..., 3])


def _weights(weights, shape):
    if weights is None:
        return np.ones((2, *shape))
    return np.broadcast_to(_positive("weights", weights, shape, beams=True), (2, *shape))


def _positive(name, value, shape, beams=False):
    value = np.asarray(value, dtype=float)
    allowed = [shape[1:], shape] + ([(2, *shape)] if beams else [])
    if value.shape not in allowed:
        raise ParameterError(f"{name} has shape {value.shape}; allowed are {allowed}")
    # a weight of zero leaves a flux out; a frame without light says nothing
    if not np.all(np.isfinite(value)) or value.min() < 0 or (not beams and value.min() == 0):
        raise ParameterError(
            f"{name} = {value.min():g} must be finite and {'not negative' if beams else 'positive'}"
        )
    return np.broadcast_to(value, shape if value.ndim < 3 else value.shape)


def _inverse_variances(channels, weights):
    """Return the weights of the channels, (2, n_wavelengths, n_units)."""
    with np.errstate(divide="ignore"):
        # a weight of zero is an infinite variance, and stays a weight of zero in its pair
        variances = channels.variances(np.moveaxis(1 / weights, 1, 2))
        return np.moveaxis(1 / variances, 2, 1)


def _refuse_undetermined(found, labels):
    linear = found.determined[:, 1:3]
    if linear.all(axis=1).any():
        return
    count = found.rows.shape[2]
    words = f"{count} frame{'s' if count > 1 else ''}"
    if labels is not None:
        shown = ", ".join(map(str, list(labels)[:_MAX_NAMED]))
        words += f" ({shown}{', ...' if count > _MAX_NAMED else ''})"
    if found.channels.pairs is not None:
        words += f" in {len(found.channels.pairs)} pairs"
    raise ObservationError(
        f"Q and U are not determined at any wavelength by {words}: poorly determined is "
        f"{found.weak[0]}; frames at half-wave-plate angles such as 0, 22.5, 45 and 67.5 deg are "
        "needed"
    )
