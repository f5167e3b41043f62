# Licensed under a 3-clause BSD style license - see LICENSE
"""
Bootstrap over blocks of frames: errors that do not trust the noise model.

Frames of one half-wave-plate cycle share what the model lacks (a lamp that
drifts, a derotator that stands slightly wrong), so their residuals are not
independent, and errors from the Jacobian are too small. Drawing whole cycles
with replacement keeps that dependence (Kuensch 1989, Ann. Statist. 17, 1217,
https://doi.org/10.1214/aos/1176347265).
"""

from dataclasses import dataclass

import numpy as np

from astropolcal.calibration._refit import Refit
from astropolcal.calibration.accuracy import leave_out_groups
from astropolcal.calibration.covariance import Covariance, full_covariance
from astropolcal.exceptions import FitError
from astropolcal.simulation import check_seed

__all__ = ["Resampled", "bootstrap"]

BLOCKS = ("derotator", "pair")
# resamples drawn for each one wanted before giving up
_PATIENCE = 5
_FEWEST_BLOCKS = 3
# a direction counts as lost if its singular value falls to this share of the original's
_LOST = 1e-7


@dataclass
class Resampled:
    """
    Parameters of refits to resampled data.

    Parameters
    ----------
    names : list of str
        Name of each parameter.
    units : list of `~astropy.units.Unit` or None
        Unit of each.
    samples : `~numpy.ndarray`
        Shape (n_resamples, n), in these units; NaN for parameters that the
        data do not determine, whose spread would be an accident of the fitter.
    block : str
        What was drawn: ``"derotator"`` or ``"pair"``.
    n_blocks : int
        How many of them the data have.
    n_rejected : int
        Resamples that did not determine what the data determine, or whose fit
        did not converge; others were drawn in their place.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Resampled
    >>> made = Resampled(["wollaston.efficiency"], [None], np.array([[0.97], [0.99]]), "pair", 8, 0)
    >>> float(made.stds[0].round(4))
    0.0141
    """

    names: list
    units: list
    samples: np.ndarray
    block: str
    n_blocks: int
    n_rejected: int

    @property
    def stds(self):
        """Standard deviation of each parameter, NaN where not determined."""
        return self.samples.std(axis=0, ddof=1)

    @property
    def covariance(self):
        """The sample covariance, a `Covariance`."""
        centred = self.samples - self.samples.mean(axis=0)
        return Covariance(self.names, self.units, centred.T @ centred / (len(self.samples) - 1))

    def std(self, name):
        """
        Return the standard deviation of one parameter.

        Parameters
        ----------
        name : str
            One of ``names``.

        Returns
        -------
        `~astropy.units.Quantity` or float

        Raises
        ------
        ParameterError
            If there is no such parameter.
        """
        return self.covariance.std(name)

    def interval(self, level=0.6827):
        """
        Return the percentile interval of each parameter.

        Parameters
        ----------
        level : float
            Share of the resamples inside.

        Returns
        -------
        low, high : `~numpy.ndarray`
            Shape (n,), in ``units``.
        """
        if not 0 < level < 1:
            raise FitError(f"level = {level}; allowed is a share between 0 and 1")
        return tuple(np.quantile(self.samples, [(1 - level) / 2, (1 + level) / 2], axis=0))

    def __repr__(self):
        return (
            f"<Resampled: {len(self.samples)} bootstrap resamples of {self.n_blocks} "
            f"{self.block} blocks, {len(self.names)} parameters>"
        )


