# Licensed under a 3-clause BSD style license - see LICENSE
"""One dataset of a measurement: a chain, its observations, and its Jacobian."""

import copy
from contextlib import suppress

import astropy.units as u
import numpy as np
from astropy.modeling import Model

from astropolcal import instruments
from astropolcal.chain import Train, check_states, leaves, stages, states_of
from astropolcal.exceptions import (
    ChainError,
    InstrumentError,
    ObservationError,
    WavelengthRangeError,
)
from astropolcal.observations import Observations
from astropolcal.observations.pointings import frame_names
from astropolcal.observations.reading import bins_on_grid
from astropolcal.optics import COORDINATES
from astropolcal.optics.positions import PLACES
from astropolcal.propagation import Propagator, splits
from astropolcal.units import to_unit
from astropolcal.words import check_type

__all__ = []


def as_tables(observations):
    """Return one or several tables of fluxes as a list; refuse what is of another type."""
    tables = list(observations) if isinstance(observations, (list, tuple)) else [observations]
    wanted = "tables of fluxes are needed, such as Observations.read(file) gives"
    for table in tables:
        check_type("observations", table, Observations, wanted, ObservationError)
    return tables


def check_chains(what, chains, also=""):
    """Refuse what is not a chain; ``also`` says what else is allowed in its place."""
    wanted = f"{also}chains of optics are needed, such as instruments.get(name).chain() gives"
    for one in chains:
        check_type(what, one, (Model, Train), wanted, ChainError)


def refuse_repeated(tables):
    """Refuse tables of the same content: data that count twice would make all errors too small."""
    first = {}
    for i, table in enumerate(tables):
        other = first.setdefault(table.content_hash, i)
        if other != i:
            raise ObservationError(
                f"table {i + 1} ({table.name}) has the content of table {other + 1} "
                f"({tables[other].name}); give every table once"
            )


def as_pairs(chain, observations, positions):
    """Return ``(chain, observations, positions)`` of every dataset, from one or several of each."""
    observations = as_tables(observations)
    check_chains("chain", chain if isinstance(chain, (list, tuple)) else [chain])
    chains = [chain] * len(observations) if isinstance(chain, Model) else list(chain)
    positions = [None] * len(observations) if positions is None else list(positions)
    if not observations or len(chains) != len(observations) or len(positions) != len(observations):
        raise ObservationError(
            f"{len(observations)} datasets, {len(chains)} chains and {len(positions)} sets of "
            "positions do not go together"
        )
    return list(zip(chains, observations, positions, strict=True))


