# Licensed under a 3-clause BSD style license - see LICENSE
"""
What is compared with the model: differences of the two beams, with derivatives.

Every observable is a small strategy object. Fluxes come as two arrays of shape
``(k, W, P)``: ``k`` frames per datum (index 0 the plus frame, index 1 the minus
frame, whose half-wave plate is 45 degrees further; of four frames see
`NormalizedTripleDifference`), ``W`` wavelengths and ``P`` data. The derivatives
are analytic, because a fit evaluates them at every step. The names X and I
follow Sec. 2.2 of the CHARIS recalibration paper.
"""

from abc import ABC, abstractmethod

import numpy as np

from astropolcal.exceptions import ObservationError
from astropolcal.words import did_you_mean

__all__ = ["OBSERVABLES", "Observable"]


class Observable(ABC):
    """
    A quantity formed from the beam fluxes of a frame, a pair of frames or two pairs.

    A subclass gives ``name``, ``description``, ``frames_per_datum``, `evaluate`
    and `derivative`; errors follow from the derivative.

    Attributes
    ----------
    name : str
        The name by which `OBSERVABLES` and ``observable=`` find it.
    description : str
        One line for reports.
    frames_per_datum : int
        1 for a quantity of single frames, 2 for one of pairs, 4 for one of pairs in both
        states of a modulator.

    Examples
    --------
    A new observable needs its formula and the derivative, nothing else:

    >>> import numpy as np
    >>> from astropolcal.observations import Observable
    >>> class RightBeam(Observable):
    ...     name = "right_beam"
    ...     description = "flux of the right beam"
    ...     frames_per_datum = 1
    ...     def evaluate(self, right, left):
    ...         return right[0]
    ...     def derivative(self, right, left):
    ...         return np.ones_like(right), np.zeros_like(left)
    >>> flux = np.full((1, 1, 1), 100.0)
    >>> float(RightBeam().variance(flux, flux, var_right=flux, var_left=flux)[0, 0])
    100.0
    """

    name = None
    description = None
    frames_per_datum = 2

    @abstractmethod
    def evaluate(self, right, left):
        """
        Return the observable.

        Parameters
        ----------
        right, left : `~numpy.ndarray`
            Beam fluxes, shape (k, W, P).

        Returns
        -------
        `~numpy.ndarray`
            Shape (W, P), dimensionless.
        """

    @abstractmethod
    def derivative(self, right, left):
        """
        Return the derivative with respect to each flux.

        Parameters
        ----------
        right, left : `~numpy.ndarray`
            Beam fluxes, shape (k, W, P).

        Returns
        -------
        d_right, d_left : `~numpy.ndarray`
            Each (k, W, P), per unit of flux. They may share memory: read only.
        """

    def variance(self, right, left, var_right, var_left, cov=0.0):
        """
        Return the variance to first order in the errors of the fluxes.

        Parameters
        ----------
        right, left : `~numpy.ndarray`
            Beam fluxes, shape (k, W, P).
        var_right, var_left : `~numpy.ndarray`
            Their variances, same shape; NaN gives NaN.
        cov : `~numpy.ndarray` or float
            Covariance of the two beams of a frame.

        Returns
        -------
        `~numpy.ndarray`
            Shape (W, P).

        Examples
        --------
        >>> import numpy as np
        >>> from astropolcal.observations import OBSERVABLES
        >>> flux = np.full((2, 1, 1), 100.0)
        >>> x = OBSERVABLES["normalized_double_difference"]
        >>> round(float(x.variance(flux, flux, flux, flux)[0, 0]), 6)
        0.0025
        """
        d_right, d_left = self.derivative(right, left)
        # g^T C g for each frame; frames are independent of each other
        terms = d_right**2 * var_right + d_left**2 * var_left + 2.0 * cov * d_right * d_left
        return terms.sum(axis=0)

    def of(self, right, variance, usable, groups):
        """
        Return the observable of a dataset; one whose data depend on other data keeps these.

        ``right``, its ``variance`` and what is ``usable`` have shape (W, P), ``groups`` of frames
        that share the brightness of the source (P,).
        """
        return self

    def gathered(self, slopes, right, left):
        """Return derivatives of the data, (n, W, P), from those of the frames of each datum."""
        return slopes

    def frame_covariance(self, right, left, var_right, var_left, cov, frames):
        """
        Return the covariance between data, which is not zero where they share a frame.

        Parameters
        ----------
        right, left, var_right, var_left, cov : `~numpy.ndarray`
            As in `variance`.
        frames : `~numpy.ndarray` of int
            Frame indices of every datum, shape (P, k).

        Returns
        -------
        `~numpy.ndarray`
            Shape (W, P, P); its diagonal is `variance`.

        Raises
        ------
        ObservationError
            If ``frames`` has another shape.

        Examples
        --------
        Two data that share their minus frame have half of their noise in common:

        >>> import numpy as np
        >>> from astropolcal.observations import OBSERVABLES
        >>> flux = np.full((2, 1, 2), 100.0)
        >>> x = OBSERVABLES["normalized_double_difference"]
        >>> c = x.frame_covariance(flux, flux, flux, flux, 0.0, np.array([[0, 1], [2, 1]]))
        >>> round(float(c[0, 0, 1] / c[0, 0, 0]), 6)
        0.5
        """
        frames = np.asarray(frames)
        expected = (right.shape[2], right.shape[0])
        if frames.shape != expected:
            raise ObservationError(
                f"frames has shape {frames.shape}, allowed is (P, k) = {expected}"
            )
        d_right, d_left = self.derivative(right, left)
        # the flux covariance matrix of a frame times the derivative vector
        to_right = d_right * var_right + d_left * cov
        to_left = d_left * var_left + d_right * cov
        # (W, P, P)
        total = np.zeros((right.shape[1], len(frames), len(frames)))
        # datum p uses a frame as its i-th, datum q as its j-th
        for i, j in np.ndindex(len(right), len(right)):
            p, q = np.nonzero(frames[:, i, None] == frames[None, :, j])
            total[:, p, q] += to_right[i][:, p] * d_right[j][:, q]
            total[:, p, q] += to_left[i][:, p] * d_left[j][:, q]
        return total

    def __repr__(self):
        return f"<{type(self).__name__}: {self.description}>"


