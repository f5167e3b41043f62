# Licensed under a 3-clause BSD style license - see LICENSE
"""
What to observe next: exposures that answer the questions which a diagnosis cannot answer.

Two causes that fit the data alike predict different data elsewhere. Each exposure that the set-ups
allow is simulated with each cause of an alias group as the truth, and what the others foresee is
compared with it, all parameters fitted again to old and new data together (Box & Hill 1967,
doi:10.1080/00401706.1967.10490441). An exposure is proposed only where it raises the probability
that the true cause is expected to have.
"""

from copy import copy
from dataclasses import dataclass, replace
from itertools import dropwhile, product

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtr

from astropolcal.calibration.identifiability.linearized import orthonormal, ranked
from astropolcal.chain import Train, join, leaves, stages
from astropolcal.exceptions import ParameterError
from astropolcal.gap.effects import Roles
from astropolcal.gap.effects._laws import turned_by
from astropolcal.gap.problem import OPEN, GapProblem
from astropolcal.gap.selection import REMAINDER
from astropolcal.optics import COORDINATES
from astropolcal.optics.perturbations import Dependence
from astropolcal.simulation import simulate
from astropolcal.words import listed

__all__ = []

# positions that are set: degree; altitudes from low to high, the range in which stars are observed
_DEROTATOR, _ALTITUDE = np.arange(0, 180, 15.0), (25.0, 45.0, 65.0, 80.0)
_TURN = tuple(float(a) for a in np.arange(32) * 11.25)
_CYCLE = _TURN[:8]
_SKY = ("parallactic", "altitude")
_LEVELS = (0.5, 2.0)
# new angles of the derotator that are tried, and frames of a run that are repeated
_NEW_ANGLES, _LONGEST = 3, 128
# a stage that modulates without such a plate is turned by so much (degree)
_TURNED_BY = (22.5, 45.0)
# a cause, and an alias of a smaller share, is not asked about; so many are
_LEAST_CHANCE, _LEAST_SHARE, _MOST_MEMBERS = 0.05, 0.02, 6
# of the doubt, the least that an exposure has to take; what a change of the set-up and a frame
# have to bring
_CLEARLY, _CHANGE, _FRAME = 0.2, 0.01, 1e-4
# dependences that a run shows, and not the frames of any other block
_TIMED = ("time", "time2")
# log Bayes factor at which two causes are told apart
_APART = np.log(10)
# entries of a plan
_MOST_LINES = 4
# a dataset is repeated so many times to know its noise
_REPEATS = 3
MODULATOR, STATES = "flc_state", ("A", "B")
GROUP = "group"
#: What cannot be seen to one standard deviation is not worth an exposure.
LEAST_GAIN = 1.0
# a change of this size (radian or relative) has to be seen
_WANTED = 0.01
# keeps open directions where they are, of columns of unit length; sizes are known within this
# factor of the usual one
_HOLD, _WIDE = 1e-10, 3.0


