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

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import stats

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.exceptions import GapError
from astropolcal.gap.attribution import false_discovery
from astropolcal.gap.channels import CHANNELS
from astropolcal.gap.problem import law_basis

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
_OF = {"difference": "differences", "sum": "sums"}
# harmonics in the order of who gives a name to what the angles cannot tell apart
_PLATE = (0, 4, 2, 8, 1, 3, 5, 6, 7, 12)
_DEROTATOR = (2, 4, 1)
# condition number of a constant, harmonic 4 and another one, beyond which they are hardly told
_POOR = 10.0
_ORDER = "the order of frames within a block at one derotator angle"
_SAME_ORDER = "the plate angles come in the same order in every block"
_NOTE = "these angles hardly tell it from a constant and harmonic 4"
#: Angles closer than this (radian) are the same.
SAME_ANGLE = np.deg2rad(0.5)
# chi-square tables drawn under the null; fewer than _RELIABLE beyond a value tell no probability
_DRAWS = 1000
_RELIABLE = 20
# runs grow as the square of the labels: 24 give 300 at the most
_MOST_BLOCKS = 24


def locate(model):
    """
    Return where the gap of a fitted model lies, a list of dict, the most telling patterns first.

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
        tangent, residual = problem.tangent(model.fit.coefficients), model.residual
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


def _sequence(data, terms, null):
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
        rates = false_discovery([tested[i].p_single for i in left])
        small = tested[best].excess < _LEAST_SHARE * data.scale
        if len(taken) == _MOST_TERMS or rates[left.index(best)] >= ALPHA or small:
            break
        one = tested[best]
        taken.append((terms[best], one))
        # the normal equations of the others beside it
        along = gram[:, slices[best]] @ one.inverse_root
        target = target - along @ (one.inverse_root.T @ target[slices[best]])
        gram = gram - along @ along.T
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


def _row(term, tested, scale):
    return {
        "axis": term.axis,
        "detail": term.detail,
        "kind": "pattern",
        "share": float(np.clip(tested.excess / scale, 0, 1)),
        "p_single": tested.p_single,
    }


def frame_patterns(observations):
    """
    Return functions of the frame, (k, F), by axis and words.

    What the angles taken cannot tell from an earlier pattern is left out.
    """
    found, known = {}, observations.frames.colnames
    if "hwp" in known:
        found |= _harmonics(observations.position("hwp"), "hwp", "half-wave-plate", _PLATE)
    if "derotator" in known:
        angle = observations.position("derotator")
        found |= _harmonics(angle, "derotator", "derotator", _DEROTATOR)
    for name in ("altitude", "parallactic"):
        if name in known:
            found |= _harmonics(observations.position(name), name, name, (2, 4))
    found |= _products(found)
    time = 2 * observations.position("sequence") - 1
    found["time", "a trend through the run"] = _legendre(time)
    plate4 = found.get(("hwp", "harmonic 4 of the half-wave-plate angle"))
    if plate4 is not None:
        words = "harmonic 4 of the half-wave-plate angle with a trend through the run"
        found["time x hwp", words] = plate4 * time
    order = _order(observations)
    if order is not None:
        found["time", _ORDER] = order
    return {
        key: columns
        for key, columns in found.items()
        if np.ptp(columns, axis=1).any() or key[1].startswith("what is constant")
    }


def _harmonics(angle, axis, title, orders):
    """Return the harmonics of an angle that differ from one another where it was sampled."""
    found, spans = {}, []
    for k in orders:
        waves = [np.cos(k * angle), np.sin(k * angle)] if k else [np.ones_like(angle)]
        columns = np.array([w for w in waves if np.abs(w).max() > 1e-6])
        # the simpler name was given already: at steps of 22.5 deg harmonic 12 is harmonic 4
        if k and _within(columns, spans, angle.size):
            continue
        words = (
            f"harmonic {k} of the {title} angle" if k else f"what is constant in the {title} angle"
        )
        found[axis, words] = columns
        spans.append(columns)
    return found


def _within(columns, spans, n):
    """Whether all columns are constant or lie in the span of one of the others."""
    for other in [np.ones((1, n)), *spans]:
        left = columns - columns @ np.linalg.pinv(other) @ other
        if np.abs(left).max() < 1e-6:
            return True
    return False


def badly_separated(observations):
    """
    Return the patterns that the plate angles taken separate badly from simpler ones, and a note.

    Harmonics whose condition number together with a constant and harmonic 4 is large, and the order
    of frames where the angles always come in the same one. The dataset with the better angles
    counts.
    """
    angles = [o.position("hwp") for o in observations if "hwp" in o.frames.colnames]
    found = {}
    for k in _PLATE[2:] if angles else ():
        poor = min(_condition(angle, (0, 4, k)) for angle in angles)
        if poor > _POOR:
            found[f"harmonic {k} of the half-wave-plate angle"] = _NOTE
    if angles and all(map(_same_order, observations)):
        found[_ORDER] = _SAME_ORDER
    return found


def _same_order(observations):
    """Whether the place of a frame in its block tells the plate angle."""
    if "hwp" not in observations.frames.colnames:
        return True
    angle, place = observations.position("hwp"), _places(observations)
    first = np.array([angle[place == p][0] for p in range(place.max() + 1)])
    # the sine, for a plate turned by half a turn is the same plate
    return bool(np.all(np.abs(np.sin(angle - first[place])) < SAME_ANGLE))


def _condition(angle, orders):
    columns = [part(k * angle) for k in sorted(orders) if k for part in (np.cos, np.sin)]
    singular = np.linalg.svd(np.array([np.ones_like(angle), *columns]), compute_uv=False)
    return singular[0] / max(singular[-1], 1e-12 * singular[0])


def _products(found):
    """Return the products of the harmonics of two angles."""
    out = {}
    for k in (2, 4):
        one = next((v for (a, w), v in found.items() if a == "hwp" and f"ic {k} " in w), None)
        for (axis, words), other in found.items():
            if one is None or axis == "hwp" or "harmonic 1 " in words:
                continue
            both = (one[:, None] * other[None]).reshape(-1, one.shape[1])
            title = f"harmonic {k} of the half-wave-plate angle times {words}"
            out[f"hwp x {axis}", title] = both
    return out


def _legendre(values):
    return np.polynomial.legendre.legvander(values, 2)[:, 1:].T


def _order(observations):
    """Return the place of each frame in its block, None if blocks are single frames."""
    blocks = frame_blocks(observations)
    size = np.bincount(blocks)[blocks]
    if size.max() < 3:
        return None
    place = _places(observations)
    return _legendre(2 * place / np.maximum(size - 1, 1) - 1) * (size > 1)


def _places(observations):
    """Return the place of each frame in its block, from 0."""
    blocks = frame_blocks(observations)
    return np.arange(blocks.size) - np.searchsorted(blocks, blocks)


def frame_blocks(observations):
    """Return the number of the run of frames at one derotator angle of each frame, (F,), from 0."""
    if "derotator" not in observations.frames.colnames:
        return np.arange(observations.n_frames)
    # the first frame begins a run but is no step
    step = np.abs(np.diff(observations.position("derotator"), prepend=np.nan)) > SAME_ANGLE
    step[0] = False
    return np.cumsum(step)


def places(model):
    """Yield axis, label of every row, names of intervals of labels, and whether these are runs."""
    problem = model.problem
    nm = np.round(1000 * problem.wavelength).astype(int)
    order = np.argsort(nm)
    yield (
        "wavelength",
        _labels(problem, lambda d, s: _on(np.argsort(order)[d.bins], s, 0)),
        nm[order],
        "{} nm",
    )
    if len(problem.datasets) > 1:
        names = [f'dataset "{o.name}"' for o in model.observations]
        numbers = iter(range(len(names)))
        label = _labels(problem, lambda d, s: np.full(s, next(numbers)))
        yield "dataset", label, names, None
    beams = ["the differences of the beams", "the sums of the beams"]
    yield (
        "beam",
        _labels(problem, lambda d, s: np.arange(2)[:, None, None] + np.zeros(s, int)),
        beams,
        None,
    )
    if all("derotator" in o.frames.colnames for o in model.observations):
        every = np.concatenate([o.position("derotator") for o in model.observations])
        kinds = np.unique(np.round(every / SAME_ANGLE))
        if 2 < len(kinds) <= _MOST_BLOCKS:
            label = _labels(problem, lambda d, s: _on(_angle_number(d.observations, kinds), s, 1))
            angles = [f"{a:g}" for a in np.round(np.rad2deg(kinds * SAME_ANGLE), 1)]
            yield "derotator", label, angles, "derotator at {} deg"
    shortest = min(o.n_frames for o in model.observations)
    if shortest > 5 and len(model.observations) == 1:
        edges = _time_edges(model.observations[0])
        label = _labels(
            problem, lambda o, s: _on(np.searchsorted(edges, np.arange(s[2]), "right") - 1, s, 1)
        )
        yield ("time", label, [(a, b - 1) for a, b in pairwise(edges)], "frames")


def _labels(problem, rule):
    return np.concatenate(
        [
            np.asarray(rule(d, c.shape)).ravel()
            for d, c in zip(problem.datasets, problem.channels, strict=True)
        ]
    )


def _on(values, shape, axis):
    """Return a function of wavelength (0) or frame (1), on the shape of both channels."""
    values = values[:, None] if axis == 0 else values[None]
    return np.broadcast_to(values, shape)


def _angle_number(observations, kinds):
    rounded = np.round(observations.position("derotator") / SAME_ANGLE)
    return np.searchsorted(kinds, rounded)


def _time_edges(observations):
    """Return the first frames of the blocks that are looked at together, and the end."""
    blocks = frame_blocks(observations)
    count, n = blocks.max() + 1, blocks.size
    if 2 < count <= _MOST_BLOCKS:
        return np.append(np.searchsorted(blocks, np.unique(blocks)), n)
    return np.unique(np.linspace(0, n, min(_MOST_BLOCKS, n // 2) + 1).astype(int))


def most_uneven(data, axis, label, names, template):
    """Return the set of neighbouring labels in which the residuals exceed the others most."""
    count = len(names)
    if count < 2:
        return []
    squares = np.bincount(label, data.residual**2, minlength=count)
    freedom = np.maximum(data.freedom(label, count), 1e-9)
    runs = template is not None
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count + 1)]
    # a run of more than half is rather the rest that is too quiet
    pairs = [(a, b) for a, b in pairs if b - a <= max(count // 2, 1) and (runs or b - a == 1)]
    ratio = _unevenness(squares[None], freedom, pairs)[0]
    best = int(np.argmax(ratio))
    # the same draws for the same number of looks, so that a diagnosis can be repeated
    draws = np.random.default_rng(len(pairs)).chisquare(freedom, (_DRAWS, count))
    more = int(np.sum(_unevenness(draws, freedom, pairs).max(axis=1) >= ratio[best]))
    # never zero: the observed table counts as one of the draws
    p = (more + 1) / (_DRAWS + 1)
    if more < _RELIABLE:
        # too few draws reach that far: Bonferroni's bound
        p = min(p if more else 1.0, len(pairs) * stats.chi2.sf(2 * ratio[best], 1) / 2)
    start, stop = pairs[best]
    share = (squares[start:stop].sum() - freedom[start:stop].sum()) / data.scale
    detail = _name(names, start, stop, template)
    row = {"axis": axis, "detail": detail, "kind": "place", "share": float(np.clip(share, 0, 1))}
    return [row | {"p_single": float(min(p, 1.0)), "evidence": ratio[best]}]


def _unevenness(squares, freedom, pairs):
    """Return the log likelihood ratio of a larger variance inside each interval."""
    total, start, stop = freedom.sum(), *np.array(pairs).T
    sums = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    # sums over runs as differences of cumulative sums, shape (n_draws, n_pairs)
    edges = np.concatenate([[0], np.cumsum(freedom)])
    inside, n_in = sums[:, stop] - sums[:, start], edges[stop] - edges[start]
    outside, n_out = sums[:, -1:] - inside, total - n_in
    tiny = 1e-300
    ratio = 0.5 * (
        total * np.log(np.maximum(sums[:, -1:], tiny) / total)
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
