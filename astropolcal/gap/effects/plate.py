# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the half-wave plate and its stage."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.gap.effects._shared import Around
from astropolcal.gap.effects.base import Edit, EffectParameter, Insertion

__all__ = [
    "PlateAxisDispersion",
    "PlateBeamWander",
    "PlateDiattenuation",
    "PlateEccentricity",
    "PlateRetardance",
    "PlateRetardanceFree",
    "PlateTilt",
    "PlateTransmission",
    "PlateTransmissionOnce",
    "PlateTwoLobes",
    "WavelengthScale",
]


class PlateRetardance(Insertion):
    """
    Retardance of the half-wave plate that its two layers do not explain.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_retardance").shows
    'harmonics 2 and 4 of the plate angle, smooth in wavelength'
    """

    name, kind, place = "hwp_retardance", "parameter", "half-wave plate"
    title = "error of the half-wave plate's retardance law"
    shows = "harmonics 2 and 4 of the plate angle, smooth in wavelength"
    reference = "'t Hart et al. 2021, doi:10.1117/12.2594962"
    anchor, side, follows = "plate", "before", True
    free = {"retardance": (1 * u.deg, 30 * u.deg)}

    def build(self, size, anchor, context):
        """Return a retarder that turns with the plate."""
        return optics.LinearRetarder(
            retardance=np.zeros(size) * u.deg, mount=anchor.mount, name=self.label
        )


class PlateRetardanceFree(PlateRetardance):
    """
    Retardance of the half-wave plate, free at each wavelength: its law is too stiff.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_retardance_free").degree is None
    True
    """

    # one value a wavelength, for two layers and any smooth law may be too stiff
    name, degree = "hwp_retardance_free", None
    title = "retardance of the half-wave plate that no smooth law describes"
    shows = "harmonics 2 and 4 of the plate angle, any course with wavelength"


class WavelengthScale(PlateRetardance):
    """
    Shift and stretch of the wavelength scale, as the half-wave plate shows them.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("wavelength_scale").kind
    'detector'
    """

    name, kind, place = "wavelength_scale", "detector", "spectrograph"
    title = "shift of the wavelength scale"
    shows = "the model's derivative to wavelength"
    reference = "template of a shifted wavelength scale; compare Harrington & Sueoka 2017"
    free = {"retardance": (0.3 * u.deg, 10 * u.deg)}

    def applies_to(self, roles):
        """Return whether the plate has a law in wavelength."""
        return isinstance(roles.plate, optics.TwoLayerWaveplate)

    def edit(self, chains, context):
        """Return the chains with a retarder whose law is the plate's slope."""
        plates = (self.roles(chain).plate for chain in chains)
        plate = next(plate for plate in plates if self._has_law(plate))
        # relative: small against the course of the indices, large against rounding
        step = 1e-4
        up, down = (
            plate.retardance(context.wavelength * (1 + s) * u.um).to_value(u.rad)
            for s in (step, -step)
        )
        # d retardance / d ln(wavelength), radian; a shift and a stretch are this times a line
        self_law = (up - down) / (2 * step)
        edit = super().edit(chains, context)
        basis = self_law[:, None] * context.basis(1) / np.abs(self_law).max()
        parameter = edit.parameters[0]
        fresh = EffectParameter(parameter.name, parameter.scale, parameter.limit, basis)
        return Edit(edit.chains, [fresh], edit.ties)

    @staticmethod
    def _has_law(plate):
        return isinstance(plate, optics.TwoLayerWaveplate)


class PlateDiattenuation(Insertion):
    """
    Diattenuation of the half-wave plate.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_diattenuation").place
    'half-wave plate'
    """

    name, kind, place = "hwp_diattenuation", "optic", "half-wave plate"
    title = "diattenuation of the half-wave plate"
    shows = "harmonic 2 of the plate angle in sums and in differences of unpolarized light"
    reference = "Bryan et al. 2010, doi:10.1364/AO.49.006313"
    anchor, side, follows = "plate", "before", True
    free = {"diattenuation": (0.003, 0.1)}

    def build(self, size, anchor, context):
        """Return a diattenuator that turns with the optic it stands next to."""
        return optics.Diattenuator(
            diattenuation=np.zeros(size), mount=anchor.mount, name=self.label
        )


class PlateTransmission(Insertion):
    """
    Transmission of the half-wave plate that changes twice a turn.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_transmission").free["sine"]
    (0.003, 0.1)
    """

    name, kind, place = "hwp_transmission", "optic", "half-wave plate"
    title = "transmission of the half-wave plate that changes twice a turn"
    shows = "harmonic 2 of the plate angle in sums, none in differences"
    reference = "Essinger-Hileman et al. 2016, doi:10.1063/1.4962023"
    # cosine and sine are single numbers, the same at all wavelengths
    anchor, degree, harmonic = "plate", None, 2
    free = {"cosine": (0.003, 0.1), "sine": (0.003, 0.1)}

    def build(self, size, anchor, context):
        """Return a gain that turns with the plate."""
        return optics.HarmonicGain(harmonic=self.harmonic, mount=anchor.mount, name=self.label)


