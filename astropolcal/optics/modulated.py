# Licensed under a 3-clause BSD style license - see LICENSE
"""
Optics whose Mueller matrix changes from frame to frame.

Their ``mount`` names what the matrix depends on: the angle of a stage (``"hwp"``), or how far the
run has come (``"sequence"``, 0 to 1). At zero parameters each is the identity, so that it adds to a
chain one way in which a real instrument departs from an ideal one.

Optics that act in one state of a device, or on one beam of several.

Their ``mount`` is ``"COLUMN=STATE"``: the position is 1 in the frames whose column of the table
has that state, and 0 in all others, where the optic does nothing. A liquid crystal with four
voltages is four retarders, ``mount="lcvr=A"`` to ``"lcvr=D"``; an analyser with three beams is
three polarizers, ``mount="beam=NAME"``, one for each column ``flux_NAME``.
"""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal import mueller
from astropolcal.exceptions import ParameterError
from astropolcal.optics._modelling import Setting, phase
from astropolcal.optics.core import Optic
from astropolcal.optics.polarizers import BEAMS, EllipticalRetarder, _BeamOptic
from astropolcal.units import positive_number

__all__ = [
    "DriftRetarder",
    "DriftRotator",
    "FerroelectricLiquidCrystal",
    "FluxGain",
    "FrameOptic",
    "HarmonicGain",
    "HarmonicRetarder",
    "HarmonicRotator",
    "PolarizedBackground",
    "StateAnalyser",
    "StateRetarder",
    "StrayLight",
]

# share of a frame that is light of the source at the least
_LEAST_OF_SOURCE = 0.01


class FrameOptic(Optic):
    """
    An optic whose matrix depends on the position of its mount.

    A subclass gives ``_matrix(coordinate, *values)`` and ``_derivatives``. The coordinate is the
    position of the mount (radian or a number, with the sign of the mount); values and coordinate
    broadcast against each other. Without a mount the coordinate is zero.

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

    def _dispersion_at(self, wavelength):
        # for its check of the wavelength
        super()._dispersion_at(wavelength)
        # no law in wavelength: the coordinate takes the place of the dispersion
        return 0.0

    def _moved(self, coordinate, angle, shift):
        # a rotator before the plate stays where it is while its amplitude follows the stage
        return coordinate + shift, angle + shift if self.turns else angle


class _Modulated(FrameOptic):
    """
    What depends on one number: the sum of the parameters, each times a function of the position.

    A subclass gives these functions as ``_waves``, by default the position itself, the matrix of
    the number as ``_of``, and its derivative as ``_slope``.
    """

    def _waves(self, coordinate):
        return (np.asarray(coordinate),)

    def _sum(self, coordinate, values):
        return sum(w * value for w, value in zip(self._waves(coordinate), values, strict=True))

    def _matrix(self, coordinate, *values):
        return self._of(self._sum(coordinate, values))

    def _derivatives(self, coordinate, *values):
        slope = self._slope(self._sum(coordinate, values))
        return tuple(wave[..., None, None] * slope for wave in self._waves(coordinate))


class _Rotation(_Modulated):
    _of = staticmethod(mueller._rotation_matrix)

    def _slope(self, angle):
        return mueller.turn(mueller._rotation_matrix(angle))


class _Retardation(_Modulated):
    _of = staticmethod(mueller._linear_retarder)
    _slope = staticmethod(mueller.retardance_slope)


class _Gain(_Modulated):
    def _of(self, change):
        return scaled(1.0 + change)

    def _slope(self, change):
        return scaled(np.ones_like(change))


def _one_of(*allowed):
    """Return the check of a setting that is one of some values of one kind."""
    kind = type(allowed[0])

    def check(value, name):
        known = isinstance(value, bool | np.bool_) == (kind is bool) and np.isscalar(value)
        if not known or value not in allowed:
            raise ParameterError(f"{name} = {value!r}; allowed are {', '.join(map(str, allowed))}")
        return kind(value)

    return check


class _Harmonic(FrameOptic):
    """What varies as cosine cos(n x) + sine sin(n x) with the position x of the mount."""

    takes_numbers = False

    harmonic = Setting(1, _one_of(1, 2, 4), "Number of periods in a turn of the mount: 1, 2 or 4.")

    def _waves(self, coordinate):
        phase = self._harmonic * np.asarray(coordinate)
        return np.cos(phase), np.sin(phase)


class HarmonicRotator(_Harmonic, _Rotation):
    r"""
    Rotator of the polarization by an angle that varies with the position of a stage.

    :math:`T(\delta)` with :math:`\delta = a\cos nx + b\sin nx`. One upstream of an
    optic and its inverse (both parameters of opposite sign) downstream of it add
    :math:`\delta` to the orientation of that optic, the error of the encoder of
    its stage: n = 1 for a scale that is not centred, n = 2 for one that is not
    round. All three need the same ``mount``, with the same sign.

    Parameters
    ----------
    cosine, sine : `~astropy.units.Quantity`
        Amplitudes a and b, angles; scalars, or one value per wavelength.
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


