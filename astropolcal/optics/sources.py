# Licensed under a 3-clause BSD style license - see LICENSE
"""Sources of known or unknown polarization, such as standard stars."""

import astropy.units as units
import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.mueller import UNITS, blank
from astropolcal.optics.core import _LinearOptic

__all__ = ["Light", "PolarizedSource", "StarSource"]


class Light(_LinearOptic):
    r"""
    Light of given Stokes parameters: a model with one input, the wavelength.

    .. math:: M = \begin{pmatrix}I&0&0&0\\Q&0&0&0\\U&0&0&0\\V&0&0&0\end{pmatrix}

    First in a chain it takes the place of the light that arrives: the chain then has the
    wavelength as its only input. Followed by ``Mapping((1,), n_inputs=5)`` of astropy, which picks
    the intensity, the chain is a model of one input and one output, which every fitter takes.

    Parameters
    ----------
    I, Q, U, V : float or array_like
        Stokes parameters; scalars, or one value per wavelength. All are fixed by default.
    theta : `~astropy.units.Quantity`
        Orientation of the axes of Q and U.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.modeling.models import Mapping
    >>> from astropolcal.optics import Light, LinearRetarder
    >>> plate = LinearRetarder(retardance=180 * u.deg, theta=20 * u.deg, name="plate")
    >>> curve = Light(Q=1) | plate | Mapping((2,), n_inputs=5)
    >>> curve([1.2, 1.6] * u.um).round(4)
    array([0.1736, 0.1736])
    """

    n_inputs = 1

    I = Parameter(default=1.0, bounds=(0, None), fixed=True, description="intensity")  # noqa: E741
    Q = Parameter(default=0.0, fixed=True, description="Q of the light")
    U = Parameter(default=0.0, fixed=True, description="U of the light")
    V = Parameter(default=0.0, fixed=True, description="V of the light")

    _elements = tuple((1.0, ((row, 0),)) for row in range(4))

    def evaluate(self, wavelength, *parameters):
        """Return ``wavelength`` and the Stokes parameters of the light."""
        stokes = self._light_behind(
            wavelength, (np.ones(np.shape(wavelength)), 0, 0, 0), parameters
        )
        return wavelength, *stokes


class PolarizedSource(_LinearOptic):
    r"""
    Source of linearly polarized light, in the place of the light that arrives.

    .. math:: M = \begin{pmatrix}1&0&0&0\\q&0&0&0\\u&0&0&0\\0&0&0&0\end{pmatrix}

    Light of any polarization leaves with the same intensity and the normalized Stokes parameters q
    and u: an ideal depolarizer, then a source of that polarization. It stands first in the chain of
    a star. Its frame is that of what follows; before ``Rotator(mount="parallactic")`` q and u are
    those of the sky, with angles from north through east.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, between -0.7 and 0.7 so that every pair is a
        possible one; scalars, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes of q and u.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import PolarizedSource
    >>> star = PolarizedSource(q=0.01, u=-0.02, name="star")
    >>> [float(x) for x in star(1.6 * u.um, 5, 0, 0, 0)[1:]]
    [5.0, 0.05, -0.1, 0.0]
    """

    # 0.7 sqrt(2) < 1, see the docstring
    q = Parameter(default=0.0, bounds=(-0.7, 0.7), description="Q over I of the source")
    u = Parameter(default=0.0, bounds=(-0.7, 0.7), description="U over I of the source")

    # only the first column: whatever polarization arrives is forgotten
    _constant, _elements = UNITS[0, 0], ((1.0, ((1, 0),)), (1.0, ((2, 0),)))


