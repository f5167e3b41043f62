# Licensed under a 3-clause BSD style license - see LICENSE
"""
How well the polarization of a standard star is known, and which of it is assumed.

The catalogue of standard stars that comes with the package.
"""

import re
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from astropolcal.exceptions import ParameterError
from astropolcal.optics.sources import serkowski
from astropolcal.standards.law import LinearStokes, SerkowskiLaw, whittet_width
from astropolcal.units import length_to_um
from astropolcal.words import check_choice, did_you_mean

__all__ = ["StandardStar", "catalogue", "get", "names"]

# fractions, micrometres and degrees throughout this module
# what a source does not state
_UNSTATED = 1e-3
# less is not claimed of any star
_LEAST = 1e-4
# the interstellar medium: Serkowski, Mathewson & Ford (1975), Whittet et al. (1992)
_MEDIUM = 0.545
# with these, and not with 0.06 um, J, H and K of the stars behind ordinary dust are
# within their errors as often as they should be if they are predicted from V, R or B to I
_MEDIUM_SCATTER, _WIDTH_SCATTER = 0.08, 0.1
# of the catalogue's 94 stars from U to K, 68 % lie within this
_ROTATION_SCATTER = 3.0
# the angles of ten stars with several sources scatter by 0.7 deg, and would by about
# 0.5 deg because of the errors that are stated
_ZERO_POINT = 0.5
# of a law that is published without errors; its numbers have as many digits
_LAW_ERRORS = {"p_max": 1e-3, "lambda_max": 0.02, "theta": 1.0}
# by how much the law changes from B to R
_NO_BAND = 0.05
# of the effective wavelength of a band: other filters, detectors and colours of stars
_BAND_ERROR = 0.02
_BOUNDS = ([1e-5, 0.3, 0.1], [1.0, 1.3, 3.0])
# Beyond so many um the degree falls slower than the law (Martin & Whittet 1990, ApJ 357, 113): so
# much per factor of e makes H and K of the catalogue as far from the laws as their errors say.
_LONG, _DEPARTURE = 1.5, 0.25
_UNITS = {"lambda_max": u.um, "theta": u.deg, "rotation": u.deg / u.um}
_PARAMETERS = ("p_max", "lambda_max", "K", "theta", "rotation")


class UnpolarizedError(NamedTuple):
    """Standard error of q and of u of an unpolarized star, and in words where it comes from."""

    value: float
    words: str


class Interstellar(NamedTuple):
    """The Serkowski law of a polarized star, with an error of every parameter.

    ``errors`` are by name, as quantities where the parameter has a unit. ``covariance`` is of
    p_max, lambda_max, K, theta and rotation in the units of the law; the errors alone give two or
    three times too much in the near infrared, where those of lambda_max and K cancel. ``source``
    names the publications, ``assumed`` what none of them says, one sentence each.
    """

    law: SerkowskiLaw
    errors: dict
    covariance: np.ndarray
    source: str
    assumed: tuple


# --- polarized ---------------------------------------------------------------------------


def _plain(error, name):
    """Return an error as a number in the units of this module."""
    return float(u.Quantity(error).to_value(_UNITS.get(name, u.dimensionless_unscaled)))


# --- the degree --------------------------------------------------------------------------


def _published(star):
    """Return the published shape of a law, and its covariance."""
    shape = np.array([getattr(star.law, name).value for name in _PARAMETERS[:3]], dtype=float)
    errors = np.array([_plain(star.law_errors[name], name) for name in _PARAMETERS[:3]])
    table = star.polarization[star.polarization["reference"] == star.law_reference]
    error = table["p_err"].to_value(u.dimensionless_unscaled)
    if np.unique(table["wavelength"]).size < 3 or not np.all(np.isfinite(error)):
        return shape, np.diag(errors**2), []
    # the errors are published, but not that those of lambda_max and K go together,
    # as they do in every fit to these bands
    slopes = SerkowskiLaw().fit_deriv(table["wavelength"].to_value(u.um), *shape, 0.0, 0.0)[:3]
    slopes = np.stack(slopes, axis=-1) / error[:, None]
    together = np.linalg.inv(slopes.T @ slopes)
    scale = errors / np.sqrt(np.diag(together))
    return shape, together * np.outer(scale, scale), []


