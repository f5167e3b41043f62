# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of the posterior of a calibration, and whether they have converged."""

from astropolcal.calibration.posterior.sampler import LogPosterior
from astropolcal.calibration.posterior.samples import Posterior

__all__ = ["LogPosterior", "Posterior"]
