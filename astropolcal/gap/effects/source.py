# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the source and of what stands in front of the half-wave plate."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import leaves, replace_optic
from astropolcal.gap.effects._shared import Depolarization
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, Insertion
from astropolcal.gap.effects.roles import is_held

__all__ = [
    "PolarizerLeak",
    "RetarderBeforePlate",
    "SourceCircular",
    "SourceLinear",
    "SourceRotationDrift",
    "StandardPolarization",
]


class SourceCircular(Insertion):
    """
    Circular polarization of the source, or a retarder in front of the plate.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("source_circular").anchor
    'polarizer'
    """

    name, kind, place = "source_circular", "source", "source"
    title = "circular polarization of the source (or a retarder in front of the plate)"
    shows = "constant in plate angle, varies with derotator angle"
    reference = "computed from the measurement equation; McIntosh et al. 2026, Sec. 2"
    anchor = "polarizer"
    # degree of circular polarization = sin(retardance): 1 deg is 1.7 percent
    free = {"retardance": (1 * u.deg, 45 * u.deg)}

    def build(self, size, anchor, context):
        """Return a retarder at 45 deg to the polarizer."""
        return optics.LinearRetarder(
            retardance=np.zeros(size) * u.deg,
            # along the polarizer a retarder does nothing; at 45 deg it turns linear into circular
            # light
            theta=(anchor.theta.value + 45) * u.deg,
            name=self.label,
        )


class RetarderBeforePlate(SourceCircular):
    """
    Retarder in front of the plate, as the unpolarized source shows it.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("retarder_before_plate").anchor
    'mirror'
    """

    name, kind, place = "retarder_before_plate", "optic", "in front of the half-wave plate"
    title = "retarder in front of the half-wave plate in the path of the unpolarized source"
    shows = "constant in plate angle, varies with derotator angle, unpolarized data alone"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
    anchor = "mirror"
    free = {"retardance": (5 * u.deg, 90 * u.deg)}


class SourceLinear(Insertion):
    """
    Linear polarization of a source that the model takes for unpolarized.

    It is that of the source, or of a mirror between it and the half-wave plate.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("source_linear").anchor
    'entrance'
    """

    name, kind, place = "source_linear", "source", "in front of the half-wave plate"
    title = "linear polarization of the source, or a mirror in front of the half-wave plate"
    shows = "harmonic 4 of the plate angle, as the derotator turns it"
    reference = "McIntosh et al. 2026, Sec. 5.2 (fold mirror of the internal source)"
    anchor, side = "entrance", "before"
    free = {"horizontal": (0.01, 0.3), "diagonal": (0.01, 0.3)}

    def build(self, size, anchor, context):
        """Return a diattenuator of any orientation."""
        return optics.VectorDiattenuator(
            horizontal=np.zeros(size), diagonal=np.zeros(size), name=self.label
        )


class SourceRotationDrift(Insertion):
    """
    Polarization of the source that turns through the run.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("source_rotation_drift").free["rate"][1].unit
    Unit("deg")
    """

    name, kind, place = "source_rotation_drift", "source", "source"
    title = "polarization of the source that turns through the run"
    shows = "phase of harmonic 4 of the plate angle, with time"
    reference = "Harrington et al. 2023, drift terms of DKIST"
    anchor, degree = "polarizer", None
    free = {"rate": (0.1 * u.deg, 10 * u.deg)}

    def build(self, size, anchor, context):
        """Return a rotator whose angle grows through the run."""
        return optics.DriftRotator(mount="sequence", name=self.label)


class PolarizerLeak(Depolarization):
    """
    Calibration polarizer that lets some of the other polarization through.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("polarizer_leak").place
    'calibration polarizer'
    """

    name, kind, place = "polarizer_leak", "source", "calibration polarizer"
    title = "leak of the calibration polarizer"
    shows = "amplitude of the polarized data alone: the efficiency takes it up"
    reference = "'t Hart et al. 2021, doi:10.1117/12.2594962"
    absorbed_by = "wollaston.efficiency"
    anchor = "polarizer"
    # behind a polarizer a leak is an equal loss of all, whatever the axes
    free = {"retained_q": (0.01, 0.3)}


class StandardPolarization(Effect):
    """
    Polarization of a star itself, which the model holds at zero or at a catalogue's value.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> charis, effect = instruments.get("charis"), get_effect("standard_polarization")
    >>> effect.applies([charis.chain("unpolarized standard star")])
    True
    >>> effect.applies([charis.chain("star")])
    False
    """

    name, kind, place = "standard_polarization", "source", "star"
    title = "polarization of the standard star itself, which the model holds"
    shows = "harmonic 4 of the plate angle, with a phase that is fixed on the sky"
    reference = "Blinov et al. 2023, doi:10.1051/0004-6361/202346778"
    #: Size to expect and limit of q and u.
    free = {"q": (0.003, 0.3), "u": (0.003, 0.3)}

    def applies_to(self, roles):
        """Return whether the polarization of a star is held."""
        return _held_star(roles.leaves) is not None

    def edit(self, chains, context):
        """Return the chains with q and u of the stars free; see `Effect.edit`."""
        edited, added = [], {}
        for chain in chains:
            star = _held_star(leaves(chain))
            if star is not None:
                fresh = self._released(star, len(context.wavelength))
                chain = replace_optic(chain, star.name, fresh)
                added |= {p.name: p for p in self._parameters(fresh, context)}
            edited.append(chain)
        return Edit(edited, list(added.values()))

    def _released(self, star, size):
        values = {key: np.broadcast_to(getattr(star, key).value, size) for key in self.free}
        fresh = star.with_parameters(**values)
        for key in self.free:
            getattr(fresh, key).fixed, getattr(fresh, key).prior = False, None
        return fresh

    def _parameters(self, star, context):
        for key, (scale, limit) in self.free.items():
            held = np.array(getattr(star, key).value)
            # the law must hold the catalogue's values, from which the size counts
            basis = None if held.size == 1 else _able_to_hold(held, context.basis(self.degree))
            yield EffectParameter(f"{star.name}.{key}", scale, limit, basis, held)


def _held_star(optics_of_chain):
    """Return the first star whose polarization is fixed."""
    stars = (o for o in optics_of_chain if isinstance(o, optics.PolarizedSource))
    return next((star for star in stars if is_held(star.q) and is_held(star.u)), None)


def _able_to_hold(values, basis):
    """Return a basis that can represent the values as well."""
    left = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    size = np.abs(left).max()
    return basis if size < 1e-12 else np.column_stack([basis, left / size])