def bootstrap(calibration, n=200, block="derotator", seed=None, progress=None):
    """
    Refit resampled data, drawn in blocks of frames with replacement.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    n : int
        Number of resamples.
    block : {"derotator", "pair"}
        What is drawn: all frames at a derotator angle, or single pairs of
        frames, each with all wavelengths. Every dataset keeps its number of
        blocks. ``"pair"`` assumes that pairs are independent.
    seed : int or `~numpy.random.Generator`, optional
        Seed.
    progress : callable, optional
        Called with the number of fits done and wanted after each.

    Returns
    -------
    Resampled

    Raises
    ------
    FitError
        If the block is unknown, ``n`` is below 2, a dataset has fewer than
        three blocks, or hardly any resample can be fitted.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import bootstrap
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 50, 65, 80, 95] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> bootstrap(cal, n=10, seed=1)
    <Resampled: 10 bootstrap resamples of 5 derotator blocks, 49 parameters>
    """
    if n < 2:
        raise FitError(f"n = {n}; a bootstrap needs at least 2 resamples")
    refit = Refit(calibration)
    groups = _blocks(refit.measurement, block)
    rng = np.random.default_rng(check_seed(seed))
    # what all data determine, a resample must determine too
    wanted = _singular_values(refit, 1.0)
    samples, rejected = [], 0
    while len(samples) < n:
        counts = _draw(rng, groups)
        vector = _resample(refit, counts, wanted)
        if vector is None:
            rejected += 1
            _check_patience(rejected, n)
            continue
        samples.append(vector)
        if progress is not None:
            progress(len(samples), n)
    return _result(calibration, refit, np.array(samples), block, groups, rejected)


def labels_of(measurement, block):
    """Return the number of the block of each datum; datasets have their own blocks."""
    if block not in BLOCKS:
        raise FitError(f"block = {block!r}; allowed are {', '.join(BLOCKS)}")
    if block == "derotator":
        return leave_out_groups(measurement)
    sizes = [len(dataset.frames) for dataset in measurement.datasets]
    first = np.cumsum([0, *sizes[:-1]])
    parts = zip(first, measurement.datasets, strict=True)
    return np.concatenate([start + dataset.group_of_datum for start, dataset in parts])


def _blocks(measurement, block):
    """Return for each dataset its slice of the data and the block of each datum."""
    labels, found = labels_of(measurement, block), []
    for dataset, segment in zip(measurement.datasets, measurement.segments, strict=True):
        _, numbers = np.unique(labels[segment], return_inverse=True)
        if numbers.max() + 1 < _FEWEST_BLOCKS:
            raise FitError(
                f"{dataset.observations.name} has {numbers.max() + 1} {block} blocks; a bootstrap "
                f"needs {_FEWEST_BLOCKS}, and many more to be accurate"
            )
        found.append((segment, numbers))
    return found


def _draw(rng, groups):
    """Return how often each datum occurs in a resample."""
    parts = []
    for _, numbers in groups:
        n_blocks = numbers.max() + 1
        # as many blocks as there are, with replacement
        drawn = np.bincount(rng.integers(n_blocks, size=n_blocks), minlength=n_blocks)
        parts.append(drawn[numbers])
    return np.concatenate(parts).astype(float)


def _resample(refit, counts, wanted):
    """Return the fit to a resample; None if it determines less than all data, or fails."""
    if np.any(_singular_values(refit, np.sqrt(counts))[: wanted.size] < _LOST * wanted):
        return None
    vector, _, arrived = refit.fit(refit.solution, counts)
    return vector if arrived else None


def _singular_values(refit, scale):
    """Return the singular values that are not zero, of columns of natural size."""
    jacobian = refit.jacobian(refit.solution, refit.weights * scale)
    size = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.where(size > 0, size, 1.0), compute_uv=False)
    return singular[singular > 1e-9 * singular[0]] if np.ndim(scale) == 0 else singular


def _check_patience(rejected, n):
    if rejected > _PATIENCE * n + 10:
        raise FitError(
            f"{rejected} resamples could not be fitted: the data have too few blocks for the model"
        )


def _result(calibration, refit, vectors, block, groups, rejected):
    known = full_covariance(calibration)
    samples = vectors / refit.measurement.free.factors()
    is_open = (np.abs(known._axes().open) > 1e-5).any(axis=0)
    # where the data leave a direction open, a fit ends anywhere along it
    samples[:, is_open] = np.nan
    n_blocks = sum(int(numbers.max()) + 1 for _, numbers in groups)
    return Resampled(known.names, known.units, samples, block, n_blocks, rejected)
