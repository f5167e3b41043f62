# Licensed under a 3-clause BSD style license - see LICENSE
"""Which of the equivalent solutions a calibration reports, and that it says so."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, calibrate, instruments
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.measurement import Normal
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


def test_the_gauge_is_recorded_and_read_back(observations, tmp_path):
    minimal = _fit(_chain(), observations)
    assert minimal.settings["gauge"].startswith("minimal")
    for name in ANGLES:
        assert name in minimal.settings["gauge"]
    assert "Gauge: minimal" in minimal.summary()
    minimal.write(tmp_path / "cal.asdf")
    assert Calibration.read(tmp_path / "cal.asdf").settings == minimal.settings
    assert "accident" in _fit(_chain(), observations, gauge=None).settings["gauge"]


def test_fixing_is_a_gauge_and_gives_errors(observations):
    fixed = _fit(_chain(), observations, fix={"hwp.theta": 0 * u.deg, "derotator.theta": None})
    assert fixed.settings["gauge"].startswith("held: hwp.theta, derotator.theta")
    assert "the data determine every free parameter" in fixed.settings["gauge"]
    assert np.all(np.isfinite(fixed.covariance.stds))
    assert fixed.identifiability.rank == len(fixed.covariance)


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
    free = _fit(_chain(), observations, weights="errors")
    value = free.parameter_values()[name]["value"]
    rows = [free.covariance.names.index(f"{name}[{i}]") for i in range(4)]
    data = free.covariance.matrix[np.ix_(rows, rows)]
    mean, std = float(value.mean()), float(np.sqrt(data[0, 0]))
    chain["wollaston"].efficiency.prior = Normal(mean, std)
    pulled = _fit(chain, observations, weights="errors")
    # a prior on these four alone combines with their covariance as two measurements do
    posterior = np.linalg.inv(np.linalg.inv(data) + np.eye(4) / std**2)
    expected = posterior @ (np.linalg.inv(data) @ value + mean / std**2)
    known = pulled.parameter_values()[name]
    assert np.abs(expected - value).max() > 0.2 * std
    np.testing.assert_allclose(known["value"], expected, atol=0.02 * std)
    np.testing.assert_allclose(known["std"], np.sqrt(np.diag(posterior)), rtol=0.01)
    assert "none for calibration_polarizer.theta" in pulled.settings["gauge"]


def test_without_a_choice_there_is_no_gauge(observations):
    linear = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")
    linear["hwp"].theta.fixed = True
    assert _fit(linear, observations).settings["gauge"] == "the data determine every free parameter"


@pytest.mark.parametrize(
    ("options", "error", "complaint"),
    [
        ({"gauge": "landau"}, FitError, "'minimal' and None"),
        ({"fix": {"hwp.tilt": None}}, FitError, "no parameter 'hwp.tilt'"),
        ({"fix": {"hwp.theta": 1 * u.mm}}, ParameterError, "not convertible"),
        ({"fix": {"hwp.theta": 1}}, ParameterError, "needs a unit"),
    ],
)
def test_nonsense_is_refused(observations, options, error, complaint):
    with pytest.raises(error, match=complaint):
        _fit(_chain(), observations, **options)
