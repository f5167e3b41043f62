# Licensed under a 3-clause BSD style license - see LICENSE
"""
One noise for all who need it: fit, errors, gauge, tests and sampler.

The noise of a datum is its weight in the fit, the scale of all errors, and the width of the
likelihood. So that these agree, it is worked out here only, for every choice of ``weights``, and
stays with the fitted measurement.

A robust loss lets data that depart far from the model count less, by iterated weights: a datum with
residual r has the noise that a least-squares fit would need to give it the weight of the loss.
Nothing is dropped; `outlying_data` says which frames depart.
"""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.linearized import Whitened, triangle
from astropolcal.calibration.noise.estimates import NoiseEstimate, data_by_wavelength, rms
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.observations.grid import MAD_TO_SIGMA, brightness
from astropolcal.observations.pointings import frame_names
from astropolcal.units import to_unit
from astropolcal.words import check_choice, did_you_mean

__all__ = ["outlying_data"]

# robust standard deviations beyond which a frame is at odds with the model
_FAR = 4.0
# a datum of one wavelength is beyond so many times as many, unless more of the data are fitted away
_ALONE, _MOST_FITTED = 1.5, 0.5
# so many times as many data as parameters are fitted by their triangular factor
_TALL = 10
# smallest weight, so that no datum is lost altogether
_LEAST = 1e-4
# step of residuals in units of the noise for the slope of their pull
_SMALL = 1e-4

#: Weight of a datum by its residual in units of the noise; the constants give 95 % of the
#: efficiency of least squares for normal noise (Holland & Welsch 1977,
#: doi:10.1080/03610927708827533).
LOSSES = {
    "linear": np.ones_like,
    "huber": lambda r: np.minimum(1.0, 1.345 / np.maximum(np.abs(r), 1e-300)),
    "cauchy": lambda r: 1 / (1 + (r / 2.385) ** 2),
    "bisquare": lambda r: np.clip(1 - (r / 4.685) ** 2, 0.0, None) ** 2,
}


def robust_weighting(measurement, loss):
    """Return the noise of every datum that gives it the weight of a loss, one of `LOSSES`."""
    # that of a calibration from a file may be any text
    check_choice("loss", loss, LOSSES, FitError)
    residuals, n = measurement.residuals(), measurement.n_data
    # the fit has taken its share from the residuals
    taken = np.sqrt(n / max(n - measurement.free.size, 1))
    scale = _scales(measurement, residuals) * taken
    pulls = residuals / scale
    weight = np.maximum(LOSSES[loss](pulls), _LEAST)
    # what a datum pulls with is the residual times its weight
    up, down = ((pulls + step) * LOSSES[loss](pulls + step) for step in (_SMALL, -_SMALL))
    slope = (up - down) / (2 * _SMALL)
    # least squares weighs by 1 / sigma^2: sigma = scale / sqrt(weight of the loss)
    return Weighting(GIVEN, scale / np.sqrt(weight), slope / weight)


def _scales(measurement, residuals):
    """Return the robust standard deviation of each datum's dataset and wavelength."""
    rows = data_by_wavelength(measurement)[2]
    levels = [np.median(np.abs(residuals[row])) if row.size else 0.0 for row in rows]
    scale = MAD_TO_SIGMA * np.repeat(levels, [row.size for row in rows])
    for where in measurement.segments:
        least = _FLOOR * np.median(scale[where]) if scale[where].size else 0.0
        scale[where] = np.maximum(scale[where], max(least, 1e-12))
    return scale