def _fitted(star):
    """Return a shape that goes through what is known, its covariance, and what is assumed."""
    from scipy.optimize import least_squares

    x, degree, error, words = _degrees(star)
    center, spread, prior_words = _prior(star)
    # a band elsewhere than said has another degree, dp = 2 K p ln(lambda_max / lambda) dln(lambda)
    slope = 2 * center["K"] * np.log(center["lambda_max"] / x)
    error = np.hypot(error, _BAND_ERROR * slope * degree)
    if star.law is not None:
        # a published maximum is one more measurement, made where the maximum is
        x, degree = np.append(x, star.law.lambda_max.value), np.append(degree, star.law.p_max.value)
        error = np.append(error, spread["p_max"])

    def residuals(t):
        # K follows the relation, unless one is published with its error
        width = center["K"] if "K" in star.law_errors else whittet_width(t[1] * u.um)
        prior = [(t[1] - center["lambda_max"]) / spread["lambda_max"], (t[2] - width) / spread["K"]]
        return np.append((degree - t[0] * serkowski(x, *t[1:])[0]) / error, prior)

    start = [max(degree.max(), _LEAST), center["lambda_max"], center["K"]]
    fit = least_squares(residuals, start, bounds=_BOUNDS, x_scale=[0.01, 0.1, 0.1])
    # bands and sources may disagree by more than their errors
    excess = max(np.sum(fit.fun[: x.size] ** 2) / max(x.size - 1, 1), 1.0)
    weight = np.append(np.full(x.size, 1 / excess), [1, 1])
    inverse = np.linalg.inv((fit.jac * weight[:, None]).T @ fit.jac)
    return fit.x, inverse, prior_words + words


def _degrees(star):
    """Return wavelengths, degrees and errors of the measurements; and what is assumed of them."""
    table, words = star.polarization, []
    x = table["wavelength"].to_value(u.um)
    degree, error = (table[key].to_value(u.one) for key in ("p", "p_err"))
    stated = np.isfinite(error)
    if not np.all(stated):
        names = ", ".join(dict.fromkeys(map(str, table["reference"][~stated])))
        words.append(f"p: {names} states no error; {100 * _UNSTATED:g} % is assumed")
        error = np.where(stated, error, _UNSTATED)
    vague = np.array(table["band"]) == "optical"
    if np.any(vague):
        words.append(f"p: +- {100 * _NO_BAND:g} % of it where the source names no band")
        error = np.where(vague, np.hypot(error, _NO_BAND * degree), error)
    if star.variability:
        error = np.hypot(error, _plain(star.variability["p"], "p"))
    return x, degree, error, words


def _prior(star):
    """Return where the parameters are expected, how certainly, and what of it is assumed."""
    given = {k: _plain(v, k) for k, v in star.law_errors.items()}
    spread = {"p_max": given.get("p_max", _LAW_ERRORS["p_max"]), "K": given.get("K", np.nan)}
    words = []
    if star.law is None:
        center, spread["lambda_max"] = {"lambda_max": _MEDIUM}, _MEDIUM_SCATTER
        words.append(
            f"lambda_max: {_MEDIUM:g} +- {_MEDIUM_SCATTER:g} um (Serkowski et al. 1975), where "
            "the bands do not say more"
        )
    else:
        center = {"lambda_max": star.law.lambda_max.value}
        spread["lambda_max"] = given.get("lambda_max", _LAW_ERRORS["lambda_max"])
        missing = [n for n in ("p_max", "lambda_max") if n not in given]
        texts = {"p_max": f"{100 * _LAW_ERRORS['p_max']:g} %"}
        texts["lambda_max"] = f"{_LAW_ERRORS['lambda_max']:g} um"
        if missing:
            numbers = " and ".join(texts[n] for n in missing)
            words.append(f"{' and '.join(missing)}: published without errors, assumed: {numbers}")
    if "K" in given:
        center["K"] = star.law.K.value
    else:
        # a width without error, such as the 1.15 of Serkowski (1974), is a convention
        center["K"], spread["K"] = whittet_width(center["lambda_max"] * u.um), _WIDTH_SCATTER
        words.append(
            f"K: 0.01 + 1.66 lambda_max with a scatter of {_WIDTH_SCATTER:g} (Whittet et al. "
            "1992), where the bands do not say more"
        )
    return center, spread, words


