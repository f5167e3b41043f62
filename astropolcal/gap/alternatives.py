# Licensed under a 3-clause BSD style license - see LICENSE
"""
Alternatives to a nominal model: another sign or reflection, exchanged beams, angles of other rows.

They have no size, and are tried one after the other where the double differences are far off: in
all of the data, in one of several tables, and in a part of a run that the model does not fit.
"""

import warnings
from contextlib import suppress
from functools import partial

import numpy as np

from astropolcal.calibration import Calibration
from astropolcal.calibration.fit.branches import BinProblem, search_branches
from astropolcal.calibration.fit.strategies import few_frames
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.calibration.noise.estimates import rms
from astropolcal.calibration.noise.weighting import first_weighting
from astropolcal.calibration.result.verdict import NO_SPLITTER
from astropolcal.calibration.system import at_wavelengths
from astropolcal.chain import join, leaves
from astropolcal.exceptions import AstropolcalWarning, GapError, ObservationError
from astropolcal.gap.effects import Context, adapted
from astropolcal.gap.effects._laws import Misread
from astropolcal.gap.model import Model, nominal_calibration, nominal_model
from astropolcal.gap.problem import Fit, GapProblem
from astropolcal.measurement import Measurement
from astropolcal.measurement.datasets import check_chains
from astropolcal.observations.pointings import frame_names
from astropolcal.observations.reading import bins_on_grid, common_wavelengths, nearest_bins
from astropolcal.optics import WollastonPrism

__all__ = []

# alternatives are tried where double differences are off by more than this
_WRONG_SIGN = 0.01
# or by more than this share of the signal and so many times the noise, as those of stars are
_WRONG_SHARE, _ABOVE_NOISE = 0.1, 3.0
# an alternative must lower the residuals to this share, and those within a tenth are aliases
_FAR_BETTER, _ALIKE = 0.5, 1.1
# one that leaves more than this share is no answer before the others were tried
_SETTLED = 0.25
# a wrong sign is in most data: what leaves in this share of them less than that share of the misfit
# is wrong in a few frames
_MOST_DATA, _SHOWS = 0.95, 0.5
# the part of a run that a model fits is at least one in so many of the frames, and its misfit at
# most such a share of that of the whole; with so many frames more it is twice that
_LEAST_PART, _FITS, _SUDDEN = 4, 0.1, 4
# fits of what gives the same data end with misfits that differ by a smaller share
_EQUAL = 1e-3
_FEW = 3
# what alternatives leave is told after so many searches and steps: further ones lower it by less
# than a quarter, mostly; and what leaves so many times as much as counts after the first is not
# searched again
_SEARCHES, _STEPS, _HOPELESS = 2, 15, 1.5


def starting_model(calibration, observations, library, say):
    """Return the nominal model, that of the discrete alternative that beats it, and which this is.

    Where none does, the second is the nominal model again and the third an empty list; else the
    alternative is followed by its aliases. The fourth says up to or from which frame the model does
    not fit, though it fits all others, where that is so.
    """
    chains = chains_of(calibration, observations)
    chains = [_at_data(chain, observations) for chain in _set_apart(chains)]
    # of a calibration too: in other data a wavelength may be in another branch
    made, where = nominal_calibration(chains, observations), ""
    if _may_be_wrong(made):
        discrete = [e for e in adapted(library, chains) if e.kind == "discrete"]
        found, read, where = _alternatives(chains, observations, made, discrete, say)
        best = _best_alternative(*read, found, say)
        if best is not None:
            best, asked, effects = best
            effects[0] = effects[0].changed(left=_left(best, read[-1]))
            model = nominal_model(*asked, best)
            # what fits badly need not converge to be left behind
            problem = GapProblem(read[-1].chains, asked[1], like=model.problem)
            residual = problem.residual(problem.start)
            nominal = Model(problem, Fit(problem.start, float(residual @ residual), False))
            model.added[effects[0].name] = []
            return nominal, model, effects, where
    nominal = nominal_model(chains, observations, made)
    return nominal, nominal, [], where


def chains_of(calibration, observations):
    """Return the chain of each dataset, of a calibration, one for all, or given."""
    chains = calibration.chains if isinstance(calibration, Calibration) else calibration
    chains = list(chains) if isinstance(chains, (list, tuple)) else [chains] * len(observations)
    check_chains("calibration", chains, "a calibration, such as Calibration.read(file) gives, or ")
    if len(chains) != len(observations):
        raise GapError(f"{len(chains)} chains for {len(observations)} datasets")
    return chains


