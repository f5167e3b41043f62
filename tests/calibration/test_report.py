# Licensed under a 3-clause BSD style license - see LICENSE
"""Harmonics, mirror solutions and consequences on sky, in numbers and in words."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import calibrate, instruments, optics
from astropolcal.calibration import examine
from astropolcal.calibration.identifiability.analysis import (
    harmonic_conditions,
    harmonic_words,
    mirror_branches,
)
from astropolcal.calibration.identifiability.sky import consequences_along, view_of_measurement
from astropolcal.chain import join
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[7, 11, 16]]
EIGHT = np.deg2rad(np.arange(8) * 11.25)


# ---- harmonics ----------------------------------------------------------------------


def test_condition_numbers():
    for n, expected in [
        (8, (1.414, 27.48, 14184)),
        (16, (1.414, 1.414, 53.58)),
        (32, (1.414, 1.414, 1.414)),
    ]:
        found = harmonic_conditions(np.deg2rad(np.arange(n) * 11.25))
        np.testing.assert_allclose(list(found.values()), expected, rtol=1e-3)
    # too few angles separate nothing
    found = harmonic_conditions(np.deg2rad([0, 45, 22.5, 67.5]))
    assert found[(0, 4)] == pytest.approx(np.sqrt(2))
    assert found[(0, 2, 4)] == np.inf


def test_words_name_the_angles_to_add():
    second, first = harmonic_words(EIGHT)
    assert "0 to 78.75 deg" in second
    assert "harmonic 2" in second
    assert "add 90 to 168.75 deg" in second
    assert "harmonic 1, 2" in first
    assert "add 90 to 348.75 deg" in first
    assert harmonic_words(np.deg2rad(np.arange(32) * 11.25)) == []


@pytest.mark.slow
@given(st.sampled_from([4, 8, 12, 16]), st.floats(0, 20))
def test_following_the_advice_cures_it(n, start):
    angles = np.deg2rad(start + np.arange(n) * 11.25)
    words = harmonic_words(angles)
    if words:
        low, high = _advised(words[-1])
        added = np.deg2rad(np.arange(low, high + 1e-6, 11.25))
        assert harmonic_words(np.concatenate([angles, added])) == []


def _advised(words):
    first, _, last = words.rsplit("add ", 1)[1].removesuffix(" deg").partition(" to ")
    return float(first), float(last)


# ---- mirror solutions ------------------------------------------------------------------


def _measurement(chain):
    frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    return Measurement(chain, simulate(chain, WAVELENGTH, frames, noise=False))


def _polarimeter(**derotator):
    return (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=[170, 172, 175] * u.deg, mount="hwp", name="hwp")
        | optics.EllipticalRetarder(
            horizontal=[100, 80, 60] * u.deg,
            diagonal=[4, 3, 2] * u.deg,
            circular=[5, 5, 4] * u.deg,
            mount="derotator",
            name="derotator",
            **derotator,
        )
        | optics.WollastonPrism(efficiency=[0.98, 0.97, 0.96], name="wollaston")
    )


def _mirrors(measurement):
    return [branch["words"] for branch in mirror_branches(measurement, measurement.vector(), None)]


def test_all_mirror_solutions_of_free_retarders():
    measurement = _measurement(_polarimeter())
    found = _mirrors(measurement)
    assert [words.split(":")[0] for words in found] == ["hwp", "derotator", "hwp, derotator"]
    # bounds exclude mirror solutions
    bounds = dict.fromkeys(("horizontal", "diagonal", "circular"), (0, 360))
    measurement = _measurement(_polarimeter(bounds=bounds))
    assert [w.split(":")[0] for w in _mirrors(measurement)] == ["hwp"]
    # a waveplate of two layers has no other hand
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH)
    measurement = _measurement(chain)
    found = _mirrors(measurement)
    assert [words.split(":")[0] for words in found] == ["derotator"]


# ---- on sky -----------------------------------------------------------------------------


def _direction(measurement, **changes):
    out = np.zeros((1, measurement.free.size))
    for name, value in changes.items():
        out[0, measurement.free.by_name[name.replace("__", ".")].slice] = value
    return out


def _consequences(measurement, directions):
    return consequences_along(view_of_measurement(measurement, measurement.vector()), directions)


def test_efficiency_changes_the_dolp_alone():
    measurement = _measurement(_polarimeter())
    efficiency = np.array([0.98, 0.97, 0.96])
    one_percent = _direction(measurement, wollaston__efficiency=-0.01 * efficiency)
    (sky,) = _consequences(measurement, one_percent)
    # a model of one percent less efficiency finds one percent more polarization
    assert sky["dolp_percent"] == pytest.approx([1.0, 1.0], abs=1e-3)
    assert sky["aolp_deg"] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_turning_everything_turns_the_sky():
    chain = _polarimeter()
    for name in ("hwp", "derotator", "wollaston"):
        chain[name].theta.fixed = False
    measurement = _measurement(chain)
    turn = dict.fromkeys(("hwp__theta", "derotator__theta", "wollaston__theta"), np.deg2rad(1))
    (sky,) = _consequences(measurement, _direction(measurement, **turn))
    assert sky["aolp_deg"] == pytest.approx([1.0, 1.0], abs=1e-4)
    assert sky["dolp_percent"] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_the_polarizer_is_not_on_sky():
    chain = _polarimeter()
    chain["polarizer"].theta.fixed = False
    measurement = _measurement(chain)
    (sky,) = _consequences(measurement, _direction(measurement, polarizer__theta=1.0))
    for part in (sky, *sky["targets"]):
        assert part["aolp_deg"] == [0.0, 0.0]
    assert [t["dolp_change_percent"] for t in sky["targets"]] == [[0.0, 0.0]] * 3


def test_without_an_optic_that_turns_there_is_no_sky():
    chain = join([optics.LinearRetarder(retardance=90 * u.deg, name="plate"),
                  optics.WollastonPrism(name="wollaston")])  # fmt: skip
    measurement = _measurement(chain)
    assert _consequences(measurement, np.ones((2, 2))) == [None, None]


# ---- all of it in a calibration -----------------------------------------------------------


@pytest.fixture(scope="module")
def calibration():
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH)
    frames = half_wave_plate_cycles(derotator=np.arange(45, 120, 12.5) * u.deg)
    observations = simulate(chain, WAVELENGTH, frames, seed=6)
    return calibrate(chain, observations, cross_validate=False)


def test_the_report_says_all_of_it(calibration):
    text = " ".join(calibration.summary(full=True).split())
    assert (
        "calibration_polarizer.theta by +1 deg cannot be distinguished from hwp.theta by +1 deg"
        in text
    )
    assert "on sky the AoLP changes by up to 1 deg" in text
    assert "separate harmonic 2 badly" in text
    assert "mirror solution: derotator" in text
    summary = calibration.to_dict()
    assert summary["null_directions"][0]["sky"]["aolp_deg"] == pytest.approx([1, 1], abs=1e-3)
    assert len(summary["sampling"]) == 2
    assert len(summary["mirror_solutions"]) == 1


def test_a_run_can_be_examined_before_it_is_fitted(calibration):
    before = examine(calibration.measurement)
    assert before.rank == calibration.identifiability.rank
    assert [d["words"].split(" by ")[0] for d in before.directions] == [
        d["words"].split(" by ")[0] for d in calibration.identifiability.directions
    ]
    frames = half_wave_plate_cycles(
        hwp=np.arange(16) * 11.25 * u.deg, derotator=np.arange(45, 120, 12.5) * u.deg
    )
    chain = calibration.chain
    planned = examine(Measurement(chain, simulate(chain, WAVELENGTH, frames, noise=False)))
    assert len(planned.sampling) == 1 < len(before.sampling)
