# Licensed under a 3-clause BSD style license - see LICENSE
"""
What to observe next: exposures that tell aliases apart or fix what is open.

Two effects that fit the data alike predict different data elsewhere. If one of
them is the truth, the chi-square that the other is expected to miss, with all
of its parameters fitted again to old and new data together, is the squared
length of the difference of both predictions less its projection on the tangent
space of the other (Box & Hill 1967, doi:10.1080/00401706.1967.10490441). The
lesser of both directions counts.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.linalg import qr

from astropolcal.chain import leaves, remove_optic, stages
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import EFFECTS, Roles, get_effect
from astropolcal.gap.model import nominal_model
from astropolcal.gap.problem import GapProblem, orthonormal
from astropolcal.optics import COORDINATES
from astropolcal.simulation import simulate

__all__ = ["Exposure", "exposures", "few", "plan"]

_TURN = tuple(float(a) for a in np.mod(np.arange(8) * 56.25, 360))
_DEROTATOR = tuple(float(a) for a in np.arange(0, 180, 20))
_ALTITUDE = (25.0, 45.0, 65.0, 80.0)
_LEVELS = (0.5, 2.0)
_MODULATOR, _STATES = "flc_state", ("A", "B")
# singular values of unit columns below this are open directions
_OPEN = 1e-6
# a change of this size (radian or relative) has to be seen
_WANTED = 0.01
# what cannot be seen to one standard deviation is not worth an exposure
_LEAST_GAIN = 1.0
# exposures of different kinds for the same purpose, and the gain that each deviation from the
# set-up of the data must bring
_SAME_PURPOSE, _WORTH_A_CHANGE = 2, 1.1
_FULL_TURN = 270.0


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
    positions : tuple of (str, float)
        Other stages and their angle in degree.
    polarizer_turned : float
        Degrees by which the calibration polarizer is turned.
    lamp : float
        Brightness of the lamp, relative to that of the dataset.
    without : tuple of str
        Optics that are taken out.
    states : tuple of str
        States of a modulator, "A" and "B", in which each angle is taken, one frame each; empty
        where there is no modulator.

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

    @property
    def setup(self):
        """What is the same in exposures that are computed together."""
        return self.dataset, self.polarizer_turned, self.lamp, self.without, bool(self.states)

    @property
    def n_frames(self):
        """Number of frames: each angle in each state."""
        return len(self.hwp) * max(len(self.states), 1)

    @property
    def plate(self):
        """Half-wave-plate angle of every frame, degree."""
        return np.repeat(self.hwp, max(len(self.states), 1))

    @property
    def modulator(self):
        """State of the modulator in every frame, A or B."""
        return np.tile(self.states, len(self.hwp))

    @property
    def kind(self):
        """What it changes: exposures of one kind differ by their angles alone."""
        return self.polarizer_turned != 0, self.lamp != 1, self.without

    @property
    def effort(self):
        """Number of things to change in the set-up of the data, apart from the derotator."""
        return sum(map(bool, self.kind)) + self._turns

    @property
    def _turns(self):
        return max(self.hwp) - min(self.hwp) > _FULL_TURN

    @property
    def words(self):
        """The exposure in words."""
        span = f"from {min(self.hwp):.4g} to {max(self.hwp):.4g} deg"
        if self._turns:
            steps = ", ".join(f"{angle:g}" for angle in self.hwp[:3])
            span = f"over a full turn ({steps}, ... deg)"
        parts = [f"{len(self.hwp)} half-wave-plate angles {span}"]
        if self.states:
            plural = "s" * (len(self.states) > 1)
            parts[0] += f" in state{plural} {' and '.join(self.states)} of the modulator"
        parts += [f"{name} at {angle:g} deg" for name, angle in self.positions]
        if self.polarizer_turned:
            parts.append(f"the polarizer turned by {self.polarizer_turned:g} deg")
        parts += [f"{name} taken out" for name in self.without]
        if self.lamp != 1:
            level = "half" if self.lamp == 0.5 else f"{self.lamp:g} times"
            parts.append(f"the lamp {level} as bright")
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
    54
    """
    found = []
    for i, (chain, observations) in enumerate(zip(model.chains, model.observations, strict=True)):
        if "hwp" not in observations.frames.colnames:
            continue
        taken = np.unique(np.round(np.rad2deg(observations.position("hwp")), 2))
        cycles = [tuple(float(a) for a in taken[:8]), _TURN]
        states = _STATES if _MODULATOR in stages(chain) else ()
        base = [
            Exposure(i, cycle, where, states=states)
            for cycle in cycles
            for where in _settings(chain)
        ]
        found += base
        roles = Roles(chain)
        if roles.polarizer is not None:
            found += [replace(one, polarizer_turned=45.0) for one in base]
            if not any(Roles(other).polarizer is None for other in model.chains):
                found += [replace(one, without=(roles.polarizer.name,)) for one in base]
        if flux_matters:
            found += [replace(one, lamp=level) for one in base for level in _LEVELS]
    return found


