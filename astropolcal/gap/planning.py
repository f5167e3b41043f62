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
from itertools import combinations

import numpy as np

from astropolcal.calibration._directions import ranked
from astropolcal.chain import stages
from astropolcal.exceptions import GapError, ParameterError
from astropolcal.gap._forecast import LEAST_GAIN, MODULATOR, STATES, Foreseen, Known, separation
from astropolcal.gap.effects import Roles, get_effect
from astropolcal.gap.model import nominal_model
from astropolcal.optics import COORDINATES

__all__ = ["Exposure", "exposures", "few", "plan"]

# eight steps of 56.25 deg cover a turn and all angles modulo 90 deg in 11.25 deg steps
_TURN = tuple(float(a) for a in np.mod(np.arange(8) * 56.25, 360))
_DEROTATOR = tuple(float(a) for a in np.arange(0, 180, 20))
# degree; low to high, the range in which stars are usually observed
_ALTITUDE = (25.0, 45.0, 65.0, 80.0)
_LEVELS = (0.5, 2.0)
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
        # the angles that are taken anyway, and a full turn, which tells odd harmonics
        cycles = [tuple(float(a) for a in taken[:8]), _TURN]
        states = STATES if MODULATOR in stages(chain) else ()
        base = [
            Exposure(i, cycle, where, states=states)
            for cycle in cycles
            for where in _settings(chain)
        ]
        found += base
        roles = Roles(chain)
        if roles.polarizer is not None:
            # Q into U: what acts on one of them alone shows
            found += [replace(one, polarizer_turned=45.0) for one in base]
            # a dataset without it is that exposure already
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
    effects : sequence of str or Effect
        An alias group.
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
    known = {one.name: one for one in map(get_effect, effects)}
    for name, effect in known.items():
        if name not in members:
            members[name] = _with_effect(model, effect)
    pairs = list(combinations(members, 2))
    everyone = [model, *members.values()]
    if candidates is None:
        used = {s for m in everyone for c in m.chains for s in stages(c)}
        matters = bool(used & set(COORDINATES) - {MODULATOR})
        candidates = exposures(model, flux_matters=matters)
    candidates = list(candidates)
    _check(candidates, model)
    old = {name: Known(member, model) for name, member in {None: model, **members}.items()}
    lists = {pair: [] for pair in pairs}
    n_open, fixing = old[None].directions[1].shape[1] if model.problem.size else 0, []
    for group in _groups(candidates):
        try:
            new = {name: Foreseen(old[name], model, group) for name in old}
        except ParameterError as error:
            # a model of data that lack much need not be physical at angles they do not have, and
            # foresees nothing there
            if error.argument != "chain":
                raise
            continue
        for j, exposure in enumerate(group):
            for a, b in pairs:
                # whichever of both is the truth, the other has to fail
                gain = min(separation(old, new, a, b, j), separation(old, new, b, a, j))
                purpose = f"tells {_titled(a, known)} from {_titled(b, known)}"
                _note(lists[a, b], exposure, (a, b), gain, purpose)
            if n_open:
                names, gain, count = old[None].fixes(new[None].columns(j))
                purpose = (
                    f"fixes {count} of {n_open} open directions of the parameters, the clearest "
                    f"that of {' with '.join(names)},"
                )
                _note(fixing, exposure, names, gain, purpose)
    return _best([*lists.values(), fixing], limit)


def _with_effect(model, effect):
    name = effect.name
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
        if not set(one.states) <= set(STATES):
            raise GapError(f"exposure with states {one.states}: allowed are {', '.join(STATES)}")
        if bool(one.states) != (MODULATOR in stages(model.chains[one.dataset])):
            raise GapError(
                f"exposure of dataset {one.dataset} with states {one.states}: they are needed "
                "where the chain has a modulator, and nowhere else"
            )


def _groups(candidates):
    setups = {}
    for one in candidates:
        setups.setdefault(one.setup, []).append(one)
    return list(setups.values())


def _titled(name, known):
    return f"{known[name].title} ({name})" if name in known else name


def _note(rows, exposure, names, gain, purpose):
    if gain >= LEAST_GAIN:
        words = f"Take {exposure.words}: {purpose} at {_sigmas(gain)} standard deviations"
        entry = {"words": words, "separates": list(names), "gain": float(gain)}
        # of nearly equal gain the one with less to change comes first
        rows.append((gain / _WORTH_A_CHANGE**exposure.effort, exposure, entry))


def _sigmas(gain):
    return f"{gain:.2g}" if gain < 100 else f"{gain:.0f}"


def _best(lists, limit):
    """Return the best of each kind of each list in turn, sorted by gain."""
    found = []
    for rows in lists:
        kinds = {}
        for i in ranked([row[0] for row in rows]):
            _, exposure, entry = rows[i]
            kinds.setdefault(exposure.kind, entry)
        found.append(list(kinds.values())[:_SAME_PURPOSE])
    return _in_turn(found, limit)


def _in_turn(lists, limit):
    # the best of every purpose, then the second of each
    chosen = [one[i] for i in range(limit) for one in lists if i < len(one)]
    return _largest_first(chosen[:limit])


def _largest_first(entries):
    return [entries[i] for i in ranked([entry["gain"] for entry in entries])]


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
    for entry in _largest_first(entries):
        # a pair is the same purpose in either order
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
