# Licensed under a 3-clause BSD style license - see LICENSE
"""
Optics whose Mueller matrix changes from frame to frame.

Their ``mount`` names what the matrix depends on: the angle of a stage
(``"hwp"``), or how far the run has come (``"sequence"``, 0 to 1); those that
follow the flux are in `astropolcal.optics.fluxes`. At zero parameters each is
the identity, so that it adds to a chain one way in which a real instrument
departs from an ideal one.
"""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.mueller.elements import (
    _elliptical_retarder,
    _linear_retarder,
    _rotation_matrix,
)
from astropolcal.optics._matrices import blank, retardance_slope
from astropolcal.optics.beamsplitters import BEAMS, _BeamOptic
from astropolcal.optics.core import Optic
from astropolcal.optics.retarders import EllipticalRetarder

__all__ = [
    "DriftRetarder",
    "DriftRotator",
    "FrameOptic",
    "HarmonicGain",
    "HarmonicRetarder",
    "HarmonicRotator",
]

_IDENTITY = np.eye(4)


class FrameOptic(Optic):
    """
    An optic whose matrix depends on the position of its mount.

    A subclass gives ``_matrix(coordinate, *values)`` and ``_derivatives``. The
    coordinate is the position of the mount (radian or a number, with the sign
    of the mount); values and coordinate broadcast against each other. Without a
    mount the coordinate is zero.

    See Also
    --------
    COORDINATES : the positions that are numbers.

    Examples
    --------
    >>> from astropolcal.optics import FrameOptic, HarmonicGain
    >>> issubclass(HarmonicGain, FrameOptic)
    True
    """

    #: Whether the optic also turns with its mount.
    turns = False
    takes_numbers = True

    def _resolve(self, wavelength, position, parameters=None):
        # no law in wavelength: the coordinate takes the place of the dispersion
        _, shift, values = self._read(wavelength, position, parameters)
        return (*self._moved(0.0, values[0], shift), values[1:])

    def _moved(self, coordinate, angle, shift):
        # a rotator before the plate stays where it is while its amplitude follows the stage
        return coordinate + shift, angle + shift if self.turns else angle


def one_of(allowed, value, name):
    """Return a whole number of those allowed, or raise."""
    if isinstance(value, bool | np.bool_) or not np.isscalar(value) or value not in allowed:
        raise ParameterError(f"{name} = {value!r}; allowed are {', '.join(map(str, allowed))}")
    return int(value)


class _Harmonic(FrameOptic):
    """What varies as cosine cos(n x) + sine sin(n x) with the position x of the mount."""

    takes_numbers = False

    def __init__(self, *args, harmonic=1, **kwargs):
        super().__init__(*args, **kwargs)
        self.harmonic = harmonic

    @property
    def harmonic(self):
        """Number of periods in a turn of the mount: 1, 2 or 4."""
        return self._harmonic

    @harmonic.setter
    def harmonic(self, value):
        self._harmonic = one_of((1, 2, 4), value, f"{type(self).__name__}.harmonic")

    def _settings(self):
        return super()._settings() | {"harmonic": self.harmonic}

    def _waves(self, coordinate):
        phase = self._harmonic * np.asarray(coordinate)
        return np.cos(phase), np.sin(phase)

    def _sum(self, coordinate, cosine, sine):
        c, s = self._waves(coordinate)
        return cosine * c + sine * s


