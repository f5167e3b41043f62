# Licensed under a 3-clause BSD style license - see LICENSE
"""
What data determine: analytic null directions, ranks, and honest errors.

The gauge freedoms at one wavelength follow from the Mueller algebra: (i) the
45 deg retardance and the derotator's misalignment, (ii) the circular
retardance and a common rotation of polarizer and half-wave plate.
"""

import re

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.calibration import calibrate, examine
from astropolcal.calibration.identifiability.analysis import finding_of as finding_of_problem
from astropolcal.calibration.identifiability.linearized import Whitened, near_null_directions
from astropolcal.calibration.identifiability.sky import consequences_along, view_of_measurement
from astropolcal.measurement import Measurement, Normal
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.simulation import half_wave_plate_cycles, simulate

FRAMES = half_wave_plate_cycles(derotator=np.linspace(45, 132.5, 8) * u.deg)


def analyse(free, jacobian, held=None):
    """What the data alone determine, and the covariance for unit noise."""
    whitened = Whitened(jacobian, free.steps, None, held)
    return finding_of_problem(free, whitened), whitened.covariance()


def finding_of(measurement, held=None):
    vector = measurement.vector()
    return analyse(measurement.free, measurement.jacobian(vector), held)


def angles_chain(free=("polarizer", "wollaston")):
    """Polarizer and Wollaston, whose angles the data see as a difference only."""
    chain = (
        optics.LinearPolarizer(theta=20 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=0 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(theta=3 * u.deg, efficiency=0.9, name="wollaston")
    )
    chain["hwp"].retardance.fixed = True
    chain["wollaston"].efficiency.fixed = True
    for name in free:
        chain[name].theta.fixed = False
    return chain


# --- analytic cases -------------------------------------------------------------------------


def test_common_rotation_of_polarizer_and_analyser_changes_nothing():
    """Without a retarder only the difference of both angles counts: Malus's law."""
    chain = angles_chain()
    data = simulate(chain, 1.6 * u.um, FRAMES, noise=False)
    measurement = Measurement(chain, data, observable="normalized_single_difference")
    finding, covariance = finding_of(measurement)
    assert finding.rank == 1
    np.testing.assert_allclose(np.abs(finding.null_vectors), [[np.sqrt(0.5)] * 2], atol=1e-12)
    assert not finding.identifiable.any()
    assert np.isnan(covariance).all()
    assert finding.directions[0]["words"].endswith("+1 deg")
    assert finding.directions[0]["parameters"] == pytest.approx(
        {"polarizer.theta": 1.0, "wollaston.theta": 1.0}
    )


def test_fixing_one_of_them_determines_the_other():
    chain = angles_chain(free=("polarizer",))
    data = simulate(chain, 1.6 * u.um, FRAMES, noise=False)
    measurement = Measurement(chain, data, observable="normalized_single_difference")
    finding, covariance = finding_of(measurement)
    assert finding.rank == finding.n_free == 1
    assert finding.identifiable.all()
    assert not len(finding.directions)
    slope = measurement.jacobian(measurement.vector())
    assert covariance[0, 0] == pytest.approx(1 / np.sum(slope**2))


def test_double_difference_does_not_see_a_plate_that_does_nothing():
    chain = angles_chain()
    data = simulate(chain, 1.6 * u.um, FRAMES, noise=False)
    finding, _ = finding_of(Measurement(chain, data))
    assert finding.rank == 0
    assert {d["words"] for d in finding.directions} == {
        "polarizer.theta changes no datum: it cannot be determined and keeps its start value",
        "wollaston.theta changes no datum: it cannot be determined and keeps its start value",
    }
    assert finding.silent == ["polarizer.theta", "wollaston.theta"]


def test_one_wavelength_has_rank_six_of_eight(make):
    """The count of the gauge freedoms at one wavelength, with the HWP retardance free."""
    chain = make.chain("elliptical", fixed=False, wavelength=[1.6] * u.um)
    train = chain.copy()
    for key, value in (("horizontal", -95.0), ("diagonal", -3.0), ("circular", 4.0)):
        setattr(train["derotator"], key, [value] * u.deg)
    chain = (
        train["calibration_polarizer"]
        | optics.LinearRetarder(
            retardance=-170 * u.deg, mount="hwp", name="hwp", fixed={"theta": False}
        )
        | train["derotator"]
        | train["wollaston"]
    )
    data = simulate(chain, 1.6 * u.um, FRAMES, noise=False)
    finding, _ = finding_of(Measurement(chain, data))
    assert (finding.rank, finding.n_free) == (6, 8)


def test_diagonal_retardance_is_a_misalignment_at_first_order():
    """(i): turning a retarder d by a small angle a gives a 45 deg retardance 2 d a."""
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.EllipticalRetarder(
            horizontal=100 * u.deg, mount="derotator", name="derotator", fixed={"theta": False}
        )
        | optics.WollastonPrism(efficiency=0.97, name="wollaston")
    )
    for parameter in (chain["hwp"].retardance, chain["derotator"].circular):
        parameter.fixed = True
    data = simulate(chain, 1.6 * u.um, FRAMES, noise=False)
    finding, _ = finding_of(Measurement(chain, data))
    (direction,) = finding.directions
    moved = direction["parameters"]
    assert set(moved) == {"derotator.theta", "derotator.diagonal"}
    ratio = moved["derotator.diagonal"] / moved["derotator.theta"]
    # T(-a) M T(a) turns the retardance vector by 2 a in the direction of -45 deg
    assert abs(ratio) == pytest.approx(2 * np.deg2rad(100.0), rel=1e-6)


