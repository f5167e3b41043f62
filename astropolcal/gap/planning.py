# Licensed under a 3-clause BSD style license - see LICENSE
"""
What to observe next: exposures that answer the questions which a diagnosis leaves open.

Two causes that fit the data alike predict different data elsewhere. Each exposure that the set-ups
allow is simulated with each cause of an alias group as the truth, and what the others foresee is
compared with it, all parameters fitted again to old and new data together (Box & Hill 1967,
doi:10.1080/00401706.1967.10490441). An exposure is proposed only where it raises the probability
that the true cause is expected to have.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from astropolcal.chain import stages
from astropolcal.exceptions import GapError, ParameterError
from astropolcal.gap._forecast import (
    LEAST_GAIN,
    MODULATOR,
    STATES,
    Forecast,
    expected,
    odds,
)
from astropolcal.gap._words import listed
from astropolcal.gap.effects import Roles, get_effect
from astropolcal.gap.selection import REMAINDER
from astropolcal.optics import COORDINATES
from astropolcal.optics.perturbations import Dependence

__all__ = ["Exposure", "exposures", "plan"]

# positions that are set: degree; altitudes from low to high, the range in which stars are observed
_DEROTATOR, _ALTITUDE = np.arange(0, 180, 15.0), (25.0, 45.0, 65.0, 80.0)
_TURN = tuple(float(a) for a in np.arange(32) * 11.25)
_CYCLE = _TURN[:8]
_SKY = ("parallactic", "altitude")
_LEVELS = (0.5, 2.0)
# new angles of the derotator that are tried, and frames of a run that are repeated
_NEW_ANGLES, _LONGEST = 3, 128
# an alias of a smaller share is not asked about; so many are
_LEAST_SHARE, _MOST_MEMBERS = 0.02, 6
# of the doubt, the least that an exposure has to take; what a change of the set-up and a frame
# have to bring
_CLEARLY, _CHANGE, _FRAME = 0.2, 0.01, 1e-4
# dependences that a run shows, and not the frames of any other block
_TIMED = ("time", "time2", "step", "frame")
# log Bayes factor at which two causes are told apart
_APART = np.log(10)
# a dataset is repeated so many times to know its noise
_REPEATS = 3


@dataclass(frozen=True)
class Exposure:
    """
    A block of frames that could be taken.

    Parameters
    ----------
    dataset : int
        The dataset whose set-up it repeats.
    hwp : tuple of float
        Half-wave-plate angles in degree, one a frame.
    positions : tuple of (str, float or tuple of float)
        Other stages and their angle in degree, one a frame where it changes.
    polarizer_turned : float
        Degrees by which the calibration polarizer is turned.
    lamp : float
        Brightness of the lamp, relative to that of the dataset.
    without : tuple of str
        Optics that are taken out.
    states : tuple of str
        States of a modulator, "A" and "B", in which each angle is taken, one frame each; empty
        where there is no modulator.
    what : str
        The frames in words, where they are those of a run.
    setup : str
        Name of the dataset, where there are several.

    Examples
    --------
    >>> from astropolcal.gap.planning import Exposure
    >>> Exposure(0, (0.0, 22.5, 45.0, 67.5), (("derotator", 100.0),), polarizer_turned=45.0).words
    '4 half-wave-plate angles from 0 to 67.5 deg, derotator at 100 deg, the polarizer turned \
by 45 deg'
    """

    dataset: int
    hwp: tuple
    positions: tuple = ()
    polarizer_turned: float = 0.0
    lamp: float = 1.0
    without: tuple = ()
    states: tuple = ()
    what: str = ""
    setup: str = ""

    @property
    def n_frames(self):
        """Number of frames: each angle in each state."""
        return len(self.hwp) * max(len(self.states), 1)

    @property
    def angles(self):
        """Angle of every stage in every frame, degree, by name."""
        n, each = len(self.hwp), max(len(self.states), 1)
        found = {"hwp": self.hwp, **dict(self.positions)}
        return {name: np.repeat(np.broadcast_to(a, n), each) for name, a in found.items()}

    @property
    def modulator(self):
        """State of the modulator in every frame, A or B."""
        return np.tile(self.states, len(self.hwp))

    @property
    def effort(self):
        """Number of things to change in the set-up of the data, apart from its stages."""
        return bool(self.polarizer_turned) + (self.lamp != 1) + bool(self.without)

    @property
    def words(self):
        """The exposure in words."""
        parts = [self.what]
        if not self.what:
            span = f"from {min(self.hwp):.4g} to {max(self.hwp):.4g} deg"
            parts = [f"{len(self.hwp)} half-wave-plate angles {span}"]
            if self.states:
                plural = "s" * (len(self.states) > 1)
                parts[0] += f" in state{plural} {' and '.join(self.states)} of the modulator"
            parts += [f"{name} at {angle:g} deg" for name, angle in self.positions]
            parts += [f"set up as {self.setup}"] * bool(self.setup)
        if self.polarizer_turned:
            parts.append(f"the polarizer turned by {self.polarizer_turned:g} deg")
        parts += [f"{name} taken out" for name in self.without]
        if self.lamp != 1:
            level = "half" if self.lamp == 0.5 else f"{self.lamp:g} times"
            source = "a star" if "parallactic" in dict(self.positions) else "the lamp"
            parts.append(f"{source} {level} as bright")
        return ", ".join(parts)


def exposures(model, *, flux_matters=False):
    """
    Return exposures that the set-ups of the data allow.

    Parameters
    ----------
    model : Model
        The fitted model.
    flux_matters : bool
        Whether other brightnesses of the lamp are among them.

    Returns
    -------
    list of Exposure
        New angles, a full turn of the plate, the run again, in another order and backwards, the
        polarizer turned or taken out, and another lamp.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.planning import exposures
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> len(exposures(model))
    9
    """
    found, trains = [], model.trains
    polarized = [Roles(train).polarizer is not None for train in trains]
    for i, (train, observations) in enumerate(zip(trains, model.observations, strict=True)):
        if "hwp" not in observations.frames.colnames:
            continue
        run = _run(i, train, observations)
        # of several datasets it has to be said whose source and lamp it is
        run = replace(run, setup=observations.name) if len(trains) > 1 else run
        blocks = _blocks(run, train)
        found += [*blocks, *_runs(run, train, observations.name)]
        middle = blocks[len(blocks) // 2]
        if polarized[i]:
            # Q into U: what acts on one of them alone shows
            found.append(replace(middle, polarizer_turned=45.0))
            # a dataset without it is that exposure already
            if all(polarized):
                found.append(replace(middle, without=(Roles(train).polarizer.name,)))
        if flux_matters:
            found += [replace(middle, lamp=level) for level in _LEVELS]
    return found


def _run(i, train, observations):
    """Return the frames of a dataset as one exposure."""
    states, take = (), np.ones(observations.n_frames, dtype=bool)
    if MODULATOR in stages(train):
        states, take = STATES, observations.position(MODULATOR) < 0.5
    names = [s for s in stages(train) if s not in (*COORDINATES, "hwp")]
    known = set(observations.frames.colnames)
    where = {
        name: tuple(np.round(np.rad2deg(observations.position(name)[take]), 6)[:_LONGEST])
        for name in ("hwp", *names)
        if name in known
    }
    return Exposure(i, where.pop("hwp"), tuple(where.items()), states=states)


def _blocks(run, train):
    """Return blocks of plate angles at new positions, and a full turn at an old one."""
    cycle = tuple(float(a) for a in np.unique(np.round(run.hwp, 2))[:8])
    # a plate that follows the sky has been everywhere
    cycle = _CYCLE if len(set(np.round(run.hwp, 2))) > len(_TURN) else cycle
    usual = {name: float(np.median(angles)) for name, angles in run.positions}
    moved = next((name for name in ("altitude", "derotator", *usual) if name in usual), None)
    if moved is None:
        return [replace(run, hwp=angles) for angles in (cycle, _TURN)]
    taken = np.unique(np.round(dict(run.positions)[moved], 1))
    new, rest = [], list(_ALTITUDE if moved == "altitude" else _DEROTATOR)
    for _ in range(min(_NEW_ANGLES, len(rest))):
        # the one that is farthest from all others, modulo half a turn
        far = [np.min(np.abs((a - np.array([*taken, *new]) + 90) % 180 - 90)) for a in rest]
        new.append(rest.pop(int(np.argmax(np.round(far, 6)))))
    blocks = [replace(run, hwp=cycle, positions=_at(usual | {moved: a})) for a in sorted(new)]
    return [*blocks, replace(run, hwp=_TURN, positions=_at(usual | {moved: float(taken[0])}))]


def _at(where):
    return tuple((name, float(angle)) for name, angle in where.items())


def _runs(run, train, name):
    """Return the run again, in another order, and with the stages moving backwards."""
    same = replace(run, what=f"the run of {name} again")
    if any(stage in _SKY for stage in stages(train)):
        # the sky moves on by itself
        return [same]
    n = len(run.hwp)
    # the same for all runs of a length: the proposal can be repeated
    shuffled = np.random.default_rng(n).permutation(n)
    return [
        same,
        _in_order(same, shuffled, f"the frames of {name} in shuffled order"),
        _in_order(same, np.arange(n)[::-1], f"the run of {name} backwards, from its last frame"),
    ]


def _in_order(run, order, what):
    positions = tuple((name, tuple(np.array(a)[order])) for name, a in run.positions)
    return replace(run, hwp=tuple(np.array(run.hwp)[order]), positions=positions, what=what)


# ---- the plan ----------------------------------------------------------------------------------


def plan(found, members=(), *, candidates=None, limit=4):
    """
    Propose exposures for every question that is open.

    Parameters
    ----------
    found : Diagnosis or Model
        A diagnosis, with all its questions; or a fitted model.
    members : sequence of tuple
        For a model: an alias group, names or effects with their probabilities.
    candidates : sequence of Exposure, optional
        By default those of ``exposures``.
    limit : int
        Most lines to return.

    Returns
    -------
    list of dict
        ``words``; ``question``, ``"cause"``, ``"structure"`` or ``"parameters"``; ``separates``,
        the causes, or the parameters of the open direction that is seen best; ``gain``, the
        standard deviations at which they come apart, or at which a change of that direction by
        0.01 (rad) shows, 0 where no exposure tells them apart; ``probability_now`` and
        ``probability_after``, that the true one is expected to have, None for parameters. The
        questions are in the order of the causes.

    Raises
    ------
    GapError
        If an effect is unknown or has no place in the chains, or an exposure is impossible.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.planning import plan
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> plan(model)
    []
    """
    model = getattr(found, "improved", found)
    groups = _groups(found) if model is not found else [_given(model, members)] * bool(members)
    lines = [] if model is found else _repetitions(found)
    forecast = Forecast(model, [recipe for group in groups for _, recipe, _ in group])
    # a member may have lost its place to another one
    groups = [[one for one in group if one[0] in forecast.own] for group in groups]
    groups = [group for group in groups if len(group) > 1]
    directions = forecast.open_directions()
    asked = [*groups, None] if directions[2].shape[1] else groups
    if not asked:
        return lines[:limit]
    if candidates is None:
        used = {s for chain in forecast.chains for s in stages(chain)}
        candidates = exposures(model, flux_matters=bool(used & {"flux", "total_flux"}))
    _check(list(candidates), model)
    foreseen = []
    for one in candidates:
        try:
            foreseen.append((one, forecast.columns(one)))
        except ParameterError as error:
            # a model of data that lack much need not be physical at angles they do not have, and
            # foresees nothing there
            if error.argument != "chain":
                raise
    for group in groups:
        lines.insert(len(lines) - (not groups), _telling_apart(forecast, group, foreseen))
    if directions[2].shape[1]:
        lines += _fixing(forecast, directions, foreseen)
    return _merged(lines)[:limit]


def _given(model, members):
    found = []
    for one, share in members:
        effect = get_effect(one)
        if effect.name not in model.added and not effect.applies(model.trains):
            raise GapError(f"effect {effect.name!r} has no place in these chains")
        found.append((effect.name, (effect, None), float(share)))
    return found


def _groups(diagnosis):
    """Return name, recipe and probability of the aliases of every cause."""
    found = []
    for cause in diagnosis.causes:
        members = {cause.cell or cause.name: [cause.name, (cause.effect, None), cause.share]}
        for one, share in cause.aliases:
            # a name and its cell are one cause
            if (one.cell or one.name) in members:
                members[one.cell or one.name][2] += share
            elif share > _LEAST_SHARE:
                members[one.cell or one.name] = [one.name, one.recipe, share]
        smooth = [m for m in members.values() if m[1][0].kind != "discrete"]
        if cause.name in diagnosis.improved.added and len(smooth) > 1:
            found.append([tuple(m) for m in smooth[:_MOST_MEMBERS]])
    return found


def _telling_apart(forecast, group, foreseen):
    """Return the line on the exposure that tells the members of an alias group apart best."""
    names, recipes, shares = zip(*group, strict=True)
    weights = np.array(shares) / sum(shares)
    titles = {effect.name: _titled(effect) for effect, _ in recipes}
    hypotheses, now = forecast.foreseen(names), float(np.sum(weights**2))
    best, value = None, -np.inf
    # a short block is no run: how far a drift would come in it is not known
    timed = any(Dependence(effect.dependence).kind in _TIMED for effect, _ in recipes)
    for exposure, columns in foreseen:
        if timed and not exposure.what:
            continue
        factors, sigmas = odds(hypotheses, columns.T @ columns)
        after = expected(weights, factors)
        clear = np.log10(1 + np.min(sigmas + sigmas.max() * np.eye(len(names))))
        worth = after + _CHANGE * (clear - exposure.effort) - _FRAME * exposure.n_frames
        if worth > value:
            best, value = (exposure, after, factors, sigmas), worth
    entry = {"question": "cause", "separates": list(names), "gain": 0.0}
    entry |= {"probability_now": now, "probability_after": now}
    first = titles[names[0]]
    if best is not None:
        exposure, after, factors, sigmas = best
        other = [j for j in range(1, len(names)) if min(factors[0, j], factors[j, 0]) > _APART]
        if other and after - now > _CLEARLY * (1 - now):
            gain = min(min(sigmas[0, j], sigmas[j, 0]) for j in other)
            few = listed([titles[names[j]] for j in other], most=2)
            same = [titles[names[j]] for j in range(1, len(names)) if j not in other]
            few += f", not from {listed(same, most=2)}," if same else ""
            words = (
                f"Take {exposure.words}: tells {first} from {few} at {_sigmas(gain)} "
                f"standard deviations; the probability of the true one should rise from "
                f"{now:.0%} to {_percent(after)}"
            )
            told = [names[0], *(names[j] for j in other)]
            more = {"separates": told, "gain": float(gain), "probability_after": after}
            return entry | more | {"words": words}
    few = listed([titles[name] for name in names[1:]], most=2)
    words = f"No exposure that was tried tells {first} from {few}: other angles and orders"
    return entry | {"words": f"{words}, polarizer and lamp do to both the same"}


def _repetitions(diagnosis):
    """Return the line on how to know whether what is left is noise."""
    if diagnosis.remainder_p_value >= REMAINDER:
        return []
    problem, model = diagnosis.improved.problem, diagnosis.improved
    squares = model.residual**2
    worst = max(
        range(len(problem.segments)), key=lambda i: float(np.mean(squares[problem.segments[i]]))
    )
    n = 2 * int(problem.channels[worst].valid.sum())
    excess = float(np.sum(squares[problem.segments[worst]])) / n
    # the scatter of repetitions has a variance that is known to this share
    gain = np.log(max(excess, 1.0)) / np.sqrt(2 / n + 2 / (n * (_REPEATS - 1)))
    name = model.observations[worst].name
    words = (
        f"Take the run of {name} {_REPEATS} times: tells structure that no cause explains from "
        f"noise larger than stated, at {_sigmas(gain)} standard deviations"
    )
    after = float(stats.norm.cdf(gain))
    chances = {"probability_now": 0.5, "probability_after": after}
    entry = {"words": words, "question": "structure", "separates": [], "gain": float(gain)}
    return [entry | chances] if gain > LEAST_GAIN else []


def _fixing(forecast, directions, foreseen):
    """Return the line on the exposure that fixes what is open among the parameters."""
    best, n_open = (LEAST_GAIN, None), directions[2].shape[1]
    for exposure, columns in foreseen:
        names, gain, count = forecast.fixes(directions, columns)
        worth = gain / (1 + exposure.effort)
        if worth > best[0]:
            best = worth, (exposure, names, gain, count)
    if best[1] is None:
        return []
    exposure, names, gain, count = best[1]
    words = (
        f"Take {exposure.words}: fixes {count} of {n_open} open directions of the parameters, the "
        f"clearest that of {' with '.join(names)}, at {_sigmas(gain)} standard deviations"
    )
    entry = {"words": words, "question": "parameters", "separates": names, "gain": gain}
    return [entry | {"probability_now": None, "probability_after": None}]


def _merged(lines):
    """Return the lines, with one exposure that answers several questions named once."""
    found = {}
    for line in lines:
        exposure, _, purpose = line["words"].partition(": ")
        if line["gain"] and exposure in found:
            old = found[exposure]
            old["words"] += f"; {purpose}"
            old["separates"] = list(dict.fromkeys(old["separates"] + line["separates"]))
        else:
            found[exposure if line["gain"] else line["words"]] = dict(line)
    return list(found.values())


def _titled(effect):
    # what a cell is called says no more than its title
    is_cell = effect.kind == "cell"
    return effect.title if is_cell else f"{effect.title} ({effect.name})"


def _percent(probability):
    return "over 99%" if probability > 0.99 else f"{probability:.0%}"


def _sigmas(gain):
    return f"{gain:.2g}" if gain < 100 else f"{gain:.0f}"


def _check(candidates, model):
    n = len(model.observations)
    for one in candidates:
        if not 0 <= one.dataset < n:
            raise GapError(f"exposure of dataset {one.dataset}; there are {n}, from 0")
        modulated = MODULATOR in stages(model.trains[one.dataset])
        wrong = {
            f"half-wave-plate angles {one.hwp}: finite ones are needed": (
                len(one.hwp) == 0 or not np.all(np.isfinite(one.hwp))
            ),
            f"lamp = {one.lamp}: it must be positive": not (np.isfinite(one.lamp) and one.lamp > 0),
            f"states {one.states}: allowed are {', '.join(STATES)}": not set(one.states)
            <= {*STATES},
            f"states {one.states}: they are needed where the chain has a modulator, and nowhere "
            "else": bool(one.states) != modulated,
        }
        for words, is_wrong in wrong.items():
            if is_wrong:
                raise GapError(f"exposure with {words}")
