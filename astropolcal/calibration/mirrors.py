# Licensed under a 3-clause BSD style license - see LICENSE
"""
Discrete mirror solutions: other values that give exactly the same data.

Each candidate is tried on the measurement and counts only if it predicts the
same data and stays within the bounds. What the bounds, or the model of an optic,
exclude may be the truth all the same: it is told where it matters on sky.
"""

import astropy.units as u
import numpy as np

from astropolcal.calibration._settling import star_words
from astropolcal.calibration._sky_view import LEFT_OUT
from astropolcal.calibration._system import split_chain
from astropolcal.calibration.sky import consequences_of, matters, sky_words
from astropolcal.chain import join, leaves, stages, system_mueller
from astropolcal.instruments.base import without_nuisance
from astropolcal.optics import COORDINATES, EllipticalRetarder, LinearRetarder, MuellerElement

__all__ = ["mirror_solutions"]

# far below any noise, far above rounding: a mirror solution is exact or it is none
_SAME = 1e-9
# frames of a long table in which the light is looked at
_FEW = 64
_SAME_DATA = "all retardances with the other sign (circular ones keep theirs) give the same data"


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
    return [branch["words"] for branch in _within_bounds(measurement, vector)]


def mirror_branches(measurement, vector, view):
    """
    Return the mirror solutions with what they do on sky.

    Dicts with ``words``, and ``sky`` as in `sky_consequences`, None without a view of the sky;
    with them the other hand of the whole instrument, if only bounds or models exclude it and it
    matters on sky.
    """
    branches = _within_bounds(measurement, vector)
    for branch in branches:
        other = branch.pop("vector")
        chains = None if view is None else measurement.put_back(other)
        branch["sky"] = view and consequences_of(view, view.with_optics_of(chains))
    if not any(_SAME_DATA in branch["words"] for branch in branches):
        branches += _other_instrument(measurement, vector, view)
    for branch in branches:
        if branch["sky"] is not None and matters(branch["sky"]):
            branch["words"] += (
                f"; WARNING: if the other one is true, {sky_words(branch['sky'])}; "
                f"{star_words(view.site)} tells them apart"
            )
    return branches


def _other_instrument(measurement, vector, view):
    """Return the other hand of all behind the telescope, if it matters and no datum tells it."""
    if view is None or view.telescope == LEFT_OUT or _knows_hand(measurement, vector):
        return []
    telescope, instrument = split_chain(view.chain)
    # V -> -V in front of everything behind it: the fluxes are of I alone, and have no hand
    turned = MuellerElement.from_matrix(np.diag([1.0, 1.0, 1.0, -1.0]), name="other_hand")
    sky = consequences_of(view, join([*telescope, turned, *instrument]))
    words = f"behind the telescope: {_SAME_DATA}, only bounds or models exclude them"
    return [{"words": words, "sky": sky}] if matters(sky) else []


def _knows_hand(measurement, vector):
    """Return whether circularly polarized light enters the instrument in some dataset."""
    lam = measurement.wavelength * u.um
    for chain, dataset in zip(measurement.put_back(vector), measurement.datasets, strict=True):
        front, _ = split_chain(without_nuisance(chain))
        if not front:
            continue
        source = join(front)
        step = max(1, dataset.frames.shape[0] // _FEW)
        positions = {
            stage: 0.0 * u.one
            if stage in COORDINATES
            else dataset.positions[stage][:, ::step].ravel() * u.rad
            for stage in stages(source)
        }
        light = system_mueller(source, lam, positions)[..., :, 0]
        if np.abs(light[..., 3]).max() > _SAME * np.abs(light[..., 0]).max():
            return True
    return False


def _within_bounds(measurement, vector):
    """Return words and values of the mirror solutions within the bounds."""
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
        candidates.append((f"{', '.join(retarders)}: {_SAME_DATA}", flip))
    others = [(words, _mirrored(measurement, vector, edits)) for words, edits in candidates]
    return [{"words": words, "vector": other} for words, other in others if other is not None]


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


def _mirrored(measurement, vector, edits):
    """Return the values of a mirror solution, None if it is none."""
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
    return other if inside and moved and same else None


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
