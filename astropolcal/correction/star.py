# Licensed under a 3-clause BSD style license - see LICENSE
r"""
The polarization of the star, and images without it.

A polarized star puts :math:`q_\star I` and :math:`u_\star I` on all of its light, scattered in the
telescope or not. Subtracted is, in every pixel,

.. math:: Q' = Q - q_\star I, \qquad U' = U - u_\star I

after the correction: there the star's polarization has one direction on the sky, while in the
frames it turns and mixes with what the instrument polarizes.
"""

from dataclasses import replace

import astropy.units as u
import numpy as np

from astropolcal.correction.solve import covariance_index
from astropolcal.correction.systematic import Systematic
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.stokes import angle_error, polarization_angle
from astropolcal.units import angle_to_rad, median_of_known, to_unit

__all__ = []

_KINDS = ("statistical", "systematic")
#: Columns of the table of the star, as spectra call them.
COLUMNS = ["wavelength", "q", "u", *(f"{n}_{kind}" for n in "qu" for kind in _KINDS)]
COLUMNS += ["dolp", "aolp", *(f"{n}_{kind}" for n in ("s_p", "s_chi") for kind in _KINDS)]


def measured_star(corrected, annulus):
    """Return the light within two radii as a spectrum, of the pixels that have a value."""
    try:
        inner, outer = (float(radius) for radius in annulus)
    except (TypeError, ValueError):
        inner = outer = np.nan
    if not 0 <= inner < outer < np.inf:
        raise ParameterError(f"annulus = {annulus}; two radii in pixels are needed, inner < outer")
    words = f"annulus of {inner:g} to {outer:g} pixels"
    known = np.isfinite(corrected.stokes[:3]).all(axis=0)
    inside = corrected._circle(outer, inner=inner)
    # a wavelength that is not determined has no value anywhere
    for w in np.flatnonzero(known.any(axis=(1, 2))):
        missing = int((inside & ~known[w]).sum())
        if 2 * missing > inside.sum():
            raise ObservationError(
                f"{words}: {missing} of its {inside.sum()} pixels have no value at "
                f"{corrected.wavelength[w]:.6g}; at least half are needed"
            )
    star = corrected.aperture(outer, inner=inner)
    dark = star["I"] <= 0
    if dark.any():
        raise ObservationError(
            f"{words}: no light at {corrected.wavelength[np.argmax(dark)]:.6g}, from which a "
            "polarization would follow"
        )
    most = np.nanmax(np.hypot(star.q, star.u), initial=0.0)
    if most > 1:
        raise ObservationError(
            f"{words}: its light is polarized by {100 * most:.3g} %, which no light is; it holds "
            "too little of the star"
        )
    return star


def stated_star(corrected, dolp, aolp, errors):
    """Return light of a degree and an angle of polarization, with their errors, as a spectrum."""
    n, size = len(corrected.components), len(corrected.wavelength)
    errors = (0.0, 0 * u.deg) if errors is None else errors
    if not (isinstance(errors, tuple | list) and len(errors) == 2):
        raise ParameterError(f"errors = {errors!r}; two are needed, of dolp and of aolp")
    degree, s_degree = (to_unit(x, None, "dolp") for x in (dolp, errors[0]))
    angle, s_angle = (angle_to_rad(x, "aolp") for x in (aolp, errors[1]))
    if shapes := [np.shape(x) for x in (degree, angle, s_degree, s_angle) if np.shape(x)]:
        raise ParameterError(
            f"polarization of the star has shape {shapes[0]}; dolp, aolp and their errors must be "
            "single numbers"
        )
    if not (0 <= degree <= 1 and np.isfinite(angle)):
        raise ParameterError(
            f"polarization of the star: {100 * degree:g} % at {np.rad2deg(angle):g} deg; "
            "allowed are 0 to 100 %, and a finite angle"
        )
    if not (0 <= s_degree < np.inf and 0 <= s_angle < np.inf):
        raise ParameterError("errors of the star's polarization: allowed are 0 and above")
    along = np.array([np.cos(2 * angle), np.sin(2 * angle)])
    across = np.array([-along[1], along[0]])
    # along the direction of polarization the degree errs, across it the angle
    spread = s_degree**2 * np.outer(along, along)
    spread += (2 * degree * s_angle) ** 2 * np.outer(across, across)
    stokes, covariance = np.zeros((n, size)), np.zeros((n, n, size))
    stokes[0], stokes[1:3] = 1.0, (degree * along)[:, None]
    covariance[1:3, 1:3] = spread[..., None]
    planes = np.stack([covariance[pair] for pair in covariance_index(n)])
    return replace(corrected, stokes=stokes, covariance=planes, systematic=None)