def _at_data(chain, observations):
    """Return a chain at the wavelengths of all datasets, where it has values at more."""
    grid, optics = common_wavelengths(observations), leaves(chain)
    known = (getattr(leaf, key).grid for leaf in optics for key in leaf.param_names)
    own = next((one for one in known if one is not None), grid)
    rows, off = nearest_bins(grid, own)
    if off.any() or len(own) == len(grid):
        return chain
    return at_wavelengths(chain, np.eye(len(own))[rows], len(own))


def _alternatives(chains, observations, made, discrete, say):
    """Return misfit and effect of discrete alternatives, best first.

    With them, the chains, datasets and calibration of which they are alternatives, and the name of
    the part of a dataset that does not fit, see `_parts`.
    """
    misfit, asked, where = _misfit(made), (chains, observations, made), ""
    enough, least = _SETTLED * misfit, _ABOVE_NOISE * _usual(made, "sigma")
    stages = {"enough": enough, "least": least if np.isfinite(least) else enough}
    stages["most"] = _FAR_BETTER * misfit
    found = _by_stages(chains, observations, discrete, say, **stages)
    settled = bool(found) and found[0][0] <= enough
    if not settled:
        # or in a part of the run: there is a frame too many, or one was lost
        some = [e for e in discrete if e.may_be_in_part]
        inside, parts, where = _in_part(chains, observations, misfit, some, say)
        if inside:
            return inside, (*parts, nominal_calibration(*parts)), where
    if len(observations) > 1 and (not settled or isinstance(found[0][1], Misread)):
        # all but one of the tables may be right
        some = [found[0][1]] if settled else [e for e in discrete if e.may_be_in_part]
        apart = [e.in_run(o.name) for e in some for o in observations]
        found += _by_stages(chains, observations, apart, say, **stages)
        found.sort(key=lambda one: one[0])
    return found, asked, where


def _by_stages(chains, observations, effects, say, enough, least, most):
    """Return misfit and effect of alternatives, best first; rarer ones if others are above a least.

    One that leaves no more than is enough gives way only to what is far better; what leaves more
    than the most does not count.
    """
    # tables are seldom misread, and more seldom by several frames
    misread = [e for e in effects if isinstance(e, Misread)]
    found, signs = [], [e for e in effects if e not in misread]
    for some in (signs, misread, [way for e in misread for way in e.farther()]):
        before = found[0][0] if found else np.inf
        if not before <= least:
            more = _tried(chains, observations, some, say, found, most)
            gives_way = before > enough or more[0][0] < _FAR_BETTER * before
            found = more if gives_way else found
    return found


def _in_part(chains, observations, misfit, effects, say):
    """Return misfit and effect of alternatives in a part of a run that does not fit, best first.

    With them, chains and datasets, one of these in two parts, and the name of that which does not
    fit. Without such a part they are as they were, and the name is empty.
    """
    most = _SETTLED * misfit

    def tried(effects, *edge):
        *parts, where = _split(chains, observations, *edge)
        apart = [e.in_run(where) for e in effects]
        found = _by_stages(*parts, apart, say, most, most, most)
        return [one for one in found if one[0] < most], parts, where

    say("where the model begins to fail")
    edge = _edge(chains, observations, misfit)
    if edge is None:
        return [], (chains, observations), ""
    found, parts, where = tried(effects, *edge)
    if found:
        i, order, words, good = edge
        best = nominal_calibration(*_read(found[0][1], *parts))
        # in double differences a frame without a partner is not seen, and few of many are no misfit
        new, sure = _nearer(best.chains[i : i + 2], observations[i], order, words)
        # a part of another length, or of other frames; none, or all of them, are no part
        moved = 0 < sure < len(order) and (sure != good or np.any(new != order))
        names = {one.name.partition("/")[0] for _, one in found}
        some = [e for e in effects if e.name in names]
        again = tried(some, i, new, words, sure) if moved else ([],)
        found, parts, where = again if again[0] else (found, parts, where)
    return found, parts, where


def _edge(chains, observations, misfit):
    """Return which dataset fits in part, the order of its frames, and how many of them do.

    These are the most that the model fits with all other datasets, from the first frame on or up to
    the last, or both together. Before their number is where the others are, in words. None without
    such frames.
    """
    few_chains, few = thinned(chains, observations, _FEW)
    for i, whole in enumerate(observations):
        forward = np.argsort(whole.position("sequence"), kind="stable")
        share = partial(_share_left, few_chains, few, i, misfit)
        found = [
            (i, order, words, _fitting(share, order))
            for order, words in ((forward, "from"), (forward[::-1], "up to"))
        ]
        start, stop = found[0][-1], len(forward) - found[1][-1]
        # all frames have a partner in their part, or it is none
        for more in range(_SUDDEN) if 0 < start < stop < len(forward) else ():
            order, good = _around(forward, start - more, stop + more)
            parts = _split(few_chains, few, i, order, "in", good)
            if np.isfinite(_tried_misfit(*parts[:2])) and share(order[:good]) <= _FITS:
                return i, order, "in", good
        found = [edge for edge in found if edge[-1] < len(forward)]
        if found:
            return max(found, key=lambda edge: edge[-1])
    return None