def outlying_data(calibration):
    """
    Return the pairs of frames that are at odds with a calibration.

    The residuals of a pair, in units of the robust noise of its wavelength, are reduced to
    their median over the wavelengths, which is what a cloud, a satellite or a wrong angle
    changes. A pair is at odds if this departs by more than four robust standard deviations
    of all pairs of its dataset. It is at odds at one wavelength, as a cosmic ray does it, if its
    datum there departs by more than one and a half times as many.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.

    Returns
    -------
    `~astropy.table.QTable`
        Largest first: ``dataset``, ``frames`` (numbers as text), ``wavelength`` (NaN of those at
        odds at all), ``residual`` (there, or median over the wavelengths, percent), ``sigma`` (in
        robust standard deviations) and ``brightness`` (of the fainter frame, relative to the
        median frame). Empty if there is none. ``meta["data"]`` has the numbers of all their data.

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Examples
    --------
    >>> from astropolcal.calibration.noise import outlying_data
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(outlying_data(cal))
    0
    """
    live, rows, data = calibration.live_measurement(), [], []
    residuals = live.residuals()
    scales = _scales(live, residuals)
    scaled, tells = residuals / scales, live.free.size <= _MOST_FITTED * live.n_data
    for part, where in zip(live.datasets, live.segments, strict=True):
        groups = np.unique(part.group_of_datum)
        members = [where.start + np.flatnonzero(part.group_of_datum == g) for g in groups]
        bright = brightness(part.observations)
        # few data of a wavelength may have a small scatter by chance
        size = np.abs(residuals) / np.maximum(scales, np.median(scales[where]))
        # by how many robust standard deviations each pair departs at all its wavelengths
        common = np.array([np.median(scaled[own]) for own in members])
        off = np.abs(common - np.median(common))
        # what noise alone gives a median of so many wavelengths
        least = np.array([1.25 / np.sqrt(own.size) for own in members])
        for i, whole in enumerate(off / np.maximum(MAD_TO_SIGMA * np.median(off), least)):
            alone = members[i][np.argmax(size[members[i]])]
            times = size[alone] * tells
            if max(whole, times / _ALONE) > _FAR:
                own, nm = members[i], np.nan
                if not whole > _FAR:
                    own, nm, whole = alone, 1e3 * live.wavelength[live.bins[alone]], times
                frames = part.frames[groups[i]]
                numbers = ", ".join(np.array(frame_names(part.observations.frames))[frames])
                told = (nm, 100 * np.median(residuals[own]), whole, bright[frames].min())
                rows.append((part.observations.name, numbers, *map(float, told)))
                data += np.atleast_1d(own).tolist()
    rows.sort(key=lambda row: -row[4])
    names = ("dataset", "frames", "wavelength", "residual", "sigma", "brightness")
    units = {"wavelength": u.nm, "residual": u.percent}
    kinds, meta = (str, str, *[float] * 4), {"data": data}
    return QTable(rows=rows or None, names=names, dtype=kinds, units=units, meta=meta)


# ---- one noise for all who need it: fit, errors, gauge, tests and sampler ----


CHOICES = (None, "wavelength", "errors")
GIVEN = "given"
# no wavelength counts as less noisy than this share of the median of its dataset
_FLOOR = 0.1
# rounds of noise from residuals, and the relative change of it at which they end
ROUNDS = 10
_SETTLED = 1e-2
# fewer degrees of freedom than this tell no noise
_LEAST_FREEDOM = 0.5
_MAX_EVALUATIONS = 100
# a derivative below this share of the largest may vanish at an extremum; then it is this many
# times larger, and this share of the largest, so many degrees, micrometres or percent beside it
_WEAK, _GROWN, _SEEN, _BESIDE = 3e-3, 10.0, 1e-6, 5.0
# the share of the way at which the data change by the noise that changes nothing else
_PART_OF_WAY = 0.02
# normalized data do not reach this; one over a noise does
_LARGEST = 1.0