def without_star(corrected, star, words, measured):
    """Return images or spectra without the polarization of a star, a spectrum.

    Of a ``measured`` one the polarization is subtracted that the calibration made of it: what is
    added to all light in proportion to its intensity drops out, and so does its error.
    """
    if corrected.star is not None:
        raise ParameterError(f"the star was subtracted already: {corrected.star.meta['star']}")
    n, size = len(corrected.components), len(corrected.wavelength)
    share = np.nan_to_num(star.stokes / star.stokes[0])
    # Q' = Q - q I: one matrix per wavelength, and its inverse
    change = np.broadcast_to(np.eye(n), (size, n, n)).copy()
    change[:, 1:3, 0] = -share[1:3].T
    back = 2 * np.eye(n) - change
    stokes = corrected.stokes.copy()
    stokes[1:3] -= share[1:3].reshape(2, -1, *[1] * (stokes.ndim - 2)) * stokes[0]
    covariance = corrected.covariance
    if covariance is not None:
        known = corrected.covariances("statistical")
        # a V that is not determined has no errors, but the others do
        moved = np.einsum("wab,bcw...,wdc->adw...", change, np.nan_to_num(known), change)
        known = np.where(np.isnan(known), np.nan, moved)
        covariance = np.stack([known[pair] for pair in covariance_index(n)])
    table = star.table()[COLUMNS]
    table.meta = {"star": words}
    return replace(
        corrected,
        stokes=stokes,
        covariance=covariance,
        systematic=_systematic(corrected.systematic, star, change, back, measured),
        star=table,
    )


def _systematic(known, star, change, back, measured):
    """Return what calibration and star do to the errors of all pixels together."""
    size, n = change.shape[:2]
    if known is None:
        known = Systematic(np.zeros((0, size, n, n)), np.zeros((size, n, n), bool), "star only")
    factor = change @ known.factor @ back
    is_open = (np.abs(change) @ known.open @ np.abs(back)) > 0
    if measured:
        light = np.nan_to_num(star.stokes / star.stokes[0]).T
        # the star was seen through the same errors, which therefore cancel in its own light
        moved = change @ known.factor @ light[..., None]
        factor[..., 1:3, 0] -= moved[..., 1:3, 0]
        is_open[:, 1:3, 0] &= n > 3
    if star.covariance is not None:
        # the errors of q and u of the star as directions, the same for all pixels
        errors = star.fractional_errors()
        q, u_, cross = (np.nan_to_num(errors[key]) for key in ("q", "u", "covariance_qu"))
        # columns of a triangular root of the covariance of q and u
        slope = np.divide(cross, q, out=np.zeros(size), where=q > 0)
        roots = np.array([[q, slope], [0 * q, np.sqrt(np.maximum(u_**2 - slope**2, 0.0))]])
        # noise of one wavelength is not that of another; a value that is stated is one for all
        parts = np.eye(size) if measured else np.ones((1, size))
        found = np.zeros((2, len(parts), size, n, n))
        # d: directions, r: rows of q and u, p: parts, w: wavelengths
        found[..., 1:3, 0] = -np.einsum("pw,drw->dpwr", parts, roots)
        factor = np.concatenate([factor, found.reshape(-1, size, n, n)])
    return replace(known, factor=factor, open=is_open)


def star_words(table):
    """Return degree and angle that were subtracted in words, the median over the wavelengths."""
    middle = {name: median_of_known(table[name]) for name in COLUMNS[1:]}
    errors = {
        # what is not known is none
        name: np.hypot(*(np.nan_to_num(middle[f"{name}_{kind}"], posinf=np.inf) for kind in _KINDS))
        for name in ("s_p", "s_chi")
    }
    if np.isfinite(errors["s_chi"]):
        # both together tell no less than nothing
        errors["s_chi"] = min(errors["s_chi"], angle_error(0.0, 1.0))
    # of q and u: angles near 0 and 180 deg are neighbours
    angle = polarization_angle(middle["q"], middle["u"])
    exact = "" if errors["s_p"] or errors["s_chi"] else ", taken as exact"
    return (
        f"{100 * middle['dolp']:.3g} +- {100 * errors['s_p']:.2g} % at {angle:.4g} +- "
        f"{errors['s_chi']:.2g} deg{exact}"
    )
