# Licensed under a 3-clause BSD style license - see LICENSE
"""
Noise of the data: from stated errors, from repeated data, or from the null channel.

A chi-square means something only beside a noise that does not come from the residuals it is
compared with. Each of the three says what it includes. The null channel, which the double
difference cancels, is there for every table that has no repeated data.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.linearized import RANK, orthonormal
from astropolcal.chain import states_of
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.observations.grid import MAD_TO_SIGMA
from astropolcal.observations.observables import OBSERVABLES
from astropolcal.observations.pointings import angle_or_zero
from astropolcal.units import angle_to_rad, positive_number
from astropolcal.words import check_choice

__all__ = [
    "noise_from_errors",
    "noise_from_null_channel",
    "noise_from_replicates",
    "noise_from_roughness",
]


@dataclass(frozen=True)
class NoiseEstimate:
    """
    Noise of one datum at each wavelength of each dataset.

    Parameters
    ----------
    dataset : `~numpy.ndarray` of int
        Dataset of each row, shape (n_rows,).
    wavelength : `~astropy.units.Quantity`
        Wavelength of each row.
    sigma : `~astropy.units.Quantity`
        Standard deviation of one datum (rms where they differ), in percent;
        NaN where it could not be estimated.
    dof : `~numpy.ndarray`
        Degrees of freedom of ``sigma``, infinite where it is known.
    method : {"errors", "replicates", "null channel", "roughness", "given"}
        Where it comes from.
    words : str
        What it includes and what it does not.
    sigma_of_data : `~numpy.ndarray`
        Standard deviation of every datum, dimensionless, shape (n_data,).
    independent : `~numpy.ndarray` or float
        How many of the wavelengths of the dataset have independent noise, as a share.

    Examples
    --------
    >>> from astropolcal.calibration.noise import noise_from_errors
    >>> from astropolcal import optics
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.observations import Observations, example_table
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(name="wollaston"))
    >>> measurement = Measurement(chain, Observations.from_table(example_table()))
    >>> noise = noise_from_errors(measurement)
    >>> noise.method, noise.sigma[0].round(2)
    ('errors', <Quantity 2.09 %>)
    """

    dataset: np.ndarray
    wavelength: u.Quantity
    sigma: u.Quantity
    dof: np.ndarray
    method: str
    words: str
    sigma_of_data: np.ndarray
    independent: object = 1.0

    def of_data(self, measurement):
        """Return the noise of every datum; refuse an estimate from another measurement."""
        if self.sigma_of_data.shape != (measurement.n_data,):
            raise FitError(
                f"the noise is that of {self.sigma_of_data.size} data, the measurement has "
                f"{measurement.n_data}; estimate it from this measurement"
            )
        return self.sigma_of_data


def data_by_wavelength(measurement):
    """Return number of the dataset, wavelength, and indices of unmasked data of each cell.

    A cell is a wavelength of a dataset.
    """
    numbers, wavelengths, rows = [], [], []
    for i, (part, where) in enumerate(zip(measurement.datasets, measurement.segments, strict=True)):
        bins = measurement.bins[where]
        rows += [where.start + np.flatnonzero(bins == b) for b in part.bins]
        wavelengths.append(part.observations.wavelength.to_value(u.nm))
        numbers += [i] * len(part.bins)
    return np.array(numbers), np.concatenate(wavelengths) * u.nm, rows


def rms(values):
    """Return the root mean square, NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan


def mean_of_known(values):
    """Return means of what is known along the last axis, NaN of nothing."""
    with np.errstate(invalid="ignore"):
        return np.nansum(values, axis=-1) / np.isfinite(values).sum(axis=-1)


def _of_data(measurement, sigma, dof, method, words, independent=1.0):
    """Return an estimate with a noise for each datum, (n_data,)."""
    numbers, wavelength, rows = data_by_wavelength(measurement)
    percent = 100 * np.array([rms(sigma[row]) for row in rows]) * u.percent
    dof = np.broadcast_to(dof, len(rows))
    return NoiseEstimate(numbers, wavelength, percent, dof, method, words, sigma, independent)


