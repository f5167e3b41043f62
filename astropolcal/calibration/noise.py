# Licensed under a 3-clause BSD style license - see LICENSE
"""
Noise of the data, from stated errors or from repeated data.

A chi-square means something only beside a noise that does not come from the
residuals it is compared with. There are three sources: the errors in the
table, the scatter among data taken at the same settings, and the null channel
(`~astropolcal.calibration.null_channel`). Each says what it includes.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.exceptions import FitError
from astropolcal.units import angle_to_rad

__all__ = [
    "NoiseEstimate",
    "data_by_wavelength",
    "equal_axes",
    "noise_from_errors",
    "noise_from_replicates",
    "noise_of_cells",
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
    method : {"errors", "replicates", "null channel"}
        Where it comes from.
    words : str
        What it includes and what it does not.
    sigma_of_data : `~numpy.ndarray`
        Standard deviation of every datum, dimensionless, shape (n_data,).

    Examples
    --------
    >>> from astropolcal.calibration import noise_from_errors
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

    @property
    def table(self):
        """One row a dataset and wavelength, a `~astropy.table.QTable`."""
        columns = {"dataset": self.dataset, "wavelength": self.wavelength}
        meta = {"method": self.method, "words": self.words}
        return QTable(columns | {"sigma": self.sigma, "dof": self.dof}, meta=meta)


def data_by_wavelength(measurement):
    """
    Return which data belong to each wavelength of each dataset.

    Parameters
    ----------
    measurement : Measurement
        The measurement.

    Returns
    -------
    dataset : `~numpy.ndarray` of int
        Shape (n_rows,).
    wavelength : `~astropy.units.Quantity`
        Shape (n_rows,).
    rows : list of `~numpy.ndarray`
        Indices of the data, those that are not masked.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.calibration.noise import data_by_wavelength
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.observations import Observations, example_table
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(name="wollaston"))
    >>> measurement = Measurement(chain, Observations.from_table(example_table()))
    >>> dataset, wavelength, rows = data_by_wavelength(measurement)
    >>> wavelength[1], rows[1].tolist()
    (<Quantity 1600. nm>, [2, 3])
    """
    numbers, wavelengths, rows = [], [], []
    for i, part in enumerate(measurement.datasets):
        bins = measurement.bins[measurement.segments[i]]
        first = measurement.segments[i].start
        rows += [first + np.flatnonzero(bins == b) for b in part.bins]
        wavelengths.append(part.observations.wavelength.to_value(u.nm))
        numbers += [i] * len(part.bins)
    return np.array(numbers), np.concatenate(wavelengths) * u.nm, rows


def noise_of_cells(measurement, sigma, dof, method, words):
    """
    Return an estimate of one noise for each wavelength of each dataset.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    sigma : array_like
        Standard deviation of a datum, dimensionless, in the order of `data_by_wavelength`.
    dof : array_like
        Degrees of freedom of each; without any the noise is not known.
    method, words : str
        As `NoiseEstimate` has them.

    Returns
    -------
    NoiseEstimate

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.calibration.noise import noise_of_cells
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.observations import Observations, example_table
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(name="wollaston"))
    >>> measurement = Measurement(chain, Observations.from_table(example_table()))
    >>> noise_of_cells(measurement, [0.01, 0.02, 0.03], [4, 4, 0], "made up", "").sigma
    <Quantity [ 1.,  2., nan] %>
    """
    numbers, wavelength, rows = data_by_wavelength(measurement)
    sigma = np.where(np.asarray(dof) > 0, sigma, np.nan)
    of_data = np.empty(measurement.n_data)
    for row, value in zip(rows, sigma, strict=True):
        of_data[row] = value
    percent = 100 * sigma * u.percent
    return NoiseEstimate(numbers, wavelength, percent, np.asarray(dof), method, words, of_data)


# ---- known ------------------------------------------------------------------------------


def noise_from_errors(measurement, *, gain=None, read_noise=0.0):
    """
    Return the noise that the errors of the fluxes give.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    gain : float, optional
        Electrons per unit of flux. With it the errors of the table, if any, are
        left aside: the variance of a flux F is F / gain + (read_noise / gain)^2.
    read_noise : float
        Standard deviation per beam and frame in electrons, all pixels of the
        aperture together.

    Returns
    -------
    NoiseEstimate
        Infinite degrees of freedom: taken as known.

    Raises
    ------
    FitError
        If the tables give no errors and no gain is given, or the gain or read
        noise is not a possible one.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import noise_from_errors
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
        sigma, words = measurement.sigma, "the errors stated in the table, and nothing else"
    else:
        sigma = _photon_sigma(measurement, _number("gain", gain, 0, False), read_noise)
        words = f"photon noise at gain {gain:g} and read noise of {read_noise:g} electrons a beam"
    bad = ~(np.isfinite(sigma) & (sigma > 0))
    if bad.any():
        raise FitError(
            f"{bad.sum()} of {bad.size} data have no error; give gain= or estimate the noise from "
            "replicates or the null channel"
        )
    numbers, wavelength, rows = data_by_wavelength(measurement)
    rms = [np.sqrt(np.mean(sigma[row] ** 2)) if row.size else np.nan for row in rows]
    return NoiseEstimate(
        numbers,
        wavelength,
        100 * np.array(rms) * u.percent,
        np.full(len(rows), np.inf),
        "errors",
        f"{words}: not flicker, nor what moves between frames",
        sigma.copy(),
    )


