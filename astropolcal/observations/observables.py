# Licensed under a 3-clause BSD style license - see LICENSE
"""
What is compared with the model: differences of the two beams, with derivatives.

Every observable is a small strategy object. Fluxes come as two arrays of shape ``(k, W, P)``: ``k``
frames per datum (index 0 the plus frame, index 1 the minus frame, whose half-wave plate is 45
degrees further; of four frames see `NormalizedTripleDifference`), ``W`` wavelengths and ``P`` data.
The derivatives are analytic, because a fit evaluates them at every step. The names X and I follow
Sec. 2.2 of the CHARIS recalibration paper.

The frames of a pair have half-wave plates 45 degrees apart, or modulators that differ, or both.
They are found from angles and states, never from the order of the rows, see ``pair_frames``.
"""

from abc import ABC, abstractmethod

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ObservationError, warn
from astropolcal.observations.pointings import angle_or_zero, axes_apart, clock, frame_names
from astropolcal.observations.reading import numeric_column
from astropolcal.units import angle_to_rad
from astropolcal.words import check_choice, counted, listed

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
        signs = np.reshape(self.signs, (-1, 1, 1))
        return signs, (signs * (right - left)).sum(axis=0), (right + left).sum(axis=0)

    def evaluate(self, right, left):
        """Return x, shape (W, P); see `Observable.evaluate`."""
        _, difference, total = self._parts(right, left)
        return difference / total

    def derivative(self, right, left):
        """Return dx/dR and dx/dL; see `Observable.derivative`."""
        signs, difference, total = self._parts(right, left)
        x = difference / total
        return (signs - x) / total, (-signs - x) / total


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
    """The ratio method, x = (rho - 1) / (rho + 1), rho^2 = (R+ / L+) / (R- / L-).

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
    """Normalized triple difference of the frames A+, B+, A-, B-.

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
        factor = self._factor(flux)
        # no brightness makes light of a model without any
        return self._over_mean(np.where(factor > 0, self._flux, 0.0) + self._left(factor * flux))

    def gathered(self, slopes, right, left):
        """Return the derivatives of the data; the brightness follows the model."""
        pull = self._weight * self._flux
        total = self._totals(pull * right[0])
        turn = self._totals(pull * slopes) / np.where(total > 0, total, np.inf)
        factor = self._factor(right[0])
        change = self._left(factor * slopes)
        return self._over_mean(change - self._left(factor * right[0]) * turn)

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
    if all("hwp" in one.frame_columns for one in observations):
        return NormalizedDoubleDifference.name
    return NormalizedSingleDifference.name


def get_observable(name):
    """Return the observable of that name; case, blanks, hyphens and underscores do not matter."""
    if isinstance(name, Observable):
        return name
    # "Double-Difference" and "double difference" are one name
    key = "_".join(str(name).lower().replace("-", " ").replace("_", " ").split())
    known = OBSERVABLES | {_INTENSITY.name: _INTENSITY}
    if key not in known:
        check_choice("observable", name, known, ObservationError)
    return known[key]


# ---- pairing -------------------------------------------------------------------------------


#: By what frames may be paired: the half-wave plate, or the state of a modulator.
PAIRINGS = ("hwp", "flc_state")

# a half-wave plate at 45 deg exchanges +Q and -Q, and at 180 deg is the same again
_QUARTER, _HALF = np.deg2rad([45.0, 90.0])
# relative; what a shutter or a header may differ by
_SAME_EXPOSURE = 0.01
# a message of a thousand numbers helps nobody
_MAX_NAMED = 10
# tables up to this length are searched as a whole, longer ones within so many frames first
_SMALL, _WINDOW = 1000, 64