def _of_deviations(measurement, parts, method, words):
    """Return an estimate from deviations (n, n_bins) and freedom at each wavelength, by dataset.

    Without any degree of freedom the noise there is not known.
    """
    dof = np.concatenate([freedom for _, freedom in parts])
    squares = np.concatenate([np.sum(off**2, axis=0) for off, _ in parts])
    sigma = np.sqrt(np.where(dof > 0, squares / np.maximum(dof, 1), np.nan))
    sizes = [row.size for row in data_by_wavelength(measurement)[2]]
    shares = np.repeat([_independent(*part) for part in parts], [len(f) for _, f in parts])
    return _of_data(measurement, np.repeat(sigma, sizes), dof, method, words, shares)


def _independent(off, freedom):
    """Return how many wavelengths deviate independently, as a share of all."""
    off = off[:, (freedom > 0) & off.any(axis=0)]
    size = off.shape[1]
    if size < 2:
        return 1.0
    unit = off / np.linalg.norm(off, axis=0)
    # mean square of the correlation of two wavelengths, less what it is by chance
    found = (np.sum((unit.T @ unit) ** 2) - size) / (size * (size - 1))
    chance = 1 / freedom[freedom > 0].mean()
    common = (found - chance) / (1 - chance) if chance < 1 else 1.0
    return 1 / (1 + (size - 1) * max(common, 0.0))


# ---- known ------------------------------------------------------------------------------


def noise_as_given(measurement, sigma):
    """Return the noise of every datum that a user has given, as an estimate."""
    return _of_data(measurement, sigma, np.inf, "given", "as given to the fit")


def noise_from_errors(measurement, *, gain=None, read_noise=0.0):
    """
    Return the noise that the errors of the fluxes give.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    gain : float or `~astropy.units.Quantity`, optional
        Electrons per unit of flux, also in electron / adu. With it the errors of the table, if any,
        are left aside: the variance of a flux F is F / gain + (read_noise / gain)^2.
    read_noise : float or `~astropy.units.Quantity`
        Standard deviation per beam and frame in electrons, all pixels of the aperture together.

    Returns
    -------
    ``NoiseEstimate``
        Infinite degrees of freedom: taken as known.

    Raises
    ------
    FitError, ParameterError
        If the tables give no errors and no gain is given, or the gain or read
        noise is not a possible one.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration.noise import noise_from_errors
    >>> from astropolcal import optics
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.observations import Observations, example_table
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(name="wollaston"))
    >>> measurement = Measurement(chain, Observations.from_table(example_table()))
    >>> stated, four = (noise_from_errors(measurement, gain=g) for g in (None, 4.0))
    >>> np.allclose(stated.sigma, 2 * four.sigma)
    True
    """
    if gain is None:
        sigma, words = measurement.sigma, "the errors stated in the table only"
    else:
        gain = positive_number(gain, "gain", u.electron / u.adu)
        read_noise = positive_number(read_noise, "read_noise", u.electron, zero=True)
        parts = []
        for part in measurement.datasets:
            beams = part.observations.flux_right, part.observations.flux_left
            fluxes = [np.moveaxis(flux.T[:, part.frames], 2, 0) for flux in beams]
            # Poisson: var(F) = F / gain, plus the read noise in the same units
            variances = [flux / gain + (read_noise / gain) ** 2 for flux in fluxes]
            with np.errstate(invalid="ignore", divide="ignore"):
                parts.append(part.observable.variance(*fluxes, *variances)[part.valid])
        sigma = np.sqrt(np.concatenate(parts))
        words = f"photon noise at gain {gain:g} and read noise of {read_noise:g} electrons per beam"
    bad = ~(np.isfinite(sigma) & (sigma > 0))
    if bad.any():
        raise FitError(
            f"{bad.sum()} of {bad.size} data have no error; give gain= or estimate the noise from "
            "replicates or the null channel"
        )
    words = f"{words}: not flicker, nor what moves between frames"
    return _of_data(measurement, sigma.copy(), np.inf, "errors", words)


# ---- replicates ---------------------------------------------------------------------------


