# Licensed under a 3-clause BSD style license - see LICENSE
"""Quick fits from a known solution: with other weights, or with parameters held."""

import numpy as np

from astropolcal.calibration.weighting import weighting_of

_MAX_EVALUATIONS = 100


class Refit:
    """The least-squares problem of a calibration: data, priors, bounds."""

    def __init__(self, calibration):
        self.measurement = calibration.live_measurement()
        self.solution = self.measurement.vector()
        weighting = weighting_of(calibration)
        weights = weighting.weight
        # with equal weights residuals stay dimensionless, and the
        # noise multiplies the priors instead
        self.weights = np.ones(self.measurement.n_data) if weights is None else weights
        self._noise = weighting.level
        self._low, self._high = self.measurement.free.bounds()

    def residuals(self, vector, weights):
        """Return weighted residuals of data and priors."""
        data = weights * (self.measurement.predict(vector) - self.measurement.observed)
        return np.concatenate([data, self._noise * self.measurement.free.prior_residuals(vector)])

    def jacobian(self, vector, weights):
        """Return the derivative of `residuals`, (n_data + n_priors, n_free)."""
        data = self.measurement.jacobian(vector) * weights
        priors = self.measurement.free.prior_jacobian(vector) * self._noise
        return np.concatenate([data, priors], axis=1).T

    def fit(self, start, counts=None, held=()):
        """
        Fit from a start.

        ``counts`` tells how often each datum occurs, ``held`` which elements
        stay as they are. Returns the vector, chi-square, and whether it arrived.
        """
        from scipy.optimize import least_squares

        # a datum drawn k times adds k r^2 to chi-square; one never drawn adds nothing
        weights = self.weights if counts is None else self.weights * np.sqrt(counts)
        live = np.setdiff1d(np.arange(start.size), held)
        vector = start.copy()

        def place(part):
            vector[live] = part
            return vector

        found = least_squares(
            lambda part: self.residuals(place(part), weights),
            # least_squares refuses a start outside of the bounds by a rounding error
            np.clip(start[live], self._low[live], self._high[live]),
            jac=lambda part: self.jacobian(place(part), weights)[:, live],
            bounds=(self._low[live], self._high[live]),
            # a radian, a micrometre and a 1 move the data by very different amounts
            x_scale=self._scale(start, weights)[live],
            max_nfev=_MAX_EVALUATIONS,
        )
        return place(found.x).copy(), 2 * found.cost, found.status > 0

    def _scale(self, vector, weights):
        """Return the natural step of each parameter; 1 for one that moves nothing."""
        size = np.linalg.norm(self.jacobian(vector, weights), axis=0)
        return 1 / np.where(size > 0, size, 1.0)
