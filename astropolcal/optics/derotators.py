# Licensed under a 3-clause BSD style license - see LICENSE
"""Image derotators, by the physics of their mirrors."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.optics.mirrors import _Metallic

__all__ = ["KMirror"]


class KMirror(_Metallic):
    r"""
    Image derotator of three mirrors in one plane, a K-mirror, with equal films.

    Light meets the first and the last mirror at the angle of incidence
    :math:`\alpha` and the middle one at :math:`2\alpha - 90^\circ`, so that it
    leaves along the line on which it came: 60, 30, 60 deg by default. The
    amplitudes of the three multiply; together they are one
    diattenuator-retarder that turns with its mount ('t Hart et al. 2021, who fit
    the film of that of Subaru).

    Parameters
    ----------
    incidence : `~astropy.units.Quantity`
        Angle of incidence :math:`\alpha` on the first and the last mirror.
    film_thickness : `~astropy.units.Quantity`
        Thickness of the film on each mirror.
    n_scale, k_scale : float or array_like
        Factors on the real and the imaginary part of the index of the metal.
    material, film : str
        Names of the metal and of the material of the film, see
        `~astropolcal.materials.get_material`.
    theta : `~astropy.units.Quantity`
        Orientation of the field across the plane of incidence.

    Raises
    ------
    ParameterError
        If the angle of incidence is not from 45 deg to less than 90 deg, a thickness or
        factor is negative, or a material is not known.
    WavelengthRangeError
        If the index of a material is not known at a wavelength.

    References
    ----------
    't Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import KMirror
    >>> derotator = KMirror(film_thickness=260 * u.nm, mount="derotator", name="derotator")
    >>> derotator.retardance([1.2, 1.6, 2.2] * u.um).round(0)
    <Quantity [144., 274., 303.] deg>
    """

    incidence = Parameter(
        default=60.0,
        unit=u.deg,
        bounds=(50, 80),
        fixed=True,
        description="angle of incidence on the first and the last mirror",
    )
    film_thickness = Parameter(
        default=200.0, unit=u.nm, bounds=(0, 2000), description="thickness of the films"
    )
    n_scale = Parameter(
        default=1.0, bounds=(0.05, 20), fixed=True, description="factor on n of the metal"
    )
    k_scale = Parameter(
        default=1.0, bounds=(0.2, 5), fixed=True, description="factor on k of the metal"
    )

    def _reflections(self, incidence):
        # a smaller angle leaves the middle mirror no place
        good = incidence >= np.pi / 4
        self._check(good, "incidence", np.rad2deg(incidence), " deg", "45 deg to less than 90 deg")
        # a mirror at the angle a bends the light by 180 deg - 2 a; the outer two undo what the
        # middle one does: 2 (180 - 2 a) = 180 - 2 b
        return ((incidence, 1.0, 2), (2 * incidence - np.pi / 2, 2.0, 1))
