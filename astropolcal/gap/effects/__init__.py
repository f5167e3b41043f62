# Licensed under a 3-clause BSD style license - see LICENSE
"""
The library of effects that a model of a polarimeter may lack.

One row each of ``astropolcal.gap.effects.library``, in `EFFECTS`; `register_effect` adds your own.
"""

from astropolcal.exceptions import GapError
from astropolcal.gap.effects._check import check_against, check_declared
from astropolcal.gap.effects.base import (
    KINDS,
    Context,
    Edit,
    EffectParameter,
    tracking_laws,
)
from astropolcal.gap.effects.effect import Effect
from astropolcal.gap.effects.library import LIBRARY
from astropolcal.gap.effects.roles import Roles, adapted
from astropolcal.gap.effects.where import (
    Where,
    after,
    before,
    detector,
    direction,
    harmonic,
    inside,
    move,
    source,
    step,
    telescope,
    time,
)
from astropolcal.words import did_you_mean

__all__ = [
    "EFFECTS",
    "KINDS",
    "Context",
    "Edit",
    "Effect",
    "EffectParameter",
    "Roles",
    "Where",
    "adapted",
    "after",
    "before",
    "check_effect",
    "detector",
    "direction",
    "get_effect",
    "harmonic",
    "inside",
    "move",
    "register_effect",
    "source",
    "step",
    "telescope",
    "time",
    "tracking_laws",
]

#: Every effect by name.
EFFECTS = {}


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
    check_declared(one)
    if one.name in EFFECTS:
        raise _taken(one.name)
    EFFECTS[one.name] = one
    return effect


def _taken(name):
    return GapError(f"an effect {name!r} is registered already; give yours another name")


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
    one = effect() if isinstance(effect, type) else get_effect(effect)
    check_declared(one)
    # the registered effect itself may be checked, a namesake may not
    if one.name in EFFECTS and type(EFFECTS[one.name]) is not type(one):
        raise _taken(one.name)
    check_against(one, chains, observations)


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


for _effect in LIBRARY:
    register_effect(_effect)