class PlateTransmissionOnce(PlateTransmission):
    """
    Dust or a wedge on the half-wave plate: transmission that changes once a turn.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_transmission_once").harmonic
    1
    """

    name, harmonic = "hwp_transmission_once", 1
    title = "dust or a wedge on the half-wave plate, transmission that changes once a turn"
    shows = "harmonic 1 of the plate angle in sums, none in differences"


class PlateBeamWander(Insertion):
    """
    Beams that wander over the detector as a wedged plate turns.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_beam_wander").kind
    'detector'
    """

    name, kind, place = "hwp_beam_wander", "detector", "detector"
    title = "beams that wander over the detector as the half-wave plate turns"
    shows = "harmonic 1 of the plate angle in differences of all sources"
    reference = "Tinyanont et al. 2019, doi:10.1088/1538-3873/aaef0f"
    anchor, degree, stage = "splitter", None, "hwp"
    free = {"cosine": (0.003, 0.1), "sine": (0.003, 0.1)}

    def applies_to(self, roles):
        """Return whether there are a plate and a splitter."""
        return roles.plate is not None and roles.splitter is not None

    def build(self, size, anchor, context):
        """Return a gain of opposite sign in the two beams."""
        # light that leaves one aperture enters none: seen as opposite gains
        return optics.HarmonicGain(differential=True, mount=self.stage, name=self.label)


class PlateTilt(Insertion):
    """
    Tilt of the half-wave plate to the beam.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_tilt").harmonic
    2
    """

    name, kind, place = "hwp_tilt", "optic", "half-wave plate"
    title = "tilt of the half-wave plate, retardance that changes as it turns"
    shows = "harmonics 2, 4, 6 and 8 of the plate angle"
    reference = "Patanchon et al. 2024, doi:10.1088/1475-7516/2024/01/074"
    # its retardance depends on whether the fast axis lies along the tilt or across: twice a turn
    anchor, side, follows, degree, harmonic = "plate", "before", True, None, 2
    free = {"cosine": (0.5 * u.deg, 20 * u.deg), "sine": (0.5 * u.deg, 20 * u.deg)}

    def build(self, size, anchor, context):
        """Return a retarder whose retardance varies with its orientation."""
        return optics.HarmonicRetarder(harmonic=self.harmonic, mount=anchor.mount, name=self.label)


class PlateAxisDispersion(Around):
    """
    Fast axis of the half-wave plate that turns with wavelength.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_axis_dispersion").place
    'half-wave plate'
    """

    name, kind, place = "hwp_axis_dispersion", "parameter", "half-wave plate"
    title = "fast axis of the half-wave plate that turns with wavelength"
    shows = "phase of harmonic 4 of the plate angle, with wavelength, at all derotator angles"
    reference = "chromatic zero angles of FORS; Bagnulo et al. 2009, doi:10.1086/605654"
    # a constant is the misalignment of the plate, which the model fits
    anchor, side, constant = "plate", "before", False
    free = {"circular": (1 * u.deg, 20 * u.deg)}

    def build(self, size, anchor, context):
        """Return a rotator of the polarization, the same at all positions."""
        return optics.EllipticalRetarder(circular=np.zeros(size) * u.deg, name=self.label)


class PlateEccentricity(Around):
    """
    Scale of the half-wave plate's encoder that is not centred.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_encoder_eccentricity").harmonic
    1
    """

    name, kind, place = "hwp_encoder_eccentricity", "parameter", "stage of the half-wave plate"
    title = "angle of the half-wave plate wrong once a turn (eccentric encoder)"
    shows = "harmonics 3 and 5 of the plate angle, none for unpolarized light"
    reference = "geometry of an eccentric scale; compare Millar-Blanchaer et al. 2016"
    # a scale off its axis by d reads wrong by d sin(angle) over its radius
    anchor, side, degree, harmonic = "plate", "before", None, 1
    free = {"cosine": (0.1 * u.deg, 5 * u.deg), "sine": (0.1 * u.deg, 5 * u.deg)}

    def build(self, size, anchor, context):
        """Return a rotator by an angle that varies with that of the stage."""
        return optics.HarmonicRotator(harmonic=self.harmonic, mount=anchor.mount, name=self.label)


class PlateTwoLobes(PlateEccentricity):
    """
    Scale of the half-wave plate's encoder that is not round.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_encoder_two_lobe").harmonic
    2
    """

    name = "hwp_encoder_two_lobe"
    title = "angle of the half-wave plate wrong twice a turn (encoder not round)"
    shows = "harmonics 2 and 6 of the plate angle, none for unpolarized light"
    harmonic = 2
