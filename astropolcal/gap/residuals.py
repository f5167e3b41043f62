# Licensed under a 3-clause BSD style license - see LICENSE
"""
Where the gap lies: in which wavelengths, angles, frames, beam and dataset.

The whitened residuals of a fitted model are noise of unit variance, less the
directions that model and lamp have taken up. What exceeds that is divided in
two ways. *Patterns* are functions of an axis (a harmonic of an angle, a trend,
a product of two), with a law in wavelength that is smooth or, as a pair with
the wavelength, free: they are taken in one after the other, the most telling
first, and each has the share that those before it have left. *Places* are sets
of data (a range of wavelengths, a derotator angle, a dataset) in which the
residuals are larger than elsewhere, found by a scan statistic (Kulldorff 1997,
doi:10.1080/03610929708831995), and the null channel, which holds several patterns.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from astropy.table import QTable
from scipy import stats

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.exceptions import GapError
from astropolcal.gap._places import most_uneven, places
from astropolcal.gap.attribution import false_discovery
from astropolcal.gap.channels import CHANNELS
from astropolcal.gap.patterns import badly_separated, frame_patterns
from astropolcal.gap.problem import law_basis

__all__ = ["Where", "locate"]

#: False discovery rate below which a look counts.
ALPHA = 0.01
_SMOOTH = 2
# a direction of which the model takes up more than this is none of the axis
_ABSORBED = 1e-3
_MOST_TERMS = 12
# a harmonic that the angles hardly tell from simpler ones gives way to the simplest that has
# this share of its evidence
_DOUBT = 0.5
# a pattern with a smaller share than this is not worth a sentence
_LEAST_SHARE = 0.01
_OF = {"difference": "differences", "sum": "sums"}


@dataclass
class Where:
    """
    Shares of the gap, by axis.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        All looks: ``axis``, ``detail``, ``kind`` ("pattern" or "place"),
        ``share`` of the excess over the noise, ``p_single`` and ``p_value``, the
        latter corrected for the number of looks.
    excess : float
        Sum of squares of the whitened residuals, less its expectation by noise.
    n_freedom : int
        That expectation.
    alpha : float
        False discovery rate below which a look counts.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from astropolcal.gap.residuals import Where
    >>> table = QTable({"axis": ["hwp"], "detail": ["harmonic 4"], "kind": ["pattern"],
    ...                 "share": [0.9], "p_single": [1e-9], "p_value": [1e-7]})
    >>> Where(table, 100.0, 500).entries[0]["share"]
    0.9
    """

    table: QTable
    excess: float
    n_freedom: int
    alpha: float = ALPHA

    @property
    def entries(self):
        """Rows of `told` as dicts with axis, detail, share and p_value."""
        return [
            {
                "axis": str(row["axis"]),
                "detail": str(row["detail"]),
                "share": float(row["share"]),
                "p_value": float(row["p_value"]),
            }
            for row in self.told
        ]

    @property
    def told(self):
        """Rows of the table that are significant and not minute."""
        table = self.table
        return table[(table["p_value"] < self.alpha) & (table["share"] > _LEAST_SHARE)]

    @property
    def words(self):
        """One sentence on the most telling pattern and place."""
        told = self.told
        if not told:
            return "No axis stands out from the noise."
        parts = []
        for kind, verb in (("pattern", "follows"), ("place", "lies in")):
            row = next((r for r in told if r["kind"] == kind), None)
            if row is not None:
                share = f"{100 * row['share']:.0f} % of the gap"
                parts.append(f"{share} {verb} {row['detail']}")
        return "; ".join(parts) + "."


def locate(model, *, alpha=ALPHA):
    """
    Divide the gap of a fitted model among wavelength, angles, time, beams and datasets.

    Parameters
    ----------
    model : Model
        The fitted model.
    alpha : float
        False discovery rate (Benjamini & Yekutieli 2001,
        doi:10.1214/aos/1013699998) over all looks.

    Returns
    -------
    Where

    Raises
    ------
    GapError
        If the data leave no freedom after the fit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.residuals import locate
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> locate(model).words
    'No axis stands out from the noise.'
    """
    data = _Whitened(model)
    patterns, null = _sequence(data, *_terms(model), alpha)
    found = [one for look in places(model) for one in most_uneven(data, *look)]
    rows = [*patterns, *sorted(found, key=lambda row: -row["evidence"]), null]
    corrected = false_discovery([row["p_single"] for row in rows])
    for row, p in zip(rows, corrected, strict=True):
        row["p_value"] = p
    names = ("axis", "detail", "kind", "share", "p_single", "p_value")
    table = QTable({name: [row[name] for row in rows] for name in names})
    return Where(table, data.excess, data.n_freedom, alpha)


class _Whitened:
    """Whitened residuals, and the directions in which they are empty."""

    def __init__(self, model):
        problem = model.problem
        self.problem, self.segments = problem, problem.segments
        self.tangent = problem.tangent(model.fit.coefficients)
        residual = model.residual
        self.residual = residual - self.tangent @ (self.tangent.T @ residual)
        self.n_freedom = problem.n_data - self.tangent.shape[1]
        if self.n_freedom < 1:
            raise GapError(
                f"{problem.n_data} data and {self.tangent.shape[1]} fitted directions leave "
                "nothing to look for a gap in; more frames are needed"
            )
        self.total = float(self.residual @ self.residual)
        self.excess = self.total - self.n_freedom
        # a gap within the noise has no shares worth the name
        self.scale = max(self.excess, np.sqrt(2 * self.n_freedom))
        self.valid = np.concatenate(
            [np.broadcast_to(c.valid, c.shape).ravel() for c in problem.channels]
        )

    def freedom(self, label, count):
        """Return the expected sum of squares of the rows of each label."""
        # leverage: the fit and the lamp take this share of the noise of each row
        taken = np.sum(self.tangent**2, axis=1)
        for segment, channel in zip(self.segments, self.problem.channels, strict=True):
            rows = np.arange(segment.start, segment.stop).reshape(channel.shape)[1].ravel()
            taken[rows] += np.sum(channel.nuisance**2, axis=1)
        keep = self.valid & (label >= 0)
        return np.bincount(label[keep], (1 - taken)[keep], minlength=count)


# ---- patterns ------------------------------------------------------------------------------


@dataclass
class _Term:
    """A pattern: its columns of each dataset, arrays (k, 2, W, F)."""

    axis: str
    detail: str
    channel: int
    parts: list = field(default_factory=list)
    doubtful: bool = False

    def columns(self, i, shape):
        part = self.parts[i]
        out = np.zeros((len(part), *shape))
        out[:, self.channel] = part
        return out


def _terms(model):
    """Return all patterns, with a smooth and with a free law in wavelength."""
    problem = model.problem
    smooth = law_basis(problem.wavelength, _SMOOTH)
    # what is not smooth
    rough = np.linalg.svd(smooth)[0][:, smooth.shape[1] :]
    tables = [frame_patterns(o) for o in model.observations]
    keys = dict.fromkeys(key for table in tables for key in table)
    notes = badly_separated(model.observations)
    terms = []
    for channel, name in enumerate(CHANNELS):
        for axis, words in keys:
            parts = [table.get((axis, words)) for table in tables]
            note = f" ({notes[words]})" if words in notes else ""
            detail = f"{words}, in the {_OF[name]}{note}"
            parts_smooth = _outer(parts, smooth, problem)
            terms.append(_Term(axis, detail, channel, parts_smooth, bool(note)))
            if rough.shape[1] and " x " not in axis and not note:
                sharp = f"{words}, sharp in wavelength, in the {_OF[name]}"
                pair = f"wavelength x {axis}"
                terms.append(_Term(pair, sharp, channel, _outer(parts, rough, problem)))
    return [*terms, _flux(problem)], _null_channel(model, smooth)


def _outer(parts, law, problem):
    """Return the products of a law and patterns, arrays (k, W, F)."""
    out = []
    for part, channel, dataset in zip(parts, problem.channels, problem.datasets, strict=True):
        shape = channel.shape[1:]
        if part is None:
            out.append(np.zeros((0, *shape)))
            continue
        # a dataset may have some of the wavelengths only
        product = law[dataset.bins].T[:, None, :, None] * part[None, :, None, :]
        out.append(product.reshape(-1, *shape))
    return out


def _null_channel(model, law):
    """Return what double sums see: all that is the same a quarter of a turn further on."""
    parts = []
    for observations in model.observations:
        if "hwp" not in observations.frames.colnames:
            parts.append(None)
            continue
        angle = np.mod(observations.position("hwp") + 1e-9, np.pi / 4)
        kinds = np.unique(np.round(angle, 4))[:8]
        parts.append((np.abs(angle - kinds[:, None]) < 1e-3).astype(float))
    detail = "what is equal at plate angles 45 deg apart (null channel), in the differences"
    return _Term("beam", detail, 0, _outer(parts, law, model.problem))


def _flux(problem):
    """Return the logarithm and the inverse of the flux, at each wavelength."""
    parts = []
    for channel, flux in zip(problem.channels, problem.fluxes, strict=True):
        level = np.asarray(flux).sum(axis=0) if flux is not None else np.exp(channel.observed[1])
        level = np.where(channel.valid, level, np.nan)
        level = np.nan_to_num(level / np.nanmedian(level), nan=1.0).clip(1e-6)
        parts.append(np.stack([np.log(level), 1 / level - 1]))
    return _Term("flux", "the flux, in the differences", 0, parts)


def _sequence(data, terms, null, alpha):
    """Take in patterns while they are significant; return one row a pattern, and the null's."""
    # normal equations once: taking a term in is then a sweep of a small matrix, no fit
    gram, target, slices = _normal_equations(data, [*terms, null])
    total, freedom, own = data.total, data.n_freedom, slices.pop()
    # the null channel holds other patterns and is no rival to them
    whole = _test(gram, target, own, total, freedom)
    taken, left = [], list(range(len(terms)))
    while left:
        tested = {i: _test(gram, target, slices[i], total, freedom) for i in left}
        best = _simplest(terms, tested, max(left, key=lambda i: tested[i].evidence))
        looks = false_discovery([tested[i].p_single for i in left])
        small = tested[best].excess < _LEAST_SHARE * data.scale
        if len(taken) == _MOST_TERMS or looks[left.index(best)] >= alpha or small:
            break
        one = tested[best]
        taken.append((terms[best], one))
        gram, target = _swept(gram, target, slices[best], one)
        total, freedom = total - one.statistic, freedom - one.rank
        left.remove(best)
    # what a few patterns explain is a better measure of a small gap than the sum of squares
    data.scale = max(data.scale, sum(one.excess for _, one in taken))
    left = [i for i in left if tested[i].rank]
    found = [(terms[left[k]], tested[left[k]]) for k in ranked([-tested[i].log_p for i in left])]
    rows = [_row(term, one, data.scale) for term, one in taken + found]
    return rows, _row(null, whole, data.scale) | {"kind": "place"}