def noise_from_replicates(measurement, *, tolerance=0.1 * u.deg):
    r"""
    Return the noise from the scatter among data taken at the same settings.

    Same are all stages of the chain, modulo 180 deg, the states that it knows, that of a modulator
    (column ``flc_state``), and the beam. The scatter is that of the *residuals*, so
    that differences of position within ``tolerance`` count to second order only:
    with :math:`\bar r` the mean residual of a group of replicates,
    :math:`\sigma^2 = \sum (r - \bar r)^2 / \sum (m - 1)` over groups of m
    (pure error; Draper & Smith 1998, Applied Regression Analysis, Sec. 2.1,
    doi:10.1002/9781118625590).

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    tolerance : `~astropy.units.Quantity`
        Largest difference of a position among replicates, 0 to 90 deg.

    Returns
    -------
    ``NoiseEstimate``
        It includes all that differs between repeated data: photon and read noise, flicker,
        repeatability of the stages, drifts; but nothing that is the same in all of them.

    Raises
    ------
    FitError
        If nothing was repeated.
    ParameterError
        If the tolerance or the number of parameters is not a possible one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.noise import noise_from_replicates
    >>> from astropolcal import instruments
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[50, 50, 80, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> int(noise_from_replicates(Measurement(charis.chain(), observations)).dof[0])
    8
    """
    residuals = measurement.residuals()
    limit = angle_to_rad(tolerance, "tolerance")
    if limit.ndim or not 0 <= limit <= np.pi / 2:
        raise ParameterError(f"tolerance = {tolerance}; allowed is one angle from 0 to 90 deg")
    datasets = zip(measurement.datasets, measurement.chains, measurement.segments, strict=True)
    parts = [_replicate_scatter(part, c, residuals[where], limit) for part, c, where in datasets]
    if not any(freedom.any() for _, freedom in parts):
        names = ", ".join(part.observations.name for part in measurement.datasets)
        raise FitError(
            f"{names}: no two data at the same settings within {np.rad2deg(limit):g} deg; "
            "repeat a half-wave-plate cycle, or use the null channel"
        )
    words = (
        "scatter among repeated data: photon and read noise, flicker, repeatability of the "
        "stages; not what is the same in every repetition"
    )
    return _of_deviations(measurement, parts, "replicates", words)


def _replicate_scatter(part, chain, residuals, tolerance):
    """Return deviations from the mean of the same settings, and freedom at each wavelength."""
    dense, present = np.zeros(part.valid.shape), part.valid.T.astype(float)
    dense[part.valid] = residuals
    columns = [*_states(part.observations, chain)[part.frames.T]]
    columns += [equal_axes(angle, tolerance) for row in part.positions.values() for angle in row]
    # a number for the settings of every group of frames
    setting = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()
    member = (setting[:, None] == np.arange(setting.max() + 1)).astype(float)
    count = member.T @ present
    mean = member.T @ dense.T / np.maximum(count, 1)
    off = present * (dense.T - member @ mean)
    return off, (present.sum(axis=0) - (count > 0).sum(axis=0)).astype(int)


def _states(observations, chain):
    """Number what the states that the chain knows, of a modulator, and the beam are together."""
    columns = observations.frames.columns
    names = sorted({"flc_state", "beam", *states_of(chain)} & set(columns))
    # states are known as text
    told = [[str(value).strip() for value in columns[name]] for name in names]
    told = np.array([*told, [""] * observations.n_frames])
    return np.unique(told, axis=1, return_inverse=True)[1].ravel()


def equal_axes(angle, tolerance):
    """Number axes (radian, modulo 180 deg) so that those of one number lie within a tolerance."""
    axis = np.mod(angle, np.pi)
    ordered = np.sort(axis)
    gaps = np.diff(ordered, append=ordered[0] + np.pi)
    # begin behind the largest gap, lest 0 and 180 deg be torn apart
    along = np.mod(axis - ordered[(np.argmax(gaps) + 1) % len(axis)], np.pi)
    found, number, first = np.empty(len(axis), dtype=int), -1, -np.inf
    for i in np.argsort(along, kind="stable"):
        if along[i] - first > tolerance:
            number, first = number + 1, along[i]
        found[i] = number
    return found


# ---- noise of the data from the null channel, which the double difference cancels ----


_NULL_MODELS = ("constant", "smooth")
# far below the steps of a run, which in CHARIS's are 12.5 deg of derotator and 11.25 deg of plate
_SAME_DEROTATOR = np.deg2rad(0.5)
_SAME_PLATE = np.deg2rad(0.3)


