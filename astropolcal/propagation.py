# Licensed under a 3-clause BSD style license - see LICENSE
"""
Fluxes of both beams and their derivatives, for many frames and wavelengths.

One forward sweep carries the Stokes vectors of all frames and wavelengths
through the chain; one backward sweep carries the analyser rows (the adjoint)
towards the source. The derivative to any parameter is then a product of the
two at its optic, so that all derivatives together cost about as much as a
few evaluations. Everything is on canonical floats.

Arrays of light have shape (n_wavelengths, 4, n_columns); a column is a frame,
and an axis has length 1 as long as nothing has depended on it. The matrix of an
optic has shape (n_wavelengths, 4, 4), or (n_wavelengths, 4, 4, n_columns) where it
changes from frame to frame.
"""

import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError
from astropolcal.optics import FrameOptic

__all__ = ["Propagator"]


class _Node:
    """An optic of the chain, with what does not change in a fit."""

    __slots__ = ("dispersion", "index", "leaf", "per_frame", "stage_angle")

    def __init__(self, index, leaf, wavelength, positions):
        self.index = index
        self.leaf = leaf
        self.per_frame = isinstance(leaf, FrameOptic)
        shift = leaf.stage_sign * _of_beam(leaf, positions) if leaf.stage else 0.0
        if self.per_frame:
            self.dispersion, self.stage_angle = leaf._moved(0.0, 0.0, np.atleast_2d(shift))
        else:
            self.dispersion, self.stage_angle = leaf._dispersion(wavelength), shift

    def matrix(self, values):
        return self._shaped(self.leaf._matrix(self.dispersion, *self._along(values)))

    def derivatives(self, values):
        found = self.leaf._derivatives(self.dispersion, *self._along(values))
        return [self._shaped(derivative) for derivative in found]

    def _along(self, values):
        """Put values given per wavelength along the first of the frames' two axes."""
        return [v[:, None] if np.ndim(v) else v for v in values] if self.per_frame else values

    def _shaped(self, matrix):
        """Return a matrix with its axis of wavelengths first and that of columns last."""
        if self.per_frame:
            return np.ascontiguousarray(np.moveaxis(matrix, 1, -1))
        return matrix if matrix.ndim == 3 else matrix.reshape(-1, 4, 4)


def _for_beam(leaf, beam):
    """Return an optic as it acts on a beam."""
    if not hasattr(leaf, "beam"):
        return leaf
    copy = leaf.copy()
    copy.beam = beam
    return copy


def _of_beam(leaf, positions):
    """Return the positions of a leaf's stage; a flux has a first axis for the beams."""
    given = np.asarray(positions[leaf.stage])
    return given[1 if getattr(leaf, "beam", "right") == "left" else 0] if given.ndim == 3 else given


class _Step:
    """What the forward sweep leaves at one optic for the backward sweep."""

    __slots__ = ("light", "matrix", "node", "out", "turn", "values")

    def __init__(self, node, values, turn, light, matrix, out):
        self.node, self.values, self.turn = node, values, turn
        self.light, self.matrix, self.out = light, matrix, out


