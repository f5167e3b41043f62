# Licensed under a 3-clause BSD style license - see LICENSE
"""Small simulated stars, for the tests of effects on sky."""

import astropy.units as u
import numpy as np

from astropolcal.chain import join, leaves
from astropolcal.simulation import half_wave_plate_cycles


def sky_track(n_cycles, parallactic=(-40, 40), altitude=(55, 68)):
    """Frames of a star; the angle of the plate is the true one, that follows the sky."""
    table = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.zeros(n_cycles) * u.deg)
    table["parallactic"] = np.linspace(*parallactic, len(table)) * u.deg
    table["altitude"] = np.linspace(*altitude, len(table)) * u.deg
    table["derotator"] = 0.5 * table["altitude"] + 63.5 * u.deg
    table["hwp"] = table["hwp"] + 0.5 * table["parallactic"] + table["altitude"]
    return table


def held(chain, without=(), free=()):
    """Return the chain with everything held but some optics, and some taken out."""
    train = [leaf.copy() for leaf in leaves(chain) if leaf.name not in without]
    for leaf in train:
        for key in leaf.param_names:
            getattr(leaf, key).fixed = leaf.name not in free or key == "theta"
    return join(train)
