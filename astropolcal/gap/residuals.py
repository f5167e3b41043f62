# Licensed under a 3-clause BSD style license - see LICENSE
"""
Where the gap lies: in which wavelengths, angles, frames, beam and dataset.

The whitened residuals of a fitted model are noise of unit variance, less the directions that model
and lamp have absorbed. What exceeds that is divided in two ways. *Patterns* are functions of an
axis (a harmonic of an angle, a trend, a product of two), with a law in wavelength that is smooth
or, as a pair with the wavelength, free: they are taken in one after the other, the most telling
first, and each has the share that those before it have left. *Places* are sets of data (a range of
wavelengths, a derotator angle, a dataset) in which the residuals are larger than elsewhere, found
by a scan statistic (Kulldorff 1997, doi:10.1080/03610929708831995), and the null channel, which
holds several patterns.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.exceptions import GapError
from astropolcal.gap.attribution import false_discovery
from astropolcal.gap.problem import law_basis
from astropolcal.observations.grid import SAME_ANGLE, derotator_runs
from astropolcal.observations.pointings import frame_names

__all__ = []

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
# what double sums see: all that is the same a quarter of a turn further on
_NULL = ("beam", "what is equal at plate angles 45 deg apart (null channel)")
# harmonics in the order of who gives a name to what the angles cannot tell apart
_ORDERS = {
    "hwp": (0, 4, 2, 8, 1, 3, 5, 6, 7, 12),
    "derotator": (2, 4, 1),
    "altitude": (2, 4),
    "parallactic": (2, 4),
}
_PLATE = "harmonic {} of the half-wave-plate angle"
# condition number of a constant, harmonic 4 and another one, beyond which they are hardly told
_POOR = 10.0
_ORDER = "the order of frames within a block at one derotator angle"
_SAME_ORDER = "the plate angles come in the same order in every block"
_NOTE = "these angles hardly tell it from a constant and harmonic 4"
# chi-square tables drawn under the null; fewer than _RELIABLE beyond a value tell no probability
_DRAWS = 1000
_RELIABLE = 20
# runs grow as the square of the labels: 24 give 300 at the most
_MOST_BLOCKS = 24


def locate(model):
    """Return where the gap of a fitted model lies, a list of dict, the most telling patterns first.

    Keys are ``axis``, ``detail``, ``share`` of the excess over the noise, ``p_value``, corrected
    for the number of looks (Benjamini & Yekutieli 2001, doi:10.1214/aos/1013699998), and ``kind``,
    ``"pattern"`` or ``"place"``: of the looks that are significant and not minute.
    """
    keys = ("axis", "detail", "share", "p_value", "kind")
    told = [one for one in looks(model) if one["p_value"] < ALPHA and one["share"] > _LEAST_SHARE]
    return [{key: one[key] for key in keys} for one in told]


def looks(model):
    """Return all looks as `locate` gives those that count, with ``p_single`` of each alone."""
    data = _Whitened(model)
    patterns, null = _sequence(data, *_terms(model))
    found = [one for look in places(model) for one in most_uneven(data, *look)]
    rows = [*patterns, *sorted(found, key=lambda row: -row["evidence"]), null]
    corrected = false_discovery([row["p_single"] for row in rows])
    return [row | {"p_value": p} for row, p in zip(rows, corrected, strict=True)]


class _Whitened:
    """Whitened residuals, and the directions in which they are empty."""

    def __init__(self, model):
        problem = model.problem
        self.problem, self.segments = problem, problem.segments
        tangent = problem.tangent(model.fit.coefficients, model.jacobian)
        residual = model.residual
        # what is known of a mounting has no place among the frames
        seen = slice(0, self.segments[-1].stop)
        self.tangent = tangent[seen]
        self.residual = (residual - tangent @ (tangent.T @ residual))[seen]
        self.n_freedom = problem.n_data - self.tangent.shape[1]
        if self.n_freedom < 1:
            raise GapError(
                f"{problem.n_data} data and {self.tangent.shape[1]} fitted directions leave "
                "nothing to look for a gap in; more frames are needed"
            )
        self.total = float(self.residual @ self.residual)
        # a gap within the noise has no shares worth the name
        self.scale = max(self.total - self.n_freedom, np.sqrt(2 * self.n_freedom))

    def freedom(self, label, count):
        """Return the expected sum of squares of the rows of each label."""
        # leverage: the fit and the lamp take this share of the noise of each row
        taken = np.sum(self.tangent**2, axis=1)
        for segment, channel in zip(self.segments, self.problem.channels, strict=True):
            rows = np.arange(segment.start, segment.stop).reshape(channel.shape)[1].ravel()
            taken[rows] += np.sum(channel.nuisance**2, axis=1)
        valid = [np.broadcast_to(c.valid, c.shape).ravel() for c in self.problem.channels]
        return np.bincount(label, (1 - taken) * np.concatenate(valid), minlength=count)


# ---- patterns ------------------------------------------------------------------------------


@dataclass
class _Term:
    """A pattern of a channel: its columns of each dataset, arrays (k, W, F)."""

    axis: str
    detail: str
    channel: int
    parts: list
    doubtful: bool = False


def _terms(model):
    """Return all patterns, with a smooth and with a free law in wavelength."""
    problem = model.problem
    smooth = law_basis(problem.wavelength, _SMOOTH)
    # what is not smooth
    rough = np.linalg.svd(smooth)[0][:, smooth.shape[1] :]
    tables = [frame_patterns(o) for o in model.observations]
    nothing = [np.zeros((0, o.n_frames)) for o in model.observations]
    known = {
        key: [table.get(key, none) for table, none in zip(tables, nothing, strict=True)]
        for key in dict.fromkeys([_NULL, *(key for table in tables for key in table)])
    }
    columns = _outer(known.pop(_NULL), smooth, problem)
    null = _Term(_NULL[0], f"{_NULL[1]}, in the differences", 0, columns)
    notes, terms = badly_separated(model.observations), []
    sums = "intensities" if _is_single(problem) else "sums"
    for channel, name in enumerate(("differences", sums)):
        for (axis, words), parts in known.items():
            note = f" ({notes[words]})" if words in notes else ""
            columns = _outer(parts, smooth, problem)
            detail = f"{words}, in the {name}{note}"
            terms.append(_Term(axis, detail, channel, columns, bool(note)))
            if rough.shape[1] and " x " not in axis and not note:
                detail = f"{words}, sharp in wavelength, in the {name}"
                columns = _outer(parts, rough, problem)
                terms.append(_Term(f"wavelength x {axis}", detail, channel, columns))
    return [*terms, _flux(problem)], null


def _is_single(problem):
    """Return whether all datasets have one beam."""
    return all(channel.groups is not None for channel in problem.channels)


def _outer(parts, law, problem):
    """Return the products of a law and patterns, arrays (k, W, F)."""
    # a dataset may have some of the wavelengths only
    laws = [law[dataset.bins].T[:, None, :, None] for dataset in problem.datasets]
    return [np.concatenate(one * part[:, None]) for one, part in zip(laws, parts, strict=True)]


def _flux(problem):
    """Return the logarithm and the inverse of the flux, at each wavelength."""
    parts = []
    for channel, flux in zip(problem.channels, problem.fluxes, strict=True):
        level = np.where(channel.valid, flux.sum(axis=0), np.nan)
        level = np.nan_to_num(level / np.nanmedian(level), nan=1.0).clip(1e-6)
        parts.append(np.stack([np.log(level), 1 / level - 1]))
    return _Term("flux", "the flux, in the differences", 0, parts)


def _sequence(data, terms, null):
    """Take in patterns while they are significant; return one row a pattern, and the null's."""
    # normal equations once: taking a term in is then a sweep of small matrices, no fit
    equations = _Equations(data, [*terms, null])
    total, freedom = data.total, data.n_freedom
    # the null channel holds other patterns and is no rival to them
    whole = equations.test(-1, total, freedom)
    taken, left = [], list(range(len(terms)))
    while left:
        tested = {i: equations.test(i, total, freedom) for i in left}
        best = _simplest(terms, tested, max(left, key=lambda i: tested[i].evidence))
        rates = false_discovery([np.exp(tested[i].log_p) for i in left])
        small = tested[best].excess < _LEAST_SHARE * data.scale
        if len(taken) == _MOST_TERMS or rates[left.index(best)] >= ALPHA or small:
            break
        one = tested[best]
        taken.append((terms[best], one))
        equations.take(best, one.inverse_root)
        total, freedom = total - one.statistic, freedom - one.rank
        left.remove(best)
    # what a few patterns explain is a better measure of a small gap than the sum of squares
    data.scale = max(data.scale, sum(one.excess for _, one in taken))
    left = [i for i in left if tested[i].rank]
    found = [(terms[left[k]], tested[left[k]]) for k in ranked([-tested[i].log_p for i in left])]
    rows = [
        {
            "axis": term.axis,
            "detail": term.detail,
            "kind": "pattern",
            "share": float(np.clip(one.excess / data.scale, 0, 1)),
            "p_single": float(np.exp(one.log_p)),
        }
        for term, one in [*taken, *found, (null, whole)]
    ]
    return rows[:-1], rows[-1] | {"kind": "place"}


