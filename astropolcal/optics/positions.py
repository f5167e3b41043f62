# Licensed under a 3-clause BSD style license - see LICENSE
"""Where optics stand: angles of stages, and the numbers that stand for them elsewhere."""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad, to_unit

__all__ = ["COORDINATES", "FLUXES", "MOVES", "RATES"]

#: Positions that differ between wavelengths and beams: the flux of the beam, and that flux
#: over the one in the frame before.
FLUXES = ("flux", "total_flux", "previous_flux")

#: By how much an angle changes from one frame to the next.
RATES = ("parallactic_rate", "derotator_rate")

#: The last move of a stage: 1 where it went backwards, else 0; and how far, in radian.
MOVES = tuple(f"{stage}_{what}" for stage in ("hwp", "derotator") for what in ("direction", "move"))

#: Positions that are numbers, not angles: how far the run has come (0 to 1), the state of a
#: modulator (0 or 1), the number of the frame, the change of an angle from frame to frame, the
#: last moves of the stages, and the fluxes.
COORDINATES = ("sequence", "flc_state", "frame", *RATES, *MOVES, *FLUXES)


def finite_position(value, name, stage=None):
    """Return the position of a stage in radian, or as a number; refuse what is not finite."""
    number = (stage or name) in COORDINATES
    position = to_unit(value, None, name) if number else angle_to_rad(value, name)
    if not np.all(np.isfinite(position)):
        raise ParameterError(f"{name} = {value} must be finite")
    return position


def check_broadcast(wavelength, position):
    """Refuse positions and wavelengths that do not broadcast."""
    try:
        np.broadcast_shapes(np.shape(wavelength), np.shape(position))
    except ValueError:
        raise ParameterError(
            f"positions of shape {np.shape(position)} do not broadcast against wavelengths of "
            f"shape {np.shape(wavelength)}; give the positions the shape (n_frames, 1)"
        ) from None
