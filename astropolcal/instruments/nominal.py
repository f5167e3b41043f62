# Licensed under a 3-clause BSD style license - see LICENSE
"""
Dual-beam polarimeters that are known from what is public of them; the rest is nominal.

The page "More instruments" of the documentation says of each where its values, keywords and signs
come from, and what is not known. Where it has no others, a half-wave plate starts at 178 deg, a
K-mirror at 160 deg, a prism with an efficiency of 0.99 (0.985 at Subaru), a tertiary mirror as bare
aluminium, and the rest at 0. What the page leaves out:

- NaCo: the encoder of the plate has 4096 steps a turn, from 205 steps below zero (NACO manual).
- NIRC2: the pipeline's ROTPDEST (its Eq. 3) is twice the angle of the K-mirror on the bench.
- GPI: the plate's retardance in K2 is above half a wave, and starts as far below it, which linear
  polarization does not tell apart. Signs are of ``gpi_combine_polarization_sequence``.
- HiCIAO: bare silver of n = 0.3 + 11.7i at 1.6 um (Hashimoto) makes 0.3 % of polarization; that
  of the tables here, another film, 0.55 % in H. Its keywords are those that public code reads.
- IRCS: the keywords are those of the same plate and derotator in CHARIS; no header has been seen.
- Fast-PDI: the constants in the model of fastpdi_dpp carry the names of filters of VAMPIRES and
  are not taken, nor are its quarter-wave plates upstream of the liquid crystal.
- REACH: the public pipeline pyird, https://github.com/prvjapan/pyird, has the bands Y, J and H.
- In Y the derotator of both of SCExAO starts at its published value at 1.16 um.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import replace_optic
from astropolcal.instruments import telescope as shared
from astropolcal.instruments.base import Polarimeter, SkyLaw, SubaruPolarimeter, aluminium
from astropolcal.instruments.vampires import VAMPIRES, liquid_crystal

__all__ = []

# of the plate of NaCo: one of 4096 (deg)
_STEP = 360 / 4096
# of that of FORS2 in b_HIGH, v_HIGH, R_SPECIAL and I_BESS (deg): half of the error of angles that
# ESO's manual (Sec. 4.6.2) has, with the other sign
_FORS2_ZERO = (-0.77, -0.90, 0.595, 1.445)


class FORS2(Polarimeter):
    """VLT/FORS2 with its half-wave plate at any angles, and its Wollaston prism.

    Its polarized source is a polarizer upstream of the instrument, such as the prism with which
    ESO measured the zero of the plate. Free are, per wavelength, retardance and zero of the plate
    and the efficiency of the prism, and of stars what the collimator polarizes, which a polarizer
    hides.
    """

    name = "fors2"
    aliases = ("VLT/FORS2",)
    # nominal centres of b_HIGH, v_HIGH, R_SPECIAL and I_BESS
    wavelength = [440, 557, 655, 768] * u.nm
    keywords = {
        "hwp": "ESO INS RETA2 POSANG",
        "parallactic": "ESO ADA POSANG",
        "altitude": "ESO TEL ALT",
    }
    references = (
        "Patat & Romaniello 2006, PASP 118, 146, doi:10.1086/497581",
        "Cikota et al. 2017, MNRAS 464, 4146, doi:10.1093/mnras/stw2545",
        "Gonzalez-Gaitan et al. 2020, A&A 634, A70, doi:10.1051/0004-6361/201936379",
        "FORS2-INSTPOL, https://github.com/gongsale/FORS2-INSTPOL",
    )
    entrance = "collimator"
    # M1 and M2 do not polarize on the axis
    site, focus = shared.PARANAL, "cassegrain"

    def inner(self, source, optics_in, grid):
        """Return the collimator, the plate, whose zero is free per wavelength, and the prism."""
        collimator = diattenuator("collimator", grid)
        collimator.horizontal.fixed = collimator.diagonal.fixed = source == "polarized"
        theta = np.interp(grid.to_value(u.nm), self.wavelength.value, _FORS2_ZERO)
        plate = turning_retarder("hwp", 178, grid, most=15, theta=theta * u.deg)
        return [collimator, plate, wollaston(grid)]


class NaCo(Polarimeter):
    """VLT/NaCo with half-wave plate and Wollaston prism, observing stars.

    Free are, per wavelength, the diattenuation of M3, that of the mirrors downstream of it, the
    retardance of the plate and the efficiency of the prism; and the angle of the plate, within
    20 deg, as it was once 13 deg off.
    """

    name = "naco"
    aliases = ("VLT/NaCo", "NAOS+CONICA")
    # nominal centres of J, H and Ks
    wavelength = [1.265, 1.66, 2.18] * u.um
    keywords = {
        "hwp": "ESO INS ADC1 ENC",
        "parallactic": "ESO TEL PARANG START",
        "altitude": "ESO TEL ALT",
        "position_angle": "ESO ADA POSANG",
    }
    transforms = {"hwp": (_STEP, 205 * _STEP)}
    references = (
        "Witzel et al. 2011, A&A 525, A130, doi:10.1051/0004-6361/201015009",
        "Characterizing instrumental effects on polarization at a Nasmyth focus using NaCo, 2014, "
        "Proc. SPIE 9147, 87",
    )
    sources = shared.STARS
    entrance = "mirrors"
    site = shared.PARANAL

    def inner(self, source, optics_in, grid):
        """Return the mirrors of the instrument, the plate and the prism."""
        plate = turning_retarder("hwp", 178, grid, most=20)
        return [diattenuator("mirrors", grid), plate, wollaston(grid)]

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return M3 of aluminium, and the adapter, which keeps the sky at the position angle."""
        return [
            optics.Rotator(mount="parallactic", name="parallactic"),
            aluminium(self.grid(wavelength)),
            # a mirror turns the sense of the angles
            optics.Rotator(mount="parallactic", name="adapter"),
            optics.Rotator(mount="-position_angle", name="position_angle"),
        ]


