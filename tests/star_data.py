# Licensed under a 3-clause BSD style license - see LICENSE
"""A simulated star of CHARIS: its chain, its track and its table."""

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.observations import Observations
from astropolcal.optics import COORDINATES
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = [1200, 1600, 2200] * u.nm
META = {
    "instrument": "SCExAO/CHARIS",
    "nasmyth_beam_switcher": "installed",
    "yjh50_dichroic": "in",
}
_CRITICAL = [0, 45, 22.5, 67.5] * u.deg


def in_radian(positions):
    """Positions of an instrument with their unit, as users give them."""
    return {k: v if k in COORDINATES else v * u.rad for k, v in positions.items()}


def track(n_cycles, parallactic=(-40, 40), altitude=(55, 68)):
    """Frames of a star that rises, commanded and true plate angles included."""
    frames = half_wave_plate_cycles(_CRITICAL, np.zeros(n_cycles) * u.deg)
    n = len(frames)
    frames["parallactic"] = np.linspace(*parallactic, n) * u.deg
    frames["altitude"] = np.linspace(*altitude, n) * u.deg
    frames["derotator"] = 0.5 * frames["altitude"] + 63.5 * u.deg
    frames["commanded"] = frames["hwp"]
    frames["hwp"] = frames["hwp"] + 0.5 * frames["parallactic"] + frames["altitude"]
    return frames


def observe_star(
    chain, n_cycles=12, source="unpolarized standard star", wavelength=WAVELENGTH, **options
):
    """Simulate a star; the table has the commanded plate angles, as headers do."""
    span = {k: options.pop(k) for k in ("parallactic", "altitude") if k in options}
    frames = track(n_cycles, **span)
    meta = META | {"source": source, "object": options.pop("target", "HD 293396")}
    seen = simulate(chain, wavelength, frames, meta=meta, **options)
    table = seen.to_table()
    table["hwp"] = table["commanded"]
    table.remove_column("commanded")
    return Observations.from_table(table, name="star")


def star_chain(source="unpolarized standard star", **options):
    options = {"wavelength": WAVELENGTH} | options
    return CHARIS.chain(source, ["dichroic", "nbs"], **options)