class HarmonicRotator(_Harmonic):
    r"""
    Rotator of the polarization by an angle that varies with the position of a stage.

    :math:`T(\delta)` with :math:`\delta = a\cos nx + b\sin nx`. One in front of an
    optic and its inverse (both parameters of opposite sign) behind it add
    :math:`\delta` to the orientation of that optic, the error of the encoder of
    its stage: n = 1 for a scale that is not centred, n = 2 for one that is not
    round. All three need the same ``mount``, with the same sign.

    Parameters
    ----------
    cosine, sine : `~astropy.units.Quantity`
        Amplitudes a and b, angles; scalars, or one value a wavelength.
    harmonic : {1, 2, 4}
        Periods n in a turn of the mount.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import HarmonicRotator
    >>> error = HarmonicRotator(cosine=0.5 * u.deg, mount="hwp", name="hwp_encoder")
    >>> float(error.mueller(position=180 * u.deg)[1, 2].round(5))
    -0.01745
    """

    cosine = Parameter(default=0.0, unit=u.deg, bounds=(-30, 30), description="cosine amplitude")
    sine = Parameter(default=0.0, unit=u.deg, bounds=(-30, 30), description="sine amplitude")

    def _matrix(self, coordinate, cosine, sine):
        return _rotation_matrix(self._sum(coordinate, cosine, sine))

    def _derivatives(self, coordinate, cosine, sine):
        slope = _turned_slope(self._sum(coordinate, cosine, sine))
        return tuple(_times(wave, slope) for wave in self._waves(coordinate))


class DriftRotator(FrameOptic):
    r"""
    Rotator of the polarization by an angle that grows through the run.

    :math:`T(r x)` with x from 0 in the first to 1 in the last frame: a source
    or polarizer whose orientation drifts. As behind a `Rotator`, the angle of
    linear polarization is less by :math:`r x`.

    Parameters
    ----------
    rate : `~astropy.units.Quantity`
        Angle r over the run, or per radian of a stage.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import DriftRotator
    >>> drift = DriftRotator(rate=0.2 * u.deg, mount="sequence", name="drift")
    >>> float(drift.mueller(position=0.5)[1, 2].round(5))
    0.00349
    """

    rate = Parameter(default=0.0, unit=u.deg, bounds=(-30, 30), description="angle over the run")

    def _matrix(self, coordinate, rate):
        return _rotation_matrix(rate * np.asarray(coordinate))

    def _derivatives(self, coordinate, rate):
        return (_times(coordinate, _turned_slope(rate * np.asarray(coordinate))),)


class DriftRetarder(FrameOptic):
    r"""
    Linear retarder of any orientation whose retardance changes through the run.

    The retardance vector is :math:`(h + \dot h x,\; d + \dot d x,\; 0)`, with x
    from 0 in the first to 1 in the last frame. Fringes whose phase drifts with the
    temperature are one, with a cosine and a sine of the wavenumber for each
    parameter.

    Parameters
    ----------
    horizontal, diagonal : `~astropy.units.Quantity`
        Retardances h and d in the first frame; scalars, or one value a wavelength.
    horizontal_rate, diagonal_rate : `~astropy.units.Quantity`
        Their changes over the run.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import DriftRetarder
    >>> window = DriftRetarder(diagonal_rate=2 * u.deg, mount="sequence", name="window")
    >>> float(window.mueller(position=0.5)[1, 3].round(5))
    -0.01745
    """

    horizontal = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="horizontal linear retardance"
    )
    diagonal = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="45 deg linear retardance"
    )
    horizontal_rate = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="change over the run"
    )
    diagonal_rate = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="change over the run"
    )

    @staticmethod
    def _vector(coordinate, horizontal, diagonal, horizontal_rate, diagonal_rate):
        x = np.asarray(coordinate)
        return horizontal + horizontal_rate * x, diagonal + diagonal_rate * x, 0.0

    def _matrix(self, coordinate, *values):
        return _elliptical_retarder(*self._vector(coordinate, *values))

    def _derivatives(self, coordinate, *values):
        vector = self._vector(coordinate, *values)
        # nothing moves the circular retardance, so that its slope is not needed
        to_horizontal, to_diagonal, _ = EllipticalRetarder()._derivatives(None, *vector)
        rates = (_times(coordinate, slope) for slope in (to_horizontal, to_diagonal))
        return to_horizontal, to_diagonal, *rates