class StarSource(PolarizedSource):
    r"""
    Star whose polarization follows a smooth law in wavelength.

    .. math::

        q + i u = p_\mathrm{max} \exp\left[-K \ln^2(\lambda_\mathrm{max} / \lambda)
                  + 2 i \rho \ln(\lambda / \lambda_\mathrm{max})\right] + a + b x + c x^2,
                  \qquad x = \ln(\lambda / \lambda_0)

    The first part is interstellar (Serkowski, Mathewson & Ford 1975, ApJ 196, 261,
    doi:10.1086/153410), along ``theta`` but for its rotation :math:`\rho`. The second,
    with :math:`a = \mathtt{q} + i\,\mathtt{u}` and so on, is what else a star has: all of it for
    one that is unpolarized as far as anyone knows, the departure from the law for others.
    Bounds of single parameters do not keep every sum possible; priors do.

    Parameters
    ----------
    q, u : float
        Further q and u at the reference wavelength.
    p_max : float
        Largest degree of the interstellar polarization.
    lambda_max : `~astropy.units.Quantity`
        Wavelength at which it is reached.
    K : float
        Width of the law.
    rotation : `~astropy.units.Quantity`
        Change of the angle per unit of the natural logarithm of the wavelength.
    q_slope, u_slope, q_curvature, u_curvature : float
        Changes of ``q`` and ``u`` with the logarithm of the wavelength and its square.
    reference : `~astropy.units.Quantity`
        The wavelength :math:`\lambda_0` at which ``q`` and ``u`` hold; fixed.
    theta : `~astropy.units.Quantity`
        Angle of the interstellar polarization at ``lambda_max``, and of the axis of q.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import StarSource
    >>> star = StarSource(p_max=0.04, theta=45 * u.deg, name="star")
    >>> q, stokes_u = star.stokes(550 * u.nm)
    >>> round(float(q), 6), round(float(stokes_u), 6)
    (0.0, 0.04)
    """

    p_max = Parameter(default=0.0, bounds=(0, 0.7), description="largest interstellar degree")
    lambda_max = Parameter(
        default=550.0,
        unit=units.nm,
        bounds=(100, 2500),
        fixed=True,
        description="wavelength of the largest interstellar polarization",
    )
    K = Parameter(default=0.923, bounds=(0, 5), fixed=True, description="width of the law")
    rotation = Parameter(
        default=0.0,
        unit=units.deg,
        bounds=(-90, 90),
        fixed=True,
        description="change of the angle per unit of the logarithm of the wavelength",
    )
    q_slope = Parameter(default=0.0, bounds=(-1, 1), description="slope of q in the logarithm")
    u_slope = Parameter(default=0.0, bounds=(-1, 1), description="slope of u in the logarithm")
    q_curvature = Parameter(default=0.0, bounds=(-1, 1), description="curvature of q")
    u_curvature = Parameter(default=0.0, bounds=(-1, 1), description="curvature of u")
    reference = Parameter(
        default=1000.0,
        unit=units.nm,
        bounds=(100, 10000),
        fixed=True,
        description="wavelength at which q and u hold",
    )

    def stokes(self, wavelength):
        """Return q and u of the star at wavelengths."""
        matrix = self.mueller(wavelength)
        return matrix[..., 1, 0], matrix[..., 2, 0]

    def loosened(self, wavelength):
        """Return the source with the q and u that the law has at each wavelength, held."""
        upright = self.with_parameters(theta=0 * units.deg)
        upright.mount = None
        q, u = upright.stokes(wavelength)
        held = {"q": True, "u": True}
        loose = self._as(PolarizedSource, q=q, u=u, fixed=held, **super()._settings())
        loose.theta.prior = self.theta.prior
        return loose

    def _dispersion(self, wavelength):
        return np.asarray(wavelength)

    def _check(self, law):
        """Refuse wavelengths that have no logarithm; bounds may have been lifted."""
        for key, value in (("lambda_max", law[1]), ("reference", law[8])):
            if not np.all(np.asarray(value) > 0):
                least = 1e3 * np.min(value)
                raise ParameterError(f"{self._label}.{key} = {least:.6g} nm; allowed is above zero")

    def _matrix(self, wavelength, q, u, *law):
        self._check(law)
        x, (q1, u1, q2, u2) = np.log(wavelength / law[8]), law[4:8]
        degree, along, *_ = _interstellar(wavelength, *law[:4])
        return super()._matrix(
            wavelength,
            q + q1 * x + q2 * x**2 + degree * along.real,
            u + u1 * x + u2 * x**2 + degree * along.imag,
        )

    def _derivatives(self, wavelength, q, u, *law):
        self._check(law)
        (_, longest, width, rotation), slopes, reference = law[:4], law[4:8], law[8]
        x = np.log(wavelength / reference)
        degree, along, log, shape = _interstellar(wavelength, *law[:4])
        light = degree * along
        slope, curvature = slopes[0] + 1j * slopes[1], slopes[2] + 1j * slopes[3]
        # changes of q + iu, in the order of the parameters
        changes = (
            1.0,
            1j,
            shape * along,
            # the logarithm grows by 1 / lambda_max, and the angle falls by rotation times that
            -2 * (width * log + 1j * rotation) * light / longest,
            -(log**2) * light,
            -2j * log * light,
            x,
            1j * x,
            x**2,
            1j * x**2,
            # x falls by 1 / reference
            -(slope + 2 * curvature * x) / reference,
        )
        out = blank(wavelength, q, u, *law)
        first, second = UNITS[1:3, 0]
        return tuple(
            out + x.real[..., None, None] * first + x.imag[..., None, None] * second
            for x in map(np.asarray, changes)
        )


def _interstellar(wavelength, p_max, lambda_max, width, rotation):
    """Return degree and direction, the logarithm of lambda_max over the wavelength, and shape."""
    shape, log = serkowski(wavelength, lambda_max, width)
    return p_max * shape, np.exp(-2j * rotation * log), log, shape


def serkowski(wavelength, lambda_max, width):
    """Return the law of Serkowski as a share of its maximum, and the logarithm in it."""
    log = np.log(lambda_max / wavelength)
    return np.exp(-width * log**2), log