# --- the angle ---------------------------------------------------------------------------


def _turned(star, lambda_max, complete):
    """Return theta and rotation of a star, their covariance, and what is assumed."""
    x, theta, error = angles(star.polarization)
    words = []
    if star.variability:
        error = np.hypot(error, _plain(star.variability["theta"], "theta"))
    if complete and x.size == 0:
        errors = [_plain(star.law_errors[name], name) for name in _PARAMETERS[3:]]
        return (star.law.theta.value, star.law.rotation.value), np.diag(errors) ** 2, words
    if star.law is not None and not complete:
        stated = "theta" in star.law_errors
        spread = _plain(star.law_errors["theta"], "theta") if stated else _LAW_ERRORS["theta"]
        if not stated:
            words.append(f"theta: published without error; {spread:g} deg is assumed")
        x, theta = np.append(x, lambda_max), np.append(theta, star.law.theta.value)
        error = np.append(error, spread)
    values, covariance, assumed = turning(x, theta, error, lambda_max)
    return values, covariance, words + assumed


def angles(table):
    """Return wavelengths, angles and their errors of the measurements that have an angle."""
    table = table[np.isfinite(table["theta"])]
    theta, error = table["theta"].to_value(u.deg), table["theta_err"].to_value(u.deg)
    ratio = (table["p_err"] / table["p"]).to_value(u.dimensionless_unscaled)
    # dtheta = dp / 2 p in radian, where a source states dp only
    error = np.where(np.isfinite(error), error, np.rad2deg(ratio) / 2)
    error = np.where(np.isfinite(error), error, _LAW_ERRORS["theta"])
    return table["wavelength"].to_value(u.um), theta, error


def turning(x, theta, error, lambda_max):
    """Return theta at lambda_max and rotation, their covariance, and what is assumed."""
    double = np.exp(2j * np.deg2rad(theta))
    # an angle of polarization has a period of 180 deg, so the double angle
    # is averaged on the circle
    mean = np.angle(np.sum(double / error**2))
    mean, offset = np.rad2deg(mean) / 2, np.rad2deg(np.angle(double * np.exp(-1j * mean))) / 2
    words = []
    if np.unique(x).size > 2:
        design = np.stack([np.ones_like(x), x - lambda_max], axis=-1) / error[:, None]
        inverse = np.linalg.inv(design.T @ design)
        theta, turn = inverse @ design.T @ (offset / error)
        residuals = offset / error - design @ [theta, turn]
        # bands and sources may disagree by more than their errors
        inverse *= max(np.sum(residuals**2) / (x.size - 2), 1.0)
    # else the slope is not measured
    if np.unique(x).size < 3 or inverse[1, 1] >= _ROTATION_SCATTER**2:
        weight = error**-2.0
        scatter = np.sum(weight * offset**2) / np.sum(weight) / max(x.size - 1, 1)
        # from where it was measured to lambda_max it may have turned, too
        away = np.array([lambda_max - np.average(x, weights=weight), 1.0])
        inverse = np.outer(away, away) * _ROTATION_SCATTER**2
        inverse[0, 0] += max(scatter, 1 / np.sum(weight))
        theta, turn = 0.0, 0.0
        words = [f"rotation: 0 +- {_ROTATION_SCATTER:g} deg/um, the scatter of other stars"]
    inverse[0, 0] += _ZERO_POINT**2
    return (float(np.mod(mean + theta, 180)), float(turn)), inverse, words


# ---- what a calibration assumes -------------------------------------------------------------


