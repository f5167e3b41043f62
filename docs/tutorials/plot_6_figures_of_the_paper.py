# Licensed under a 3-clause BSD style license - see LICENSE
"""
6. The figures of the paper
===========================

The figures of McIntosh et al. (2026), from one joint fit of a polarized lamp, an unpolarized lamp
and an unpolarized star. By default the data are simulated, so the figures show what such a run
looks like; with a folder of the real tables they are those of the real instrument, which the page
:doc:`/charis` compares with the published numbers.
"""

# %%
# Data and fit
# ------------

import os
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Observations, calibrate, instruments
from astropolcal.chain import replace_optic
from astropolcal.efficiency import polarimetric_efficiency
from astropolcal.plotting import (
    plot_double_differences,
    plot_efficiency,
    plot_mirrors,
    plot_retardances,
    plot_target_accuracy,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

charis = instruments.get("charis")
BLUE, VERMILION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"


def simulated():
    """Return a polarized lamp, an unpolarized lamp and an unpolarized star at all wavelengths."""
    lamp = half_wave_plate_cycles(derotator=np.arange(45, 133, 12.5) * u.deg)
    night = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.zeros(23) * u.deg)
    night["parallactic"] = np.linspace(20, 36, len(night)) * u.deg
    night["altitude"] = np.linspace(67, 62, len(night)) * u.deg
    night["derotator"] = 0.5 * night["altitude"] + 63.5 * u.deg
    night["hwp_true"] = night["hwp"] + 0.5 * night["parallactic"] + night["altitude"]
    published = charis.published()
    sources = ("polarized", "unpolarized", "unpolarized standard star")
    data = []
    for i, source in enumerate(sources):
        chain = charis.chain(source, ["dichroic", "nbs"])
        for name in ("hwp", "derotator", "wollaston"):
            chain = replace_optic(chain, name, published[name].copy())
        if source == "unpolarized":
            chain["fold_mirror"].diattenuation = np.linspace(0.0122, 0.0079, 22)
        if "star" in source:
            chain["m3"].diattenuation = np.linspace(0.0163, 0.0120, 22)
        data.append(
            simulate(
                chain,
                charis.wavelength,
                night if "star" in source else lamp,
                flux=1e6 if "star" in source else 4e6,
                read_noise=100.0,
                seed=i,
                meta=charis.published_meta() | {"source": source},
                name=source,
            )
        )
    return data


folder = os.environ.get("ASTROPOLCAL_DATA")
if folder:
    names = ("dataset3_polarized", "dataset4_unpolarized", "hd293396")
    data = [Observations.read(next(Path(folder).rglob(f"{name}*.ecsv"))) for name in names]
else:
    data = simulated()
data = [charis.prepare(dataset) for dataset in data]
fit = {"instrument": "charis", "weights": "wavelength", "cross_validate": False}
calibration = calibrate(charis.chains_for(data), data, **fit)
print(calibration)
nm = calibration.wavelength.to_value(u.nm)

# %%
# Double differences of the polarized lamp
# ----------------------------------------
#
# Modelled and observed normalized double differences against the derotator angle, at four
# wavelengths.

figure = plt.figure(figsize=(11.8, 9.4))
plot_double_differences(calibration, [1329, 1575, 1744, 1932] * u.nm, figure=figure)

# %%
# Relative accuracy, with a linear and an elliptical derotator
# ------------------------------------------------------------
#
# The paper's :math:`s_\mathrm{rel}` of the polarized lamp. The paper's linear derotator has its
# orientations at zero; in this joint fit they are free.

linear = calibrate(charis.chains_for(data[:1], derotator="linear"), data[:1], **fit)
elliptical = calibrate(charis.chains_for(data[:1]), data[:1], **fit)
figure, axis = plt.subplots(figsize=(9, 4.8), layout="constrained")
for name, one, color, marker in (
    ("linear derotator", linear, VERMILION, "s"),
    ("elliptical derotator", elliptical, BLUE, "o"),
):
    s_rel = one.accuracy["s_mean"].to_value(u.percent)
    axis.plot(nm, s_rel, color=color, marker=marker, label=name)
axis.set(xlabel="wavelength (nm)", ylabel=r"$s_\mathrm{rel}$ (%)", yscale="log")
axis.legend(frameon=False)

# %%
# Retardances of half-wave plate and derotator
# --------------------------------------------
#
# The retardances have the signs of this package; :ref:`mirror-branches` lists those with the
# opposite sign in the paper.

figure = plt.figure(figsize=(11.9, 8.2))
plot_retardances(elliptical, figure=figure)

# %%
# Modulation efficiency of the Wollaston prism
# --------------------------------------------

figure = plt.figure(figsize=(9, 4.8))
plot_efficiency(elliptical, figure=figure)

# %%
# Mirrors
# -------
#
# The fold mirror of the unpolarized lamp and the tertiary mirror of the telescope.

figure = plt.figure(figsize=(12.5, 8.8))
plot_mirrors(calibration, figure=figure)

# %%
# The unpolarized star
# --------------------
#
# Double differences against altitude.

figure = plt.figure(figsize=(11.8, 9.4))
plot_double_differences(calibration, [1375, 1575, 1744, 1932] * u.nm, dataset=2, figure=figure)

# %%
# Polarimetric efficiency
# -----------------------
#
# The share of linear polarization that is measured, against the derotator angle. Where the
# derotator is a quarter-wave retarder it turns the light at 45 deg to its axes into circular
# light.

sky = charis.on_sky(calibration.chains[0])
derotator = np.arange(0, 181, 3.0) * u.deg
figure, axes = plt.subplots(2, 2, figsize=(10, 7), sharex=True, sharey=True, layout="constrained")
colors, lines = [BLUE, VERMILION, GREEN, ORANGE], ["-", "--", "-.", ":"]
pointings = [(32, 48), (94, 60), (126, 60), (24, 67)]
for axis, (parallactic, altitude) in zip(axes.flat, pointings, strict=True):
    share = polarimetric_efficiency(
        sky,
        calibration.wavelength,
        derotator=derotator,
        altitude=altitude * u.deg,
        parallactic=parallactic * u.deg,
    )
    for b, color, line in zip([2, 9, 12, 17], colors, lines, strict=True):
        label = f"{nm[b]:.0f} nm"
        axis.plot(
            derotator.value, np.squeeze(share)[:, b], color=color, ls=line, lw=1.8, label=label
        )
    axis.set_title(f"parallactic angle {parallactic}°, altitude {altitude}°", fontsize=10)
    axis.grid(True, color="0.9")
for axis in axes[1]:
    axis.set_xlabel("derotator (deg)")
for axis in axes[:, 0]:
    axis.set_ylabel("polarimetric efficiency")
figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)

# %%
# Accuracy for targets
# --------------------
#
# The parts of the paper's accuracy, and the accuracies of the calibration for targets of 30, 1 and
# 0.1 %.

figure = plt.figure(figsize=(8.5, 11))
plot_target_accuracy(calibration, figure=figure)