class Dataset:
    """A chain with its observations, on the common grid (micrometre) and the flat vector.

    ``positions`` of every stage are in radian, shape (n_frames,), or (nodes, n_frames) at the
    Gauss-Legendre nodes of each exposure, whose fluxes are averaged; by default as the instrument
    that the table names reads it, or the columns of the table.
    """

    def __init__(self, chain, observations, observable, free, wavelength, positions=None):
        _check_fit(chain, observations, observable)
        self.observations = observations
        self.observable = observable
        self.n_free = free.size
        # indices of this dataset's wavelengths on the grid common to all, (n_wavelengths,)
        self.bins = bins_on_grid(observations, wavelength)
        self.frames = self.observations.groups(self.observable.frames_per_datum)
        columns = self.frames.T.ravel()
        given = self._given = _positions(chain, observations, positions)
        self._node_weights = _node_weights(given, observations)
        #: Position of each stage in the frames of each datum, radian,
        #: (frames_per_datum, n_groups); the mean over the nodes of an exposure.
        self.positions = {
            stage: np.atleast_2d(angle).mean(axis=0)[self.frames.T]
            for stage, angle in given.items()
            if stage not in COORDINATES
        }
        self._place(chain, columns)
        self._plan(chain, free)
        self._observe(columns)

    def _place(self, chain, columns):
        n_nodes = self._node_weights.size
        # node after node, each with all columns: (n_nodes *
        # n_columns,) is the frame axis of a sweep
        placed = {
            stage: (a[:, columns].ravel() if a.ndim == 2 else np.tile(a[..., columns], n_nodes))
            for stage, a in self._given.items()
        }
        # where nothing moves all frames are alike, but there are as many
        placed = placed or {"frame": np.zeros(n_nodes * columns.size)}
        obs = self.observations
        try:
            self.propagator = Propagator(chain, obs.wavelength.to_value(u.um), placed)
        except WavelengthRangeError as error:
            raise WavelengthRangeError(f"{obs.name}: {error}") from None

    def inputs(self):
        """Return the lowest and highest of each position in the frames that are used."""
        used = ~self.observations.mask.all(axis=1)
        flat = ((name, given[..., used]) for name, given in self._given.items())
        return {name: (float(given.min()), float(given.max())) for name, given in flat}

    def thinned(self, chain, groups):
        """Return the dataset with some of its groups of frames, by ascending numbers."""
        new = copy.copy(self)
        new.frames = self.frames[groups]
        new.positions = {stage: angle[:, groups] for stage, angle in self.positions.items()}
        columns = new.frames.T.ravel()
        new._place(chain, columns)
        new._observe(columns)
        return new

    # ---- data ----------------------------------------------------------------

    def _observe(self, columns):
        obs = self.observations
        # the table is (n_frames, n_wavelengths), an observable wants the frames of a datum first
        known = obs.flux_right, obs.flux_left, obs.variance_right, obs.variance_left, obs.covariance
        right, left, *errors = (self._grouped(values[columns].T) for values in known)
        # one masked frame spoils the whole difference
        bad = self._grouped(obs.mask[columns].T).any(axis=0)
        groups = obs.brightness_groups[self.frames[:, 0]]
        self.observable = self.observable.of(right[0], errors[0][0], ~bad, groups)
        #: True where a group of frames gives a datum, (n_wavelengths, n_groups).
        self.valid = ~bad & getattr(self.observable, "valid", True)
        # what is masked may be zero or NaN; it is dropped by the index, not by the arithmetic
        with np.errstate(invalid="ignore", divide="ignore"):
            self.observed = self.observable.evaluate(right, left)[self.valid]
            variance = self.observable.variance(right, left, *errors)
        self.sigma = np.sqrt(variance[self.valid])
        self.n_data = int(self.valid.sum())
        self._all_valid = bool(self.valid.all())
        places, self.group_of_datum = np.nonzero(self.valid)
        self.bin_of_datum = self.bins[places]

    def _grouped(self, array):
        """Turn (n_wavelengths, columns) into (frames_per_datum, n_wavelengths, n_groups)."""
        shape = (array.shape[0], self.frames.shape[1], self.frames.shape[0])
        return array.reshape(shape).transpose(1, 0, 2)

    def _fluxes(self, sweep):
        """Return the fluxes of a sweep, averaged over the nodes, in groups."""
        return tuple(self._grouped(self._over_nodes(flux, mean=True)) for flux in sweep.fluxes)

    def _over_nodes(self, array, mean=False):
        """Return the sum, or the weighted mean, of (n_wavelengths, nodes x columns) over nodes."""
        weights = self._node_weights
        if weights.size == 1:
            return array
        nodes = array.reshape(array.shape[0], weights.size, -1)
        # derivatives carry the weights of the nodes already and are only added up
        return np.einsum("wnc,n->wc", nodes, weights if mean else np.ones_like(weights))

    # ---- parameters ------------------------------------------------------------

    def _plan(self, chain, free):
        """Note which values of the chain come from which part of the flat vector."""
        self._constants = self.propagator.values()
        # ((leaf, parameter), place in the flat vector, factor,
        # offset): value = factor * vector + offset
        self._live = []
        for i, leaf in enumerate(leaves(chain)):
            for j, key in enumerate(leaf.param_names):
                slot, factor, offset = free.lookup(f"{leaf.name}.{key}")
                if slot is not None:
                    where = slot.start + self.bins if slot.per_wavelength else slot.start
                    self._live.append(((i, j), where, factor, offset))
                # a fixed value per wavelength is cut down to this dataset's wavelengths
                elif np.size(self._constants[i][j]) > 1:
                    self._constants[i][j] = self._constants[i][j][self.bins]

    @property
    def n_parameters_per_wavelength(self):
        """Number of free parameters that act on the data of one wavelength."""
        # one start a slot: a follower shares that of its source, and one free number counts once
        return len({int(np.min(where)) for _, where, *_ in self._live})

    def values(self, sweep):
        """Return the predicted data of a forward sweep, shape (n_data,)."""
        predicted = self.observable.evaluate(*self._fluxes(sweep))
        return predicted.ravel() if self._all_valid else predicted[self.valid]

    def brightness(self, sweep):
        """Return how bright frames are in the table, over the model and the mean of their group.

        Shape (frames_per_datum, n_data), and its derivatives (frames_per_datum, n_free, n_data).
        """
        right, left = self._fluxes(sweep)
        observed = self.observations.flux_right + self.observations.flux_left
        observed = self._grouped(observed[self.frames.T.ravel()].T)
        model = np.where(self.valid, right + left, 1.0)
        bright = np.where(self.valid, observed, 1.0) / model
        bright, each = bright / bright.mean(axis=0), np.eye(len(bright))[..., None, None] / -model
        slopes = np.array([self.jacobian(sweep, derivative=(one, one)) for one in each])
        return bright[:, self.valid], slopes - slopes.mean(axis=0)

    def of_lamp(self, sweep, bright):
        """Return what the data gain where frames are so bright, (n_data,)."""
        factor = np.ones((len(bright), *self.valid.shape))
        factor[:, self.valid] = bright
        with_lamp = self.observable.evaluate(*(flux * factor for flux in self._fluxes(sweep)))
        return with_lamp[self.valid] - self.values(sweep)

    def forward(self, vector):
        """Return the forward sweep at a vector of free parameters."""
        return self.propagator.forward(self.current_values(vector))

    def current_values(self, vector):
        """Return the parameter values of all optics at a vector of free parameters."""
        values = [list(optic) for optic in self._constants]
        for (i, j), where, factor, offset in self._live:
            values[i][j] = factor * vector[where] + offset
        return values

    def jacobian(self, sweep, among=None, derivative=None):
        """Return the derivative of the data to the flat vector, (n_free, n_data).

        Or of what has a ``derivative`` to the fluxes of both beams of its group.
        """
        live = [one for one in self._live if among is None or np.any(among[one[1]])]
        right, left = self._fluxes(sweep)
        own = derivative is None
        derivative = self.observable.derivative(right, left) if own else derivative
        # the weights of columns are spread over the nodes of their exposures
        columns = [d.transpose(1, 0, 2).reshape(d.shape[1], 1, -1) for d in derivative]
        weights = [(c * self._node_weights[:, None]).reshape(len(c), -1) for c in columns]
        # backward sweep: d(datum)/d(parameter) = sum over frames and beams of
        # d(datum)/d(flux) * d(flux)/d(parameter), without ever building the fluxes' own Jacobian
        slopes = sweep.derivatives([key for key, *_ in live], weights)
        n_groups, n_bins = self.frames.shape[0], len(self.bins)
        out = np.zeros((self.n_free, n_bins, n_groups))
        each = np.arange(n_bins)
        for key, where, factor, _ in live:
            slope = factor * self._grouped(self._over_nodes(slopes[key])).sum(axis=0)
            # a value per wavelength moves the data of its own wavelength
            # only, one for all moves all of them
            out[where, each] += slope
        out = self.observable.gathered(out, right, left) if own else out
        return out.reshape(self.n_free, -1) if self._all_valid else out[:, self.valid]

    def along_stage(self, chain, sweep, stage):
        """Return the derivative of the data to the angle of a stage, per radian, (n_data,)."""
        new = copy.copy(self)
        new.n_free = 1
        new._live = [
            ((i, leaf.param_names.index("theta")), 0, leaf.stage_sign, 0.0)
            for i, leaf in enumerate(leaves(chain))
            if leaf.stage == stage and "theta" in leaf.param_names
        ]
        return new.jacobian(sweep)[0]