def _split(chains, observations, i, order, words, good):
    """Return chains and datasets, one of these in two parts, and the name of the second part."""
    whole = observations[i]
    parts = [whole.select(np.sort(part)) for part in (order[:good], order[good:])]
    names = frame_names(whole.frames)
    where = f"{words} frame {names[order[good]]}"
    where += f"-{names[order[-1]]}" * (words == "in")
    parts[1].name = f"{whole.name} {where}"
    split = [*observations[:i], *parts, *observations[i + 1 :]]
    return [*chains[: i + 1], *chains[i:]], split, parts[1].name


def _around(order, start, stop):
    """Return an order of frames with those from one up to another last, and where these begin."""
    middle = order[start:stop]
    return np.concatenate([order[:start], order[stop:], middle]), len(order) - len(middle)


def _share_left(chains, observations, i, misfit, rows):
    """Return the share of a misfit that is left with some of the frames of one dataset."""
    # all of them may be masked
    with suppress(ObservationError):
        part = observations[i].select(np.sort(rows))
        return _tried_misfit(chains, [*observations[:i], part, *observations[i + 1 :]]) / misfit
    return np.inf


def _nearer(chains, whole, order, words):
    """
    Return how many frames of a dataset are those of the first of two chains, and not of the second.

    That is decided frame by frame, in single differences; before it their order, these first.
    """
    off = []
    for chain in chains:
        problem = GapProblem([chain], [whole])
        problem.settle_noise()
        (channel,), (difference,) = problem.channels, problem.differences(problem.start)
        off.append(np.sum(channel.gap(difference) ** 2, axis=0))
    if words == "in":
        order = np.argsort(whole.position("sequence"), kind="stable")
        more = np.cumsum(np.append(0.0, (off[0] - off[1])[order]))
        inside = np.triu(more - more[:, None])
        start, stop = np.unravel_index(np.argmax(inside), inside.shape)
        return _around(order, start, stop)
    more = np.cumsum((off[0] - off[1])[order])
    least = len(order) // _LEAST_PART
    return order, least + int(np.argmin(more[least - 1 : -1]))


def _fitting(share, order):
    """Return how many frames of a dataset the model fits, all if it is not clear which.

    ``share`` is that of the misfit that some of the frames leave.
    """
    bad = len(order)
    good = bad // _LEAST_PART
    # so few of them may determine nothing
    while np.isinf(left := share(order[:good])) and good < bad // 2:
        good += 1 + good // 2
    if left > _FITS:
        return bad
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if share(order[:middle]) <= _FITS else (good, middle)
    # at once, not little by little
    sudden = share(order[: good + _SUDDEN]) > 2 * _FITS
    return good if sudden else len(order)


def _set_apart(chains):
    """Return chains in which what an earlier diagnosis found is held, and leaves its names."""
    found = [[leaf.copy() for leaf in leaves(chain)] for chain in chains]
    known = [leaf for one in found for leaf in one if (leaf.name or "").startswith("gap_")]
    for leaf in known:
        leaf.name = f"gap_earlier_{leaf.name.removeprefix('gap_')}"
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    return [join(optics) for optics in found] if known else chains


def _tried(chains, observations, effects, say, known, most):
    """Return misfit and effect of alternatives at a few wavelengths, and known ones, best first."""
    few, found = thinned(chains, observations, _FEW), list(known)
    for effect in effects:
        say(f"trying: {effect.title}")
        for one in effect.ways():
            # where it leaves too few frames, or none, it is not asked for
            with suppress(ObservationError):
                found.append((_tried_misfit(*_read(one, *few), most), one))
    found = [one for one in found if np.isfinite(one[0])]
    misfits, best = np.array([misfit for misfit, _ in found]), {}
    for i in ranked(-misfits, _EQUAL * misfits.min(initial=np.inf)):
        best.setdefault(found[i][1].name, found[i])
    return list(best.values())