def _simplest(terms, tested, best):
    """Return the simplest pattern of the plate angle that may be what a doubtful one shows."""
    if not terms[best].doubtful:
        return best
    axes, channel = ("hwp", terms[best].axis), terms[best].channel
    most = tested[best].evidence
    enough = min(_DOUBT * most, most)
    # in the order of their simplicity
    return min(
        i
        for i, one in tested.items()
        if terms[i].axis in axes and terms[i].channel == channel and one.evidence >= enough
    )


class _Equations:
    """Normal equations of the columns of terms, less the tangent space, and less terms taken in.

    The Gram matrix of all of them is never made: each term has that of its own columns, and what
    two have in common is worked out where one of them is taken in. Whitening mixes neither datasets
    nor channels, so that the columns are never all there at once either.
    """

    def __init__(self, data, terms):
        self.data, self.terms, self._along = data, terms, []
        edges = np.cumsum([0] + [sum(len(p) for p in term.parts) for term in terms])
        self.slices = [slice(*pair) for pair in pairwise(edges)]
        self.target = np.zeros(edges[-1])
        self._seen = np.zeros((data.tangent.shape[1], edges[-1]))
        self.own = [np.zeros((n, n)) for n in np.diff(edges)]
        for k, _, where, rows, columns in self._columns():
            start = self.slices[k].start
            inside = slice(where.start - start, where.stop - start)
            self.own[k][inside, inside] = columns @ columns.T
            self.target[where] = columns @ data.residual[rows]
            self._seen[:, where] = data.tangent[rows].T @ columns.T
        self._less(self._seen.T)

    def _columns(self, like=None):
        """Yield number, dataset, place, rows and columns of each part of a term, as of one term."""
        places = zip(self.data.segments, self.data.problem.channels, strict=True)
        for i, (rows, channel) in enumerate(places):
            size = channel.shape[1] * channel.shape[2]
            for k, term in enumerate(self.terms):
                c, n = term.channel, len(term.parts[i])
                if n and (like is None or c == like.channel):
                    start = self.slices[k].start + sum(len(part) for part in term.parts[:i])
                    own = slice(rows.start + c * size, rows.start + (c + 1) * size)
                    yield k, i, slice(start, start + n), own, _unit(channel, c, term.parts[i])

    def _less(self, along):
        """Take directions, (n_columns, n), out of the Gram matrix of each term."""
        for gram, where in zip(self.own, self.slices, strict=True):
            gram -= along[where] @ along[where].T

    def test(self, k, total, freedom):
        """Return the test of a term."""
        # columns had unit length before model and lamp were taken out: an eigenvalue is what is
        # left of it
        values, vectors = np.linalg.eigh(self.own[k])
        keep = values > _ABSORBED
        root = vectors[:, keep] / np.sqrt(values[keep])
        statistic = float(np.sum((root.T @ self.target[self.slices[k]]) ** 2))
        rank = int(keep.sum())
        if not rank or freedom <= rank:
            return _Tested(0.0, 0, root, 0.0, -np.inf)
        # what the others leave is no noise either where a gap is large
        scatter = max(1.0, (total - statistic) / (freedom - rank))
        # far out the chance is no number any more
        with np.errstate(divide="ignore"):
            log_p = np.log(chi2_above(statistic / scatter, rank))
        evidence = statistic / scatter - rank * np.log(max(freedom, 2))
        return _Tested(statistic, rank, root, log_p, evidence)

    def take(self, k, root):
        """Take a term in: the equations of the others beside it; ``root`` whitens its columns."""
        term, own = self.terms[k], self.slices[k]
        pairs = enumerate(zip(term.parts, self.data.problem.channels, strict=True))
        mine = {i: _unit(c, term.channel, part) for i, (part, c) in pairs if len(part)}
        along = np.zeros((len(self.target), own.stop - own.start))
        edges = np.cumsum([0] + [len(part) for part in term.parts])
        for _, i, where, _, columns in self._columns(term):
            if i in mine:
                along[where, edges[i] : edges[i + 1]] = columns @ mine[i].T
        for before in (self._seen.T, *self._along):
            along -= before @ before[own].T
        self._along.append(along @ root)
        self.target = self.target - self._along[-1] @ (root.T @ self.target[own])
        self._less(self._along[-1])


