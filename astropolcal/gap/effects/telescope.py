# Licensed under a 3-clause BSD style license - see LICENSE
"""
Effects on sky: the telescope's tertiary mirror, the background, the signs of what follows the sky.

They have their place in the chains of stars, where rotations by the parallactic
angle and by the altitude stand in front of the half-wave plate.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic
from astropolcal.gap.effects._shared import LAG, Discrete, lagging
from astropolcal.gap.effects.base import Edit, EffectParameter, Insertion, label_of
from astropolcal.gap.effects.roles import is_held
from astropolcal.observations.pointings import TRACKING

__all__ = [
    "AltitudeSign",
    "ParallacticSign",
    "PlateNotTracking",
    "PlateTrackingAltitudeSign",
    "PlateTrackingParallacticSign",
    "SkyBackground",
    "SkyMotion",
    "TertiaryDiattenuation",
    "TertiaryRecoating",
    "TertiaryRetardance",
]

_VAN_HARTEN = "van Harten et al. 2009, arXiv:0903.2740"
_SIGNS = "McIntosh et al. 2026, Sec. 6.1; van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"


class _Telescope:
    """What stands between a star and the half-wave plate; None where one lacks."""

    def __init__(self, roles):
        self.parallactic = next((o for o in roles.leaves if _turns(o, "parallactic")), None)
        self.star = self.altitude = None
        # without a rotation by the parallactic angle the light is that of an internal source
        if self.parallactic is not None:
            i = next(i for i, o in enumerate(roles.leaves) if o is self.parallactic)
            before, behind = roles.leaves[:i], roles.leaves[i:]
            self.star = next((o for o in before if isinstance(o, optics.PolarizedSource)), None)
            self.altitude = next((o for o in behind if _turns(o, "altitude")), None)
        self.mirror = roles.telescope_mirror

    @property
    def is_there(self):
        """Whether the light comes from the sky."""
        return self.parallactic is not None

    @property
    def has_mirror(self):
        """Whether there is a mirror, or the place of one at the altitude axis."""
        return self.is_there and (self.mirror is not None or self.altitude is not None)

    def mirror_leaves(self, *keys):
        """Return whether no parameter of the mirror is free, its angle and ``keys`` aside."""
        # nothing is free in what is not there
        if self.mirror is None:
            return True
        others = (getattr(self.mirror, k) for k in self.mirror.param_names if k not in keys)
        # a free diattenuation or retardance of the mirror takes the effect up
        return all(is_held(parameter) for parameter in others)

    @property
    def unpolarized(self):
        """Whether the star is held at zero polarization."""
        if self.star is None:
            return False
        if isinstance(self.star, optics.StarSource):
            # nothing interstellar: unpolarized as far as the catalogue knows
            return self.star.p_max.fixed and not np.any(self.star.p_max.value)
        return all(is_held(p) and not np.any(p.value) for p in (self.star.q, self.star.u))


def _turns(optic, stage):
    return isinstance(optic, optics.Rotator) and optic.stage == stage


class _OnSky(Insertion):
    """One more optic in front of the rotation by the parallactic angle."""

    anchor = None

    def applies_to(self, roles):
        """Return whether one chain has the telescope."""
        return _Telescope(roles).is_there

    def edit(self, chains, context):
        """Return the chains with the optic at zero; see `Effect.edit`."""
        edited = []
        for chain in chains:
            roles = self.roles(chain)
            if self.applies_to(roles):
                chain = self._with(chain, _Telescope(roles), self.label, context)
            edited.append(chain)
        return Edit(edited, self.parameters(context))

    def _with(self, chain, telescope, name, context):
        optic = self._freed(self.build(len(context.wavelength), telescope, context))
        optic.name = name
        return insert_optic(chain, optic, **self.place_in(telescope))

    def place_in(self, telescope):
        """Return next to what the new optic stands, and on which side."""
        return {"before": telescope.parallactic.name}


class _OfMirror(_OnSky):
    """One more optic behind a mirror of the telescope, or in front of the altitude axis."""

    anchor = "telescope_mirror"

    def applies_to(self, roles):
        """Return whether one chain has the mirror, or its place."""
        telescope = _Telescope(roles)
        return telescope.has_mirror and (self.optic is None or telescope.mirror is not None)

    def place_in(self, telescope):
        """Return next to what the new optic stands, and on which side."""
        if telescope.mirror is not None:
            # behind the mirror: small diattenuations of one plane add up in any order
            return {"after": telescope.mirror.name}
        return {"before": telescope.altitude.name}


def _along(mirror):
    """Return the orientation of what acts as a mirror does."""
    return {} if mirror is None else {"theta": mirror.theta.value * u.deg, "mount": mirror.mount}


class _MirrorDiattenuation(_OfMirror):
    """A diattenuator in the plane of the mirror."""

    def build(self, size, telescope, context):
        """Return a diattenuator in the plane of the mirror."""
        return optics.Diattenuator(diattenuation=np.zeros(size), **_along(telescope.mirror))


class TertiaryDiattenuation(_MirrorDiattenuation):
    """
    Diattenuation of the tertiary mirror that the model lacks or holds fixed.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> charis = instruments.get("charis")
    >>> get_effect("m3_diattenuation").applies([charis.on_sky(charis.published())])
    False
    >>> get_effect("m3_diattenuation").applies([charis.chain()])
    False
    """

    name, kind, place = "m3_diattenuation", "optic", "tertiary mirror"
    title = "diattenuation of the telescope's tertiary mirror"
    shows = "harmonic 4 of the plate angle, with a phase that follows altitude and derotator"
    reference = _VAN_HARTEN
    free = {"diattenuation": (0.01, 0.1)}

    def applies_to(self, roles):
        """Return whether there is a telescope whose mirror has no free diattenuation."""
        open_ = _Telescope(roles).mirror_leaves("theta", "retardance")
        return open_ and super().applies_to(roles)


class TertiaryRetardance(_OfMirror):
    """
    Retardance of the tertiary mirror that the model lacks or holds fixed.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> charis, effect = instruments.get("charis"), get_effect("m3_retardance")
    >>> effect.applies([charis.chain("star")])
    True
    >>> effect.applies([charis.chain("unpolarized standard star")])
    False
    """

    name, kind, place = "m3_retardance", "optic", "tertiary mirror"
    title = "retardance of the telescope's tertiary mirror"
    shows = "circular from linear polarization of stars, with altitude; none of unpolarized ones"
    reference = _VAN_HARTEN
    free = {"retardance": (5 * u.deg, 180 * u.deg)}

    def applies_to(self, roles):
        """Return whether a star that may be polarized is behind a mirror of fixed retardance."""
        telescope = _Telescope(roles)
        # a retarder does nothing to unpolarized light: such stars cannot tell it
        open_ = not telescope.unpolarized and telescope.mirror_leaves("theta", "diattenuation")
        return open_ and super().applies_to(roles)

    def build(self, size, telescope, context):
        """Return a retarder in the plane of the mirror."""
        zero = np.zeros(size) * u.deg
        return optics.LinearRetarder(retardance=zero, **_along(telescope.mirror))


class TertiaryRecoating(_MirrorDiattenuation):
    """
    Diattenuation of the tertiary mirror that changes from one dataset to the next.

    A mirror that is coated anew, or washed, changes in steps. The datasets of stars
    are taken in the order in which they are given; the first one is the
    reference, and each of the others has a change of its own.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> night = instruments.get("charis").chain("unpolarized standard star")
    >>> effect = get_effect("m3_recoating")
    >>> effect.applies([night]), effect.applies([night, night])
    (False, True)
    """

    name, kind, place = "m3_recoating", "optic", "tertiary mirror"
    title = "tertiary mirror that is coated anew between two datasets of stars"
    shows = "as the diattenuation of the tertiary mirror, in some datasets and not in others"
    reference = _VAN_HARTEN
    free = {"diattenuation": (0.003, 0.1)}

    def applies(self, chains):
        """Return whether there are two datasets of stars; see `Effect.applies`."""
        # the first night is the reference: a change needs two
        return sum(self.applies_to(self.roles(chain)) for chain in chains) > 1

    def edit(self, chains, context):
        """Return the chains with a diattenuator in all but the first; see `Effect.edit`."""
        edited, added, seen = [], [], 0
        for chain in chains:
            roles = self.roles(chain)
            if self.applies_to(roles):
                # the first dataset keeps the nominal mirror
                if seen:
                    name = f"{self.label}_{seen}"
                    chain = self._with(chain, _Telescope(roles), name, context)
                    added += self._named(name, context)
                seen += 1
            edited.append(chain)
        return Edit(edited, added)

    def _named(self, name, context):
        return [
            EffectParameter(f"{name}.{key}", *sizes, self.law(key, context))
            for key, sizes in self.free.items()
        ]


class SkyBackground(_OnSky):
    """
    Polarized light of the sky that was not subtracted: moonlight, twilight.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> sorted(get_effect("sky_background").free)
    ['q', 'u']
    """

    name, kind, place = "sky_background", "source", "sky"
    title = "polarized background of the sky in the apertures"
    shows = "harmonic 4 of the plate angle with a phase of its own, as one over the flux"
    reference = "Patat & Romaniello 2006, doi:10.1086/497581"
    degree = 1
    free = {"q": (0.002, 0.1), "u": (0.002, 0.1)}

    def build(self, size, telescope, context):
        """Return polarized light that is added at a constant flux."""
        return optics.PolarizedBackground(
            # constant in flux, so that bright frames are polarized less by it
            q=np.zeros(size),
            u=np.zeros(size),
            reference=2 * context.flux,
            mount="total_flux",
        )


class SkyMotion(_OnSky):
    """
    Parallactic angle of another moment than that of the exposure.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("sky_motion").degree is None
    True
    """

    name, kind, place = "sky_motion", "parameter", "telescope"
    title = "parallactic angle of another moment than the middle of the exposure"
    shows = "polarization of stars turned by the rate of the parallactic angle, most near transit"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
    degree = None
    free = {"rate": LAG}

    def applies_to(self, roles):
        """Return whether a star that may be polarized is behind a telescope."""
        telescope = _Telescope(roles)
        return telescope.is_there and not telescope.unpolarized

    def build(self, size, telescope, context):
        """Return a rotator by the lag times the rate."""
        return lagging("parallactic", self.label)


# ---- signs -----------------------------------------------------------------------------------


class ParallacticSign(Discrete):
    """
    Parallactic angle that counts the other way, as the star sees it.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("parallactic_sign").axis
    'parallactic'
    """

    name, place, axis = "parallactic_sign", "sky", "parallactic"
    title = "parallactic angle with the wrong sign"
    shows = "polarization of stars that turns with the parallactic angle"
    reference = _SIGNS

    def applies_to(self, roles):
        """Return whether one chain has the axis."""
        return getattr(_Telescope(roles), self.axis) is not None

    def change(self, chain, roles):
        """Return the chain with the axis turned the other way."""
        axis = getattr(_Telescope(self.roles(chain)), self.axis)
        axis.mount = axis.stage if axis.stage_sign < 0 else f"-{axis.stage}"
        return chain


class AltitudeSign(ParallacticSign):
    """
    Altitude that counts the other way.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("altitude_sign").axis
    'altitude'
    """

    name, place, axis = "altitude_sign", "telescope", "altitude"
    title = "altitude with the wrong sign"
    shows = "everywhere on sky: the polarization turns with twice the altitude"


class PlateTrackingParallacticSign(Discrete):
    """
    Half-wave plate that follows the parallactic angle the other way.

    By which law it should follow is the instrument's, see `~astropolcal.instruments.SkyLaw`.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_tracking_parallactic_sign").factors
    (-1.0, 1.0)
    """

    name, place = "hwp_tracking_parallactic_sign", "stage of the half-wave plate"
    title = "half-wave plate that follows the parallactic angle with the wrong sign"
    shows = "everywhere on sky: the polarization turns with the parallactic angle"
    reference = _SIGNS
    acts_on = "plate"
    #: By what the factors of parallactic angle and altitude in the plate's law are multiplied.
    factors = (-1.0, 1.0)

    def applies_to(self, roles):
        """Return whether there are a telescope and a plate."""
        return roles.plate is not None and _Telescope(roles).is_there

    def edit(self, chains, context):
        """Return the chains with the plate following another law; see `Effect.edit`."""
        # tables hold true angles; the law tells which part of them came from the sky
        laws = () if context is None else context.tracking
        laws = laws if len(laws) == len(chains) else [TRACKING] * len(chains)
        edited = []
        for chain, law in zip(chains, laws, strict=True):
            roles = self.roles(chain)
            applies = self.applies_to(roles)
            edited.append(self.change(chain.copy(), roles, law) if applies else chain)
        return Edit(edited, [])

    def change(self, chain, roles, law=TRACKING):
        """Return the chain with the plate turned by the difference of the laws."""
        plate, label = roles.plate.name, label_of(self.name)
        for stage, factor, old in zip(("parallactic", "altitude"), self.factors, law, strict=True):
            # a law without this angle cannot have its sign wrong
            if factor * old != old:
                # rotators before and behind turn the plate without turning the light
                for side, sign in {"before": 1, "after": -1}.items():
                    turn = _follower(sign * (factor - 1) * old, stage, f"{label}_{stage}_{side}")
                    chain = insert_optic(chain, turn, **{side: plate})
        return chain


class PlateTrackingAltitudeSign(PlateTrackingParallacticSign):
    """
    Half-wave plate that follows the altitude the other way.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_tracking_altitude_sign").factors
    (1.0, -1.0)
    """

    name = "hwp_tracking_altitude_sign"
    title = "half-wave plate that follows the altitude with the wrong sign"
    shows = "everywhere on sky: the polarization turns with four times the altitude"
    factors = (1.0, -1.0)

    def applies_to(self, roles):
        """Return whether there is an altitude axis, too."""
        return super().applies_to(roles) and _Telescope(roles).altitude is not None


class PlateNotTracking(PlateTrackingParallacticSign):
    """
    Half-wave plate that does not follow the sky.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_not_tracking").factors
    (0.0, 0.0)
    """

    name = "hwp_not_tracking"
    title = "half-wave plate that stands still between the commands"
    shows = "everywhere on sky: the polarization turns with parallactic angle and altitude"
    factors = (0.0, 0.0)


def _follower(factor, stage, name):
    """Return a rotator by a multiple of the angle of a stage, a whole number of turns included."""
    turn = optics.DriftRotator(mount=stage, name=name)
    turn.rate.bounds = (None, None)
    turn.rate = factor * u.rad
    turn.rate.fixed = True
    return turn