class NIRC2(Polarimeter):
    """Keck II/NIRC2 with half-wave plate, K-mirror and Wollaston prism.

    Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the
    prism; the angles of plate and K-mirror; and of stars the diattenuation of the tertiary mirror,
    whose retardance is held.
    """

    name = "nirc2"
    aliases = ("Keck/NIRC2", "NIRC2-Pol")
    # nominal centres of J, H and Kp; the band L has a plate of its own
    wavelength = [1.248, 1.633, 2.124] * u.um
    keywords = {"hwp": "PCUPR", "derotator": "OBRT", "parallactic": "PARANG", "altitude": "EL"}
    references = (
        "NIRC2Pol-DPP, https://github.com/UCSB-Exoplanet-Polarimetry-Lab/NIRC2Pol-DPP",
        "Lewis et al. 2026, announced there",
    )
    site, altitude = (-155.4747, 19.8260, 4145.0), "altitude"
    #: The plate stays where it is put; the K-mirror keeps image or pupil still, by the same signs.
    sky_law = SkyLaw(plate=(0, 0), derotator={"pupil": (0, -0.5), "field": (0.5, -0.5)})

    def inner(self, source, optics_in, grid):
        """Return the plate, the K-mirror and the prism."""
        k_mirror = turning_retarder("derotator", 160, grid, bounds=(0, 360), sign="-")
        plate = turning_retarder("hwp", 178, grid, sign="-", most=22.5)
        return [plate, k_mirror, wollaston(grid)]


class MagAOX(Polarimeter):
    """Magellan/MagAO-X with half-wave plate, K-mirror and polarizing beam splitter.

    Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the cube;
    the angles of plate and K-mirror; and of stars the diattenuation of the tertiary mirror. The
    static retarder ``bench`` is fixed at 0 deg until you free it. Unequal gains of the cameras are
    the nuisance ``"beam_gain"``.
    """

    name = "magaox"
    aliases = ("MagAO-X", "Magellan/MagAO-X")
    # nominal centres of g', r', i' and z'
    wavelength = [527, 614, 762, 908] * u.nm
    keywords = {
        "hwp": "HWPTRACK SET ANGLE",
        "hwp_true": "HWPTRACK ACTUAL ANGLE",
        "derotator": "STAGEK POS",
        "parallactic": "PARANG",
    }
    references = (
        "MagAO-X handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html",
        "Calibration of 2025, https://github.com/mileslucas/2025_magaox_polcal",
    )
    site = (-70.6926, -29.0146, 2400.0)
    #: The plate stays where it is put, the K-mirror follows as at any Nasmyth focus.
    sky_law = SkyLaw(plate=(0, 0))

    def inner(self, source, optics_in, grid):
        """Return the plate, the K-mirror, the optics of the bench and the cube."""
        still = np.zeros(grid.size) * u.deg
        return [
            turning_retarder("hwp", 178, grid),
            turning_retarder("derotator", 160, grid, bounds=(0, 360)),
            optics.LinearRetarder(retardance=still, name="bench", fixed={"retardance": True}),
            # the right beam, camsci2, has the vertical polarization
            wollaston(grid, theta=90 * u.deg),
        ]