@dataclass(frozen=True)
class Exposure:
    """A block of frames that could be taken."""

    #: The dataset whose set-up it repeats.
    dataset: int
    #: Angle in degree, or state, of each stage, ``"hwp"`` first if there is such a plate; one per
    #: frame where it changes.
    positions: dict
    #: Degrees by which the calibration polarizer is turned.
    polarizer_turned: float = 0.0
    #: Brightness of the lamp, relative to that of the dataset.
    lamp: float = 1.0
    without: tuple = ()
    #: States of a modulator, "A" and "B", in which each angle is taken, one frame each; empty where
    #: there is no modulator.
    states: tuple = ()
    #: The frames in words, where they are those of a run.
    what: str = ""
    #: Name of the dataset, where there are several.
    setup: str = ""

    @property
    def n_angles(self):
        """Number of frames, those in several states counted once."""
        return max(map(np.size, self.positions.values()), default=0)

    @property
    def n_frames(self):
        """Number of frames: each angle in each state."""
        return self.n_angles * max(len(self.states), 1)

    @property
    def angles(self):
        """Angle of every stage in every frame, degree, or its state, by name."""
        each = max(len(self.states), 1)
        return {
            name: np.repeat(np.broadcast_to(angle, self.n_angles), each)
            for name, angle in self.positions.items()
        }

    @property
    def effort(self):
        """Number of things to change in the set-up of the data, apart from its stages."""
        return bool(self.polarizer_turned) + (self.lamp != 1) + bool(self.without)

    @property
    def words(self):
        """The exposure in words."""
        parts = [self.what]
        if not self.what:
            rest = dict(self.positions)
            plate = rest.pop("hwp")
            span = f"from {min(plate):.4g} to {max(plate):.4g} deg"
            parts = [f"{len(plate)} half-wave-plate angles {span}"]
            if self.states:
                parts[0] += f" in states {' and '.join(self.states)} of the modulator"
            parts += [f"{name} at {angle:g} deg" for name, angle in rest.items()]
            parts += [f"set up as {self.setup}"] * bool(self.setup)
        if self.polarizer_turned:
            parts.append(f"the polarizer turned by {self.polarizer_turned:g} deg")
        parts += [f"{name} taken out" for name in self.without]
        if self.lamp != 1:
            level = "half" if self.lamp == 0.5 else f"{self.lamp:g} times"
            source = "a star" if "parallactic" in self.positions else "the lamp"
            parts.append(f"{source} {level} as bright")
        return ", ".join(parts)