class HarmonicRetarder(_Harmonic):
    r"""
    Linear retarder that turns with its mount and whose retardance varies with it.

    Retardance :math:`a\cos nx + b\sin nx`: what a tilted plate adds to its own
    (n = 2; Patanchon et al. 2023, arXiv:2308.00967).

    Parameters
    ----------
    cosine, sine : `~astropy.units.Quantity`
        Amplitudes a and b; scalars, or one value a wavelength.
    harmonic : {1, 2, 4}
        Periods n in a turn of the mount.
    theta : `~astropy.units.Quantity`
        Orientation of the axis on the mount.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import HarmonicRetarder
    >>> tilt = HarmonicRetarder(cosine=2 * u.deg, harmonic=2, mount="hwp", name="hwp_tilt")
    >>> float(tilt.mueller(position=90 * u.deg)[2, 3].round(4))
    0.0349
    """

    turns = True

    cosine = Parameter(default=0.0, unit=u.deg, bounds=(-90, 90), description="cosine amplitude")
    sine = Parameter(default=0.0, unit=u.deg, bounds=(-90, 90), description="sine amplitude")

    def _matrix(self, coordinate, cosine, sine):
        return _linear_retarder(self._sum(coordinate, cosine, sine))

    def _derivatives(self, coordinate, cosine, sine):
        slope = retardance_slope(self._sum(coordinate, cosine, sine))
        return tuple(_times(wave, slope) for wave in self._waves(coordinate))


class HarmonicGain(_BeamOptic, _Harmonic):
    r"""
    Transmission of the beams that varies with the position of a stage.

    :math:`1 \pm (a\cos nx + b\sin nx)`: dust or a wedge that turns with the
    plate. Both beams alike, or (``differential``) with opposite signs, as where
    the beams wander over a detector that is not flat (Tinyanont et al. 2019,
    arXiv:1908.10409).

    Parameters
    ----------
    cosine, sine : float or array_like
        Amplitudes a and b; scalars, or one value a wavelength.
    harmonic : {1, 2, 4}
        Periods n in a turn of the mount.
    differential : bool
        Whether the left beam changes with the opposite sign.
    beam : {"right", "left"}
        The beam that goes on in a chain.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import HarmonicGain
    >>> dust = HarmonicGain(sine=0.01, mount="hwp", name="hwp_transmission")
    >>> float(dust.mueller(position=90 * u.deg)[0, 0])
    1.01
    """

    cosine = Parameter(default=0.0, bounds=(-0.4, 0.4), description="cosine amplitude")
    sine = Parameter(default=0.0, bounds=(-0.4, 0.4), description="sine amplitude")

    def __init__(self, *args, differential=False, **kwargs):
        super().__init__(*args, **kwargs)
        self.differential = differential

    @property
    def differential(self):
        """Whether the left beam changes with the opposite sign."""
        return self._differential

    @differential.setter
    def differential(self, value):
        if not isinstance(value, bool | np.bool_):
            raise ParameterError(
                f"HarmonicGain.differential = {value!r}; allowed are True and False"
            )
        self._differential = bool(value)

    @property
    def depends_on_beam(self):
        """True where the left beam changes with the opposite sign."""
        return self._differential

    def _settings(self):
        return super()._settings() | {"differential": self.differential}

    @property
    def _sign(self):
        # +1 for the right beam, -1 for the left
        return BEAMS[self._beam] if self._differential else 1.0

    def _matrix(self, coordinate, cosine, sine):
        return scaled(1.0 + self._sign * self._sum(coordinate, cosine, sine))

    def _derivatives(self, coordinate, cosine, sine):
        shape = np.broadcast_shapes(*(np.shape(x) for x in (coordinate, cosine, sine)))
        return tuple(
            scaled(np.broadcast_to(self._sign * wave, shape)) for wave in self._waves(coordinate)
        )


def scaled(gain):
    """Return the Mueller matrix of a gain that does not depend on polarization."""
    return np.asarray(gain)[..., None, None] * _IDENTITY


def _times(factor, matrix):
    return np.asarray(factor)[..., None, None] * matrix


def _turned_slope(angle):
    """Return the derivative of T(angle)."""
    out = blank(angle)
    # of cos 2 angle and sin 2 angle, see T in Rotator
    out[..., 1, 1] = out[..., 2, 2] = -2 * np.sin(2 * angle)
    out[..., 1, 2] = 2 * np.cos(2 * angle)
    out[..., 2, 1] = -out[..., 1, 2]
    return out
