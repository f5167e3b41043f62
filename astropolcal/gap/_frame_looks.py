# Licensed under a 3-clause BSD style license - see LICENSE
"""What single frames say against a nominal model: derivatives, leverages and finite errors."""

from functools import cached_property

import numpy as np
from scipy import stats

from astropolcal.chain import leaves
from astropolcal.gap._bases import law_basis
from astropolcal.optics import COORDINATES

__all__ = ["BEAM_DEGREE", "Look", "angle_stages", "kept_rows"]

#: Largest degree in wavelength of the law of a beam's factor.
BEAM_DEGREE = 2
# a direction of which the nominal model takes up all but this share is not seen
_SEEN = 1e-6


def angle_stages(chain):
    """
    Return the stages of a chain that turn an optic, with the optics on them.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.

    Returns
    -------
    dict of str to list of tuple
        Index of the optic in the chain and the sign with which it turns.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap._frame_looks import angle_stages
    >>> angle_stages(instruments.get("charis").chain())
    {'hwp': [(1, 1.0)], 'derotator': [(2, 1.0)]}
    """
    found = {}
    for i, leaf in enumerate(leaves(chain)):
        if leaf.stage and leaf.stage not in COORDINATES:
            found.setdefault(leaf.stage, []).append((i, leaf.stage_sign))
    return found


