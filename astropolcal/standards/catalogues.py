# Licensed under a 3-clause BSD style license - see LICENSE
"""The catalogue of standard stars that comes with the package."""

import re
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from astropolcal.exceptions import ParameterError
from astropolcal.standards.law import LinearStokes, SerkowskiLaw
from astropolcal.standards.priors import angles, interstellar, turning, unpolarized_error
from astropolcal.units import length_to_um
from astropolcal.words import did_you_mean

__all__ = ["StandardStar", "catalogue", "get", "names"]

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
        For a polarized star whose parameters are published; `interstellar` has one for
        every polarized star. A law published without its angle has that of the
        measurements.
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
            Of a polarized star those of `interstellar`, with its covariance; of an
            unpolarized star q = u = 0, with the error of `unpolarized_error`.

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
        return known.law.stokes(wavelength, known.covariance)

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
        What is published of the star counts first. What is not is that of the
        interstellar medium on average: lambda_max = 0.545 +- 0.08 um, K = 0.01 + 1.66
        lambda_max / um +- 0.1, an angle that turns by 0 +- 3 deg/um. The law goes
        through the measurements by weighted least squares, and errors are never
        smaller than the scatter of bands and sources.

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
        return interstellar(self)

    def unpolarized_error(self):
        r"""
        Return how far q and u of an unpolarized star may be from zero, and why: ``value, words``.

        A measured degree overestimates the true one, :math:`E[p^2] = P^2 + 2\sigma^2`, and P has
        an unknown direction, so that q and u have the variance :math:`P^2/2 + \sigma^2 =
        \max(p^2/2, \sigma^2)` each. Of several measurements the best gives :math:`\sigma`, and all
        together give P. It is at least 0.01 %, and 0.1 % where no source states an error.
        Interstellar polarization is smaller in the near infrared; that of a circumstellar disk
        need not be.
        """
        return unpolarized_error(self)


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
    check_kind(kind)
    return [s.name for s in _stars().values() if kind in (None, s.kind)]


def check_kind(kind):
    """Raise if there is no such kind of standard star."""
    if kind not in (None, *KINDS):
        raise ParameterError(f"kind = {kind!r} must be {KINDS[0]!r} or {KINDS[1]!r}")


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