def _tried_misfit(chains, observations, most=np.inf):
    """Return the misfit after a few steps of everything, infinite where frames are too few.

    It is less exact where it is above the ``most`` that counts.
    """
    # of what is not the answer a user is not warned
    with warnings.catch_warnings(), suppress(ObservationError):
        warnings.simplefilter("ignore", AstropolcalWarning)
        measurement = Measurement(chains, observations)
        start = vector = np.clip(measurement.vector(), *measurement.free.bounds())
        # so few data fit anything
        if start.size > measurement.n_data:
            return np.inf
        if start.size:
            problem = BinProblem(*few_frames(measurement, first_weighting(measurement, None)))
            for _ in range(_SEARCHES):
                vector = search_branches(problem, vector, start)[0]
                vector = problem.fit(vector, evaluations=_STEPS)[0]
                if rms(measurement.residuals(vector)) > _HOPELESS * most:
                    break
        return rms(measurement.residuals(vector))
    return np.inf


def _read(effect, chains, observations):
    """Return the chains with an alternative, and the frames of which it knows the angles."""
    context = Context.of(common_wavelengths(observations), observations)
    edges = ((o, effect.edge(o)) for o in observations)
    kept = [o.with_mask(f, "angle in no row") if f.any() else o for o, f in edges]
    return effect.edit(chains, context).chains, kept


def _misfit(calibration):
    """Return the root mean square residual of the double differences, in polarization."""
    return rms(calibration.measurement.residuals())


def _usual(calibration, what):
    """Return the root mean square of the double differences, ``"observed"``, or their noise."""
    parts = [np.square(getattr(d, what)).ravel() for d in calibration.measurement.datasets]
    return float(np.sqrt(np.mean(np.concatenate(parts))))


def _may_be_wrong(calibration):
    """Return whether the double differences are so far off that a sign may be wrong."""
    misfit = _misfit(calibration)
    size = np.sort(np.abs(calibration.measurement.residuals()))
    if rms(size[: max(1, int(_MOST_DATA * size.size))]) < _SHOWS * misfit:
        return False
    signal, noise = (_usual(calibration, what) for what in ("observed", "sigma"))
    # what has no stated errors has no noise to compare with
    clear = not misfit < _ABOVE_NOISE * noise
    return misfit > _WRONG_SIGN or (misfit > _WRONG_SHARE * signal and clear)


def _left(best, given):
    """Return the share of what exceeds the noise in double differences that a fit leaves."""
    noise = np.nan_to_num(_usual(best, "sigma") ** 2, posinf=0.0)
    left, whole = (max(_misfit(one) ** 2 - noise, 1e-300) for one in (best, given))
    return float(left / whole)


def _best_alternative(chains, observations, made, found, say):
    """Return an alternative that is far better than the nominal calibration, None without one.

    That is its calibration, the chains and datasets of it, and the effect with its aliases.
    """
    most, before, best = _FAR_BETTER * _misfit(made), 0.0, None
    for misfit, effect in found:
        # what does as much may end in a better minimum where all wavelengths are fitted, and what
        # gives the same data does not
        if misfit > most or (best is not None and misfit > _ALIKE * found[0][0]):
            break
        if misfit > (1 + _EQUAL) * before:
            say(f"calibrating: {effect.title}")
            asked, before = _read(effect, chains, observations), misfit
            tried = nominal_calibration(*asked)
            # where the fit leaves no polarization, as of a lamp that has none, any sign does
            optics = (leaf for chain in tried.chains for leaf in leaves(chain))
            prisms = (leaf.efficiency for leaf in optics if isinstance(leaf, WollastonPrism))
            if any(np.median(one.value) < NO_SPLITTER for one in prisms if not one.fixed):
                continue
            if _misfit(tried) < (most if best is None else _misfit(best[0])):
                best = tried, asked, misfit, effect
    if best is not None:
        *best, misfit, effect = best
        alike = (other for left, other in found if left < _ALIKE * misfit)
        return *best, [effect, *(other for other in alike if other is not effect)]
    return None


def thinned(chains, observations, count):
    """Return chains and datasets at a few of the wavelengths of each."""
    grid = common_wavelengths(observations)
    own = [bins_on_grid(o, grid) for o in observations]
    keep = [o[np.linspace(0, len(o) - 1, min(count, len(o))).round().astype(int)] for o in own]
    keep = np.unique(np.concatenate(keep))
    if len(keep) == len(grid):
        return list(chains), list(observations)
    pairs = zip(observations, own, strict=True)
    few = [o.select_bins(np.isin(bins, keep)) for o, bins in pairs]
    return [at_wavelengths(c, np.eye(len(grid))[keep], len(grid)) for c in chains], few
