# Licensed under a 3-clause BSD style license - see LICENSE
"""Corrected Stokes parameters with what is known of their errors."""

from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.coordinates import StokesCoord
from astropy.table import QTable

from astropolcal.correction.geometry import azimuthal, azimuthal_variances
from astropolcal.correction.product import read_product, write_product
from astropolcal.correction.solve import covariance_index
from astropolcal.correction.star import measured_star, stated_star, without_star
from astropolcal.exceptions import ParameterError, warn
from astropolcal.stokes import (
    angle_error,
    debias_dolp,
    polarization_angle,
    polarization_errors,
)
from astropolcal.words import check_choice

__all__ = ["Corrected"]

_KINDS = ("statistical", "systematic")


@dataclass(eq=False)
class Corrected:
    """
    Stokes parameters of the light that entered, `correct` makes it.

    Attributes
    ----------
    components : str
        ``"IQU"`` or ``"IQUV"``.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).
    stokes : `~numpy.ndarray`
        Shape (n_components, n_wavelengths, ...); NaN where not determined.
    covariance : `~numpy.ndarray` or None
        Statistical, of the pairs II, IQ, IU, QQ, ..., (n_pairs, n_wavelengths, ...).
    systematic : Systematic or None
        What the errors of the calibration do; None without a calibration.
    condition : `~numpy.ndarray`
        Largest over smallest singular value of the frames' rows, for each wavelength.
    determined : `~numpy.ndarray` of bool
        Which components the frames determine, (n_wavelengths, n_components).
    leakage : `~numpy.ndarray`
        What each component takes from a V that is taken as zero, (n_wavelengths, n_components).
    weak : list of str
        The poorly determined combinations in words, one per wavelength; else "".
    mode, observable : str
        How it was corrected.
    unit : `~astropy.units.UnitBase`
        Of ``stokes``.
    north_up, centre, pixel_scale
        As in `ScienceFrames`.
    resampling : float
        Mean variance of a pixel over the one that it would have had frames not been resampled.
    provenance : dict
        Calibration, versions, input files.
    star : `~astropy.table.QTable` or None
        Polarization of the star that `without_star` subtracted, with its errors; one row per
        wavelength.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.correction import ScienceFrames, correct
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> hwp = [0, 45, 22.5, 67.5] * u.deg
    >>> right, left = np.array([[1.02, 0.98, 1.0, 1.0], [0.98, 1.02, 1.0, 1.0]])[..., None]
    >>> star = correct(chain, ScienceFrames.from_arrays(right, left, [1.6] * u.um, {"hwp": hwp}))
    >>> star.q.round(6), star.stokes_axis
    (array([0.02]), StokesCoord(['I', 'Q', 'U']))
    """

    components: str
    wavelength: u.Quantity
    stokes: np.ndarray
    covariance: np.ndarray | None
    systematic: object
    condition: np.ndarray
    determined: np.ndarray
    leakage: np.ndarray
    weak: list
    mode: str = "stokes"
    observable: str = "intensity"
    unit: u.UnitBase = u.adu
    north_up: bool = False
    centre: tuple | None = None
    pixel_scale: float | None = None
    resampling: float = 1.0
    provenance: dict = field(default_factory=dict)
    star: QTable | None = None

    # ---- Stokes parameters -------------------------------------------------------

    @property
    def stokes_axis(self):
        """The first axis of ``stokes``, a `~astropy.coordinates.StokesCoord`."""
        return StokesCoord(list(self.components))

    def __getitem__(self, component):
        """Return one Stokes parameter, shape (n_wavelengths, ...)."""
        return self.stokes[self._index(component)]

    def _index(self, component):
        check_choice("component", component, list(self.components), ParameterError)
        return self.components.index(component)

    @property
    def q(self):
        """Q / I, NaN where there is no light."""
        return self._normalized("Q")

    @property
    def u(self):
        """U / I, NaN where there is no light."""
        return self._normalized("U")

    @property
    def v(self):
        """V / I, NaN where there is no light or V is not determined."""
        return self._normalized("V")

    def _normalized(self, component):
        bright = self["I"] > 0
        return np.where(bright, self[component], np.nan) / np.where(bright, self["I"], 1.0)

    # ---- errors ------------------------------------------------------------------

    def covariances(self, kind="statistical"):
        """
        Return the covariances of the Stokes parameters.

        Parameters
        ----------
        kind : {"statistical", "systematic"}
            Noise, or what the errors of the calibration do.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_components, n_components, n_wavelengths, ...); NaN where not known.
        """
        check_choice("kind", kind, _KINDS, ParameterError)
        n = len(self.components)
        result = np.full((n, n, *self.stokes.shape[1:]), np.nan)
        if kind == "statistical" and self.covariance is not None:
            for plane, (i, j) in zip(self.covariance, covariance_index(n), strict=True):
                result[i, j] = result[j, i] = plane
        if kind == "systematic" and self.systematic is not None:
            for w in range(self.stokes.shape[1]):
                result[:, :, w] = self.systematic.covariance(self.stokes[:, w], w)
            # the tensor knows an error also of light that was not measured: of none
            result[:, :, ~np.isfinite(self.stokes).any(axis=0)] = np.nan
        return result

    def error(self, component, kind="statistical"):
        """Return the standard deviation of a Stokes parameter, shape (n_wavelengths, ...)."""
        i = self._index(component)
        return np.sqrt(self.covariances(kind)[i, i])

    def fractional_errors(self, kind="statistical"):
        """
        Return errors of the normalized Stokes parameters.

        Returns
        -------
        dict of str to `~numpy.ndarray`
            ``q``, ``u`` and, if solved for, ``v``: standard deviations; ``covariance_qu``.
        """
        return fractions(self.stokes, self.covariances(kind), self.components)

    def polarization(self):
        """
        Return degree and angle of linear polarization with their errors.

        Returns
        -------
        dict of str to `~numpy.ndarray`
            ``dolp``, ``dolp_debiased`` (where statistical errors are known), ``aolp`` in degree
            from north through east, and for each kind of error ``s_p_...`` and ``s_chi_...`` (in
            degree, at most 52, where any angle is as likely; infinite where it is open).
        """
        kinds = {kind: self.fractional_errors(kind) for kind in _KINDS}
        return polarization(self.q, self.u, kinds)

    def azimuthal(self):
        """
        Return Q_phi and U_phi of images, with their errors.

        The direction from the star is taken as if north were up and east left. Where
        ``north_up`` is false this is not known, and it may be off by the angle of the field.

        Returns
        -------
        dict of str to `~numpy.ndarray`
            ``q_phi``, ``u_phi``, and ``..._statistical`` and ``..._systematic``.
        """
        if self.stokes.ndim != 4:
            raise ParameterError("Q_phi and U_phi are of images; these are not")
        i, j = self._index("Q"), self._index("U")
        pair = azimuthal(self.stokes[i], self.stokes[j], self.centre)
        result = dict(zip(("q_phi", "u_phi"), pair, strict=True))
        for kind in _KINDS:
            known = self.covariances(kind)
            variances = azimuthal_variances(known[i, i], known[j, j], known[i, j], self.centre)
            for name, variance in zip(("q_phi", "u_phi"), variances, strict=True):
                result[f"{name}_{kind}"] = np.sqrt(np.maximum(variance, 0))
        return result

    # ---- spectra -----------------------------------------------------------------

    def aperture(self, radius, centre=None, inner=0.0):
        """
        Return the sum within a circle or a ring, as the spectrum of a point source.

        Parameters
        ----------
        radius : float
            Pixels; a pixel counts if its middle is inside. The circle may not leave the images.
        centre : (float, float), optional
            0-based x and y; by default that of the images.
        inner : float
            Radius from which on pixels count.

        Returns
        -------
        Corrected
            Of shape (n_components, n_wavelengths). The statistical errors take the pixels as
            independent before they were resampled; of few pixels they are then too large.

        Warns
        -----
        AstropolcalWarning
            If pixels inside have no value; they are left out of all Stokes parameters.
        """
        inside = self._circle(radius, centre, inner)
        pixels, covariance = self.stokes[..., inside], self.covariance
        # a component that is not determined has no value in any pixel
        known = np.isfinite(pixels)
        known = (known | ~known.any(axis=-1, keepdims=True)).all(axis=0)
        if lost := (~known).sum(axis=1).max():
            warn(
                f"up to {lost} of {inside.sum()} pixels of the aperture have no value, at "
                f"{(~known).any(axis=1).sum()} of {len(known)} wavelengths; they are left out of "
                "all Stokes parameters, and I lacks their light"
            )
        stokes = np.where(known, pixels, 0.0).sum(axis=-1)
        if covariance is not None:
            covariance = np.where(known, covariance[..., inside], 0.0).sum(axis=-1)
            # what the spline took from each pixel is what it has in common with its neighbours
            covariance /= self.resampling
        return replace(self, stokes=stokes, covariance=covariance, resampling=1.0)

    def _circle(self, radius, centre=None, inner=0.0):
        """Return the pixels of a circle, or of a ring, that does not leave the images."""
        if self.stokes.ndim != 4:
            raise ParameterError("an aperture needs images; these are spectra")
        rows, columns = np.indices(self.stokes.shape[2:])
        x, y = self._middle() if centre is None else centre
        # whole pixels only, so that the sum has the covariance of a sum
        distance = np.hypot(columns - x, rows - y)
        inside = (distance <= radius) & (distance >= inner)
        if not radius > 0 or not inside.any():
            raise ParameterError(f"radius = {radius}: no pixel is inside")
        height, width = inside.shape
        # to the outer edge of the outermost pixels
        largest = min(x, width - 1 - x, y, height - 1 - y) + 0.5
        if radius > largest:
            raise ParameterError(
                f"radius = {radius:g} leaves the images of {width} x {height} pixels; allowed "
                f"around ({x:g}, {y:g}) are up to {largest:g}"
            )
        return inside

    def without_star(self, *, annulus=None, dolp=None, aolp=None, errors=None):
        r"""
        Return the same without the polarization of the star: :math:`Q - q_\star I` and so on.

        Parameters
        ----------
        annulus : (float, float), optional
            Radii in pixels between which the light is the star's alone, and shows its
            polarization at each wavelength; a circle if the first is 0.
        dolp, aolp : float and `~astropy.units.Quantity`, optional
            In its place the degree, a fraction or a Quantity, and the angle of polarization, from
            north through east.
        errors : (float, `~astropy.units.Quantity`), optional
            Their standard deviations.

        Returns
        -------
        Corrected
            With the table ``star``. The errors of the star's polarization are part of the
            systematic ones, as they are the same in all pixels. Of a polarization that was
            measured here, what the calibration errs by in proportion to the intensity cancels.

        Raises
        ------
        ParameterError
            If the annulus leaves the images, or a value is impossible.
        ObservationError
            If most pixels of the annulus have no value, or it has no light, or light that is
            polarized by more than 100 %.
        """
        if (annulus is None) == (dolp is None) or (dolp is None) != (aolp is None):
            raise ParameterError("give either annulus, or dolp and aolp, of the star")
        if annulus is None:
            return without_star(self, stated_star(self, dolp, aolp, errors), "stated", False)
        star = measured_star(self, annulus)
        return without_star(self, star, "annulus of {:g} to {:g} pixels".format(*annulus), True)

    def _middle(self):
        height, width = self.stokes.shape[2:]
        return ((width - 1) / 2, (height - 1) / 2) if self.centre is None else self.centre

    def table(self):
        """
        Return the spectrum of a point source.

        Returns
        -------
        `~astropy.table.QTable`
            One row per wavelength: I, q, u (and v) with both errors, degree and angle of linear
            polarization with both errors, ``condition``, ``leakage_q`` and ``leakage_u`` (what
            they take from v), ``determined``.
        """
        if self.stokes.ndim != 2:
            raise ParameterError("a table is of a point source; take an aperture of the images")
        table = QTable({"wavelength": self.wavelength, "I": self["I"] * self.unit})
        for kind in _KINDS:
            table[f"I_{kind}"] = self.error("I", kind) * self.unit
        errors = {kind: self.fractional_errors(kind) for kind in _KINDS}
        for name in self.components[1:].lower():
            table[name] = getattr(self, name)
            for kind in _KINDS:
                table[f"{name}_{kind}"] = errors[kind][name]
        for kind in _KINDS:
            table[f"covariance_qu_{kind}"] = errors[kind]["covariance_qu"]
        for name, values in self.polarization().items():
            table[name] = values * u.deg if "chi" in name or "aolp" in name else values
        table["condition"] = self.condition
        table["leakage_q"], table["leakage_u"] = self.leakage[:, 1:3].T
        table["determined"] = self.determined.all(axis=1)
        table.meta |= {"mode": self.mode, "observable": self.observable} | self.provenance
        return table

    def spectra(self):
        """
        Return the spectra of a point source.

        Returns
        -------
        dict of str to `~specutils.Spectrum`
            ``"I"``, ``"q"``, ``"u"`` (and ``"v"``). The uncertainty is the statistical one; the
            systematic one, one value per wavelength, stands in ``meta["systematic"]``.
        """
        from astropy.nddata import StdDevUncertainty
        from specutils import Spectrum

        table, found = self.table(), {}
        for name in ("I", *self.components[1:].lower()):
            keys = (name, *(f"{name}_{kind}" for kind in _KINDS))
            flux, *errors = (u.Quantity(table[key]) for key in keys)
            found[name] = Spectrum(
                flux=flux,
                spectral_axis=self.wavelength,
                uncertainty=StdDevUncertainty(errors[0]),
                mask=~np.isfinite(flux.value),
                meta=dict(table.meta) | {"systematic": np.asarray(errors[1].value)},
            )
        return found

    # ---- files -------------------------------------------------------------------

    def write(self, path, overwrite=False):
        """
        Write a FITS product, atomically.

        Maps that follow from the others are written too: the systematic covariances, degree and
        angle of polarization, Q_phi and U_phi.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        ObservationError
            If the file exists or cannot be written.
        """
        write_product(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read a FITS product.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        Corrected

        Raises
        ------
        ObservationError
            If the file is missing, damaged or not ours.
        """
        return cls(**read_product(path))

    def __repr__(self):
        shape = " x ".join(map(str, self.stokes.shape[1:]))
        return f"<Corrected {self.components} of {shape}, mode {self.mode}>"


# ---- fractions, degree and angle; NaN where there are none ---------------------------------------


def fractions(stokes, covariances, components="IQU"):
    """Return standard deviations ``q``, ``u``, ``v`` of Q / I and so on, and ``covariance_qu``.

    From Stokes parameters (n, ...), I first, and covariances (n, n, ...); infinite where a
    covariance is, NaN where it is not known or there is no light.
    """
    bright = stokes[0] > 0
    light = np.where(bright, stokes[0], 1.0)
    share = stokes / light
    found = {}
    with np.errstate(invalid="ignore"):

        def cross(i, j):
            # dq = (dQ - q dI) / I to first order
            mixed = share[i] * covariances[0, j] + share[j] * covariances[0, i]
            return (covariances[i, j] - mixed + share[i] * share[j] * covariances[0, 0]) / light**2

        for i, name in enumerate(components[1:].lower(), start=1):
            # what is open has no covariance, but an infinite error all the same
            variance = np.where(np.isinf(covariances[i, i]), np.inf, cross(i, i))
            found[name] = np.where(bright, np.sqrt(np.maximum(variance, 0)), np.nan)
        found["covariance_qu"] = np.where(bright, cross(1, 2), np.nan)
    return found


def polarization(q, u, errors):
    """Return degree and angle of linear polarization with their errors.

    ``dolp``, ``dolp_debiased``, ``aolp`` (degree, 0 to 180), and ``s_p`` and ``s_chi`` (degree) of
    each kind of error that `fractions` gave; the statistical one removes the bias of noise.
    """
    dolp = np.hypot(q, u)
    result = {
        "dolp": dolp,
        "dolp_debiased": np.full(dolp.shape, np.nan),
        "aolp": np.where(dolp > 0, polarization_angle(q, u), np.nan),
    }
    for kind, error in errors.items():
        s_p, across = _errors(q, u, dolp, error)
        # what is open stays so
        s_chi, known, is_noise = across.copy(), np.isfinite(across + dolp), kind == "statistical"
        if is_noise:
            result["dolp_debiased"][known] = debias_dolp(dolp[known], across[known])
        s_chi[known] = angle_error(dolp[known], across[known], is_measured=is_noise)
        result[f"s_p_{kind}"], result[f"s_chi_{kind}"] = s_p, s_chi
    return result


def impossible(known):
    """Return in words that a `polarization` is above 100 % beyond its errors, else ""."""
    errors = np.hypot(*(np.nan_to_num(known[f"s_p_{kind}"], posinf=np.inf) for kind in _KINDS))
    beyond = known["dolp"][known["dolp"] - 3 * errors > 1]
    return f"polarized by {100 * beyond.max():.3g} %, which no light is" if beyond.size else ""


def _errors(q, u, dolp, error):
    """Return the errors along and across the direction of polarization."""
    s_q, s_u = error["q"], error["u"]
    is_open = np.isinf(s_q) | np.isinf(s_u)
    found = np.full((2, *dolp.shape), np.nan)
    found[:, is_open & (dolp > 0)] = np.inf
    good = (dolp > 0) & np.isfinite(s_q) & np.isfinite(s_u)
    if good.any():
        # rounding may lift a perfect correlation above one
        limit = s_q[good] * s_u[good]
        cross = np.clip(error["covariance_qu"][good], -limit, limit)
        found[:, good] = polarization_errors(q[good], u[good], s_q[good], s_u[good], cross)
    return found