def _settings(chain):
    """Return the positions of the stages other than the plate that are tried."""
    known = [name for name in stages(chain) if name not in (*COORDINATES, "hwp")]
    if "derotator" not in known and "altitude" not in known:
        return [tuple((name, 45.0) for name in known)]
    moved = "altitude" if "altitude" in known else "derotator"
    angles = _ALTITUDE if moved == "altitude" else _DEROTATOR
    rest = tuple((name, 45.0) for name in known if name != moved)
    return [((moved, angle), *rest) for angle in angles]


def plan(model, effects=(), *, members=None, candidates=None, limit=4):
    """
    Rank exposures by how well they tell effects apart or fix what is open.

    Parameters
    ----------
    model : Model
        The fitted model without the effects.
    effects : sequence of str
        Names of an alias group.
    members : dict of str to Model, optional
        The model fitted with each of the effects, if known already.
    candidates : sequence of Exposure, optional
        By default those of ``exposures``.
    limit : int
        Most exposures to return.

    Returns
    -------
    list of dict
        ``words``; ``separates``, the two effects, or the parameters of the open
        direction that is seen best; ``gain``, the standard deviations at which
        they come apart, or at which a change of that direction by 0.01 (rad)
        shows. Best first, at most two a pair of effects, which differ in more than
        angles; empty if nothing is to be told apart or no exposure does.

    Raises
    ------
    GapError
        If an effect is unknown or has no place in the chains.

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
    members = dict(members or {})
    for name in effects:
        if name not in members:
            members[name] = _with_effect(model, name)
    pairs = list(combinations(members, 2))
    everyone = [model, *members.values()]
    if candidates is None:
        used = {s for m in everyone for c in m.chains for s in stages(c)}
        matters = bool(used & set(COORDINATES) - {_MODULATOR})
        candidates = exposures(model, flux_matters=matters)
    candidates = list(candidates)
    _check(candidates, model)
    old = {name: _Old(member, model) for name, member in {None: model, **members}.items()}
    lists = {pair: [] for pair in pairs}
    n_open, fixing = old[None].directions[1].shape[1] if model.problem.size else 0, []
    for group in _groups(candidates):
        new = {name: _New(old[name], model, group) for name in old}
        for j, exposure in enumerate(group):
            for a, b in pairs:
                gain = min(_separation(old, new, a, b, j), _separation(old, new, b, a, j))
                purpose = f"tells {_titled(a)} from {_titled(b)}"
                _note(lists[a, b], exposure, (a, b), gain, purpose)
            if n_open:
                names, gain, count = old[None].fixes(new[None].columns(j))
                purpose = (
                    f"fixes {count} of {n_open} open directions of the parameters, the clearest "
                    f"that of {' with '.join(names)},"
                )
                _note(fixing, exposure, names, gain, purpose)
    return _best([*lists.values(), fixing], limit)


def _with_effect(model, name):
    effect = get_effect(name)
    if not effect.applies(model.chains):
        raise GapError(f"effect {name!r} has no place in these chains")
    if effect.kind == "discrete":
        edited = effect.edit(model.chains, model.context).chains
        return nominal_model(edited, model.observations)
    return model if name in model.added else model.with_effect(effect)


def _check(candidates, model):
    n = len(model.chains)
    for one in candidates:
        if not 0 <= one.dataset < n:
            raise GapError(f"exposure of dataset {one.dataset}; there are {n}, from 0")
        if len(one.hwp) == 0 or not np.all(np.isfinite(one.hwp)):
            raise GapError(
                f"exposure with half-wave-plate angles {one.hwp}: finite ones are needed"
            )
        if not (np.isfinite(one.lamp) and one.lamp > 0):
            raise GapError(f"exposure with lamp = {one.lamp}: it must be positive")
        if not set(one.states) <= set(_STATES):
            raise GapError(f"exposure with states {one.states}: allowed are {', '.join(_STATES)}")
        if bool(one.states) != (_MODULATOR in stages(model.chains[one.dataset])):
            raise GapError(
                f"exposure of dataset {one.dataset} with states {one.states}: they are needed "
                "where the chain has a modulator, and nowhere else"
            )


def _groups(candidates):
    setups = {}
    for one in candidates:
        setups.setdefault(one.setup, []).append(one)
    return list(setups.values())


def _titled(name):
    return f"{EFFECTS[name].title} ({name})" if name in EFFECTS else name


def _note(rows, exposure, names, gain, purpose):
    if gain >= _LEAST_GAIN:
        words = f"Take {exposure.words}: {purpose} at {_sigmas(gain)} standard deviations"
        entry = {"words": words, "separates": list(names), "gain": float(gain)}
        rows.append((gain / _WORTH_A_CHANGE**exposure.effort, exposure, entry))


def _sigmas(gain):
    return f"{gain:.2g}" if gain < 100 else f"{gain:.0f}"


def _best(lists, limit):
    """Return the best of each kind of each list in turn, sorted by gain."""
    found = []
    for rows in lists:
        kinds = {}
        for _, exposure, entry in sorted(rows, key=lambda row: -row[0]):
            kinds.setdefault(exposure.kind, entry)
        found.append(list(kinds.values())[:_SAME_PURPOSE])
    return _in_turn(found, limit)


def _in_turn(lists, limit):
    chosen = [one[i] for i in range(limit) for one in lists if i < len(one)]
    return sorted(chosen[:limit], key=lambda entry: -entry["gain"])


def few(entries, limit=4):
    """
    Return the best of several plans: few, and of different purposes.

    Parameters
    ----------
    entries : sequence of dict
        As `plan` gives them, of several calls.
    limit : int
        Most exposures to return.

    Returns
    -------
    list of dict
        At most two for the same purpose, and the best of every purpose before
        the second of any; an exposure that serves several is named once. Largest
        gain first.

    Examples
    --------
    >>> from astropolcal.gap.planning import few
    >>> words = [f"Take {x}: tells a from b" for x in ("this", "that", "other")]
    >>> both = {"separates": ["a", "b"], "gain": 5.0}
    >>> plans = [both | {"words": w, "gain": 5.0 - i} for i, w in enumerate(words)]
    >>> [entry["gain"] for entry in few(plans)]
    [5.0, 4.0]
    """
    purposes = {}
    for entry in sorted(entries, key=lambda entry: -entry["gain"]):
        found = purposes.setdefault(frozenset(entry["separates"]), {})
        found.setdefault(_exposure(entry), entry)
    best = [list(found.values())[:_SAME_PURPOSE] for found in purposes.values()]
    exposed = {}
    for entry in _in_turn(best, limit):
        exposed.setdefault(_exposure(entry), []).append(entry)
    return [_merged(exposure, found) for exposure, found in exposed.items()]


def _exposure(entry):
    return entry["words"].partition(": ")[0]


def _merged(exposure, entries):
    """Return one entry of an exposure that serves several purposes; the best gain counts."""
    purposes = [entry["words"].partition(": ")[2] for entry in entries]
    names = dict.fromkeys(name for entry in entries for name in entry["separates"])
    words = f"{exposure}: {'; '.join(purposes)}"
    return entries[0] | {"words": words, "separates": list(names)}


# ---- what the data know already -------------------------------------------------------------


class _Old:
    """A fitted model, and the triangle of its least-squares problem on the data taken."""

    def __init__(self, member, base):
        self.member, self.base, self.problem = member, base, member.problem
        q = member.fit.coefficients
        raw = self.problem.jacobian(q, whitened=False).T
        slopes = np.concatenate(
            [
                c.whiten(raw[:, rows].reshape(-1, *c.shape)).reshape(len(raw), -1)
                for c, rows in zip(base.problem.channels, base.problem.segments, strict=True)
            ],
            axis=1,
        ).T
        self.slopes = np.concatenate([slopes, np.diag(self.problem.tight)])
        self.scale = np.linalg.norm(self.slopes, axis=0)
        self.scale = np.where(self.scale > 0, self.scale, 1.0)
        self.gaps = self.problem.differences(q)
        self._triangles = {}

    def triangle(self, other):
        """Return the triangle of slopes and of the difference to another model's predictions."""
        if id(other) not in self._triangles:
            parts = zip(self.base.problem.channels, self.gaps, other.gaps, strict=True)
            difference = [c.whiten(mine - theirs).ravel() for c, mine, theirs in parts]
            target = np.concatenate([*difference, np.zeros(self.problem.size)])
            table = np.concatenate([self.slopes / self.scale, target[:, None]], axis=1)
            self._triangles[id(other)] = qr(table, mode="r")[0][: table.shape[1]]
        return self._triangles[id(other)]

    @cached_property
    def directions(self):
        """Directions of unit columns that the data determine, and those that they leave open."""
        _, singular, right = np.linalg.svd(self.slopes / self.scale, full_matrices=False)
        is_open = singular < _OPEN * singular[0]
        return right[~is_open].T, right[is_open].T

    def fixes(self, columns):
        """
        Return what new rows say of the open directions.

        That is the parameters of the one seen best, at how many standard deviations a
        change of it shows, and how many directions show at all.
        """
        known, unknown = self.directions
        table = np.concatenate([self.slopes, columns]) / self.scale
        basis = orthonormal(table @ known)
        left = table @ unknown
        # twice is enough to be orthogonal to rounding
        left -= basis @ (basis.T @ left)
        left -= basis @ (basis.T @ left)
        _, singular, right = np.linalg.svd(left, full_matrices=False)
        steps = np.abs(unknown @ right.T) / self.scale[:, None]
        sigmas = _WANTED * singular / steps.max(axis=0)
        best = int(np.argmax(sigmas))
        step = steps[:, best]
        main = [i for i in np.argsort(-step)[:3] if step[i] > 0.3 * step.max()]
        names = [self.problem.names[i] for i in main]
        return names, float(sigmas[best]), int(np.sum(sigmas > _LEAST_GAIN))