class DriftRotator(_Rotation):
    r"""
    Rotator of the polarization by an angle that grows through the run.

    :math:`T(r x)` with x from 0 in the first to 1 in the last frame: a source
    or polarizer whose orientation drifts. As downstream of a `Rotator`, the angle of
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


class DriftRetarder(FrameOptic):
    r"""
    Linear retarder of any orientation whose retardance changes through the run.

    The retardance vector is :math:`(h + \dot h x,\; d + \dot d x,\; 0)`, with x from 0 in the first
    to 1 in the last frame. Fringes whose phase drifts with the temperature are one, with a cosine
    and a sine of the wavenumber for each parameter.

    Parameters
    ----------
    horizontal, diagonal : `~astropy.units.Quantity`
        Retardances h and d in the first frame; scalars, or one value per wavelength.
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

    horizontal = phase("horizontal linear retardance")
    diagonal = phase("45 deg linear retardance")
    horizontal_rate = phase("change over the run")
    diagonal_rate = phase("change over the run")

    @staticmethod
    def _vector(coordinate, horizontal, diagonal, horizontal_rate, diagonal_rate):
        x = np.asarray(coordinate)
        return horizontal + horizontal_rate * x, diagonal + diagonal_rate * x, 0.0

    def _matrix(self, coordinate, *values):
        return mueller._elliptical_retarder(*self._vector(coordinate, *values))

    def _derivatives(self, coordinate, *values):
        vector = self._vector(coordinate, *values)
        # nothing moves the circular retardance, so that its slope is not needed
        to_horizontal, to_diagonal, _ = EllipticalRetarder()._derivatives(None, *vector)
        x = np.asarray(coordinate)[..., None, None]
        return to_horizontal, to_diagonal, x * to_horizontal, x * to_diagonal


class HarmonicRetarder(_Harmonic, _Retardation):
    r"""
    Linear retarder that turns with its mount and whose retardance varies with it.

    Retardance :math:`a\cos nx + b\sin nx`: what a tilted plate adds to its own
    (n = 2; Patanchon et al. 2023, arXiv:2308.00967).

    Parameters
    ----------
    cosine, sine : `~astropy.units.Quantity`
        Amplitudes a and b; scalars, or one value per wavelength.
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


class HarmonicGain(_BeamOptic, _Harmonic, _Gain):
    r"""
    Transmission of the beams that varies with the position of a stage.

    :math:`1 \pm (a\cos nx + b\sin nx)`: dust or a wedge that turns with the
    plate. Both beams alike, or (``differential``) with opposite signs, as where the beams wander
    over a detector that is not flat (Tinyanont et al. 2019, arXiv:1908.10409).

    Parameters
    ----------
    cosine, sine : float or array_like
        Amplitudes a and b; scalars, or one value per wavelength.
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

    differential = Setting(
        False, _one_of(True, False), "Whether the left beam changes with the opposite sign."
    )

    @property
    def depends_on_beam(self):
        """True where the left beam changes with the opposite sign."""
        return self._differential

    def _waves(self, coordinate):
        sign = BEAMS[self._beam] if self._differential else 1.0
        return tuple(sign * wave for wave in super()._waves(coordinate))


def scaled(gain):
    """Return the Mueller matrix of a gain that does not depend on polarization."""
    return np.asarray(gain)[..., None, None] * np.eye(4)


