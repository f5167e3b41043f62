# Licensed under a 3-clause BSD style license - see LICENSE
"""
The table of effects: of each its place, kind and dependence, sizes, words and reference.

Places are given by the role of an optic, see `Roles`, so that a row fits every instrument.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.gap.effects._laws import (
    LAG,
    Alternative,
    BandAverage,
    Elliptical,
    Fringes,
    Held,
    Recoating,
    StandardPolarization,
    WavelengthScale,
    every_wavelength,
    flipped_before,
    flipped_behind,
    following,
    has_law,
    lagging,
    may_be_polarized,
    mirror_leaves,
    other_sign,
    turned_by,
    without_constant,
)
from astropolcal.gap.effects.effect import NUMBER, Effect
from astropolcal.gap.effects.where import Where

__all__ = []

_BRYAN = "Bryan et al. 2010, doi:10.1364/AO.49.006313"
_HARRINGTON_2019 = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
_HARTEN = "van Harten et al. 2009, arXiv:0903.2740"
_HOLSTEIN = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
_MCINTOSH = "McIntosh et al. 2026, Sec. 4"
_PATAT = "Patat & Romaniello 2006, doi:10.1086/497581"
_SIGNS = "McIntosh et al. 2026, Sec. 6.1; van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
_THART = "'t Hart et al. 2021, doi:10.1117/12.2594962"

_PLATE = Where("in", "plate", True, in_front=True)
_DEROTATOR = Where("in", "derotator", True)
_RELAY = Where("after", "relay", True)
_POLARIZER = Where("after", "polarizer", True)
_MIRROR = Where("after", "mirror", True)
_SPLITTER = Where("before", "splitter", True)
_DETECTOR = Where("detector")
_ENTRANCE = Where("before", "entrance", True)
_SKY = Where("before", "parallactic", True)
# behind the mirror: small diattenuations of one plane add up in any order
_M3 = Where("in", "telescope_mirror", True, turned=0.0, otherwise=Where("before", "altitude", True))

_ON_PLATE = {"words": "half-wave plate"}
_AT_DETECTOR = {"words": "detector", "category": "detector"}
_BEHIND = {"words": "relay downstream of the derotator"}
_IN_TELESCOPE = {
    kind: {"words": "tertiary mirror", "near": (Where("telescope"), (f"{kind}_h", f"{kind}_d"))}
    for kind in ("diattenuation", "retardance")
}

_WAVES = ("cosine", "sine")
_ANY_AXIS = ("horizontal", "diagonal")
_CIRCULAR_H_D = ("retardance_d", "retardance_h", "rotation")
_DEPOLARIZED = ("depolarization_d", "depolarization_linear", "depolarization_circular")


def _size(scale, limit, unit=1.0):
    return {"scale": scale * unit, "limit": limit * unit}


def _effect(name, title, place, kind, optic, free, size, shows, reference, **more):
    """Return the effect of an optic that there is already, of which some parameters are free."""
    free = (free,) if isinstance(free, str) else free
    return Effect(
        name, title, place, kind, more.pop("dependence", None), more.pop("degree", 2),
        inserted=optic, free=free, shows=shows, reference=reference, **size, **more,
    )  # fmt: skip


def _encoder(name, n, place, optic, like, shows):
    """Return a scale off its axis by d, which reads wrong by d sin(angle) over its radius."""
    how = ("once a turn (eccentric encoder)", "twice a turn (encoder not round)")[n - 1]
    return _effect(
        name, f"angle of the {optic} wrong {how}", place, "orientation",
        optics.HarmonicRotator(harmonic=n), _WAVES, _size(0.1, 5, u.deg), shows,
        f"geometry of an eccentric scale; compare {like}", degree=NUMBER,
        dependence=f"harmonic:own:{n}", words=f"stage of the {optic}", category="parameter",
    )  # fmt: skip


def _transmission(name, n, title):
    """Return a gain of both beams that changes as the plate turns."""
    return _effect(
        name, title, _PLATE, (), optics.HarmonicGain(harmonic=n), _WAVES, _size(0.003, 0.1),
        f"harmonic {n} of the plate angle in sums, none in differences",
        "Essinger-Hileman et al. 2016, doi:10.1063/1.4962023", degree=NUMBER,
        dependence=f"harmonic:own:{n}", near=(Where("source"), ("diattenuation_h",)), **_ON_PLATE,
    )  # fmt: skip


_NO_RETARDER = optics.LinearRetarder(retardance=0 * u.deg)
_PLATE_EFFECTS = [
    # a constant is the misalignment of the plate, which the model fits
    _effect(
        "hwp_axis_dispersion", "fast axis of the half-wave plate that turns with wavelength",
        _PLATE, "orientation", optics.EllipticalRetarder(), "circular", _size(1, 20, u.deg),
        "phase of harmonic 4 of the plate angle, with wavelength, at all derotator angles",
        "chromatic zero angles of FORS; Bagnulo et al. 2009, doi:10.1086/605654",
        degree=without_constant, **_ON_PLATE, category="parameter",
    ),
    _effect(
        "hwp_retardance", "error of the half-wave plate's retardance law",
        _PLATE, "retardance_h", _NO_RETARDER, "retardance", _size(1, 30, u.deg),
        "harmonics 2 and 4 of the plate angle, smooth in wavelength", _THART,
        **_ON_PLATE, category="parameter",
    ),
    # one value per wavelength, for two layers and any smooth law may be too stiff
    _effect(
        "hwp_retardance_free", "retardance of the half-wave plate that no smooth law describes",
        _PLATE, "retardance_h", _NO_RETARDER, "retardance", _size(1, 30, u.deg),
        "harmonics 2 and 4 of the plate angle, any course with wavelength", _THART,
        degree=None, **_ON_PLATE, category="parameter",
    ),
    WavelengthScale(
        "wavelength_scale", "shift of the wavelength scale", _PLATE, "retardance_h",
        inserted=_NO_RETARDER, free=("retardance",), **_size(0.3, 10, u.deg),
        words="spectrograph", category="detector", when=lambda roles: has_law(roles.plate),
        shows="the model's derivative to wavelength",
        reference="template of a shifted wavelength scale; compare Harrington & Sueoka 2017",
    ),
    _effect(
        "hwp_diattenuation", "diattenuation of the half-wave plate",
        _PLATE, "diattenuation_h", optics.Diattenuator(), "diattenuation", _size(0.003, 0.1),
        "harmonic 2 of the plate angle in sums and in differences of unpolarized light", _BRYAN,
        **_ON_PLATE,
    ),
    _transmission(
        "hwp_transmission", 2, "transmission of the half-wave plate that changes twice a turn",
    ),
    _transmission(
        "hwp_transmission_once", 1,
        "dust or a wedge on the half-wave plate, transmission that changes once a turn",
    ),
    # light that leaves one aperture enters none: seen as opposite gains
    _effect(
        "hwp_beam_wander", "beams that wander over the detector as the half-wave plate turns",
        _DETECTOR, "gain", optics.HarmonicGain(differential=True, mount="hwp"), _WAVES,
        _size(0.003, 0.1), "harmonic 1 of the plate angle in differences of all sources",
        "Tinyanont et al. 2019, doi:10.1088/1538-3873/aaef0f",
        degree=NUMBER, dependence="harmonic:hwp:1", when=lambda roles: roles.plate is not None,
        **_AT_DETECTOR,
    ),
    # its retardance depends on whether the fast axis lies along the tilt or across: twice a turn
    _effect(
        "hwp_tilt", "tilt of the half-wave plate, retardance that changes as it turns",
        _PLATE, "retardance_h", optics.HarmonicRetarder(harmonic=2), _WAVES,
        _size(0.5, 20, u.deg), "harmonics 2, 4, 6 and 8 of the plate angle",
        "Patanchon et al. 2024, doi:10.1088/1475-7516/2024/01/074",
        degree=NUMBER, dependence="harmonic:own:2", **_ON_PLATE,
    ),
    _encoder(
        "hwp_encoder_eccentricity", 1, _PLATE, "half-wave plate", "Millar-Blanchaer et al. 2016",
        "harmonics 3 and 5 of the plate angle, none for unpolarized light",
    ),
    _encoder(
        "hwp_encoder_two_lobe", 2, _PLATE, "half-wave plate", "Millar-Blanchaer et al. 2016",
        "harmonics 2 and 6 of the plate angle, none for unpolarized light",
    ),
]  # fmt: skip


def _elliptical(name, title, shows, kinds, *components):
    # with the horizontal component the diagonal one turns the axis: by half the arctangent of
    # their ratio
    return Elliptical(
        name, title, _DEROTATOR, kinds, components=components,
        words="derotator", category="parameter", shows=shows, reference=_MCINTOSH,
        **_size(2, 60, u.deg),
    )  # fmt: skip


_DEROTATOR_EFFECTS = [
    _elliptical(
        "derotator_45_retardance", "retardance of the derotator at 45 deg",
        "rotation of Q and U that depends on wavelength and derotator angle",
        ("retardance_d", "rotation"), "diagonal",
    ),
    _elliptical(
        "derotator_circular_retardance", "circular retardance of the derotator",
        "rotation of Q and U that depends on wavelength",
        ("rotation", "retardance_d"), "circular",
    ),
    _elliptical(
        "derotator_elliptical_retardance",
        "retardance of the derotator at 45 deg and circular (an elliptical retarder)",
        "rotation of Q and U that depends on wavelength, in part on the derotator angle",
        ("retardance_d", "rotation"), "diagonal", "circular",
    ),
    BandAverage(
        "derotator_band_average",
        "retardance of the derotator that changes within a wavelength bin",
        _DEROTATOR, ("depolarization_h", "depolarization_linear", "depolarization_circular"),
        **_size(0.005, 0.2), free=("retained_u",), words="derotator",
        shows="less modulation where the retardance is steep, most between the axes of the "
        "derotator", reference=_HARRINGTON_2019,
    ),
    _effect(
        "derotator_diattenuation", "diattenuation of the derotator",
        _DEROTATOR, "diattenuation_h", optics.Diattenuator(), "diattenuation", _size(0.005, 0.2),
        "harmonic 2 of the derotator angle, constant with the plate", _HOLSTEIN,
        words="derotator",
    ),
    *(
        _encoder(
            name, n, _DEROTATOR, "derotator", "van Holstein et al. 2020",
            "rotation of Q and U with the derotator angle, the same at all wavelengths",
        )
        for n, name in enumerate(("derotator_encoder_eccentricity", "derotator_encoder"), 1)
    ),
    # for internal sources the derotator is static during an exposure: bench data would tie the
    # lag to a rate that they do not have
    _effect(
        "derotator_motion",
        "angle of the derotator of another moment than the middle of the exposure",
        _DEROTATOR, "orientation", lambda derotator: lagging(derotator.mount), "rate", LAG,
        "rotation of Q and U by the rate of the derotator, most near transit", _HOLSTEIN,
        degree=NUMBER, when=lambda roles: any(o.stage == "parallactic" for o in roles.leaves),
        words="stage of the derotator",
        category="parameter",
    ),
]  # fmt: skip

_FRINGES = Fringes(
    "fringes", "fringes of a plane-parallel window", _RELAY, ("retardance_d", "retardance_h"),
    inserted=optics.EllipticalRetarder(), free=_ANY_AXIS, **_size(1, 30, u.deg),
    words="plane-parallel window downstream of the derotator",
    shows="sinusoid in one over the wavelength",
    reference="Harrington et al. 2017, doi:10.1117/1.JATIS.3.4.048001",
)  # fmt: skip
_DRIFTING = Fringes(
    "fringes_drift", "fringes of a plane-parallel window that drift through the run", _RELAY,
    ("retardance_d", "retardance_h"), inserted=optics.DriftRetarder(mount="sequence"),
    near=(_RELAY, ("retardance_d", "retardance_h"), ("time", "constant")),
    free=(*_ANY_AXIS, "horizontal_rate", "diagonal_rate"), **_size(1, 30, u.deg),
    words="plane-parallel window downstream of the derotator",
    shows="sinusoid in one over the wavelength, with time",
    reference="Harrington & Sueoka 2018, doi:10.1117/1.JATIS.4.1.018006",
)  # fmt: skip

_RELAY_EFFECTS = [
    # beyond half a turn a retardance comes back with the other sign
    _effect(
        "static_retarder", "retarder that is static downstream of the derotator",
        _RELAY, _CIRCULAR_H_D, optics.EllipticalRetarder(), (*_ANY_AXIS, "circular"),
        _size(2, 180, u.deg), "pattern in derotator angle, smooth in wavelength",
        _HARRINGTON_2019, **_BEHIND,
    ),
    _effect(
        "dichroic_j_band", "retardance of a dichroic that changes steeply with wavelength",
        _RELAY, ("retardance_d", "retardance_h"), optics.EllipticalRetarder(), _ANY_AXIS,
        _size(5, 360, u.deg), "pattern in derotator angle, sharp in wavelength", _HARRINGTON_2019,
        degree=every_wavelength, words="dichroic",
    ),
    *(one.of(thickness) for thickness in (8, 4, 12) for one in (_FRINGES, _DRIFTING)),
    _effect(
        "static_diattenuator", "diattenuator that is static downstream of the derotator",
        _RELAY, "diattenuation", optics.VectorDiattenuator(), _ANY_AXIS, _size(0.005, 0.3),
        "single differences of all sources, at all plate and derotator angles",
        "de Boer et al. 2020, doi:10.1051/0004-6361/201834989", **_BEHIND,
    ),
    # at 0 deg it would scale what the splitter sees, which the efficiency takes up; a retarder
    # averaged over a band keeps what is along its axis and loses the rest alike: a loss of Q alone
    # is not physical
    _effect(
        "anisotropic_depolarizer",
        "depolarizer downstream of the derotator that is not the same for all orientations",
        _RELAY, _DEPOLARIZED, optics.Depolarizer(theta=22.5 * u.deg), "retained_q",
        _size(0.01, 0.5), "Q measured where there is U, with the derotator angle",
        _HARRINGTON_2019, equal={"retained_v": "retained_q"}, **_BEHIND,
    ),
    BandAverage(
        "dichroic_band_average", "retardance of a dichroic that changes within a wavelength bin",
        _SPLITTER, ("depolarization_linear", "depolarization_h", *_DEPOLARIZED),
        **_size(0.005, 0.2), free=("retained_u",), words="dichroic",
        shows="less modulation where the retardance is steep, with the derotator angle",
        reference=_HARRINGTON_2019,
    ),
    _effect(
        "beam_crosstalk", "light of one beam in the other, or any loss of contrast",
        _SPLITTER, (), optics.Depolarizer(), "retained_q", _size(0.01, 0.5),
        "amplitude of harmonic 4 of the plate angle alone: the efficiency takes it up", _THART,
        equal={"retained_u": "retained_q", "retained_v": "retained_q"},
        near=(Where("detector"), ("crosstalk",)), absorbed_by="wollaston.efficiency",
        **_AT_DETECTOR,
    ),
    _effect(
        "wollaston_orientation", "Wollaston prism that is turned",
        _SPLITTER, "rotation", optics.EllipticalRetarder(), "circular", _size(1, 20, u.deg),
        "phase with derotator angle, the same at all wavelengths", _HOLSTEIN,
        degree=NUMBER, words="Wollaston prism", category="parameter",
    ),
]  # fmt: skip

_SOURCE_EFFECTS = [
    # along the polarizer a retarder does nothing; at 45 deg it turns linear into circular light:
    # degree of circular polarization = sin(retardance), 1 deg is 1.7 percent
    _effect(
        "source_circular",
        "circular polarization of the source (or a retarder upstream of the plate)",
        Where("after", "polarizer", True, turned=45), ("retardance_d", "retardance_h"),
        _NO_RETARDER, "retardance", _size(1, 45, u.deg),
        "constant in plate angle, varies with derotator angle",
        "computed from the measurement equation; McIntosh et al. 2026, Sec. 2",
        words="source", category="source",
    ),
    _effect(
        "retarder_before_plate",
        "retarder upstream of the half-wave plate in the path of the unpolarized source",
        Where("after", "mirror", True, turned=45), ("retardance_d", "retardance_h"),
        _NO_RETARDER, "retardance", _size(5, 90, u.deg),
        "constant in plate angle, varies with derotator angle, unpolarized data alone", _HOLSTEIN,
        words="upstream of the half-wave plate",
    ),
    _effect(
        "source_linear",
        "linear polarization of the source, or a mirror upstream of the half-wave plate",
        _ENTRANCE, "diattenuation", optics.VectorDiattenuator(), _ANY_AXIS, _size(0.01, 0.3),
        "harmonic 4 of the plate angle, as the derotator turns it",
        "McIntosh et al. 2026, Sec. 5.2 (fold mirror of the internal source)",
        words="upstream of the half-wave plate", category="source",
    ),
    _effect(
        "source_rotation_drift", "polarization of the source that turns through the run",
        _POLARIZER, "rotation", optics.DriftRotator(mount="sequence"), "rate",
        _size(0.1, 10, u.deg), "phase of harmonic 4 of the plate angle, with time",
        "Harrington et al. 2023, drift terms of DKIST",
        degree=NUMBER, dependence="time", words="source", category="source",
    ),
    # behind a polarizer a leak is an equal loss of all, whatever the axes
    _effect(
        "polarizer_leak", "leak of the calibration polarizer",
        _POLARIZER, ("depolarization_linear", "depolarization_circular"), optics.Depolarizer(),
        "retained_q", _size(0.01, 0.3),
        "amplitude of the polarized data alone: the efficiency takes it up", _THART,
        equal={"retained_u": "retained_q", "retained_v": "retained_q"},
        absorbed_by="wollaston.efficiency", words="calibration polarizer", category="source",
    ),
    StandardPolarization(
        "standard_polarization", "polarization of the standard star itself, which the model holds",
        Where("after", "star", True), "diattenuation", free=("q", "u"), **_size(0.003, 0.3),
        words="star", category="source",
        shows="harmonic 4 of the plate angle, with a phase that is fixed on the sky",
        reference="Blinov et al. 2023, doi:10.1051/0004-6361/202346778",
    ),
]  # fmt: skip

_SKY_EFFECTS = [
    _effect(
        "m3_diattenuation", "diattenuation of the telescope's tertiary mirror",
        _M3, "diattenuation", optics.Diattenuator(), "diattenuation", _size(0.01, 0.1),
        "harmonic 4 of the plate angle, with a phase that follows altitude and derotator",
        _HARTEN, when=mirror_leaves("retardance"), **_IN_TELESCOPE["diattenuation"],
    ),
    # a retarder does nothing to unpolarized light: such stars cannot tell it
    _effect(
        "m3_retardance", "retardance of the telescope's tertiary mirror",
        _M3, "retardance", _NO_RETARDER, "retardance", _size(5, 180, u.deg),
        "circular from linear polarization of stars, with altitude; none of unpolarized ones",
        _HARTEN, **_IN_TELESCOPE["retardance"],
        when=lambda roles: may_be_polarized(roles) and mirror_leaves("diattenuation")(roles),
    ),
    Recoating(
        "m3_recoating", "tertiary mirror that is recoated between two datasets of stars",
        _M3, "diattenuation", inserted=optics.Diattenuator(), free=("diattenuation",),
        **_size(0.003, 0.1), **_IN_TELESCOPE["diattenuation"], reference=_HARTEN,
        shows="as the diattenuation of the tertiary mirror, in some datasets and not in others",
    ),
    # constant in flux, so that bright frames are polarized less by it
    _effect(
        "sky_background", "polarized background of the sky in the apertures",
        _SKY, "diattenuation", optics.PolarizedBackground(mount="total_flux"), ("q", "u"),
        _size(0.002, 0.1),
        "harmonic 4 of the plate angle with a phase of its own, as one over the flux", _PATAT,
        degree=1, flux=2, words="sky", category="source",
    ),
    _effect(
        "sky_motion", "parallactic angle of another moment than the middle of the exposure",
        _SKY, "rotation", lagging("parallactic"), "rate", LAG,
        "polarization of stars turned by the rate of the parallactic angle, most near transit",
        _HOLSTEIN, degree=NUMBER, when=may_be_polarized, words="telescope", category="parameter",
    ),
]  # fmt: skip

_DETECTOR_EFFECTS = [
    _effect(
        "beam_gain", "unequal gains of the two beams (flat field)",
        _DETECTOR, "gain", optics.BeamGain(), "imbalance", _size(0.005, 0.3),
        "single differences of all sources, constant and harmonic 8 of the plate angle", _PATAT,
        **_AT_DETECTOR,
    ),
    # the amount is a share of the usual flux of both beams together
    _effect(
        "background", "background or stray light in the apertures",
        _SPLITTER, (), optics.StrayLight(mount="total_flux"), "amount", _size(0.003, 0.2),
        "amplitude of differences, as one over the flux", _PATAT,
        flux=2, near=(Where("detector"), ("background",), "flux"), **_AT_DETECTOR,
    ),
    # one detector: the same law for both beams
    _effect(
        "detector_nonlinearity", "detector that does not answer linearly",
        _DETECTOR, (), optics.FluxGain(power=1, mount="flux"), "right", _size(0.01, 0.3),
        "harmonic 8 of the plate angle in sums, 12 in differences, as the flux",
        "Didier et al. 2019, doi:10.3847/1538-4357/ab0f36; Takakura et al. 2017", degree=0,
        flux=1, equal={"left": "right"}, near=(Where("detector"), ("nonlinearity",), "flux"),
        **_AT_DETECTOR,
    ),
    # the gain of a beam grows as the flux before over the flux now
    _effect(
        "persistence", "light of the frame before that is still in the detector",
        _DETECTOR, (), optics.FluxGain(power=-1, mount="previous_flux"), "right",
        _size(0.003, 0.1), "differences that follow those of the frame before",
        "Smith et al. 2008, doi:10.1117/12.789372", degree=0, equal={"left": "right"},
        near=(Where("detector"), ("persistence",), "previous"), **_AT_DETECTOR,
    ),
]  # fmt: skip

_HELD = "orientation of the {}, which the model holds fixed"
_PHASE = "phase of harmonic 4 of the plate angle, {}"
_BOUND = {
    "category": "bound",
    "shows": "along the derivative to the parameter that is at its bound",
    "reference": "residual of a constrained fit; Nocedal & Wright 2006, chapter 12",
}
_HALF_DEGREE, _TEN_DEGREES = _size(0.5, 5, u.deg), _size(1, 10, u.deg)


def _held(name, title, where, kind, words, size, free=("theta",), **more):
    more = {"category": "parameter", "reference": _HOLSTEIN} | more
    return Held(name, title, where, kind, words=words, free=free, **size, **more)


_HELD_EFFECTS = [
    _held(
        "hwp_misalignment", _HELD.format("half-wave plate"), _PLATE, "orientation",
        "half-wave plate", _HALF_DEGREE, shows=_PHASE.format("the same at all wavelengths"),
    ),
    _held(
        "derotator_misalignment", _HELD.format("derotator"), _DEROTATOR, "orientation",
        "derotator", _HALF_DEGREE,
        shows="pattern in derotator angle of a turned derotator, with its retardance",
    ),
    _held(
        "polarizer_misalignment", _HELD.format("calibration polarizer"), _POLARIZER, "rotation",
        "calibration polarizer", _HALF_DEGREE, shows=_PHASE.format("polarized data alone"),
    ),
    # a mirror's plane may be anywhere: 45 deg is as far as an axis can be off
    _held(
        "mirror_misalignment",
        "orientation of the mirror upstream of the half-wave plate, far from where it should be",
        _MIRROR, "rotation", "mirror upstream of the half-wave plate", _size(1, 45, u.deg),
        shows=_PHASE.format("unpolarized data alone"),
    ),
    _held(
        "hwp_angle_bound", "orientation of the half-wave plate beyond its bound",
        _PLATE, "orientation", "half-wave plate", _TEN_DEGREES, **_BOUND,
    ),
    _held(
        "derotator_angle_bound", "orientation of the derotator beyond its bound",
        _DEROTATOR, "orientation", "derotator", _TEN_DEGREES, **_BOUND,
    ),
    _held(
        "polarizer_angle_bound", "orientation of the calibration polarizer beyond its bound",
        _POLARIZER, "rotation", "calibration polarizer", _TEN_DEGREES, **_BOUND,
    ),
    _held(
        "hwp_thickness_bound", "thickness of a layer of the half-wave plate beyond its bound",
        _PLATE, "retardance_h", "half-wave plate", _size(0.02, 0.5, u.mm), ("w_sio2", "w_mgf2"),
        **_BOUND,
    ),
    _held(
        "derotator_retardance_bound", "retardance of the derotator beyond its bound",
        _DEROTATOR, "retardance_h", "derotator", _size(5, 180, u.deg),
        ("retardance", "horizontal", "diagonal", "circular"), **_BOUND,
    ),
]  # fmt: skip

_TURNED = "everywhere: the polarization turns the other way"
_BY_DEROTATOR = "everywhere that depends on the derotator angle"
_SIGN = "angle of the {} with the wrong sign"
_OFFSET = "angle of the {} from another zero or keyword, off by 45 deg"
_PLATE_WORDS, _DEROTATOR_WORDS = "stage of the half-wave plate", "stage of the derotator"


def _followed(name, title, shows, *factors, needs="parallactic"):
    """Return a plate that follows the sky by another law than its instrument says."""
    return Alternative(
        name, f"half-wave plate that {title}", _PLATE_WORDS, "plate", following(*factors),
        shows=f"everywhere on sky: the polarization turns with {shows}", reference=_SIGNS,
        when=lambda roles: getattr(roles, needs) is not None,
    )  # fmt: skip


_ALTERNATIVES = [
    Alternative(
        "mirror_flip",
        "odd number of reflections downstream of the derotator, missing or in excess",
        "relay downstream of the derotator", "relay", flipped_behind,
        shows="everywhere: U and V have the wrong sign",
        when=lambda roles: roles.splitter is not None,
    ),
    # an odd number in all: two flips with only rotators between them are a rotation
    Alternative(
        "mirror_flip_before_plate",
        "odd number of reflections upstream of the half-wave plate that the model lacks",
        "upstream of the half-wave plate", Where("before", "plate"), flipped_before, shows=_TURNED,
    ),
    Alternative("hwp_sign", _SIGN.format("half-wave plate"), _PLATE_WORDS, "plate", other_sign,
                shows=_TURNED),
    Alternative("derotator_sign", _SIGN.format("derotator"), _DEROTATOR_WORDS, "derotator",
                other_sign, shows=_BY_DEROTATOR),
    # T(-90) exchanges the axes of the prism, and with them the beams
    Alternative("beams_swapped", "right and left beam exchanged", "detector", "splitter",
                turned_by(90), shows="everywhere: the differences have the wrong sign"),
    # two plates 45 deg apart differ by the sign of Q and U: polarization turned by 90 deg
    Alternative("hwp_offset", _OFFSET.format("half-wave plate"), _PLATE_WORDS, "plate",
                turned_by(45), shows="everywhere: the polarization is turned by 90 deg"),
    Alternative("derotator_offset", _OFFSET.format("derotator"), _DEROTATOR_WORDS, "derotator",
                turned_by(45), shows=_BY_DEROTATOR),
    Alternative("parallactic_sign", "parallactic angle with the wrong sign", "sky", "parallactic",
                other_sign, reference=_SIGNS,
                shows="polarization of stars that turns with the parallactic angle"),
    Alternative("altitude_sign", "altitude with the wrong sign", "telescope", "altitude",
                other_sign, reference=_SIGNS,
                shows="everywhere on sky: the polarization turns with twice the altitude"),
    _followed("hwp_tracking_parallactic_sign", "follows the parallactic angle with the wrong sign",
              "the parallactic angle", -1.0, 1.0),
    _followed("hwp_tracking_altitude_sign", "follows the altitude with the wrong sign",
              "four times the altitude", 1.0, -1.0, needs="altitude"),
    _followed("hwp_not_tracking", "does not move between the commands",
              "parallactic angle and altitude", 0.0, 0.0),
]  # fmt: skip

#: All effects, by the place where they act.
LIBRARY = (
    _PLATE_EFFECTS + _DEROTATOR_EFFECTS + _RELAY_EFFECTS + _SOURCE_EFFECTS + _SKY_EFFECTS
    + _DETECTOR_EFFECTS + _HELD_EFFECTS + _ALTERNATIVES
)  # fmt: skip
