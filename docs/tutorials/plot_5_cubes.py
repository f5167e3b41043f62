# Licensed under a 3-clause BSD style license - see LICENSE
"""
5. From FITS cubes to Stokes parameters
=======================================

A complete reduction: image cubes of a lamp become a table of fluxes and a calibration; cubes of a
star become its Stokes parameters, with errors. The cubes are simulated, because no real ones come
with the package; the steps are those for real ones. With a folder of real tables, these take the
place of the reduced cubes.
"""

# %%
# Cubes of a lamp
# ---------------
#
# The truth is the published instrument with a thicker layer of quartz in its half-wave plate.
# Cubes and the headers of raw frames are written as the instrument writes them.

import os
import tempfile
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Observations, calibrate, instruments
from astropolcal.measurement import parameter_table
from astropolcal.optics import PolarizedSource
from astropolcal.plotting.reduction import plot_apertures
from astropolcal.reduction import DetectorModel, ImageModel, reduce_run, simulate_cubes
from astropolcal.simulation import half_wave_plate_cycles

charis = instruments.get("charis")
truth = charis.published()
truth["hwp"].w_sio2 = 1.66 * u.mm
scratch = tempfile.TemporaryDirectory()
folder = os.environ.get("ASTROPOLCAL_DATA")

CYCLE = [0, 45, 22.5, 67.5] * u.deg
frames = half_wave_plate_cycles(CYCLE, [50, 70, 95] * u.deg)
place = Path(scratch.name) / "lamp"
bad = DetectorModel(bad_pixels=1e-3)
cubes = simulate_cubes(place, truth, charis, frames, flux=4e6, detector=bad, seed=2)
print(len(cubes), "cubes")

# %%
# From cubes to a table
# ---------------------
#
# ``reduce_run`` sums the light in a rectangle in each beam, with errors, and looks up the angles
# in the headers. ``problems`` lists the files that could not be used.

lamp = reduce_run(cubes, charis, source="internal", raw=place / "raw")
print(lamp.observations)
print("problems:", lamp.problems)
figure = plt.figure(figsize=(11, 8))
plot_apertures(lamp, frames=[0, 1], wavelength=9, figure=figure)

# %%
# Calibrate
# ---------
#
# So few frames do not determine angles and efficiencies in addition to the thicknesses; these are
# held. The residuals of a real table contain errors of the model, which its photon noise does not
# include: there the residuals give the weights, and the result is compared with the published
# thickness.

if folder:
    path = next(Path(folder).rglob("dataset3_polarized*.ecsv"))
    observations, weights = charis.prepare(Observations.read(path)), "wavelength"
    known = charis.published()["hwp"].w_sio2.quantity
else:
    observations, weights = lamp.observations, "errors"
    known = truth["hwp"].w_sio2.quantity

held = dict.fromkeys(["hwp.theta", "derotator.theta", "wollaston.efficiency"])
calibration = calibrate(
    charis.published(),
    observations,
    instrument="charis",
    fix=held,
    weights=weights,
    cross_validate=False,
)
quartz = calibration.chain["hwp"].w_sio2.quantity
error = calibration.covariance.std("hwp.w_sio2")
print(f"quartz: {quartz:.5f} +- {error:.5f}; {'published' if folder else 'simulated'}: {known}")

# %%
# Cubes of a star
# ---------------
#
# The star is polarized by 1 %. The telescope is upstream of the calibrated optics, with the
# published law of its tertiary mirror, and the half-wave plate follows the sky.


def on_sky(chain, q, u):
    """Return the chain of a star with these Stokes parameters at every wavelength."""
    source = PolarizedSource(q=np.full(22, q), u=np.full(22, u), name="star")
    return source | charis.on_sky(chain)


Q, U = 0.008, -0.006
frames = half_wave_plate_cycles(CYCLE, [97, 97] * u.deg)
frames["parallactic"] = np.linspace(24, 30, len(frames)) * u.deg
frames["altitude"] = np.linspace(67, 64, len(frames)) * u.deg
place = Path(scratch.name) / "star"
cubes = simulate_cubes(
    place,
    on_sky(truth, Q, U),
    charis,
    frames,
    source="star",
    flux=2e6,
    image=ImageModel(halo=0.1, motion=1.0, seeing=0.05),
    detector=DetectorModel(background=2.0),
    seed=3,
)
star = reduce_run(cubes, charis, source="star", raw=place / "raw")
print(star.observations)
figure = plt.figure(figsize=(11, 8))
plot_apertures(star, frames=[0, 1], wavelength=9, figure=figure)

# %%
# Its Stokes parameters
# ---------------------
#
# With the calibrated instrument and the telescope held, only q and u of the star are free. With the
# real tables the star is the unpolarized standard HD 293396, whose q and u should be zero.

if folder:
    path = next(Path(folder).rglob("hd293396*.ecsv"))
    observations, expected = charis.prepare(Observations.read(path)), (0, 0)
else:
    observations, expected = star.observations, (Q, U)

sky = on_sky(calibration.chain, 0, 0)
sky["star"].q.fixed = sky["star"].u.fixed = False
held = dict.fromkeys(n for n in parameter_table([sky]) if not n.startswith("star."))
fit = calibrate(sky, observations, fix=held, weights=weights, cross_validate=False)

figure, axis = plt.subplots(figsize=(9, 4.8), layout="constrained")
nm = charis.wavelength.to_value(u.nm)
looks = (("q", "#0072B2", "o"), ("u", "#D55E00", "s"))
for (name, color, marker), true in zip(looks, expected, strict=True):
    value = 100 * getattr(fit.chain["star"], name).value
    errors = [100 * float(fit.covariance.std(f"star.{name}[{i}]")) for i in range(nm.size)]
    axis.errorbar(nm, value, errors, color=color, marker=marker, ls="", capsize=2.5, label=name)
    axis.axhline(100 * true, color=color, ls="--", lw=1)
axis.set(xlabel="wavelength (nm)", ylabel="q, u (%)")
axis.set_title(f"Points: found. Dashed: {'expected' if folder else 'put in'}.")
axis.legend(frameon=False, ncols=2)
scratch.cleanup()
