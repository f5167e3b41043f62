# Licensed under a 3-clause BSD style license - see LICENSE
"""
What the chains of instruments share: stars, tertiary mirrors, and the polarimeters at Subaru.

On sky a star and the mirrors of the telescope stand before the half-wave plate.
"""

import re
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import optics, standards
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalError, InstrumentError, warn
from astropolcal.optics._modelling import FrozenNormal
from astropolcal.units import to_unit
from astropolcal.words import check_choice

__all__ = []

#: Sources of an internal calibration unit, and kinds of stars.
INTERNAL = ("polarized", "unpolarized")
STARS = ("unpolarized standard star", "polarized standard star", "star")

#: How the tertiary mirror may be modelled.
M3_MODELS = ("free", "power law", "metal")

# McIntosh et al. 2026, Sec. 6: the permittivity of M3 before its coating of December 2025,
# and the values where their fit starts; bounds are 0.5 to 2 times these
_PUBLISHED = {"b1": 15.56, "m1": 3.186, "b2": 9.69, "m2": 1.040}
_START = {"b1": 13.70, "m1": 1.94, "b2": 13.89, "m2": 2.08}
_FILM_START = 60 * u.nm
# 't Hart et al. 2021, the film on the derotator
_DEROTATOR_FILM = 262.56 * u.nm
# what measured silver films differ by from one another (n by far more than k)
_N_SPREAD, _K_SPREAD = 0.5, 0.1
# how far optics that are bolted to their place stand from their nominal orientation
_MOUNTING = 0.3 * u.deg
# q and u of an unpolarized star of which no source states an error
_UNPOLARIZED = 1e-3
# Share by which the degree of polarized stars departs from the law: beyond 1.5 um it falls with a
# power of the wavelength, slower than the law (Martin & Whittet 1990, ApJ 357, 113).
_DEPARTURE = 0.2
# Departures of a star's q and u hang together over a factor of e in the wavelength, so that both a
# grey star and one with a Serkowski law are likely. The first three terms of a process with a
# squared exponential correlation of length L in its logarithm have normal coefficients of widths
# 1, 1 / L and 1 / (sqrt(2) L^2); here L = 1.
_WIDTHS = {"": 1.0, "_slope": 1.0, "_curvature": 0.71}


def tertiary_mirror(model, wavelength):
    """Return the tertiary mirror of an alt-azimuth telescope, ready to be calibrated.

    ``"free"``: one free diattenuation per wavelength; the retardance, which an unpolarized star
    does not constrain, is fixed at that of the published law. ``"power law"``: the paper's
    permittivity, four free numbers for all wavelengths. ``"metal"``: silver with a film of silica;
    its thickness and factors on n and k are free, the factors with normal priors of 0.5 and 0.1
    around 1. All are ``mounted``.
    """
    if model == "power law":
        # the bounds of the paper, half to twice its start
        bounds = {key: (0.5 * start, 2 * start) for key, start in _START.items()}
        return mounted(optics.PowerLawMirror(name="m3", bounds=bounds, **_START))
    if model == "metal":
        settings = {"material": "silver", "film_thickness": _FILM_START, "name": "m3"}
        return mounted(_metal(optics.MetalMirror, 500, **settings))
    retardance = optics.PowerLawMirror(**_PUBLISHED).retardance(wavelength)
    return mounted(free_mirror("m3", np.full(wavelength.size, 0.01), retardance))


def free_mirror(name, diattenuation, retardance, most=1.0):
    """Return a mirror of free diattenuation; its retardance no unpolarized star shows."""
    return optics.DiattenuatorRetarder(
        diattenuation=diattenuation,
        retardance=retardance,
        name=name,
        fixed={"retardance": True},
        bounds={"diattenuation": (-most, most)},
    )


def k_mirror(**settings):
    """
    Return a derotator of three silver mirrors with films of silica, ready to be calibrated.

    Free are the thickness of the films and factors on n and k of silver, with normal priors of 0.5
    and 0.1 around 1, and what else ``fixed`` and ``bounds`` say; ``settings`` are of the optic.
    """
    return _metal(optics.KMirror, 600, film_thickness=_DEROTATOR_FILM, **settings)


def _metal(kind, thickest, *, fixed=(), bounds=(), **settings):
    """Return mirrors with a film of up to so many nm, whose indices have priors."""
    free = dict.fromkeys(("film_thickness", "n_scale", "k_scale"), False)
    limits = {"film_thickness": (0, thickest), "n_scale": (0.05, 20), "k_scale": (0.5, 2)}
    mirror = kind(fixed=free | dict(fixed), bounds=limits | dict(bounds), **settings)
    mirror.n_scale.prior = FrozenNormal(1, _N_SPREAD)
    mirror.k_scale.prior = FrozenNormal(1, _K_SPREAD)
    return mirror


def published_mirror():
    """Return Subaru's tertiary mirror with the published permittivity."""
    return optics.PowerLawMirror(name="m3", **_PUBLISHED)


