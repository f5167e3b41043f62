# Licensed under a 3-clause BSD style license - see LICENSE
"""Datasets that have some of the wavelengths only."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.gap import diagnose
from astropolcal.gap.residuals import locate
from astropolcal.optics import BeamGain
from astropolcal.plotting import plot_gap_maps, plot_gap_spectrum
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = np.geomspace(1200, 2300, 6) * u.nm


@pytest.mark.long
def test_where_knows_which_wavelengths_a_dataset_has():
    frames = half_wave_plate_cycles(derotator=[45, 70, 95, 120] * u.deg)
    chain = CHARIS.chain(derotator="linear", wavelength=WAVELENGTH)
    whole = simulate(chain | BeamGain(imbalance=0.02, name="flat"), WAVELENGTH, frames, seed=1)
    first, last = np.arange(6) < 4, np.arange(6) > 1
    data = [whole.select_bins(first), whole.select_bins(last)]
    found = diagnose([chain, chain], data)
    assert found.causes[0].name == "beam_gain"
    where = locate(found.nominal)
    assert where[0]["share"] > 0.4
    assert "constant" in where[0]["detail"]


@pytest.mark.long
def test_one_wavelength_a_dataset_as_filters_have_it():
    frames = half_wave_plate_cycles(derotator=[45, 70, 95, 120] * u.deg)
    chain = CHARIS.chain(derotator="linear", wavelength=WAVELENGTH)
    whole = simulate(chain, WAVELENGTH, frames, seed=2)
    data = [whole.select_bins(np.arange(6) == i) for i in range(6)]
    found = diagnose([chain] * 6, data)
    assert found.verdict == "none"
    assert len(plot_gap_spectrum(found).axes) == 12
    # a map before and after for each, and the bar of colours
    assert len(plot_gap_maps(found).axes) == 13
