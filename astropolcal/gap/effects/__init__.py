# Licensed under a 3-clause BSD style license - see LICENSE
"""
The library of effects that a model of a polarimeter may lack.

One row each of ``astropolcal.gap.effects.library``, in `EFFECTS`; `register_effect` adds your own.
"""

import astropy.units as u
import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.gap.effects.effect import (
    KINDS,
    CellEffect,
    Context,
    Edit,
    Effect,
    EffectParameter,
)
from astropolcal.gap.effects.library import LIBRARY
from astropolcal.gap.effects.where import Roles, adapted
from astropolcal.gap.problem import GapProblem
from astropolcal.words import check_choice, did_you_mean

__all__ = [
    "EFFECTS",
    "KINDS",
    "Context",
    "Edit",
    "Effect",
    "EffectParameter",
    "Roles",
    "adapted",
    "check_effect",
    "get_effect",
    "register_effect",
]

#: Every effect by name.
EFFECTS = {}
_NEEDED = ("name", "title", "kind", "place", "shows", "reference")
_TAKEN = "an effect {!r} is registered already; give yours another name"
# of the largest flux: far above rounding, far below any noise
_SAME = 1e-10
# step of the differences, in units of the size to expect, and error that they may have
_STEP, _ERROR = 1e-3, 1e-4
# derivatives are compared at zero and at this share of the size to expect
_PLACES = (0.0, 0.5)


def register_effect(effect):
    """
    Add an effect to the library.

    Parameters
    ----------
    effect : Effect or type
        An effect, or its class.

    Returns
    -------
    Effect or type
        The same, so that it serves as a decorator.

    Raises
    ------
    GapError
        If an effect of that name is there already, it lacks an attribute, or it
        is of no known kind.

    See Also
    --------
    check_effect : tests derivatives and laws on chains and data.

    Examples
    --------
    >>> from astropolcal.gap.effects import EFFECTS, get_effect, register_effect
    >>> register_effect(get_effect("fringes").of(15.0)).name
    'fringes_15_um'
    >>> removed = EFFECTS.pop("fringes_15_um")
    """
    one = effect() if isinstance(effect, type) else effect
    _check_declared(one)
    if one.name in EFFECTS:
        raise GapError(_TAKEN.format(one.name))
    EFFECTS[one.name] = one
    return effect


def check_effect(effect, chains, observations):
    """
    Check on chains and data that an effect does what a diagnosis relies on.

    It has all its attributes and a name of its own; it leaves the chains given
    as they are; at zero the edited chains predict the same fluxes; the names of
    its parameters are new, and its parameters are free; and the analytic
    derivative of both channels to each of them is that of central differences.

    Parameters
    ----------
    effect : Effect or type
        An effect, or its class; registered or not.
    chains : sequence
        The nominal chain of each dataset.
    observations : sequence of Observations
        The datasets; simulated ones will do.

    Raises
    ------
    GapError
        If one of this is not so; the message names what, where, and by how much.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import check_effect
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> check_effect("hwp_tilt", [charis.chain()], [observations])
    """
    one = get_effect(effect() if isinstance(effect, type) else effect)
    # the registered effect itself may be checked, a namesake may not
    if one.name in EFFECTS and type(EFFECTS[one.name]) is not type(one):
        raise GapError(_TAKEN.format(one.name))
    _check_against(one, chains, observations)


def get_effect(name):
    """
    Return the effect of that name.

    Parameters
    ----------
    name : str or Effect
        Its name, or ``"name:optic"`` for that of one optic among several of a kind; an `Effect` is
        returned as it is.

    Returns
    -------
    Effect

    Raises
    ------
    GapError
        If there is none; the message names the nearest.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("beam_gain").title
    'unequal gains of the two beams (flat field)'
    """
    if isinstance(name, Effect):
        # a cell of the diagnosis declares nothing
        if not isinstance(name, CellEffect):
            _check_declared(name)
        return name
    if name in EFFECTS:
        return EFFECTS[name]
    whole, _, optic = str(name).partition(":")
    if optic and whole in EFFECTS and EFFECTS[whole].acts_on:
        return EFFECTS[whole].at(optic)
    near = did_you_mean(name, EFFECTS, most=3)
    # all names would be a line of more than a thousand characters
    raise GapError(
        f"no effect {name!r}{f'{near} All' if near else '; all'} {len(EFFECTS)} are listed by "
        "'astropolcal diagnose --effects help'"
    )


def _check_declared(effect):
    """Check that an effect has its attributes and is of a known kind."""
    if not isinstance(effect, Effect):
        raise GapError(f"{effect!r} is not an Effect")
    lacking = [key for key in _NEEDED if not getattr(effect, key)]
    # one that neither inserts an optic nor edits chains in its own way
    if not effect.kinds and effect.inserted is None and type(effect) is Effect:
        lacking.append("kind")
    if lacking:
        raise GapError(f"effect {effect.name or type(effect).__name__} lacks {', '.join(lacking)}")
    check_choice(f"effect {effect.name}: kind", effect.kind, KINDS, GapError)


