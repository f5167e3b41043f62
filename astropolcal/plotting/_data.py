# Licensed under a 3-clause BSD style license - see LICENSE
"""Observed and modelled data of one dataset, laid out for figures."""

from dataclasses import dataclass

import numpy as np

from astropolcal.chain import stages
from astropolcal.exceptions import ObservationError, ParameterError, WavelengthRangeError
from astropolcal.observations.quality import is_star
from astropolcal.optics import COORDINATES
from astropolcal.plotting._style import (
    MINUS,
    clusters,
    degrees,
    nanometres,
)
from astropolcal.propagation import Propagator

# angles (deg) that differ by less are the same setting of a stage
SAME_ANGLE = 0.5


@dataclass
class Series:
    """Data taken with the same setting of the half-wave plate."""

    label: str
    #: Which data belong to it, indices on the second axis of the grids.
    data: np.ndarray
    #: Mean position (rad) of every stage in each frame of a datum, or None if one moves.
    positions: dict | None


class DataGrid:
    """
    One dataset as arrays of shape (n_wavelengths, n_groups), NaN where masked.

    A group is the frame, or the pair of frames, that gives one datum.
    """

    def __init__(self, calibration, dataset):
        residuals = calibration.residuals  # first: says clearly if there are no data
        measurement = calibration.measurement
        dataset = check_dataset(calibration, dataset)
        self.part = measurement.datasets[dataset]
        self.chain = calibration.chains[dataset]
        if not self.part.n_data:
            raise ObservationError(f"{self.part.observations.name}: no datum is left to draw")
        self.observable = measurement.observable
        self.wavelength = nanometres(self.part.observations.wavelength)
        self.observed = self._grid(self.part.observed)
        self.residual = self._grid(residuals[measurement.segments[dataset]])
        self.sigma = self._grid(self.part.sigma)
        self.calibrated_um = measurement.wavelength
        self.is_star = is_star(self.part.observations.source) and "altitude" in self.part.positions
        self.derotator = np.rad2deg(self.position("derotator")[0])

    @property
    def abscissa(self):
        """What the data are drawn against, in degree, and how that is called."""
        if self.is_star:
            return np.rad2deg(self.position("altitude").mean(axis=0)), "altitude of the star (°)"
        return self.derotator, "derotator angle (°)"

    def _grid(self, flat):
        grid = np.full(self.part.valid.shape, np.nan)
        grid[self.part.valid] = flat
        return grid

    @property
    def quantity(self):
        """Name of the observable in words."""
        return self.observable.name.replace("_", " ")

    # ---- where the stages stand -------------------------------------------------

    def position(self, stage):
        """Return the position (rad) of a stage, shape (frames_per_datum, n_groups)."""
        # as the model has them, which need not be the table's columns
        if stage in self.part.positions:
            return self.part.positions[stage]
        return self.part.observations.position(stage)[self.part.frames.T]

    def series(self):
        """Return the data by setting of the half-wave plate, ordered by its angle."""
        # half a turn does not matter; a value just below it belongs to zero
        angle = np.mod(np.rad2deg(self._plate()) + SAME_ANGLE, 180) - SAME_ANGLE
        number, state = clusters(angle[0], SAME_ANGLE), self._state()
        settings = sorted(set(zip(number, state, strict=True)))
        return [self._one_series(angle, (number == n) & (state == now), now) for n, now in settings]

    def _state(self):
        """Return the states of a modulator in the frames of a datum, empty without one."""
        if "flc_state" not in stages(self.chain):
            return np.full(self.part.frames.shape[0], "")
        state = self.part.observations.position("flc_state")[self.part.frames] > 0.5
        names = [["AB"[one] for one in states] for states in state.astype(int)]
        return np.array([one[0] if len(set(one)) == 1 else f" {MINUS} ".join(one) for one in names])

    def _plate(self):
        """Return the angle of the plate: as commanded where it follows the sky."""
        if self.is_star:
            return self.part.observations.position("hwp")[self.part.frames.T]
        return self.position("hwp")

    def _one_series(self, angle, member, state):
        middle = np.median(angle[:, member], axis=1)
        return Series(
            label=_label([degrees(value) for value in middle], state),
            data=np.flatnonzero(member),
            positions=self._steady(member),
        )

    def _steady(self, member):
        others = {s: a[:, member] for s, a in self.part.positions.items() if s != "derotator"}
        if any(np.ptp(angle, axis=1).max() > np.deg2rad(SAME_ANGLE) for angle in others.values()):
            return None
        return {stage: angle.mean(axis=1) for stage, angle in others.items()}

    # ---- the model ---------------------------------------------------------------

    def curve(self, series, bins, derotator):
        """
        Return the model between the data, shape (n_bins, n_angles).

        The derotator turns (``derotator`` in degree); every other stage stays
        where it stands in the series.
        """
        angle = np.deg2rad(derotator)
        per_datum, n = self.part.frames.shape[1], len(angle)
        positions = {stage: np.repeat(p, n) for stage, p in series.positions.items()}
        positions["derotator"] = np.tile(angle, per_datum)
        # between the data there is neither a time nor a flux: such optics do nothing there
        others = [s for s in stages(self.chain) if s in COORDINATES and s != "flc_state"]
        positions |= {stage: np.zeros(1) for stage in others}
        if "flc_state" in stages(self.chain):
            state = self.part.observations.position("flc_state")
            positions["flc_state"] = np.repeat(state[self.part.frames[series.data[0]]], n)
        # the chain's parameters are given on the calibration's own grid of wavelengths
        propagator = Propagator(self.chain, self.calibrated_um, positions)
        right, left = (
            flux[self.part.bins[bins]].reshape(len(bins), per_datum, n).transpose(1, 0, 2)
            for flux in propagator.fluxes()
        )
        return self.observable.evaluate(right, left)

    # ---- wavelengths ---------------------------------------------------------------

    def spread_bins(self, count):
        """Return bins with data, spread over the range."""
        usable = np.flatnonzero(np.isfinite(self.observed).any(axis=1))
        usable = usable[np.argsort(self.wavelength[usable])]
        if len(usable) <= count:
            return usable
        # few wavelengths leave nothing between them to be spread over
        ends = 1 if len(usable) > 2 * count else 0
        places = np.linspace(0, len(usable) - 1, count + 2 * ends)[ends : ends + count]
        return usable[np.round(places).astype(int)]

    def nearest_bins(self, wavelengths):
        """Return the bins nearest to wavelengths, each once."""
        wanted = nanometres(wavelengths)
        low, high = self.wavelength.min(), self.wavelength.max()
        for value in wanted:
            if not 0.99 * low <= value <= 1.01 * high:
                raise WavelengthRangeError(
                    f"wavelength {value:g} nm; {self.part.observations.name} has "
                    f"{low:.1f} to {high:.1f} nm"
                )
        nearest = np.abs(self.wavelength[None, :] - wanted[:, None]).argmin(axis=1)
        return np.array(list(dict.fromkeys(nearest.tolist())))


def check_dataset(calibration, dataset):
    """Return the index of a dataset, or say which there are."""
    count = len(calibration.datasets)
    if isinstance(dataset, bool) or dataset not in range(count):
        raise ParameterError(f"dataset = {dataset!r}; allowed are whole numbers 0 to {count - 1}")
    return int(dataset)


def _label(angles, state):
    """Return the angles of the plate, and the states of a modulator."""
    if not state:
        return f" {MINUS} ".join(angles)
    # where the states make the difference the plate stands still
    plate = angles[0] if len(set(angles)) == 1 else f" {MINUS} ".join(angles)
    return f"{plate}, {state}"