def telescope(mirror, altitude="-altitude"):
    """Return the optics from the sky to the half-wave plate of an alt-azimuth telescope."""
    return [
        optics.Rotator(mount="parallactic", name="parallactic"),
        mirror,
        optics.Rotator(mount=altitude, name="altitude"),
    ]


def mounted(optic):
    """
    Return the optic, whose orientation is now known as well as its mounting.

    A calibration then finds ``theta`` with a normal prior around its present value, in place of
    taking it as exact.
    """
    spread = _MOUNTING.to_value(optic.theta.unit)
    optic.theta.fixed, optic.theta.prior = False, FrozenNormal(float(optic.theta.value), spread)
    return optic


def as_exact(chain):
    """Hold standard stars and mountings of a chain at what is known of them, and return it."""
    for leaf in leaves(chain):
        keys = leaf.param_names if isinstance(leaf, optics.StarSource) else ["theta"]
        # the orientation of what stands on a stage is for the data to find
        for parameter in (getattr(leaf, key) for key in keys if leaf.mount is None):
            if parameter.prior is not None:
                parameter.fixed, parameter.prior = True, None
    return chain


def star_source(source, wavelength, name="star", target=None):
    """Return the source optic of a star.

    ``"unpolarized standard star"``: q and u are zero with the error of the catalogue, or 0.1 %
    where no source states one; they may change smoothly with the wavelength. ``"polarized standard
    star"``: a Serkowski law with the errors of the catalogue. Both are normal priors of free
    parameters. Of any other star q and u are free at each wavelength. ``target`` is its name in
    the catalogue of standards.
    """
    known = _standard(source, target) if target and source.endswith("standard star") else None
    if source == "unpolarized standard star":
        try:
            error = known.unpolarized_error().value if known else _UNPOLARIZED
        except AstropolcalError:
            error = _UNPOLARIZED
        values = {
            f"{key}{suffix}": (0.0, error * w) for key in "qu" for suffix, w in _smooth(wavelength)
        }
        return _with_priors(name, _middle(wavelength), values)
    if not known:
        zero = np.zeros(wavelength.size)
        return optics.PolarizedSource(q=zero, u=zero, name=name)
    known, middle = known.interstellar(), _middle(wavelength)
    law, errors = known.law, known.errors
    departure = _DEPARTURE * law(middle).to_value(u.one)
    values = {
        "p_max": (law.p_max.value, errors["p_max"]),
        "lambda_max": (law.lambda_max.quantity, errors["lambda_max"]),
        "K": (law.K.value, errors["K"]),
        "theta": (law.theta.quantity, errors["theta"]),
        "rotation": _rotation(known, wavelength),
    }
    # the degree may depart from the law; its angle is better known than that
    values |= {f"q{suffix}": (0.0, departure * w) for suffix, w in _smooth(wavelength)}
    return _with_priors(name, middle, values)


def _rotation(known, wavelength):
    """Return the change of the angle per logarithm of the wavelength, and its error (deg).

    That of the catalogue is one per wavelength; the two are the same in the middle. The error
    makes that of the angle at the wavelength farthest from lambda_max no less than it is in the
    catalogue, where those of angle and rotation go together, and than the two laws differ.
    """
    from scipy.special import exprel

    longest, rotation = known.law.lambda_max.quantity, known.law.rotation.value
    logs = np.log((u.Quantity([_middle(wavelength), *wavelength]) / longest).to_value(u.one))
    # (x - lambda_max) / log(x / lambda_max), in um
    middle, *others = longest.value * exprel(logs)
    far = np.argmax(np.abs(logs[1:]))
    log, per_log = logs[1:][far], others[far]
    shared, turn = known.covariance[4, 3:]
    # of the variance at that wavelength what that of theta leaves, per square of the logarithm
    lacking = turn * per_log**2 + 2 * shared * per_log / (log or 1.0)
    error = np.hypot(np.sqrt(max(lacking, 0.0)), rotation * (per_log - middle))
    return rotation * middle * u.deg, max(np.sqrt(turn) * middle, error) * u.deg


def _with_priors(name, reference, values):
    """Return a star with normal priors: parameter to mean and standard deviation."""
    star = optics.StarSource(
        name=name,
        reference=reference,
        fixed={key: key not in values for key in optics.StarSource.param_names},
        **{key: mean for key, (mean, _) in values.items()},
    )
    for key, numbers in values.items():
        parameter = getattr(star, key)
        # a prior is one of the value in the unit of the parameter
        parameter.prior = FrozenNormal(*(float(to_unit(x, parameter.unit, key)) for x in numbers))
    return star


def _middle(wavelength):
    return np.sqrt(wavelength.min() * wavelength.max())


def _smooth(wavelength):
    """Return the terms of a smooth departure: at one wavelength no slope, at two no curvature."""
    return list(_WIDTHS.items())[: wavelength.size]


