# Licensed under a 3-clause BSD style license - see LICENSE
"""Parameters that the nominal model holds fixed, or that have run into a bound."""

import astropy.units as u
import numpy as np

from astropolcal.chain import replace_optic
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter
from astropolcal.gap.effects.roles import is_held

__all__ = [
    "DerotatorAngleBound",
    "DerotatorMisalignment",
    "DerotatorRetardanceBound",
    "MirrorMisalignment",
    "PlateAngleBound",
    "PlateMisalignment",
    "PlateThicknessBound",
    "PolarizerAngleBound",
    "PolarizerMisalignment",
]

# nearer to a bound than this share of the limit is at the bound
_NEAR = 1e-4


class _Freed(Effect):
    """Parameters of one optic that become free, within their bounds or wider ones."""

    kind = "parameter"
    acts_on = "plate"

    #: Parameter to (size to expect, largest change that is physical).
    free = {"theta": (0.5 * u.deg, 5 * u.deg)}

    def is_open(self, parameter, limit):
        """Return whether the effect may act on a parameter: one that is fixed."""
        return is_held(parameter)

    def applies_to(self, roles):
        """Return whether one of the parameters is held."""
        optic = getattr(roles, self.acts_on)
        return optic is not None and any(
            self.is_open(getattr(optic, key), limit) for key, (_, limit) in self._own(optic)
        )

    def _own(self, optic):
        return [(key, sizes) for key, sizes in self.free.items() if key in optic.param_names]

    def edit(self, chains, context):
        """Return the chains with the parameters free; see `Effect.edit`."""
        edited, added = [], {}
        for chain in chains:
            optic = getattr(self.roles(chain), self.acts_on)
            if optic is not None:
                fresh = optic.copy()
                # a dict, for the same parameter in two datasets is one
                added |= self._release(fresh)
                chain = replace_optic(chain, optic.name, fresh)
            edited.append(chain)
        return Edit(edited, list(added.values()))

    def _release(self, optic):
        """Free the parameters of one optic, and return them by name."""
        found = {}
        for key, (scale, limit) in self._own(optic):
            parameter = getattr(optic, key)
            if not self.is_open(parameter, limit):
                continue
            # where it was held is where the effect is absent
            value = u.Quantity(parameter.value, parameter.unit or u.one)
            parameter.fixed, parameter.prior = False, None
            parameter.bounds = _around(parameter, limit, getattr(type(optic), key).bounds)
            name = f"{optic.name}.{key}"
            found[name] = EffectParameter(name, scale, limit, neutral=value)
        return found


def _in_unit(quantity, parameter):
    return u.Quantity(quantity).to_value(parameter.unit or u.one)


def _around(parameter, limit, possible):
    """
    Return bounds that leave room on both sides of the value, and are no tighter than before.

    The room ends where the optic itself has its bounds.
    """
    room = _in_unit(limit, parameter)
    low, high = parameter.bounds
    least = -np.inf if possible[0] is None else possible[0]
    most = np.inf if possible[1] is None else possible[1]
    value = np.asarray(parameter.value)
    return (
        None if low is None else min(low, max(least, float(value.min()) - room)),
        None if high is None else max(high, min(most, float(value.max()) + room)),
    )


class PlateMisalignment(_Freed):
    """
    Orientation of the half-wave plate that the model holds fixed.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_misalignment").acts_on
    'plate'
    """

    name, place = "hwp_misalignment", "half-wave plate"
    title = "orientation of the half-wave plate, which the model holds fixed"
    shows = "phase of harmonic 4 of the plate angle, the same at all wavelengths"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"


class DerotatorMisalignment(PlateMisalignment):
    """
    Orientation of the derotator that the model holds fixed.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_misalignment").acts_on
    'derotator'
    """

    name, place, acts_on = "derotator_misalignment", "derotator", "derotator"
    title = "orientation of the derotator, which the model holds fixed"
    shows = "pattern in derotator angle of a turned derotator, with its retardance"


class PolarizerMisalignment(PlateMisalignment):
    """
    Orientation of the calibration polarizer that the model holds fixed.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("polarizer_misalignment").acts_on
    'polarizer'
    """

    name, place, acts_on = "polarizer_misalignment", "calibration polarizer", "polarizer"
    title = "orientation of the calibration polarizer, which the model holds fixed"
    shows = "phase of harmonic 4 of the plate angle, polarized data alone"


class MirrorMisalignment(PlateMisalignment):
    """
    Orientation of what polarizes the unpolarized source a little, held fixed in the model.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("mirror_misalignment").acts_on
    'mirror'
    """

    name, place, acts_on = "mirror_misalignment", "mirror in front of the half-wave plate", "mirror"
    title = "orientation of the mirror in front of the half-wave plate, held fixed by the model"
    shows = "phase of harmonic 4 of the plate angle, unpolarized data alone"
    # a mirror's plane may be anywhere: 45 deg is as far as an axis can be off
    free = {"theta": (1 * u.deg, 45 * u.deg)}


class _Lifted(_Freed):
    """Parameters that have run into a bound, with room beyond it."""

    kind = "bound"
    shows = "along the derivative to the parameter that is at its bound"
    reference = "residual of a constrained fit; Nocedal & Wright 2006, chapter 12"

    def is_open(self, parameter, limit):
        """Return whether a parameter is at its lower or upper bound."""
        # a bounded fit may end a little before its bound
        value, near = np.asarray(parameter.value), _NEAR * _in_unit(limit, parameter)
        low, high = parameter.bounds
        at_low = low is not None and np.any(value <= low + near)
        return bool(at_low or (high is not None and np.any(value >= high - near)))


class PlateAngleBound(_Lifted):
    """
    Orientation of the half-wave plate beyond its bound.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_angle_bound").kind
    'bound'
    """

    name, place = "hwp_angle_bound", "half-wave plate"
    title = "orientation of the half-wave plate beyond its bound"
    free = {"theta": (1 * u.deg, 10 * u.deg)}


class DerotatorAngleBound(PlateAngleBound):
    """
    Orientation of the derotator beyond its bound.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_angle_bound").kind
    'bound'
    """

    name, place, acts_on = "derotator_angle_bound", "derotator", "derotator"
    title = "orientation of the derotator beyond its bound"


class PolarizerAngleBound(PlateAngleBound):
    """
    Orientation of the calibration polarizer beyond its bound.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("polarizer_angle_bound").kind
    'bound'
    """

    name, place, acts_on = "polarizer_angle_bound", "calibration polarizer", "polarizer"
    title = "orientation of the calibration polarizer beyond its bound"


class PlateThicknessBound(_Lifted):
    """
    Thicknesses of the half-wave plate's layers beyond their bounds.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> sorted(get_effect("hwp_thickness_bound").free)
    ['w_mgf2', 'w_sio2']
    """

    name, place = "hwp_thickness_bound", "half-wave plate"
    title = "thickness of a layer of the half-wave plate beyond its bound"
    free = {key: (0.02 * u.mm, 0.5 * u.mm) for key in ("w_sio2", "w_mgf2")}


class DerotatorRetardanceBound(_Lifted):
    """
    Retardances of the derotator beyond their bounds.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_retardance_bound").acts_on
    'derotator'
    """

    name, place, acts_on = "derotator_retardance_bound", "derotator", "derotator"
    title = "retardance of the derotator beyond its bound"
    free = {
        key: (5 * u.deg, 180 * u.deg)
        for key in ("retardance", "horizontal", "diagonal", "circular")
    }
