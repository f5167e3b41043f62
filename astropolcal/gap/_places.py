# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sets of data in which the residuals are larger than elsewhere.

A scan statistic over runs of wavelengths, derotator angles, frames, over beams and
datasets (Kulldorff 1997, doi:10.1080/03610929708831995).
"""

from itertools import pairwise

import numpy as np
from scipy import stats

from astropolcal.gap.patterns import SAME_ANGLE, frame_blocks

# chi-square tables drawn under the null; fewer than _RELIABLE beyond a value tell no probability
_DRAWS = 1000
_RELIABLE = 20
# runs grow as the square of the labels: 24 give 300 at the most
_MOST_BLOCKS = 24


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
        yield (
            "time",
            label,
            [(a, b - 1) for a, b in pairwise(edges)],
            "frames",
        )


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