def _simplest(terms, tested, best):
    """Return the simplest pattern of the plate angle that may be what a doubtful one shows."""
    if not terms[best].doubtful:
        return best
    axes = ("hwp", terms[best].axis)
    most = tested[best].evidence
    enough = min(_DOUBT * most, most)
    rivals = [
        i for i in tested if terms[i].axis in axes and terms[i].channel == terms[best].channel
    ]
    # in the order of their simplicity
    return min(i for i in rivals if tested[i].evidence >= enough)


def _normal_equations(data, terms):
    """
    Return Gram matrix and right side of the columns of all terms, less the tangent space.

    Whitening mixes neither datasets nor channels, so that the matrix is made
    block by block and the columns are never all there at once.
    """
    edges = np.cumsum([0] + [sum(len(p) for p in term.parts) for term in terms])
    slices = [slice(a, b) for a, b in pairwise(edges)]
    gram, target = np.zeros((edges[-1],) * 2), np.zeros(edges[-1])
    seen = np.zeros((data.tangent.shape[1], edges[-1]))
    for i, (rows, channel) in enumerate(zip(data.segments, data.problem.channels, strict=True)):
        for c in range(2):
            here, where = [], []
            for term, place in zip(terms, slices, strict=True):
                if term.channel == c and len(term.parts[i]):
                    start = place.start + sum(len(p) for p in term.parts[:i])
                    where.append(np.arange(start, start + len(term.parts[i])))
                    raw = term.columns(i, channel.shape) * channel.valid
                    here.append(_unit(channel, raw)[:, c].reshape(len(raw), -1))
            if not here:
                continue
            columns, where = np.concatenate(here), np.concatenate(where)
            own = np.arange(rows.start, rows.stop).reshape(channel.shape)[c].ravel()
            gram[np.ix_(where, where)] = columns @ columns.T
            target[where] = columns @ data.residual[own]
            seen[:, where] = data.tangent[own].T @ columns.T
    return gram - seen.T @ seen, target, slices


