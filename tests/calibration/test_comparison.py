# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side."""

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import calibrate, instruments, optics
from astropolcal.calibration import compare
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.chain import join
from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.instruments.telescope import published_mirror, telescope
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.plotting import plot_comparison
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6] * u.um
COLUMNS = [
    "label", "filter", "wavelength", "hwp_retardance", "hwp_diattenuation",
    "derotator_retardance", "derotator_diattenuation", "path_diattenuation",
    "least_efficiency", "most_efficiency",
]  # fmt: skip
COLUMNS += [f"{name}_std" for name in COLUMNS[3:]]


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


def test_retardance_is_the_angle_whatever_sign_and_turn():
    for given, shown in [(170, 170), (-172, 172), (200, 160), (251.5, 108.5), (540, 180)]:
        table = compare({"bench": (bench(given, given), LAM)})
        assert table.colnames == COLUMNS, shown
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
    for name in COLUMNS[3:10]:
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


def test_what_cannot_be_compared():
    for members, error, words in [
        ([], ParameterError, "nothing to compare"),
        (["irdis", "irdis"], ParameterError, "irdis occurs twice; give labels"),
        ({"x": 3}, ParameterError, "x: 3 is not a calibration"),
        (["iridis"], InstrumentError, "unknown instrument 'iridis'.*did you mean 'irdis'"),
    ]:
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


# --- errors -----------------------------------------------------------------------------

QUANTITIES = COLUMNS[3:10]


def calibrated(plate=130.0, derotator=140.0, fixed=(), frames=None, seed=3):
    """Return the calibration of a bench whose retardances and diattenuation are free."""
    # double differences see a diattenuation in second order only, and a plate far from half a
    # wave tells it from the retardance
    chain = bench(plate, derotator, 0.3)
    chain["mirrors"].theta.fixed = False
    for name, key in fixed:
        getattr(chain[name], key).fixed = True
    frames = (
        half_wave_plate_cycles(derotator=[20, 50, 75, 110] * u.deg) if frames is None else frames
    )
    frames["rotator"] = frames["derotator"]
    data = simulate(chain, LAM, frames, flux=1e8, seed=seed)
    return calibrate(chain, data, search=False, cross_validate=False)


@pytest.fixture(scope="module")
def calibration():
    return calibrated()


def drawn(calibration, n, seed=1):
    """Return the smooth quantities of chains drawn from the covariance, shape (n, 7, n_lam)."""
    chain = calibration.chains[0].copy()
    free = FreeParameters([chain], len(LAM))
    factor = full_covariance(calibration).factor
    z = np.random.default_rng(seed).normal(size=(n, len(factor)))
    found, start = [], free.start()
    for row in z @ factor:
        free.put_back(start + row * free.factors())
        table = compare({"draw": (chain, LAM)})
        found.append([u.Quantity(table[key]).value for key in QUANTITIES])
    return np.array(found)


@pytest.mark.slow
def test_errors_are_the_scatter_over_the_covariance(calibration):
    table = compare([calibration])
    scatter = drawn(calibration, 200).std(axis=0)
    for key, expected in zip(QUANTITIES, scatter, strict=True):
        found = u.Quantity(table[f"{key}_std"]).value
        if key == "hwp_diattenuation":
            assert np.isnan(found).all()
        elif key != "most_efficiency":
            # 200 draws give a standard deviation to 5 %
            np.testing.assert_allclose(found, expected, rtol=0.25, err_msg=key)


def test_error_of_a_retardance_is_that_of_its_parameter(calibration):
    table = compare([calibration])
    for column, name in (("hwp", "plate"), ("derotator", "mirrors")):
        expected = calibration.covariance.std(f"{name}.retardance").to_value(u.deg)
        found = table[f"{column}_retardance_std"].to_value(u.deg)
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    expected = calibration.covariance.std("mirrors.diattenuation")
    np.testing.assert_allclose(table["derotator_diattenuation_std"], expected, rtol=1e-6)


@pytest.mark.slow
def test_half_a_wave_is_no_kink():
    """The folded retardance has a kink at 180 deg, where its error is still that of the angle."""
    for plate in [179.999, 180.0, 180.001, -180.0]:
        cal = calibrated(plate, fixed=[("mirrors", "diattenuation")])
        found = compare([cal])["hwp_retardance_std"]
        np.testing.assert_allclose(found, cal.covariance.std("plate.retardance"), rtol=1e-6)


def test_what_is_fixed_has_no_error():
    held = [("mirrors", "retardance"), ("mirrors", "diattenuation"), ("mirrors", "theta")]
    table = compare([calibrated(fixed=held)])
    for key in ("derotator_retardance", "derotator_diattenuation", "path_diattenuation"):
        assert np.isnan(u.Quantity(table[f"{key}_std"]).value).all(), key
    assert np.isfinite(table["hwp_retardance_std"]).all()


def test_instruments_and_chains_have_no_errors():
    table = compare({"irdis": "irdis", "bench": (bench(), LAM)})
    for key in QUANTITIES:
        assert np.isnan(u.Quantity(table[f"{key}_std"]).value).all(), key
    assert table["hwp_retardance_std"].unit == u.deg


def test_what_the_data_leave_open_has_an_infinite_error():
    """With the derotator at one angle only, its retardance and orientation are one number."""
    cal = calibrated(frames=half_wave_plate_cycles(derotator=[20] * u.deg))
    table = compare([cal])
    assert np.isinf(table["derotator_retardance_std"].to_value(u.deg)).any()


def test_errors_survive_the_file(calibration, tmp_path):
    path = calibration.write(tmp_path / "cal.asdf") or tmp_path / "cal.asdf"
    a, b = compare([calibration]), compare({"chain 1": type(calibration).read(path)})
    for key in QUANTITIES:
        name = f"{key}_std"
        np.testing.assert_allclose(u.Quantity(a[name]), u.Quantity(b[name]), rtol=1e-6)


def test_figure_has_a_bar_for_each_error(calibration):
    table = compare({"calibrated": calibration, "published": "irdis"})
    figure = plot_comparison(table, figure=Figure())
    bars = [one for one in figure.axes[1].collections if len(one.get_segments())]
    assert len(bars) == 1
    found = np.array(bars[0].get_segments())
    value = table["derotator_retardance"][:2].to_value(u.deg)
    std = table["derotator_retardance_std"][:2].to_value(u.deg)
    np.testing.assert_allclose(found[:, 0, 0], LAM.to_value(u.nm))
    np.testing.assert_allclose(found[:, :, 1], np.stack([value - std, value + std], axis=1))
    # in percent, as its axis
    (path,) = (one for one in figure.axes[2].collections if len(one.get_segments()))
    span = np.ptp(np.array(path.get_segments())[:, :, 1], axis=1)
    np.testing.assert_allclose(span, 200 * table["path_diattenuation_std"][:2])


def test_figure_shows_what_is_open_and_takes_tables_without_errors():
    table = compare({"one": (bench(), LAM)})
    table["hwp_retardance_std"] = [np.inf, 0.1] * u.deg
    figure = plot_comparison(table, figure=Figure())
    (line,) = [x for x in figure.axes[0].get_lines() if list(x.get_ydata()) == [0, 1]]
    np.testing.assert_allclose(line.get_xdata(), 1200)
    table.remove_columns([f"{key}_std" for key in QUANTITIES])
    assert not plot_comparison(table, figure=Figure()).axes[0].collections