def exposures(model, *, flux_matters=False):
    """Return exposures that the set-ups of the data allow.

    New angles, a full turn of the plate, the run again, in another order and backwards, the
    polarizer turned or taken out, and another lamp. Where no half-wave plate modulates two beams,
    it is the run again with each stage turned.
    """
    found, trains = [], model.trains
    polarized = [Roles(train).polarizer is not None for train in trains]
    for i, (train, observations) in enumerate(zip(trains, model.observations, strict=True)):
        run = _run(i, train, observations)
        # of several datasets it has to be said whose source and lamp it is
        run = replace(run, setup=observations.name) if len(trains) > 1 else run
        plain = "hwp" in run.positions and not observations.single_beam
        blocks = _blocks(run) if plain else _turned(run, observations.name)
        found += [*blocks, *_runs(run, train, observations.name)]
        if not blocks:
            continue
        middle = blocks[len(blocks) // 2]
        if polarized[i] and plain:
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
    # "filter=CLEAR" is a state of the column filter
    names = dict.fromkeys(stage.partition("=")[0] for stage in ("hwp", *stages(train)))
    known = set(observations.frame_columns)
    where = {}
    for name in (name for name in names if name in known and name not in COORDINATES):
        column = np.asarray(observations.frames[name])
        if column.dtype.kind not in "US":
            column = np.round(np.rad2deg(observations.position(name)), 6)
        where[name] = column[take][:_LONGEST]
    if observations.single_beam:
        where[GROUP] = observations.brightness_groups[take][:_LONGEST]
    return Exposure(i, where, states=states)


def _turned(run, name):
    """Return the run with each of its stages turned, those of the sky aside."""
    # states and groups are no angles
    own = {s: a for s, a in run.positions.items() if s not in _SKY and a.dtype.kind == "f"}
    found = []
    for stage, by in product(own, _TURNED_BY):
        what = f"the run of {name} with {stage} turned by {by:g} deg"
        found.append(replace(run, positions=run.positions | {stage: own[stage] + by}, what=what))
    return found


def _blocks(run):
    """Return blocks of plate angles at new positions, and a full turn at an old one."""
    plate = np.unique(np.round(run.positions["hwp"], 2))
    # a plate that follows the sky has been everywhere
    cycle = _CYCLE if len(plate) > len(_TURN) else tuple(map(float, plate[:8]))
    usual = {name: float(np.median(a)) for name, a in run.positions.items() if name != "hwp"}
    moved = next((name for name in ("altitude", "derotator", *usual) if name in usual), None)
    if moved is None:
        return [replace(run, positions={"hwp": angles}) for angles in (cycle, _TURN)]
    taken = np.unique(np.round(run.positions[moved], 1))
    new, rest = [], list(_ALTITUDE if moved == "altitude" else _DEROTATOR)
    for _ in range(min(_NEW_ANGLES, len(rest))):
        # the one that is farthest from all others, modulo half a turn
        far = [np.min(np.abs((a - np.array([*taken, *new]) + 90) % 180 - 90)) for a in rest]
        new.append(rest.pop(int(np.argmax(np.round(far, 6)))))
    frames = [*((cycle, angle) for angle in sorted(new)), (_TURN, taken[0])]
    return [
        replace(run, positions={"hwp": angles} | usual | {moved: float(angle)})
        for angles, angle in frames
    ]


def _runs(run, train, name):
    """Return the run again, in another order, and with the stages moving backwards."""
    same = replace(run, what=f"the run of {name} again")
    if any(stage in _SKY for stage in stages(train)):
        # the sky moves on by itself
        return [same]
    # frames that share their brightness stay together
    group = np.unique(run.positions.get(GROUP, np.arange(run.n_angles)), return_inverse=True)[1]
    found = [same]
    for order, what in (
        (_shuffled(group), f"the frames of {name} in shuffled order"),
        (np.argsort(-group, kind="stable"), f"the run of {name} backwards, from its last frame"),
    ):
        positions = {stage: angles[order] for stage, angles in run.positions.items()}
        found.append(replace(same, positions=positions, what=what))
    return found


def _shuffled(group):
    """Return an order of frames, of which those of a group stay together."""
    n = group.max(initial=-1) + 1
    # the same for all runs of a length: the proposal can be repeated
    return np.argsort(np.random.default_rng(n).permutation(n)[group], kind="stable")


# ---- the plan ----------------------------------------------------------------------------------


def plan(diagnosis, candidates=None):
    """Return exposures that answer the questions that a diagnosis cannot answer, a list of dict.

    Keys are ``words``; ``question``, ``"cause"``, ``"structure"`` or ``"parameters"``;
    ``separates``, the causes, or the parameters of the open direction that is seen best; ``gain``,
    the standard deviations at which they come apart, or at which a change of that direction by 0.01
    (rad) shows, 0 where no exposure tells them apart; ``probability_now`` and
    ``probability_after``, that the true one is expected to have, None for parameters.
    The questions are in the order of the causes.
    """
    model, groups = diagnosis.improved, _groups(diagnosis)
    lines = [*_moved(diagnosis), *_repetitions(diagnosis)]
    forecast = Forecast(model, [recipe for group in groups for _, recipe, _ in group])
    # a member may have lost its place to another one
    groups = [[one for one in group if one[0] in forecast.own] for group in groups]
    groups = [group for group in groups if len(group) > 1]
    directions = forecast.open_directions()
    if not groups and not directions[2].shape[1]:
        return lines[:_MOST_LINES]
    if candidates is None:
        used = {s for chain in forecast.chains for s in stages(chain)}
        candidates = exposures(model, flux_matters=bool(used & {"flux", "total_flux"}))
    foreseen = []
    for one in candidates:
        try:
            foreseen.append((one, forecast.columns(one)))
        except ParameterError as error:
            # a model of data that lack much need not be physical at angles they do not have, and
            # foresees nothing there
            if error.argument != "chain":
                raise
    lines += [_telling_apart(forecast, group, foreseen) for group in groups]
    if n_open := directions[2].shape[1]:
        found = [(one, *forecast.fixes(directions, columns)) for one, columns in foreseen]
        worth = [gain / (1 + one.effort) for one, _, gain, _ in found]
        if max(worth, default=0.0) > LEAST_GAIN:
            exposure, names, gain, count = found[int(np.argmax(worth))]
            purpose = (
                f"fixes {count} of {n_open} open directions of the parameters, the clearest that "
                f"of {' with '.join(names)}, at {_sigmas(gain)} standard deviations"
            )
            lines.append(_line(exposure.words, purpose, "parameters", names, gain))
    return _merged(lines)[:_MOST_LINES]


def _groups(diagnosis):
    """Return name, recipe and probability of the aliases of every cause."""
    found = []
    for cause in (one for one in diagnosis.causes if one.probability > _LEAST_CHANCE):
        members = {cause.cell or cause.name: [cause.name, (cause.effect, None), cause.share]}
        for one, share in cause.aliases:
            # a name and its cell are one cause
            if (one.cell or one.name) in members:
                members[one.cell or one.name][2] += share
            elif share > _LEAST_SHARE:
                members[one.cell or one.name] = [one.name, one.recipe, share]
        # what happened at a frame of a run need not happen in another
        asked = [m for m in members.values() if m[1][0].kind != "discrete"]
        asked = [m for m in asked if Dependence(m[1][0].dependence).driver != "frame"]
        if cause.name in diagnosis.improved.added and asked[1:] and asked[0][0] == cause.name:
            found.append([tuple(m) for m in asked[:_MOST_MEMBERS]])
    return found


def _telling_apart(forecast, group, foreseen):
    """Return the line on the exposure that tells the members of an alias group apart best."""
    names, recipes, shares = zip(*group, strict=True)
    weights = np.array(shares)
    # what a cell is called says no more than its title
    titles = {e.name: e.title + f" ({e.name})" * (e.kind != "cell") for e, _ in recipes}
    hypotheses = forecast.foreseen(names)
    now = float(np.sum(weights**2) / weights.sum())
    # a short block is no run: how far a drift would come in it is not known
    timed = any(Dependence(effect.dependence).kind in _TIMED for effect, _ in recipes)
    found = []
    for exposure, columns in (each for each in foreseen if each[0].what or not timed):
        factors, sigmas = odds(hypotheses, columns.T @ columns)
        after = expected(weights, factors)
        clear = np.log10(1 + np.min(sigmas + sigmas.max() * np.eye(len(names))))
        worth = after + _CHANGE * (clear - exposure.effort) - _FRAME * exposure.n_frames
        found.append((worth, exposure, after, factors, sigmas))
    first = titles[names[0]]
    if found:
        _, exposure, after, factors, sigmas = max(found, key=lambda one: one[0])
        other = [j for j in range(1, len(names)) if min(factors[0, j], factors[j, 0]) > _APART]
        if other and after - now > _CLEARLY * (1 - now):
            gain = min(min(sigmas[0, j], sigmas[j, 0]) for j in other)
            few = listed([titles[names[j]] for j in other], most=2)
            same = [titles[names[j]] for j in range(1, len(names)) if j not in other]
            few += f", not from {listed(same, most=2)}," if same else ""
            purpose = (
                f"tells {first} from {few} at {_sigmas(gain)} "
                f"standard deviations; if one of these is the cause, its share should rise from "
                f"{now:.0%} to {_grown(after)}"
            )
            told = [names[0], *(names[j] for j in other)]
            return _line(exposure.words, purpose, "cause", told, float(gain), now, after)
    few = listed([titles[name] for name in names[1:]], most=2)
    words = (
        f"No exposure that was tried tells {first} from {few}: other angles and orders, polarizer "
        "and lamp do to both the same"
    )
    return _line(None, words, "cause", list(names), 0.0, now, now)


def _line(exposure, purpose, question, separates, gain, now=None, after=None):
    """Return an entry of the plan; of causes, also how probable the true one is expected to be."""
    take = exposure and f"Take {exposure}"
    found = {"question": question, "separates": separates, "gain": gain, "exposure": take}
    words = f"{take}: {purpose}" if take else purpose
    return found | {"probability_now": now, "probability_after": after, "words": words}


def _repetitions(diagnosis):
    """Return the line on how to know whether what is left is noise."""
    if diagnosis.remainder_p_value >= REMAINDER:
        return []
    problem, model = diagnosis.improved.problem, diagnosis.improved
    squares = [np.sum(model.residual[rows] ** 2) for rows in problem.segments]
    # what is masked is no datum
    counts = [channel.count * int(channel.valid.sum()) for channel in problem.channels]
    worst = int(np.argmax(np.divide(squares, counts)))
    n, excess = counts[worst], float(squares[worst] / counts[worst])
    # the scatter of repetitions has a variance that is known to this share
    gain = np.log(max(excess, 1.0)) / np.sqrt(2 / n + 2 / (n * (_REPEATS - 1)))
    name = model.observations[worst].name
    purpose = (
        "tells structure that no cause explains from noise larger than stated, at "
        f"{_sigmas(gain)} standard deviations"
    )
    take = f"the run of {name} {_REPEATS} times"
    found = _line(take, purpose, "structure", [], float(gain), 0.5, float(ndtr(gain)))
    return [found] if gain > LEAST_GAIN else []


def _moved(diagnosis):
    """Return the line on how to know whether a course follows a stage or happened once."""
    model = diagnosis.improved
    if any(stage in _SKY for chain in model.trains for stage in stages(chain)):
        return []
    for one in diagnosis.courses[:1] if diagnosis.verdict == "unexplained" else ():
        told = [np.sum((wave / std) ** 2) for wave, std in zip(one.wave, one.std, strict=True)]
        i = int(np.argmax(told))
        seen, wave, var = model.observations[i], one.wave[i], one.std[i] ** 2
        group = seen.brightness_groups if seen.single_beam else np.arange(len(wave))
        order = _shuffled(group)
        # the shuffled run has what comes with the angles, or with the time, or nothing
        waves = np.stack([wave[order], wave, np.zeros_like(wave)])
        spread = var + np.stack([var[order], var, np.zeros_like(var)])
        missed = np.sum((waves[:, None] - waves) ** 2 / spread, axis=-1)
        now, after = 1 / 3, expected(np.full(3, 1 / 3), missed / 2)
        gain = float(np.sqrt(np.min(missed[~np.eye(3, dtype=bool)])))
        if gain > LEAST_GAIN and after - now > _CLEARLY * (1 - now):
            purpose = (
                "tells whether the one thing that it may be comes with the angles of a stage, "
                f"with the time in the run, or came once, at {_sigmas(gain)} standard deviations; "
                f"if one of these is so, its share should rise from {now:.0%} to {_grown(after)}"
            )
            take = f"the frames of {seen.name} in shuffled order"
            return [_line(take, purpose, "structure", [], gain, now, after)]
    return []


def _grown(after):
    return "over 99%" if after > 0.99 else f"{after:.0%}"


def _merged(lines):
    """Return the lines, with one exposure that answers several questions named once."""
    found = {}
    for line in lines:
        old = found.setdefault(line["exposure"] or line["words"], dict(line))
        if old["words"] != line["words"]:
            old["words"] += f"; {line['words'].removeprefix(line['exposure'] + ': ')}"
            old["separates"] = list(dict.fromkeys(old["separates"] + line["separates"]))
    return list(found.values())


def _sigmas(gain):
    return f"{gain:.2g}" if gain < 100 else f"{gain:.0f}"


# ---- what exposures would tell ------------------------------------------------------------------


class Forecast:
    """
    A fitted model with all causes that are asked about, and what the data say of each of them.
    """

    def __init__(self, model, recipes):
        wanted = {effect.name: (effect, context) for effect, context in recipes}
        edited = model.edited(*(wanted[name] for name in wanted if name not in model.added))
        self.model, self.chains, self.problem = model, edited.trains, edited.problem
        problem, q = edited.problem, edited.fit.coefficients
        tight, own = problem.tight**2, {}
        for name, parameters in edited.added.items():
            own[name] = problem.numbers(p.name for p in parameters)
            for one in parameters:
                tight[problem.numbers([one.name])] = 1 / (_WIDE * one.canonical_scale) ** 2
        #: Coefficients of each cause that has a place.
        self.own = {name: numbers for name, numbers in own.items() if numbers.size}
        slopes, self.residual = problem.jacobian(q), problem.residual(q)
        self.causes = np.zeros(problem.size, dtype=bool)
        for numbers in self.own.values():
            self.causes[numbers] = True
        #: Coefficients that the data may move.
        self.live = self.causes | ~problem.at_bound(q)
        norm = np.linalg.norm(slopes, axis=0)
        self.scale = np.where(norm > 0, norm, 1.0)
        self.slopes = slopes / self.scale
        self.gram = self.slopes.T @ self.slopes + np.diag(tight / self.scale**2 + _HOLD)
        #: By how much each coefficient is off the value at which its cause is absent.
        self.value = (q - problem.absent) * self.scale

    def foreseen(self, names):
        """
        Return what the data say of causes, one at a time.

        The coefficients that are live, the normal equations, and the solution (size,).
        """
        inside = [name for name in names if name in self.model.added]
        # the data, with the causes of the group that are in the model taken out
        taken = np.concatenate([np.empty(0, dtype=int), *(self.own[n] for n in inside)])
        wanted = self.slopes.T @ (self.residual + self.slopes[:, taken] @ self.value[taken])
        absent = self.causes.copy()
        for name in self.own.keys() & self.model.added.keys():
            absent[self.own[name]] = False
        found = []
        for name in names:
            live = self.live & ~absent
            live[taken] = False
            live[self.own[name]] = True
            rows = np.flatnonzero(live)
            normal = self.gram[np.ix_(rows, rows)]
            solution = np.zeros(self.problem.size)
            solution[rows] = cho_solve(cho_factor(normal), wanted[rows])
            found.append((rows, normal, solution))
        return found

    def columns(self, exposure):
        """Return the whitened derivatives of an exposure, in the same units: (rows, size)."""
        chain = _set_up(self.chains[exposure.dataset], exposure)
        observations = _hypothetical(self.model, exposure)
        own = {leaf.name for leaf in leaves(chain)}
        ties = {
            name: tie
            for name, tie in self.problem.ties.items()
            if {name.split(".")[0], tie.source.split(".")[0]} <= own
        }
        how = {"laws": self.problem.laws, "neutral": self.problem.neutral}
        how["wavelength"] = self.problem.wavelength * u.um
        problem = GapProblem([chain], [observations], ties=ties, **how)
        _settle_noise(problem.channels[0], self.model.problem.channels[exposure.dataset], exposure)
        slopes = problem.jacobian(problem.start)[problem.segments[0]]
        out = np.zeros((len(slopes), self.problem.size))
        # a parameter that the set-up alone has is none of those fitted
        shared = [name for name in problem.slices if name in self.problem.slices]
        out[:, self.problem.numbers(shared)] = slopes[:, problem.numbers(shared)]
        return out / self.scale

    def open_directions(self):
        """Return what the data determine, as few rows, and the directions that they do not."""
        if not self.problem.size:
            return (np.empty((0, 0)),) * 4
        singular, right, scale = self.model.decomposed
        is_open = singular < OPEN * singular[0]
        return singular[:, None] * right, right[~is_open].T, right[is_open].T, scale

    def fixes(self, directions, columns):
        """
        Return what new rows say of the open directions.

        That is the parameters of the one seen best, at how many standard deviations a
        change of it shows, and how many directions show at all.
        """
        rows, known, unknown, scale = directions
        order = self.problem.numbers(self.model.problem.slices)
        table = np.concatenate([rows, columns[:, order] * self.scale[order] / scale])
        basis = orthonormal(table @ known)
        left = table @ unknown
        # twice is enough to be orthogonal to rounding
        left -= basis @ (basis.T @ left)
        left -= basis @ (basis.T @ left)
        _, singular, right = np.linalg.svd(left, full_matrices=False)
        steps = np.abs(unknown @ right.T) / scale[:, None]
        sigmas = _WANTED * singular / steps.max(axis=0)
        best = int(ranked(sigmas)[0])
        step = steps[:, best]
        main = [i for i in ranked(step)[:3] if step[i] > 0.3 * step.max()]
        found = [self.model.problem.names[i] for i in main]
        return found, float(sigmas[best]), int(np.sum(sigmas > LEAST_GAIN))


def odds(hypotheses, gram):
    """
    Return the expected logarithms of Bayes factors, and what tells two causes apart.

    Of the truth (first axis) against another cause (second axis), and by how many standard
    deviations this one fails.
    """
    n = len(hypotheses)
    chi2, freedom = np.zeros((n, n)), np.zeros(n)
    for j, (rows, normal, mine) in enumerate(hypotheses):
        inner = gram[np.ix_(rows, rows)]
        both = cho_factor(normal + inner)
        for i, (_, _, theirs) in enumerate(hypotheses):
            change = gram @ (theirs - mine)
            seen = change[rows] @ cho_solve(both, change[rows])
            chi2[i, j] = max(float((theirs - mine) @ change - seen), 0.0)
        grown = _log_det(both) - _log_det(cho_factor(normal))
        freedom[j] = grown - np.trace(cho_solve(both, inner))
    return (chi2 + freedom[None] - freedom[:, None]) / 2, np.sqrt(chi2)


def _log_det(factor):
    return 2 * np.sum(np.log(np.diag(factor[0])))


def expected(weights, factors):
    """
    Return the probability that the true one of several causes is expected to have.

    What their weights lack of one is that of causes which nothing is known to tell from it.
    """
    against = np.exp(np.clip(-factors, -700, 50)) @ weights + max(1 - weights.sum(), 0.0)
    return float(np.sum(weights**2 / against) / weights.sum())


# ---- exposures ---------------------------------------------------------------------------------


def _set_up(chain, exposure):
    """Return copies of the optics of a chain as the exposure needs them."""
    kept = (leaf.copy() for leaf in leaves(chain) if leaf.name not in exposure.without)
    # where nothing is left upstream of what turns, no diagnosis has a place for causes there
    train = Train(dropwhile(lambda leaf: (leaf.name or "").startswith("gap_"), kept))
    if exposure.polarizer_turned:
        turned_by(exposure.polarizer_turned)(train, Roles(train).polarizer)
    return train


def _hypothetical(base, exposure):
    """Return noiseless observations of an exposure, as bright as its dataset."""
    i, problem = exposure.dataset, base.problem
    chain = _set_up(base.trains[i], exposure)
    chain = [leaf for leaf in chain if leaf.stage not in COORDINATES or leaf.stage == MODULATOR]
    sweep = problem.datasets[i].forward(problem.vector(base.fit.coefficients))
    usual = np.median(np.sum(sweep.fluxes, axis=0), axis=1)
    measured = np.exp(_middle(problem.channels[i], problem.channels[i].observed[1]))
    # of a wavelength without a datum nothing is asked: any flux will do
    measured = np.where(np.isfinite(measured), measured, usual)
    frames = QTable(
        {name: a * u.deg if a.dtype.kind == "f" else a for name, a in exposure.angles.items()}
    )
    if exposure.states:
        states = np.tile(exposure.states, exposure.n_angles)
        frames[MODULATOR] = (states == STATES[1]).astype(float)
    how = {"flux": exposure.lamp * measured / usual, "name": f"next {base.observations[i].name}"}
    wavelength = problem.wavelength[problem.datasets[i].bins] * u.um
    return simulate(join(chain), wavelength, frames, noise=False, **how)


def _middle(channel, values):
    """Return the median of values (..., W, F) over the frames, NaN at a wavelength without data."""
    found, some = np.full(values.shape[:-1], np.nan), channel.valid.any(axis=1)
    known = np.where(channel.valid, values, np.nan)
    found[..., some] = np.nanmedian(known[..., some, :], axis=-1)
    return found


def _settle_noise(new, old, exposure):
    """Give channels the noise and the lamp of a dataset, whose colour does not drift."""
    sigma = np.nan_to_num(_middle(old, old.sigma)[..., None], nan=np.inf) / np.sqrt(exposure.lamp)
    new.lamp = copy(old.lamp)
    new.lamp.color = 0
    if new.groups is not None:
        new.lamp = type(old.lamp)(new.groups)
    new.lamp.sequence = 2 * new.sequence - 1
    new.settle(np.broadcast_to(sigma, new.shape))