def _unit(channel, raw):
    """Whiten columns, and divide by the length that they had before the lamp was taken out."""
    weight = np.where(channel.valid, 1 / channel.sigma, 0.0)
    norm = np.sqrt(np.sum((raw * weight) ** 2, axis=(1, 2, 3), keepdims=True))
    return channel.whiten(raw / np.where(norm > 0, norm, 1.0))


@dataclass
class _Tested:
    statistic: float
    rank: int
    inverse_root: np.ndarray
    log_p: float
    evidence: float

    @property
    def p_single(self):
        return float(np.exp(self.log_p))

    @property
    def excess(self):
        return self.statistic - self.rank


def _test(gram, target, where, total, freedom):
    # columns had unit length before model and lamp were taken out: an eigenvalue is what is left
    # of it
    values, vectors = np.linalg.eigh(gram[where, where])
    keep = values > _ABSORBED
    root = vectors[:, keep] / np.sqrt(values[keep])
    statistic, rank = float(np.sum((root.T @ target[where]) ** 2)), int(keep.sum())
    if not rank or freedom <= rank:
        return _Tested(0.0, 0, root, 0.0, -np.inf)
    # what the others leave is no noise either where a gap is large
    scatter = max(1.0, (total - statistic) / (freedom - rank))
    log_p = stats.chi2.logsf(statistic / scatter, rank)
    evidence = statistic / scatter - rank * np.log(max(freedom, 2))
    return _Tested(statistic, rank, root, log_p, evidence)


def _swept(gram, target, where, tested):
    """Return the normal equations with one term taken out of all others."""
    along = gram[:, where] @ tested.inverse_root
    return gram - along @ along.T, target - along @ (tested.inverse_root.T @ target[where])


def _row(term, tested, scale):
    return {
        "axis": term.axis,
        "detail": term.detail,
        "kind": "pattern",
        "share": float(np.clip(tested.excess / scale, 0, 1)),
        "p_single": tested.p_single,
    }
