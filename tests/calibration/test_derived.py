# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of what follows from a calibration: analytic, numeric, sampled, and infinite."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import models
from astropy.time import Time

from astropolcal import optics
from astropolcal.calibration import Calibration, calibrate, propagate
from astropolcal.calibration.uncertainty import (
    derived_data,
    derived_efficiency,
    derived_mueller,
    derived_retardance,
    derived_sky,
)
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.calibration.uncertainty.derived import mirror_values
from astropolcal.chain import follow, system_mueller, with_beam
from astropolcal.exceptions import (
    CalibrationFileError,
    ChainError,
    ParameterError,
    WavelengthRangeError,
)
from astropolcal.measurement import Tie
from astropolcal.plotting import plot_efficiency, plot_retardances
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6, 2.2] * u.um
AT = {"hwp": [0, 22.5] * u.deg, "derotator": 60 * u.deg}


def calibrated(make, kind="elliptical", fixed=True, **options):
    truth = make.truth(make.chain(kind, fixed=fixed, wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    options = {"search": False, "errors": "white", "cross_validate": False} | options
    return calibrate(truth, data, **options)


@pytest.fixture(scope="module")
def full_rank(make):
    return calibrated(make)


@pytest.fixture(scope="module")
def open_gauge(make):
    """Two directions stay open: 15 of 17 combinations are determined."""
    return calibrated(make, fixed=False)


@pytest.fixture(scope="module")
def from_file(full_rank, tmp_path_factory):
    path = tmp_path_factory.mktemp("derived") / "cal.asdf"
    full_rank.write(path)
    return Calibration.read(path)


# --- analytic against numeric -------------------------------------------------------------


def total_retardance(chain):
    keys = ("horizontal", "diagonal", "circular")
    return np.sqrt(sum(getattr(chain["derotator"], key).quantity ** 2 for key in keys))


CASES = {
    "retardance of a law": (
        lambda cal: derived_retardance(cal, "hwp"),
        lambda chain: chain["hwp"].retardance(LAM),
    ),
    "total retardance": (lambda cal: derived_retardance(cal, "derotator"), total_retardance),
    "efficiency": (derived_efficiency, lambda chain: chain["wollaston"].efficiency.value.copy()),
    "right beam": (
        lambda cal: derived_mueller(cal, AT),
        lambda chain: system_mueller(with_beam(chain, "right"), LAM, AT),
    ),
    "left beam": (
        lambda cal: derived_mueller(cal, AT, beam="left"),
        lambda chain: system_mueller(with_beam(chain, "left"), LAM, AT),
    ),
}


@pytest.mark.slow
def test_analytic_errors_are_the_numeric_ones(request):
    for case in CASES:
        for which in ["full_rank", "open_gauge"]:
            cal = request.getfixturevalue(which)
            ready, function = CASES[case]
            analytic, numeric = ready(cal), propagate(cal, function)
            np.testing.assert_allclose(
                u.Quantity(analytic.value), u.Quantity(numeric.value), rtol=1e-12
            )
            np.testing.assert_allclose(
                u.Quantity(analytic.std).value, u.Quantity(numeric.std).value, rtol=1e-5, atol=1e-9
            )
            known = np.ravel(analytic.is_determined)
            one, other = (d.covariance()[np.ix_(known, known)] for d in (analytic, numeric))
            stds = np.ravel(u.Quantity(analytic.std).value)[known]
            assert (np.abs(one - other) <= 1e-4 * np.outer(stds, stds)).all()
            assert analytic.open_directions.keys() == numeric.open_directions.keys()


def test_derivatives_may_be_given(full_rank):
    """A ratio of the two thicknesses, and an efficiency per wavelength."""

    def function(chain):
        ratio = chain["hwp"].w_sio2.value / chain["hwp"].w_mgf2.value
        return ratio * chain["wollaston"].efficiency.value

    def derivatives(chain):
        a, b = chain["hwp"].w_sio2.value, chain["hwp"].w_mgf2.value
        eta = chain["wollaston"].efficiency.value
        return {
            "hwp.w_sio2": eta / b,
            "hwp.w_mgf2": -eta * a / b**2,
            "wollaston.efficiency": np.diag(np.full(3, a / b)),
        }

    given, numeric = propagate(full_rank, function, derivatives), propagate(full_rank, function)
    np.testing.assert_allclose(given.std, numeric.std, rtol=1e-6)


def test_wrong_derivatives_are_refused(full_rank):
    for name, value, message in [
        ("hwp.w_sio2", np.ones(2), "expected is"),
        ("wollaston.efficiency", 1.0, "expected is"),
        ("hwp.theta", 1.0, "no such free parameter"),
    ]:
        with pytest.raises(ParameterError, match=message):
            propagate(full_rank, lambda chain: 1.0, lambda chain, n=name, v=value: {n: v})


def test_parameter_itself_has_its_own_error(full_rank):
    made = propagate(full_rank, lambda chain: chain["hwp"].w_sio2.quantity.copy())
    assert u.isclose(made.std, full_rank.covariance.std("hwp.w_sio2"), rtol=1e-6)
    assert made.value.shape == made.std.shape == ()
    # calibration is not changed
    before = full_rank.chain["hwp"].w_sio2.value.copy()
    propagate(full_rank, lambda chain: chain["hwp"].w_sio2.value.copy())
    assert full_rank.chain["hwp"].w_sio2.value == before


@pytest.mark.slow
def test_errors_are_the_spread_of_samples(full_rank):
    """Monte Carlo from the covariance matrix, 2000 draws: 1.6 % per standard deviation."""
    rng = np.random.default_rng(1)
    measurement = full_rank.measurement
    factors = measurement.free.factors()
    draws = rng.multivariate_normal(
        measurement.vector(), full_rank.covariance.matrix * np.outer(factors, factors), size=2000
    )
    chain = full_rank.chain.copy()
    free = measurement.free.of_chains([chain])
    sampled = []
    for draw in draws:
        free.put_back(draw)
        sampled.append(chain["hwp"].retardance(LAM).value)
    made = derived_retardance(full_rank, "hwp")
    np.testing.assert_allclose(np.std(sampled, axis=0), made.std.value, rtol=0.08)
    np.testing.assert_allclose(
        np.corrcoef(np.transpose(sampled))[0, 1],
        made.covariance()[0, 1] / np.prod(made.std[:2].value),
        atol=0.05,
    )


def test_tied_parameters_move_together(make):
    chain = make.truth(make.chain("linear", wavelength=LAM))
    ties = {"derotator.theta": Tie("calibration_polarizer.theta", factor=2.0)}
    data = make.observe(chain, wavelength=LAM, seed=1)
    cal = calibrate(chain, data, ties=ties, search=False, cross_validate=False)
    # 180.8 deg, where up to 5 deg are allowed
    assert "tied beyond its bounds: derotator.theta" in cal.verdict().cautions
    made = propagate(cal, lambda c: c["derotator"].theta.quantity.copy())
    assert u.isclose(made.std, 2 * cal.covariance.std("calibration_polarizer.theta"), rtol=1e-5)
    analytic, numeric = (
        derived_mueller(cal, AT),
        propagate(cal, lambda c: system_mueller(with_beam(c, "right"), LAM, AT)),
    )
    np.testing.assert_allclose(analytic.std, numeric.std, rtol=1e-5, atol=1e-10)


def test_function_of_several_chains(make):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    data = [make.observe(truth, wavelength=LAM, seed=seed) for seed in (1, 2)]
    cal = calibrate([truth, truth], data, search=False, cross_validate=False)
    made = propagate(cal, lambda a, b: a["hwp"].w_sio2.value + b["hwp"].w_sio2.value)
    assert made.std == pytest.approx(2 * cal.covariance.std("hwp.w_sio2").value, rel=1e-6)


# --- rank deficiency ----------------------------------------------------------------------


def test_predicted_data_are_determined_whatever_the_gauge(open_gauge):
    made = derived_data(open_gauge)
    assert made.is_determined.all()
    assert not made.open_directions
    # the trace of the hat matrix is the rank
    scale = np.sum(open_gauge.residuals**2) / (
        open_gauge.measurement.n_data - open_gauge.identifiability.rank
    )
    assert np.sum(made.std**2) / scale == pytest.approx(open_gauge.identifiability.rank)


def test_law_is_determined_whatever_the_gauge(open_gauge, full_rank):
    loose, tight = (derived_retardance(cal, "hwp").std for cal in (open_gauge, full_rank))
    assert np.isfinite(loose).all()
    np.testing.assert_allclose(loose.value, tight.value, rtol=0.1)


def test_total_retardance_moves_with_the_polarizer_but_not_with_the_derotator(open_gauge):
    """Turning the derotator only turns its retardance vector; turning the light adds to it."""
    made = derived_retardance(open_gauge, "derotator")
    assert np.isinf(made.std).all()
    assert len(made.open_directions) == 1
    assert "derotator.theta" not in made.open_directions
    assert "open:" in str(made)
    assert np.isfinite(open_gauge.covariance.std("hwp.w_sio2").value)


def test_total_retardance_is_determined_where_only_the_derotator_turns(make):
    chain = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    data = make.observe(chain, wavelength=LAM, seed=1)
    cal = calibrate(chain, data, fix={"hwp.theta": None}, search=False, cross_validate=False)
    assert not np.isfinite(cal.covariance.std("derotator.diagonal[1]").value)
    made = derived_retardance(cal, "derotator")
    assert made.is_determined.all()
    assert (made.std < 1 * u.deg).all()


def test_open_change_is_that_of_the_leading_parameter(open_gauge):
    """AoLP on sky follows the polarizer one to one: q = 0.5 gives du = 2 x 0.5 x 1 deg."""
    made = derived_sky(open_gauge, 0.5, 0.0, AT)
    (change,) = made.open_directions.values()
    np.testing.assert_allclose(np.abs(change[:, 1]), np.deg2rad(1.0), rtol=1e-6)
    assert np.isinf(made.std[:, 1]).all()
    # to first order the degree of polarization does not move
    assert np.isfinite(made.std[:, 0]).all()


def test_parameter_at_a_bound_goes_inward(make):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    low = truth.copy()
    low["wollaston"].efficiency = [0.9, 0.96, 0.9]
    low["wollaston"].efficiency.bounds = (0, 0.96)
    cal = calibrate(low, data, search=False, cross_validate=False)
    assert cal.at_bound
    made = derived_efficiency(cal)
    bound = [f"wollaston.efficiency[{i}]" in cal.at_bound for i in range(3)]
    assert np.isnan(
        [cal.covariance.std(f"wollaston.efficiency[{i}]") for i in range(3)]
    ).tolist() == (bound)
    # what follows from it has the error that it may go inward
    inward = cal.parameter_values()["wollaston.efficiency"]["std_inward"]
    np.testing.assert_allclose(made.std[bound], inward[bound], rtol=0.01)
    assert np.isfinite(derived_data(cal).std).all()


# --- ready-made quantities ----------------------------------------------------------------


def test_retardance_between_the_wavelengths(full_rank):
    made = derived_retardance(full_rank, "derotator", [1.2, 1.4, 1.6] * u.um)
    at_grid = derived_retardance(full_rank, "derotator")
    assert u.allclose(made.value[[0, 2]], at_grid.value[:2])
    np.testing.assert_allclose(made.std[[0, 2]].value, at_grid.std[:2].value, rtol=1e-6)
    law = derived_retardance(full_rank, "hwp", 1400 * u.nm)
    assert u.isclose(law.value, full_rank.chain["hwp"].retardance(1.4 * u.um))
    assert law.std.shape == ()


def straight(still, model, of, **since):
    """A calibration of a plate and a prism that follow a straight line, and the truth."""
    truth = still
    for name, slope in (("hwp.retardance", 10), ("wollaston.efficiency", 0.04)):
        truth = follow(truth, name, model(slope), of, **since)
    frames = half_wave_plate_cycles(derotator=[40, 60, 100, 140] * u.deg)
    frames["time"] = Time("2026-03-01") + np.linspace(0, 1, len(frames)) * u.day
    data = simulate(truth, LAM, frames, seed=1)
    return calibrate(truth, data, gauge=None, search=False, cross_validate=False)


def test_what_follows_a_law_of_the_wavelength_has_its_values():
    still = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=155 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=100 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.9, name="wollaston")
    )

    def line(slope):
        return models.Polynomial1D(1, c1=slope)

    cal = straight(still, line, "wavelength")
    between = [1.2, 1.4, 2.2] * u.um
    for found, true in (
        (derived_retardance(cal, "hwp", between), (155 + 10 * between.value) * u.deg),
        (derived_efficiency(cal, between), 0.9 + 0.04 * between.value),
    ):
        assert (np.abs(found.value - true) < 4 * found.std).all()
        assert (found.std < 0.001 * true).all()
    with pytest.raises(WavelengthRangeError):
        derived_retardance(cal, "hwp", 2.5 * u.um)
    # figures, too
    for draw, start, slope in ((plot_retardances, 155, 10), (plot_efficiency, 0.9, 0.04)):
        points = draw(cal).axes[0].containers[0]
        np.testing.assert_allclose(points[0].get_ydata(), start + slope * LAM.value, rtol=1e-3)
    # of time there is no value for all frames
    cal = straight(still, line, "time", since="2026-03-01")
    for ask in (lambda: derived_retardance(cal, "hwp"), lambda: derived_efficiency(cal)):
        with pytest.raises(ParameterError, match="follows a law of time; derived_mueller"):
            ask()


