# Licensed under a 3-clause BSD style license - see LICENSE
"""
Which cells of the table of places, kinds and dependences an effect is, or is nearest to.

A template names optics by their role, see `Roles`: ``in:plate``, ``after:relay``; ``before:plate``
is the place in front of one, and ``behind`` the last place of a chain.
"""

from astropolcal.gap.cells import Cell, places

__all__ = ["filled_in"]

_ORIENTATION = {
    role: (f"in:{role} rotation", f"before:{role} rotation") for role in ("plate", "derotator")
}
_RETARDER = ("after:relay retardance_h", "after:relay retardance_d")
_STAR = ("source diattenuation_h", "source diattenuation_d")
_SOURCE_RETARDER = ("source retardance_d", "source retardance_h")


def _with(dependence, templates):
    return tuple(f"{template} {dependence}" for template in templates)


#: Place, kind and dependence (by default constant) of each effect, the main one first.
TEMPLATES = {
    "hwp_retardance": ("in:plate retardance_h",),
    "hwp_retardance_free": ("in:plate retardance_h",),
    "wavelength_scale": ("in:plate retardance_h",),
    "hwp_thickness_bound": ("in:plate retardance_h",),
    "hwp_diattenuation": ("in:plate diattenuation_h",),
    "hwp_transmission": ("in:plate diattenuation_h",),
    "hwp_transmission_once": ("in:plate diattenuation_h harmonic:plate:1",),
    "hwp_beam_wander": ("detector gain harmonic:plate:1",),
    "hwp_tilt": ("in:plate retardance_h harmonic:plate:2",),
    "hwp_axis_dispersion": _ORIENTATION["plate"],
    "hwp_misalignment": _ORIENTATION["plate"],
    "hwp_angle_bound": _ORIENTATION["plate"],
    "hwp_encoder_eccentricity": _with("harmonic:plate:1", _ORIENTATION["plate"]),
    "hwp_encoder_two_lobe": _with("harmonic:plate:2", _ORIENTATION["plate"]),
    "derotator_45_retardance": ("in:derotator retardance_d", "in:derotator rotation"),
    "derotator_circular_retardance": ("in:derotator rotation", "in:derotator retardance_d"),
    "derotator_elliptical_retardance": ("in:derotator retardance_d", "in:derotator rotation"),
    "derotator_retardance_bound": ("in:derotator retardance_h",),
    "derotator_band_average": (
        "in:derotator depolarization_h",
        "in:derotator depolarization_linear",
        "in:derotator depolarization_circular",
    ),
    "derotator_diattenuation": ("in:derotator diattenuation_h",),
    "derotator_misalignment": _ORIENTATION["derotator"],
    "derotator_angle_bound": _ORIENTATION["derotator"],
    "derotator_motion": _ORIENTATION["derotator"],
    "derotator_encoder_eccentricity": _with("harmonic:derotator:1", _ORIENTATION["derotator"]),
    "derotator_encoder": _with("harmonic:derotator:2", _ORIENTATION["derotator"]),
    "static_retarder": (*_RETARDER, "after:relay rotation"),
    "dichroic_j_band": _RETARDER,
    "fringes": _RETARDER,
    "fringes_drift": (*_with("time", _RETARDER), *_RETARDER),
    "static_diattenuator": ("after:relay diattenuation_h", "after:relay diattenuation_d"),
    "anisotropic_depolarizer": (
        "after:relay depolarization_d",
        "after:relay depolarization_linear",
        "after:relay depolarization_circular",
    ),
    "dichroic_band_average": (
        "behind depolarization_linear",
        "behind depolarization_h",
        "behind depolarization_d",
        "behind depolarization_circular",
    ),
    "beam_crosstalk": ("detector crosstalk",),
    "wollaston_orientation": ("behind rotation",),
    "source_circular": _SOURCE_RETARDER,
    "retarder_before_plate": _SOURCE_RETARDER,
    "source_linear": _STAR,
    "source_rotation_drift": ("source rotation time",),
    "polarizer_leak": ("source depolarization_linear", "source depolarization_circular"),
    "polarizer_misalignment": ("source rotation",),
    "polarizer_angle_bound": ("source rotation",),
    "mirror_misalignment": ("source rotation",),
    "standard_polarization": _STAR,
    "sky_background": _STAR,
    "sky_motion": ("source rotation",),
    "m3_diattenuation": ("telescope diattenuation_h", "telescope diattenuation_d"),
    "m3_recoating": ("telescope diattenuation_h", "telescope diattenuation_d"),
    "m3_retardance": ("telescope retardance_h", "telescope retardance_d"),
    "beam_gain": ("detector gain",),
    "background": ("detector background flux",),
    "detector_nonlinearity": ("detector nonlinearity flux",),
    "persistence": ("detector persistence previous",),
}


def filled_in(effect, chains):
    """Return the cells of an effect, with the names of the optics of these chains."""
    templates = TEMPLATES.get(getattr(effect, "stem", effect.name.partition(":")[0]), ())
    chains = list(chains)
    own = [chain for chain in chains if effect.applies_to(effect.roles(chain))] or chains
    found = [_cell(effect, template, own[0]) for template in templates] if own else []
    return tuple(dict.fromkeys(found))


def _cell(effect, template, chain):
    place, kind, dependence, *_ = (*template.split(), "constant")
    roles, there = effect.roles(chain), [place.name for place in places(chain)]
    head, _, role = place.partition(":")
    optic = getattr(roles, role).name if role and getattr(roles, role) is not None else None
    if head == "before":
        at = there.index(f"in:{optic}") if f"in:{optic}" in there else 1
        place = there[max(at - 1, 0)]
    elif role:
        place = f"{head}:{optic}"
    elif head == "behind":
        place = there[-1]
    what, _, rest = dependence.partition(":")
    if what == "harmonic":
        role, _, count = rest.partition(":")
        dependence = f"harmonic:{getattr(roles, role).stage}:{count}"
    return Cell(place, kind, dependence)