class Propagator:
    """
    The fluxes that a chain predicts, and their derivatives.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        A chain with one beam splitter.
    wavelength : `~numpy.ndarray`
        Wavelengths in micrometre, shape (n_wavelengths,).
    positions : dict of str to `~numpy.ndarray`
        Position of each stage, radian or a number, shape (n_columns,). What
        differs between the beams, such as a flux, may have shape
        (2, n_wavelengths, n_columns), the right beam first.
    source : sequence of float
        Stokes vector of the light that enters.

    Raises
    ------
    ChainError
        If the chain has no beam splitter, a stage has no position, the stages
        have different numbers of positions, or positions that differ between
        the beams are given for an optic that does not.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.propagation import Propagator
    >>> chain = optics.LinearPolarizer() | optics.WollastonPrism(efficiency=0.9)
    >>> right, left = Propagator(chain, np.array([1.6]), {}).fluxes()
    >>> float(right[0, 0].round(4)), float(left[0, 0].round(4))
    (0.475, 0.025)
    """

    def __init__(self, chain, wavelength, positions, source=(1.0, 0.0, 0.0, 0.0)):
        wavelength = np.atleast_1d(np.asarray(wavelength, dtype=float))
        self.leaves = leaves(chain)
        _check(self.leaves, positions, len(wavelength))
        self.wavelength = wavelength
        self.shape = (len(wavelength), _column_count(positions))
        self.source = np.asarray(source, dtype=float).reshape(1, 4, 1)
        split = next(i for i, leaf in enumerate(self.leaves) if leaf.depends_on_beam)
        make = [_Node(i, leaf, wavelength, positions) for i, leaf in enumerate(self.leaves)]
        self._common = make[:split]
        self._arms = [
            [
                _Node(i, _for_beam(leaf, beam), wavelength, positions)
                for i, leaf in enumerate(self.leaves[split:], start=split)
            ]
            for beam in ("right", "left")
        ]
        first, other = (arm[0] for arm in self._arms)
        same = np.array_equal(first.stage_angle, other.stage_angle)
        self._same_entrance = same and not first.leaf.rotates_frame

    def values(self):
        """
        Return the current parameter values, one list an optic.

        Returns
        -------
        list of list of `~numpy.ndarray`
            Canonical floats, ``theta`` first; shape () or (n_wavelengths,).

        Examples
        --------
        >>> import numpy as np
        >>> from astropolcal import optics
        >>> from astropolcal.propagation import Propagator
        >>> values = Propagator(optics.WollastonPrism(), np.array([1.6]), {}).values()
        >>> [[float(value) for value in optic] for optic in values]
        [[0.0, 1.0]]
        """
        return [leaf.canonical_values() for leaf in self.leaves]

    def fluxes(self, values=None):
        """
        Return the fluxes of the right and the left beam.

        Parameters
        ----------
        values : list of list, optional
            Values as `values` gives them; by default the current ones.

        Returns
        -------
        right, left : `~numpy.ndarray`
            Shape (n_wavelengths, n_columns), for unit source intensity.

        Examples
        --------
        >>> import numpy as np
        >>> from astropolcal import optics
        >>> from astropolcal.propagation import Propagator
        >>> [float(flux[0, 0]) for flux in Propagator(optics.WollastonPrism(), [1.6], {}).fluxes()]
        [0.5, 0.5]
        """
        return self.forward(values).fluxes

    def forward(self, values=None):
        """
        Carry the light through the chain and keep what derivatives need.

        Parameters
        ----------
        values : list of list, optional
            As for `fluxes`.

        Returns
        -------
        Sweep
            With ``fluxes`` and the method ``derivatives``.

        Raises
        ------
        ParameterError
            If the chain's own values are used and one has neither one value
            nor one a wavelength.

        Examples
        --------
        The derivative of the right flux to the efficiency of the Wollaston prism:

        >>> import numpy as np
        >>> from astropolcal import optics
        >>> from astropolcal.propagation import Propagator
        >>> chain = optics.LinearPolarizer() | optics.WollastonPrism(efficiency=0.9)
        >>> sweep = Propagator(chain, np.array([1.6]), {}).forward()
        >>> weights = np.ones((1, 1)), np.zeros((1, 1))
        >>> float(sweep.derivatives([(1, 1)], weights)[1, 1][0, 0])
        0.25
        """
        return Sweep(self, self._own_values() if values is None else values)

    def _own_values(self):
        """Return the chain's values; refuse those that are on another wavelength grid."""
        values = self.values()
        for leaf, own in zip(self.leaves, values, strict=True):
            leaf._check_grid(self.wavelength, own)
        return values


def _check(found, positions, n_wavelengths):
    if not any(leaf.splits_light for leaf in found):
        raise ChainError("the chain has no beam splitter, so it predicts no beam fluxes")
    for leaf in found:
        label = f"optic {leaf.name or type(leaf).__name__} stands on stage {leaf.stage!r}"
        if leaf.stage and leaf.stage not in positions:
            raise ChainError(f"{label}; the observations give positions of {sorted(positions)}")
        shape = np.shape(positions[leaf.stage]) if leaf.stage else ()
        if len(shape) > 1 and not (len(shape) == 3 and shape[:2] == (2, n_wavelengths)):
            raise ChainError(
                f"{label}, whose positions have shape {shape}; allowed are (n_columns,) and, "
                f"beam by beam, (2, {n_wavelengths}, n_columns)"
            )
        if len(shape) == 3 and not leaf.depends_on_beam and leaf.stage != "total_flux":
            raise ChainError(f"{label}, which differs between the beams, but the optic does not")


def _column_count(positions):
    counts = {name: np.shape(np.atleast_1d(angle))[-1] for name, angle in positions.items()}
    several = {count for count in counts.values() if count != 1}
    if len(several) > 1:
        raise ChainError(f"the stages have different numbers of positions: {counts}")
    return several.pop() if several else 1