def test_rank_of_the_calibration_of_charis(make):
    """93 parameters of the paper have two null directions; two fixed angles remove them."""
    for kind, fixed, rank, n_free in [
        ("elliptical", False, 91, 93),
        ("elliptical", True, 91, 91),
        ("linear", False, 49, 49),
        ("linear", True, 47, 47),
    ]:
        truth = make.truth(make.chain(kind, fixed=fixed))
        finding, _ = finding_of(Measurement(truth, make.observe(truth, noise=False)))
        assert (finding.rank, finding.n_free) == (rank, n_free), (kind, fixed, rank, n_free)
        assert len(finding.directions) == n_free - rank, (kind, fixed, rank, n_free)
        if n_free > rank:
            leads = {d["words"].split(" by ")[0] for d in finding.directions}
            assert leads <= {"hwp.theta", "derotator.theta", "calibration_polarizer.theta"}, (
                kind,
                fixed,
                rank,
                n_free,
            )
            known = dict(zip(finding.names, finding.identifiable, strict=True))
            assert known["hwp.w_sio2"], (kind, fixed, rank, n_free)
            assert known["wollaston.efficiency[3]"], (kind, fixed, rank, n_free)
            assert not known["derotator.circular[3]"], (kind, fixed, rank, n_free)


# --- the null directions are true ------------------------------------------------------------


@settings(max_examples=20)
@given(
    weights=st.tuples(st.floats(-1, 1), st.floats(-1, 1)).filter(lambda w: max(map(abs, w)) > 0.1)
)
def test_step_along_the_null_directions_leaves_the_data_unchanged(weights, make):
    """To second order: half the step leaves a quarter of the change."""
    truth = make.truth(make.chain("elliptical", fixed=False))
    measurement = Measurement(truth, make.observe(truth, noise=False))
    finding, _ = finding_of(measurement)
    vector = measurement.vector()
    direction = np.array(weights) @ finding.null_vectors * measurement.free.steps
    step = direction / np.abs(direction).max() * np.deg2rad(0.5)

    def change(share):
        return np.abs(measurement.predict(vector + share * step) - measurement.observed).max()

    other = np.zeros_like(step)
    other[measurement.free.by_name["derotator.horizontal"].slice] = np.deg2rad(0.5)
    ordinary = np.abs(measurement.predict(vector + other) - measurement.observed).max()
    assert change(1.0) < 0.05 * ordinary
    assert change(0.5) < 0.27 * change(1.0)