class _NormalizedDifference(Observable):
    """Beam differences of some frames, each with its sign, over the sum of all their fluxes."""

    signs = ()

    def _parts(self, right, left):
        each, both = right - left, right + left
        # few frames, the first with sign 1: plain sums are quicker than sums along an axis
        difference, total = each[0], both[0]
        for sign, one, sum_ in zip(self.signs[1:], each[1:], both[1:], strict=True):
            difference = difference + one if sign > 0 else difference - one
            total = total + sum_
        return difference, total

    def evaluate(self, right, left):
        """Return x, shape (W, P); see `Observable.evaluate`."""
        difference, total = self._parts(right, left)
        return difference / total

    def derivative(self, right, left):
        """Return dx/dR and dx/dL; see `Observable.derivative`."""
        difference, total = self._parts(right, left)
        inverse = 1.0 / total
        x_inverse = difference * (inverse * inverse)
        up, down = inverse - x_inverse, -inverse - x_inverse
        d_right = [up if sign > 0 else down for sign in self.signs]
        return np.stack(d_right), np.stack([down if one is up else up for one in d_right])


class NormalizedDoubleDifference(_NormalizedDifference):
    """
    Normalized double difference, x = (X+ - X-) / (I+ + I-), of the CHARIS recalibration paper.

    It removes what the optics downstream of the half-wave plate polarize, as long as the flux does
    not change between the two frames.
    """

    name = "normalized_double_difference"
    description = "normalized double difference, (X+ - X-) / (I+ + I-)"
    signs = (1.0, -1.0)


class PerFrameDoubleDifference(Observable):
    """
    Half the difference of the frames' normalized differences, x = (x+ - x-) / 2.

    Each frame is normalized by its own sum, so a change of flux between the frames drops out.
    """

    name = "per_frame_double_difference"
    description = "difference of the frames' normalized differences, (x+ - x-) / 2"

    def evaluate(self, right, left):
        """Return x, shape (W, P); see `Observable.evaluate`."""
        normalized = (right - left) / (right + left)
        return 0.5 * (normalized[0] - normalized[1])

    def derivative(self, right, left):
        """Return dx/dR and dx/dL; see `Observable.derivative`."""
        total = right + left
        scale = 1.0 / (total * total)
        # d x/dR = 2 L / I^2 for one frame; half of it, with the sign of the frame
        scale[1] *= -1.0
        return left * scale, -right * scale


