# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that split the light into two beams, and that act on the two differently."""

import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.optics._matrices import blank
from astropolcal.optics.core import Optic

__all__ = ["BeamGain", "WollastonPrism"]

# sign of eta: the right beam is the ordinary one
BEAMS = {"right": 1.0, "left": -1.0}


class _BeamOptic(Optic):
    """What acts differently on the two beams, and follows one of them in a chain."""

    depends_on_beam = True

    def __init__(self, *args, beam="right", **kwargs):
        super().__init__(*args, **kwargs)
        self.beam = beam

    @property
    def beam(self):
        """The beam that goes on in a chain, ``"right"`` or ``"left"``."""
        return self._beam

    @beam.setter
    def beam(self, value):
        if value not in BEAMS:
            raise ParameterError(f"beam = {value!r}; allowed are {sorted(BEAMS)}")
        self._beam = value

    def _settings(self):
        return super()._settings() | {"beam": self.beam}


class WollastonPrism(_BeamOptic):
    r"""
    Wollaston prism: two beams of opposite linear polarization.

    .. math:: M = \tfrac{1}{2}\begin{pmatrix}1&\pm\eta&0&0\\ \pm\eta&1&0&0\\
              0&0&0&0\\0&0&0&0\end{pmatrix}

    The right beam is ordinary (:math:`+\eta`), the left extraordinary
    (:math:`-\eta`); paper, Eq. for :math:`M_\mathrm{Wol}`.

    Parameters
    ----------
    efficiency : float or array_like
        Modulation efficiency :math:`|\eta|`, between 0 and 1.
    beam : {"right", "left"}
        The beam that goes on in a chain; `beams` gives both.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import WollastonPrism
    >>> wollaston = WollastonPrism(efficiency=0.99, name="wollaston")
    >>> right, left = wollaston.beams(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(right[1]), 4), round(float(left[1]), 4)
    (0.995, 0.005)
    """

    splits_light = True

    efficiency = Parameter(default=1.0, bounds=(0, 1), description="modulation efficiency")

    def _matrix(self, dispersion, efficiency):
        out = blank(efficiency)
        # half of unpolarized light goes into each beam
        out[..., 0, 0] = out[..., 1, 1] = 0.5
        out[..., 0, 1] = out[..., 1, 0] = 0.5 * BEAMS[self._beam] * efficiency
        return out

    def _derivatives(self, dispersion, efficiency):
        out = blank(efficiency)
        out[..., 0, 1] = out[..., 1, 0] = 0.5 * BEAMS[self._beam]
        return (out,)

    def beams(self, wavelength, I, Q, U, V):  # noqa: E741
        """
        Return the light of both beams.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength.
        I, Q, U, V : float or `~numpy.ndarray`
            The light that enters.

        Returns
        -------
        right, left : tuple
            ``(wavelength, I, Q, U, V)`` of each beam.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.optics import WollastonPrism
        >>> right, left = WollastonPrism().beams(1.6 * u.um, 1, -1, 0, 0)
        >>> float(right[1]), float(left[1])
        (0.0, 1.0)
        """
        return tuple(self._through(beam)(wavelength, I, Q, U, V) for beam in ("right", "left"))

    def _through(self, beam):
        # the optic in the chain keeps its own beam
        copy = self.copy()
        copy.beam = beam
        return copy


class BeamGain(_BeamOptic):
    r"""
    Unequal gains of the two beams: :math:`1 + g` for the right, :math:`1 - g` for the left.

    What is left of the flat field, or unequal transmission behind the beam
    splitter (Patat & Romaniello 2006, doi:10.1086/497581).

    Parameters
    ----------
    imbalance : float or array_like
        Half the relative difference g of the gains.
    beam : {"right", "left"}
        The beam that goes on in a chain.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> from astropolcal.optics import BeamGain
    >>> float(BeamGain(imbalance=0.01, beam="left").mueller()[0, 0])
    0.99
    """

    imbalance = Parameter(default=0.0, bounds=(-0.5, 0.5), description="half the gain difference")

    def _matrix(self, dispersion, imbalance):
        gain = 1.0 + BEAMS[self._beam] * np.asarray(imbalance)
        return gain[..., None, None] * np.eye(4)

    def _derivatives(self, dispersion, imbalance):
        sign = np.full(np.shape(imbalance), BEAMS[self._beam])
        return (sign[..., None, None] * np.eye(4),)
