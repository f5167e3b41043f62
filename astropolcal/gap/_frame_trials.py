# Licensed under a 3-clause BSD style license - see LICENSE
"""What may be wrong with one frame, tried at any size: angles, an exchange, a beam's factor."""

from dataclasses import dataclass

import numpy as np

from astropolcal.gap._frame_looks import angle_stages
from astropolcal.propagation import Propagator

__all__ = ["Frame", "Trial"]

# the angles that are tried, and how often the best of them are refined (radian)
_STEP = np.deg2rad(1.0)
_ZOOMS, _POINTS = 6, 13
_MINIMA = 4
# minima that differ by less are alike: the one nearest to the table counts
_ALIKE = 9.0
# what the size of an angle's error or of a factor may be: log-uniform between these
_ANGLES = np.deg2rad([0.005, 90.0])
_FACTORS = np.array([1e-4, 2.0])
_NEWTON = 8
# differences that are wrong for no known reason, wavelength by wavelength
_ANY = 0.3
_TINY = 1e-6
_BEAMS = {1: "right", -1: "left"}


@dataclass
class Trial:
    """
    One thing that may be wrong with a frame.

    Parameters
    ----------
    what : str
        Kind of the fault.
    chi2 : float
        What it leaves of the frame.
    cost : float
        Minus twice the logarithm of the share of its prior that the data leave.
    value, error : float
        Angle in radian, or factor of the beam; NaN where there is none.
    partner : int, optional
        Index of the other frame of an exchange.
    beam : str
        The beam that was off.

    Examples
    --------
    >>> from astropolcal.gap._frame_trials import Trial
    >>> Trial("hwp angle", 12.0, 8.0).total
    20.0
    """

    what: str
    chi2: float
    cost: float
    value: float = np.nan
    error: float = np.nan
    partner: int | None = None
    beam: str = ""

    @property
    def total(self):
        """Minus twice the logarithm of the evidence."""
        return self.chi2 + self.cost


