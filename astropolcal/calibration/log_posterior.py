# Licensed under a 3-clause BSD style license - see LICENSE
"""
Log-posterior of a measurement, for many parameter vectors at once.

The likelihood is that of normal noise; the priors are those of the fit. It is
what `~astropolcal.calibration.sample` hands to the sampler, and good for any
other one.
"""

import numpy as np

from astropolcal.calibration.identifiability import physical_scale
from astropolcal.calibration.weighting import given_noise, noise_of, residual_noise
from astropolcal.exceptions import ParameterError

__all__ = ["LogPosterior", "residual_noise"]

FIT = "fit"


class LogPosterior:
    r"""
    Log-posterior of a measurement, up to a constant.

    :math:`-\frac{1}{2}\sum_i (r_i/\sigma_i)^2` plus the log density of the
    priors; minus infinity outside the bounds.

    Parameters
    ----------
    measurement : Measurement
        The measurement; its current values are those of the fit.
    weights : {"fit", None, "wavelength", "errors"}, NoiseEstimate or array_like
        Where the noise comes from, as for `calibrate`. By default it is the
        one that the fit assumed, so that fit and posterior agree; one level
        from the residuals of all data if no fit is known.
    noise : float, `~astropy.units.Quantity` or array_like, optional
        Noise to use instead: one value, one a wavelength, or one a datum.
    parameters : sequence of str, optional
        What varies, ``"hwp.w_sio2"`` (all its values) or
        ``"derotator.horizontal[3]"``; all others keep their fitted values. By
        default everything varies.

    Raises
    ------
    FitError
        If there is no noise to be had, see `noise_of`.
    ParameterError
        If a parameter is unknown, fixed or named twice, or the noise has the
        wrong shape or is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import LogPosterior
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> posterior = LogPosterior(cal.measurement, parameters=["hwp.w_sio2", "hwp.w_mgf2"])
    >>> posterior.names, posterior(posterior.centre) > posterior(posterior.centre + 1.0)
    (['hwp.w_sio2', 'hwp.w_mgf2'], True)
    """

    def __init__(self, measurement, weights=FIT, noise=None, parameters=None):
        self.measurement = measurement
        free = measurement.free
        low, high = free.bounds()
        #: All fitted values, canonical, shape (n_free,).
        self.fitted = np.clip(measurement.vector(), low, high)
        #: Elements of the flat vector that vary.
        self.sampled = _elements(free, parameters)
        #: Names of what varies, one an element.
        self.names = [free.names[i] for i in self.sampled]
        units = [slot.unit for slot in free.slots for _ in range(slot.size)]
        #: Declared units of what varies.
        self.units = [units[i] for i in self.sampled]
        #: Factors from declared to canonical units.
        self.factors = free.factors()[self.sampled]
        #: Bounds of what varies, canonical.
        self.low, self.high = low[self.sampled], high[self.sampled]
        #: Noise of each datum, shape (n_data,).
        self.sigma = _sigma(measurement, weights, noise)

    @property
    def centre(self):
        """Fitted values of what varies, canonical."""
        return self.fitted[self.sampled]

    def __call__(self, values):
        """
        Return the log-posterior.

        Parameters
        ----------
        values : array_like
            Canonical values, shape (n,) or (n_walkers, n).

        Returns
        -------
        float or `~numpy.ndarray`
            Shape (n_walkers,) for several.
        """
        values = np.asarray(values, dtype=float)
        if values.ndim not in (1, 2) or values.shape[-1] != self.sampled.size:
            raise ParameterError(
                f"values of shape {values.shape} for {self.sampled.size} parameters; allowed are "
                f"({self.sampled.size},) and (n_walkers, {self.sampled.size})"
            )
        found = self._of_rows(np.atleast_2d(values))
        return float(found[0]) if values.ndim == 1 else found

    def _of_rows(self, rows):
        # an optic outside of its bounds may not exist, so nothing is evaluated there
        inside = ((rows >= self.low) & (rows <= self.high)).all(axis=1)
        found = np.full(len(rows), -np.inf)
        if not inside.any():
            return found
        vectors = np.tile(self.fitted, (int(inside.sum()), 1))
        vectors[:, self.sampled] = rows[inside]
        likelihood = np.array([self._log_likelihood(vector) for vector in vectors])
        total = likelihood + self._log_prior(vectors)
        # emcee stops at NaN; a model that fails somewhere makes that place impossible
        found[inside] = np.where(np.isnan(total), -np.inf, total)
        return found

    def _log_likelihood(self, vector):
        # not through Measurement.predict, which keeps its last sweep for the fitters
        chi2 = 0.0
        for dataset, segment in zip(
            self.measurement.datasets, self.measurement.segments, strict=True
        ):
            residual = dataset.observed - dataset.values(dataset.forward(vector))
            residual /= self.sigma[segment]
            chi2 += residual @ residual
        return -0.5 * chi2

    def _log_prior(self, vectors):
        """Return the log density of the priors for each vector, each prior called once."""
        total = np.zeros(len(vectors))
        for slot, prior in self.measurement.free.priors:
            total += prior.log_densities(vectors[:, slot.slice]).sum(axis=1)
        return total

    def whitened_jacobian(self):
        """Return derivatives of data and priors over their noise, (n, n_data + n_priors)."""
        data = self.measurement.jacobian(self.fitted) / self.sigma
        priors = self.measurement.free.prior_jacobian(self.fitted)
        return np.concatenate([data, priors], axis=1)[self.sampled]

    def physical_scale(self):
        """Return a degree, a micrometre or a percent of what varies, canonical."""
        return physical_scale(self.measurement.free)[self.sampled]


def _elements(free, parameters):
    """Return the elements of the flat vector that the names stand for, in their order."""
    if not free.size:
        raise ParameterError("nothing to sample: every parameter is fixed or tied")
    if parameters is None:
        return np.arange(free.size)
    parameters = [parameters] if isinstance(parameters, str) else list(parameters)
    by_name = {name: [i] for i, name in enumerate(free.names)}
    by_name |= {slot.name: list(range(slot.start, slot.start + slot.size)) for slot in free.slots}
    for name in parameters:
        if name not in by_name:
            raise ParameterError(
                f"no free parameter {name!r}; allowed are "
                f"{', '.join(slot.name for slot in free.slots)}, or one value of them such as "
                f"{free.names[-1]}"
            )
    found = [i for name in parameters for i in by_name[name]]
    if not found or len(set(found)) < len(found):
        raise ParameterError(f"parameters = {parameters} must name something, and nothing twice")
    return np.array(found)


def _sigma(measurement, weights, noise):
    """Return the noise of every datum: given, that of the fit, or for a choice of weights."""
    if noise is not None:
        return given_noise(measurement, noise)
    if isinstance(weights, str) and weights == FIT:
        weights = measurement.weighting.choice if measurement.weighting is not None else None
    return noise_of(measurement, weights).sigma
