# Licensed under a 3-clause BSD style license - see LICENSE
"""
4. Correct a disk
=================

A star with a polarized disk, seen through the telescope and an instrument that turns linear into
circular polarization. What a double difference makes of it, and what the calibration gives back.
"""

# %%
# The scene
# ---------
#
# The scene is a ring of scattered light, polarized by up to 40 % across the direction to the star.
# The instrument is the published one, with the telescope upstream of it. With a folder of real
# tables it is the one that they calibrate, and the telescope points where it pointed in a real
# night.

import os
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Observations, calibrate, instruments
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.plotting.correction import plot_images

charis = instruments.get("charis")
folder = os.environ.get("ASTROPOLCAL_DATA")
if folder:
    names = ("dataset3_polarized", "hd293396")
    lamp, star = (Observations.read(next(Path(folder).rglob(f"{name}*.ecsv"))) for name in names)
    chains = charis.chains_for([lamp])
    bench = calibrate(chains, lamp, instrument="charis", cross_validate=False).chain
else:
    bench = charis.published()
chain = charis.on_sky(bench)
bins = [2, 9, 16]
wavelength = charis.wavelength

rows, columns = np.indices((51, 51)) - 25
radius, angle = np.hypot(rows, columns), np.arctan2(-columns, rows)
ring = 400 * np.exp(-0.5 * ((radius - 15) / 2) ** 2) * (1 + 0.5 * np.cos(angle - 0.8))
light = 500 + 4000 * np.exp(-0.5 * (radius / 2) ** 2) + ring
polarized = 0.4 * ring
scene = np.stack([light, -polarized * np.cos(2 * angle), -polarized * np.sin(2 * angle)])

# %%
# Sixteen frames, four cycles of the half-wave plate, while the field turns and the derotator
# keeps it upright.

n = 16
commanded = np.resize([0, 45, 22.5, 67.5], n) * u.deg
if folder:
    # frames of the whole night, so that the field turns as far as it did
    taken = np.linspace(0, star.n_frames - 1, n).astype(int)
    names = ("parallactic", "altitude", "derotator")
    parallactic, altitude, derotator = (star.position(name)[taken] * u.rad for name in names)
else:
    parallactic, altitude = np.linspace(-30, 40, n) * u.deg, np.linspace(60, 75, n) * u.deg
    derotator = np.linspace(55, 80, n) * u.deg
positions = {
    "hwp": commanded + 0.5 * parallactic + altitude,
    "derotator": derotator,
    "parallactic": parallactic,
    "altitude": altitude,
}
matrix = measurement_rows(chain, positions, wavelength)[..., :3]
beams = np.einsum("bwfs,syx->bfwyx", matrix, scene)
noisy = np.random.default_rng(1).poisson(beams)
frames = ScienceFrames.from_arrays(
    *noisy,
    wavelength,
    positions,
    variance_right=beams[0],
    variance_left=beams[1],
    hwp=commanded,
    position_angle=np.zeros(n) * u.deg,
    pixel_scale=16.2,
)

# %%
# Three ways to reduce it
# -----------------------
#
# ``mode="ip"`` takes the instrument as ideal except for the polarization that it adds to
# unpolarized light, as a reduction without a calibration of the retardances does. ``mode="stokes"``
# inverts the whole chain.

full = correct(chain, frames)
plain = correct(chain, frames, mode="ip")

truth = np.hypot(scene[1], scene[2])
bright = truth > 0.5 * truth.max()
for name, image in (("without crosstalk", plain), ("with the whole chain", full)):
    found = np.hypot(image["Q"], image["U"])
    share = [np.sum(found[b][bright]) / np.sum(truth[bright]) for b in bins]
    at = [f"{wavelength[b].to_value(u.nm):.0f} nm" for b in bins]
    words = ", ".join(f"{s:.2f} at {nm}" for s, nm in zip(share, at, strict=True))
    print(f"{name}: {words} of the polarized light of the ring")

# %%
# The degree of polarization is not the only error. Rotated polarization moves from
# :math:`Q_\phi` to :math:`U_\phi`, where an observer looks for multiple scattering.

figure, axes = plt.subplots(2, 3, figsize=(11, 7), layout="constrained", sharex=True, sharey=True)
limit = truth.max()
titles = ("instrument taken for ideal", "corrected")
for row, title, image in zip(axes, titles, (plain, full), strict=True):
    for axis, b in zip(row, bins, strict=True):
        u_phi = image["Q"][b] * np.sin(2 * angle) - image["U"][b] * np.cos(2 * angle)
        drawn = axis.imshow(u_phi, origin="lower", cmap="PuOr", vmin=-limit, vmax=limit)
        axis.set_title(f"{title}, {wavelength[b].to_value(u.nm):.0f} nm", fontsize=10)
figure.supxlabel("x (pixel)")
figure.supylabel("y (pixel)")
figure.colorbar(drawn, ax=axes, label=r"$U_\phi$ (photons); the ring has none", shrink=0.8)

# %%
# The product
# -----------
#
# Images of I, Q, U, :math:`Q_\phi`, :math:`U_\phi` and the error of Q. ``full.write("disk.fits")``
# writes them with their covariances, statistical and systematic.

figure = plt.figure(figsize=(12.5, 8.2))
plot_images(full, figure=figure)

# %%
# The condition of the inversion depends on the retardance of the derotator and so on wavelength.
# It is 1.4 for an ideal instrument.

figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
axis.plot(wavelength.to_value(u.nm), full.condition, "o-", color="#0072B2")
axis.axhline(np.sqrt(2), color="0.5", ls="--", label="ideal instrument")
axis.set(xlabel="wavelength (nm)", ylabel="condition of the inversion")
axis.legend(frameon=False)
