# Licensed under a 3-clause BSD style license - see LICENSE
"""
Positions at which a frame was taken: angles of stages, and what else optics and laws depend on.
"""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.units import mjd_of, to_unit

__all__ = ["COORDINATES"]

#: Positions that differ between wavelengths and beams: the flux of the beam, and that flux
#: over the one in the frame before.
FLUXES = ("flux", "total_flux", "previous_flux")

#: What stands behind the name of a stage for its last move: 1 where it went backwards, else 0; how
#: far, and how far the next one goes, in radian, or the last or next few with their number behind;
#: by how much it changes from frame to frame; how far its angle is from that which the frame would
#: have if each of its cycles came in reverse order.
MOVES = ("_direction", "_move", "_next", "_rate", "_reversed")


#: What laws of parameters depend on beside the stages, with its unit: the moment as Modified
#: Julian Date (UTC), and the place in the field.
PLACES = {"time": u.day, "x": u.arcsec, "y": u.arcsec}


def counted(name):
    """Return the name of a move without its number, and that, as of ``"hwp_move2"``; 1 without."""
    word = name.rstrip("0123456789")
    return word, int(name[len(word) :] or 1)


def is_move(name):
    """Return whether a position is a move of a stage, or several, as ``"hwp_move2"``."""
    return name.rstrip("0123456789").endswith(MOVES)


class _Coordinates(tuple):
    """Names of positions that are numbers, also ``PLACES``, ``"COLUMN=STATE"``, moves of stages."""

    __slots__ = ()

    def __contains__(self, name):
        known = tuple.__contains__(self, name) or name in PLACES
        return known or (isinstance(name, str) and ("=" in name or is_move(name)))


#: Positions that are numbers, not angles: how far the run has come (0 to 1), the state of a
#: modulator (0 or 1), the number of the frame, the change of an angle from frame to frame and the
#: last moves of stages (those of ``hwp`` and ``derotator``, and ``"STAGE_direction"`` and so on of
#: any other), the fluxes, and the brightness of a frame against the mean of its table; and
#: ``"COLUMN=STATE"``, 1 in the frames whose column has that state and 0 in the others. Laws of
#: parameters also take ``"time"``, a Modified Julian Date or `~astropy.time.Time`, and ``"x"`` and
#: ``"y"``, the place in the field in arcsec.
COORDINATES = _Coordinates(
    (
        *("sequence", "flc_state", "frame", "parallactic_rate", "brightness"),
        *FLUXES,
        *(f"{stage}{what}" for stage in ("hwp", "derotator") for what in MOVES),
    )
)


def finite_position(value, name, stage=None):
    """Return the position of a stage in radian, or a number; refuse what cannot be."""
    stage = stage or name
    if stage == "time":
        return mjd_of(value, name)
    position = to_unit(value, PLACES.get(stage) if stage in COORDINATES else u.rad, name)
    if not np.all(np.isfinite(position)):
        raise ParameterError(f"{name} = {value} must be finite")
    if stage == "altitude" and position.size:
        worst = np.rad2deg(position.flat[np.argmax(np.abs(position - np.pi / 4))])
        # beyond the zenith by a rounding error is allowed
        if not 0 < worst <= 90 + 1e-7:
            raise ObservationError(f"altitude = {worst:.4g} deg; allowed is above 0 to 90 deg")
    return position