def assumed_polarization(star, wavelength):
    """
    Return what a calibration assumes of a star: a row per wavelength, and the reasons in words.

    Rows have degree (percent) and angle (deg) of polarization with the errors along and across it;
    of light without polarization there is no angle. None if the polarization is not known.
    """
    try:
        light = star.stokes(wavelength)
        if star.kind == "unpolarized":
            words = [star.unpolarized_error().words]
        else:
            words = list(star.interstellar().assumed)
    except ParameterError:
        return None
    degree, angle = np.hypot(light.q, light.u), np.arctan2(light.u, light.q)
    rows = []
    for i, band in enumerate(wavelength.to_value(u.um)):
        along = np.array([np.cos(angle[i]), np.sin(angle[i])])
        across = np.array([-along[1], along[0]])
        error, turn = (np.sqrt(d @ light.covariance[i] @ d) for d in (along, across))
        polarized = degree[i] > 0
        rows.append({
            "wavelength_um": float(band),
            "p_percent": 100 * float(degree[i]),
            "p_err_percent": 100 * float(error),
            "theta_deg": float(np.rad2deg(angle[i] / 2) % 180) if polarized else None,
            "theta_err_deg": float(np.rad2deg(turn / 2 / degree[i])) if polarized else None,
        })  # fmt: skip
    return {"stokes": rows, "words": words}


# ---- catalogues ----------------------------------------------------------------------------


#: What a standard star may be.
KINDS = ("polarized", "unpolarized")
#: Bands in which the catalogue has magnitudes.
MAGNITUDES = ("V", "J", "H", "K")

# names are numbers for the most part, and all are alike; these differ by a digit or a sign
_SIMILAR = 0.8
_DATA = Path(__file__).resolve().parents[1] / "data"


