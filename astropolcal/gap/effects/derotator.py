# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the derotator and its stage."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic, replace_optic
from astropolcal.gap.effects._shared import LAG, Around, BandAverage, lagging
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, label_of
from astropolcal.gap.effects.plate import PlateDiattenuation, PlateEccentricity
from astropolcal.measurement import Tie

__all__ = [
    "DerotatorBandAverage",
    "DerotatorCircular",
    "DerotatorDiagonal",
    "DerotatorDiattenuation",
    "DerotatorEccentricity",
    "DerotatorElliptical",
    "DerotatorMotion",
    "DerotatorTwoLobes",
]


# what an elliptical retarder can stand for
_EXCHANGED = (optics.LinearRetarder, optics.EllipticalRetarder)


class DerotatorDiagonal(Effect):
    """
    Retardance of the derotator at 45 deg to its axes.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_45_retardance").component
    'diagonal'
    """

    # with the horizontal component it turns the axis: by half the arctangent of their ratio
    name, kind, place = "derotator_45_retardance", "parameter", "derotator"
    title = "retardance of the derotator at 45 deg"
    shows = "rotation of Q and U that depends on wavelength and derotator angle"
    reference = "McIntosh et al. 2026, Sec. 4"
    component, acts_on = "diagonal", "derotator"
    scale, limit = 2 * u.deg, 60 * u.deg

    @property
    def components(self):
        """Components that the effect frees."""
        return (self.component,)

    def applies_to(self, roles):
        """Return whether the derotator lacks this component."""
        if roles.derotator is None:
            return False
        if isinstance(roles.derotator, optics.EllipticalRetarder):
            return all(getattr(roles.derotator, key).fixed for key in self.components)
        return not any(leaf.name == label_of(self.name) for leaf in roles.leaves)

    def edit(self, chains, context):
        """Return the chains with an elliptical derotator; see `Effect.edit`."""
        edited, names, ties = [], {}, {}
        for chain in chains:
            derotator = self.roles(chain).derotator
            # exchanged in place, as two retarders one behind the other do not commute
            if isinstance(derotator, _EXCHANGED):
                chain = replace_optic(chain, derotator.name, self._elliptical(derotator, context))
                names[derotator.name] = None
            elif derotator is not None:
                added = self._behind(derotator, context)
                chain = insert_optic(chain, added, after=derotator.name)
                names[added.name] = None
                if not derotator.theta.fixed:
                    ties[f"{added.name}.theta"] = Tie(f"{derotator.name}.theta")
            edited.append(chain)
        basis = None if len(context.wavelength) == 1 else context.basis(self.degree)
        parameters = [
            EffectParameter(f"{name}.{key}", self.scale, self.limit, basis)
            for name in names
            for key in self.components
        ]
        return Edit(edited, parameters, ties)

    def _behind(self, derotator, context):
        """Return what turns with a derotator that is more than a retarder, and adds to it."""
        zero = np.zeros(len(context.wavelength)) * u.deg
        added = optics.EllipticalRetarder(
            theta=derotator.theta.value * u.deg,
            mount=derotator.mount,
            name=label_of(self.name),
            **dict.fromkeys(self.components, zero),
        )
        added.theta.bounds = (None, None)
        for key in added.param_names:
            getattr(added, key).fixed = key not in self.components
        return added

    def _elliptical(self, old, context):
        size = len(context.wavelength)
        zero = np.zeros(size) * u.deg
        if isinstance(old, optics.EllipticalRetarder):
            values = {
                key: np.broadcast_to(getattr(old, key).value, size) * u.deg
                for key in self.components
            }
            new = old.with_parameters(**values)
        else:
            new = optics.EllipticalRetarder(
                horizontal=old.retardance.value * u.deg,
                theta=old.theta.value * u.deg,
                mount=old.mount,
                name=old.name,
                **dict.fromkeys(self.components, zero),
            )
            # what was free stays free, so that the nominal parameters keep their meaning
            for ours, theirs in (("theta", "theta"), ("horizontal", "retardance")):
                source, target = getattr(old, theirs), getattr(new, ours)
                target.fixed, target.bounds = source.fixed, source.bounds
            for key in {"diagonal", "circular"} - set(self.components):
                getattr(new, key).fixed = True
        for key in self.components:
            getattr(new, key).fixed = False
        return new