def _number(name, value, low, closed):
    if not np.isfinite(value) or value < low or (value == low and not closed):
        raise FitError(f"{name} = {value}; allowed are numbers {'from' if closed else 'above'} 0")
    return float(value)


def _photon_sigma(measurement, gain, read_noise):
    extra = (_number("read_noise", read_noise, 0, True) / gain) ** 2
    found = []
    for part in measurement.datasets:
        obs = part.observations
        fluxes = obs.flux_right, obs.flux_left
        right, left = (np.moveaxis(f.T[:, part.frames], 2, 0) for f in fluxes)
        with np.errstate(invalid="ignore", divide="ignore"):
            # Poisson: var(F) = F / gain, plus the read noise in the same units
            variance = part.observable.variance(
                right, left, right / gain + extra, left / gain + extra
            )
        found.append(np.sqrt(variance[part.valid]))
    return np.concatenate(found)


# ---- replicates ---------------------------------------------------------------------------


def noise_from_replicates(measurement, vector=None, *, tolerance=0.1 * u.deg):
    r"""
    Return the noise from the scatter among data taken at the same settings.

    Same are all stages of the chain, modulo 180 deg, and the state of a
    modulator (column ``flc_state``). The scatter is that of the *residuals*, so
    that differences of position within ``tolerance`` count to second order only:
    with :math:`\bar r` the mean residual of a group of replicates,
    :math:`\sigma^2 = \sum (r - \bar r)^2 / \sum (m - 1)` over groups of m
    (pure error; Draper & Smith 1998, Applied Regression Analysis, Sec. 2.1,
    doi:10.1002/9781118625590).

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : array_like, optional
        Parameters for the residuals, by default the current ones; shape (n_free,).
    tolerance : `~astropy.units.Quantity`
        Largest difference of a position among replicates.

    Returns
    -------
    NoiseEstimate
        It includes all that differs between repeated data: photon and read noise,
        flicker, repeatability of the stages, drifts; but nothing that is the same
        in all of them.

    Raises
    ------
    FitError
        If nothing was repeated.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import noise_from_replicates
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[50, 50, 80, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> int(noise_from_replicates(Measurement(charis.chain(), observations)).dof[0])
    8
    """
    residuals = measurement.residuals(vector)
    limit = float(angle_to_rad(tolerance, "tolerance"))
    group = np.empty(measurement.n_data, dtype=int)
    for part, where in zip(measurement.datasets, measurement.segments, strict=True):
        group[where] = _same_settings(part, limit)[part.group_of_datum]
    squares, dof = _scatter(residuals, group, data_by_wavelength(measurement)[2])
    if not dof.any():
        names = ", ".join(part.observations.name for part in measurement.datasets)
        raise FitError(
            f"{names}: no two data at the same settings within {np.rad2deg(limit):g} deg; "
            "repeat a half-wave-plate cycle, or use the null channel"
        )
    sigma = np.sqrt(squares / np.maximum(dof, 1))
    words = (
        "scatter among repeated data: photon and read noise, flicker, repeatability of the "
        "stages; not what is the same in every repetition"
    )
    return noise_of_cells(measurement, sigma, dof, "replicates", words)


def _scatter(values, group, rows):
    """Return the sum of squares about the mean of each group, and its freedom, by cell."""
    squares, dof = np.zeros(len(rows)), np.zeros(len(rows), dtype=int)
    for i, row in enumerate(rows):
        if row.size:
            _, label, counts = np.unique(group[row], return_inverse=True, return_counts=True)
            mean = np.bincount(label, values[row]) / counts
            squares[i] = np.sum((values[row] - mean[label]) ** 2)
            dof[i] = row.size - counts.size
    return squares, dof


def _same_settings(part, tolerance):
    """Return a number for the settings of every group of frames of a dataset."""
    columns = [equal_axes(angle, tolerance) for row in part.positions.values() for angle in row]
    frames = part.observations.frames
    if "flc_state" in frames.colnames:
        columns.append(np.unique(np.asarray(frames["flc_state"]), return_inverse=True)[1])
        columns[-1] = columns[-1][part.frames[:, 0]]
    if not columns:
        return np.zeros(len(part.frames), dtype=int)
    return np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()


def equal_axes(angle, tolerance):
    """
    Number axes, angles modulo 180 deg, so that those of one number lie within a tolerance.

    Parameters
    ----------
    angle : `~numpy.ndarray`
        In radian, shape (n,).
    tolerance : float
        Largest difference among those of one number, in radian.

    Returns
    -------
    `~numpy.ndarray` of int
        Shape (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration.noise import equal_axes
    >>> equal_axes(np.deg2rad([0, 45, 179.95, 225]), np.deg2rad(0.1)).tolist()
    [0, 1, 0, 1]
    """
    axis = np.mod(angle, np.pi)
    order = np.argsort(axis, kind="stable")
    gaps = np.diff(axis[order], append=axis[order[0]] + np.pi)
    # begin behind the largest gap, lest 0 and 180 deg be torn apart
    start = (int(np.argmax(gaps)) + 1) % len(axis)
    order = np.roll(order, -start)
    along = np.mod(axis[order] - axis[order[0]], np.pi)
    label, first = np.zeros(len(axis), dtype=int), along[0]
    for i, value in enumerate(along[1:], start=1):
        new = value - first > tolerance
        first = value if new else first
        label[i] = label[i - 1] + new
    result = np.empty_like(label)
    result[order] = label
    return result