class Look:
    """
    All frames beside what a nominal model can do.

    Parameters
    ----------
    model : Model
        The nominal model.
    coefficients : `~numpy.ndarray`
        Where it is looked from.
    out : list of `~numpy.ndarray` of bool
        Frames that take no part, one array (F,) a dataset.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.gap._frame_looks import Look
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> look = Look(model, model.fit.coefficients, [np.zeros(24, bool)])
    >>> bool(look.chance > 0.01)
    True
    """

    def __init__(self, model, coefficients, out):
        self.model, self.problem, self.chains = model, model.problem, model.chains
        self.coefficients, self.out = coefficients, out
        self.vector = self.problem.vector(coefficients)
        rows = kept_rows(self.problem, out)
        columns = np.concatenate([self.problem.open_slopes(coefficients), self._of_flux()], axis=1)
        #: What the model takes up of a frame that takes part, (n_rows, rank); of one that does
        #: not, how its prediction hangs on the others.
        self.tangent, weight = _basis(columns, rows)
        residual = self.problem.residual(coefficients)
        #: What is left of frames that take part; of others, by how far they miss the prediction.
        self.residual = residual - self.tangent @ (weight.T @ residual)
        #: Sum of squares and degrees of freedom of the frames that take part.
        self.chi2 = float(np.sum(self.residual[rows] ** 2))
        lost = sum(
            2 * int(c.valid[:, o].sum()) for c, o in zip(self.problem.channels, out, strict=True)
        )
        self.freedom = max(self.problem.n_data - lost - self.tangent.shape[1], 1)

    @cached_property
    def chance(self):
        """Probability that noise gives as large a sum of squares."""
        return float(stats.chi2.sf(self.chi2, self.freedom))

    def _of_flux(self):
        """
        Return what background and nonlinearity do to the differences, (n_rows, k).

        A lamp that is dim in a few frames must not make a background look like their fault.
        """
        blocks = []
        for i, (channel, rows) in enumerate(
            zip(self.problem.channels, self.problem.segments, strict=True)
        ):
            right, left = self.sweeps[i].fluxes
            difference = (right - left) / (right + left)
            level = np.where(channel.valid, np.exp(channel.observed[1]), np.nan)
            bright = level / np.nanmedian(level) if channel.valid.any() else np.ones(level.shape)
            bright = np.where(channel.valid, bright, 1.0)
            shapes = (1 / bright, difference / bright, bright * difference * (1 - difference**2))
            law = self.law(i).T[:, :, None]
            table = np.zeros((len(shapes) * len(law), *channel.shape))
            table[:, 0] = np.concatenate([law * shape * channel.valid for shape in shapes])
            block = np.zeros((self.problem.n_rows, len(table)))
            block[rows] = channel.whiten_frames(table).reshape(len(table), -1).T
            blocks.append(block)
        return np.concatenate(blocks, axis=1)

    def law(self, i):
        """Return the law of a beam's factor at the wavelengths of a dataset, (W, k)."""
        law = law_basis(self.problem.wavelength[self.problem.datasets[i].bins], BEAM_DEGREE)
        # of few wavelengths it is any function: its first column is a constant here, too
        return law if len(law) > BEAM_DEGREE + 1 else np.tril(np.ones(law.shape))

    @cached_property
    def _parts(self):
        """Residual (2 W, F), tangent (2 W, F, rank) and lamp (2 W, F, n) of each dataset."""
        parts = []
        for channel, rows in zip(self.problem.channels, self.problem.segments, strict=True):
            _, n, f = channel.shape
            lamp = np.zeros((2, n * f, channel.n_nuisance))
            lamp[1] = channel.nuisance
            parts.append(
                (
                    self.residual[rows].reshape(2 * n, f),
                    self.tangent[rows].reshape(2 * n, f, -1),
                    lamp.reshape(2 * n, f, -1),
                )
            )
        return parts

    # ---- small errors, all frames at once -----------------------------------------------------

    @cached_property
    def sweeps(self):
        """The forward sweep of each dataset."""
        return [dataset.forward(self.vector) for dataset in self.problem.datasets]

    def columns(self, i):
        """
        Return what an error of each kind does to every frame of a dataset, (k, 2 W, F) each.

        By kind: ``"STAGE angle"`` per radian, ``"right beam"`` and ``"left beam"`` for a law in
        wavelength of the logarithm of the beam's flux.
        """
        channel, sweep = self.problem.channels[i], self.sweeps[i]
        stages, weights = angle_stages(self.chains[i]), channel.slopes(sweep)
        wanted = [(optic, 0) for optics in stages.values() for optic, _ in optics]
        slopes = [sweep.derivatives(wanted, weight) for weight in weights]
        found = {
            f"{stage} angle": np.stack(
                [sum(sign * slope[optic, 0] for optic, sign in optics) for slope in slopes]
            )[None]
            for stage, optics in stages.items()
        }
        law = self.law(i).T[:, None, :, None]
        for beam, name in enumerate(("right beam", "left beam")):
            found[name] = law * np.stack([weight[beam] * sweep.fluxes[beam] for weight in weights])
        return {
            kind: channel.whiten_frames(c * channel.valid).reshape(len(c), -1, channel.shape[2])
            for kind, c in found.items()
        }

    def lowering(self, i, columns):
        """Return by how much columns (k, 2 W, F) of one frame each lower chi-square, (F,)."""
        residual, tangent, lamp = self._parts[i]
        inner = np.einsum("haf,gaf->fhg", columns, columns)
        full = np.einsum("fhh->fh", inner).copy()
        for taken in (tangent, lamp):
            part = np.einsum("afk,haf->fkh", taken, columns, optimize=True)
            inner -= np.einsum("fkh,fkg->fhg", part, part)
        scale = np.sqrt(np.where(full > 0, full, 1.0))
        values, vectors = np.linalg.eigh(inner / scale[:, :, None] / scale[:, None, :])
        along = np.einsum("haf,af->fh", columns, residual) / scale
        along = np.einsum("fhg,fh->fg", vectors, along)
        seen = values > _SEEN
        return np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)

    def deleted(self, i):
        """
        Return by how much each frame's differences raise chi-square, and their number, (F,).

        That is by how much it falls if a frame that takes part is left out, and by how much it
        rises if one that does not is taken in.
        """
        residual, tangent, _ = self._parts[i]
        channel = self.problem.channels[i]
        n = channel.shape[1]
        residual, tangent = residual[:n].T, tangent[:n].transpose(1, 0, 2)
        values, vectors = np.linalg.eigh(tangent @ tangent.swapaxes(1, 2))
        along = np.einsum("fab,fa->fb", vectors, residual)
        share = np.where(self.out[i][:, None], 1 + values, 1 - values)
        seen = share > _SEEN
        fall = np.where(seen, along**2 / np.where(seen, share, 1.0), 0.0).sum(axis=1)
        return fall, channel.valid.sum(axis=0)

    def kept(self, i):
        """Return which frames of a dataset take part and have data, (F,) of bool."""
        return self.problem.channels[i].valid.any(axis=0) & ~self.out[i]

    def of_frame(self, i, f):
        """
        Return what the other frames say of the differences of one.

        Returns
        -------
        missed : `~numpy.ndarray`
            By how far the frame misses what is predicted from the others, (W,), whitened.
        sight : `~numpy.ndarray`
            Inverse of the covariance of these, with the errors of the prediction, (W, W).
        weight : `~numpy.ndarray`
            Inverse of the noise, (W,).
        """
        residual, tangent, _ = self._parts[i]
        channel = self.problem.channels[i]
        n = channel.shape[1]
        weight = channel.whiten_frames(np.ones(channel.shape) * channel.valid)[0, :, f]
        values, vectors = np.linalg.eigh(tangent[:n, f] @ tangent[:n, f].T)
        if self.out[i][f]:
            return residual[:n, f], (vectors / (1 + values)) @ vectors.T, weight
        share = np.where(1 - values > _SEEN, 1 - values, np.inf)
        missed = (vectors / share) @ vectors.T @ residual[:n, f]
        return missed, (vectors * np.maximum(1 - values, 0.0)) @ vectors.T, weight

    def sums_of_frame(self, i, f):
        """
        Return what the sums of a frame miss, (W,), what the lamp leaves of sums, and whitening.

        The latter two are (W, W).
        """
        residual, _, lamp = self._parts[i]
        channel = self.problem.channels[i]
        n = channel.shape[1]
        left = np.eye(n) - lamp[n:, f] @ lamp[n:, f].T
        single = np.zeros((n, 2, n, channel.shape[2]))
        single[:, 1, :, f] = np.diag(channel.valid[:, f].astype(float))
        return residual[n:, f], left, channel.whiten_frames(single)[:, 1, :, f].T


def _basis(columns, rows):
    """
    Return the basis that is orthonormal in some rows, in all of them, and in these rows only.

    A coefficient that these rows do not determine is left out.
    """
    kept = columns * rows[:, None]
    norm = np.linalg.norm(kept, axis=0)
    seen = norm > 0
    left, singular, right = np.linalg.svd(kept[:, seen] / norm[seen], full_matrices=False)
    good = singular > _SEEN * singular.max(initial=0.0)
    full = columns[:, seen] / norm[seen] @ (right[good].T / singular[good])
    # what was in the basis need not be worked out again, and is more exact
    return np.where(rows[:, None], left[:, good], full), left[:, good]


def kept_rows(problem, out):
    """Return which rows belong to frames that take part, (n_rows,) of bool."""
    return np.concatenate(
        [
            np.broadcast_to(~o, channel.shape).ravel()
            for channel, o in zip(problem.channels, out, strict=True)
        ]
    )
