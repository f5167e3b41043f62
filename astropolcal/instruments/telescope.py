# Licensed under a 3-clause BSD style license - see LICENSE
"""What stands before the half-wave plate on sky: a star, and the telescope's tertiary mirror."""

import re
import warnings

import astropy.units as u
import numpy as np

from astropolcal import optics, standards
from astropolcal.chain import leaves
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    ChainError,
    InstrumentError,
)
from astropolcal.observations import is_star

__all__ = [
    "INTERNAL",
    "M3_MODELS",
    "STARS",
    "behind_telescope",
    "k_mirror",
    "published_mirror",
    "star_options",
    "star_source",
    "telescope",
    "tertiary_mirror",
]

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
# no catalogue polarization is known better than this, so that no datum weighs without limit
_LEAST_ERROR = 1e-4


def tertiary_mirror(model, wavelength, name="m3"):
    """
    Return the tertiary mirror of an alt-azimuth telescope, ready to be calibrated.

    Parameters
    ----------
    model : {"free", "power law", "metal"}
        ``"free"``: one free diattenuation a wavelength; the retardance, of which an
        unpolarized star tells nothing, is fixed at that of the published law.
        ``"power law"``: the paper's permittivity, four free numbers for all wavelengths.
        ``"metal"``: silver with a film of silica; its thickness and factors on n and k are
        free, the factors with normal priors of 0.5 and 0.1 around 1.
    wavelength : `~astropy.units.Quantity`
        Grid of the parameters given per wavelength.
    name : str
        Name of the optic.

    Returns
    -------
    Optic

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.instruments.telescope import tertiary_mirror
    >>> m3 = tertiary_mirror("free", [1.2, 2.2] * u.um)
    >>> m3.retardance.fixed, m3.diattenuation.fixed
    (True, False)
    """
    if model == "power law":
        bounds = {key: (0.5 * start, 2 * start) for key, start in _START.items()}
        # the bounds of the paper, half to twice its start
        return optics.PowerLawMirror(name=name, bounds=bounds, **_START)
    if model == "metal":
        free = dict.fromkeys(("film_thickness", "n_scale", "k_scale"), False)
        bounds = {"film_thickness": (0, 500), "n_scale": (0.05, 20), "k_scale": (0.5, 2)}
        mirror = optics.MetalMirror(
            material="silver", film_thickness=_FILM_START, name=name, fixed=free, bounds=bounds
        )
        return _with_metal_priors(mirror)
    return optics.DiattenuatorRetarder(
        diattenuation=np.full(wavelength.size, 0.01),
        retardance=optics.PowerLawMirror(**_PUBLISHED).retardance(wavelength),
        name=name,
        fixed={"retardance": True},
    )


def k_mirror(*, fixed, bounds, **settings):
    """
    Return a derotator of three silver mirrors with films of silica, ready to be calibrated.

    Free are the thickness of the films and factors on n and k of silver, with normal
    priors of 0.5 and 0.1 around 1.

    Parameters
    ----------
    fixed, bounds : dict
        What else is free, as `astropy.modeling` takes it.
    **settings
        Of the optic, such as ``name`` and ``mount``.

    Returns
    -------
    KMirror

    Examples
    --------
    >>> from astropolcal.instruments.telescope import k_mirror
    >>> derotator = k_mirror(fixed={}, bounds={}, name="derotator", mount="derotator")
    >>> derotator.film_thickness.quantity
    <Quantity 262.56 nm>
    """
    free = dict.fromkeys(("film_thickness", "n_scale", "k_scale"), False)
    limits = {"film_thickness": (0, 600), "n_scale": (0.05, 20), "k_scale": (0.5, 2)}
    mirror = optics.KMirror(
        film_thickness=_DEROTATOR_FILM, fixed=free | fixed, bounds=limits | bounds, **settings
    )
    return _with_metal_priors(mirror)


def _with_metal_priors(mirror):
    mirror.n_scale.prior, mirror.k_scale.prior = _normal(1, _N_SPREAD), _normal(1, _K_SPREAD)
    return mirror


def published_mirror(name="m3"):
    """
    Return Subaru's tertiary mirror with the published permittivity.

    Parameters
    ----------
    name : str
        Name of the optic.

    Returns
    -------
    PowerLawMirror

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.instruments.telescope import published_mirror
    >>> published_mirror().diattenuation(1.6 * u.um).round(4)
    np.float64(0.0147)
    """
    return optics.PowerLawMirror(name=name, **_PUBLISHED)