def test_null_vectors_are_orthonormal_and_null(make):
    truth = make.truth(make.chain("elliptical", fixed=False))
    measurement = Measurement(truth, make.observe(truth, noise=False))
    finding, _ = finding_of(measurement)
    null = finding.null_vectors
    np.testing.assert_allclose(null @ null.T, np.eye(2), atol=1e-12)
    scaled = measurement.jacobian(measurement.vector()) * measurement.free.steps[:, None]
    assert np.abs(null @ scaled).max() < 1e-9 * finding.singular_values[0]
    np.testing.assert_allclose(
        finding.singular_values[91:], 0, atol=1e-9 * finding.singular_values[0]
    )


# --- errors ------------------------------------------------------------------------------------


def test_covariance_is_the_inverse_normal_matrix(make):
    truth = make.truth(make.chain())
    measurement = Measurement(truth, make.observe(truth, seed=1))
    whitened = measurement.jacobian(measurement.vector()) / measurement.sigma
    finding, covariance = analyse(measurement.free, whitened)
    assert finding.identifiable.all()
    # in steps, so that an element has the same weight whatever its unit
    scale = measurement.free.steps
    covariance, whitened = covariance / np.outer(scale, scale), whitened * scale[:, None]
    np.testing.assert_allclose(covariance @ (whitened @ whitened.T), np.eye(47), atol=1e-7)


def test_held_parameter_counts_as_known(make):
    """At a bound: no error of its own, and the others are as if it were fixed."""
    truth = make.truth(make.chain())
    data = make.observe(truth, seed=1)
    measurement = Measurement(truth, data)
    held = np.array([name == "calibration_polarizer.theta" for name in measurement.free.names])
    finding, covariance = finding_of(measurement, held)
    assert not finding.identifiable[held].any()
    assert np.isnan(covariance[held]).all()
    truth["calibration_polarizer"].theta.fixed = True
    _, expected = finding_of(Measurement(truth, data))
    np.testing.assert_allclose(covariance[np.ix_(~held, ~held)], expected, rtol=1e-6)


def test_parameter_that_ends_at_a_bound_is_flagged(make):
    chain = make.chain(wavelength=[1.2, 1.6, 2.2] * u.um)
    truth = make.truth(chain)
    chain["calibration_polarizer"].theta.bounds = (89.8, 90.2)  # the truth is 90.4
    data = make.observe(truth, wavelength=[1.2, 1.6, 2.2] * u.um, seed=1)
    cal = calibrate(chain, data, cross_validate=False)
    assert cal.at_bound == ["calibration_polarizer.theta"]
    known = cal.parameter_values()["calibration_polarizer.theta"]
    assert known["at_bound"]
    assert not known["identifiable"]
    assert np.isnan(known["std"])
    assert "At a bound" in cal.summary(full=True)
    assert known["value"] == pytest.approx(90.2)


def test_scale_is_a_degree_a_micrometre_or_a_percent():
    chain = optics.TwoLayerWaveplate(name="plate", fixed={"theta": False}) | optics.WollastonPrism(
        name="wollaston"
    )
    free = FreeParameters([chain], 1)
    assert free.names == ["plate.theta", "plate.w_sio2", "plate.w_mgf2", "wollaston.efficiency"]
    np.testing.assert_allclose(free.steps, [np.deg2rad(1.0), 1.0, 1.0, 0.01])


def test_words_say_rank_and_directions(make):
    truth = make.truth(make.chain("elliptical", fixed=False))
    finding, _ = finding_of(Measurement(truth, make.observe(truth, noise=False)))
    words = str(finding)
    assert words.startswith("The data determine 91 combinations of 93 free parameters.")
    assert words.count("cannot be distinguished from") == 2