def _unit(channel, c, part):
    """Whiten columns of a channel, over the length that they had with the lamp in them, (k, n)."""
    raw = np.zeros((len(part), *channel.shape))
    raw[:, c] = part * channel.valid
    weight = np.where(channel.valid, 1 / channel.sigma[c], 0.0)
    norm = np.sqrt(np.sum((raw[:, c] * weight) ** 2, axis=(1, 2)))
    raw /= np.where(norm > 0, norm, 1.0)[:, None, None, None]
    return channel.whiten(raw)[:, c].reshape(len(raw), -1)


@dataclass
class _Tested:
    statistic: float
    rank: int
    inverse_root: np.ndarray
    log_p: float
    evidence: float

    @property
    def excess(self):
        return self.statistic - self.rank


def frame_patterns(observations):
    """
    Return functions of the frame, (k, F), by axis and words.

    What the angles taken cannot tell from an earlier pattern is left out.
    """
    found, known = {}, observations.frame_columns
    for axis, orders in _ORDERS.items():
        if axis in known:
            found |= _harmonics(observations.position(axis), axis, orders)
    single = list(found.items())
    second, fourth = ("hwp", _PLATE.format(2)), ("hwp", _PLATE.format(4))
    for plate in (second, fourth):
        for (axis, words), other in single:
            if plate in found and axis != "hwp" and "harmonic 1 " not in words:
                both = (found[plate][:, None] * other[None]).reshape(-1, other.shape[1])
                found[f"hwp x {axis}", f"{plate[1]} times {words}"] = both
    time = 2 * observations.position("sequence") - 1
    found["time", "a trend through the run"] = _legendre(time)
    if fourth in found:
        found["time x hwp", f"{fourth[1]} with a trend through the run"] = found[fourth] * time
    if "hwp" in known:
        angle = np.mod(observations.position("hwp") + 1e-9, np.pi / 4)
        kinds = np.unique(np.round(angle, 4))[:8]
        found[_NULL] = (np.abs(angle - kinds[:, None]) < 1e-3).astype(float)
    place, size = _within_blocks(observations)
    if size.max() >= 3:
        found["time", _ORDER] = _legendre(2 * place / np.maximum(size - 1, 1) - 1) * (size > 1)
    return {
        key: columns
        for key, columns in found.items()
        if np.ptp(columns, axis=1).any() or key[1].startswith("what is")
    }