@dataclass(frozen=True, eq=False)
class StandardStar:
    """
    A standard star: where it is, how bright, and how polarized.

    Parameters
    ----------
    name : str
        Its name in the catalogue.
    kind : str
        ``"polarized"`` or ``"unpolarized"``.
    coord : `~astropy.coordinates.SkyCoord`
        Position (ICRS), without proper motion.
    position_error : `~astropy.units.Quantity`
        How far off the position may be.
    magnitudes : dict
        Magnitudes by band, those that are known.
    polarization : `~astropy.table.QTable`
        Measurements: ``band, wavelength, p, p_err, theta, theta_err, reference,
        doi, via, checked``.
    law : SerkowskiLaw or None
        For a polarized star whose parameters are published; `interstellar` has one for every
        polarized star. A law published without its angle has that of the measurements.
    law_errors : dict
        Standard errors of the law's parameters, all five or none.
    spectral_type, law_reference, law_doi, note : str
        Empty where nothing is known.
    aliases : tuple of str
        Other names by which `get` finds it.
    variability : dict
        Standard deviations ``p`` and ``theta`` of a star that varies.

    Examples
    --------
    >>> from astropolcal import standards
    >>> star = standards.get("HD 30675")
    >>> star.kind, float(star.magnitudes["H"].value), len(star.polarization)
    ('polarized', 6.687, 8)
    """

    name: str
    kind: str
    coord: SkyCoord
    position_error: u.Quantity
    magnitudes: dict
    polarization: QTable
    # no "| None": between model classes the bar means a compound model
    law: SerkowskiLaw = None
    law_errors: dict = field(default_factory=dict)
    spectral_type: str = ""
    law_reference: str = ""
    law_doi: str = ""
    note: str = ""
    aliases: tuple = ()
    variability: dict = field(default_factory=dict)

    def __repr__(self):
        place = self.coord.to_string("hmsdms", precision=0)
        return f"<StandardStar {self.name!r}, {self.kind}, {place}>"

    @property
    def checked(self):
        """Whether all of its numbers were read in a source, none from memory."""
        return bool(np.all(self.polarization["checked"]))

    def brightness(self, band=None):
        """Return a magnitude (perhaps nan) and its band: V where the one asked for has none."""
        band = band if band in self.magnitudes else "V"
        magnitude = self.magnitudes.get(band)
        return (float("nan") if magnitude is None else float(magnitude.value)), band

    def stokes(self, wavelength):
        """
        Return the q and u that the catalogue expects.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Any shape.

        Returns
        -------
        LinearStokes
            Of a polarized star those of `interstellar`, with its covariance and, beyond 1.5 um,
            an error of the law itself; of an unpolarized star q = u = 0, with the error of
            `unpolarized_error`.

        Raises
        ------
        ParameterError
            If the star is polarized and neither a law nor a measurement is known.
        WavelengthRangeError
            If the law does not hold at a wavelength.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import standards
        >>> star = standards.get("HD 30675").stokes(1.64 * u.um)
        >>> print(star.q.round(4), star.u.round(4), star.covariance.diagonal() ** 0.5 > 0)
        -0.0045 0.0095 [ True  True]
        """
        if self.kind == "unpolarized":
            zero = np.zeros_like(length_to_um(wavelength))
            variance = np.full(zero.shape, self.unpolarized_error().value ** 2)
            return LinearStokes(zero, zero.copy(), variance[..., None, None] * np.eye(2))
        known = self._interstellar
        q, u_, covariance = known.law.stokes(wavelength, known.covariance)
        beyond = _DEPARTURE * np.log(np.maximum(length_to_um(wavelength) / _LONG, 1.0))
        away = np.stack([q, u_], axis=-1) * beyond[..., None]
        return LinearStokes(q, u_, covariance + away[..., :, None] * away[..., None, :])

    def interstellar(self):
        """
        Return the Serkowski law of a polarized star, with an error of every parameter.

        Returns
        -------
        Interstellar
            The law, its errors and their covariance, its source and what is assumed.

        Raises
        ------
        ParameterError
            If the star is unpolarized, or neither a law nor a measurement is known.

        Notes
        -----
        What is published of the star counts first. What is not is that of the interstellar medium
        on average: lambda_max = 0.545 +- 0.08 um, K = 0.01 + 1.66 lambda_max / um +- 0.1, an angle
        that turns by 0 +- 3 deg/um. The law goes through the measurements by weighted least
        squares, and errors are never smaller than the scatter of bands and sources.

        References
        ----------
        Serkowski, Mathewson & Ford 1975, ApJ 196, 261, doi:10.1086/153410;
        Wilking, Lebofsky & Rieke 1982, AJ 87, 695, doi:10.1086/113147;
        Whittet et al. 1992, ApJ 386, 562, doi:10.1086/171039.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import standards
        >>> known = standards.get("HD 155197").interstellar()
        >>> print(known.law(1.65 * u.um).to(u.percent).round(2), known.errors["p_max"].round(2))
        1.51 % 0.02 %
        >>> print(known.assumed[0])
        lambda_max: 0.545 +- 0.08 um (Serkowski et al. 1975), where the bands do not say more
        """
        known = self._interstellar
        # the star is shared by all who ask for it, and what it says must not change
        return known._replace(
            law=known.law.copy(), errors=dict(known.errors), covariance=known.covariance.copy()
        )

    @cached_property
    def _interstellar(self):
        from scipy.linalg import block_diag

        if self.kind != "polarized":
            raise ParameterError(f"{self.name} is {self.kind}; ask for unpolarized_error() instead")
        if self.law is None and not np.any(np.isfinite(self.polarization["theta"])):
            raise ParameterError(f"{self.name} has neither a law nor a measurement with an angle")
        complete = set(_PARAMETERS) <= set(self.law_errors)
        shape, within, words = (_published if complete else _fitted)(self)
        angle, turned, angle_words = _turned(self, shape[1], complete)
        words = [*words, *angle_words, f"theta: +- {_ZERO_POINT:g} deg for its zero"]
        covariance = block_diag(within, turned)
        if self.variability:
            degree, turn = (_plain(self.variability[key], key) for key in ("p", "theta"))
            covariance[0, 0] += degree**2
            covariance[3, 3] += turn**2
            varies = f"it varies, by about {100 * degree:.2g} % and {turn:.2g} deg"
            words.append(f"{varies}; the errors include it")
        law = SerkowskiLaw(
            shape[0], shape[1] * u.um, shape[2], angle[0] * u.deg, angle[1] * u.deg / u.um
        )
        errors = dict(zip(_PARAMETERS, map(float, np.sqrt(np.diag(covariance))), strict=True))
        errors |= {name: errors[name] * unit for name, unit in _UNITS.items()}
        errors["p_max"] = 100 * errors["p_max"] * u.percent
        # the publications that the law is from
        parts = [self.law_reference] if self.law_reference else []
        if not complete:
            table = self.polarization
            for reference in dict.fromkeys(map(str, table["reference"])):
                bands = dict.fromkeys(map(str, table["band"][table["reference"] == reference]))
                parts.append(f"{reference} ({', '.join(bands)})")
        return Interstellar(law, errors, covariance, "; ".join(parts), tuple(words))

    def unpolarized_error(self):
        r"""
        Return how far q and u of an unpolarized star may be from zero, and why: ``value, words``.

        A measured degree overestimates the true one, :math:`E[p^2] = P^2 + 2\sigma^2`, and P has an
        unknown direction, so that q and u have the variance :math:`P^2/2 + \sigma^2 = \max(p^2/2,
        \sigma^2)` each. Of several measurements the best gives :math:`\sigma`, and all together
        give P. It is at least 0.01 %, and 0.1 % where no source states an error. Interstellar
        polarization is smaller in the near infrared; that of a circumstellar disk need not be.
        """
        if self.kind != "unpolarized":
            raise ParameterError(f"{self.name} is {self.kind}; ask for interstellar() instead")
        table = self.polarization
        degree, error = (table[key].to_value(u.one) for key in ("p", "p_err"))
        stated = np.isfinite(error)
        if np.any(stated):
            table, degree, error = table[stated], degree[stated], error[stated]
        else:
            error = np.full_like(degree, _UNSTATED)
        # E[p^2] = P^2 + 2 sigma^2, and P has any direction: q and u have the variance
        # P^2 / 2 each; that of its estimate p^2 / 2 - sigma^2 is sigma^4 for a small P
        square = np.average(degree**2 / 2 - error**2, weights=error**-4)
        value = np.sqrt(np.min(error) ** 2 + max(square, 0.0))
        rows = zip(
            table["reference"], degree, error, table["wavelength"].to_value(u.um), strict=True
        )
        spread = " +- {2:.3g}" if np.any(stated) else ""
        form = f"{{0}}: {{1:.3g}}{spread} % at {{3:.3g}} um"
        words = "; ".join(form.format(name, 100 * p, 100 * e, at) for name, p, e, at in rows)
        if not np.any(stated):
            words += f"; no error is stated, {100 * _UNSTATED:g} % is assumed"
        if "emission-line" in self.note:
            words += "; it is an emission-line star, which may vary"
        return UnpolarizedError(round(max(float(value), _LEAST), 7), words)


