# Licensed under a 3-clause BSD style license - see LICENSE
"""How a detector is read out: gain, noise, and what electron multiplication adds to it."""

import math
from dataclasses import dataclass, replace

from astropolcal.exceptions import InstrumentError

__all__ = ["EM_EXCESS_NOISE", "ReadOut"]

#: By what factor a long multiplication register raises the photon noise.
EM_EXCESS_NOISE = math.sqrt(2)


@dataclass(frozen=True)
class ReadOut:
    """
    A way to read a detector out.

    Parameters
    ----------
    gain : float
        Electrons per adu.
    read_noise : float
        Of a pixel, electrons.
    saturation : float
        Value of a pixel, in adu, above which it is not linear.
    excess_noise : float
        Standard deviation of the signal over that of its photon noise; 1 without multiplication.

    Raises
    ------
    InstrumentError
        If a number is out of range.

    Notes
    -----
    In an EMCCD the number of electrons that leave the register for each that enters has a wide
    distribution, which raises the photon noise by a factor near the square root of 2 (Robbins &
    Hadwen 2003, IEEE Trans. Electron Devices 50, 1227, doi:10.1109/TED.2003.813462).

    Examples
    --------
    >>> from astropolcal.instruments.readout import ReadOut
    >>> ReadOut(gain=4.5, read_noise=90.0).multiplied(300).read_noise
    0.3
    """

    gain: float = 1.0
    read_noise: float = 0.0
    saturation: float = math.inf
    excess_noise: float = 1.0

    def __post_init__(self):
        positive = self.gain > 0 and self.saturation > 0
        if not (positive and self.read_noise >= 0 and self.excess_noise >= 1):
            raise InstrumentError(
                f"{self}: gain and saturation must be above zero, read_noise at least 0 and "
                "excess_noise at least 1"
            )

    def multiplied(self, em_gain):
        """
        Return gain and read noise in electrons before a multiplication.

        Parameters
        ----------
        em_gain : float
            Electrons that leave the register for each that enters.

        Returns
        -------
        ReadOut
        """
        return replace(self, gain=self.gain / em_gain, read_noise=self.read_noise / em_gain)