# ---- what it would see -----------------------------------------------------------------------


class _New:
    """Predictions of a fitted model, and their slopes, for exposures of one set-up."""

    def __init__(self, old, base, group):
        member, first = old.member, group[0]
        chain = _set_up(member.chains[first.dataset], first)
        observations = _hypothetical(base, group)
        own = {leaf.name for leaf in leaves(chain)}
        ties = {
            name: tie
            for name, tie in member.problem.ties.items()
            if name.split(".")[0] in own and tie.source.split(".")[0] in own
        }
        problem = GapProblem([chain], [observations], ties=ties, laws=member.problem.laws)
        channel, vector = problem.channels[0], problem.vector(problem.start)
        self.predicted = channel.predicted(problem.datasets[0].forward(vector))
        slopes = problem.jacobian(problem.start, whitened=False).T.reshape(-1, *channel.shape)
        self.slopes = np.zeros((member.problem.size, *channel.shape))
        for name, where in problem.slices.items():
            self.slopes[member.problem.slices[name]] = slopes[where]
        edges = np.cumsum([0, *(one.n_frames for one in group)])
        self.frames = [slice(a, b) for a, b in pairwise(edges)]
        self.noise = _Noise(base, first)

    def columns(self, j):
        """Return the whitened slopes of one exposure, shape (rows, n_coefficients)."""
        whitened = self.noise.whiten(self.slopes[..., self.frames[j]])
        return whitened.reshape(len(whitened), -1).T

    def against(self, other, j):
        """Return the whitened difference of the predictions of one exposure."""
        frames = self.frames[j]
        return self.noise.whiten(other.predicted[..., frames] - self.predicted[..., frames]).ravel()