def names(kind=None):
    """
    Return the names of the standard stars, by right ascension.

    Parameters
    ----------
    kind : str, optional
        ``"polarized"`` or ``"unpolarized"``; by default both.

    Returns
    -------
    list of str

    Raises
    ------
    ParameterError
        If there is no such kind.

    Examples
    --------
    >>> from astropolcal import standards
    >>> "HD 293396" in standards.names("unpolarized")
    True
    """
    if kind is not None:
        check_choice("kind", kind, KINDS, ParameterError)
    return [s.name for s in _stars().values() if kind in (None, s.kind)]


def get(name):
    """
    Return a standard star by its name.

    Parameters
    ----------
    name : str
        Name or alias; spaces, case, underscores and leading zeros do not matter.

    Returns
    -------
    StandardStar

    Raises
    ------
    ParameterError
        If the catalogue has no such star; the message suggests the nearest names.

    Examples
    --------
    >>> from astropolcal import standards
    >>> standards.get("hd_030675")
    <StandardStar 'HD 30675', polarized, 04h50m52s +28d18m51s>
    """
    key = _normal(name)
    index = _index()
    if key in index:
        return _stars()[index[key]]
    # the index holds aliases too; what is suggested are the catalogue's own names
    hint = did_you_mean(key, index, most=3, cutoff=_SIMILAR, show=index.get)
    raise ParameterError(f"the catalogue has no standard star {str(name)!r}{hint}")


