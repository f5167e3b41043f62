# Licensed under a 3-clause BSD style license - see LICENSE
"""The catalogue of standard stars that comes with the package."""

import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from astropolcal.exceptions import ParameterError
from astropolcal.standards.law import LinearStokes, SerkowskiLaw
from astropolcal.units import length_to_um
from astropolcal.words import did_you_mean

__all__ = ["KINDS", "MAGNITUDES", "StandardStar", "catalogue", "get", "names"]

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
        For a polarized star whose parameters are published.
    law_errors : dict
        Standard errors of the law's parameters, those that are published.
    spectral_type, law_reference, law_doi, note : str
        Empty where nothing is known.
    aliases : tuple of str
        Other names by which `get` finds it.

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

    def __repr__(self):
        place = self.coord.to_string("hmsdms", precision=0)
        return f"<StandardStar {self.name!r}, {self.kind}, {place}>"

    @property
    def checked(self):
        """Whether all of its numbers were read in a source, none from memory."""
        return bool(np.all(self.polarization["checked"]))

    def brightness(self, band=None):
        """
        Return the magnitude in a band, or in V where that band has none.

        Parameters
        ----------
        band : str, optional
            ``"V"``, ``"J"``, ``"H"`` or ``"K"``; others count as V.

        Returns
        -------
        magnitude : float
            Nan if neither is known.
        band : str
            The band that it is of.

        Examples
        --------
        >>> from astropolcal import standards
        >>> standards.get("HD 30675").brightness("H")
        (6.687, 'H')
        >>> standards.get("HD 293396").brightness("H")
        (9.6, 'V')
        """
        band = band if band in self.magnitudes else "V"
        magnitude = self.magnitudes.get(band)
        return (float("nan") if magnitude is None else float(magnitude.value)), band

    def stokes(self, wavelength):
        r"""
        Return the q and u that the catalogue expects.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Any shape.

        Returns
        -------
        LinearStokes
            Of a polarized star the Serkowski law with the published errors
            (covariance None if there are none). Of an unpolarized star q = u = 0,
            each with the standard error :math:`\sqrt{p^2 + \sigma_p^2}` of the
            measurement nearest in wavelength.

        Raises
        ------
        ParameterError
            If the star is polarized and no law is published for it.
        WavelengthRangeError
            If the law does not hold at a wavelength.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import standards
        >>> star = standards.get("HD 30675").stokes(1.64 * u.um)
        >>> print(star.q.round(4), star.u.round(4), star.covariance.diagonal() ** 0.5 > 0)
        -0.0048 0.0094 [ True  True]
        """
        if self.kind == "unpolarized":
            return self._unpolarized(length_to_um(wavelength))
        if self.law is None:
            raise ParameterError(
                f"{self.name} has no published Serkowski law; its measurements are in "
                f"`polarization` (bands {', '.join(self.polarization['band'])})"
            )
        return self.law.stokes(wavelength, self.law_errors or None)

    def _unpolarized(self, x):
        table = self.polarization
        distance = np.abs(np.log(x[..., None] / table["wavelength"].to_value(u.um)))
        # (n_wavelengths, n_measurements) nearest in the logarithm:
        # bands are about equally wide in it
        error = table["p_err"].to_value(u.dimensionless_unscaled)
        degree = table["p"].to_value(u.dimensionless_unscaled)
        # that q = u = 0 is wrong by the measured p itself, and p by its error
        variance = (degree**2 + np.where(np.isfinite(error), error, 0) ** 2)[
            np.argmin(distance, axis=-1)
        ]
        zero = np.zeros_like(x)
        return LinearStokes(zero, zero.copy(), variance[..., None, None] * np.eye(2))


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
        One row a star; missing numbers are nan.
    polarization : `~astropy.table.QTable`
        One row a star, band and source.

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
    return tuple(_read(_DATA / name) for name in files)


def _read(path):
    table = QTable.read(path, format="ascii.ecsv")
    for column in table.itercols():
        # astropy reads an empty text as masked
        if hasattr(column, "filled"):
            table[column.info.name] = column.filled("")
    return table


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
        **{key: str(row[key]) for key in texts},
    )


def _law(row, measured):
    """Return the star's Serkowski law and the errors of its parameters."""
    if not np.isfinite(row["p_max"]):
        return None, {}
    theta, error = row["law_theta"], np.nan * u.deg
    # a law published without its angle takes that of the measurements
    if not np.isfinite(theta):
        theta, error = _mean_angle(measured)
    law = SerkowskiLaw(row["p_max"], row["lambda_max"], float(row["width"]), theta)
    errors = {"p_max": row["p_max_err"], "lambda_max": row["lambda_max_err"]}
    errors |= {"K": float(row["width_err"]), "theta": error}
    # errors of some parameters only would give a covariance that is too small
    return law, errors if all(np.isfinite(e) for e in errors.values()) else {}


def _mean_angle(measured):
    """Return the weighted mean of the angles, and an error no smaller than their scatter."""
    weight = measured["theta_err"].to_value(u.rad) ** -2.0
    double = 2 * measured["theta"].to_value(u.rad)
    # an angle of polarization is one of period 180 deg, so the
    # double angle is averaged on the circle
    mean = np.angle(np.sum(weight * np.exp(1j * double)))
    offset = np.angle(np.exp(1j * (double - mean))) / 2
    variance = np.sum(weight * offset**2) / np.sum(weight)
    # bands may disagree by more than their errors: the larger of scatter and stated error
    error = np.sqrt(max(variance / max(len(measured) - 1, 1), 1 / np.sum(weight)))
    return np.mod(np.rad2deg(mean) / 2, 180) * u.deg, np.rad2deg(error) * u.deg
