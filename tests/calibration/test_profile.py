# Licensed under a 3-clause BSD style license - see LICENSE
"""Profiles of chi-square: parabolas, flat lines, and bounds."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import instruments, optics
from astropolcal.calibration import Calibration, calibrate, profile
from astropolcal.calibration.uncertainty.refits import Profile
from astropolcal.chain import join
from astropolcal.exceptions import CalibrationFileError, FitError, ParameterError
from astropolcal.measurement import Normal
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6, 2.2] * u.um


def calibrated(make, kind="linear", fixed=True, **options):
    truth = make.truth(make.chain(kind, fixed=fixed, wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    return calibrate(truth, data, search=False, cross_validate=False, errors="white", **options)


@pytest.fixture(scope="module")
def cal(make):
    return calibrated(make)


# --- the profile of a well-behaved parameter ----------------------------------------------


@pytest.mark.slow
def test_profile_is_the_parabola_of_the_error(make):
    """Wilks: where the model is nearly linear, chi-square rises by one at one sigma."""
    for weights in [None, "errors"]:
        for name in ["hwp.w_sio2", "calibration_polarizer.theta", "derotator.retardance[1]"]:
            cal = calibrated(make, weights=weights)
            made = profile(cal, name, n=7)
            low, high = made.interval()
            std = cal.covariance.std(name)
            assert u.isclose((high - low) / 2, std, rtol=0.02), (weights, name)
            assert u.isclose((high + low) / 2, made.best, atol=0.05 * std), (weights, name)
            np.testing.assert_allclose(made.delta_chi2[[0, -1]], 9, rtol=0.1)
            assert made.delta_chi2.min() == 0, (weights, name)
            assert made.values[np.argmin(made.delta_chi2)] == made.best, (weights, name)
            assert "at one sigma" in str(made), (weights, name)


def test_correlated_residuals_widen_the_interval_as_they_do_the_error(make):
    """They may share an error at each setting, which makes the errors several times larger."""
    chain = make.truth(make.chain())
    data = make.off_at_settings(chain, seed=3)
    cal = calibrate(chain, data, search=False, cross_validate=False)
    for name in ["hwp.w_sio2", "calibration_polarizer.theta"]:
        low, high = profile(cal, name, n=7).interval()
        assert u.isclose((high - low) / 2, cal.covariance.std(name), rtol=0.05), name


def test_others_are_refitted(cal):
    """Two thicknesses correlate: holding all others would give a far narrower parabola."""
    made = profile(cal, "hwp.w_sio2", n=5)
    names = cal.covariance.names
    i, j = names.index("hwp.w_sio2"), names.index("hwp.w_mgf2")
    measurement = cal.measurement
    held = measurement.vector()
    held[i] = made.vectors[-1, i]
    chi2 = np.sum(measurement.residuals(held) ** 2)
    best = np.sum(measurement.residuals(made.vectors[-1]) ** 2)
    assert chi2 > 10 * best
    # the other follows with the slope of the covariance
    slope = (made.vectors[-1, j] - made.vectors[0, j]) / (made.vectors[-1, i] - made.vectors[0, i])
    expected = cal.covariance.matrix[i, j] / cal.covariance.matrix[i, i]
    assert slope == pytest.approx(expected, rel=1e-3)


def test_held_parameter_stays_where_it_is_held(cal):
    made = profile(cal, "hwp.w_sio2", n=5)
    i = cal.covariance.names.index("hwp.w_sio2")
    np.testing.assert_allclose(made.vectors[:, i], made.values.to_value(u.um))


def test_values_may_be_given_in_any_unit(cal):
    best = cal.chain["hwp"].w_sio2.quantity
    std = cal.covariance.std("hwp.w_sio2")
    wanted = (best + np.array([-2, -1, 1, 2]) * std).to(u.um)
    made = profile(cal, "hwp.w_sio2", wanted)
    assert made.values.unit == u.mm
    assert len(made.values) == 5  # the best one is added
    np.testing.assert_allclose(made.delta_chi2, [4, 1, 0, 1, 4], rtol=0.05)


def test_even_numbers_get_a_middle(cal):
    assert len(profile(cal, "hwp.w_sio2", n=4).values) == 5


def test_calibration_is_left_alone(cal):
    before = cal.measurement.vector()
    profile(cal, "hwp.w_sio2", n=3)
    np.testing.assert_array_equal(cal.measurement.vector(), before)


# --- what the data leave open -------------------------------------------------------------


@pytest.fixture(scope="module")
def open_gauge(make):
    return calibrated(make, "elliptical", fixed=False)


def test_flat_profile_is_unbounded_in_words(open_gauge):
    for name in ["hwp.theta", "derotator.theta", "derotator.circular[1]"]:
        made = profile(open_gauge, name, n=5)
        assert made.delta_chi2.max() < 1e-3, name
        low, high = made.interval()
        assert low == -np.inf * u.deg, name
        assert high == np.inf * u.deg, name
        assert f"{name} is unbounded" in made.words, name
        assert "the data do not determine it" in made.words, name
        # it was really moved
        assert u.isclose(np.ptp(made.values), 2 * u.deg), name


def test_determined_parameter_beside_open_ones(open_gauge):
    made = profile(open_gauge, "hwp.w_sio2", n=5)
    low, high = made.interval()
    assert u.isclose((high - low) / 2, open_gauge.covariance.std("hwp.w_sio2"), rtol=0.02)


def test_prior_bounds_what_the_data_leave_open(make):
    chain = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    chain["hwp"].theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    data = make.observe(chain, wavelength=LAM, seed=1)
    cal = calibrate(
        chain, data, weights="errors", errors="white", search=False, cross_validate=False
    )
    low, high = profile(cal, "hwp.theta", n=5).interval()
    assert u.isclose((high - low) / 2, 0.1 * u.deg, rtol=0.02)


def test_bound_ends_the_profile(make):
    chain = make.truth(make.chain("linear", wavelength=LAM))
    data = make.observe(chain, wavelength=LAM, seed=1)
    chain["wollaston"].efficiency.bounds = (0, 0.965)
    chain["wollaston"].efficiency = [0.96, 0.965, 0.965]
    cal = calibrate(chain, data, errors="white", search=False, cross_validate=False)
    assert "wollaston.efficiency[2]" in cal.at_bound
    made = profile(cal, "wollaston.efficiency[2]", n=5)
    assert made.values.max() <= 0.965
    low, high = made.interval()
    assert 0.96 < low < 0.965
    assert high == np.inf
    assert made.words.endswith("does not limit it up to its bound 0.965")


# --- intervals of given curves ------------------------------------------------------------


def curve(values, rises, best=0.0):
    return Profile("a.b", best, np.array(values, float), np.array(rises, float), np.zeros((1, 1)))


def test_interval_of_an_exact_parabola():
    x = np.linspace(-3, 3, 7)
    low, high = curve(x, (x / 1.7) ** 2).interval()
    assert (low, high) == (pytest.approx(-1.7), pytest.approx(1.7))
    assert curve(x, (x / 1.7) ** 2).interval(2.25) == (pytest.approx(-2.55), pytest.approx(2.55))


def test_interval_need_not_be_symmetric():
    low, high = curve([-1, 0, 1, 2], [4, 0, 0.25, 1.5625]).interval()
    assert low == pytest.approx(-0.5)
    assert high == pytest.approx(1 + 0.5 / 0.75)


def test_one_side_may_be_open():
    made = curve([-1, 0, 1], [4, 0, 0.5])
    assert made.interval()[1] == np.inf
    assert made.words == (
        "a.b is at least -0.5 at one sigma; chi-square does not limit it up to the last value 1"
    )
    assert "at most 0.5" in curve([-1, 0, 1], [0.5, 0, 4]).words


# --- bad input ----------------------------------------------------------------------------


def test_bad_input_is_refused(cal):
    for options, error, message in [
        ({"name": "hwp.phase"}, ParameterError, "no free parameter 'hwp.phase'; there are cal"),
        ({"name": "hwp.theta"}, ParameterError, "no free parameter"),
        ({"name": "hwp.w_sio2", "n": 2}, FitError, "n = 2"),
        ({"name": "hwp.w_sio2", "n": 7.0}, FitError, "n = 7.0; .* whole number"),
        ({"name": "hwp.w_sio2", "values": [1.6]}, ParameterError, "needs a unit"),
        ({"name": "hwp.w_sio2", "values": [1.6] * u.deg}, ParameterError, "not convertible"),
        ({"name": "hwp.w_sio2", "values": [-1] * u.mm}, ParameterError, "outside its bounds"),
        ({"name": "hwp.w_sio2", "values": [np.nan] * u.mm}, ParameterError, "outside its bounds"),
    ]:
        with pytest.raises(error, match=message):
            profile(cal, **options)
    for rise in (0, -1, np.nan):
        with pytest.raises(ParameterError, match=f"rise = {rise}; allowed are numbers above 0"):
            profile(cal, "hwp.w_sio2", n=3).interval(rise)


def test_calibration_from_a_file_has_no_data(cal, tmp_path):
    cal.write(tmp_path / "cal.asdf")
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        profile(Calibration.read(tmp_path / "cal.asdf"), "hwp.w_sio2")


# --- errors where chi-square is no parabola --------------------------------------------------


@pytest.mark.slow
def test_an_error_is_as_long_as_the_valley():
    """A rotator of unknown diattenuation: the plate and its retardance make up for 0.4 of it."""
    there = {"wavelength": LAM}
    truth = join(
        [
            optics.LinearPolarizer(name="polarizer"),
            optics.LinearRetarder(
                retardance=[176, 178, 179] * u.deg, mount="hwp", name="hwp", **there
            ),
            optics.DiattenuatorRetarder(
                diattenuation=np.full(3, 0.016),
                retardance=[140, 150, 160] * u.deg,
                mount="rotator",
                name="rotator",
                **there,
            ),
            optics.WollastonPrism(name="wollaston"),
        ]
    )
    start = truth.copy()
    start["rotator"].diattenuation, start["rotator"].retardance = np.zeros(3), [170] * 3 * u.deg
    plates, rotators = np.meshgrid(np.arange(5, 95, 11.25), [0, 30, 60, 90])
    frames = QTable({"hwp": plates.ravel() * u.deg, "rotator": rotators.ravel() * u.deg})
    # of six these would have been the farthest off without the curvature
    for seed in (2, 4, 5):
        data = simulate(truth, LAM, frames, flux=3e5, seed=seed)
        cal = calibrate(start, data, errors="white", cross_validate=False)
        names = [f"rotator.diattenuation[{i}]" for i in range(3)]
        stds = [cal.covariance.std(name) for name in names]
        found = cal.chain["rotator"].diattenuation.value
        assert np.all(np.abs(found - 0.016) < 3 * np.array(stds)), (seed, found, stds)
        told = [one["words"] for one in cal.identifiability.near_null]
        assert any(words.startswith("rotator.diattenuation") for words in told), seed
    made = profile(cal, names[0], values=np.linspace(-0.6, 0.6, 17))
    low, high = made.interval(rise=4)
    assert stds[0] == pytest.approx(max(high - made.best, made.best - low) / 2, rel=0.2)


def test_an_error_of_common_parameters_is_as_long_as_the_valley():
    """Two angles of a rotator that all wavelengths share: a diattenuation of 0.7 fits as well."""
    truth = join(
        [
            optics.LinearPolarizer(name="polarizer"),
            optics.LinearRetarder(retardance=172 * u.deg, mount="hwp", name="hwp"),
            optics.DiattenuatorRetarder(
                diattenuation=0.014, retardance=120 * u.deg, mount="rotator", name="rotator"
            ),
            optics.WollastonPrism(name="wollaston"),
        ]
    )
    truth["polarizer"].theta.fixed = True
    plates, rotators = np.meshgrid(np.arange(5, 95, 11.25), [0, 165])
    frames = QTable({"hwp": plates.ravel() * u.deg, "rotator": rotators.ravel() * u.deg})
    for seed in (3, 8, 9):
        data = simulate(truth, LAM, frames, flux=5e5, seed=seed)
        cal = calibrate(truth, data, cross_validate=False)
        off = abs(cal.chain["rotator"].diattenuation.value - 0.014)
        assert off < 3 * cal.covariance.std("rotator.diattenuation"), seed


@pytest.mark.slow
def test_errors_of_wavelengths_follow_valleys_of_what_all_share():
    """As all optics turn together, circular retardances make up for it, and others bend away."""
    grid = [1.3, 1.6, 2.1] * u.um
    charis = instruments.get("charis")
    start = charis.chain(wavelength=grid)
    start["hwp"].theta.prior = Normal(0 * u.deg, 2 * u.deg)
    start["derotator"].diagonal.prior = Normal(0 * u.deg, 10 * u.deg)
    start["derotator"].circular.prior = Normal(0 * u.deg, 10 * u.deg)
    truth = start.copy()
    truth["derotator"].circular = [10, -5, 5] * u.deg
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100, 120] * u.deg)
    data = simulate(truth, grid, frames, flux=1e7, seed=1, meta={"source": "polarized"})
    cal = calibrate(start, data, errors="white", cross_validate=False)
    for i, best in enumerate(cal.chain["derotator"].horizontal.quantity):
        name = f"derotator.horizontal[{i}]"
        far = 2 * cal.covariance.std(name)
        made = profile(cal, name, values=u.Quantity([best - far, best + far]))
        # it had risen by 0.8 to 1.9 at two stated errors
        assert np.min(made.delta_chi2[[0, -1]]) > 2.5, name