class Sweep:
    """A forward sweep: the fluxes of both beams, ready to be differentiated."""

    def __init__(self, propagator, values):
        self._propagator = propagator
        self._common, state = _run(propagator._common, values, (propagator.source, 0.0))
        self._arms, fluxes = [], []
        # in front of the splitter the light of both beams is the same
        turned = {} if propagator._same_entrance else None
        for nodes in propagator._arms:
            steps, (light, _) = _run(nodes, values, state, turned)
            self._arms.append(steps)
            flux = light[:, 0]
            whole = flux.shape == propagator.shape
            fluxes.append(flux if whole else np.broadcast_to(flux, propagator.shape))
        #: Fluxes of the right and the left beam, (n_wavelengths, n_columns) each.
        self.fluxes = tuple(fluxes)

    def derivatives(self, wanted, weights):
        """
        Return derivatives of a weighted sum of the two fluxes of each column.

        Parameters
        ----------
        wanted : sequence of (int, int)
            Index of the optic in the chain and of its parameter.
        weights : pair of `~numpy.ndarray`
            Weights of the right and the left flux, (n_wavelengths, n_columns).

        Returns
        -------
        dict of (int, int) to `~numpy.ndarray`
            Derivative per canonical unit, (n_wavelengths, n_columns).
        """
        result = {}
        by_optic = {}
        for optic, parameter in wanted:
            by_optic.setdefault(optic, []).append(parameter)
        adjoint = 0.0
        for steps, weight in zip(self._arms, weights, strict=True):
            row = np.zeros((weight.shape[0], 4, weight.shape[1]))
            row[:, 0, :] = weight
            adjoint = adjoint + _back(steps, row, by_optic, result)
        _back(self._common, adjoint, by_optic, result)
        shape = self._propagator.shape
        return {key: np.broadcast_to(value, shape) for key, value in result.items()}


def _run(nodes, values, state, turned=None):
    """
    Carry light through ``nodes``; return the steps and the state behind them.

    ``turned`` keeps the light as the first node sees it, for other nodes behind the same light.
    """
    light, frame = state
    steps = []
    for node in nodes:
        theta, *own = values[node.index]
        # one value a wavelength goes along the first axis, positions along the last
        angle = node.stage_angle + (theta[:, None] if np.ndim(theta) else theta)
        if node.leaf.rotates_frame:
            frame = frame - angle
            steps.append(_Step(node, own, None, light, None, light))
            continue
        turn = angle - frame
        known = turned.get("light") if turned is not None else None
        light = _rotate(light, turn) if known is None else known
        if turned is not None:
            turned["light"], turned = light, None
        matrix = node.matrix(own)
        out = _act(matrix, light)
        steps.append(_Step(node, own, turn, light, matrix, out))
        light, frame = out, angle
    return steps, (light, frame)


def _back(steps, adjoint, by_optic, result):
    """Carry the adjoint back through ``steps``, adding derivatives to ``result``."""
    for step in reversed(steps):
        wanted = by_optic.get(step.node.index, ())
        if step.matrix is None:
            if 0 in wanted:
                _add(result, (step.node.index, 0), 2 * _cross(adjoint, step.light))
            continue
        inward = _act(step.matrix.swapaxes(1, 2), adjoint)
        if wanted:
            _at_optic(step, wanted, adjoint, inward, result)
        adjoint = _rotate(inward, -step.turn)
    return adjoint


def _at_optic(step, wanted, adjoint, inward, result):
    """Add the derivatives to the wanted parameters of one optic."""
    index = step.node.index
    if 0 in wanted:
        slope = 2 * (_cross(inward, step.light) - _cross(adjoint, step.out))
        _add(result, (index, 0), slope)
    if max(wanted) > 0:
        derivatives = step.node.derivatives(step.values)
        for parameter in wanted:
            if parameter:
                changed = _act(derivatives[parameter - 1], step.light)
                _add(result, (index, parameter), np.einsum("wsc,wsc->wc", *_same(adjoint, changed)))


def _same(a, b):
    return np.broadcast_arrays(a, b) if a.shape != b.shape else (a, b)


def _add(result, key, value):
    result[key] = result[key] + value if key in result else value


def _cross(a, s):
    """Return a . G s, the product with the generator of rotations."""
    return a[..., 1, :] * s[..., 2, :] - a[..., 2, :] * s[..., 1, :]


def _rotate(light, angle):
    """Return T(angle) applied to the light; ``angle`` broadcasts against (wavelength, column)."""
    dimensions = np.ndim(angle)
    if dimensions == 0 and angle == 0:
        return light
    double = 2 * angle
    cosine, sine = np.cos(double), np.sin(double)
    rows, _, columns = light.shape
    if dimensions:
        # the shape of the product, without asking numpy for it
        columns = max(columns, angle.shape[-1])
        rows = max(rows, angle.shape[0]) if dimensions == 2 else rows
    out = _blank(rows, columns)
    q, u, new_q, new_u = light[:, 1], light[:, 2], out[:, 1], out[:, 2]
    out[:, ::3] = light[:, ::3]
    np.multiply(cosine, q, out=new_q)
    new_q += sine * u
    np.multiply(cosine, u, out=new_u)
    new_u -= sine * q
    return out


def _act(matrix, light):
    """Return matrix times light; the matrix may have a last axis of columns."""
    if matrix.ndim == 3:
        out = _blank(max(len(matrix), len(light)), light.shape[2])
        return np.matmul(matrix, light, out=out)
    return (matrix * light[:, None]).sum(axis=2)


def _blank(rows, columns):
    """Return light, (rows, 4, columns), where the values of each Stokes parameter lie together."""
    return np.empty((4, rows, columns)).swapaxes(0, 1)