def noise_from_null_channel(measurement, *, null_model="constant"):
    r"""
    Return the noise from the double sum of normalized differences.

    With :math:`x = (R - L)/(R + L)` of the frames of a pair, 45 deg of half-wave plate apart, the
    double difference is :math:`(x^+ - x^-)/2` and the null :math:`z = (x^+ + x^-)/2`. The plate
    turns the sign of the signal, so the null has next to none, while independent noise of the
    frames is the same in both. Taken away from z are what the chain predicts of it (a plate that is
    not exactly half a wave, with a retarder downstream of it, leaves some signal there), a multiple
    of :math:`x^2` at each wavelength (what beams unequal by e add,
    :math:`e(1 - x^2)`), and the null model. A datum of one frame is given
    :math:`\sqrt2` times the scatter of what is left.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    null_model : {"constant", "smooth"}
        The mean over the plate angles at each derotator angle; or for each
        plate angle a curve over the derotator angle D,
        :math:`a + b\cos 2D + c\sin 2D + d\cos 4D + f\sin 4D`.

    Returns
    -------
    ``NoiseEstimate``
        An upper limit: besides photon and read noise and flicker that changes the ratio of the
        beams it includes anything else makes the null change with the plate and is not in the
        chain, such as diattenuation. For strongly polarized light that exceeds the noise; the
        smooth null model takes away most of it. A change of the source's brightness cancels in x.

    Raises
    ------
    FitError
        If there are too few pairs for the null model, or no such model.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.noise import noise_from_null_channel
    >>> from astropolcal import instruments
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 57.5, 70] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> noise = noise_from_null_channel(Measurement(charis.chain(), observations))
    >>> int(noise.dof[0]), noise.method
    (8, 'null channel')
    """
    check_choice("null_model", null_model, _NULL_MODELS, FitError)
    _need_two_beams(measurement, "the null channel")
    vector = measurement.vector()
    datasets = zip(measurement.datasets, measurement.chains, strict=True)
    parts = [_null_scatter(part, chain, vector, null_model) for part, chain in datasets]
    if not any(freedom.any() for _, freedom in parts):
        raise FitError(
            f"the null channel has no degree of freedom left by the {null_model} null model; "
            "two plate angles per derotator angle (constant) or six derotator angles per plate "
            "angle (smooth) are needed"
        )
    words = (
        f"how far the null channel scatters beyond the null of the chain and a {null_model} term; "
        "this is an upper limit: photon and read noise, flicker and what the chain lacks are in it"
    )
    return _of_deviations(measurement, parts, "null channel", words)


def _need_two_beams(measurement, what):
    for part in measurement.datasets:
        if part.observations.single_beam:
            name = part.observations.name
            raise FitError(f"{name}: {what} needs two beams per frame, it has one")


def _null_scatter(part, chain, vector, null_model):
    """Return the null's residuals, as noise of a datum, and freedom at each wavelength."""
    obs = part.observations
    right, left = obs.flux_right, obs.flux_left
    pairs = obs.pairs()
    predicted = _predicted_differences(part, vector)
    # (n_pairs, n_wavelengths)
    null = 0.5 * ((right - left) / (right + left) - predicted)[pairs].sum(axis=1)
    signal = 0.5 * (predicted[pairs[:, 0]] - predicted[pairs[:, 1]])
    design = _null_design(obs, chain, pairs[:, 0], null_model)
    off, dof = np.zeros(null.shape), np.zeros(obs.n_bins, dtype=int)
    # z is a mean of two frames: its variance is half that of a frame, as is that of a double
    # difference; an observable of m frames has 2 / m of the null's
    scale = np.sqrt(2.0 / part.observable.frames_per_datum)
    for i, (z, x) in enumerate(zip(null.T, signal.T, strict=True)):
        good = np.isfinite(z)
        if good.any():
            # beams unequal by e have the difference x + e (1 - x^2):
            # its constant part is in the design
            columns = np.column_stack([design, x**2])[good]
            fit, _, rank, _ = np.linalg.lstsq(columns, z[good], rcond=RANK)
            off[good, i] = scale * (z[good] - columns @ fit)
            dof[i] = good.sum() - rank
    return off, dof


def _predicted_differences(part, vector):
    """Return the chain's normalized difference of every frame that gives a datum, (F, W)."""
    right, left = part.forward(vector).fluxes
    shape = (part.observations.n_bins, part.frames.size)
    difference = np.broadcast_to((right - left) / (right + left), shape)
    result = np.full((part.observations.n_frames, shape[0]), np.nan)
    result[part.frames.T.ravel()] = difference.T
    return result