class RatioMethod(Observable):
    """
    The ratio method, x = (rho - 1) / (rho + 1), rho^2 = (R+ / L+) / (R- / L-).

    The gains of the beams and the flux of each frame drop out exactly, at any degree of
    polarization (Bagnulo et al. 2009, PASP 121, 993, doi:10.1086/605654). The derivative diverges
    at zero flux.
    """

    name = "ratio"
    description = "ratio method, (rho - 1) / (rho + 1) with rho^2 = (R+/L+) / (R-/L-)"

    def evaluate(self, right, left):
        """Return x, shape (W, P); see `Observable.evaluate`."""
        # rho = above / below, without a division by a faint beam
        above = np.sqrt(right[0] * left[1])
        below = np.sqrt(right[1] * left[0])
        return (above - below) / (above + below)

    def derivative(self, right, left):
        """Return dx/dR and dx/dL; see `Observable.derivative`."""
        x = self.evaluate(right, left)
        # dx/dln(rho) = (1 - x^2) / 2, and ln(rho) holds each ln(flux) with weight 1/2
        slope = 0.25 * (1.0 - x * x)
        signed = np.stack([slope, -slope])
        return signed / right, -signed / left


class NormalizedSingleDifference(_NormalizedDifference):
    """
    Normalized single difference of every frame, x = (R - L) / (R + L).

    It keeps what a double difference cancels, so the model must describe it.
    """

    name = "normalized_single_difference"
    description = "normalized single difference of each frame, (R - L) / (R + L)"
    frames_per_datum = 1
    signs = (1.0,)


class NormalizedTripleDifference(_NormalizedDifference):
    """
    Normalized triple difference of the frames A+, B+, A-, B-.

    Both states of a modulator, at half-wave plates 45 deg apart; x = ((XA+ - XB+) - (XA- - XB-)) /
    (sum of all I).

    Norris et al. 2015, MNRAS 447, 2894 (doi:10.1093/mnras/stu2529): beam differences drop out by
    the modulator, polarization downstream of the plate drops out by the plate, at constant flux.
    """

    name = "normalized_triple_difference"
    description = "normalized triple difference, (XA+ - XB+ - XA- + XB-) / (sum of all I)"
    frames_per_datum = 4
    signs = (1.0, -1.0, -1.0, 1.0)


class Intensity(Observable):
    r"""
    Flux of a single beam over the mean of its group, whose brightness is not known.

    The frames of a group share the brightness of the source, one number for each wavelength. From
    the second on, the brightest first, each is compared with what the model and the frames before
    it lead to expect: the recursive residuals of the linear problem in the brightness (Brown,
    Durbin & Evans 1975, J. R. Stat. Soc. B 37, 149, doi:10.1111/j.2517-6161.1975.tb01532.x). They
    are independent, have the noise of their frames, and their squares add up to those that the
    best brightness leaves, so that there are as many data as frames less one for each group.
    """

    name = "intensity"
    description = "flux over the mean of its group of frames, of free brightness"
    frames_per_datum = 1

    def evaluate(self, right, left):
        """Return the flux over its mean, shape (W, P); see `Observable.evaluate`."""
        return right[0] / right[0].mean(axis=-1, keepdims=True)

    def derivative(self, right, left):
        """Return what each frame contributes; `gathered` adds those of its group."""
        return np.ones_like(right), np.zeros_like(left)

    def of(self, right, variance, usable, groups):
        """Return the observable of a dataset; see `Observable.of`."""
        return _GroupedIntensity(right, variance, usable, groups)