def _check_fit(chain, observations, observable):
    """Refuse a table whose beams or states are not those of the chain."""
    name, split = observations.name, splits(leaves(chain))
    if split == observations.single_beam:
        has, needs = ("one beam", "two") if split else ("two beams", "one")
        raise ObservationError(
            f"{name}: the table has {has} a frame, the chain {needs}; "
            + ("flux_right and flux_left" if split else "flux, or flux_NAME for each beam,")
            + " are needed"
        )
    if observations.single_beam != (observable.name == "intensity"):
        words = ("one beam", "intensity") if observations.single_beam else ("two beams", "another")
        raise ObservationError(
            f"{name}: observable {observable.name} of {words[0]} a frame; allowed is {words[1]}"
        )
    if states_of(chain):
        check_states(chain, observations.frames.columns, name, least=1)


def _positions(chain, observations, positions):
    if positions is None:
        # of an instrument that is not registered the columns are read
        read = _columns
        if observations.instrument is not None:
            with suppress(InstrumentError):
                read = instruments.get(observations.instrument).positions
        positions = read(observations, chain)
    found, used = {}, ~observations.mask.all(axis=1)
    for stage, angle in positions.items():
        unit = PLACES.get(stage) if stage in COORDINATES else u.rad
        # a plain number is in that unit
        angle = to_unit(angle, unit if hasattr(angle, "unit") else None, f"position of {stage}")
        if angle.shape[-1:] != (observations.n_frames,):
            raise ObservationError(
                f"{observations.name}: {stage} has positions of shape {angle.shape}; allowed are "
                f"({observations.n_frames},) and (nodes, {observations.n_frames})"
            )
        found[stage] = angle
        lost = used & ~np.isfinite(angle).reshape(-1, observations.n_frames).all(axis=0)
        if lost.any():
            frame = frame_names(observations.frames)[np.argmax(lost)]
            raise ObservationError(
                f"{observations.name}, frame {frame}: {stage} is not known; a finite number is "
                "needed"
            )
    return found


def _columns(observations, chain):
    # where the true angle of a stage is known, it is that at which it stands
    known, true = observations.frame_columns, {s: f"{s}_true" for s in stages(chain)}
    return {s: observations.position(t if t in known else s) for s, t in true.items()}


def _node_weights(positions, observations):
    """Return the weights of the nodes of an exposure, which sum to one."""
    counts = {s: len(a) for s, a in positions.items() if a.ndim == 2}
    if len(set(counts.values())) > 1:
        raise ObservationError(
            f"{observations.name}: the stages have different numbers of nodes: {counts}"
        )
    _, weights = np.polynomial.legendre.leggauss(next(iter(counts.values()), 1))
    # Gauss-Legendre weights on (-1, 1) sum to 2, the length of that interval
    return weights / 2