def _null_design(observations, chain, frames, null_model):
    angle = angle_or_zero(observations, "derotator")[frames]
    state = _states(observations, chain)[frames]
    if null_model == "constant":
        curves, setting = np.ones((1, len(angle))), equal_axes(angle, _SAME_DEROTATOR)
    else:
        waves = [wave(k * angle) for k in (2, 4) for wave in (np.cos, np.sin)]
        curves = np.stack([np.ones_like(angle), *waves])
        setting = equal_axes(observations.position("hwp")[frames], _SAME_PLATE)
    _, setting = np.unique(np.stack([setting, state], axis=1), axis=0, return_inverse=True)
    # one column for each setting and curve
    steps = setting.ravel()[:, None] == np.arange(setting.max() + 1)
    return np.concatenate([curve[:, None] * steps for curve in curves], axis=1)


# ---- noise of frames: what is rough in wavelength ----


# the share of the frames' freedom that harmonics may take from the measure of the noise
_MOST_TURNING = 0.7
# second differences of fewer wavelengths tell nothing
_FEWEST_ROUGH = 5
# what is so many times the median size is no noise, however uneven that is
_FAR_OFF = 20.0
_SINGLE = OBSERVABLES["normalized_single_difference"]
# independent data that tell a spread as well as the median of second differences along wavelengths
_TELLS = 0.19


def noise_from_roughness(measurement):
    r"""
    Return the stated errors, or more where single frames are rough along the wavelengths.

    What static and rotating optics do to the normalized difference of a frame is a sum of a
    few harmonics of the stages' angles, sharp in wavelength or not; everything else that they do is
    smooth in wavelength. So noise is what is left of the residuals' second differences along the
    wavelengths without these harmonics. The diagnosis of what a model lacks compares with it, too.

    Parameters
    ----------
    measurement : Measurement
        The measurement.

    Returns
    -------
    ``NoiseEstimate``
        Besides photon and read noise it includes what else differs from wavelength to wavelength
        and is not a harmonic; not flicker that neighbouring wavelengths share. Infinite degrees of
        freedom where the stated errors stand.

    Raises
    ------
    FitError
        If a dataset has fewer than five wavelengths, or the residuals tell no noise.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.noise import noise_from_roughness
    >>> from astropolcal import instruments
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 57.5, 70] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> noise = noise_from_roughness(Measurement(charis.chain(), observations))
    >>> noise.method, bool(noise.dof[0] > 50)
    ('roughness', True)
    """
    _need_two_beams(measurement, "roughness of differences")
    vector = measurement.vector()
    sigmas, freedom = [], []
    for part in measurement.datasets:
        obs = part.observations
        if obs.n_bins < _FEWEST_ROUGH:
            raise FitError(
                f"{obs.name}: {obs.n_bins} wavelengths tell no roughness; {_FEWEST_ROUGH} are "
                "needed"
            )
        fluxes = obs.flux_right.T, obs.flux_left.T
        errors = obs.variance_right.T, obs.variance_left.T, obs.covariance.T
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = _SINGLE.variance(*(x[None] for x in (*fluxes, *errors)))
            difference = _SINGLE.evaluate(*(x[None] for x in fluxes))
            residual = difference - _predicted_differences(part, vector).T
        valid = np.isfinite(residual)
        frames = SimpleNamespace(variance=variance[None], valid=valid)
        angles = {}
        for stage, angle in part.positions.items():
            angles[stage] = np.zeros(obs.n_frames)
            angles[stage][part.frames.T] = angle
        residual = np.where(valid, residual, 0.0)
        (sigma,) = frame_noise(frames, residual[None], angles, part.bins)
        of_data = np.mean(sigma[:, part.frames] ** 2, axis=-1)[part.valid]
        sigmas.append(np.sqrt(of_data / part.observable.frames_per_datum))
        known = np.isfinite(variance) & (variance > 0) & valid
        stands = np.allclose(sigma[known], np.sqrt(variance[known])) and known.any()
        # with stated errors one number is estimated, without those of a few wavelengths each
        share = 1.0 if known.any() else _FEWEST_ROUGH / obs.n_bins
        freedom += [np.inf if stands else share * _TELLS * valid.sum()] * len(part.bins)
    words = (
        "the stated errors, or more where single frames are rough along the wavelengths: photon "
        "and read noise, and what else is sharp in wavelength; not flicker that neighbouring "
        "wavelengths share"
    )
    return _of_data(measurement, np.concatenate(sigmas), freedom, "roughness", words)