class Weighting:
    """Noise that a fit assumes of its data.

    ``choice`` says where it comes from: None for one level from all residuals, "wavelength",
    "errors" of the table, or "given"; ``sigma`` is that of every datum, NaN as long as no fit has
    determined it.
    """

    def __init__(self, choice, sigma, follows=None):
        self.choice, self.sigma = choice, sigma
        #: By how much the pull of each datum grows with its residual, over that of a weight which
        #: stays; None where weights do not depend on the residuals.
        self.follows = follows
        #: Whether every datum has a noise.
        self.is_known = not np.isnan(sigma).any()
        #: Whether the noise comes from the residuals of the fit.
        self.from_residuals = choice in (None, "wavelength")
        #: One over the noise of each datum; None where all weigh the same.
        self.weight = 1 / sigma if choice is not None and self.is_known else None
        #: Standard deviation of a datum of weight one, against which priors weigh.
        self.level = float(sigma[0]) if self.weight is None else 1.0

    def agrees(self, other):
        """Return whether another noise is the same to a hundredth."""
        change = np.abs(self.sigma - other.sigma)
        return bool(np.all(change <= _SETTLED * np.maximum(self.sigma, other.sigma)))

    def started(self, measurement):
        """Return one level for all data, from the residuals before the first fit."""
        freedom = max(measurement.n_data - measurement.free.size, 1)
        level = np.sqrt(np.sum(measurement.residuals() ** 2) / freedom) or 1.0
        return Weighting(self.choice, np.full(measurement.n_data, level))

    def updated(self, measurement, whitened=None):
        """Return the noise that the residuals of a fit with this noise show.

        ``whitened`` is the linear problem of the measurement with this noise, if available.
        """
        if not self.from_residuals:
            return self
        whitened = Problem(measurement, self).around() if whitened is None else whitened
        if self.choice == "wavelength":
            sigma = _by_wavelength(measurement, whitened.leverage)
            return Weighting(self.choice, sigma)
        freedom = measurement.n_data - whitened.n_taken
        total = np.sum(measurement.residuals() ** 2)
        level = np.sqrt(total / freedom) if freedom > _LEAST_FREEDOM else np.nan
        return Weighting(None, np.full(measurement.n_data, level))


