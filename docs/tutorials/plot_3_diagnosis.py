# Licensed under a 3-clause BSD style license - see LICENSE
"""
3. Read a diagnosis
===================

A calibrated model leaves residuals. Are they noise? If not, what does the model lack? This run
has an error in it that the model does not know, and the diagnosis is to find it.
"""

# %%
# An instrument with a secret
# ---------------------------
#
# The true instrument has beams of unequal gain and a half-wave plate that absorbs one polarization
# more than the other. The model has neither. With a folder of tables, the real internal source is
# diagnosed instead, and the answer is not known.

import os
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Observations, instruments, optics
from astropolcal.chain import insert_optic
from astropolcal.gap import diagnose
from astropolcal.gap.report import causes_table, summary
from astropolcal.plotting import plot_cause_map, plot_gap_frames, plot_gap_maps, plot_gap_spectrum
from astropolcal.simulation import half_wave_plate_cycles, simulate

charis = instruments.get("charis")
wavelength = charis.wavelength[[2, 6, 10, 14, 18, 20]]
frames = half_wave_plate_cycles(np.arange(0, 180, 11.25) * u.deg, [45, 62.5, 80, 100] * u.deg)


def simulated():
    """Return chains of the model, and observations with what it lacks."""
    chains, data = [], []
    for i, source in enumerate(("polarized", "unpolarized")):
        chain = charis.chain(source, derotator="linear", wavelength=wavelength)
        plate = optics.Diattenuator(diattenuation=0.004, mount="hwp", name="plate_absorbs")
        truth = insert_optic(chain, plate, after="hwp")
        truth = truth | optics.BeamGain(imbalance=0.012, name="gain")
        data.append(
            simulate(truth, wavelength, frames, seed=i, meta={"source": source}, name=source)
        )
        chains.append(chain)
    return chains, data


folder = os.environ.get("ASTROPOLCAL_DATA")
if folder:
    paths = [next(Path(folder).rglob("dataset3_polarized*.ecsv"))]
    data = [Observations.read(path) for path in paths]
    chains = charis.chains_for(data)
else:
    chains, data = simulated()

# %%
# Ask
# ---
#
# ``diagnose`` tests every small error that an optic may have, the cells of place, kind and
# dependence, and the named effects of the library. A few names are enough here, so that the page
# builds quickly.

effects = [
    "beam_gain",
    "hwp_diattenuation",
    "hwp_tilt",
    "hwp_beam_wander",
    "derotator_diattenuation",
    "static_diattenuator",
]
diagnosis = diagnose(chains, data, effects=effects, cells=False)
print(summary(diagnosis))

# %%
# How to read it
# --------------
#
# The first lines state what the model lacks, with its probability. The next give the gap on frames
# that were left out of the fit, in double and in single differences, and the noise; the last give
# the remainder.

causes = causes_table(diagnosis)
print(causes["rank", "effect", "probability", "explained"])

# %%
# The map shows where in the chain the causes are, and of which kind. Causes that the data cannot
# distinguish share the probability.

figure = plt.figure(figsize=(6.4, 4.6))
plot_cause_map(diagnosis, figure=figure)

# %%
# The residuals of each frame, before and after, with the contribution of the causes. Unequal
# gains are the same in all frames; an effect that turns with the half-wave plate alternates.

figure = plt.figure(figsize=(9, 6.4))
plot_gap_frames(diagnosis, figure=figure)

# %%
# The gap against wavelength, before and after the effects are in the model. Where the second
# line meets the noise, these data show no further cause.

figure = plt.figure(figsize=(10, 8.2))
plot_gap_spectrum(diagnosis, figure=figure)

# %%
# Maps of the residuals: wavelength against frame. Unequal gains are constant in all frames; an
# effect that turns with the half-wave plate makes stripes.

figure = plt.figure(figsize=(12, 7.9))
plot_gap_maps(diagnosis, figure=figure)

# %%
# And then
# --------
#
# The improved chains are ordinary chains. They can be calibrated, written to files and used to
# correct science data; the page :doc:`/diagnosis` describes this and the limits of the search.

for chain in diagnosis.chains:
    print(" | ".join(optic.name for optic in chain))