def catalogue():
    """
    Return the stars and their measurements as tables.

    Returns
    -------
    stars : `~astropy.table.QTable`
        One row per star; missing numbers are nan.
    polarization : `~astropy.table.QTable`
        One row per star, band and source.

    Examples
    --------
    >>> from astropolcal import standards
    >>> stars, polarization = standards.catalogue()
    >>> set(polarization["name"]) <= set(stars["name"])
    True
    """
    return tuple(table.copy() for table in _tables())


def _normal(name):
    """Return a name without what people write differently."""
    key = re.sub(r"[\s_.°*#]|\bno\b", "", str(name).lower())
    # the sign of a declination counts, other hyphens do not
    key = re.sub(r"(?<!bd)(?<!cd)(?<!cpd)-", "", key)
    key = re.sub(r"^hde", "hd", key)
    key = re.sub(r"^(hd|hip)0+", r"\1", key)
    # BD+59d389 is a way to write BD+59 389
    return re.sub(r"^(bd[+-]?\d\d)d(\d)", r"\1\2", key)


@lru_cache(maxsize=1)
def _tables():
    # stars and measurements in two tables: a star has one position and many measurements
    files = ("standards.ecsv", "standards_polarization.ecsv")
    # astropy reads an empty text as masked
    return tuple(QTable.read(_DATA / name, format="ascii.ecsv").filled("") for name in files)


@lru_cache(maxsize=1)
def _stars():
    stars, polarization = _tables()
    return {str(row["name"]): _star(row, polarization) for row in stars}


@lru_cache(maxsize=1)
def _index():
    return {_normal(n): s.name for s in _stars().values() for n in (*s.aliases, s.name)}


def _star(row, polarization):
    measured = polarization[polarization["name"] == row["name"]]
    measured.remove_column("name")
    law, errors = _law(row, measured)
    varies = {"p": row["p_scatter"], "theta": row["theta_scatter"]}
    texts = ("spectral_type", "law_reference", "law_doi", "note")
    return StandardStar(
        name=str(row["name"]),
        kind=str(row["kind"]),
        coord=SkyCoord(row["ra"], row["dec"]),
        position_error=row["position_err"],
        magnitudes={b: row[b] for b in MAGNITUDES if np.isfinite(row[b])},
        polarization=measured,
        law=law,
        law_errors=errors,
        aliases=tuple(a for a in str(row["aliases"]).split(";") if a),
        variability=varies if np.isfinite(row["p_scatter"]) else {},
        **{key: str(row[key]) for key in texts},
    )


def _law(row, measured):
    """Return the star's Serkowski law and the errors of its parameters."""
    if not np.isfinite(row["p_max"]):
        return None, {}
    law = SerkowskiLaw(row["p_max"], row["lambda_max"], float(row["width"]), row["law_theta"])
    errors = {"p_max": row["p_max_err"], "lambda_max": row["lambda_max_err"]}
    errors["K"] = float(row["width_err"])
    # a law published without its angle takes that of the measurements
    if not np.isfinite(row["law_theta"]):
        (theta, rotation), covariance, _ = turning(*angles(measured), law.lambda_max.value)
        law.theta, law.rotation = theta * u.deg, rotation * u.deg / u.um
        error = np.sqrt(np.diag(covariance))
        errors |= {"theta": error[0] * u.deg, "rotation": error[1] * u.deg / u.um}
    # errors of some parameters only would give a covariance that is too small
    complete = len(errors) == len(law.param_names) and all(map(np.isfinite, errors.values()))
    return law, errors if complete else {}