class Problem:
    """The least-squares problem of a measurement: data, priors and bounds, and their noise."""

    def __init__(self, measurement, weighting):
        self.measurement, self.weighting = measurement, weighting
        #: The parameters that the measurement has when the problem is posed.
        self.solution = measurement.vector()
        weight = weighting.weight
        # with equal weights residuals stay dimensionless, and the noise multiplies the priors
        self.weights = np.ones(measurement.n_data) if weight is None else weight
        if measurement.n_priors and not weighting.is_known:
            weighting = weighting.started(measurement)
        self.noise = weighting.level
        self._low, self._high = measurement.free.bounds()

    def residuals(self, vector, weights=None, drawn=0.0):
        """Return weighted residuals of data and priors, model minus observed."""
        data = self.measurement.predict(vector) - self.measurement.observed
        priors = self.noise * (self.measurement.free.prior_residuals(vector) - drawn)
        return np.concatenate([data * (self.weights if weights is None else weights), priors])

    def jacobian(self, vector, weights=None):
        """Return the derivative of `residuals`, (n_data + n_priors, n_free)."""
        weights = self.weights if weights is None else weights
        data = self.measurement.jacobian(vector) * weights
        priors = self.measurement.free.prior_jacobian(vector) * self.noise
        return np.concatenate([data, priors], axis=1).T

    def around(self, vector=None):
        """Return the linear problem around a vector, by default the solution."""
        vector, free = self.solution if vector is None else vector, self.measurement.free
        data = self.measurement.jacobian(vector) * self.weights
        priors = free.prior_jacobian(vector, for_errors=True) * self.noise
        return Whitened(data, free.steps, priors, free.at_bounds(vector))

    def beside_extrema(self, vector, whitened):
        """Return a vector a little beside the extrema, as half a wave is, of what is hardly known.

        Derivatives vanish there, and what trades with such a parameter would seem to be known well.
        A small part of the way at which the data change by the noise changes nothing else.
        """
        data, steps = whitened.rows.T, whitened.scale
        size = np.linalg.norm(data, axis=1)
        weak = ~whitened.held & (size < _WEAK * size.max(initial=0.0))
        if weak.any():
            weak &= ~(self._errors(whitened) < _BESIDE)
        bent, moved = data.copy(), vector.copy()
        ways = np.full(vector.size, np.nan)
        for slot in self.measurement.free.slots:
            own = np.arange(slot.start, slot.start + slot.size)[weak[slot.slice]]
            if not own.size:
                continue
            there, way = vector.copy(), _BESIDE * steps[own]
            sign = np.where(vector[own] + way > self._high[own], -1, 1)
            there[own] += sign * way
            beside = self.measurement.jacobian(there)[own] * self.weights * steps[own, None]
            grown = np.linalg.norm(beside, axis=1)
            grown = (grown > _GROWN * size[own]) & (grown > _SEEN * size.max())
            # away from the extremum, on whose other side the derivative has the other sign
            sign = np.where(np.sum(beside * data[own], axis=1) < 0, -sign, sign)
            ways[own[grown]] = sign[grown]
            bent[own[grown]] = beside[grown]
        if np.isnan(ways).all():
            return None
        around = Whitened(bent / steps[:, None], steps, whitened.prior_rows.T / steps[:, None])
        errors = np.nan_to_num(self._errors(around), nan=_BESIDE, posinf=_BESIDE)
        # the slope grows with the way: there it is as long as the error that follows from it
        ways *= _PART_OF_WAY * np.sqrt(2 * _BESIDE * errors) * steps
        moved += np.nan_to_num(ways)
        return np.clip(moved, self._low, self._high)

    def _errors(self, whitened):
        """Return standard errors in steps, NaN of what is open."""
        weighting = self.weighting
        level = (weighting if weighting.is_known else weighting.started(self.measurement)).level
        return level * np.sqrt(np.diag(whitened.covariance())) / whitened.scale

    def fit(self, start, counts=None, held=(), evaluations=_MAX_EVALUATIONS, drawn=0.0, gain=1e-8):
        """Return the vector, chi-square, and what scipy says of the fit.

        ``counts`` tells how often each datum occurs, ``held`` which elements stay, ``evaluations``
        after how many the fit ends, ``drawn`` the residuals at which priors have their peaks, and
        ``gain`` the share of chi-square below which a step is the last.
        """
        # a calibration is read where there is no scipy
        from scipy.optimize import least_squares

        # a datum drawn k times adds k r^2 to chi-square; one never drawn adds nothing
        weights = self.weights if counts is None else self.weights * np.sqrt(counts)
        live = np.setdiff1d(np.arange(start.size), held)
        vector = start.copy()

        def place(part):
            vector[live] = part
            return vector

        # a radian, a micrometre and a 1 move the data by very different amounts
        size = np.linalg.norm(self.jacobian(start, weights), axis=0)[live]
        # what moves them by rounding alone has no length
        size[size <= np.finfo(float).eps * size.max(initial=0.0)] = 1.0

        def residuals(part):
            return self.residuals(place(part), weights, drawn)

        def slopes(part):
            return self.jacobian(place(part), weights)[:, live]

        if self.measurement.n_data > _TALL * live.size:
            residuals, slopes = _short(residuals, slopes)
        found = least_squares(
            residuals,
            # least_squares refuses a start outside of the bounds by a rounding error
            np.clip(start[live], self._low[live], self._high[live]),
            jac=slopes,
            bounds=(self._low[live], self._high[live]),
            x_scale=1 / size,
            max_nfev=evaluations,
            ftol=gain,
        )
        return place(found.x).copy(), 2 * found.cost, found