def _separation(old, new, truth, fitted, j):
    """Return by how many standard deviations an exposure speaks against a wrong model."""
    triangle = old[fitted].triangle(old[truth])
    added = np.column_stack(
        [new[fitted].columns(j) / old[fitted].scale, new[fitted].against(new[truth], j)]
    )
    table = np.concatenate([triangle, added])
    basis = orthonormal(table[:, :-1])
    left = table[:, -1] - basis @ (basis.T @ table[:, -1])
    return float(np.sqrt(max(left @ left - triangle[-1, -1] ** 2, 0.0)))


def _set_up(chain, exposure):
    """Return a copy of a chain as the exposure needs it."""
    chain = chain.copy()
    polarizer = Roles(chain).polarizer
    if exposure.polarizer_turned:
        if polarizer is None:
            raise GapError("no polarizer to turn in the chain of this dataset")
        angle = exposure.polarizer_turned
        theta = polarizer.theta
        theta.bounds = tuple(None if b is None else b + angle for b in theta.bounds)
        theta.value = theta.value + angle
    for name in exposure.without:
        chain = remove_optic(chain, name)
    return chain


def _hypothetical(base, group):
    """Return noiseless observations of the exposures, as bright as their dataset."""
    i, exposure = group[0].dataset, group[0]
    problem, observations = base.problem, base.observations[group[0].dataset]
    chain = _set_up(base.chains[i], exposure)
    for leaf in leaves(chain):
        if leaf.stage in COORDINATES and leaf.stage != _MODULATOR:
            chain = remove_optic(chain, leaf.name)
    sweep = problem.datasets[i].forward(problem.vector(base.fit.coefficients))
    expected = np.median(np.sum(sweep.fluxes, axis=0), axis=1)
    measured = np.exp(np.median(problem.channels[i].observed[1], axis=1))
    frames = QTable({"hwp": np.concatenate([one.plate for one in group]) * u.deg})
    for name, _ in exposure.positions:
        values = [np.full(one.n_frames, dict(one.positions)[name]) for one in group]
        frames[name] = np.concatenate(values) * u.deg
    if "derotator" not in frames.colnames:
        # tables have it, also those of instruments without one
        frames["derotator"] = np.zeros(len(frames)) * u.deg
    if exposure.states:
        states = np.concatenate([one.modulator for one in group])
        frames[_MODULATOR] = (states == _STATES[1]).astype(float)
    return simulate(
        chain,
        problem.wavelength * u.um,
        frames,
        flux=exposure.lamp * measured / expected,
        noise=False,
        name=f"next {observations.name}",
    )


class _Noise:
    """Noise of new frames: that of the dataset, and a lamp of unknown brightness."""

    def __init__(self, base, exposure):
        channel = base.problem.channels[exposure.dataset]
        sigma = np.where(channel.valid, channel.sigma, np.nan)
        self.weight = np.sqrt(exposure.lamp) / np.nanmedian(sigma, axis=2)[..., None]
        self.flicker = channel.lamp.flicker

    def whiten(self, array):
        """Divide by the noise; take out flicker and the brightness at each wavelength."""
        weight = np.where(np.isfinite(self.weight), self.weight, 0.0)
        out = array * weight
        # the brightness at each wavelength is that of this block alone
        sums = out[..., 1, :, :] - out[..., 1, :, :].mean(axis=-1, keepdims=True)
        norm = np.sqrt(np.sum(weight[1] ** 2))
        direction = weight[1] / (norm if norm > 0 else 1.0)
        shrink = 1 - 1 / np.sqrt(1 + (self.flicker * norm) ** 2)
        common = np.sum(sums * direction, axis=-2, keepdims=True)
        out[..., 1, :, :] = sums - shrink * common * direction
        return out