def frame_noise(channel, residual, angles, bins=None):
    """Return the noise of every number of each frame: the stated errors, or more by the data.

    ``channel`` has the stated ``variance`` (n, W, F) and what is ``valid`` (W, F), ``residual`` has
    the shape of the variance, ``angles`` the position of every stage, radian, (F,), and ``bins``,
    (W,), the place of each wavelength in the spectrum, by default that in the table.

    What static and rotating optics can do to a beam is a sum of a few
    harmonics of the stages' angles, sharp in wavelength or not; everything else
    is smooth in wavelength. So noise is what is left without either.
    """
    order = np.arange(len(channel.valid)) if bins is None else np.argsort(bins)
    sigma, valid = np.sqrt(channel.variance)[:, order], channel.valid[order]
    residual = residual[:, order]
    basis = _turning(angles, valid)
    whole = _whole(valid) if basis.shape[1] else np.ones(valid.shape[1], dtype=bool)
    # neighbours in wavelength of which none is masked
    three = valid[:-2] & valid[1:-1] & valid[2:]
    keep = three & whole
    for i in range(len(residual)):
        rough = np.nan
        if len(valid) >= _FEWEST_ROUGH and keep.any():
            left = np.where(whole, residual[i], 0.0)
            left = left - (left @ basis) @ basis.T
            # white noise of unit variance has second differences of variance 1 + 4 + 1
            second = (left[:-2] - 2 * left[1:-1] + left[2:]) / np.sqrt(6)
            # what is constant at a wavelength, as its brightness, is not noise
            second = second - np.median(second, axis=1, keepdims=True)
            # projection takes the freedom of its columns from the scatter
            shrunk = np.sqrt(1 - basis.shape[1] / whole.sum())
            # a median, lest a few sharp features of the optics count as noise
            rough = MAD_TO_SIGMA * np.median(np.abs(second[keep])) / shrunk
        stated = np.isfinite(sigma[i]) & (sigma[i] > 0) & valid
        if not stated.any():
            if not rough > 0:
                raise FitError(
                    f"{len(valid)} wavelengths without errors in the table tell no noise; give the "
                    "errors of the fluxes (flux_right_err and flux_left_err, flux_err or "
                    f"flux_NAME_err), or at least {_FEWEST_ROUGH} wavelengths with noise in the "
                    "residuals"
                )
            # nothing states which data are noisier: mean squares around each wavelength, without
            # what is far off
            level, half = np.zeros(len(valid)), _FEWEST_ROUGH // 2
            for j in range(len(valid)):
                # the first second difference is that of the second wavelength
                near = slice(max(j - 1 - half, 0), j + half)
                own = np.abs(second[near][keep[near]])
                own = own[own <= _FAR_OFF * np.median(own)] if own.size else own
                level[j] = np.sqrt(np.mean(own**2)) / shrunk if own.size else 0.0
            sigma[i] = np.where(level > 0, level, rough)[:, None]
            continue
        if np.isfinite(rough):
            total = (sigma[i][:-2] ** 2 + 4 * sigma[i][1:-1] ** 2 + sigma[i][2:] ** 2) / 6
            sigma[i] *= max(1.0, rough / np.median(np.sqrt(total)[three]))
        sigma[i] = np.where(stated, sigma[i], np.median(sigma[i][stated]))
    return sigma[:, np.argsort(order)]


def _turning(angles, valid):
    """Return an orthonormal basis of the harmonics of the stages, (F, k); k may be 0."""
    waves = [np.ones(valid.shape[1], dtype=complex)]
    for stage, orders in (("hwp", (2, 4)), ("derotator", (2, 4))):
        if stage in angles:
            turns = [np.exp(1j * k * angles[stage]) for k in orders]
            waves += [wave * t for wave in waves for turn in turns for t in (turn, turn.conj())]
    waves = by_state(waves, angles)
    whole = _whole(valid)
    columns = np.concatenate([part(np.array(waves)) for part in (np.real, np.imag)]).T
    basis = orthonormal(columns * whole[:, None], keep=1e-6)
    # too few frames would be left to tell the noise
    return basis if basis.shape[1] <= _MOST_TURNING * whole.sum() else basis[:, :0]


def by_state(waves, angles):
    """Return the waves, and for a modulator with two states those that change sign with them."""
    state = angles.get("flc_state", np.zeros(1))
    if np.ptp(state) == 0:
        return waves
    return [w for wave in waves for w in (wave, wave * (1 - 2 * state))]


def _whole(valid):
    """Return which frames have a datum at every wavelength, (F,)."""
    # a wavelength that is masked through the run, as in a band of water, makes no frame incomplete
    return valid[valid.any(axis=1)].all(axis=0)