def _check_against(effect, chains, observations):
    """Check identity at zero, names and derivatives of an effect on chains and data."""
    chains, observations = list(chains), list(observations)
    if not effect.applies(chains):
        raise _failed(effect, "has no place in these chains")
    # a diagnosis edits the same chains for a hundred effects: they must stay as they are
    before = [_state(chain) for chain in chains]
    nominal = GapProblem(chains, observations)
    nominal.settle_noise()
    try:
        edit = effect.edit(chains, Context.of(nominal.wavelength, observations))
    except AstropolcalError as error:
        raise _failed(effect, f"cannot edit the chains: {error}") from error
    names = [parameter.name for parameter in edit.parameters]
    twice = sorted({name for name in names if names.count(name) > 1})
    discrete = effect.kind == "discrete"
    wrong = {
        f"gives {len(edit.chains)} chains for {len(chains)}": len(edit.chains) != len(chains),
        "changes the chains that it is given; edit copies of the optics": (
            [_state(chain) for chain in chains] != before
        ),
        "is discrete and has parameters; make it another kind": discrete and names,
        "adds no parameter": not discrete and not names,
        f"names the parameter {next(iter(twice), None)} twice": twice,
    }
    for words, is_wrong in wrong.items():
        if is_wrong:
            raise _failed(effect, words)
    like = None if discrete else nominal
    try:
        how = {"ties": edit.ties, "laws": edit.laws, "neutral": edit.neutral, "like": like}
        problem = GapProblem(edit.chains, observations, **how)
    except AstropolcalError as error:
        raise _failed(effect, f"gives chains that cannot be fitted: {error}") from error
    if discrete:
        return
    for parameter in edit.parameters:
        _check_parameter(effect, parameter, problem, nominal)
    for number, pair in enumerate(zip(problem.datasets, nominal.datasets, strict=True)):
        new, old = (
            np.stack(dataset.forward(one.vector(one.start)).fluxes)
            for dataset, one in zip(pair, (problem, nominal), strict=True)
        )
        change = np.max(np.abs(new - old)) / np.max(np.abs(old))
        if not change < _SAME:
            raise _failed(
                effect,
                f"changes the fluxes of dataset {number} by {change:.2g} at zero parameters; "
                "it must be the identity there",
            )
    for parameter in edit.parameters:
        _check_derivative(effect, problem, parameter)


def _failed(effect, words):
    return GapError(f"effect {effect.name}: {words}")


def _state(chain):
    """Return all that an edit could change in a chain."""
    found = []
    for leaf in leaves(chain):
        found += [leaf.name, leaf.mount]
        for one in (getattr(leaf, key) for key in leaf.param_names):
            found.append((np.array(one.value).tolist(), bool(one.fixed), tuple(one.bounds)))
    return found


def _check_parameter(effect, parameter, problem, nominal):
    """Check that a parameter is new, and in the chains."""
    name, free, there = parameter.name, problem.free.by_name, nominal.free.by_name
    if name not in free:
        new = ", ".join(sorted(set(free) - set(there)))
        raise _failed(effect, f"{name} is not free in its chains; new and free: {new or '-'}")
    # a lifted bound, or prior, frees nothing that was not free: it gives room
    known = {one for one, _ in nominal.known}
    if name in there and name not in known and effect.kind != "bound":
        raise _failed(effect, f"{name} is free in the chains without it already")
    slot = free[name]
    if parameter.basis is not None and len(parameter.basis) != slot.size:
        raise _failed(effect, f"{name}: a law for {len(parameter.basis)} of {slot.size} values")
    for what in ("scale", "limit"):
        effect._check_size(what, getattr(parameter, what), slot.unit or u.one)


def _check_derivative(effect, problem, parameter):
    """Compare the derivative of both channels with central differences."""
    where, scale = problem.slices[parameter.name], parameter.canonical_scale
    # f' = (8 [f(h) - f(-h)] - [f(2h) - f(-2h)]) / 12 h, with an error of h^4
    steps, weights = _STEP * scale * np.array([1, -1, 2, -2]), np.array([8, -8, -1, 1])
    for place in _PLACES:
        middle = problem.start.copy()
        middle[where] += place * scale
        slopes = problem.jacobian(middle, whitened=False)
        for column in range(where.start, where.stop):
            moved = [middle + step * np.eye(problem.size)[column] for step in steps]
            # differences are observed minus predicted
            rows = [np.concatenate([d.ravel() for d in problem.differences(q)]) for q in moved]
            expected = -(weights @ rows) / (12 * _STEP * scale)
            # a derivative that is zero has no relative error
            size = max(np.abs(expected).max(), 1e-9 / scale)
            worst = np.abs(slopes[:, column] - expected).max() / size
            if not worst < _ERROR:
                raise _failed(
                    effect,
                    f"derivative to {problem.names[column]} differs from central differences by "
                    f"{100 * worst:.3g} % of its largest value",
                )


for _effect in LIBRARY:
    register_effect(_effect)