def _short(residuals, slopes):
    """Return residuals and their derivatives, turned so that all but a few rows are zero.

    The triangular factor of both has the same sums of squares and products as they have: a fitter
    takes the same steps, and decomposes a small matrix in place of a tall one.
    """
    seen = [None, None]

    def turned(part):
        if seen[0] is None or (seen[0] != part).any():
            seen[:] = part.copy(), triangle(np.column_stack([slopes(part), residuals(part)]))
        return seen[1]

    return lambda part: turned(part)[:, -1], lambda part: turned(part)[:, :-1]


# ---- the choices ------------------------------------------------------------------------


def first_weighting(measurement, weights):
    """Return the noise for a choice of weights before anything is fitted."""
    if isinstance(weights, Weighting):
        return weights
    if isinstance(weights, NoiseEstimate):
        sigma, before = weights.of_data(measurement), f"noise from {weights.method}: "
        return _known(GIVEN, sigma, before, "have none")
    if weights is not None and not isinstance(weights, str):
        sigma = given_noise(measurement, weights)
        if np.median(sigma) > _LARGEST:
            raise ParameterError(
                f"a noise of {100 * np.median(sigma):.3g} %: weights takes the noise of the data, "
                "not one over it"
            )
        return Weighting(GIVEN, sigma)
    if weights == GIVEN:
        raise FitError("weights='given': this measurement was not fitted with a noise given to it")
    if weights not in CHOICES:
        hint = did_you_mean(weights, CHOICES[1:])
        raise FitError(
            f"weights = {weights!r}; allowed are None, 'wavelength', 'errors', or the noise itself"
            f"{hint}"
        )
    if weights != "errors":
        return Weighting(weights, np.full(measurement.n_data, np.nan))
    return _known("errors", measurement.sigma, "weights='errors', but ", "have no error")


def _known(choice, sigma, before, after):
    """Return the noise; words around the number of data without one if there are such."""
    bad = ~(np.isfinite(sigma) & (sigma > 0))
    if bad.any():
        raise FitError(f"{before}{bad.sum()} of {bad.size} data {after}")
    return Weighting(choice, sigma)


def assumed(measurement, weights):
    """Return the noise of data with weights, (n_data,); of None that of a fit of equal weights."""
    if weights is not None:
        with np.errstate(divide="ignore"):
            # without weight is what has infinite noise
            return Weighting(GIVEN, 1 / np.asarray(weights, dtype=float))
    fitted = measurement.weighting
    if fitted is not None and fitted.choice is None and fitted.is_known:
        return fitted
    return Weighting(None, np.full(measurement.n_data, np.nan)).started(measurement)


def noise_of(measurement, weights=None):
    """Return the noise of every datum for a choice of weights, as `calibrate` takes it.

    "wavelength" is the restricted maximum likelihood of one level per wavelength of each dataset
    (Patterson & Thompson 1971, Biometrika 58, 545, doi:10.1093/biomet/58.3.545).
    """
    fitted = measurement.weighting
    same = isinstance(weights, str) or weights is None
    if fitted is not None and same and fitted.choice == weights:
        return _told(measurement, fitted)
    weighting = first_weighting(measurement, weights)
    if weighting.from_residuals:
        weighting = weighting.started(measurement)
        for _ in range(ROUNDS):
            before, weighting = weighting, _told(measurement, weighting.updated(measurement))
            if weighting.agrees(before):
                break
    return weighting


def problem_of(calibration):
    """Return the least-squares problem of a calibration, which needs its data."""
    return Problem(calibration.live_measurement(), weighting_of(calibration))


def weighting_of(calibration):
    """Return the noise that a calibration, which needs its data, assumes of them."""
    measurement, settings = calibration.live_measurement(), calibration.settings
    if measurement.weighting is None:
        noise = settings.get("weights")
        if noise == GIVEN and settings.get("loss", "linear") != "linear":
            noise = robust_weighting(measurement, settings["loss"])
        elif noise == GIVEN:
            # as `describe` has kept it
            kept = [value for part in settings["noise"] for value in part["sigma_percent"]]
            sizes = [row.size for row in data_by_wavelength(measurement)[2]]
            sigma = np.repeat(np.array(kept, dtype=float) / 100, sizes)
            for part, where in zip(settings["noise"], measurement.segments, strict=True):
                sigma[where] = part.get("sigma_of_data", sigma[where])
            noise = Weighting(GIVEN, sigma)
        measurement.weighting = noise_of(measurement, noise)
    return measurement.weighting


