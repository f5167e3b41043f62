# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side."""

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import calibrate, instruments, optics
from astropolcal.calibration import compare
from astropolcal.chain import join
from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.instruments.telescope import published_mirror, telescope
from astropolcal.plotting import plot_comparison
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6] * u.um
COLUMNS = [
    "label", "filter", "wavelength", "hwp_retardance", "hwp_diattenuation",
    "derotator_retardance", "derotator_diattenuation", "path_diattenuation",
    "least_efficiency", "most_efficiency",
]  # fmt: skip


def bench(plate=170.0, derotator=150.0, attenuation=0.02):
    train = [
        optics.LinearPolarizer(name="polarizer"),
        optics.LinearRetarder(retardance=plate * u.deg, mount="hwp", name="plate"),
    ]
    if derotator is not None:
        train.append(
            optics.DiattenuatorRetarder(
                retardance=derotator * u.deg,
                diattenuation=attenuation,
                theta=12 * u.deg,
                mount="rotator",
                name="mirrors",
            )
        )
    return join([*train, optics.WollastonPrism(name="wollaston")])


@pytest.mark.parametrize(
    ("given", "shown"), [(170, 170), (-172, 172), (200, 160), (251.5, 108.5), (540, 180)]
)
def test_retardance_is_the_angle_whatever_sign_and_turn(given, shown):
    table = compare({"bench": (bench(given, given), LAM)})
    assert table.colnames == COLUMNS
    np.testing.assert_allclose(table["hwp_retardance"].to_value(u.deg), shown, atol=1e-6)
    np.testing.assert_allclose(table["derotator_retardance"].to_value(u.deg), shown, atol=1e-6)
    np.testing.assert_allclose(table["derotator_diattenuation"], 0.02)


def test_least_efficiency_is_the_closed_form():
    table = compare({"bench": (bench(180, 120, 0.0), LAM)})
    np.testing.assert_allclose(table["most_efficiency"], 1, atol=0.01)
    # the derotator is 12 deg off, and turned in steps of 5 deg
    assert np.all(np.abs(table["least_efficiency"] - 0.5) < 0.01)


def test_without_a_derotator_there_are_gaps():
    table = compare({"bench": (bench(170, None), LAM)})
    assert np.isnan(table["derotator_retardance"].value).all()
    assert np.isnan(table["derotator_diattenuation"]).all()
    np.testing.assert_array_equal(table["least_efficiency"], table["most_efficiency"])


def test_published_filters_are_named():
    table = compare(["irdis", "charis"])
    irdis = table[table["label"] == "irdis"]
    assert irdis["filter"].tolist() == ["Y", "J", "H", "Ks"]
    assert irdis["derotator_retardance"][2].to_value(u.deg) == pytest.approx(99.3231, abs=1e-3)
    assert set(table["filter"][table["label"] == "charis"]) == {""}
    assert len(table) == 26


def test_telescope_does_not_count():
    inside = bench()
    sky = join([*telescope(published_mirror()), *list(inside)[1:]])
    a, b = compare({"a": (inside, LAM)}), compare({"b": (sky, LAM)})
    for name in COLUMNS[3:]:
        np.testing.assert_allclose(u.Quantity(a[name]), u.Quantity(b[name]))


def test_calibration_is_a_member_next_to_its_instrument():
    charis = instruments.get("charis")
    lam = charis.wavelength[[0, 10, 21]]
    chain = charis.chain(derotator="linear", wavelength=lam)
    data = simulate(chain, lam, half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg), seed=1)
    cal = calibrate(chain, data, instrument="charis", search=False, cross_validate=False)
    table = compare({"today": cal, "published": charis})
    found = table[table["label"] == "today"]
    expected = np.abs(cal.chain["derotator"].retardance.value)
    expected = np.minimum(expected % 360, 360 - expected % 360)
    np.testing.assert_allclose(found["derotator_retardance"].to_value(u.deg), expected, atol=1e-6)
    assert compare([cal])["label"][0] == "charis"


@pytest.mark.parametrize(
    ("members", "error", "words"),
    [
        ([], ParameterError, "nothing to compare"),
        (["irdis", "irdis"], ParameterError, "irdis occurs twice; give labels"),
        ({"x": 3}, ParameterError, "x: 3 is no calibration"),
        (["iridis"], InstrumentError, "unknown instrument 'iridis'.*did you mean 'irdis'"),
    ],
)
def test_what_cannot_be_compared(members, error, words):
    with pytest.raises(error, match=words):
        compare(members)


def test_figure_shows_every_member_and_value():
    table = compare({"one": (bench(), LAM), "two": (bench(160, None), LAM)})
    figure = plot_comparison(table, title="two benches", figure=Figure())
    assert figure.get_suptitle() == "two benches"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    plate = figure.axes[0].get_lines()
    np.testing.assert_allclose(plate[1].get_ydata(), 160)
    np.testing.assert_allclose(plate[0].get_xdata(), [1200, 1600])
    units = [ax.get_ylabel() for ax in figure.axes]
    assert units == [
        "retardance (deg)",
        "retardance (deg)",
        "diattenuation (%)",
        "measured share of the polarization",
    ]