def test_more_parameters_than_data_is_no_obstacle():
    free = FreeParameters([optics.WollastonPrism(name="w", fixed={"theta": False})], 1)
    finding, covariance = analyse(free, np.array([[1.0], [0.0]]))
    assert finding.rank == 1
    assert finding.identifiable.tolist() == [True, False]
    np.testing.assert_allclose(covariance, [[1, np.nan], [np.nan, np.nan]])


def test_no_information_at_all():
    free = FreeParameters([optics.WollastonPrism(name="w")], 1)
    finding, covariance = analyse(free, np.zeros((1, 4)))
    assert finding.rank == 0
    assert np.isnan(covariance).all()


# --- determined, but badly ------------------------------------------------------------------


def faint(make, flux, fixed=True, **options):
    """An elliptical derotator at three angles, with as much or little light as is asked for."""
    lam = [1.2, 1.6, 2.0, 2.2] * u.um
    chain = make.truth(make.chain("elliptical", fixed=fixed, wavelength=lam))
    frames = half_wave_plate_cycles(derotator=[45, 90, 120] * u.deg)
    data = make.observe(chain, frames, lam, seed=1, flux=flux)
    for name, prior in options.items():
        getattr(chain["derotator"], name).prior = prior
    options = {"weights": "errors", "errors": "white", "search": False}
    return calibrate(chain, data, cross_validate=False, **options)


def test_what_is_uncertain_by_many_degrees_is_named(make):
    """Little light makes the rank no smaller: the words say what the noise does to a parameter."""
    cal = faint(make, 1e3)
    finding = cal.identifiability
    assert finding.rank == finding.n_free
    assert finding.directions == []
    worst = finding.near_null[0]
    names = [name for name in worst["parameters"] if name.startswith("derotator")]
    assert names
    assert re.match(
        r"derotator\.\w+\[0\] is uncertain by \d+ deg at the noise of this fit", worst["words"]
    )
    assert "; on sky the AoLP changes by up to " in worst["words"]
    said = float(worst["words"].split("uncertain by ")[1].split(" deg")[0])
    lead = worst["words"].split(" is uncertain")[0]
    # one direction is a part of the whole error
    std = cal.covariance.std(lead).to_value(u.deg)
    assert 0.4 * std < said < 1.05 * std
    assert f"badly determined: {worst['words']}" in str(finding)
    assert max(map(abs, worst["parameters"][lead[:-3]])) == pytest.approx(said, rel=0.06)


def test_the_effect_on_sky_is_that_of_one_standard_error(make):
    """Each direction is moved by hand, and the change of the AoLP worked out anew."""
    cal = faint(make, 1e3)
    live, scale = cal.measurement, cal.measurement.free.steps
    for direction in cal.identifiability.near_null[:2]:
        change = np.zeros(live.free.size)
        for slot in live.free.slots:
            if slot.name in direction["parameters"]:
                size = 0.01 if slot.unit is None else 1.0
                change[slot.slice] = np.array(direction["parameters"][slot.name]) / size
        view = view_of_measurement(live, live.vector())
        (sky,) = consequences_along(view, (change * scale)[None])
        # what moves least is left out
        for key in ("aolp_deg", "dolp_percent"):
            limit = 0.05 * np.abs(direction["sky"][key]).max() + 0.05
            np.testing.assert_allclose(sky[key], direction["sky"][key], atol=limit)


def test_it_is_known_before_the_data_are_taken(make):
    """From the noise to be expected; without it there is no size of any error."""
    live = faint(make, 1e3).measurement
    found = examine(live, 1 / live.sigma).near_null
    assert [d["words"] for d in found] == [
        d["words"] for d in faint(make, 1e3).identifiability.near_null
    ]
    assert examine(live).near_null == []


def test_enough_light_leaves_nothing_badly_determined(make):
    assert faint(make, 1e8).identifiability.near_null == []
    assert "badly determined" not in str(faint(make, 1e8).identifiability)