def _harmonics(angle, axis, orders):
    """Return the harmonics of an angle that differ from one another where it was sampled."""
    found, title = {}, "half-wave-plate" if axis == "hwp" else axis
    spans = [np.ones((1, angle.size))]
    for k in orders:
        columns = np.array([wave for wave in _waves(angle, k) if np.abs(wave).max() > 1e-6])
        # the simpler name was given already: at steps of 22.5 deg harmonic 12 is harmonic 4
        left = [columns - columns @ np.linalg.pinv(other) @ other for other in spans if k]
        if any(np.abs(one).max() < 1e-6 for one in left):
            continue
        what = f"harmonic {k} of the" if k else "what is constant in the"
        found[axis, f"{what} {title} angle"] = columns
        spans.append(columns)
    return found


def _waves(angle, k):
    return [np.cos(k * angle), np.sin(k * angle)] if k else [np.ones_like(angle)]


def _legendre(values):
    return np.polynomial.legendre.legvander(values, 2)[:, 1:].T


def badly_separated(observations):
    """Return the patterns that the plate angles taken separate badly from simpler ones, and a note.

    Harmonics whose condition number together with a constant and harmonic 4 is large, and the order
    of frames where the angles always come in the same one. The dataset with the better angles
    counts.
    """
    found, mine = {}, [o for o in observations if "hwp" in o.frame_columns]
    angles = [o.position("hwp") for o in mine]
    for k in _ORDERS["hwp"][2:] if mine else ():
        waves = [np.concatenate([_waves(angle, n) for n in (0, 4, k)]) for angle in angles]
        if min(map(np.linalg.cond, waves)) > _POOR:
            found[_PLATE.format(k)] = _NOTE
    if mine and all(map(_same_order, mine)):
        found[_ORDER] = _SAME_ORDER
    return found


