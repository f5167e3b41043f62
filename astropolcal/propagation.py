# Licensed under a 3-clause BSD style license - see LICENSE
"""
Fluxes of both beams and their derivatives, for many frames and wavelengths.

One forward sweep carries the Stokes vectors of all frames and wavelengths through the chain; one
backward sweep carries the analyser rows (the adjoint) towards the source. The derivative to any
parameter is then a product of the two at its optic, so that all derivatives together cost about as
much as a few evaluations. Everything is on canonical floats.

Light has shape (n_wavelengths, n_columns, 4); a column is a frame, and an axis has length 1 as long
as nothing has depended on it. Q and U of a column lie side by side, so that they are also the
complex number Q + iU, which a rotation of the frame by an angle multiplies by exp(-2i angle), its
phase; None is a phase of 1. Light is kept in the frame of the optic that it enters. The matrix of
an optic has shape (n_wavelengths, 4, 4), or (n_wavelengths, n_columns, 4, 4) where it changes from
frame to frame.
"""

import cmath

import numpy as np

from astropolcal.chain import check_inputs, leaves
from astropolcal.exceptions import ChainError
from astropolcal.mueller import crossed, phase_of, turned, turned_back
from astropolcal.optics import FrameOptic

__all__ = []


class _Node:
    """An optic of the chain, with what does not change in a fit."""

    def __init__(self, index, leaf, wavelength, positions, follows):
        self.index, self.leaf, self.phase = index, leaf, None
        # whether some optic follows a law: the values of all have an axis for the frames then
        self.follows = follows
        inputs = {name for law in leaf._follows.values() for name in law.of} & set(positions)
        self.places = wavelength[:, None], {name: np.atleast_2d(positions[name]) for name in inputs}
        by_law = bool(set(leaf._follows) - {"theta"})
        self.per_frame = isinstance(leaf, FrameOptic) or by_law
        shift = leaf.stage_sign * _of_beam(leaf, positions) if leaf.stage else 0.0
        if isinstance(leaf, FrameOptic):
            self.dispersion, self.stage_angle = leaf._moved(0.0, 0.0, np.atleast_2d(shift))
        else:
            self.dispersion = leaf._dispersion(wavelength[:, None] if by_law else wavelength)
            self.stage_angle = shift

    def followed(self, values):
        """Return theta and the other values, with what laws add in each frame."""
        if not self.follows:
            return values
        found = self.leaf._followed(*self.places, _lifted(values))
        return found if self.per_frame else [found[0], *values[1 : len(found)]]

    def rates(self, values):
        """Return of each coefficient of a law which parameter it moves, and by how much."""
        found = self.leaf._rates(*self.places, _lifted(values))
        first = len(values) - len(found)
        moved = enumerate(found, start=first)
        return {(self.index, j): ((self.index, i), rate) for j, (i, rate) in moved}

    def follow(self, frame):
        """
        Add the stage angle of the frame upstream of the optic; return the one downstream of it.

        The stages stay where they are in a fit, so that their cosines are worked out once.
        """
        if self.leaf.rotates_frame:
            return frame - self.stage_angle
        self.phase = phase_of(self.stage_angle - frame)
        return self.stage_angle

    def matrix(self, values):
        return self._shaped(self.leaf._matrix(self.dispersion, *self._along(values)))

    def derivatives(self, values):
        found = self.leaf._derivatives(self.dispersion, *self._along(values))
        return [self._shaped(derivative) for derivative in found]

    def _along(self, values):
        """Put values given per wavelength along the first of the frames' two axes."""
        return _lifted(values) if self.per_frame else values

    def _shaped(self, matrix):
        return matrix if self.per_frame or matrix.ndim == 3 else matrix.reshape(-1, 4, 4)


def _lifted(values):
    """Put values given per wavelength along the first of two axes."""
    return [v[:, None] if np.ndim(v) == 1 else v for v in values]


def _of_beam(leaf, positions):
    """Return the positions of a leaf's stage; a flux has a first axis for the beams."""
    given = np.asarray(positions[leaf.stage])
    return given[1 if getattr(leaf, "beam", "right") == "left" else 0] if given.ndim == 3 else given


