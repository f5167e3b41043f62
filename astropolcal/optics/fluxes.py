# Licensed under a 3-clause BSD style license - see LICENSE
"""
Optics whose Mueller matrix follows the flux of a frame.

Detectors that are not linear or keep an afterglow, and light that is added to that of the source.
The flux is a column of the tables: their ``mount`` is ``"flux"``, that of the beam,
``"previous_flux"``, the same over the one in the frame before, or ``"total_flux"``, of both beams.
"""

import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.optics._matrices import blank
from astropolcal.optics.beamsplitters import _BeamOptic
from astropolcal.optics.modulated import FrameOptic, one_of, scaled
from astropolcal.units import to_unit

__all__ = ["FluxGain", "PolarizedBackground", "StrayLight"]

_IDENTITY = np.eye(4)


class _Referenced(FrameOptic):
    """What is given for a reference flux, so that its parameters are numbers near one."""

    def __init__(self, *args, reference=1.0, **kwargs):
        super().__init__(*args, **kwargs)
        self.reference = reference

    @property
    def reference(self):
        """Flux of which the coefficients are shares, in the unit of the tables."""
        return self._reference

    @reference.setter
    def reference(self, value):
        self._reference = _positive(value, f"{type(self).__name__}.reference")

    def _settings(self):
        return super()._settings() | {"reference": self.reference}


class FluxGain(_BeamOptic, _Referenced):
    r"""
    Gain of each beam that depends on its flux.

    :math:`1 + k (F/F_0)^m`, with the coefficient k of the beam and its flux F in
    the table (``mount="flux"``). With m = 1 a detector that is not linear. With
    ``mount="previous_flux"``, F is the flux over that of the frame before, and
    m = -1 is persistence, a share :math:`k F_0` of it. Where F = 0 the gain is one.

    Parameters
    ----------
    right, left : float or array_like
        Coefficient k of each beam; scalars, or one value a wavelength.
    power : {1, -1}
        Exponent m.
    reference : float
        :math:`F_0`, in the unit of the tables.
    beam : {"right", "left"}
        The beam that goes on in a chain.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> from astropolcal.optics import FluxGain
    >>> bend = FluxGain(right=-0.01, left=-0.01, reference=1e7, mount="flux", name="nonlinearity")
    >>> float(bend.mueller(position=5e6)[0, 0])
    0.995
    """

    right = Parameter(default=0.0, bounds=(-0.5, 0.5), description="coefficient of the right beam")
    left = Parameter(default=0.0, bounds=(-0.5, 0.5), description="coefficient of the left beam")

    def __init__(self, *args, power=1, **kwargs):
        super().__init__(*args, **kwargs)
        self.power = power

    @property
    def power(self):
        """Exponent of the flux, 1 or -1."""
        return self._power

    @power.setter
    def power(self, value):
        self._power = one_of((1, -1), value, "FluxGain.power")

    def _settings(self):
        return super()._settings() | {"power": self.power}

    def _level(self, coordinate):
        # on the stage previous_flux the coordinate is F now over F before, so that its inverse
        # is the afterglow of the frame before per flux of this one
        relative = np.asarray(coordinate) / self._reference
        if self._power == 1:
            return relative
        # where there is no flux, there is none to add to
        return np.divide(1.0, relative, out=np.zeros_like(relative), where=relative != 0)

    def _matrix(self, coordinate, right, left):
        # each beam falls on a part of the detector of its own
        own = right if self._beam == "right" else left
        return scaled(1.0 + own * self._level(coordinate))

    def _derivatives(self, coordinate, right, left):
        shape = np.broadcast_shapes(*(np.shape(x) for x in (coordinate, right, left)))
        slope = scaled(np.broadcast_to(self._level(coordinate), shape))
        # what bends one beam does not move the other
        none = np.zeros_like(slope)
        return (slope, none) if self._beam == "right" else (none, slope)


class StrayLight(_Referenced):
    r"""
    Unpolarized light that is added in front of the beam splitter, whatever the source does.

    :math:`I' = I\,(1 + b F_0/F)` with F the sum of both beams in the table
    (``mount="total_flux"``), so that a constant flux :math:`b F_0` is added to
    each frame: background, stray light, ghosts (Patat & Romaniello 2006,
    doi:10.1086/497581). Where F = 0 nothing is added.

    Parameters
    ----------
    amount : float or array_like
        Added flux b over :math:`F_0`; scalar, or one value a wavelength.
    reference : float
        :math:`F_0`, in the unit of the tables.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> from astropolcal.optics import StrayLight
    >>> ghost = StrayLight(amount=0.01, reference=1e6, mount="total_flux", name="ghost")
    >>> float(ghost.mueller(position=5e5)[0, 0])
    1.02
    """

    amount = Parameter(default=0.0, bounds=(-0.5, 0.5), description="added flux over the reference")

    def _share(self, coordinate):
        flux = np.asarray(coordinate, dtype=float)
        return np.divide(self._reference, flux, out=np.zeros_like(flux), where=flux != 0)

    def _matrix(self, coordinate, amount):
        out = blank(coordinate, amount)
        out[...] = _IDENTITY
        # added light has no polarization: only I to I grows
        out[..., 0, 0] += amount * self._share(coordinate)
        return out

    def _derivatives(self, coordinate, amount):
        out = blank(coordinate, amount)
        out[..., 0, 0] = self._share(coordinate)
        return (out,)


class PolarizedBackground(StrayLight):
    r"""
    Polarized light that is added to that of the source, whatever the source does.

    .. math:: I' = I\,(1 + b F_0/F),\quad Q' = Q + q F_0/F\,I,\quad U' = U + u F_0/F\,I

    with F the sum of both beams in the table (``mount="total_flux"``), so that
    the same Stokes vector :math:`(b, q, u) F_0` is added to each frame: moonlight,
    twilight or a zodiacal background (Patat & Romaniello 2006,
    doi:10.1086/497581). Where F = 0 nothing is added.

    Parameters
    ----------
    amount : float or array_like
        Added flux b over :math:`F_0`; 0 where the flux of the background was
        subtracted, but not its polarization.
    q, u : float or array_like
        Added polarized flux over :math:`F_0`, in the frame of what follows;
        scalars, or one value a wavelength.
    reference : float
        :math:`F_0`, in the unit of the tables.
    theta : `~astropy.units.Quantity`
        Orientation of the axes of q and u.

    Examples
    --------
    >>> from astropolcal.optics import PolarizedBackground
    >>> moon = PolarizedBackground(q=0.01, reference=1e6, mount="total_flux", name="moon")
    >>> float(moon.mueller(position=5e5)[1, 0])
    0.02
    """

    q = Parameter(default=0.0, bounds=(-0.5, 0.5), description="added Q over the reference")
    u = Parameter(default=0.0, bounds=(-0.5, 0.5), description="added U over the reference")

    def _matrix(self, coordinate, amount, q, u):
        out = blank(coordinate, amount, q, u)
        out[...] = _IDENTITY
        for row, value in enumerate((amount, q, u)):
            # the light is added whatever the polarization of the source: the first column only
            out[..., row, 0] += value * self._share(coordinate)
        return out

    def _derivatives(self, coordinate, amount, q, u):
        slopes = []
        for row in range(3):
            out = blank(coordinate, amount, q, u)
            out[..., row, 0] = self._share(coordinate)
            slopes.append(out)
        return tuple(slopes)


def _positive(value, name):
    number = to_unit(value, None, name)
    if number.ndim or not (np.isfinite(number) and number > 0):
        raise ParameterError(f"{name} = {value!r} must be one positive number")
    return float(number)