class FerroelectricLiquidCrystal(FrameOptic):
    r"""
    Ferroelectric liquid crystal: a retarder whose axis switches between two orientations.

    .. math:: M_s = T(-s\alpha)\, R(\delta)\, T(s\alpha)

    with the state s from the frame (``mount="flc_state"``): 0 in state A, 1 in state B (Norris et
    al. 2015, doi:10.1093/mnras/stu2529). A half-wave retarder with a switching angle of 45 deg
    exchanges the two beams.

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        Retardance :math:`\delta`; scalar, or one value per wavelength.
    switching_angle : `~astropy.units.Quantity`
        Angle :math:`\alpha` from the fast axis in state A to that in state B; scalar, or one
        value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the fast axis in state A.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import FerroelectricLiquidCrystal
    >>> flc = FerroelectricLiquidCrystal(
    ...     retardance=180 * u.deg, switching_angle=45 * u.deg, mount="flc_state", name="flc"
    ... )
    >>> [float(flc.mueller(position=state)[1, 1].round(6)) for state in (0, 1)]
    [1.0, -1.0]
    """

    retardance = phase("retardance in both states")
    switching_angle = Parameter(
        default=0.0,
        unit=u.deg,
        bounds=(-90, 90),
        description="angle of the fast axis in state B from that in state A",
    )

    def _matrix(self, coordinate, retardance, switching_angle):
        return mueller._rotate(mueller._linear_retarder(retardance), coordinate * switching_angle)

    def _derivatives(self, coordinate, retardance, switching_angle):
        slope = mueller._rotate(mueller.retardance_slope(retardance), coordinate * switching_angle)
        # the axis stands at s alpha: a turn of it, s times
        turning = mueller.rotation_generator(self._matrix(coordinate, retardance, switching_angle))
        return slope, np.asarray(coordinate)[..., None, None] * turning


class _Referenced(FrameOptic):
    """What is given for a reference flux, so that its parameters are numbers near one."""

    reference = Setting(
        1.0,
        positive_number,
        "Flux of which the coefficients are shares, in the unit of the tables.",
    )


class FluxGain(_BeamOptic, _Referenced, _Gain):
    r"""
    Gain of each beam that depends on its flux.

    :math:`1 + k F/F_0`, with the coefficient k of the beam and its flux F in the table
    (``mount="flux"``), is a detector that is not linear. With the exponent -1 it is
    :math:`1 / (1 - k F_0/F)`: a flux :math:`k F_0` is added, which F contains, 99 % of it at
    most. With ``mount="previous_flux"`` F is the flux over that of the frame before, and what is
    added is persistence, a share :math:`k F_0` of it. Where F = 0 the gain is one.

    Parameters
    ----------
    right, left : float or array_like
        Coefficient k of each beam; scalars, or one value per wavelength.
    power : {1, -1}
        Exponent of the flux.
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

    power = Setting(1, _one_of(1, -1), "Exponent of the flux, 1 or -1.")

    def _waves(self, coordinate):
        # on the stage previous_flux the coordinate is F now over F before, so that its inverse
        # is the afterglow of the frame before per flux of this one
        level = np.asarray(coordinate) / self._reference
        if self._power != 1:
            # where there is no flux, there is none to add to
            level = np.divide(1.0, level, out=np.zeros_like(level), where=level != 0)
        # each beam falls on a part of the detector of its own, and what bends one does not move
        # the other
        none = np.zeros_like(level)
        return (level, none) if self._beam == "right" else (none, level)

    def _of(self, change):
        # light that is added is in the flux of the table
        return super()._of(change if self._power == 1 else 1 / _of_source(change) - 1)

    def _slope(self, change):
        if self._power == 1:
            return super()._slope(change)
        left = _of_source(change)
        return scaled(np.where(left > _LEAST_OF_SOURCE, left**-2, 0.0))


def _of_source(added):
    """Return what of the light is not added, from the share that is."""
    return np.maximum(1 - added, _LEAST_OF_SOURCE)


class StrayLight(_Referenced):
    r"""
    Unpolarized light that is added upstream of the beam splitter, regardless of the source.

    :math:`I' = I / (1 - b F_0/F)` with F the sum of both beams in the table
    (``mount="total_flux"``), which contains the added light: a constant flux :math:`b F_0` is
    part of each frame, such as background, stray light, ghosts (Patat & Romaniello 2006,
    doi:10.1086/497581). It is 99 % of a frame at most. Where F = 0 nothing is added.

    Parameters
    ----------
    amount : float or array_like
        Added flux b over :math:`F_0`; scalar, or one value per wavelength.
    reference : float
        :math:`F_0`, in the unit of the tables.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> from astropolcal.optics import StrayLight
    >>> ghost = StrayLight(amount=0.01, reference=1e6, mount="total_flux", name="ghost")
    >>> float(ghost.mueller(position=5e5)[0, 0].round(4))
    1.0204
    """

    amount = Parameter(default=0.0, bounds=(-0.5, 0.5), description="added flux over the reference")

    def _share(self, coordinate, amount):
        """Return the reference flux over that of the source, and its derivative to the amount."""
        flux = np.asarray(coordinate, dtype=float)
        share = np.divide(self._reference, flux, out=np.zeros_like(flux), where=flux != 0)
        # the frame has some light of the source
        left = _of_source(amount * share)
        share = share / left
        return share, np.where(left > _LEAST_OF_SOURCE, share**2, 0.0)

    def _matrix(self, coordinate, *added):
        out = mueller.blank(coordinate, *added)
        out += np.eye(4)
        share, _ = self._share(coordinate, added[0])
        for row, value in enumerate(added):
            # the light is added whatever the polarization of the source: the first column only
            out[..., row, 0] += value * share
        return out

    def _derivatives(self, coordinate, *added):
        slopes = [mueller.blank(coordinate, *added) for _ in added]
        share, slope = self._share(coordinate, added[0])
        for row, value in enumerate(added):
            slopes[row][..., row, 0] += share
            # the more is added, the less is the source
            slopes[0][..., row, 0] += value * slope
        return tuple(slopes)


class PolarizedBackground(StrayLight):
    r"""
    Polarized light that is added to that of the source, regardless of the source.

    .. math:: I' = I\,(1 + b s),\quad Q' = Q + q s\,I,\quad U' = U + u s\,I

    with :math:`s = F_0 / (F - b F_0)` and F the sum of both beams in the table
    (``mount="total_flux"``), which contains the added light: the same Stokes vector
    :math:`(b, q, u) F_0` is part of each frame: moonlight, twilight or a zodiacal background
    (Patat & Romaniello 2006, doi:10.1086/497581). Where F = 0 nothing is added.

    Parameters
    ----------
    amount : float or array_like
        Added flux b over :math:`F_0`; 0 where the flux of the background was
        subtracted, but not its polarization.
    q, u : float or array_like
        Added polarized flux over :math:`F_0`, in the frame of what follows;
        scalars, or one value per wavelength.
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


