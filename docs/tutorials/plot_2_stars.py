# Licensed under a 3-clause BSD style license - see LICENSE
"""
2. Lamps and stars in one fit
=============================

The light of a lamp does not pass the telescope. An unpolarized star shows the polarization that the
tertiary mirror adds, and a lamp without polarizer what the fold mirror does. All three are fitted
together here, so that the covariance of one calibration knows about all of them.
"""

# %%
# Three datasets
# --------------
#
# Without a folder of tables they are simulated: the published instrument, a fold mirror of 1.2 to
# 0.8 % and a tertiary mirror of 1.7 to 1.2 % diattenuation, at six of the 22 wavelengths.

import os
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Observations, calibrate, instruments
from astropolcal.calibration.validation import star_accuracy, star_stokes
from astropolcal.plotting import plot_double_differences, plot_mirrors, plot_target_accuracy
from astropolcal.simulation import half_wave_plate_cycles, simulate

charis = instruments.get("charis")
SOURCES = ("polarized", "unpolarized", "unpolarized standard star")


def simulated():
    """Return a polarized lamp, an unpolarized lamp and an unpolarized star."""
    wavelength = charis.wavelength[[1, 4, 8, 11, 15, 19]]
    trend = np.linspace(1, 0, wavelength.size)
    options = {"wavelength": wavelength, "derotator": "linear"}
    chains = [charis.chain(source, ["dichroic", "nbs"], **options) for source in SOURCES]
    chains[1]["fold_mirror"].diattenuation = 0.008 + 0.004 * trend
    chains[2]["m3"].diattenuation = 0.012 + 0.005 * trend
    lamp = half_wave_plate_cycles(derotator=[45, 57.5, 70, 95, 120] * u.deg)
    night = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.zeros(14) * u.deg)
    n = len(night)
    night["parallactic"], night["altitude"] = np.linspace([20, 67], [45, 61], n).T * u.deg
    night["derotator"] = 0.5 * night["altitude"] + 63.5 * u.deg
    # the plate follows the sky: the header has the angle that was asked for, and the true one
    night["hwp_true"] = night["hwp"] + 0.5 * night["parallactic"] + night["altitude"]
    meta = charis.published_meta()
    return [
        simulate(
            chain,
            wavelength,
            frames,
            flux=flux,
            seed=i,
            meta=meta | {"source": source},
            name=source,
        )
        for i, (chain, frames, flux, source) in enumerate(
            zip(chains, (lamp, lamp, night), (4e6, 4e6, 1e6), SOURCES, strict=True)
        )
    ]


folder = os.environ.get("ASTROPOLCAL_DATA")
if folder:
    names = ("dataset3_polarized", "dataset4_unpolarized", "hd293396")
    data = [Observations.read(next(Path(folder).rglob(f"{name}*.ecsv"))) for name in names]
    options = {}
else:
    data, options = simulated(), {"derotator": "linear"}
for dataset in data:
    print(dataset)

# %%
# Frames that cannot be used
# --------------------------
#
# ``prepare`` masks frames of incomplete cycles and those taken while the lamp warmed up, with a
# warning.

data = [charis.prepare(dataset) for dataset in data]
for dataset in data:
    print(dataset.name, int(dataset.mask.sum()), "cells masked")

# %%
# One fit
# -------
#
# Optics of the same name are the same optic: half-wave plate, derotator and Wollaston prism are
# shared by all three, the fold mirror belongs to the lamp, the tertiary mirror to the star.

chains = charis.chains_for(data, **options)
for chain in chains:
    print(" | ".join(optic.name for optic in chain))
calibration = calibrate(
    chains, data, instrument="charis", weights="wavelength", cross_validate=False
)
print(calibration)

# %%
# The mirrors
# -----------
#
# The figure compares their diattenuations with those of bare metals at the same incidence. With one
# weight for all data the noisier lamp would set the errors of the tertiary mirror;
# ``weights="wavelength"`` gives each dataset and wavelength its own.

known = calibration.parameter_values()
for name in ("fold_mirror.diattenuation", "m3.diattenuation"):
    value, error = (100 * np.array(known[name][key], dtype=float) for key in ("value", "std"))
    print(name, "from", f"{value[0]:.2f} +- {error[0]:.2f} to {value[-1]:.2f} +- {error[-1]:.2f} %")
figure = plt.figure(figsize=(12.5, 8.8))
plot_mirrors(calibration, figure=figure)

# %%
# The star's double differences follow its altitude:

figure = plt.figure(figsize=(11.8, 9.4))
plot_double_differences(calibration, dataset=2, figure=figure)

# %%
# What an observer gets
# ---------------------
#
# The figure shows the residuals of the three datasets and, below, the accuracies for targets of 30,
# 1 and 0.1 %:

figure = plt.figure(figsize=(8.5, 11))
plot_target_accuracy(calibration, figure=figure)

# %%
# The star's polarization in each cycle follows from the calibration. The star is taken as
# unpolarized, so the remainder is the noise and the error of the model.

found = star_stokes(calibration, calibration.chains[2], data[2])
print(star_accuracy(found)["wavelength", "s_q", "s_u"])