# Wiktorowicz et al. 2014: Q, U and V of unpolarized light that leaves telescope and optics
_POLARIZANCE = (-0.00037, 0.004338, -0.0664)
# of the public pipeline of GPI: retardances in Y, J, H, K1 and K2, and the angle of the plate (deg)
_RETARDANCE, _GPI_ZERO = (178.9, 175.6, 172.9, 178.5, 175.8), 29.14


class GPI(Polarimeter):
    """
    Gemini Planet Imager with half-wave plate and Wollaston prism, observing stars.

    Free are, per wavelength, the linear diattenuation of all that is upstream of the plate, the
    retardance of the plate and the efficiency of the prism; and the angle of the plate.
    """

    name = "gpi"
    aliases = ("Gemini/GPI",)
    # nominal centres of Y, J, H, K1 and K2
    wavelength = [1.05, 1.24, 1.65, 2.05, 2.26] * u.um
    keywords = {"hwp": "WPANGLE", "parallactic": "PAR_ANG"}
    references = (
        "Wiktorowicz et al. 2014, Proc. SPIE 9147, arXiv:1407.2505",
        "Perrin et al. 2015, ApJ 799, 182, arXiv:1407.2495",
        "Millar-Blanchaer et al. 2016, Proc. SPIE 9908, 990836, arXiv:1609.08691",
        "GPI data pipeline, https://github.com/geminiplanetimager/gpi_pipeline",
    )
    sources = shared.STARS
    entrance = "telescope_and_ao"
    # what the telescope polarizes is published together with the instrument
    site, focus = (-70.7366, -30.2407, 2722.0), "cassegrain"

    def inner(self, source, optics_in, grid):
        """Return what is upstream of the plate, the plate and the prism."""
        upstream = diattenuator("telescope_and_ao", grid, *_POLARIZANCE[:2])
        retardance = np.interp(grid.to_value(u.um), self.wavelength.value, _RETARDANCE)
        plate = turning_retarder("hwp", retardance, grid, about=_GPI_ZERO, most=30)
        return [upstream, plate, wollaston(grid)]

    def published(self):
        """
        Return the chain of a star with the published polarization, of circular light too.

        A diattenuator with that polarizance has a known matrix (Lu & Chipman 1996).
        """
        vector = np.array(_POLARIZANCE)
        size = np.linalg.norm(vector)
        root, axis = np.sqrt(1 - size**2), vector / size
        matrix = np.eye(4)
        matrix[0, 1:] = matrix[1:, 0] = vector
        matrix[1:, 1:] = root * np.eye(3) + (1 - root) * np.outer(axis, axis)
        upstream = optics.MuellerElement.from_matrix(matrix, name="telescope_and_ao")
        return replace_optic(self.chain("star"), "telescope_and_ao", upstream)

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {"instrument": "gpi", "source": "star"}


class RomanCoronagraph(Polarimeter):
    """Coronagraph of the Roman Space Telescope with its two Wollaston prisms.

    A table has the columns ``roll``, and ``prism``: 0 deg where ``DPAMNAME`` is POL0, 45 deg where
    it is POL45. Its sources are not called stars, as there is no site of the telescope whose sky
    turns: "unpolarized standard", "polarized standard" and "target".

    Free are, per band, the diattenuation of all that is upstream of the prisms, its retardance,
    which lowers the signal of one prism, and the efficiency of the prisms; and their common
    orientation.
    """

    name = "roman"
    aliases = ("Roman/CGI", "CGI")
    wavelength = [573.8, 825.5] * u.nm
    keywords = {"roll": "ROLL", "prism": "DPAMNAME"}
    transforms = {"prism": {"POL0": 0.0, "POL45": 45.0}}
    references = (
        "Groff et al., Proc. SPIE, Roman Space Telescope CGI: prism and polarizer "
        "characterization modes",
        "corgidrp, https://github.com/roman-corgi/corgidrp",
    )
    sources = ("unpolarized standard", "polarized standard", "target")
    sky_options = ()
    entrance = "roll"
    # a chain is of a source in the sky; there is no other that a telescope could be put before
    has_telescope = False

    def light(self, source, grid, star, target):
        """Return a standard star or a target."""
        kind = "star" if source == "target" else f"{source} star"
        light = shared.star_source(kind, grid, star, target)
        if source == "polarized standard" and not target:
            # a start: of a star without polarization nothing tells the efficiencies
            light.q = np.full(grid.size, 0.03)
        return [light]

    def inner(self, source, optics_in, grid):
        """Return the turning of the sky, what is upstream of the prisms, and the prisms."""
        ten = np.full(grid.size, 10.0) * u.deg
        return [
            optics.Rotator(mount="-roll", name="roll"),
            diattenuator("telescope", grid),
            optics.LinearRetarder(retardance=ten, bounds={"retardance": (0, 90)}, name="mirrors"),
            wollaston(grid, mount="prism", **shared.misaligned(0)),
        ]

    def particulars(self, observations):
        """Return the names of a star, ``object`` in the meta: of its source, in the catalogue."""
        return shared.star_options(observations)