class Frame:
    """
    One frame's differences beside what all others say of them.

    Parameters
    ----------
    look : Look
        At the fit without the frame, or nearly so.
    i, f : int
        Dataset and frame.
    scatter : float
        Mean square of other frames in units of the noise.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.gap._frame_looks import Look
    >>> from astropolcal.gap._frame_trials import Frame
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> frame = Frame(Look(model, model.fit.coefficients, [np.zeros(24, bool)]), 0, 3)
    >>> bool(frame.as_told().total < frame.angle("hwp").total)
    True
    """

    def __init__(self, look, i, f, scatter=1.0):
        self.look, self.i, self.f, self.scatter = look, i, f, scatter
        self.dataset, self.channel = look.problem.datasets[i], look.problem.channels[i]
        self.valid = self.channel.valid[:, f]
        self.sigma = self.channel.sigma[0, :, f] * np.sqrt(scatter)
        self.weight = np.where(self.valid, 1 / self.sigma, 0.0)
        self.observed = self.channel.observed[0, :, f]
        missed, self._sight, weight = look.of_frame(i, f)
        plain = self.predicted(self._positions([f]))[:, 0]
        # what others say beyond the optics, of background and the like
        missed = np.divide(missed, weight, out=np.zeros(len(weight)), where=weight > 0)
        self._offset = np.where(self.valid, missed - (self.observed - plain), 0.0)
        self._plain, self._root = plain, _root(self._sight)
        missed, left, whiten = look.sums_of_frame(i, f)
        root = _root(left) / np.sqrt(scatter)
        self._sums = (
            np.linalg.pinv(_root(left), rcond=_TINY) @ missed / np.sqrt(scatter),
            whiten,
            root,
        )

    # ---- predictions ------------------------------------------------------------------------

    def _positions(self, frames):
        """Return the positions of all stages in some frames."""
        given = self.dataset._given
        return {stage: np.atleast_1d(p)[..., frames] for stage, p in given.items()}

    def predicted(self, positions):
        """Return the differences at some positions of the stages, (W, n)."""
        chain = self.look.chains[self.i]
        wavelength = self.dataset.propagator.wavelength
        right, left = Propagator(chain, wavelength, positions).fluxes(
            self.dataset.current_values(self.look.vector)
        )
        return (right - left) / (right + left)

    def chi2(self, difference):
        """Return the sum of squares that predicted differences (W, n) leave, (n,)."""
        left = self.observed[:, None] - difference + self._offset[:, None]
        left = left * self.weight[:, None]
        return np.einsum("wn,wn->n", left, self._sight @ left)

    # ---- trials -----------------------------------------------------------------------------

    def as_told(self):
        """Return the trial in which nothing is wrong."""
        return Trial("none", float(self.chi2(self.predicted(self._positions([self.f])))[0]), 0.0)

    def trials(self):
        """Return all trials that need no other frame."""
        stages = [self.angle(stage) for stage in angle_stages(self.look.chains[self.i])]
        degrees = range(self.look.law(self.i).shape[1])
        beams = [self.beam(degree, side) for degree in degrees for side in _BEAMS]
        return [*stages, *beams, self.anything()]

    def angle(self, stage):
        """Return the trial in which a stage stood elsewhere."""
        told = float(self._positions([self.f])[stage][0])
        grid = np.arange(-np.pi / 2, np.pi / 2, _STEP)
        chi2 = self._turned(stage, grid)
        lowest = np.flatnonzero((chi2 <= np.roll(chi2, 1)) & (chi2 <= np.roll(chi2, -1)))
        lowest = lowest[np.argsort(chi2[lowest], kind="stable")][:_MINIMA]
        found = [self._refined(stage, grid[k]) for k in lowest]
        least = min(value for _, value in found)
        offset, chi2 = min(
            (one for one in found if one[1] < least + _ALIKE), key=lambda one: abs(one[0])
        )
        h = np.deg2rad(0.02)
        low, middle, high = self._turned(stage, offset + np.array([-h, 0.0, h]))
        curvature = (low - 2 * middle + high) / h**2 / 2
        error = 1 / np.sqrt(max(curvature, 1.0))
        cost = _occam(offset, error, _ANGLES)
        return Trial(f"{stage} angle", chi2, cost, told + offset, error)

    def _turned(self, stage, offsets):
        positions = self._positions(np.full(len(offsets), self.f))
        positions[stage] = positions[stage] + offsets
        return self.chi2(self.predicted(positions))

    def _refined(self, stage, offset):
        half = _STEP
        for _ in range(_ZOOMS):
            grid = offset + np.linspace(-half, half, _POINTS)
            chi2 = self._turned(stage, grid)
            best = int(np.argmin(chi2))
            offset, half = grid[best], 2 * half / (_POINTS - 1)
        return float(offset), float(chi2[best])

    def beam(self, degree, side):
        """
        Return the trial in which the right (1) or left (-1) beam was off by a factor.

        The logarithm of the factor is a law in wavelength. The sums take part, too: they tell
        which of the beams it was where the lamp is steady.
        """
        law = self.look.law(self.i)[:, : degree + 1]
        size = np.zeros(law.shape[1])
        for _ in range(_NEWTON):
            left, slopes = self._of_beam(law, size, side)
            inner = slopes.T @ slopes
            step = np.linalg.lstsq(inner, slopes.T @ left, rcond=1e-12)[0]
            size = size + np.clip(step, -1.0, 1.0)
        before, after = (self._of_beam(law, x, side)[0] for x in (0 * size, size))
        chi2 = self.as_told().chi2 - float(before @ before - after @ after)
        errors = np.sqrt(np.diag(np.linalg.pinv(inner, hermitian=True)))
        # the law is about its mean: other coefficients are of its size or below
        biggest = max(np.abs(size).max(), errors[0])
        cost = _occam(size[0], errors[0], _FACTORS)
        cost += sum(_share(error, 2 * biggest) for error in errors[1:])
        mean = float(np.exp(np.mean((law @ size)[self.valid])))
        return Trial("one beam", chi2, cost, mean, float(errors[0] * mean), beam=_BEAMS[side])

    def _of_beam(self, law, size, side):
        """Return what a law leaves of differences and sums, and its derivatives; unit noise."""
        factor = law @ size
        shifted = _shifted(self._plain, side * factor)
        left = (self.observed - shifted + self._offset) * self.weight
        slopes = side * law * ((1 - shifted**2) / 2 * self.weight)[:, None]
        share = (1 + side * self._plain) / 2
        brighter = np.log1p(share * np.expm1(factor))
        missed, whiten, root = self._sums
        brighter, slope = (
            root @ whiten @ x
            for x in (brighter, law * (share * np.exp(factor - brighter))[:, None])
        )
        return (
            np.concatenate([self._root @ left, missed - brighter]),
            np.concatenate([self._root @ slopes, slope]),
        )

    def anything(self):
        """Return the trial in which every wavelength of the frame is off by its own amount."""
        width = 1 + (_ANY * self.weight[self.valid]) ** 2
        return Trial("unknown", 0.0, float(np.log(width).sum()))

    def with_positions_of(self, frames):
        """Return what is left of the frame if its stages stood as in others, (n,)."""
        return self.chi2(self.predicted(self._positions(frames)))


def _root(matrix):
    """Return the symmetric root of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _shifted(difference, log_ratio):
    """Return normalized differences whose beams' ratio is changed."""
    grown = np.tanh(log_ratio / 2)
    return (difference + grown) / (1 + difference * grown)


def _occam(size, error, between):
    """Return the cost of a size that may be anything between two, log-uniform, either sign."""
    density = 1 / (2 * np.log(between[1] / between[0]) * max(abs(size), between[0]))
    return _share(error, 1 / density)


def _share(error, width):
    """Return minus twice the logarithm of the share of a width that an error leaves."""
    return float(-2 * np.log(min(np.sqrt(2 * np.pi) * error / width, 1.0)))