# ---- states of a device --------------------------------------------------------------------


class StateRetarder(_Retardation):
    r"""
    Linear retarder that is there in one state of a device only.

    Its retardance is :math:`x\delta`, with x = 1 in the frames of its state and 0 in the others:
    a liquid crystal at one of its voltages (Tomczyk et al. 2010, Appl. Opt. 49, 3580,
    doi:10.1364/AO.49.003580).

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        Retardance :math:`\delta` in this state; scalar, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the fast axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import StateRetarder
    >>> quarter = StateRetarder(retardance=90 * u.deg, mount="lcvr=B", name="lcvr_B")
    >>> [float(quarter.mueller(position=x)[2, 3].round(6)) for x in (0, 1)]
    [0.0, 1.0]
    """

    retardance = phase("retardance in this state")


class StateAnalyser(FrameOptic):
    r"""
    Linear polarizer that one beam, or one state of a wheel, passes through.

    .. math:: M = (1 - x)\,\mathbb{1} + x\,\frac{t}{2}
              \begin{pmatrix}1&\eta&0&0\\ \eta&1&0&0\\0&0&0&0\\0&0&0&0\end{pmatrix}

    with x = 1 in its beam or state and 0 in the others: one beam of a double Wollaston prism
    (Oliva 1997, A&AS 123, 589), or one polarizer of a filter wheel. For all beams to be analysed,
    each needs one.

    Parameters
    ----------
    efficiency : float or array_like
        Modulation efficiency :math:`\eta`, between -1 and 1.
    transmission : float or array_like
        Transmission t, relative to the other beams or states. Fixed by default.
    theta : `~astropy.units.Quantity`
        Orientation of the transmission axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import StateAnalyser
    >>> beam = StateAnalyser(efficiency=0.99, theta=45 * u.deg, mount="beam=i45", name="i45")
    >>> beam.mueller(position=1)[0].round(3).tolist()
    [0.5, 0.0, 0.495, 0.0]
    """

    _components = ("efficiency",)
    efficiency = Parameter(default=1.0, bounds=(-1, 1), description="modulation efficiency")
    transmission = Parameter(
        default=1.0, bounds=(0, 4), fixed=True, description="relative transmission"
    )

    def _parts(self, *values):
        """Return the values, and the matrices of ideal polarizers with and without efficiency."""
        x, eta, t = (v[..., None, None] for v in np.broadcast_arrays(*values))
        crossed = mueller.UNITS[0, 1] + mueller.UNITS[1, 0]
        return x, t, crossed, mueller.UNITS[0, 0] + mueller.UNITS[1, 1] + eta * crossed

    def _matrix(self, *values):
        x, t, _, passed = self._parts(*values)
        return (1 - x) * np.eye(4) + x * t / 2 * passed

    def _derivatives(self, *values):
        x, t, crossed, passed = self._parts(*values)
        return x * t / 2 * crossed, x / 2 * passed