def test_a_prior_is_a_remedy(make):
    """Priors count as data where it is asked what is uncertain."""
    before = faint(make, 1e3).identifiability.near_null
    priors = {key: Normal(0 * u.deg, 1 * u.deg) for key in ("diagonal", "circular")}
    after = faint(make, 1e3, **priors).identifiability.near_null
    leads = {d["words"].split("[")[0] for d in before}
    assert leads & {"derotator.diagonal", "derotator.circular"}
    left = {d["words"].split("[")[0] for d in after}
    assert not left & {"derotator.diagonal", "derotator.circular"}


def test_open_directions_are_not_badly_determined_ones(make):
    finding = faint(make, 1e8, fixed=False).identifiability
    assert len(finding.directions) == 2
    assert finding.near_null == []


def test_a_bad_condition_is_named_whatever_the_noise():
    """Two angles of which the data see the sum a million times better than the difference."""
    chain = angles_chain()
    free = FreeParameters([chain], 1)
    jacobian = np.array([[1.0, 1e-6], [1.0, -1e-6]]) / np.deg2rad(1.0) * 1e9
    whitened = Whitened(jacobian, free.steps)
    (found,) = near_null_directions(free, whitened, 1.0, lambda changes: [None] * len(changes))
    assert "(condition 1e+06)" in found["words"]
    assert "sky" not in found
    values = list(found["parameters"].values())
    assert values[0] == pytest.approx(-values[1])


def test_one_parameter_at_many_wavelengths_is_one_sentence():
    """All wavelengths uncertain together, as where a direction common to all is."""
    chain = optics.LinearRetarder(retardance=[1, 2, 3] * u.deg, name="x")
    free = FreeParameters([chain], 3)
    common = np.ones((3, 1)) / np.sqrt(3)
    others = np.linalg.svd(np.ones((1, 3)))[2][1:].T
    jacobian = np.hstack([common / 20, others]) / np.deg2rad(1.0)
    (found,) = near_null_directions(
        free, Whitened(jacobian, free.steps), 1.0, lambda c: [None] * len(c)
    )
    assert found["words"] == (
        "x.retardance is uncertain by 12 to 12 deg at 3 wavelengths together at the noise of this "
        "fit"
    )


# --- one decomposition for all ----------------------------------------------------------------


@given(
    n_data=st.integers(3, 12),
    n_priors=st.integers(0, 3),
    held=st.lists(st.booleans(), min_size=5, max_size=5),
    seed=st.integers(0, 2**32 - 1),
)
def test_problem_decomposed_once_is_that_of_the_normal_equations(n_data, n_priors, held, seed):
    """Covariance, leverage and freedom against plain inverses."""
    rng, held = np.random.default_rng(seed), np.array(held)
    data, priors = rng.normal(size=(5, n_data)), rng.normal(size=(5, n_priors))
    scale = rng.uniform(0.1, 10, 5)
    found = Whitened(data, scale, priors if n_priors else None, held)
    live = np.flatnonzero(~held)
    normal = (data @ data.T + priors @ priors.T)[np.ix_(live, live)]
    if live.size and np.linalg.cond(normal) > 1e8:
        return
    inverse = np.linalg.inv(normal) if live.size else np.zeros((0, 0))
    stds = np.sqrt(np.diag(inverse))
    covariance = found.covariance()[np.ix_(live, live)]
    off = (covariance - inverse) / np.outer(stds, stds)
    np.testing.assert_allclose(off, 0, atol=1e-6)
    assert np.isnan(found.covariance()[held]).all()
    hat = data[live].T @ inverse @ data[live]
    np.testing.assert_allclose(found.leverage, np.diag(hat), atol=1e-6)
    assert found.n_taken == pytest.approx(np.trace(hat), abs=1e-6)
    assert found.data.rank == np.linalg.matrix_rank(data)


def test_without_priors_and_bounds_there_is_one_decomposition(make):
    measurement = Measurement(make.chain(), make.observe(make.chain(), seed=1))
    vector = measurement.vector()
    found = Whitened(measurement.jacobian(vector), measurement.free.steps)
    assert found.data is found.together is found.errors
