# Licensed under a 3-clause BSD style license - see LICENSE
"""The covariance matrix with names and units."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from astropolcal.calibration import Calibration, calibrate
from astropolcal.calibration.uncertainty.covariance import Covariance, full_covariance
from astropolcal.exceptions import ParameterError
from astropolcal.measurement import Normal

NAMES, UNITS = ["hwp.theta", "hwp.w_sio2", "wollaston.efficiency"], [u.deg, u.mm, None]
MATRIX = np.array([[0.04, 0.001, np.nan], [0.001, 0.0001, np.nan], [np.nan, np.nan, np.nan]])


@pytest.fixture
def covariance():
    return Covariance(NAMES, UNITS, MATRIX)


def test_std_has_the_unit(covariance):
    assert u.isclose(covariance.std("hwp.theta"), 0.2 * u.deg)
    assert u.isclose(covariance.std("hwp.w_sio2"), 10 * u.um)


def test_what_is_not_determined_is_nan(covariance):
    assert np.isnan(covariance.std("wollaston.efficiency"))
    np.testing.assert_allclose(covariance.stds, [0.2, 0.01, np.nan])
    assert repr(covariance) == "<Covariance of 3 parameters, 2 of them determined>"
    assert len(covariance) == 3


def test_correlation(covariance):
    assert covariance.correlation[0, 1] == pytest.approx(0.001 / (0.2 * 0.01))
    np.testing.assert_allclose(np.diag(covariance.correlation)[:2], 1)
    assert np.isnan(covariance.correlation[2]).all()


def test_equality(covariance):
    assert covariance == Covariance(NAMES, UNITS, MATRIX)
    assert covariance != Covariance(NAMES, [u.deg, u.um, None], MATRIX)
    assert covariance != Covariance(NAMES, UNITS, 2 * MATRIX)
    assert covariance != MATRIX.tolist()


def test_matrix_is_a_copy(covariance):
    matrix = np.array([[1.0]])
    made = Covariance(["a.b"], [None], matrix)
    matrix[0, 0] = 2.0
    assert made.matrix[0, 0] == 1.0


def test_unknown_name_is_refused(covariance):
    with pytest.raises(ParameterError, match=r"no parameter 'hwp.phase'"):
        covariance.std("hwp.phase")


def test_shapes_must_agree():
    for names, units, shape in [
        (NAMES, UNITS, (2, 2)),
        (NAMES, UNITS, (3, 2)),
        (NAMES[:2], UNITS, (3, 3)),
        (NAMES, UNITS[:2], (3, 3)),
    ]:
        with pytest.raises(ParameterError, match="covariance of"):
            Covariance(names, units, np.ones(shape))


def test_asymmetric_matrix_is_refused():
    """In units of the errors, whatever these are: rounding is allowed, another number is not."""
    for stds in [(1.0, 1.0), (10.0, 1e-6), (1e-16, 1e-16)]:

        def made(upper, lower, stds=stds):
            matrix = [[1, upper], [lower, 1]] * np.outer(stds, stds)
            return Covariance(["a.b", "a.c"], [None, None], matrix)

        assert made(3e-16, -2e-16).matrix.shape == (2, 2), stds
        for upper, lower in ((0.5, -0.5), (0.5, 0.49), (np.nan, 0.5)):
            with pytest.raises(ParameterError, match=r"symmetric: that of a\.b and a\.c is "):
                made(upper, lower)


# --- what depends on the parameters -------------------------------------------------------

ANGLES = ["polarizer.theta", "hwp.theta"]


@pytest.fixture
def sum_known():
    """Two angles of which the data know the sum, to 0.2 deg, and an efficiency at its bound."""
    factor = np.array([[0.1, 0.1, 0.0]])
    return Covariance(
        [*ANGLES, "wollaston.efficiency"],
        [u.deg, u.deg, None],
        np.full((3, 3), np.nan),
        factor=factor,
        null=[[1.0, -1.0, 0.0]],
    )


def test_sum_is_known_and_its_parts_are_not(sum_known):
    assert sum_known.propagate([1, 1, 0]) == pytest.approx(0.04)
    assert sum_known.propagate([1, 0, 0]) == np.inf
    assert sum_known.propagate([0, 1, 0]) == np.inf
    matrix = sum_known.propagate([[1, 1, 0], [1, 0, 0], [2, 2, 0]])
    np.testing.assert_allclose(
        matrix, [[0.04, np.nan, 0.08], [np.nan, np.inf, np.nan], [0.08, np.nan, 0.16]]
    )


def test_small_move_along_an_open_direction_is_infinite_too(sum_known):
    assert sum_known.propagate([1, 1.001, 0]) == np.inf
    # but a rounding error is not a move
    assert np.isfinite(sum_known.propagate([1, 1 + 1e-9, 0]))


def test_what_rests_on_a_bound_alone_has_no_error(sum_known):
    assert np.isnan(sum_known.propagate([0, 0, 1]))
    # beside others the bound counts as known
    assert sum_known.propagate([1, 1, 5]) == pytest.approx(0.04)
    assert sum_known.propagate([1, 0, 1]) == np.inf


def test_constant_has_no_error(sum_known):
    assert sum_known.propagate([0, 0, 0]) == 0


def test_without_directions_determined_parameters_still_propagate(covariance):
    assert covariance.propagate([1, 0, 0]) == pytest.approx(0.04)
    assert covariance.propagate([1, 10, 0]) == pytest.approx(0.04 + 2 * 10 * 0.001 + 100 * 1e-4)
    assert np.isnan(covariance.propagate([1, 0, 1]))


def test_open_direction_of_a_covariance_without_factor():
    """What a file tells that names its open directions only: infinite, or not known."""
    known = Covariance(ANGLES, [u.deg, u.deg], np.full((2, 2), np.nan), null=[[1, -1]])
    assert known.propagate([1, 0]) == np.inf
    assert np.isnan(known.propagate([1, 1]))


@settings(max_examples=30)
@given(arrays(float, (2, 3), elements=st.floats(-10, 10)))
def test_full_rank_is_the_textbook_formula(slopes):
    root = np.array([[0.1, 0.0, 0.0], [0.02, 0.001, 0.0], [0.05, 0.002, 0.3]])
    matrix = root.T @ root
    made = Covariance(NAMES, UNITS, matrix, factor=root, null=np.zeros((0, 3)))
    plain = Covariance(NAMES, UNITS, matrix)
    expected = slopes @ matrix @ slopes.T
    scale = 1e-9 * (1 + np.abs(expected).max())
    np.testing.assert_allclose(made.propagate(slopes), expected, rtol=1e-6, atol=scale)
    np.testing.assert_allclose(plain.propagate(slopes), expected, rtol=1e-6, atol=scale)


def test_slopes_must_fit(covariance):
    for slopes in [[1, 2], [[1, 2]], np.ones((1, 1, 3)), 1.0]:
        with pytest.raises(ParameterError, match="do not fit"):
            covariance.propagate(slopes)


def test_directions_must_be_finite():
    with pytest.raises(ParameterError, match="factor of a covariance"):
        Covariance(["a.b"], [None], [[1.0]], factor=[[np.nan]])


# --- of a calibration ---------------------------------------------------------------------

LAM = [1.2, 1.6, 2.2] * u.um


def test_directions_agree_with_the_matrix(make):
    for weights in [None, "errors"]:
        for fixed in [True, False]:
            truth = make.truth(make.chain("elliptical", fixed=fixed, wavelength=LAM))
            data = make.observe(truth, wavelength=LAM, seed=1)
            cal = calibrate(truth, data, weights=weights, search=False, cross_validate=False)
            full = full_covariance(cal)
            assert full == cal.covariance, (weights, fixed)
            rank = cal.identifiability.rank
            assert full.factor.shape == (rank, len(full)), (weights, fixed)
            assert full.null.shape == (len(full) - rank, len(full)), (weights, fixed)
            known = np.isfinite(full.stds)
            product = full.factor.T @ full.factor
            np.testing.assert_allclose(
                product[np.ix_(known, known)], full.matrix[np.ix_(known, known)], rtol=1e-6
            )
            variances = np.diag(full.propagate(np.eye(len(full))))
            np.testing.assert_allclose(variances[known], full.stds[known] ** 2, rtol=1e-6)
            assert np.isinf(variances[~known]).all(), (weights, fixed)
            assert known.all() == fixed, (weights, fixed)


def test_prior_closes_an_open_direction(make):
    """With priors the error is finite, because the gauge has a name."""
    truth = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    for name in ("hwp", "derotator"):
        truth[name].theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    data = make.observe(truth, wavelength=LAM, seed=1)
    cal = calibrate(truth, data, weights="errors", search=False, cross_validate=False)
    full = full_covariance(cal)
    assert not len(full.null)
    slopes = np.eye(len(full))[full.names.index("hwp.theta")]
    assert np.sqrt(full.propagate(slopes)) == pytest.approx(0.1, rel=0.05)
    product = full.factor.T @ full.factor
    known = cal.covariance
    off = (product - known.matrix) / np.outer(known.stds, known.stds)
    np.testing.assert_allclose(off, 0, atol=1e-9)


def test_from_a_file_the_open_stays_open(make, tmp_path):
    """Determined parameters as before; what the data leave open never gets a finite error."""
    truth = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    cal = calibrate(truth, make.observe(truth, wavelength=LAM, seed=1), cross_validate=False)
    cal.write(tmp_path / "cal.asdf")
    again = full_covariance(Calibration.read(tmp_path / "cal.asdf"))
    here, there = (np.diag(c.propagate(np.eye(len(c)))) for c in (full_covariance(cal), again))
    np.testing.assert_allclose(there, here, rtol=1e-6)
    rng = np.random.default_rng(0)
    assert not np.isfinite(np.diag(again.propagate(rng.normal(size=(5, len(again)))))).any()


def test_a_prior_tells_no_more_than_its_width(make):
    """A cusp (Laplace, exponential) pins the value, and yet the data alone know it better."""
    lam = [1.2, 1.6, 2.2] * u.um
    chain = make.truth(make.chain(wavelength=lam, fixed=False))
    chain["derotator"].theta.fixed = chain["hwp"].theta.fixed = True
    data = make.observe(chain, wavelength=lam, seed=1)
    name = "calibration_polarizer.theta"
    fitted = calibrate(chain, data, search=False, cross_validate=False).parameter_values()[name]
    value, std = float(fitted["value"]), float(fitted["std"])
    for law in (stats.laplace, stats.cauchy, stats.expon, stats.norm):
        chain["calibration_polarizer"].theta.prior = law(value, 20 * std)
        cal = calibrate(chain, data, search=False, cross_validate=False)
        known = cal.parameter_values()[name]
        # an exponential law is a bound, too
        key = "std_inward" if law is stats.expon else "std"
        assert float(known[key]) == pytest.approx(std, rel=0.05), law.name


def test_widened_along_a_direction():
    """Of two that turn together the sum is as long as its way, and the difference stays known."""
    # a third that is known well, and moves where the way bends
    rows = np.array([[3, 3, 0], [0, 0.01, 0], [0, 0, 0.1]])
    before = Covariance(list("abc"), [u.deg] * 3, rows.T @ rows, factor=rows)
    way, more = np.array([4.0, 4.0, 0.5]), np.array([1.0, 1.0, 0.5])
    wide = before.widened([(0, way, more), (0, way / 2, more / 2), (1, -way, -more)])
    assert wide.stds[0] == pytest.approx(4)
    assert wide.propagate([1, -1, 0]) ** 0.5 == pytest.approx(0.01, rel=0.1)
    assert wide.stds[2] == pytest.approx(np.hypot(0.1, 0.5))
    np.testing.assert_allclose(np.diag(wide.factor.T @ wide.factor) ** 0.5, wide.stds)
    assert np.linalg.eigvalsh(wide.matrix - before.matrix).min() > -1e-12
    assert before.widened([(0, way * 2.9 / 4, more)]) == before
    # two ways of one length, up to rounding
    rng = np.random.default_rng(0)
    for rows in rng.normal(size=(300, 40, 3)):
        many = Covariance(list("abc"), [u.mm] * 3, rows.T @ rows, factor=rows)
        longer = many.stds[0] * rng.uniform(1.1, 2) * way / way[0]
        twice = many.widened([(0, longer, more), (0, -longer, -more)])
        assert twice.stds[0] == pytest.approx(longer[0])
    # what does not go on with the element stays about as well known, however far the way leads
    for far in (3.0, 30.0, 3e3):
        way, more = np.array([3 * far, 3, 0]), np.array([3 * far - 3, 0, 0])
        assert before.widened([(0, way, more)]).stds[1] < 2 * before.stds[1]
