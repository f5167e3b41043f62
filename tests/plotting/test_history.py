# Licensed under a 3-clause BSD style license - see LICENSE
"""Parameters against date."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, optics
from astropolcal.exceptions import ParameterError
from astropolcal.plotting.history import plot_history
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1200, 1600, 2200] * u.nm


def fit(seed, date, shift=0.0, hold=False):
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | optics.LinearRetarder(
            retardance=[-160, -110, -60] * u.deg, mount="derotator", name="derotator"
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    truth = chain.copy()
    truth["derotator"].retardance = truth["derotator"].retardance.quantity + shift * u.deg
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)
    table = simulate(truth, WAVELENGTH, frames, seed=seed, meta={"date": date}, name=date)
    chain["hwp"].w_sio2.fixed = chain["hwp"].w_mgf2.fixed = hold
    return calibrate(chain, table, search=False, cross_validate=False)


@pytest.fixture(scope="module")
def years():
    return [fit(1, "2025-02-01"), fit(2, "2025-10-05"), fit(3, "2026-02-01", 0.5)]


def texts(ax):
    return [text.get_text() for text in ax.texts]


@pytest.mark.slow
def test_panels_labels_and_changes(years):
    figure = plot_history(years)
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == ["hwp.w_sio2", "hwp.w_mgf2", "derotator.retardance", "wollaston.efficiency"]
    panel = dict(zip(titles, figure.axes, strict=True))
    assert panel["hwp.w_sio2"].get_ylabel() == "value (mm)"
    assert panel["derotator.retardance"].get_ylabel() == "difference to the mean (deg)"
    assert all(len(texts(ax)) == 2 for ax in figure.axes)
    weights = [t.get_fontweight() for t in panel["derotator.retardance"].texts]
    assert weights == ["normal", "bold"]
    assert [t.get_text() for t in panel["derotator.retardance"].get_legend().get_texts()] == [
        "1200 nm", "1600 nm", "2200 nm",
    ]  # fmt: skip


def test_values_are_those_of_the_calibrations(years):
    (ax,) = plot_history(years, ["hwp.w_sio2"]).axes
    drawn = ax.lines[0].get_ydata()
    assert drawn == pytest.approx([c.chain["hwp"].w_sio2.value for c in years])


def test_wavelengths_shown(years):
    figure = plot_history(years, ["derotator.retardance"], shown=2)
    legend = figure.axes[0].get_legend()
    assert [t.get_text() for t in legend.get_texts()] == ["1200 nm", "2200 nm"]


def test_held_values_are_open_symbols(years):
    held = fit(4, "2026-03-01", hold=True)
    (ax,) = plot_history([*years, held], ["hwp.w_sio2"]).axes
    hollow = [line for line in ax.lines if line.get_markerfacecolor() == "white"]
    assert [len(line.get_xdata()) for line in hollow] == [1]
    # no change can be judged against a value that was held
    assert len(texts(ax)) == 2
    assert np.isfinite(ax.get_ylim()).all()


@pytest.mark.slow
def test_bad_input(years):
    record = dataclasses.replace(years[0].datasets[0], meta={})
    undated = dataclasses.replace(years[0], datasets=[record])
    with pytest.raises(ParameterError, match="2025-02-01: no date; state one"):
        plot_history([undated, *years[1:]])
    with pytest.raises(ParameterError, match="no calibration has a parameter 'm3'"):
        plot_history(years, ["m3"])
    with pytest.raises(ParameterError, match="0 parameters to draw"):
        plot_history(years, ["hwp.theta"])