class _GroupedIntensity(Intensity):
    """The observable of one dataset: the frames of each group in order of their flux."""

    def __init__(self, flux, variance, usable, groups):
        flux = np.where(usable, flux, 0.0)
        known = usable & np.isfinite(variance) & (variance > 0)
        # of a table without errors all frames weigh the same
        weight = np.where(known, 1 / np.where(known, variance, 1.0), 0.0 if known.any() else 1.0)
        self._groups = np.unique(groups, return_inverse=True)[1]
        count = np.maximum(self._totals(usable.astype(float)), 1.0)
        self._mean = self._totals(flux) / count
        self._order = np.stack([np.lexsort((-row, self._groups)) for row in flux])
        # place at which the group of each place begins, the same at all wavelengths
        ordered = self._groups[self._order[0]]
        self._first = np.searchsorted(ordered, ordered)
        self._flux, self._weight, self._usable = flux, weight * usable, usable
        self._sorted = self._in_order(flux)
        self._pull = self._in_order(self._weight * flux)
        seen = self._before(self._pull * self._sorted)
        told = seen > 0
        self._seen = np.where(told, seen, 1.0)
        size = 1 / np.sqrt(1 + self._pull * self._sorted / self._seen)
        self._size = np.where(told, size, 0.0)
        #: Where a frame gives a datum, shape (W, P): not the first of its group.
        self.valid = usable & (self._back(self._size) > 0)

    def evaluate(self, right, left):
        """Return the data of fluxes, (W, P), in units of the mean flux of each group."""
        # what is masked may be NaN in the table
        flux = np.where(self._usable, right[0], 0.0)
        return self._over_mean(self._flux + self._left(self._scaled(flux)))

    def gathered(self, slopes, right, left):
        """Return the derivatives of the data; the brightness follows the model."""
        pull = self._weight * self._flux
        total = self._totals(pull * right[0])
        turn = self._totals(pull * slopes) / np.where(total > 0, total, np.inf)
        change = self._left(self._factor(right[0]) * slopes)
        return self._over_mean(change - self._left(self._scaled(right[0])) * turn)

    def variance(self, right, left, var_right, var_left, cov=0.0):
        """Return the variance of the data: that of the flux, as they are independent."""
        return self._over_mean(self._over_mean(var_right[0]))

    def _over_mean(self, array):
        return array / np.where(self._mean > 0, self._mean, 1.0)

    def _factor(self, flux):
        """Return the brightness that makes fluxes of the model those of the table."""
        pull = self._weight * self._flux
        total = self._totals(pull * flux)
        return self._totals(pull * self._flux) / np.where(total > 0, total, np.inf)

    def _scaled(self, flux):
        return self._factor(flux) * flux

    def _totals(self, array):
        """Return the sums over the group of each frame, (..., W, P)."""
        member = np.eye(self._groups.max() + 1)[self._groups]
        return (array @ member) @ member.T

    def _in_order(self, array):
        order = np.broadcast_to(self._order, array.shape)
        return np.take_along_axis(array, order, axis=-1)

    def _back(self, array):
        out = np.empty(array.shape)
        np.put_along_axis(out, np.broadcast_to(self._order, array.shape), array, axis=-1)
        return out

    def _before(self, array):
        """Return the sums over the frames of the group that come before each, in order."""
        total = np.cumsum(array, axis=-1) - array
        return total - total[..., self._first]

    def _left(self, array):
        """Return recursive residuals of an array (..., W, P), zero for that of the table."""
        array = self._in_order(array)
        expected = self._sorted * self._before(self._pull * array) / self._seen
        return self._back(self._size * (array - expected))


OBSERVABLES = {
    observable.name: observable
    for observable in (
        NormalizedDoubleDifference(),
        PerFrameDoubleDifference(),
        RatioMethod(),
        NormalizedSingleDifference(),
        NormalizedTripleDifference(),
    )
}
"""Every registered `Observable` of two beams, by name; the first one is the default."""

_INTENSITY = Intensity()


def default_observable(observations):
    """Return the name of the observable for datasets: what their design allows."""
    if all(one.single_beam for one in observations):
        return Intensity.name
    if all("hwp" in one.frames.colnames for one in observations):
        return NormalizedDoubleDifference.name
    return NormalizedSingleDifference.name


def get_observable(name):
    """Return the observable of that name; case, blanks, hyphens and underscores do not matter."""
    if isinstance(name, Observable):
        return name
    # "Double-Difference" and "double difference" are one name
    key = "_".join(str(name).lower().replace("-", " ").replace("_", " ").split())
    known = OBSERVABLES | {_INTENSITY.name: _INTENSITY}
    if key in known:
        return known[key]
    hint = did_you_mean(key, known)
    raise ObservationError(f"unknown observable {name!r}; allowed are {', '.join(known)}{hint}")