def test_mirrors_that_follow_and_bare_ones_have_errors():
    """A film that is tied moves though it is fixed by default; one of no thickness has a law."""
    metal = {"film_thickness": 50 * u.nm}
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=172 * u.deg, mount="hwp", name="hwp")
        | optics.MetalMirror(theta=20 * u.deg, fixed={"film_thickness": False}, name="m1", **metal)
        | optics.MetalMirror(theta=-30 * u.deg, name="m2", **metal)
        | optics.LinearRetarder(retardance=98 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    for name in ("hwp", "derotator"):
        chain[name].retardance.fixed = True
    chain["wollaston"].efficiency.fixed = True
    frames = half_wave_plate_cycles(derotator=[0, 30, 60, 100] * u.deg)
    quick = {"search": False, "cross_validate": False}
    ties = {"m2.film_thickness": Tie("m1.film_thickness")}
    cal = calibrate(chain, simulate(chain, LAM, frames, seed=1), ties=ties, **quick)
    first, second = (mirror_values(cal, name) for name in ("m1", "m2"))
    for key in ("retardance_err", "diattenuation_err"):
        assert (first[key] > 0).all()
        np.testing.assert_array_equal(second[key], first[key])
    bare = chain.copy()
    bare["m1"].film_thickness = 0 * u.nm
    cal = calibrate(bare, simulate(bare, LAM, frames, seed=2), **quick)
    assert derived_retardance(cal, "m1").is_determined.all()


def test_interpolated_error_by_hand(full_rank):
    made = derived_efficiency(full_rank, 1.5 * u.um)
    names = full_rank.covariance.names
    at = [names.index(f"wollaston.efficiency[{i}]") for i in (0, 1)]
    matrix = full_rank.covariance.matrix[np.ix_(at, at)]
    weights = np.array([0.25, 0.75])
    assert made.std == pytest.approx(np.sqrt(weights @ matrix @ weights), rel=1e-6)
    values = full_rank.chain["wollaston"].efficiency.value
    assert made.value == pytest.approx(weights @ values[:2])


def test_no_extrapolation(full_rank):
    for wavelength in [1.1, 2.3]:
        for function in (
            lambda lam: derived_retardance(full_rank, "derotator", lam),
            lambda lam: derived_efficiency(full_rank, lam),
        ):
            with pytest.raises(WavelengthRangeError, match="outside the calibrated range 1200"):
                function(wavelength * u.um)


def test_linear_retarder(make):
    cal = calibrated(make, "linear")
    made = derived_retardance(cal, "derotator")
    expected = [cal.covariance.std(f"derotator.retardance[{i}]").value for i in range(3)]
    np.testing.assert_allclose(made.std.value, expected, rtol=1e-6)


def test_optics_without_the_quantity_and_other_wavelengths_are_refused(full_rank):
    with pytest.raises(ChainError, match="has no retardance"):
        derived_retardance(full_rank, "wollaston")
    with pytest.raises(ChainError, match="no optic 'quarter'"):
        derived_retardance(full_rank, "quarter")
    with pytest.raises(ParameterError, match="calibrated wavelengths only"):
        derived_mueller(full_rank, AT, LAM * 1.01)
    assert derived_mueller(full_rank, AT, LAM.to(u.nm)).value.shape == (2, 3, 4, 4)


def test_prediction_of_new_frames(full_rank, make):
    new = make.observe(full_rank.chain, make.frames([50] * u.deg), LAM, seed=9)
    made = derived_data(full_rank, new)
    predicted = full_rank.measurement_of(new)
    np.testing.assert_allclose(made.value, predicted.predict(predicted.vector()))
    assert made.value.shape == (12,)
    assert (made.std < 1e-2).all()
    assert made.is_determined.all()


# --- sky ----------------------------------------------------------------------------------


def sky_recovered(chain, wrong, q, u_, wavelength):
    """What a wrong calibration makes of a source, by non-linear inversion."""
    from scipy.optimize import least_squares

    def observe(model, i, source):
        stokes = np.array([1.0, *source, 0.0])
        fluxes = []
        for turned in (0, 45):
            at = AT | {"hwp": AT["hwp"] + turned * u.deg}
            for beam in ("right", "left"):
                fluxes.append(
                    (system_mueller(with_beam(model, beam), wavelength, at) @ stokes)[:, i, 0]
                )
        r_plus, l_plus, r_minus, l_minus = fluxes
        return (r_plus - l_plus - r_minus + l_minus) / (r_plus + l_plus + r_minus + l_minus)

    result = []
    for i in range(len(wavelength)):
        data = observe(chain, i, (q, u_))
        result.append(
            least_squares(lambda s, i=i, d=data: observe(wrong, i, s) - d, (q, u_), xtol=1e-14).x
        )
    return np.array(result)


@pytest.mark.long
def test_sky_error_is_that_of_a_wrong_calibration(full_rank):
    """One sigma along each determined direction, inverted without linearizing."""
    sky = [leaf for leaf in full_rank.chain if leaf.name != "calibration_polarizer"]
    sky = sky[0] | sky[1] | sky[2]
    full = full_covariance(full_rank)
    measurement = full_rank.measurement
    squares = 0.0
    wrong = full_rank.chain.copy()
    free = measurement.free.of_chains([wrong])
    for row in full.factor:
        moved = []
        for sign in (1, -1):
            free.put_back(measurement.vector() + sign * row * measurement.free.factors())
            moved.append(
                sky_recovered(sky, wrong["hwp"] | wrong["derotator"] | wrong["wollaston"],
                              0.1, -0.05, LAM)
            )  # fmt: skip
        squares = squares + ((moved[0] - moved[1]) / 2) ** 2
    made = derived_sky(full_rank, 0.1, -0.05, AT)
    np.testing.assert_allclose(made.value, [[0.1, -0.05]] * 3)
    np.testing.assert_allclose(made.std, np.sqrt(squares), rtol=1e-3)


def test_sky_error_scales_with_polarization(full_rank):
    """Without diattenuation behind the half-wave plate an unpolarized source stays so."""
    none, one, two = (derived_sky(full_rank, q, 0.0, AT).std for q in (0, 0.1, 0.2))
    np.testing.assert_allclose(none, 0, atol=1e-12)
    np.testing.assert_allclose(two, 2 * one, rtol=1e-9)


def test_more_pairs_need_not_agree_in_number_with_unknowns(full_rank):
    many = {"hwp": np.arange(0, 90, 11.25) * u.deg, "derotator": 60 * u.deg}
    made = derived_sky(full_rank, 0.1, 0.0, many)
    assert made.value.shape == (3, 2)
    assert made.is_determined.all()


def test_sky_chain_may_be_given(full_rank):
    mirror = optics.Diattenuator(diattenuation=0.01, name="m3")
    chain = mirror
    for leaf in full_rank.chain:
        if leaf.name != "calibration_polarizer":
            chain = chain | leaf
    given = derived_sky(full_rank, 0.0, 0.0, AT, chain=chain)
    # the instrumental polarization of the mirror is scaled like that of a source
    assert (given.std.max(axis=1) > 0).all()
    np.testing.assert_allclose(
        given.std, derived_sky(full_rank, 0.01, 0.0, AT).std, rtol=0.05, atol=1e-8
    )


def test_positions_must_determine_q_and_u(full_rank):
    for positions, error, message in [
        ({"hwp": 0 * u.deg, "derotator": 60 * u.deg}, ParameterError, "do not determine q and u"),
        ({"hwp": [5, 5] * u.deg, "derotator": 60 * u.deg}, ParameterError, "0 and 22.5 deg"),
        ({"derotator": 60 * u.deg}, ChainError, "no position of 'hwp'"),
    ]:
        with pytest.raises(error, match=message):
            derived_sky(full_rank, 0.1, 0.0, positions)
    # unphysical source is refused
    with pytest.raises(ParameterError, match="more than 100 %"):
        derived_sky(full_rank, 0.9, 0.9, AT)


# --- from a file --------------------------------------------------------------------------


def test_file_gives_the_same_errors_where_all_is_determined(full_rank, from_file):
    assert from_file.measurement is None
    for function in (
        lambda cal: derived_retardance(cal, "hwp"),
        lambda cal: derived_mueller(cal, AT),
        lambda cal: derived_sky(cal, 0.1, 0.0, AT),
    ):
        np.testing.assert_allclose(
            u.Quantity(function(from_file).std).value,
            u.Quantity(function(full_rank).std).value,
            rtol=1e-5,
            atol=1e-12,
        )
    # file holds no data to predict
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        derived_data(from_file)


def test_spectra_of_a_calibration_are_parameters_of_optics(full_rank):
    pytest.importorskip("specutils", reason="specutils is not installed")
    for made in (derived_retardance(full_rank, "hwp"), derived_efficiency(full_rank)):
        spectrum = made.spectrum()
        np.testing.assert_array_equal(spectrum.flux.value, u.Quantity(made.value).value)
        np.testing.assert_array_equal(spectrum.spectral_axis, full_rank.wavelength)
        np.testing.assert_allclose(spectrum.uncertainty.array, u.Quantity(made.std).value)
    optic = optics.WollastonPrism(efficiency=spectrum)
    np.testing.assert_array_equal(optic.efficiency.value, made.value)
    np.testing.assert_array_equal(optic.efficiency.std, made.std)
    with pytest.raises(ParameterError, match="one value at each of several wavelengths"):
        derived_efficiency(full_rank, 1.6 * u.um).spectrum()
