# Licensed under a 3-clause BSD style license - see LICENSE
"""
Noise of the data from the null channel, which the double difference cancels.

Every pair of frames gives a null beside its datum, so that this noise is there for every
table that has no repeated data; `estimate_noise` takes the better of the two.
"""

import numpy as np

from astropolcal.calibration.noise import equal_axes, noise_from_replicates, noise_of_cells
from astropolcal.exceptions import FitError

__all__ = ["estimate_noise", "noise_from_null_channel"]

_NULL_MODELS = ("constant", "smooth")
# far below the steps of a run, which in CHARIS's are 12.5 deg of derotator and 11.25 deg of plate
_SAME_DEROTATOR = np.deg2rad(0.5)
_SAME_PLATE = np.deg2rad(0.3)
# what does not vary beyond this share is no column of its own
_RANK = 1e-9


def noise_from_null_channel(measurement, vector=None, *, null_model="constant"):
    r"""
    Return the noise from the double sum of normalized differences.

    With :math:`x = (R - L)/(R + L)` of the frames of a pair, 45 deg of
    half-wave plate apart, the double difference is :math:`(x^+ - x^-)/2` and the
    null :math:`z = (x^+ + x^-)/2`. The plate turns the sign of the signal, so
    the null has next to none, while independent noise of the frames is the same
    in both. Taken away from z are what the chain predicts of it (a plate that is not
    exactly half a wave, with a retarder behind it, leaves some signal there),
    a multiple of :math:`x^2` at each wavelength (what beams unequal by e add,
    :math:`e(1 - x^2)`), and the null model. A datum of one frame is given
    :math:`\sqrt2` times the scatter of what is left.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : array_like, optional
        Parameters for the chain's own null, by default the current ones.
    null_model : {"constant", "smooth"}
        The mean over the plate angles at each derotator angle; or for each
        plate angle a curve over the derotator angle D,
        :math:`a + b\cos 2D + c\sin 2D + d\cos 4D + f\sin 4D`.

    Returns
    -------
    NoiseEstimate
        An upper limit: besides photon and read noise and flicker that changes
        the ratio of the beams it includes whatever else makes the null change
        with the plate and is not in the chain, such as diattenuation. For strongly
        polarized light that exceeds the noise; the smooth null model takes
        away most of it. A change of the source's brightness cancels in x.

    Raises
    ------
    FitError
        If there are too few pairs for the null model, or no such model.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import noise_from_null_channel
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 57.5, 70] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> noise = noise_from_null_channel(Measurement(charis.chain(), observations))
    >>> int(noise.dof[0]), noise.method
    (8, 'null channel')
    """
    if null_model not in _NULL_MODELS:
        raise FitError(f"null_model = {null_model!r}; allowed are {', '.join(_NULL_MODELS)}")
    vector = measurement.vector() if vector is None else np.asarray(vector, dtype=float)
    parts = [_null_scatter(part, vector, null_model) for part in measurement.datasets]
    squares, dof = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not (dof > 0).any():
        raise FitError(
            f"the null channel has no degree of freedom left by the {null_model} null model; "
            "two plate angles a derotator angle (constant) or six derotator angles a plate "
            "angle (smooth) are needed"
        )
    per_datum = [
        # z is a mean of two frames: its variance is half that of a frame, as is that of a double
        # difference; an observable of m frames has 2 / m of the null's
        np.full(len(part.bins), 2.0 / part.observable.frames_per_datum)
        for part in measurement.datasets
    ]
    sigma = np.sqrt(np.concatenate(per_datum) * squares / np.maximum(dof, 1))
    words = (
        f"scatter of the null channel about the chain's and a {null_model} null, an upper limit: "
        "photon and read noise, flicker, and what the chain leaves out of the null"
    )
    return noise_of_cells(measurement, sigma, dof, "null channel", words)


def _null_scatter(part, vector, null_model):
    """Return sum of squares of the null's residuals and freedom at each wavelength."""
    obs = part.observations
    right, left = obs.flux_right, obs.flux_left
    pairs = obs.pairs()
    predicted = _predicted_differences(part, vector)
    # (n_pairs, n_wavelengths)
    null = 0.5 * ((right - left) / (right + left) - predicted)[pairs].sum(axis=1)
    signal = 0.5 * (predicted[pairs[:, 0]] - predicted[pairs[:, 1]])
    design = _null_design(obs, pairs[:, 0], null_model)
    squares, dof = np.zeros(obs.n_bins), np.zeros(obs.n_bins, dtype=int)
    for i, (z, x) in enumerate(zip(null.T, signal.T, strict=True)):
        good = np.isfinite(z)
        if good.any():
            # beams unequal by e have the difference x + e (1 - x^2):
            # its constant part is in the design
            columns = np.column_stack([design, x**2])[good]
            fit, _, rank, _ = np.linalg.lstsq(columns, z[good], rcond=_RANK)
            squares[i] = np.sum((z[good] - columns @ fit) ** 2)
            dof[i] = good.sum() - rank
    return squares, dof


def _predicted_differences(part, vector):
    """Return the chain's normalized difference of every frame that gives a datum, (F, W)."""
    right, left = part.forward(vector).fluxes
    shape = (part.observations.n_bins, part.frames.size)
    difference = np.broadcast_to((right - left) / (right + left), shape)
    result = np.full((part.observations.n_frames, shape[0]), np.nan)
    result[part.frames.T.ravel()] = difference.T
    return result


def _null_design(observations, frames, null_model):
    angle = observations.position("derotator")[frames]
    state = np.zeros(len(frames), dtype=int)
    if "flc_state" in observations.frames.colnames:
        column = np.asarray(observations.frames["flc_state"])
        state = np.unique(column, return_inverse=True)[1][frames]
    if null_model == "constant":
        curves, setting = np.ones((1, len(angle))), equal_axes(angle, _SAME_DEROTATOR)
    else:
        twice = 2 * angle
        curves = np.stack([np.ones_like(twice), *_harmonics(twice), *_harmonics(2 * twice)])
        setting = equal_axes(observations.position("hwp")[frames], _SAME_PLATE)
    _, setting = np.unique(np.stack([setting, state], axis=1), axis=0, return_inverse=True)
    # one column for each setting and curve
    steps = setting.ravel()[:, None] == np.arange(setting.max() + 1)
    return np.concatenate([curve[:, None] * steps for curve in curves], axis=1)


def _harmonics(angle):
    return np.cos(angle), np.sin(angle)


def estimate_noise(measurement, vector=None, *, null_model="constant"):
    """
    Return the noise estimated from the data, replicates where there are any.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : array_like, optional
        Parameters, by default the current ones.
    null_model : {"constant", "smooth"}
        For the null channel, see `noise_from_null_channel`.

    Returns
    -------
    NoiseEstimate
        Of replicates where every wavelength has some, otherwise of the null channel.

    Raises
    ------
    FitError
        If neither is possible.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import estimate_noise
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 57.5, 57.5] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> estimate_noise(Measurement(charis.chain(), observations)).method
    'replicates'
    """
    try:
        noise = noise_from_replicates(measurement, vector)
    except FitError:
        return noise_from_null_channel(measurement, vector, null_model=null_model)
    if (noise.dof > 0).all():
        return noise
    return noise_from_null_channel(measurement, vector, null_model=null_model)