# ---- Subaru's -------------------------------------------------------------------------------

_PLATE_AND_DEROTATOR = (
    "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator"
)


class HiCIAO(SubaruPolarimeter):
    """Subaru/HiCIAO with half-wave plate, derotator and Wollaston prism."""

    name = "hiciao"
    aliases = ("Subaru/HiCIAO",)
    # nominal centres of J, H and Ks
    wavelength = [1.25, 1.63, 2.15] * u.um
    references = (
        "Hashimoto, Polarimetric Calibration for Nasmyth instrument HiCIAO, slides of SEEDS",
        _PLATE_AND_DEROTATOR,
    )
    # it had left the telescope before anything of these changed
    changes = ()

    # a tertiary mirror of bare silver
    telescope_optics = VAMPIRES.telescope_optics


class IRCS(SubaruPolarimeter):
    """Subaru/IRCS with the half-wave plate for J, H and K."""

    name = "ircs"
    aliases = ("Subaru/IRCS",)
    # nominal centres of J, H and K
    wavelength = [1.25, 1.63, 2.20] * u.um
    references = (
        "Thermal-infrared adaptive optics imaging- and spectro-polarimetry with IRCS, on another "
        "plate of the same unit",
        _PLATE_AND_DEROTATOR,
    )


class FastPDI(SubaruPolarimeter):
    """Subaru/SCExAO/Fast-PDI with or without its liquid crystal."""

    name = "fastpdi"
    aliases = ("Fast-PDI", "SCExAO/FastPDI", "Subaru/SCExAO/FastPDI")
    # nominal centres of Y, J and H
    wavelength = [1.03, 1.24, 1.63] * u.um
    keywords = SubaruPolarimeter.keywords | {"flc_state": "U_FLCSTT"}
    references = ("fastpdi_dpp, https://github.com/scexao-org/fastpdi_dpp", _PLATE_AND_DEROTATOR)
    optional_optics = ("flc",)
    # what tables say of a liquid crystal is the same
    setup, meta_without = VAMPIRES.setup, VAMPIRES.meta_without

    def camera(self, optics_in, grid):
        """Return the liquid crystal, where it is in, and the beam splitter."""
        crystal = [liquid_crystal(grid.size, switching=45)] if "flc" in optics_in else []
        return [*crystal, *super().camera(optics_in, grid)]


class REACH(SubaruPolarimeter):
    """
    Subaru/SCExAO/REACH; its wavelengths here are one for each band.

    Unequal throughputs of the two fibres are the nuisance ``"beam_gain"``.
    """

    name = "reach"
    aliases = ("SCExAO/REACH", "Subaru/SCExAO/REACH")
    wavelength = [1.05, 1.25, 1.60] * u.um
    references = ("pyird, https://github.com/prvjapan/pyird", _PLATE_AND_DEROTATOR)


#: Every instrument above.
NOMINAL = (FORS2, GPI, IRCS, NIRC2, REACH, FastPDI, HiCIAO, MagAOX, NaCo, RomanCoronagraph)


# ---- optics of several -----------------------------------------------------------------------


def diattenuator(name, grid, horizontal=0.0, diagonal=0.0):
    """Return optics that polarize along a direction of their own, free per wavelength."""
    values = {"horizontal": horizontal, "diagonal": diagonal}
    values = {key: np.full(grid.size, value) for key, value in values.items()}
    return optics.VectorDiattenuator(name=name, **values)


def turning_retarder(
    stage, retardance, grid, *, bounds=(150, 180), sign="", about=0.0, most=10, **more
):
    """Return a retarder on a stage, free in its angle and, per wavelength, its retardance (deg)."""
    held = shared.misaligned(about, most) | {"theta": about * u.deg} | more
    # linear polarization cannot tell 180 + x from 180 - x of a half-wave plate
    held["bounds"] |= {"retardance": bounds}
    values = np.full(grid.size, retardance, dtype=float) * u.deg
    return optics.LinearRetarder(retardance=values, mount=sign + stage, name=stage, **held)


def wollaston(grid, **settings):
    """Return a prism of nominal efficiency, free per wavelength."""
    return optics.WollastonPrism(efficiency=np.full(grid.size, 0.99), name="wollaston", **settings)