def _standard(source, target):
    """Return a standard star; refuse a polarized one that nobody knows, warn of an unpolarized."""
    try:
        known = standards.get(target)
    except AstropolcalError as error:
        if source.startswith("polarized"):
            raise InstrumentError(
                f"{target} as a polarized standard star: {error}; with the source 'star' its "
                "polarization is fitted without a prior"
            ) from error
        warn(f"{error}; it is unpolarized according to the table")
        return None
    if not source.startswith(known.kind):
        raise InstrumentError(
            f"{target} is {known.kind} according to the catalogue, but the table's source is "
            f"{source!r}"
        )
    return known


def star_options(observations):
    """
    Return the options of a chain that name its star, empty for one without a name.

    They are ``star``, the name of the source optic, and ``target``, from ``object`` in the meta of
    the observations.
    """
    target = str(observations.meta.get("object") or "")
    words = re.sub(r"\W+", "", target)
    # a star without a name is the same optic in all datasets
    return {"star": f"star_{words}", "target": target} if words else {}


def stated(meta, name, key, words):
    """Return what the meta say of an optional optic, None where they say nothing."""
    if meta.get(key) is None:
        return None
    word = str(meta[key]).strip().lower()
    check_choice(f"{name}: {key}", word, words, InstrumentError)
    return words[word]


#: Longitude, latitude (deg) and height (m) of the VLT, as in its headers.
PARANAL = (-70.4045, -24.6268, 2648.0)
#: And of the Subaru Telescope.
SITE = (-155.4761, 19.8255, 4139.0)

# 't Hart et al. 2021, thicknesses of the half-wave plate in mm
_THART_SIO2, _THART_MGF2 = 1.63398, 1.27711

#: What has changed; both days are known to the month only (McIntosh et al. 2026, Sec. 2 and 7).
CHANGES = (
    (None, "2025-08-01", "2025-10-01", "the Nasmyth beam switcher was installed"),
    ("m3", "2025-12-01", "2026-01-01", "the tertiary mirror M3 was recoated"),
)


def misaligned(about, most=5):
    """Return what frees an angle within some degrees of where the optic should stand."""
    return {"fixed": {"theta": False}, "bounds": {"theta": (about - most, about + most)}}


def two_layer_plate(**settings):
    """Return the half-wave plate of both instruments, its thicknesses near the published ones."""
    settings["bounds"] |= {
        "w_sio2": (0.6 * _THART_SIO2, 1.4 * _THART_SIO2),
        "w_mgf2": (0.6 * _THART_MGF2, 1.4 * _THART_MGF2),
    }
    return optics.TwoLayerWaveplate(
        w_sio2=_THART_SIO2 * u.mm, w_mgf2=_THART_MGF2 * u.mm, mount="hwp", name="hwp", **settings
    )


def entrance(source, grid, star, target, m3, mirror=tertiary_mirror):
    """Return what stands before the half-wave plate: source, and for a star the telescope."""
    if source in STARS:
        return [star_source(source, grid, star, target), *telescope(mirror(m3, grid))]
    if source == "polarized":
        name = "calibration_polarizer"
        # it passes -Q
        return [optics.LinearPolarizer(theta=90 * u.deg, name=name, **misaligned(90))]
    # what polarizes the lamp where the polarizer is out
    return [mounted(optics.Diattenuator(diattenuation=np.zeros(grid.size), name="fold_mirror"))]


#: McIntosh et al. 2026, Dataset 3: the final fit for each of the bins of the cubes of CHARIS, which
#: have equal resolving power, in the signs they publish.
CHARIS_FIT = QTable.read(Path(__file__).parents[1] / "data" / "charis.ecsv", format="ascii.ecsv")
#: Bounds of the derotator's retardances, by their name.
BOUNDS = {
    # every sign and mirror branch of the retardances
    "physical": {"horizontal": (-360, 360), "diagonal": (-360, 360), "circular": (-360, 360)},
    # 0 to 360 deg in the published signs, turned to ours
    "paper": {"horizontal": (-360, 0), "diagonal": (-360, 0), "circular": (0, 360)},
}
#: The models of the derotator.
DEROTATORS = ("elliptical", "linear", "kmirror")


def derotator(kind, start, bounds):
    """Return a derotator of one of `DEROTATORS`, whose retardance starts so."""
    settings = misaligned(0) | {"mount": "derotator", "name": "derotator"}
    if kind == "kmirror":
        return k_mirror(**settings)
    if kind == "linear":
        settings["bounds"] |= {"retardance": bounds["horizontal"]}
        return optics.LinearRetarder(retardance=start, **settings)
    settings["bounds"] |= bounds
    # a start inside the bounds, off the point where the two small ones vanish
    small = np.full(len(start), 1.0) * u.deg
    return optics.EllipticalRetarder(horizontal=start, diagonal=-small, circular=small, **settings)


def published_derotator(grid, kind="elliptical", bounds="physical"):
    """Return a derotator within some of `BOUNDS`, with the published retardances in our sign."""
    bins = CHARIS_FIT["wavelength"].to_value(u.nm)
    start = -np.interp(grid.to_value(u.nm), bins, CHARIS_FIT["horizontal"])
    return derotator(kind, start, BOUNDS[bounds])
