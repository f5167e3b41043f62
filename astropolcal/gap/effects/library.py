# Licensed under a 3-clause BSD style license - see LICENSE
"""
The table of effects: of each its place, kind and dependence, sizes, words and reference.

Places are given by the role of an optic, see `Roles`, so that a row fits every instrument.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.gap.cells import DETECTED
from astropolcal.gap.effects import _laws as laws
from astropolcal.gap.effects.effect import DETECTOR, NUMBER, OWN_RUN, Effect
from astropolcal.gap.effects.where import Where

__all__ = []

_BRYAN = "Bryan et al. 2010, doi:10.1364/AO.49.006313"
_HARRINGTON_2019 = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
_HARTEN = "van Harten et al. 2009, arXiv:0903.2740"
_HOLSTEIN = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
_MCINTOSH = "McIntosh et al. 2026, Sec. 4"
_PATAT = "Patat & Romaniello 2006, doi:10.1086/497581"
_SIGNS = f"McIntosh et al. 2026, Sec. 6.1; {_HOLSTEIN}"
_THART = "'t Hart et al. 2021, doi:10.1117/12.2594962"

_PLATE = Where("in", "plate", True, in_front=True, said="half-wave plate")
_DEROTATOR = Where("in", "derotator", True, said="derotator")
_RELAY = Where("after", "relay", True, said="relay downstream of the derotator")
_STATIC = Where("after", "turning", True, said=_RELAY.said)
_POLARIZER = Where("after", "polarizer", True, said="calibration polarizer")
_MOUNT = Where("in", "polarizer", True, in_front=True, said=_POLARIZER.said)
_MIRROR = Where("after", "mirror", True, said="mirror upstream of the half-wave plate")
_SPLITTER = Where("before", "splitter", True)
_DETECTOR = Where("detector")
_ENTRANCE = Where("before", "entrance", True, said="upstream of the half-wave plate")
_SKY = Where("before", "parallactic", True, said="sky")
# behind the mirror: small diattenuations of one plane add up in any order
_ALTITUDE = Where("before", "altitude", True)
_M3 = Where("in", "telescope_mirror", True, turned=0.0, otherwise=_ALTITUDE, said="tertiary mirror")
_TELESCOPE = Where("telescope")

_AT_DETECTOR = {"words": "detector", "category": "detector"}

_WAVES = ("cosine", "sine")
_ANY_AXIS = ("horizontal", "diagonal")
_RETARDANCE = ("retardance_d", "retardance_h")
_DIATTENUATION = ("diattenuation_h", "diattenuation_d")
_DEPOLARIZED = ("depolarization_d", "depolarization_linear", "depolarization_circular")


def _size(scale, limit, unit=1.0):
    return {"scale": scale * unit, "limit": limit * unit}


def _effect(name, title, place, kind, optic, free, size, shows, reference, **more):
    """Return the effect of an optic that is inserted, of which some parameters are free."""
    free = (free,) if isinstance(free, str) else free
    more |= {"inserted": optic, "free": free, "shows": shows, "reference": reference}
    return more.pop("cls", Effect)(name, title, place, kind, **size, **more)


def _encoder(name, n, place, like, shows):
    """Return a scale off its axis by d, which reads wrong by d sin(angle) over its radius."""
    optic = place.said
    how = ("once a turn (eccentric encoder)", "twice a turn (encoder not round)")[n - 1]
    return _effect(
        name, f"angle of the {optic} wrong {how}", place, "orientation",
        optics.HarmonicRotator(harmonic=n), _WAVES, _size(0.1, 5, u.deg), shows,
        f"geometry of an eccentric scale; compare {like}", degree=NUMBER,
        dependence=f"harmonic:own:{n}", words=f"stage of the {optic}", category="parameter",
    )  # fmt: skip


def _angle_off(name, place, title, dependence, shows):
    """Return an offset of the angle of a stage in some of the frames."""
    optic = place.said
    return Effect(
        name, f"{title} of the {optic}", place, "orientation", dependence, NUMBER,
        shows=shows.format(optic), reference=_HOLSTEIN, words=f"stage of the {optic}",
        category="parameter", **_size(0.1, 5, u.deg))  # fmt: skip


_BACKLASH = "backlash", "direction:own", "opposite offsets of the {} after moves to either side"


def _transmission(name, n, title):
    """Return a gain of both beams that changes as the plate turns."""
    return _effect(
        name, title, _PLATE, (), optics.HarmonicGain(harmonic=n), _WAVES, _size(0.003, 0.1),
        f"harmonic {n} of the plate angle in sums, none in differences",
        "Essinger-Hileman et al. 2016, doi:10.1063/1.4962023", degree=NUMBER,
        dependence=f"harmonic:own:{n}", near=(Where("source"), ("diattenuation_h",)))  # fmt: skip


_NO_RETARDER = optics.LinearRetarder(retardance=0 * u.deg)
_PLATE_EFFECTS = [
    # a constant is the misalignment of the plate, which the model fits
    _effect("hwp_axis_dispersion", "fast axis of the half-wave plate that turns with wavelength",
        _PLATE, "orientation", optics.EllipticalRetarder(), "circular", _size(1, 20, u.deg),
        "phase of harmonic 4 of the plate angle, with wavelength, at all derotator angles",
        "chromatic zero angles of FORS; Bagnulo et al. 2009, doi:10.1086/605654",
        degree=laws.without_constant, category="parameter"),
    _effect("hwp_retardance", "error of the half-wave plate's retardance law",
        _PLATE, "retardance_h", _NO_RETARDER, "retardance", _size(1, 30, u.deg),
        "harmonics 2 and 4 of the plate angle, smooth in wavelength", _THART, category="parameter"),
    # one value per wavelength, for two layers and any smooth law may be too stiff
    _effect("hwp_retardance_free", "retardance of the half-wave plate that no smooth law describes",
        _PLATE, "retardance_h", _NO_RETARDER, "retardance", _size(1, 30, u.deg),
        "harmonics 2 and 4 of the plate angle, any course with wavelength", _THART, degree=None,
        category="parameter"),
    _effect("wavelength_scale", "shift of the wavelength scale",
        _PLATE, "retardance_h", _NO_RETARDER, "retardance", _size(0.3, 10, u.deg),
        "the model's derivative to wavelength",
        "template of a shifted wavelength scale; compare Harrington & Sueoka 2017",
        cls=laws.WavelengthScale, words="spectrograph", category="detector",
        when=lambda roles: laws.has_law(roles.plate)),
    _effect("hwp_diattenuation", "diattenuation of the half-wave plate",
        _PLATE, "diattenuation_h", optics.Diattenuator(), "diattenuation", _size(0.003, 0.1),
        "harmonic 2 of the plate angle in sums and in differences of unpolarized light", _BRYAN),
    _angle_off("hwp_backlash", _PLATE, *_BACKLASH),
    _transmission("hwp_transmission", 2,
        "transmission of the half-wave plate that changes twice a turn"),
    _transmission("hwp_transmission_once", 1,
        "dust or a wedge on the half-wave plate, transmission that changes once a turn"),
    # light that leaves one aperture enters none: seen as opposite gains
    _effect("hwp_beam_wander", "beams that wander over the detector as the half-wave plate turns",
        _DETECTOR, "gain", optics.HarmonicGain(differential=True, mount="hwp"), _WAVES,
        _size(0.003, 0.1), "harmonic 1 of the plate angle in differences of all sources",
        "Tinyanont et al. 2019, doi:10.1088/1538-3873/aaef0f", degree=NUMBER,
        dependence="harmonic:hwp:1", when=lambda roles: roles.plate is not None, **_AT_DETECTOR),
    # its retardance depends on whether the fast axis lies along the tilt or across: twice a turn
    _effect("hwp_tilt", "tilt of the half-wave plate, retardance that changes as it turns",
        _PLATE, "retardance_h", optics.HarmonicRetarder(harmonic=2), _WAVES, _size(0.5, 20, u.deg),
        "harmonics 2, 4, 6 and 8 of the plate angle",
        "Patanchon et al. 2024, doi:10.1088/1475-7516/2024/01/074", degree=NUMBER,
        dependence="harmonic:own:2"),
    _encoder("hwp_encoder_eccentricity", 1,
        _PLATE, "Millar-Blanchaer et al. 2016",
        "harmonics 3 and 5 of the plate angle, none for unpolarized light"),
    _encoder("hwp_encoder_two_lobe", 2,
        _PLATE, "Millar-Blanchaer et al. 2016",
        "harmonics 2 and 6 of the plate angle, none for unpolarized light"),
]  # fmt: skip


def _elliptical(name, title, shows, kinds, *components):
    # with the horizontal component the diagonal one turns the axis: by half the arctangent of
    # their ratio
    return _effect(
        name, title, _DEROTATOR, kinds, None, components, _size(2, 60, u.deg), shows, _MCINTOSH,
        cls=laws.Elliptical, category="parameter",
    )  # fmt: skip


_DEROTATOR_EFFECTS = [
    _elliptical("derotator_45_retardance", "retardance of the derotator at 45 deg",
        "rotation of Q and U that depends on wavelength and derotator angle",
        ("retardance_d", "rotation"), "diagonal"),
    _elliptical("derotator_circular_retardance", "circular retardance of the derotator",
        "rotation of Q and U that depends on wavelength", ("rotation", "retardance_d"), "circular"),
    _elliptical("derotator_elliptical_retardance",
        "retardance of the derotator at 45 deg and circular (an elliptical retarder)",
        "rotation of Q and U that depends on wavelength, in part on the derotator angle",
        ("retardance_d", "rotation"), "diagonal", "circular"),
    _effect("derotator_band_average",
        "retardance of the derotator that changes within a wavelength bin",
        _DEROTATOR, ("depolarization_h", "depolarization_linear", "depolarization_circular"), None,
        "retained_u", _size(0.005, 0.2),
        "less modulation where the retardance is steep, most between the axes of the derotator",
        _HARRINGTON_2019, cls=laws.BandAverage),
    _effect("derotator_diattenuation", "diattenuation of the derotator",
        _DEROTATOR, "diattenuation_h", optics.Diattenuator(), "diattenuation", _size(0.005, 0.2),
        "harmonic 2 of the derotator angle, constant with the plate", _HOLSTEIN),
    *(_encoder(name, n, _DEROTATOR, "van Holstein et al. 2020",
        "rotation of Q and U with the derotator angle, the same at all wavelengths")
      for n, name in enumerate(("derotator_encoder_eccentricity", "derotator_encoder"), 1)),
    _angle_off("derotator_backlash", _DEROTATOR, *_BACKLASH),
    # for internal sources the derotator is static during an exposure: bench data would tie the
    # lag to a rate that they do not have
    _effect("derotator_motion",
        "angle of the derotator of another moment than the middle of the exposure",
        _DEROTATOR, "orientation", lambda leaf: laws.lagging(leaf.mount), "rate", laws.LAG,
        "rotation of Q and U by the rate of the derotator, most near transit", _HOLSTEIN,
        degree=NUMBER, when=lambda roles: any(o.stage == "parallactic" for o in roles.leaves),
        words="stage of the derotator", category="parameter"),
]  # fmt: skip

_WINDOW = {"cls": laws.Fringes, "words": "plane-parallel window downstream of the derotator"}
_FRINGES = _effect("fringes", "fringes of a plane-parallel window",
    _RELAY, _RETARDANCE, optics.EllipticalRetarder(), _ANY_AXIS, _size(1, 30, u.deg),
    "sinusoid in one over the wavelength",
    "Harrington et al. 2017, doi:10.1117/1.JATIS.3.4.048001", **_WINDOW)  # fmt: skip
_DRIFTING = _effect("fringes_drift",
    "fringes of a plane-parallel window that drift through the run",
    _RELAY, _RETARDANCE, optics.DriftRetarder(mount="sequence"),
    (*_ANY_AXIS, "horizontal_rate", "diagonal_rate"), _size(1, 30, u.deg),
    "sinusoid in one over the wavelength, with time",
    "Harrington & Sueoka 2018, doi:10.1117/1.JATIS.4.1.018006",
    near=(_RELAY, _RETARDANCE, ("time", "constant")), **_WINDOW)  # fmt: skip

_RELAY_EFFECTS = [
    # beyond half a turn a retardance comes back with the other sign
    _effect("static_retarder", "retarder that is static downstream of the derotator",
        _STATIC, (*_RETARDANCE, "rotation"), optics.EllipticalRetarder(), (*_ANY_AXIS, "circular"),
        _size(2, 180, u.deg), "pattern in derotator angle, smooth in wavelength", _HARRINGTON_2019),
    _effect("dichroic_j_band", "retardance of a dichroic that changes steeply with wavelength",
        _RELAY, _RETARDANCE, optics.EllipticalRetarder(), _ANY_AXIS, _size(5, 360, u.deg),
        "pattern in derotator angle, sharp in wavelength", _HARRINGTON_2019,
        degree=laws.every_wavelength, words="dichroic", cls=laws.OfLaw),
    *(one.of(thickness) for thickness in (8, 4, 12) for one in (_FRINGES, _DRIFTING)),
    _effect("static_diattenuator", "diattenuator that is static downstream of the derotator",
        _STATIC, "diattenuation", optics.VectorDiattenuator(), _ANY_AXIS, _size(0.005, 0.3),
        "single differences of all sources, at all plate and derotator angles",
        "de Boer et al. 2020, doi:10.1051/0004-6361/201834989"),
    # at 0 deg it would scale what the splitter sees, which the efficiency takes up; a retarder
    # averaged over a band keeps what is along its axis and loses the rest alike: a loss of Q alone
    # is not physical
    _effect("anisotropic_depolarizer",
        "depolarizer downstream of the derotator that is not the same for all orientations",
        _RELAY, _DEPOLARIZED, optics.Depolarizer(theta=22.5 * u.deg), "retained_q",
        _size(0.01, 0.5), "Q measured where there is U, with the derotator angle", _HARRINGTON_2019,
        equal={"retained_v": "retained_q"}),
    _effect("dichroic_band_average",
        "retardance of a dichroic that changes within a wavelength bin",
        _SPLITTER, ("depolarization_linear", "depolarization_h", *_DEPOLARIZED), None, "retained_u",
        _size(0.005, 0.2),
        "less modulation where the retardance is steep, with the derotator angle", _HARRINGTON_2019,
        cls=laws.BandAverage, words="dichroic"),
    _effect("beam_crosstalk", "light of one beam in the other, or any loss of contrast",
        _SPLITTER, (), optics.Depolarizer(), "retained_q", _size(0.01, 0.5),
        "amplitude of harmonic 4 of the plate angle alone: the efficiency takes it up", _THART,
        equal={"retained_u": "retained_q", "retained_v": "retained_q"},
        near=(Where("detector"), ("crosstalk",)), absorbed_by="wollaston.efficiency",
        **_AT_DETECTOR),
    _effect("wollaston_orientation", "Wollaston prism that is turned",
        _SPLITTER, "rotation", optics.EllipticalRetarder(), "circular", _size(1, 20, u.deg),
        "phase with derotator angle, the same at all wavelengths", _HOLSTEIN, degree=NUMBER,
        words="Wollaston prism", category="parameter"),
]  # fmt: skip

_SOURCE_EFFECTS = [
    # along the polarizer a retarder does nothing; at 45 deg it turns linear into circular light:
    # degree of circular polarization = sin(retardance), 1 deg is 1.7 percent
    _effect("source_circular",
        "circular polarization of the source (or a retarder upstream of the plate)",
        Where("after", "polarizer", True, turned=45), _RETARDANCE, _NO_RETARDER, "retardance",
        _size(1, 45, u.deg), "constant in plate angle, varies with derotator angle",
        "computed from the measurement equation; McIntosh et al. 2026, Sec. 2", words="source",
        category="source"),
    _effect("retarder_before_plate",
        "retarder upstream of the half-wave plate in the path of the unpolarized source",
        Where("after", "mirror", True, turned=45), _RETARDANCE, _NO_RETARDER, "retardance",
        _size(5, 90, u.deg),
        "constant in plate angle, varies with derotator angle, unpolarized data alone", _HOLSTEIN,
        words="upstream of the half-wave plate"),
    _effect("source_linear",
        "linear polarization of the source, or a mirror upstream of the half-wave plate",
        _ENTRANCE, "diattenuation", optics.VectorDiattenuator(), _ANY_AXIS, _size(0.01, 0.3),
        "harmonic 4 of the plate angle, as the derotator turns it",
        "McIntosh et al. 2026, Sec. 5.2 (fold mirror of the internal source)", category="source"),
    _effect("source_rotation_drift", "polarization of the source that turns through the run",
        _POLARIZER, "rotation", optics.DriftRotator(mount="sequence"), "rate",
        _size(0.1, 10, u.deg), "phase of harmonic 4 of the plate angle, with time",
        "Harrington et al. 2023, drift terms of DKIST", degree=NUMBER, dependence="time",
        words="source", category="source"),
    # behind a polarizer a leak is an equal loss of all, whatever the axes
    _effect("polarizer_leak", "leak of the calibration polarizer",
        _POLARIZER, ("depolarization_linear", "depolarization_circular"), optics.Depolarizer(),
        "retained_q", _size(0.01, 0.3),
        "amplitude of the polarized data alone: the efficiency takes it up", _THART,
        equal={"retained_u": "retained_q", "retained_v": "retained_q"},
        absorbed_by="wollaston.efficiency", category="source"),
    _effect("standard_polarization",
        "polarization of the standard star itself, which the model holds",
        Where("after", "star", True), "diattenuation", None, ("q", "u"), _size(0.002, 0.3),
        "harmonic 4 of the plate angle, with a phase that is fixed on the sky",
        "Blinov et al. 2023, doi:10.1051/0004-6361/202346778", cls=laws.StandardPolarization,
        words="star", category="source"),
]  # fmt: skip

_SKY_EFFECTS = [
    _effect("m3_diattenuation", "diattenuation of the telescope's tertiary mirror",
        _M3, "diattenuation", optics.Diattenuator(), "diattenuation", _size(0.01, 0.1),
        "harmonic 4 of the plate angle, with a phase that follows altitude and derotator", _HARTEN,
        when=laws.mirror_leaves("retardance"), near=(_TELESCOPE, _DIATTENUATION)),
    # a retarder does nothing to unpolarized light: such stars cannot tell it
    _effect("m3_retardance", "retardance of the telescope's tertiary mirror",
        _M3, "retardance", _NO_RETARDER, "retardance", _size(5, 180, u.deg),
        "circular from linear polarization of stars, with altitude; none of unpolarized ones",
        _HARTEN, near=(_TELESCOPE, ("retardance_h", "retardance_d")),
        when=laws.mirror_leaves("diattenuation", polarized=True)),
    _effect("m3_recoating", "tertiary mirror that is recoated between two datasets of stars",
        _M3, "diattenuation", optics.Diattenuator(), "diattenuation", _size(0.003, 0.1),
        "as the diattenuation of the tertiary mirror, in some datasets and not in others", _HARTEN,
        cls=laws.Recoating, near=(_TELESCOPE, _DIATTENUATION)),
    # constant in flux, so that bright frames are polarized less by it
    _effect("sky_background", "polarized background of the sky in the apertures",
        _SKY, "diattenuation", optics.PolarizedBackground(mount="total_flux"), ("q", "u"),
        _size(0.002, 0.1),
        "harmonic 4 of the plate angle with a phase of its own, as one over the flux", _PATAT,
        flux=2, category="source"),
    _effect("sky_motion", "parallactic angle of another moment than the middle of the exposure",
        _SKY, "rotation", laws.lagging("parallactic"), "rate", laws.LAG,
        "polarization of stars turned by the rate of the parallactic angle, most near transit",
        _HOLSTEIN, degree=NUMBER, words="telescope", category="parameter", cls=laws.OfSky),
    _effect("parallactic_offset", "parallactic angle from another zero",
        _SKY, "rotation", optics.Rotator(fixed={"theta": False}), "theta", _size(1, 45, u.deg),
        "as a turned half-wave plate, where this follows the sky", _HOLSTEIN, degree=NUMBER,
        words="telescope", category="parameter", cls=laws.OfSky),
]  # fmt: skip


def _detected(name, title, kind, size, shows, reference, **more):
    """Return the effect of what only a detector has."""
    optic, free, settings = DETECTOR[kind]
    place = _SPLITTER if kind == "background" else _DETECTOR
    return _effect(
        name, title, place, (), optic, free, size, shows, reference,
        near=(_DETECTOR, (kind,), DETECTED[kind]), **settings, **_AT_DETECTOR, **more)  # fmt: skip


_DETECTOR_EFFECTS = [
    _effect("beam_gain", "unequal gains of the two beams (flat field)",
        _DETECTOR, "gain", optics.BeamGain(), "imbalance", _size(0.005, 0.3),
        "single differences of all sources, constant and harmonic 8 of the plate angle", _PATAT,
        **_AT_DETECTOR),
    _detected("background", "background or stray light in the apertures",
        "background", _size(0.003, 0.2), "amplitude of differences, as one over the flux", _PATAT),
    _detected("detector_nonlinearity", "detector that does not answer linearly",
        "nonlinearity", _size(0.01, 0.3),
        "harmonic 8 of the plate angle in sums, 12 in differences, as the flux",
        "Didier et al. 2019, doi:10.3847/1538-4357/ab0f36; Takakura et al. 2017", degree=0),
    _detected("persistence", "light of the frame before that is still in the detector",
        "persistence", _size(0.003, 0.1), "differences that follow those of the frame before",
        "Smith et al. 2008, doi:10.1117/12.789372", degree=0),
]  # fmt: skip

_PHASE = "phase of harmonic 4 of the plate angle, {}"
_HALF_DEGREE, _TEN_DEGREES = _size(0.5, 5, u.deg), _size(1, 10, u.deg)


def _held(name, where, kind, size, shows, how="which the model holds fixed"):
    return _effect(
        name, f"orientation of the {where.said}, {how}", where, kind, None, "theta", size, shows,
        _HOLSTEIN, cls=laws.Held, category="parameter")  # fmt: skip


def _bound(name, what, where, kind, size, free="theta"):
    return _effect(
        name, f"{what} of the {where.said} beyond its bound", where, kind, None, free, size,
        "along the derivative to the parameter that is at its bound",
        "residual of a constrained fit; Nocedal & Wright 2006, chapter 12",
        cls=laws.Held, category="bound")  # fmt: skip


_HELD_EFFECTS = [
    _held("hwp_misalignment", _PLATE, "orientation", _HALF_DEGREE,
        _PHASE.format("the same at all wavelengths")),
    _held("derotator_misalignment", _DEROTATOR, "orientation", _HALF_DEGREE,
        "pattern in derotator angle of a turned derotator, with its retardance"),
    _held("polarizer_misalignment", _POLARIZER, "rotation", _HALF_DEGREE,
        _PHASE.format("polarized data alone")),
    # a mirror's plane may be anywhere: 45 deg is as far as an axis can be off
    _held("mirror_misalignment", _MIRROR, "rotation", _size(1, 45, u.deg),
        _PHASE.format("unpolarized data alone"), "far from where it should be"),
    _bound("hwp_angle_bound", "orientation", _PLATE, "orientation", _TEN_DEGREES),
    _bound("derotator_angle_bound", "orientation", _DEROTATOR, "orientation", _TEN_DEGREES),
    _bound("polarizer_angle_bound", "orientation", _POLARIZER, "rotation", _TEN_DEGREES),
    _bound("hwp_thickness_bound", "thickness of a layer", _PLATE, "retardance_h",
        _size(0.02, 0.5, u.mm), ("w_sio2", "w_mgf2")),
    _bound("derotator_retardance_bound", "retardance", _DEROTATOR, "retardance_h",
        _size(5, 180, u.deg), ("retardance", "horizontal", "diagonal", "circular")),
]  # fmt: skip

_TURNED = "everywhere: the polarization turns the other way"
_BY_DEROTATOR = "everywhere that depends on the derotator angle"
_SIGN = "angle of the {} with the wrong sign"
_OFFSET = "angle of the {} from another zero or keyword, off by 45 deg"
_AXES = {
    "plate": "stage of the half-wave plate",
    "derotator": "stage of the derotator",
    "splitter": "detector",
    "parallactic": "sky",
    "altitude": "telescope",
}


def _turned(name, title, role, change, shows, **more):
    """Return an optic, by its role, that turns differently from what the model says."""
    return laws.Alternative(name, title, _AXES[role], role, change, shows, **more)


def _followed(name, title, shows, *factors, needs="parallactic"):
    """Return a plate that follows the sky by another law than its instrument says."""
    return _turned(
        name, f"half-wave plate that {title}", "plate", laws.following(*factors),
        f"everywhere on sky: the polarization turns with {shows}", reference=_SIGNS,
        when=lambda roles: getattr(roles, needs) is not None)  # fmt: skip


_STAGES = {"hwp": _PLATE, "derotator": _DEROTATOR}


def _misread(name, title, shows, rate, what, *stages):
    """Return angles of stages that are not those of the table, but a function of them."""
    title = title.format(" and ".join(_STAGES[stage].said for stage in stages))
    role = _STAGES[stages[0]].optic
    return laws.Misread(name, title, _AXES[role], role, shows, stages, what, rate)


# a table that is a frame ahead has the angle before the last move, a late one that after the next
_MISREAD = [
    *(_misread(f"{name}_{when}", f"angle of the {{}} that stands one frame too {when} in the table",
        "differences of all frames before and after a move", rate, what, *stages)
      for name, stages in {"hwp": ["hwp"], "derotator": ["derotator"], "angles": _STAGES}.items()
      for when, rate, what in (("early", -1.0, "_move"), ("late", 1.0, "_next"))),
    *(_misread(f"{stage}_{name}", f"angle of the {{}} that is {words} in the table",
        "everywhere: the polarization turns at another rate", rate, "", stage)
      for name, words, rate in (("doubled", "twice as large", -0.5), ("halved", "halved", 1.0))
      for stage in _STAGES),
    _misread("hwp_reversed", "angle of the {} in reverse order in each cycle of the table",
        "differences of frames that are not in the middle of a cycle", 1.0, "_reversed", "hwp"),
]  # fmt: skip

_ALTERNATIVES = [
    laws.Alternative("mirror_flip",
        "odd number of reflections downstream of the derotator, missing or in excess",
        _RELAY.said, _RELAY, laws.flipped_behind, "everywhere: U and V have the wrong sign",
        when=lambda roles: roles.splitter is not None),
    # an odd number in all: two flips with only rotators between them are a rotation
    laws.Alternative("mirror_flip_before_plate",
        "odd number of reflections upstream of the half-wave plate that the model lacks",
        _ENTRANCE.said, Where("before", "plate"), laws.flipped_before, _TURNED),
    _turned("hwp_sign", _SIGN.format("half-wave plate"), "plate", laws.other_sign, _TURNED),
    _turned("derotator_sign", _SIGN.format("derotator"),
        "derotator", laws.other_sign, _BY_DEROTATOR),
    _turned("beams_swapped", "right and left beam exchanged", "splitter", laws.exchanged,
        "everywhere: the differences have the wrong sign").changed(may_be_in_part=True),
    # two plates 45 deg apart differ by the sign of Q and U: polarization turned by 90 deg
    _turned("hwp_offset", _OFFSET.format("half-wave plate"),
        "plate", laws.turned_by(45), "everywhere: the polarization is turned by 90 deg",
        back=laws.turned_by(-45)),
    _turned("derotator_offset", _OFFSET.format("derotator"),
        "derotator", laws.turned_by(45), _BY_DEROTATOR, back=laws.turned_by(-45)),
    _turned("parallactic_sign", "parallactic angle with the wrong sign",
        "parallactic", laws.other_sign,
        "polarization of stars that turns with the parallactic angle",
        back=laws.other_sign_in_table(-1.0, 1.0), reference=_SIGNS),
    _turned("altitude_sign", "altitude with the wrong sign",
        "altitude", laws.other_sign,
        "everywhere on sky: the polarization turns with twice the altitude",
        back=laws.other_sign_in_table(1.0, -1.0), reference=_SIGNS),
    _followed("hwp_tracking_parallactic_sign", "follows the parallactic angle with the wrong sign",
        "the parallactic angle", -1.0, 1.0),
    _followed("hwp_tracking_altitude_sign", "follows the altitude with the wrong sign",
        "four times the altitude", 1.0, -1.0, needs="altitude"),
    _followed("hwp_not_tracking", "does not move between the commands",
        "parallactic angle and altitude", 0.0, 0.0),
    *_MISREAD,
]  # fmt: skip

#: All effects, by the place where they act.
LIBRARY = (
    _PLATE_EFFECTS + _DEROTATOR_EFFECTS + _RELAY_EFFECTS + _SOURCE_EFFECTS + _SKY_EFFECTS
    + _DETECTOR_EFFECTS + _HELD_EFFECTS + _ALTERNATIVES
)  # fmt: skip

#: What may differ between several runs, in each of which it is asked for.
OF_RUNS = [
    _angle_off(f"{name}_zero", place, "zero of the angle", OWN_RUN,
        "all frames of one run, as an offset of the {}")
    for name, place in (_STAGES | {"polarizer": _MOUNT}).items()
]  # fmt: skip
# of any axis, which is one optic and two or three cells
OF_RUNS += [
    effect.changed(dependence=OWN_RUN)
    for effect in _RELAY_EFFECTS
    if effect.name in ("static_retarder", "static_diattenuator")
]