class _Step:
    """An optic at given values, and the light that entered it in the forward sweep."""

    def __init__(self, node, values, phase=None, matrix=None):
        self.node, self.values, self.phase, self.matrix = node, values, phase, matrix
        self.light = None


class Propagator:
    """The fluxes that a chain predicts, and their derivatives.

    Without a beam splitter the left beam is dark.

    ``wavelength`` in micrometre, ``positions`` of each stage in radian or a number, shape
    (n_columns,); what differs between the beams, such as a flux, may have shape (2, n_wavelengths,
    n_columns), the right beam first. ``source`` is the Stokes vector of the light that enters.
    """

    def __init__(self, chain, wavelength, positions, source=(1.0, 0.0, 0.0, 0.0)):
        wavelength = np.atleast_1d(np.asarray(wavelength, dtype=float))
        self.leaves = leaves(chain)
        _check(self.leaves, positions, len(wavelength))
        self.wavelength = wavelength
        counts = {name: np.shape(np.atleast_1d(angle))[-1] for name, angle in positions.items()}
        several = {count for count in counts.values() if count != 1}
        if len(several) > 1:
            raise ChainError(f"the stages have different numbers of positions: {counts}")
        self.shape = (len(wavelength), (several.pop() if several else 1))
        self.source = np.asarray(source, dtype=float).reshape(1, 1, 4)
        # of a single beam the arm is the last optic that is more than a turn of the frame
        acting = [i for i, leaf in enumerate(self.leaves) if not leaf.rotates_frame]
        split = next((i for i in acting if self.leaves[i].depends_on_beam), max(acting, default=-1))
        beams = ("right", "left") if splits(self.leaves) else ("right",)
        known = wavelength, positions, any(leaf._follows for leaf in self.leaves)
        self._common = [_Node(i, leaf, *known) for i, leaf in enumerate(self.leaves[:split])]
        self._arms = [
            [
                _Node(i, leaf.of_beam(beam), *known)
                for i, leaf in enumerate(self.leaves[split:], start=split)
            ]
            for beam in beams
        ]
        frame = _follow(self._common, 0.0)
        for arm in self._arms:
            _follow(arm, frame)
        first, other = self._arms[0][0], self._arms[-1][0]
        same = np.array_equal(first.stage_angle, other.stage_angle)
        self._same_entrance = same and not first.leaf.rotates_frame

    def values(self):
        """Return the current canonical values, one list per optic, ``theta`` first."""
        return [leaf.canonical_values() for leaf in self.leaves]

    def fluxes(self, values=None):
        """
        Return the fluxes of the right and the left beam for a source of unit intensity.

        (n_wavelengths, n_columns) each, at values as ``values`` gives them, by default the current
        ones.
        """
        return self.forward(values).fluxes

    def forward(self, values=None):
        """Carry the light through the chain and keep what derivatives need; return a Sweep."""
        if values is None:
            # those that are known at other wavelengths only are refused
            pairs = zip(self.leaves, self.values(), strict=True)
            values = [leaf.values_at(self.wavelength, own) for leaf, own in pairs]
        return Sweep(self, values)


def splits(found):
    """Return whether one of some optics splits the light into two beams."""
    return any(leaf.splits_light for leaf in found)


def _check(found, positions, n_wavelengths):
    if all(leaf.rotates_frame for leaf in found):
        raise ChainError("the chain has no optic that polarizes or splits the light")
    for leaf in found:
        label = f"optic {leaf._label} stands on stage {leaf.stage!r}"
        check_inputs(leaf, positions)
        shape = np.shape(positions[leaf.stage]) if leaf.stage else ()
        if len(shape) > 1 and not (len(shape) == 3 and shape[:2] == (2, n_wavelengths)):
            raise ChainError(
                f"{label}, whose positions have shape {shape}; allowed are (n_columns,) and, "
                f"beam by beam, (2, {n_wavelengths}, n_columns)"
            )
        if len(shape) == 3 and not leaf.depends_on_beam and leaf.stage != "total_flux":
            raise ChainError(f"{label}, which differs between the beams, but the optic does not")


