# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that split the light into two beams."""

from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.optics.core import Optic, blank

__all__ = ["WollastonPrism"]

BEAMS = {"right": 1.0, "left": -1.0}


class WollastonPrism(Optic):
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

    efficiency = Parameter(default=1.0, bounds=(0, 1), description="modulation efficiency")

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

    def _matrix(self, dispersion, efficiency):
        out = blank(efficiency)
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
        copy = self.copy()
        copy.beam = beam
        return copy
