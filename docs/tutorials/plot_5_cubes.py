# Licensed under a 3-clause BSD style license - see LICENSE
"""
5. From FITS cubes to Stokes parameters
=======================================

The whole way: image cubes of a lamp become a table of fluxes and a calibration; cubes of a star
become its Stokes parameters, with errors. The cubes are simulated, because no real ones come with
the package; the steps are those for real ones.
"""

# %%
# Cubes of a lamp
# ---------------
#
# The truth is the published instrument with a thicker layer of quartz in its half-wave plate.
# Cubes and the headers of raw frames are written as the instrument writes them.

import tempfile
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import calibrate, instruments
from astropolcal.chain import join, leaves
from astropolcal.measurement import parameter_table
from astropolcal.plotting.reduction import plot_apertures
from astropolcal.reduction import reduce_run
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.simulation import half_wave_plate_cycles

charis = instruments.get("charis")
truth = charis.published()
truth["hwp"].w_sio2 = 1.66 * u.mm
scratch = tempfile.TemporaryDirectory()
folder = Path(scratch.name)

CYCLE = [0, 45, 22.5, 67.5] * u.deg
frames = half_wave_plate_cycles(CYCLE, [50, 70, 95] * u.deg)
cubes = simulate_cubes(folder / "lamp", truth, charis, frames, flux=4e6, bad_pixels=1e-3, seed=2)
print(len(cubes), "cubes")

# %%
# From cubes to a table
# ---------------------
#
# ``reduce_run`` sums the light in a rectangle in each beam, with errors, and looks up the angles
# in the headers. ``problems`` lists the files that could not be used.

lamp = reduce_run(cubes, charis, source="internal", raw=folder / "lamp" / "raw")
print(lamp.observations)
print("problems:", lamp.problems)
figure = plt.figure(figsize=(11, 8))
plot_apertures(lamp, frames=[0, 1], wavelength=9, figure=figure)

# %%
# Calibrate
# ---------
#
# So few frames do not determine angles and efficiencies beside the thicknesses; these are held.

held = dict.fromkeys(["hwp.theta", "derotator.theta", "wollaston.efficiency"])
calibration = calibrate(
    charis.published(),
    lamp.observations,
    instrument="charis",
    fix=held,
    weights="errors",
    cross_validate=False,
)
quartz = calibration.chain["hwp"].w_sio2.quantity
error = calibration.covariance.std("hwp.w_sio2")
print(f"quartz: {quartz:.5f} +- {error:.5f}; simulated with {truth['hwp'].w_sio2.quantity}")

# %%
# Cubes of a star
# ---------------
#
# The star is polarized by 1 %. The telescope stands in front of the optics that were calibrated,
# and the half-wave plate follows the sky.

star_chain = charis.chain("star")
telescope = leaves(star_chain)[: star_chain.submodel_names.index("hwp")]
true_sky = join([*telescope, *leaves(truth)[1:]])
true_sky["star"].q, true_sky["star"].u = np.full(22, 0.008), np.full(22, -0.006)
frames = half_wave_plate_cycles(CYCLE, [97, 97] * u.deg)
frames["parallactic"] = np.linspace(24, 30, len(frames)) * u.deg
frames["altitude"] = np.linspace(67, 64, len(frames)) * u.deg
cubes = simulate_cubes(
    folder / "star",
    true_sky,
    charis,
    frames,
    source="star",
    flux=2e6,
    halo=0.1,
    motion=1.0,
    seeing=0.05,
    background=2.0,
    seed=3,
)
star = reduce_run(cubes, charis, source="star", raw=folder / "star" / "raw")
print(star.observations)
figure = plt.figure(figsize=(11, 8))
plot_apertures(star, frames=[0, 1], wavelength=9, figure=figure)

# %%
# Its Stokes parameters
# ---------------------
#
# With the calibrated instrument and the telescope held, q and u of the star are all that is free.

sky = join([*telescope, *leaves(calibration.chain)[1:]])
held = dict.fromkeys(n for n in parameter_table([sky]) if not n.startswith("star."))
fit = calibrate(sky, star.observations, fix=held, weights="errors", cross_validate=False)

figure, axis = plt.subplots(figsize=(9, 4.8), layout="constrained")
nm = charis.wavelength.to_value(u.nm)
looks = (("q", 0.008, "#0072B2", "o"), ("u", -0.006, "#D55E00", "s"))
for name, true, color, marker in looks:
    value = 100 * getattr(fit.chain["star"], name).value
    errors = [100 * float(fit.covariance.std(f"star.{name}[{i}]")) for i in range(nm.size)]
    axis.errorbar(nm, value, errors, color=color, marker=marker, ls="", capsize=2.5, label=name)
    axis.axhline(100 * true, color=color, ls="--", lw=1)
axis.set(xlabel="wavelength (nm)", ylabel="q, u (%)")
axis.set_title("Points: found in the cubes. Dashed: put in.")
axis.legend(frameon=False, ncols=2)
scratch.cleanup()