def telescope(mirror):
    """
    Return the optics from the sky to the half-wave plate of an alt-azimuth telescope.

    Parameters
    ----------
    mirror : Optic
        The tertiary mirror.

    Returns
    -------
    list of Optic

    Examples
    --------
    >>> from astropolcal.instruments.telescope import published_mirror, telescope
    >>> [optic.name for optic in telescope(published_mirror())]
    ['parallactic', 'm3', 'altitude']
    """
    return [
        optics.Rotator(mount="parallactic", name="parallactic"),
        mirror,
        optics.Rotator(mount="-altitude", name="altitude"),
    ]


def _normal(mean, std):
    from scipy.stats import norm

    return norm(mean, std)


def star_source(source, wavelength, name="star", target=None):
    """
    Return the source optic of a star.

    Parameters
    ----------
    source : str
        ``"unpolarized standard star"`` is one of zero polarization, fixed. Of any other
        star q and u are free, one a wavelength.
    wavelength : `~astropy.units.Quantity`
        Grid.
    name : str
        Name of the optic.
    target : str, optional
        Name of the star. What the catalogue of standards knows of it, at wavelengths where it
        does, gives start and prior of a polarized star.

    Returns
    -------
    PolarizedSource

    Raises
    ------
    InstrumentError
        If the catalogue does not have a polarized standard star, or has it as unpolarized, or
        the other way round.

    Warns
    -----
    AstropolcalWarning
        If the catalogue does not have an unpolarized standard star.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.instruments.telescope import star_source
    >>> star = star_source("polarized standard star", [1.25, 1.65] * u.um, target="HD 30675")
    >>> star.u.value.round(3).tolist()
    [0.016, 0.009]
    """
    if target and source.endswith("standard star"):
        _check_standard(source, target)
    if source == "unpolarized standard star":
        return optics.PolarizedSource(name=name, fixed={"q": True, "u": True})
    known = _catalogued(target, wavelength)
    zero = np.zeros(wavelength.size)
    if known is None:
        return optics.PolarizedSource(q=zero, u=zero, name=name)
    star = optics.PolarizedSource(q=known.q, u=known.u, name=name)
    if known.covariance is not None:
        for i, key in enumerate(("q", "u")):
            error = np.sqrt(np.asarray(known.covariance)[..., i, i])
            mean = np.asarray(getattr(known, key))
            getattr(star, key).prior = _normal(mean, np.maximum(error, _LEAST_ERROR))
    return star


def _check_standard(source, target):
    """Refuse a polarized standard that nobody knows; warn of an unpolarized one."""
    try:
        known = standards.get(target)
    except AstropolcalError as error:
        if source.startswith("polarized"):
            raise InstrumentError(
                f"{target} as a polarized standard star: {error}; with the source 'star' its "
                "polarization is fitted without a prior"
            ) from error
        warnings.warn(
            f"{error}; it is unpolarized because the table says so",
            AstropolcalWarning,
            stacklevel=2,
        )
        return
    if not source.startswith(known.kind):
        raise InstrumentError(
            f"{target} is {known.kind} according to the catalogue, but the table's source is "
            f"{source!r}"
        )


def _catalogued(target, wavelength):
    """Return the Stokes parameters of the catalogue, None where it has none."""
    if not target:
        return None
    try:
        return standards.get(target).stokes(wavelength)
    except AstropolcalError:
        return None


def behind_telescope(chain, name):
    """
    Return the optics of an instrument's chain from the half-wave plate on.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        The chain of an internal source.
    name : str
        Of the instrument, for the message.

    Returns
    -------
    list of Optic

    Raises
    ------
    ChainError
        If there is no optic ``hwp``.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.telescope import behind_telescope
    >>> charis = instruments.get("charis")
    >>> [optic.name for optic in behind_telescope(charis.chain(), "charis")]
    ['hwp', 'derotator', 'wollaston']
    """
    found = leaves(chain)
    start = next((i for i, leaf in enumerate(found) if leaf.name == "hwp"), None)
    if start is None:
        raise ChainError(f"{name}: the chain has no optic 'hwp' to put the telescope before")
    return found[start:]


def star_options(observations):
    """
    Return the options of a chain that name its star.

    Parameters
    ----------
    observations : Observations
        A dataset, whose meta may have ``object``.

    Returns
    -------
    dict
        ``star``, the name of the source optic, which is the object's without blanks behind
        ``star_``, and ``target``; empty for other sources, and for a star without a name.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from astropolcal.instruments.telescope import star_options
    >>> star_options(SimpleNamespace(source="star", meta={"object": "HD 30675"}))
    {'star': 'star_HD30675', 'target': 'HD 30675'}
    """
    target = str(observations.meta.get("object") or "")
    words = re.sub(r"\W+", "", target)
    # a star without a name is the same optic in all datasets
    if not words or not is_star(observations.source):
        return {}
    return {"star": f"star_{words}", "target": target}