def pair_frames(
    hwp,
    derotator=None,
    flc_state=None,
    time=None,
    exposure=None,
    *,
    tolerance=0.3 * u.deg,
    derotator_tolerance=0.5 * u.deg,
    share=False,
    lonely=False,
    labels=None,
    rows=None,
    name="table",
):
    """Pair the frames whose half-wave-plate angles differ by 45 deg; return indices (P, 2).

    All arguments are one per frame, angles as quantities; frames of a pair agree in derotator and
    state. The plus frame, whose angle modulo 90 deg lies in [0, 45), comes first; that of the same
    exposure and then the nearest in time (else in the table) wins. ``share`` lets a frame left over
    use one that is used already; ``labels``, ``rows`` and ``name`` are for messages. Frames left
    over are a warning, an angle without any partner in the table an error unless ``lonely``.
    """
    hwp = np.atleast_1d(angle_to_rad(hwp, "hwp"))
    n_frames, tolerance = len(hwp), float(angle_to_rad(tolerance, "tolerance"))
    derotator_tolerance = float(angle_to_rad(derotator_tolerance, "derotator_tolerance"))
    labels = range(n_frames) if labels is None else labels
    there = np.sort(np.mod(hwp, _HALF))
    # the neighbours across 0 and 90 deg
    there = np.concatenate([there - _HALF, there, there + _HALF])
    wanted = np.mod(hwp + _QUARTER, _HALF)
    place = np.searchsorted(there, wanted)
    alone = np.minimum(wanted - there[place - 1], there[place] - wanted) > tolerance
    if alone.any() and not lonely:
        frame = int(np.argmax(alone))
        raise ObservationError(
            f"{name}, {_where(frame, rows)}: hwp = {np.rad2deg(hwp[frame]):g} deg has no partner; "
            "a frame with the half-wave plate 45 deg from it (modulo 180 deg) is needed"
        )
    steps = np.arange(n_frames) if time is None else np.asarray(time, dtype=float)
    setting = {"hwp": hwp, "steps": (steps, exposure), "tolerance": tolerance}
    setting["flc_state"] = flc_state
    if derotator is not None:
        setting["derotator"] = np.atleast_1d(angle_to_rad(derotator, "derotator"))
        setting["derotator_tolerance"] = derotator_tolerance
    # in long tables partners are sought among the neighbours in time first, and farther away for
    # the frames that found none, so that the work grows as the number of frames
    left, width, chosen = np.argsort(steps, kind="stable"), _WINDOW, []
    while left.size:
        everything = share or left.size <= _SMALL or width >= left.size
        reach = left.size if everything else width
        pairs, used = _choose(*_candidates(left, reach, **setting), n_frames, share)
        chosen += pairs
        left = left[~used[left]]
        if everything:
            break
        width *= 4
    if left.size:
        shown = [f"{labels[i]} (hwp {np.rad2deg(hwp[i]):g} deg)" for i in sorted(left.tolist())]
        warn(
            f"{name}: {len(left)} of {n_frames} frames left out, their partner 45 deg of half-wave "
            f"plate away is missing or used: frame {listed(shown, most=_MAX_NAMED)}",
            stacklevel=3,
        )
    return np.array(sorted(chosen), dtype=np.intp).reshape(-1, 2)


def _where(frame, rows):
    return f"frame index {frame}" if rows is None else f"row {rows[frame]}"


def _candidates(
    frames, width, *, hwp, steps, tolerance, flc_state, derotator=None, derotator_tolerance=0.0
):
    """Return plus and minus frame of all possible pairs, the best first.

    Only frames at most ``width`` places apart in ``frames`` count.
    """
    ahead = np.arange(1, min(width, frames.size - 1) + 1)
    place = np.arange(frames.size)[:, None] + ahead
    here, there = np.nonzero(place < frames.size)
    first, second = frames[here], frames[place[here, there]]
    # shifted, so that an angle slightly below 0 counts as 0 and not as 90 deg
    phase = np.mod(hwp + tolerance, _HALF)
    # 45 and 135 degrees are alike for a pair: both are 45 from a multiple of 90
    good = np.abs(np.mod(hwp[second] - hwp[first], _HALF) - _QUARTER) <= tolerance
    good &= phase[first] != phase[second]
    if flc_state is not None:
        good &= np.asarray(flc_state)[first] == np.asarray(flc_state)[second]
    first, second = first[good], second[good]
    drift = np.zeros(first.size, dtype=bool)
    if derotator is not None:
        distance = axes_apart(derotator[first], derotator[second])
        close = distance <= derotator_tolerance
        first, second = first[close], second[close]
        # a derotator that drifts pairs neighbours; one that is static is better
        drift = distance[close] > 0.5 * derotator_tolerance
    plus, minus = np.where(phase[first] < phase[second], (first, second), (second, first))
    backwards = axes_apart(hwp[minus], hwp[plus] + _QUARTER) > tolerance
    order = np.lexsort((*_nearness(plus, minus, *steps), drift, backwards))
    return plus[order], minus[order]


def _nearness(first, second, steps, exposure):
    """Return keys to sort by: of one exposure, nearest in time, in the table, the earliest."""
    # the last key counts most
    apart = np.abs(steps[first] - steps[second])
    uneven = np.zeros(len(first)) if exposure is None else _uneven(exposure[[first, second]])
    return np.minimum(first, second), np.abs(first - second), apart, uneven


def _uneven(each):
    """Return whether exposures differ along the first axis; what is not known does not."""
    return np.ptp(each, axis=0) > _SAME_EXPOSURE * np.abs(each).max(axis=0)


