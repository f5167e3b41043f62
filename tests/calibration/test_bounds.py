# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors at a bound and next to one, against profiles and fits without the bound."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, optics
from astropolcal.calibration import calibrate, profile
from astropolcal.calibration.uncertainty.covariance import STATUSES, status_of
from astropolcal.exceptions import CalibrationFileError
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6, 2.2] * u.um
POLARIZER = "calibration_polarizer.theta"


def fitted(make, bounds, kind="elliptical", efficiency=None, **options):
    """A fit of a polarizer at 90.4 deg within other bounds."""
    chain = make.chain(kind, wavelength=LAM)
    truth = make.truth(chain)
    data = make.observe(truth, wavelength=LAM, seed=1)
    chain["calibration_polarizer"].theta.bounds = bounds
    chain["calibration_polarizer"].theta = np.clip(90, *bounds) * u.deg
    if efficiency is not None:
        chain["wollaston"].efficiency.bounds = (0, efficiency)
        chain["wollaston"].efficiency = np.full(3, efficiency - 0.01)
    return calibrate(chain, data, cross_validate=False, **options)


@pytest.fixture(scope="module")
def cal(make):
    return fitted(make, (85, 90.39))


# --- errors of what is at a bound ------------------------------------------------------------


@pytest.mark.slow
def test_one_sided_error_is_where_the_profile_has_risen_by_one(make):
    # far from the bound, near it, at the lower one, and several at bounds that correlate
    cases = [((85, 90.2), None), ((85, 90.39), None), ((90.5, 95), None), ((85, 90.2), 0.965)]
    for weights, some in [(None, cases), ("errors", cases[-1:])]:
        for bounds, efficiency in some:
            cal = fitted(make, bounds, efficiency=efficiency, weights=weights)
            assert POLARIZER in cal.at_bound, weights
            assert len(cal.at_bound) > 1 or efficiency is None, weights
            for name in cal.at_bound:
                row = cal.parameters[cal.parameters["name"] == name][0]
                assert (row["status"], np.isnan(row["std"])) == ("at bound", True), weights
                made = profile(cal, name, n=13)
                best = getattr(made.best, "value", made.best)
                ends = [abs(getattr(end, "value", end) - best) for end in made.interval()]
                assert min(ends) == pytest.approx(row["std_inward"], rel=0.02), weights
                assert max(ends) == np.inf, weights


def test_few_data_tell_the_noise_badly_at_a_bound_and_with_stated_noise_too():
    chain = (
        optics.LinearPolarizer(name="polarizer", fixed={"theta": False})
        | optics.LinearRetarder(retardance=173 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=100 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.95, name="wollaston")
    )
    frames = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, [45, 80, 115] * u.deg)
    seen = simulate(chain, [1.6] * u.um, frames, flux=1e5, seed=1)
    free = calibrate(chain, seen, cross_validate=False)
    # six data and four parameters: of residuals, whatever the noise of the data is said to be
    stated = calibrate(chain, seen, weights=0.01, cross_validate=False)
    np.testing.assert_allclose(stated.covariance.stds, free.covariance.stds, rtol=1e-4)
    value, std = (free.parameter_values()["wollaston.efficiency"][key] for key in ("value", "std"))
    bounded = chain.copy()
    bounded["wollaston"].efficiency = value - 0.02 * std
    bounded["wollaston"].efficiency.bounds = (0.5, value - 0.01 * std)
    bounded = calibrate(bounded, seen, cross_validate=False)
    inward = bounded.parameter_values()["wollaston.efficiency"]["std_inward"]
    # the noise is measured with one parameter less
    assert 0.7 * std < inward < std


def test_correlated_residuals_count_at_a_bound_too(make):
    """Beyond it the standard error would allow as much as it does inward of it."""
    inward, wanted = [], []
    for seed in range(6):
        chain = make.truth(make.chain())
        data = make.off_at_settings(chain, seed=seed)
        free = calibrate(chain, data, search=False, cross_validate=False)
        value, std = (float(free.parameter_values()[POLARIZER][key]) for key in ("value", "std"))
        # so that chi-square still falls a little beyond
        bound = value - 0.1 * std
        chain["calibration_polarizer"].theta.bounds = (85, bound)
        chain["calibration_polarizer"].theta = bound * u.deg
        held = calibrate(chain, data, search=False, cross_validate=False)
        known = held.parameter_values()[POLARIZER]
        assert known["at_bound"]
        low, _ = profile(held, POLARIZER, n=13).interval()
        assert bound - low.value == pytest.approx(float(known["std_inward"]), rel=0.05)
        inward.append(float(known["std_inward"]))
        wanted.append((np.sqrt(1.01) - 0.1) * std)
    assert np.median(np.divide(inward, wanted)) == pytest.approx(1, rel=0.1)


