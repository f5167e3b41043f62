# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the source and of what stands in front of the half-wave plate."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.gap.effects.base import Insertion

__all__ = ["PolarizerLeak", "RetarderBeforePlate", "SourceCircular", "SourceRotationDrift"]


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
    free = {"retardance": (1 * u.deg, 45 * u.deg)}

    def build(self, size, anchor, context):
        """Return a retarder at 45 deg to the polarizer."""
        return optics.LinearRetarder(
            retardance=np.zeros(size) * u.deg,
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


class PolarizerLeak(Insertion):
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
    free = {"retained_q": (0.01, 0.3)}

    def build(self, size, anchor, context):
        """Return a depolarizer along the polarizer."""
        optic = optics.Depolarizer(
            retained_q=np.ones(size), theta=anchor.theta.value * u.deg, name=self.label
        )
        optic.retained_q.bounds = (0.0, 1.5)
        return optic