def _same_order(observations):
    """Whether the place of a frame in its block tells the plate angle."""
    angle, place = observations.position("hwp"), _within_blocks(observations)[0]
    first = angle[np.unique(place, return_index=True)[1]]
    # the sine, for a plate turned by half a turn is the same plate
    return bool(np.all(np.abs(np.sin(angle - first[place])) < SAME_ANGLE))


def frame_blocks(observations):
    """Return the number of the run of frames at one derotator angle of each frame, (F,), from 0."""
    if "derotator" not in observations.frame_columns:
        return np.arange(observations.n_frames)
    return derotator_runs(observations)


def _within_blocks(observations):
    """Return the place of each frame in its block, from 0, and the size of the block, (F,) each."""
    blocks = frame_blocks(observations)
    place = np.arange(blocks.size) - np.searchsorted(blocks, blocks)
    return place, np.bincount(blocks)[blocks]


# ---- places --------------------------------------------------------------------------------


def places(model):
    """Yield axis, label of every row, names of intervals of labels, and whether these are runs."""
    problem, observations = model.problem, model.observations

    def labels(values):
        shaped = zip(values, problem.channels, strict=True)
        return np.concatenate([np.broadcast_to(v, c.shape).ravel() for v, c in shaped])

    nm = np.round(1000 * problem.wavelength).astype(int)
    order = np.argsort(nm)
    rank = np.argsort(order)
    label = labels([rank[d.bins][:, None] for d in problem.datasets])
    yield "wavelength", label, nm[order], "{} nm"
    if len(observations) > 1:
        names = [f'dataset "{o.name}"' for o in observations]
        yield "dataset", labels(range(len(names))), names, None
    beams = ["the differences of the beams", "the sums of the beams"]
    if not _is_single(problem):
        yield "beam", labels([np.arange(2)[:, None, None]] * len(observations)), beams, None
    if all("derotator" in o.frame_columns for o in observations):
        turned = [np.round(o.position("derotator") / SAME_ANGLE) for o in observations]
        kinds = np.unique(np.concatenate(turned))
        if 2 < len(kinds) <= _MOST_BLOCKS:
            angles = [f"{a:g}" for a in np.round(np.rad2deg(kinds * SAME_ANGLE), 1)]
            label = labels([np.searchsorted(kinds, one) for one in turned])
            yield "derotator", label, angles, "derotator at {} deg"
    n = observations[0].n_frames
    if n > 5 and len(observations) == 1:
        blocks = frame_blocks(observations[0])
        count = blocks[-1] + 1
        edges = np.searchsorted(blocks, np.arange(count + 1))
        if not 2 < count <= _MOST_BLOCKS:
            edges = np.linspace(0, n, min(_MOST_BLOCKS, n // 2) + 1).astype(int)
        label = labels([np.searchsorted(edges, np.arange(n), "right") - 1])
        names = frame_names(observations[0].frames)
        yield "time", label, [(names[a], names[b - 1]) for a, b in pairwise(edges)], "frames"


def most_uneven(data, axis, label, names, template):
    """Return the set of neighbouring labels in which the residuals exceed the others most."""
    count = len(names)
    if count < 2:
        return []
    squares = np.bincount(label, data.residual**2, minlength=count)
    freedom = np.maximum(data.freedom(label, count), 1e-9)
    # a run of more than half is rather the rest that is too quiet
    longest = 1 if template is None else max(count // 2, 1)
    pairs = [(a, b) for a in range(count) for b in range(a + 1, min(a + longest, count) + 1)]
    ratio = _unevenness(squares[None], freedom, pairs)[0]
    best = int(np.argmax(ratio))
    # the same draws for the same number of looks, so that a diagnosis can be repeated
    draws = np.random.default_rng(len(pairs)).chisquare(freedom, (_DRAWS, count))
    more = int(np.sum(_unevenness(draws, freedom, pairs).max(axis=1) >= ratio[best]))
    # never zero: the observed table counts as one of the draws
    p = (more + 1) / (_DRAWS + 1)
    if more < _RELIABLE:
        # too few draws reach that far: Bonferroni's bound
        p = min(p if more else 1.0, len(pairs) * chi2_above(2 * ratio[best], 1) / 2)
    start, stop = pairs[best]
    share = (squares[start:stop].sum() - freedom[start:stop].sum()) / data.scale
    detail = _name(names, start, stop, template)
    row = {"axis": axis, "detail": detail, "kind": "place", "share": float(np.clip(share, 0, 1))}
    return [row | {"p_single": float(min(p, 1.0)), "evidence": ratio[best]}]


def _unevenness(squares, freedom, pairs):
    """Return the log likelihood ratio of a larger variance inside each interval."""
    start, stop = np.array(pairs).T
    # sums over runs as differences of cumulative sums, shape (n_draws, n_pairs)
    sums = np.pad(np.cumsum(squares, axis=1), ((0, 0), (1, 0)))
    edges = np.pad(np.cumsum(freedom), (1, 0))
    inside, n_in = sums[:, stop] - sums[:, start], edges[stop] - edges[start]
    whole, n, tiny = sums[:, -1:], freedom.sum(), 1e-300
    outside, n_out = whole - inside, n - n_in
    ratio = 0.5 * (
        n * np.log(np.maximum(whole, tiny) / n)
        - n_in * np.log(np.maximum(inside, tiny) / n_in)
        - n_out * np.log(np.maximum(outside, tiny) / n_out)
    )
    return np.where(inside / n_in > outside / n_out, ratio, 0.0)


def _name(names, start, stop, template):
    first, last = names[start], names[stop - 1]
    if template is None:
        return str(first)
    if template == "frames":
        return f"frames {first[0]}-{last[1]}"
    return template.format(first if stop - start == 1 else f"{first}-{last}")