# --- errors next to a bound ---------------------------------------------------------------------


def test_errors_without_the_bound_are_those_of_a_fit_without_it(make, cal):
    free = fitted(make, (85, 95))
    released, other = cal.parameters, free.parameters
    hanging = released["status"] == "conditional"
    assert 3 < hanging.sum() < len(released) - 1
    # the noise comes from the residuals, which a bound enlarges a little
    np.testing.assert_allclose(released["std_released"][hanging], other["std"][hanging], rtol=0.15)
    np.testing.assert_array_less(1.1 * released["std"][hanging], released["std_released"][hanging])
    assert set(released["conditional_on"][hanging]) == {POLARIZER}
    plain = released["status"] == "determined"
    np.testing.assert_allclose(released["std"][plain], other["std"][plain], rtol=0.1)
    assert np.isnan(released["std_released"][plain]).all()
    assert not np.isin(other["status"], ["conditional", "at bound"]).any()
    assert f"conditional on {POLARIZER} at its bound; without it" in " ".join(
        cal.summary(full=True).split()
    )


def test_what_only_a_bound_determines_is_open_without_it(make):
    """Turning polarizer and half-wave plate together changes no datum."""
    chain = make.chain("elliptical", fixed=False, wavelength=LAM)
    chain["derotator"].theta.fixed = True
    data = make.observe(make.truth(chain), wavelength=LAM, seed=1)
    chain = calibrate(chain, data, cross_validate=False).chain
    # a bound right where the fit ends, so that nothing pushes against it
    angle = chain["calibration_polarizer"].theta
    angle.bounds = (float(angle.value), 95)
    cal = calibrate(chain, data, search=False, cross_validate=False)
    known = cal.parameter_values()
    assert known[POLARIZER]["status"] == "at bound"
    assert known[POLARIZER]["std_inward"] == np.inf
    assert "not limited" in cal.summary()
    for name in ("hwp.theta", "derotator.circular"):
        assert np.isin(known[name]["status"], ["conditional", "badly determined"]).all()
        # within the bounds of the polarizer nothing says where it is
        assert (known[name]["std"] > 0.1).all()
        assert np.isfinite(known[name]["std"]).all()
        assert np.isinf(known[name]["std_released"]).all()


# --- status, files ----------------------------------------------------------------------------


def test_status_of_every_kind():
    plain = {"std": 0.01, "std_released": np.nan, "unit": u.deg, "bounds": (-5, 5)}
    plain |= {"fixed": False, "tied": None, "at_bound": False, "identifiable": True}
    open_bounds = {"bounds": (None, 5)}
    nothing = {"std": np.nan, "identifiable": False}
    for changes, status in (
        ({}, "determined"),
        ({"identifiable": False}, "by priors"),
        ({"fixed": True}, "fixed"),
        ({"tied": "a.b"}, "tied"),
        (nothing, "open"),
        (nothing | {"at_bound": True}, "at bound"),
        ({"std": np.nan}, "badly determined"),  # no noise is known
        ({"std": 2.8}, "determined"),
        ({"std": 3.0}, "badly determined"),  # anywhere between the bounds
        ({"std": 3.0} | open_bounds, "determined"),
        ({"std": 5.1} | open_bounds, "badly determined"),
        ({"std": 0.06, "unit": u.mm, "bounds": (0, 2)}, "badly determined"),
        ({"std": 0.04, "unit": u.mm, "bounds": (0, 2)}, "determined"),
        ({"std": 0.06, "unit": None, "bounds": (0, 1)}, "badly determined"),
        ({"std_released": np.inf}, "conditional"),
        ({"std": 6.0, "std_released": np.inf} | open_bounds, "badly determined"),
    ):
        assert status_of(plain | changes) == status, changes
        assert status in STATUSES


@pytest.mark.slow
def test_file_keeps_them_and_refuses_what_is_none(cal, tmp_path):
    cal.write(tmp_path / "cal.asdf")
    again = Calibration.read(tmp_path / "cal.asdf")
    assert again.fit["bounds"] == cal.fit["bounds"]
    assert (again.parameters["status"] == cal.parameters["status"]).all()
    for bad in ([1], {"inward": 1}, {"inward": {"a": "b"}}, {"released": {"a": {"times": 1.0}}}):
        again.fit["bounds"] = bad
        with pytest.raises(CalibrationFileError, match=r"fit\.bounds"):
            again.write(tmp_path / "bad.asdf")
    # files from before did not say it
    del again.fit["bounds"]
    assert np.isnan(again.parameters["std_inward"]).all()
    assert "conditional" not in again.parameters["status"]