def _told(measurement, weighting):
    """Refuse residuals that leave no degree of freedom, or nothing at all."""
    if not (weighting.is_known and weighting.sigma.min() > 0):
        raise FitError(
            f"{measurement.n_data} data, {measurement.free.size} free parameters and an rms "
            f"residual of {rms(measurement.residuals()):.3g} tell no noise; give noise= or other "
            "weights"
        )
    return weighting


def describe(measurement):
    """Return the noise of each dataset and wavelength as plain lists, for the settings.

    Where a noise given differs within a wavelength, that of every datum is an array beside them.
    """
    numbers, wavelength, rows = data_by_wavelength(measurement)
    weighting = measurement.weighting
    sizes = [rms(weighting.sigma[row]) for row in rows]
    nm = wavelength.to_value(u.nm)
    # that of a robust fit follows from its residuals
    given = weighting.choice == GIVEN and weighting.follows is None
    uneven = given and any(np.ptp(weighting.sigma[row]) > 0 for row in rows if row.size)
    return [
        {
            "dataset": part.observations.name,
            "wavelength_nm": [float(w) for w in nm[numbers == i]],
            "sigma_percent": [100 * sizes[j] for j in np.flatnonzero(numbers == i)],
        }
        | ({"sigma_of_data": weighting.sigma[measurement.segments[i]]} if uneven else {})
        for i, part in enumerate(measurement.datasets)
    ]


# ---- from residuals ---------------------------------------------------------------------


def _by_wavelength(measurement, leverage):
    r"""Return one level per dataset and wavelength, not below the floor.

    :math:`\sigma^2 = \sum r_i^2 / \sum (1 - h_i)` with the leverages h (Hoaglin & Welsch 1978, The
    American Statistician 32, 17).
    """
    squares, spare = measurement.residuals() ** 2, 1 - leverage
    numbers, wavelength, rows = data_by_wavelength(measurement)
    levels = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        freedom, total = spare[row].sum(), squares[row].sum()
        if row.size and (freedom < 1 or not total > 0):
            name = measurement.datasets[numbers[i]].observations.name
            raise FitError(
                f"{name}, {wavelength[i].to_value(u.nm):.1f} nm: {row.size} data leave "
                f"{max(freedom, 0):.1f} degrees of freedom and an rms residual of "
                f"{np.sqrt(total / row.size):.3g}, which tell no noise; give noise= or other "
                "weights"
            )
        levels[i] = np.sqrt(total / freedom) if row.size else np.nan
    for number in np.unique(numbers[np.isfinite(levels)]):
        own = numbers == number
        levels[own] = np.fmax(levels[own], _FLOOR * np.nanmedian(levels[own]))
    return np.repeat(levels, [row.size for row in rows])


# ---- from the user ------------------------------------------------------------------------


def given_noise(measurement, noise):
    """Return the noise of every datum from one value, one per wavelength or one per datum."""
    noise = to_unit(noise, None, "noise")
    if not np.all(np.isfinite(noise) & (noise > 0)):
        raise ParameterError(f"noise must be positive and finite; the least is {np.min(noise)}")
    if noise.shape == measurement.wavelength.shape:
        return noise[measurement.bins]
    if noise.shape not in ((), (measurement.n_data,)):
        raise ParameterError(
            f"noise of shape {noise.shape}; allowed are one value, {len(measurement.wavelength)} "
            f"(one per wavelength) or {measurement.n_data} (one per datum)"
        )
    return np.broadcast_to(noise, measurement.n_data).astype(float)
