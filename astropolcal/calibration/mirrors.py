# Licensed under a 3-clause BSD style license - see LICENSE
"""
Discrete mirror solutions: other values that give exactly the same data.

Each candidate is tried on the measurement and counts only if it predicts the
same data and stays within the bounds.
"""

import numpy as np

from astropolcal.chain import leaves
from astropolcal.optics import EllipticalRetarder, LinearRetarder

__all__ = ["mirror_solutions"]

# far below any noise, far above rounding: a mirror solution is exact or it is none
_SAME = 1e-9


def mirror_solutions(measurement, vector):
    """
    Return the mirror solutions of a fit, in words.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : `~numpy.ndarray`
        The solution, canonical values, shape (n_free,).

    Returns
    -------
    list of str
        One sentence a mirror solution within the bounds.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import mirror_solutions
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain()
    >>> frames = half_wave_plate_cycles(derotator=[45, 60] * u.deg)
    >>> measurement = Measurement(chain, simulate(chain, charis.wavelength, frames, seed=1))
    >>> mirror_solutions(measurement, measurement.vector())[0][:43]
    'derotator: a retardance d (length |d|) and '
    """
    retarders = _retarders(measurement)
    candidates = [
        (
            f"{name}: a retardance d (length |d|) and d (1 - 360 deg / |d|) are the same optic",
            {name: _other_turn},
        )
        for name in retarders
    ]
    if retarders:
        flip = dict.fromkeys(retarders, _other_hand)
        candidates.append(
            (
                f"{', '.join(retarders)}: all retardances with the other sign (circular ones keep "
                "theirs) give the same data",
                flip,
            )
        )
    return [words for words, edits in candidates if _is_mirror(measurement, vector, edits)]


def _retarders(measurement):
    """Return the free retarders by name, with the slots of their retardances."""
    found = {}
    for chain in measurement.chains:
        for leaf in leaves(chain):
            if isinstance(leaf, (LinearRetarder, EllipticalRetarder)):
                # with one component held the others cannot go to the mirror solution
                slots = [measurement.free.by_name.get(f"{leaf.name}.{k}") for k in leaf.own_names]
                if all(slot is not None for slot in slots):
                    found[leaf.name] = slots
    return found


def _is_mirror(measurement, vector, edits):
    slots = _retarders(measurement)
    other = np.array(vector, dtype=float)
    for name, edit in edits.items():
        changed = edit(np.array([vector[slot.slice] for slot in slots[name]]))
        for slot, values in zip(slots[name], changed, strict=True):
            other[slot.slice] = values
    low, high = measurement.free.bounds()
    inside = np.all((other >= low) & (other <= high))
    moved = not np.allclose(other, vector)
    same = np.abs(measurement.predict(other) - measurement.predict(vector)).max() < _SAME
    return bool(inside and moved and same)


def _other_turn(retardance):
    """Turn the other way round the same axis; shape (1 or 3, n)."""
    length = np.linalg.norm(retardance, axis=0)
    # turning by d about an axis is turning by d - 360 deg about it
    safe = np.where(length > 0, length, 1.0)
    return retardance * np.where(length > 0, 1 - 2 * np.pi / safe, 1.0)


def _other_hand(retardance):
    """Change the sign of V before and behind."""
    # V -> -V is a reflection of the Poincare sphere: it turns round rotations about axes in the
    # equator (linear retardance), and leaves those about the axis of V
    return retardance * np.array([-1.0, -1.0, 1.0])[: len(retardance), None]
