# Licensed under a 3-clause BSD style license - see LICENSE
"""Frames of a table that make one datum: pairs, and pairs in both states of a modulator."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ObservationError
from astropolcal.observations.coordinates import clock
from astropolcal.observations.pairing import pair_frames, pair_states, quadruples
from astropolcal.units import angle_to_rad
from astropolcal.words import counted

__all__ = ["FrameGroups"]


class FrameGroups:
    """
    The groups of frames of a table, found once.

    Parameters
    ----------
    observations : Observations
        The table.
    rows : sequence of int, optional
        The row of the file each frame starts in, for messages.
    label : str
        What messages call the table.

    Examples
    --------
    >>> from astropolcal.observations import Observations, example_table
    >>> from astropolcal.observations.groups import FrameGroups
    >>> FrameGroups(Observations.from_table(example_table())).pairs().tolist()
    [[0, 2], [1, 3]]
    """

    def __init__(self, observations, rows=None, label="table"):
        self._observations = observations
        self._names = {"rows": rows, "name": label}
        self._found = {}

    def pairs(self, tolerance=0.3 * u.deg, derotator_tolerance=0.5 * u.deg, share=False):
        """
        Return frame indices of pairs, shape (P, 2).

        Parameters
        ----------
        tolerance, derotator_tolerance : `~astropy.units.Quantity`
            Largest differences that still count as the same angle.
        share : bool
            Whether a frame left over may be paired with one that is already used.

        Returns
        -------
        `~numpy.ndarray` of int
            Read only.

        Raises
        ------
        ObservationError
            If an angle or a state has no partner, or nothing can be paired.
        """
        states = self._observations.pairing == "flc_state"
        find = self._find_states if states else self._find_pairs
        return self._kept(find, tolerance, derotator_tolerance, share)

    def quadruples(self, tolerance=0.3 * u.deg, derotator_tolerance=0.5 * u.deg, share=False):
        """
        Return frame indices of pairs in both states of a modulator, shape (Q, 4).

        Parameters
        ----------
        tolerance, derotator_tolerance, share
            As for `pairs`.

        Returns
        -------
        `~numpy.ndarray` of int
            State A and B at the plus angle, then at the minus angle; read only.

        Raises
        ------
        ObservationError
            If an angle or a state has no partner, or nothing can be paired.
        """
        return self._kept(self._find_quadruples, tolerance, derotator_tolerance, share)

    def _kept(self, find, tolerance, derotator_tolerance, share):
        angles = (tolerance, derotator_tolerance)
        # in radian, so that 30 arcmin and 0.5 deg are one entry
        key = (find.__name__, *(float(angle_to_rad(a, "tolerance")) for a in angles), bool(share))
        if key not in self._found:
            limits = dict(zip(("tolerance", "derotator_tolerance"), key[1:3] * u.rad, strict=True))
            found = find(share=key[3], **limits)
            # everybody gets the same array
            found.flags.writeable = False
            self._found[key] = found
        return self._found[key]

    @property
    def _angles(self):
        return tuple(self._observations.position(name) * u.rad for name in ("hwp", "derotator"))

    def _labels(self):
        return np.asarray(self._observations.frames["frame"]).tolist()

    def _find_pairs(self, **limits):
        frames = self._observations.frames
        # the plate cancels what stands still: both frames must be in one state
        state = np.asarray(frames["flc_state"]) if "flc_state" in frames.colnames else None
        names = self._names | {"labels": self._labels()}
        return self._some(pair_frames(*self._angles, state, clock(frames), **names, **limits))

    def _find_states(self, **limits):
        observations = self._observations
        state, time = observations.position("flc_state"), clock(observations.frames)
        return pair_states(state, *self._angles, time, **self._names, **limits)

    def _find_quadruples(self, **limits):
        time = clock(self._observations.frames)
        names = self._names | {"labels": self._labels()}
        # states first: they alternate within an exposure and so share its atmosphere
        states = self._find_states(**limits)
        return self._some(quadruples(states, *self._angles, time, **names, **limits))

    def _some(self, groups):
        if not len(groups):
            n = self._observations.n_frames
            raise ObservationError(
                f"{self._names['name']}: none of its {counted(n, 'frame')} can be paired; two "
                "frames 45 deg of half-wave plate apart at the same derotator angle are needed"
            )
        return groups