class Sweep:
    """A forward sweep: the fluxes of both beams, ready to be differentiated."""

    def __init__(self, propagator, values):
        self._propagator, self._values = propagator, values
        self._common, frame = _at(propagator._common, values, 0.0)
        self._arms = [_at(arm, values, frame)[0] for arm in propagator._arms]
        last, light = _enter(self._common, propagator.source)
        light = light if last is None else act(last.matrix, light)
        same = propagator._same_entrance
        if same:
            # in front of the splitter the light of both beams is the same
            light = turned(light, self._arms[0][0].phase, in_place=last is not None)
        fluxes = []
        for arm in self._arms:
            last, seen = _enter(arm, light, entered=same)
            fluxes.append(_flux(last, seen, propagator.shape))
        if len(fluxes) == 1:
            # of a chain without a splitter the left beam is dark
            fluxes.append(np.zeros_like(fluxes[0]))
        #: Fluxes of the right and the left beam, (n_wavelengths, n_columns) each.
        self.fluxes = tuple(fluxes)

    def crossings(self, wanted, weights):
        """Return what any small change of the matrix of an optic does to a weighted sum of fluxes.

        A change of the matrix by E changes the sum by a . E s, with the light s that enters the
        optic and the analyser row a downstream of it. Of each ``wanted`` index of an optic: pairs
        of a and s, (n_wavelengths, n_columns, 4) each, in the frame of the optic, one for each beam
        where their light differs.
        """
        found = {}
        self.derivatives([(index, _CROSSING) for index in wanted], weights, found)
        shape = (*self._propagator.shape, 4)
        return {
            i: [tuple(np.broadcast_to(x, shape) for x in pair) for pair in pairs]
            for i, pairs in found.items()
        }

    def derivatives(self, wanted, weights, crossings=None):
        """
        Return derivatives of a weighted sum of the two fluxes of each column, per canonical unit.

        ``wanted`` are pairs, index of the optic and of its parameter, the keys of what is
        returned; ``weights`` those of the right and the left flux, all (n_wavelengths, n_columns),
        or several along a first axis. A dictionary ``crossings`` receives what the method of
        that name returns.
        """
        result, by_optic, rates = {}, {}, self._rates()
        for key in wanted:
            optic, parameter = rates[key][0] if key in rates else key
            by_optic.setdefault(optic, {})[parameter] = None
        adjoint, behind = 0.0, []
        # a dark beam has no arm
        for steps, weight in zip(self._arms, weights, strict=False):
            row = np.zeros((*weight.shape, 4))
            row[..., 0] = weight
            inward, pairs = _back(steps, row, [], by_optic, result, crossings)
            adjoint, behind = adjoint + inward, behind + pairs
        # upstream of the first optic that is asked for nothing is needed
        first = min(by_optic, default=len(self._common))
        _back(self._common[first:], adjoint, behind, by_optic, result, crossings)
        # of a coefficient: what its parameter does in each frame, times how it moves that
        result |= {key: result[to] * rate for key, (to, rate) in rates.items() if to in result}
        shape = (*np.shape(weights[0])[:-2], *self._propagator.shape)
        return {key: np.broadcast_to(value, shape) for key, value in result.items()}

    def _rates(self):
        found = {}
        for step in (*self._common, *self._arms[0]):
            if step.node.leaf._follows:
                found |= step.node.rates(self._values[step.node.index])
        return found


def _follow(nodes, frame):
    """Tell every node the stage angle of the frame upstream of it; return the last one's."""
    for node in nodes:
        frame = node.follow(frame)
    return frame