def pair_states(
    state,
    hwp,
    derotator,
    time=None,
    exposure=None,
    *,
    tolerance=0.3 * u.deg,
    derotator_tolerance=0.5 * u.deg,
    share=False,
    rows=None,
    name="table",
):
    """
    Pair frames of both states (0, 1) of a modulator at the same angles, modulo 180 deg.

    Returns indices (P, 2), state 0 first; the nearest in time wins. Arguments as for `pair_frames`.
    A frame without any partner is an error, one whose partner is used a warning.
    """
    state = np.asarray(state)
    angles = [np.atleast_1d(angle_to_rad(x, "angle")) for x in (hwp, derotator)]
    limits = [float(angle_to_rad(x, "tolerance")) for x in (tolerance, derotator_tolerance)]
    steps = np.arange(len(state)) if time is None else np.asarray(time, dtype=float)
    first, second = np.flatnonzero(state == 0), np.flatnonzero(state == 1)
    alike = np.ones((first.size, second.size), dtype=bool)
    for angle, limit in zip(angles, limits, strict=True):
        # (frames in state 0, frames in state 1)
        alike &= axes_apart(angle[first][:, None], angle[second]) <= limit
    # of no partner at all, not only of none that is free: that is a table with a hole
    lonely = [*first[~alike.any(axis=1)], *second[~alike.any(axis=0)]]
    if lonely:
        frame = min(lonely)
        own, other = "AB" if state[frame] == 0 else "BA"
        hwp, derotator = (np.rad2deg(angle[frame]) for angle in angles)
        raise ObservationError(
            f"{name}, {_where(frame, rows)}: flc_state {own} at hwp = {hwp:g} deg and derotator = "
            f"{derotator:g} deg has no partner; a frame in state {other} at these angles is needed"
        )
    i, j = (frames[k] for frames, k in zip((first, second), np.nonzero(alike), strict=True))
    order = np.lexsort(_nearness(i, j, steps, exposure))
    chosen, used = _choose(i[order], j[order], len(state), share)
    if not used.all():
        warn(
            f"{name}: {np.sum(~used)} of {len(state)} frames left out, their partner in the other "
            "state of the modulator is used"
        )
    return np.array(sorted(chosen), dtype=np.intp).reshape(-1, 2)


def _choose(plus, minus, n_frames, share):
    """Take candidates in order of preference, each frame once; then share if allowed."""
    used, chosen = [False] * n_frames, []
    # at first without frames that are used, then with one of the two
    for most in (0, 1) if share else (0,):
        for p, m in zip(plus.tolist(), minus.tolist(), strict=True):
            if used[p] + used[m] <= most:
                used[p] = used[m] = True
                chosen.append((p, m))
    return chosen, np.array(used)


# ---- data of a table -----------------------------------------------------------------------------


def frame_groups(observations, kind, rows, label, **limits):
    """Return the frames of each datum of a table, an array that is read only.

    By ``kind``: pairs by ``"hwp"`` or by ``"flc_state"``, (P, 2); ``"both"``, pairs in both states
    of a modulator, (Q, 4): A and B at the plus angle, then at the minus. The limits are those
    of `pair_frames`, rows and label are for messages.
    """
    frames, time = observations.frames, clock(observations.frames)
    exposure = _exposures(frames, observations.flux_unit, label)
    angles = observations.position("hwp") * u.rad, angle_or_zero(observations, "derotator") * u.rad
    labels, rows, limits = np.array(frame_names(frames)), np.asarray(rows), limits | {"name": label}
    if kind == "hwp":
        # the plate cancels what is static: both frames must be in one state
        state = np.asarray(frames["flc_state"]) if "flc_state" in frames.colnames else None
        found = pair_frames(*angles, state, time, exposure, labels=labels, rows=rows, **limits)
    else:
        # states first: they alternate within an exposure and so share its atmosphere
        state = observations.position("flc_state")
        found = pair_states(state, *angles, time, exposure, rows=rows, **limits)
    if kind == "both":
        # both frames of a pair stand at the same angles, so that one speaks for both
        first = found[:, 0]
        time = first if time is None else time[first]
        settings = {"time": time, "labels": labels[first], "rows": rows[first]} | limits
        settings["exposure"] = None if exposure is None else exposure[first]
        pairs = pair_frames(*(angle[first] for angle in angles), **settings)
        # (Q, 2, 2): plus and minus, then states; flat it is A+, B+, A-, B-
        found = found[pairs].reshape(-1, 4)
    if not len(found) and kind != "flc_state":
        raise ObservationError(
            f"{label}: none of its {counted(observations.n_frames, 'frame')} can be paired; two "
            "frames 45 deg of half-wave plate apart at the same derotator angle are needed"
        )
    warn_of_exposures(observations, found, label)
    found.flags.writeable = False
    return found


def warn_of_exposures(observations, groups, label):
    """Warn of groups of frames of unequal exposures, whose light is taken to be the same."""
    frames = observations.frames
    exposure = _exposures(frames, observations.flux_unit, label)
    uneven = [] if exposure is None else [g for g in groups if _uneven(exposure[g])]
    if uneven:
        names, each = frame_names(frames), frames["exposure_time"]
        ends = np.sort(uneven[0][[exposure[uneven[0]].argmin(), exposure[uneven[0]].argmax()]])
        shown = " and ".join(f"{names[i]} ({each[i]:g})" for i in ends)
        warn(
            f"{label}: exposures differ in {len(uneven)} of {counted(len(groups), 'group')} of "
            f"frames whose light is taken to be the same, such as {shown}",
            stacklevel=3,
        )


def _exposures(frames, unit, label):
    """Return how long frames were exposed, (F,); None where it is not known or does not matter."""
    column = frames["exposure_time"] if "exposure_time" in frames.colnames else None
    # rates, and what is calibrated or normalized, do not grow with it
    counts = any(unit.is_equivalent(kind) for kind in (u.adu, u.electron, u.ct, u.ph, u.DN))
    if not counts or getattr(getattr(column, "dtype", None), "kind", "") not in tuple("iuf"):
        return None
    return numeric_column(frames, "exposure_time", label)