class DerotatorCircular(DerotatorDiagonal):
    """
    Circular retardance of the derotator.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_circular_retardance").component
    'circular'
    """

    name = "derotator_circular_retardance"
    title = "circular retardance of the derotator"
    shows = "rotation of Q and U that depends on wavelength"
    component = "circular"


class DerotatorElliptical(DerotatorDiagonal):
    """
    Retardance of the derotator at 45 deg and circular, both at once.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_elliptical_retardance").components
    ('diagonal', 'circular')
    """

    name = "derotator_elliptical_retardance"
    title = "retardance of the derotator at 45 deg and circular (an elliptical retarder)"
    shows = "rotation of Q and U that depends on wavelength, in part on the derotator angle"
    components = ("diagonal", "circular")


class DerotatorBandAverage(BandAverage):
    """
    Retardance of the derotator that changes within a wavelength bin.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> effect = get_effect("derotator_band_average")
    >>> effect.applies([instruments.get("charis").published()])
    True
    """

    name, kind, place = "derotator_band_average", "optic", "derotator"
    title = "retardance of the derotator that changes within a wavelength bin"
    shows = "less modulation where the retardance is steep, most between the axes of the derotator"
    acts_on = "derotator"

    def retarder(self, roles):
        """Return the derotator."""
        return roles.derotator


class DerotatorDiattenuation(PlateDiattenuation):
    """
    Diattenuation of the derotator.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_diattenuation").anchor
    'derotator'
    """

    name, kind, place = "derotator_diattenuation", "optic", "derotator"
    title = "diattenuation of the derotator"
    shows = "harmonic 2 of the derotator angle, constant with the plate"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
    anchor, side = "derotator", "after"
    free = {"diattenuation": (0.005, 0.2)}


class DerotatorEccentricity(PlateEccentricity):
    """
    Scale of the derotator's encoder that is not centred.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_encoder_eccentricity").harmonic
    1
    """

    name, kind, place = "derotator_encoder_eccentricity", "parameter", "stage of the derotator"
    title = "angle of the derotator wrong once a turn (eccentric encoder)"
    shows = "rotation of Q and U with the derotator angle, the same at all wavelengths"
    reference = "geometry of an eccentric scale; compare van Holstein et al. 2020"
    anchor = "derotator"


class DerotatorTwoLobes(DerotatorEccentricity):
    """
    Scale of the derotator's encoder that is not round.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_encoder").harmonic
    2
    """

    name = "derotator_encoder"
    title = "angle of the derotator wrong twice a turn (encoder not round)"
    harmonic = 2


class DerotatorMotion(Around):
    """
    Derotator angle of another moment than that of the exposure.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> effect = get_effect("derotator_motion")
    >>> effect.applies([instruments.get("charis").chain()])
    False
    """

    name, kind, place = "derotator_motion", "parameter", "stage of the derotator"
    title = "angle of the derotator of another moment than the middle of the exposure"
    shows = "rotation of Q and U by the rate of the derotator, most near transit"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
    anchor, side, degree = "derotator", "before", None
    free = {"rate": LAG}

    def applies_to(self, roles):
        """Return whether there is a derotator, in the chain of a star: elsewhere it stops."""
        # for internal sources the derotator stands still during an exposure
        moving = any(leaf.stage == "parallactic" for leaf in roles.leaves)
        return moving and roles.derotator is not None

    def edit(self, chains, context):
        """Return the chains with the pair at zero, in those of stars; see `Effect.edit`."""
        moves = [self.applies_to(self.roles(chain)) for chain in chains]
        # bench data would tie the lag to a rate that they do not have
        edit = super().edit([c for c, moving in zip(chains, moves, strict=True) if moving], context)
        ready = iter(edit.chains)
        edited = [next(ready) if moving else c for c, moving in zip(chains, moves, strict=True)]
        return Edit(edited, edit.parameters, edit.ties)

    def build(self, size, anchor, context):
        """Return a rotator by the lag times the rate."""
        # the lag turns the way in which the stage counts
        sign = "-" if anchor.stage_sign < 0 else ""
        return lagging(f"{sign}{anchor.stage}", self.label)