def _at(nodes, values, frame):
    """
    Return the optics of nodes at given values, as steps, and theta of the frame downstream of them.

    ``frame`` is theta of the frame upstream of them.
    """
    steps = []
    for node in nodes:
        theta, *own = node.followed(values[node.index])
        if node.leaf.rotates_frame:
            frame = frame - theta
            steps.append(_Step(node, own))
        else:
            phase = _turned_on(node.phase, theta - frame)
            steps.append(_Step(node, own, phase, node.matrix(own)))
            frame = theta
    return steps, frame


def _enter(steps, light, *, entered=False):
    """Carry light to the last optic with a matrix; return it, or None, and the light it sees.

    Light that has ``entered`` is in the frame of the first optic already.
    """
    last = None
    for step in steps:
        if step.matrix is None:
            continue
        if last is not None:
            # what comes out of a product belongs to nobody else
            light = turned(act(last.matrix, light), step.phase, in_place=True)
        elif not entered:
            light = turned(light, step.phase)
        step.light = light
        last = step
    return last, light


def _flux(last, light, shape):
    """Return the intensity downstream of the last optic, which no rotation changes."""
    row = last.matrix[..., 0, :]
    if last.node.per_frame:
        return _whole(np.einsum("wcs,wcs->wc", row, light), shape)
    return _whole((light @ row[..., None])[..., 0], shape)


def _whole(flux, shape):
    return flux if flux.shape == shape else np.broadcast_to(flux, shape)


# stands for a parameter where the crossing of an optic is asked for
_CROSSING = -1


def _back(steps, adjoint, behind, by_optic, result, crossings=None):
    """Carry the adjoint back through ``steps``, adding derivatives to ``result``.

    Returns the adjoint, and adjoint and light as they enter the first optic. ``behind`` has such
    pairs for the optics downstream of the steps. The product a . G s of a pair is the same on
    either side of a rotation, so that each is needed at one optic only.
    """
    for step in reversed(steps):
        wanted = by_optic.get(step.node.index, ())
        if step.matrix is None:
            if 0 in wanted:
                _add(result, (step.node.index, 0), 2 * _crossed(behind))
            continue
        pair = [(act_back(step.matrix, adjoint), step.light)]
        if _CROSSING in wanted:
            crossings.setdefault(step.node.index, []).append((adjoint, step.light))
        if 0 in wanted:
            # d/dtheta of T(-theta) M T(theta), with T' = 2 G T
            _add(result, (step.node.index, 0), 2 * (_crossed(pair) - _crossed(behind)))
        if wanted and max(wanted) > 0:
            derivatives = step.node.derivatives(step.values)
            for parameter in wanted:
                if parameter > 0:
                    changed = act(derivatives[parameter - 1], step.light)
                    # a product with ones sums the four of a column faster than sum or einsum
                    slope = (adjoint * changed) @ np.ones(4)
                    _add(result, (step.node.index, parameter), slope)
        behind = pair
        adjoint = turned_back(pair[0][0], step.phase)
    return adjoint, behind


def _add(result, key, value):
    result[key] = result[key] + value if key in result else value


def _crossed(pairs):
    """Return the sum of a . G s over pairs; G is the generator of rotations."""
    products = [crossed(a, s) for a, s in pairs]
    return sum(products[1:], start=products[0]) if products else np.zeros((1, 1))


# ---- Stokes vectors through Mueller matrices ----------------------------------------------------


def _turned_on(stage, theta):
    """Return the phase at the entrance of an optic, of that of its stage, or None for 1."""
    if np.ndim(theta):
        # one value per wavelength goes along the first axis, positions along the second
        turn = np.exp(-2j * (theta[:, None] if theta.ndim == 1 else theta))
    elif theta:
        turn = cmath.exp(-2j * theta)
    else:
        return stage
    return turn if stage is None else stage * turn


def act(matrix, light):
    """Return matrix times light."""
    if matrix.ndim == 4:
        return np.einsum("wcij,wcj->wci", matrix, light)
    return light @ np.ascontiguousarray(matrix.swapaxes(1, 2))


def act_back(matrix, adjoint):
    """Return the adjoint times matrix."""
    if matrix.ndim == 4:
        return np.einsum("...wci,wcij->...wcj", adjoint, matrix)
    return adjoint @ matrix
