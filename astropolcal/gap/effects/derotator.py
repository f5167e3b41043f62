# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the derotator and its stage."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import replace_optic
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, Insertion, Roles
from astropolcal.gap.effects.plate import _Around

__all__ = [
    "DerotatorCircular",
    "DerotatorDiagonal",
    "DerotatorDiattenuation",
    "DerotatorEccentricity",
    "DerotatorTwoLobes",
]


class DerotatorDiagonal(Effect):
    """
    Retardance of the derotator at 45 deg to its axes.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_45_retardance").component
    'diagonal'
    """

    name, kind, place = "derotator_45_retardance", "parameter", "derotator"
    title = "retardance of the derotator at 45 deg"
    shows = "rotation of Q and U that depends on wavelength and derotator angle"
    reference = "McIntosh et al. 2026, Sec. 4"
    component = "diagonal"
    scale, limit = 2 * u.deg, 60 * u.deg

    def applies_to(self, roles):
        """Return whether the derotator lacks this component."""
        if isinstance(roles.derotator, optics.LinearRetarder):
            return True
        if not isinstance(roles.derotator, optics.EllipticalRetarder):
            return False
        return bool(getattr(roles.derotator, self.component).fixed)

    def edit(self, chains, context):
        """Return the chains with an elliptical derotator; see `Effect.edit`."""
        edited = []
        for chain in chains:
            derotator = Roles(chain).derotator
            if derotator is not None:
                chain = replace_optic(chain, derotator.name, self._elliptical(derotator, context))
            edited.append(chain)
        name = next(r.derotator.name for r in map(Roles, edited) if r.derotator is not None)
        basis = None if len(context.wavelength) == 1 else context.basis(self.degree)
        parameter = EffectParameter(f"{name}.{self.component}", self.scale, self.limit, basis)
        return Edit(edited, [parameter])

    def _elliptical(self, old, context):
        size = len(context.wavelength)
        zero = np.zeros(size) * u.deg
        if isinstance(old, optics.EllipticalRetarder):
            value = np.broadcast_to(getattr(old, self.component).value, size) * u.deg
            new = old.with_parameters(**{self.component: value})
        else:
            new = optics.EllipticalRetarder(
                horizontal=old.retardance.value * u.deg,
                theta=old.theta.value * u.deg,
                mount=old.mount,
                name=old.name,
                **{self.component: zero},
            )
            for ours, theirs in (("theta", "theta"), ("horizontal", "retardance")):
                source, target = getattr(old, theirs), getattr(new, ours)
                target.fixed, target.bounds = source.fixed, source.bounds
            for key in {"diagonal", "circular"} - {self.component}:
                getattr(new, key).fixed = True
        getattr(new, self.component).fixed = False
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


class DerotatorDiattenuation(Insertion):
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
    follows = True
    free = {"diattenuation": (0.005, 0.2)}

    def build(self, size, anchor, context):
        """Return a diattenuator that turns with the derotator."""
        return optics.Diattenuator(
            diattenuation=np.zeros(size), mount=anchor.mount, name=self.label
        )


class DerotatorEccentricity(_Around):
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
    anchor, side, degree, harmonic = "derotator", "before", None, 1
    free = {"cosine": (0.1 * u.deg, 5 * u.deg), "sine": (0.1 * u.deg, 5 * u.deg)}

    def build(self, size, anchor, context):
        """Return a rotator by an angle that varies with the derotator angle."""
        return optics.HarmonicRotator(harmonic=self.harmonic, mount=anchor.mount, name=self.label)


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
