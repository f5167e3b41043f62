# Licensed under a 3-clause BSD style license - see LICENSE
"""
1. Calibrate the internal source
================================

A lamp downstream of a polarizer, eight angles of the half-wave plate at each of eight derotator
angles: from the table of fluxes to a calibration file. By default this is the simulated run that
comes with the package.
"""

# %%
# The observations
# ----------------
#
# A table holds the fluxes of both beams, one row per frame and wavelength, with the angles of the
# stages. It is checked when it is read.

import os
from importlib.resources import files
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from astropolcal import Calibration, Observations, calibrate, instruments
from astropolcal.plotting import plot_accuracy, plot_double_differences, plot_retardances

folder = os.environ.get("ASTROPOLCAL_DATA")
if folder:
    path = next(Path(folder).rglob("dataset3_polarized*.ecsv"))
else:
    path = files("astropolcal") / "data" / "charis_example.ecsv"
observations = Observations.read(path)
print(observations.summary())

# %%
# Frames whose half-wave plates stand 45 degrees apart make a pair. Each pair gives a normalized
# double difference per wavelength, in which the gains of the beams and the polarization of static
# optics downstream of the plate cancel to first order.

print(observations.pairs().shape[0], "pairs at", len(observations.wavelength), "wavelengths")

# %%
# The chain of optics
# -------------------
#
# The instrument knows its optics in the order of the light, and reads from the table which of them
# were in the beam.

charis = instruments.get("charis")
(chain,) = charis.chains_for([observations])
for optic in chain:
    free = [key for key in optic.param_names if not getattr(optic, key).fixed]
    print(f"{optic.name:24s}{type(optic).__name__:22s}free: {', '.join(free) or 'nothing'}")

# %%
# Fit
# ---
#
# All wavelengths are fitted at once with one of Astropy's fitters and the exact Jacobian.

calibration = calibrate(chain, observations, instrument="charis")
print(calibration.summary())

# %%
# The summary says what the data do not determine. Two rotations cannot be distinguished from
# retardances of the derotator; parameters that take part in them have no error, rather than a small
# and wrong one. The page :doc:`/gauge` explains what that means on sky and which observations
# determine them.
#
# Look at it
# ----------
#
# Curves are the model, points the data, and the panels below are their difference.

figure = plt.figure(figsize=(11.8, 9.4))
plot_double_differences(calibration, figure=figure)

# %%
# The three components of the derotator's retardance, and the half-wave plate's:

figure = plt.figure(figsize=(11.9, 8.2))
plot_retardances(calibration, figure=figure)

# %%
# How well is a setting predicted that the fit has not seen? ``s_cv`` leaves each derotator angle
# out in turn. It is the number to quote for a prediction; ``s_mean`` is the error of a mean of
# residuals.

figure = plt.figure(figsize=(8.5, 6))
plot_accuracy(calibration, figure=figure)

# %%
# Keep it
# -------
#
# The file holds the chain with units and bounds, the covariance, the accuracies, the versions of
# the software and the hashes of the data.

calibration.write("charis.asdf", overwrite=True)
again = Calibration.read("charis.asdf")
print(again, np.allclose(again.wavelength, calibration.wavelength))
Path("charis.asdf").unlink()
