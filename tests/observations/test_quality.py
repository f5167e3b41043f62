# Licensed under a 3-clause BSD style license - see LICENSE
"""Frames that no calibration should use: found, masked with a reason, and said."""

import warnings

import astropy.units as u
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations
from astropolcal.observations.grid import (
    brightness,
    clusters,
    cycle_numbers,
    is_star,
    mask_incomplete_cycles,
    mask_saturated,
    mask_unstable_lamp,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
FEW = [1200, 1600, 2200] * u.nm
DEROTATOR = np.linspace(45, 132.5, 8) * u.deg
CRITICAL = [0, 45, 22.5, 67.5] * u.deg


def internal(lamp=None, derotator=DEROTATOR, source="unpolarized", **options):
    chain = CHARIS.chain(source, wavelength=FEW)
    frames = half_wave_plate_cycles(derotator=derotator)
    return simulate(chain, FEW, frames, lamp=lamp, seed=3, meta={"source": source}, **options)


def cycles(n=3, drop=(), saturated=None):
    frames = half_wave_plate_cycles(CRITICAL, np.full(n, 90) * u.deg)
    if saturated is not None:
        frames["saturated"] = saturated
    frames = frames[np.setdiff1d(np.arange(len(frames)), drop)]
    return simulate(CHARIS.chain("unpolarized", wavelength=FEW), FEW, frames, seed=1, name="star")


def test_which_sources_are_stars():
    for source, star in [
        ("unpolarized standard star", True),
        ("polarized standard-star", True),
        ("Star", True),
        ("sky", True),
        ("polarized", False),
        ("starting lamp", False),
        (None, False),
    ]:
        assert is_star(source) == star, (source, star)


# --- cycles ---------------------------------------------------------------------------------------


def test_cycles_are_numbered_by_returning_angles():
    assert cycle_numbers(cycles()).tolist() == np.repeat([0, 1, 2], 4).tolist()
    # cycles may be given
    observations = cycles()
    table = observations.to_table()
    table["cycle"] = np.asarray(table["frame"]) // 2
    assert cycle_numbers(Observations.from_table(table)).max() == 5


def test_run_whose_first_frame_is_lost_is_cut_at_the_right_place():
    observations = cycles(drop=[0])
    assert cycle_numbers(observations).tolist() == [0] * 4 + [1] * 4 + [2] * 3
    assert cycle_numbers(observations, 0 * u.deg).tolist() == [0] * 3 + [1] * 4 + [2] * 4
    with pytest.warns(AstropolcalWarning, match=r"3 of 11 frames masked"):
        masked = mask_incomplete_cycles(observations)
    assert np.flatnonzero(masked.mask.all(axis=1)).tolist() == [0, 1, 2]


def test_only_incomplete_cycles_are_masked_with_reason_and_reported():
    with pytest.warns(AstropolcalWarning, match=r"3 of 11 frames masked, incomplete half-wave"):
        masked = mask_incomplete_cycles(cycles(drop=[6]))
    assert masked.mask_reasons == {"incomplete half-wave-plate cycle": 3 * len(FEW)}
    assert np.flatnonzero(masked.mask.all(axis=1)).tolist() == [4, 5, 6]
    # complete ones stay untouched
    observations = cycles()
    assert mask_incomplete_cycles(observations) is observations


def test_cycle_whose_frame_is_masked_is_incomplete():
    observations = cycles().with_mask(np.arange(12) == 9, "cloud")
    with pytest.warns(AstropolcalWarning, match=r"3 of 12 frames masked"):
        masked = mask_incomplete_cycles(observations)
    assert masked.mask_reasons["cloud"] == len(FEW)
    assert masked.mask.all(axis=1).sum() == 4


def test_no_complete_cycle_is_an_error():
    with pytest.raises(ObservationError, match=r"star: none of its 1 half-wave-plate cycles"):
        mask_incomplete_cycles(cycles(n=1, drop=[3]))


# --- saturation and negative sums -----------------------------------------------------------------


def test_saturated_frames_are_masked():
    for flag in [np.arange(12) == 4, 7 * (np.arange(12) == 4)]:
        with pytest.warns(AstropolcalWarning, match=r"1 of 12 frames masked, saturated: frame 4"):
            masked = mask_saturated(cycles(saturated=flag))
        assert masked.mask_reasons == {"saturated": len(FEW)}, flag
    # flag that is no flag is an error
    with pytest.raises(ObservationError, match="column saturated has type"):
        mask_saturated(cycles(saturated=np.full(12, "yes")))


# --- lamp ---------------------------------------------------------------------------------------


def test_brightness_is_relative_to_the_median_frame():
    lamp = np.ones(64)
    lamp[7] = 0.5
    found = brightness(internal(lamp, noise=False))
    np.testing.assert_allclose(found, lamp, rtol=0.03)


def test_warming_lamp_and_single_dim_frame_are_masked():
    lamp = np.ones(64)
    lamp[:8] = np.linspace(0.2, 0.9, 8)
    with pytest.warns(AstropolcalWarning, match=r"8 of 64 frames masked, unstable lamp"):
        masked = mask_unstable_lamp(internal(lamp))
    assert np.flatnonzero(masked.mask.all(axis=1)).tolist() == list(range(8))
    # single dim frame is masked alone
    lamp = np.ones(64)
    lamp[20] = 0.7
    with pytest.warns(AstropolcalWarning, match=r"1 of 64 frames masked, unstable lamp: frame 20"):
        mask_unstable_lamp(internal(lamp))


def test_good_lamps_keep_all_frames():
    for source in ["polarized", "unpolarized"]:
        for lamp in [
            np.ones(64),
            np.linspace(0.5, 1.5, 64),
            1 + 0.3 * np.linspace(-1, 1, 64) ** 2,
            np.random.default_rng(1).normal(1, 0.05, 64),
        ]:
            assert mask_unstable_lamp(internal(lamp, source=source)).mask.sum() == 0, (lamp, source)


def test_unstable_lamp_of_the_real_runs(shared_data):
    """The paper leaves out derotator 45 deg of Dataset 4, and nothing else."""
    for name, masked in [("dataset1", 0), ("dataset3", 0), ("dataset4", 8)]:
        (path,) = (shared_data / "data" / "charis").glob(f"{name}*.ecsv")
        observations = Observations.read(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropolcalWarning)
            lost = mask_unstable_lamp(observations).mask.all(axis=1)
        assert lost.sum() == masked, (name, masked)
        derotator = np.rad2deg(observations.position("derotator"))[lost]
        np.testing.assert_allclose(derotator, 45, atol=1)


@pytest.mark.slow
def test_simulated_runs_of_others_keep_all_frames(shared_data):
    folders = sorted((shared_data / "gap-cases").glob("case*"))[::4]
    for path in (p for folder in folders for p in folder.glob("*.ecsv")):
        assert mask_unstable_lamp(Observations.read(path)).mask.sum() == 0, path


def test_clusters():
    for values, gap, numbers in [
        ([45.0, 60.0, 45.2, 90.0], 0.5, [0, 1, 0, 2]),
        ([3.0, 1.0, 2.0], 0.5, [2, 0, 1]),
        # a chain of small steps is one cluster
        ([0.0, 0.4, 0.8, 1.2], 0.5, [0, 0, 0, 0]),
        ([0.0, 0.5], 0.5, [0, 0]),
        ([7.0], 1.0, [0]),
    ]:
        assert clusters(np.array(values), gap).tolist() == numbers, (values, gap, numbers)


def test_encoders_that_are_not_exact_change_no_cycle():
    """Neither at angles of a plate that are odd multiples of 11.25 deg, nor at a whole turn."""
    rng = np.random.default_rng(4)
    for angles in (CRITICAL, [11.25, 56.25, 33.75, 78.75] * u.deg, [179.9, 45, 22.5, 67.5] * u.deg):
        frames = half_wave_plate_cycles(angles, np.zeros(6) * u.deg)
        for stage in ("hwp", "derotator"):
            off = rng.normal(0, 0.01, len(frames)) * u.deg
            frames[stage] = np.mod(frames[stage] + off, 180 * u.deg)
        night = simulate(CHARIS.chain("unpolarized", wavelength=FEW), FEW, frames, seed=1)
        expected = np.repeat(np.arange(6), 4).tolist()
        for start in (None, angles[0]):
            assert cycle_numbers(night, start).tolist() == expected, (angles, start)
