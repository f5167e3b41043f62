# Licensed under a 3-clause BSD style license - see LICENSE
"""Which of the equivalent solutions a calibration reports, and that it says so."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import (
    DogBoxLSQFitter,
    LevMarLSQFitter,
    LinearLSQFitter,
    TRFLSQFitter,
)

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.calibration.fit.branches import BinProblem
from astropolcal.calibration.fit.calibrate import describe_gauge, hold_silent
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.measurement import Measurement, Normal
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[6, 9, 12, 16]]
ANGLES = ("calibration_polarizer.theta", "hwp.theta", "derotator.theta")


def _truth():
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH)
    chain["derotator"].diagonal = [-4, -3, -2, -2] * u.deg
    chain["derotator"].circular = [2, 4, 5, 5] * u.deg
    chain["hwp"].theta, chain["derotator"].theta = 0.4 * u.deg, -0.3 * u.deg
    return chain


@pytest.fixture(scope="module")
def observations():
    frames = half_wave_plate_cycles(derotator=np.arange(45, 135, 12.5) * u.deg)
    return simulate(_truth(), WAVELENGTH, frames, flux=1e8, seed=4)


def _chain(**theta):
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH)
    for name, angle in theta.items():
        chain[name].theta = angle * u.deg
    return chain


def _angles(calibration):
    known = calibration.parameter_values()
    return np.array([float(known[name]["value"]) for name in ANGLES])


def _fit(chain, observations, **options):
    return calibrate(chain, observations, cross_validate=False, **options)


def test_the_minimal_gauge_does_not_depend_on_the_way(observations):
    first = _fit(_chain(), observations)
    chain = _chain()
    chain["derotator"].diagonal = [-1, -2, -3, -4] * u.deg
    second = _fit(chain, observations)
    np.testing.assert_allclose(_angles(first), _angles(second), atol=2e-3)


def test_the_minimal_gauge_moves_the_angles_least(observations):
    home = np.array([90.0, 0.0, 0.0])
    minimal, accident = (_fit(_chain(), observations, gauge=g) for g in ("minimal", None))
    near, far = (np.sum((_angles(c) - home) ** 2) for c in (minimal, accident))
    assert near <= far + 1e-6
    # the polarizer and the half-wave plate turn together, the derotator alone: home is known
    assert _angles(minimal)[2] == pytest.approx(0.0, abs=1e-3)
    polarizer, plate, _ = _angles(minimal) - home
    assert polarizer + plate == pytest.approx(0.0, abs=2e-3)


@pytest.mark.slow
def test_every_gauge_fits_the_data_as_well(observations):
    costs = [
        np.sum(_fit(chain, observations, **options).residuals ** 2)
        for chain, options in (
            (_chain(), {}),
            (_chain(), {"gauge": None}),
            (_chain(), {"fix": {"hwp.theta": 0 * u.deg, "derotator.theta": None}}),
            (_chain(hwp=2.0, derotator=-1.5), {}),
        )
    ]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-3)


@pytest.mark.slow
def test_the_gauge_is_recorded_and_read_back(observations, tmp_path):
    minimal = _fit(_chain(), observations)
    assert minimal.settings["gauge"].startswith("minimal")
    for name in ANGLES:
        assert name in minimal.settings["gauge"]
    assert "Gauge: minimal" in minimal.summary(full=True)
    minimal.write(tmp_path / "cal.asdf")
    assert Calibration.read(tmp_path / "cal.asdf").settings == minimal.settings
    assert "accident" in _fit(_chain(), observations, gauge=None).settings["gauge"]


def test_fixing_is_a_gauge_and_gives_errors(observations):
    fixed = _fit(_chain(), observations, fix={"hwp.theta": 0 * u.deg, "derotator.theta": None})
    assert fixed.settings["gauge"].startswith("held: hwp.theta, derotator.theta")
    assert "the data determine every free parameter" in fixed.settings["gauge"]
    assert np.all(np.isfinite(fixed.covariance.stds))
    assert fixed.identifiability.rank == len(fixed.covariance)
    for one in ("hwp.theta", ["hwp.theta"]):
        assert (
            _fit(_chain(), observations, fix=one).settings["gauge"].startswith("held: hwp.theta;")
        )


def test_a_prior_is_a_gauge_and_gives_errors(observations):
    chain = _chain()
    for name in ("hwp", "derotator"):
        chain[name].theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    cal = _fit(chain, observations)
    assert cal.settings["gauge"].startswith("prior on hwp.theta, derotator.theta")
    assert "data and priors determine every free parameter" in cal.settings["gauge"]
    known = cal.parameter_values()
    assert known["hwp.theta"]["std"] == pytest.approx(0.1, rel=0.02)
    assert known["hwp.theta"]["value"] == pytest.approx(0.0, abs=0.01)
    # what the data alone do not determine is still not identifiable
    assert not known["hwp.theta"]["identifiable"]
    assert cal.identifiability.rank == len(cal.covariance) - 2


def test_a_prior_competes_with_the_data_by_their_errors(observations):
    chain, name = _chain(), "wollaston.efficiency"
    free = _fit(_chain(), observations, weights="errors", errors="white")
    value = free.parameter_values()[name]["value"]
    rows = [free.covariance.names.index(f"{name}[{i}]") for i in range(4)]
    data = free.covariance.matrix[np.ix_(rows, rows)]
    mean, std = float(value.mean()), float(np.sqrt(data[0, 0]))
    chain["wollaston"].efficiency.prior = Normal(mean, std)
    pulled = _fit(chain, observations, weights="errors", errors="white")
    # a prior on these four alone combines with their covariance as two measurements do
    posterior = np.linalg.inv(np.linalg.inv(data) + np.eye(4) / std**2)
    expected = posterior @ (np.linalg.inv(data) @ value + mean / std**2)
    known = pulled.parameter_values()[name]
    assert np.abs(expected - value).max() > 0.2 * std
    np.testing.assert_allclose(known["value"], expected, atol=0.02 * std)
    np.testing.assert_allclose(known["std"], np.sqrt(np.diag(posterior)), rtol=0.01)
    # a prior on something else leaves the choice of a gauge where it is
    gauge = "prior on wollaston.efficiency; minimal: of all equal fits, the least change of "
    assert pulled.settings["gauge"].startswith(gauge + "calibration_polarizer.theta, hwp.theta")
    np.testing.assert_allclose(_angles(pulled), _angles(free), atol=5e-3)


def test_directions_that_priors_leave_open_are_settled(observations):
    """A prior on one of three angles closes one direction of two; the derotator goes home."""
    found = []
    for derotator in (0.0, 0.4):
        chain = _chain()
        chain["hwp"].theta.prior = Normal(0.2 * u.deg, 0.05 * u.deg)
        chain["derotator"].diagonal = np.full(4, -4.0 + 5 * derotator) * u.deg
        cal = _fit(chain, observations)
        assert cal.settings["gauge"] == (
            "prior on hwp.theta; minimal: of all equal fits, the least change of derotator.theta"
        )
        assert _angles(cal)[2] == pytest.approx(0.0, abs=1e-3)
        assert _angles(cal)[1] == pytest.approx(0.2, abs=1e-3)
        known = cal.parameter_values()
        assert known["hwp.theta"]["std"] == pytest.approx(0.05, rel=0.02)
        assert np.isfinite(known["calibration_polarizer.theta"]["std"])
        assert np.isnan(known["derotator.theta"]["std"])
        found.append(cal)
    np.testing.assert_allclose(_angles(found[0]), _angles(found[1]), atol=2e-3)
    accident = _fit(_chain(), observations, gauge=None)
    assert np.abs(_angles(accident)[2]) > 1e-2


def test_settling_does_not_leave_the_priors(observations):
    """The sum of squares with priors is what the gauge must not spoil."""
    chain = _chain()
    chain["hwp"].theta.prior = Normal(0.2 * u.deg, 0.05 * u.deg)
    chain["wollaston"].efficiency.prior = Normal(0.97, 0.003)
    totals = []
    for gauge in ("minimal", None):
        cal = _fit(chain, observations, gauge=gauge)
        live = cal.measurement
        problem = BinProblem(live, live.weighting)
        totals.append(0.5 * np.sum(problem.residuals(live.vector()) ** 2))
    assert totals[0] == pytest.approx(totals[1], rel=1e-3)


def test_describe_gauge_names_priors_and_choice(observations):
    chain = _chain()
    chain["hwp"].theta.prior = Normal(0 * u.deg, 1 * u.deg)
    free = Measurement(chain, observations).free
    words = describe_gauge(None, ["derotator.theta"], free, ["hwp.w_sio2"])
    assert words == (
        "held: hwp.w_sio2; prior on hwp.theta; none for derotator.theta: where the fit ended, an "
        "accident of its start"
    )


# --- what moves no datum --------------------------------------------------------------------


@pytest.mark.slow
def test_what_moves_no_datum_stays_at_its_start(observations):
    """One wavelength without data: its four parameters, and nothing else, keep their values."""
    for fitter in [TRFLSQFitter, LevMarLSQFitter, DogBoxLSQFitter]:
        for gauge in ["minimal", None]:
            mask = np.zeros((observations.n_frames, 4), dtype=bool)
            mask[:, 1] = True
            masked, chain = observations.with_mask(mask, "test"), _chain()
            start = Measurement(chain, masked).vector()
            cal = _fit(chain, masked, fitter=fitter(), gauge=gauge)
            silent = ["horizontal", "diagonal", "circular"]
            silent = [f"derotator.{key}[1]" for key in silent] + ["wollaston.efficiency[1]"]
            assert cal.identifiability.silent == silent, gauge
            rows = [cal.covariance.names.index(name) for name in silent]
            np.testing.assert_array_equal(cal.measurement.vector()[rows], start[rows])
            assert np.isnan(cal.covariance.stds[rows]).all(), gauge
            assert not cal.at_bound, gauge
            for name in silent:
                words = (
                    f"{name} changes no datum: it cannot be determined and keeps its start value"
                )
                assert words in str(cal.identifiability), gauge


def test_what_drifted_without_a_datum_is_brought_back(observations):
    """As a fitter would leave it that walks along what changes nothing, to a bound."""
    mask = np.zeros((observations.n_frames, 4), dtype=bool)
    mask[:, 1] = True
    live = Measurement(_chain(), observations.with_mask(mask, "test"))
    origin, slot = live.vector(), live.free.by_name["wollaston.efficiency"].slice
    drifted = origin.copy()
    drifted[slot] = [0.9, 1.0, 0.91, 0.92]
    live.stand_at(drifted)
    hold_silent(live, origin)
    np.testing.assert_array_equal(live.vector()[slot], [0.9, origin[slot][1], 0.91, 0.92])


def test_what_is_silent_at_the_start_only_is_fitted():
    """Without retardance an axis changes nothing; the fit finds both."""
    chain = (
        optics.LinearPolarizer(theta=20 * u.deg, name="polarizer")
        | optics.LinearRetarder(
            retardance=0 * u.deg, theta=10 * u.deg, name="window", fixed={"theta": False}
        )
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.9, name="wollaston")
    )
    truth = chain.copy()
    truth["window"].retardance, truth["window"].theta = 40 * u.deg, 14 * u.deg
    frames = half_wave_plate_cycles(derotator=[45] * u.deg)
    data = simulate(truth, WAVELENGTH, frames, flux=1e8, seed=4)
    chain["hwp"].retardance.fixed = chain["wollaston"].efficiency.fixed = True
    cal = _fit(chain, data)
    assert cal.identifiability.silent == []
    assert cal.chain["window"].theta.value != 10


def test_a_prior_speaks_for_what_is_silent(observations):
    """It then stands where its prior has it."""
    mask = np.zeros((observations.n_frames, 4), dtype=bool)
    mask[:, 1] = True
    chain = _chain()
    chain["wollaston"].efficiency.prior = Normal(0.95, 0.02)
    cal = _fit(chain, observations.with_mask(mask, "test"))
    known = cal.parameter_values()["wollaston.efficiency"]
    assert known["value"][1] == pytest.approx(0.95, abs=1e-6)
    assert known["std"][1] == pytest.approx(0.02, rel=1e-3)
    assert "wollaston.efficiency[1]" in cal.identifiability.silent
    assert "only its prior tells it" in str(cal.identifiability)


def test_without_a_choice_there_is_no_gauge(observations):
    linear = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")
    linear["hwp"].theta.fixed = True
    assert _fit(linear, observations).settings["gauge"] == "the data determine every free parameter"


def test_nonsense_is_refused(observations):
    for options, error, complaint in [
        ({"gauge": "landau"}, FitError, "allowed are minimal, None"),
        ({"fix": {"hwp.tilt": None}}, FitError, "fix: hwp has no parameter 'tilt'"),
        ({"fix": {"hwp.theta": 1 * u.mm}}, ParameterError, "not convertible"),
        ({"fix": {"hwp.theta": 1}}, ParameterError, "needs a unit"),
        ({"fix": {"hwp.theta": [1, 2] * u.deg}}, FitError, r"\[1. 2.\] deg; allowed is one value$"),
        (
            {"fix": {"derotator.diagonal": [1, 2] * u.deg}},
            FitError,
            "allowed is one value or 4, one per wavelength",
        ),
        ({"ties": {"hwp.theta": "derotator.theta"}}, ParameterError, "of type str; a Tie is"),
        ({"ties": {"hwp.theta": "x"}, "own": "derotator.theta"}, ParameterError, "a Tie is"),
        ({"fitter": "TRF"}, FitError, "fitter = 'TRF'; allowed are astropy's"),
        ({"instrument": CHARIS}, FitError, "instrument is of type CHARIS; its name is needed"),
        ({"fitter": LinearLSQFitter()}, FitError, "allowed are astropy's non-linear ones"),
        ({"fitter": TRFLSQFitter}, FitError, "fitter = .*TRFLSQFitter.*; allowed are astropy's"),
    ]:
        with pytest.raises(error, match=complaint):
            _fit(_chain(), observations, **options)
