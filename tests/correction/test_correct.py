# Licensed under a 3-clause BSD style license - see LICENSE
"""A disk and a star through the real chain: exact without noise, pulls of one with it."""

import copy
import dataclasses
import re
import warnings
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import Observations, calibrate, instruments, optics
from astropolcal.calibration import fitted_stars, with_validity
from astropolcal.correction import ScienceFrames, correct
from astropolcal.correction.correcting import _uneven
from astropolcal.correction.geometry import derotate
from astropolcal.correction.rows import sky_chain
from astropolcal.exceptions import (
    AstropolcalWarning,
    CalibrationFileError,
    ObservationError,
    ParameterError,
    WavelengthRangeError,
)


@pytest.fixture(scope="module")
def disk_frames(sky, charis, track, scene, seen):
    hwp, positions = track()
    stokes = scene(22)
    right, left = seen(sky, positions, charis.wavelength, stokes)
    return stokes, right, left, positions, hwp


def frames_of(disk_frames, charis, **settings):
    _, right, left, positions, hwp = disk_frames
    return ScienceFrames.from_arrays(right, left, charis.wavelength, positions, hwp=hwp, **settings)


def test_disk_comes_back_exactly(disk_frames, sky, charis):
    for observable in ["intensity", "single", "double"]:
        found = correct(sky, frames_of(disk_frames, charis), observable=observable)
        stokes = disk_frames[0]
        np.testing.assert_allclose(found.q, stokes[1] / stokes[0], atol=1e-10)
        np.testing.assert_allclose(found.u, stokes[2] / stokes[0], atol=1e-10)
        parts = found.azimuthal()
        np.testing.assert_allclose(parts["u_phi"], 0, atol=1e-10)
        assert found.covariance is None, observable
        assert np.isnan(found.fractional_errors()["q"]).all(), observable


def test_quarter_turns_of_the_field_are_exact(sky, charis, track, scene, seen):
    """A camera that turns between frames; the rows refer to the sky, the images do not."""
    _, positions = track(1)
    stokes = scene(22)
    right, left = seen(sky, positions, charis.wavelength, stokes)
    camera = [0, 90, 180, 270] * u.deg
    for beam in (right, left):
        for i, angle in enumerate(camera):
            beam[i] = derotate(beam[i], -angle)
    turned = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, position_angle=camera
    )
    found = correct(sky, turned)
    np.testing.assert_allclose(found.q, stokes[1] / stokes[0], atol=1e-10)
    assert found.north_up
    wrong = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, position_angle=-camera
    )
    assert np.abs(correct(sky, wrong).q - stokes[1] / stokes[0]).max() > 0.01


def test_what_some_frames_do_not_show_is_found_from_the_others(sky, charis, track, seen):
    """Corners that turn out of the image must not count as dark."""
    _, positions = track(2)
    stokes = np.ones((3, 22, 11, 11)) * np.array([100.0, 2.0, -1.0])[:, None, None, None]
    right, left = seen(sky, positions, charis.wavelength, stokes)
    camera = np.repeat([0, 45], 4) * u.deg
    frames = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, position_angle=camera
    )
    found = correct(sky, frames)
    np.testing.assert_allclose(found.stokes, stokes, rtol=1e-9)


@pytest.mark.slow
def test_any_turn_of_the_field(sky, charis, track, scene, seen):
    _, positions = track(2)
    stokes = scene(22, size=31)
    camera = np.linspace(0, 50, 8) * u.deg
    right, left = seen(sky, positions, charis.wavelength, stokes)
    for beam in (right, left):
        for i, angle in enumerate(camera):
            beam[i] = derotate(beam[i], -angle, order=5)
    found = correct(
        sky,
        ScienceFrames.from_arrays(
            right, left, charis.wavelength, positions, position_angle=camera, order=5
        ),
    )
    rows, columns = np.indices((31, 31)) - 15
    inner = np.hypot(rows, columns) < 13
    q = (stokes[1] / stokes[0])[:, inner]
    assert np.abs(found.q[:, inner] - q).max() < 0.02 * np.abs(q).max()


def test_pulls_of_noise(disk_frames, sky, charis):
    """Statistical errors alone: the chain is the true one."""
    stokes, right, left, positions, hwp = disk_frames
    rng = np.random.default_rng(7)
    variances = [beam / 4 + 3 for beam in (right, left)]
    noisy = [
        beam + rng.normal(size=beam.shape) * np.sqrt(variance)
        for beam, variance in zip((right, left), variances, strict=True)
    ]
    frames = ScienceFrames.from_arrays(
        *noisy,
        charis.wavelength,
        positions,
        hwp=hwp,
        variance_right=variances[0],
        variance_left=variances[1],
    )
    truth = stokes[1:] / stokes[0]
    for settings in ({}, {"observable": "double"}, {"weights": "variance"}):
        found = correct(sky, frames, **settings)
        errors = found.fractional_errors()
        for name, true in zip("qu", truth, strict=True):
            pull = (getattr(found, name) - true) / errors[name]
            assert abs(pull.mean()) < 0.1
            assert abs(pull.std() - 1) < 0.1
        pull = (found["I"] - stokes[0]) / found.error("I")
        assert abs(pull.std() - 1) < 0.1
    # weights by variance do not make it worse
    assert np.median(errors["q"]) <= np.median(correct(sky, frames).fractional_errors()["q"]) * 1.01


@pytest.mark.long
def test_pulls_of_the_calibration(calibration, star, charis, seen, track):
    """Systematic errors alone, noise off: each true instrument differs from the calibrated."""
    from astropolcal.correction.rows import RowModel
    from astropolcal.correction.systematic import _draws

    hwp, positions = track()
    model = RowModel(calibration, positions, charis.wavelength)
    pulls = {"q": [], "u": [], "p": []}
    truth = star.stokes[1:] / star.stokes[0]
    # mean and covariance are those of the errors, and not of the draw: directions that are
    # orthogonal, and of each draw its mirror image
    turned = np.random.default_rng(5).standard_normal((60, model.free.size))
    normal = iter(np.sqrt(60) * np.linalg.qr(turned)[0])
    rng = SimpleNamespace(standard_normal=lambda n: next(normal))
    drawn = np.array(list(_draws(model, 60, rng)))
    for vector in (*drawn, *(2 * model.free.start() - drawn)):
        rows = model.rows(vector)[..., :3]
        right, left = np.einsum("bwfs,sw->bfw", rows, star.stokes)
        frames = ScienceFrames.from_arrays(right, left, charis.wavelength, positions, hwp=hwp)
        found = correct(calibration, frames)
        errors = found.fractional_errors("systematic")
        pulls["q"].append((found.q - truth[0]) / errors["q"])
        pulls["u"].append((found.u - truth[1]) / errors["u"])
        known = found.polarization()
        pulls["p"].append((known["dolp"] - np.hypot(*truth)) / known["s_p_systematic"])
    for values in pulls.values():
        assert abs(np.mean(values)) < 0.02
        assert abs(np.std(values) - 1) < 0.01


@pytest.mark.slow
def test_errors_stay_apart(calibration, star, charis, seen, track):
    hwp, positions = track()
    variance = np.full(star.right.shape, 100.0)
    frames = ScienceFrames.from_arrays(
        *seen(calibration, positions, charis.wavelength, star.stokes),
        charis.wavelength,
        positions,
        hwp=hwp,
        variance_right=variance,
        variance_left=variance,
    )
    found = correct(calibration, frames)
    sampled = correct(calibration, frames, n_samples=300, seed=1)
    np.testing.assert_array_equal(found.covariance, sampled.covariance)
    one, two = (f.fractional_errors("systematic")["q"] for f in (found, sampled))
    np.testing.assert_allclose(two, one, rtol=0.2)
    # ideal: 32 fluxes that each measure half of the light
    assert found.error("I") == pytest.approx(10 * 2 / np.sqrt(32), rel=0.2)
    table = found.table()
    for name in ("s_p_statistical", "s_p_systematic", "s_chi_statistical", "s_chi_systematic"):
        assert (table[name] > 0).all()
    assert (table["dolp_debiased"] < table["dolp"]).all()
    assert table["s_chi_systematic"].unit == u.deg


def test_frames_that_disagree_beyond_all_errors_are_told(calibration, star, charis, seen, track):
    """One of another target, angles that are wrong, a gain; not noise, clouds or a lost slice."""
    hwp, positions = track(2)
    positions = positions | {"derotator": np.repeat([55, 62, 70, 77], 2) * u.deg}
    known = calibration, positions, charis.wavelength
    clean = seen(*known, star.stokes)
    other, gain, faint = clean.copy(), clean.copy(), clean.copy()
    other[:, 2] = seen(*known, star.stokes * [[1], [-3], [6]])[:, 2]
    gain[0, 5] *= 1.02
    faint *= np.linspace(0.3, 1, 8)[:, None]
    faint[:, 3, 7] = np.nan
    turned = positions | {"derotator": positions["derotator"] + np.repeat([0, 30], 4) * u.deg}
    rng, words = np.random.default_rng(3), "the frames disagree: .* q and u may be wrong by"
    for fluxes, where, odd in (
        (clean, positions, ""),
        (faint, positions, ""),
        (other, positions, "frame 2"),
        (gain, positions, "frame 5"),
        (clean, turned, "frame"),
    ):
        noisy = fluxes + np.sqrt(np.nan_to_num(fluxes)) * rng.standard_normal(fluxes.shape)
        right, left = noisy
        variances = dict(zip(("variance_right", "variance_left"), fluxes, strict=True))
        frames = ScienceFrames.from_arrays(
            right, left, charis.wavelength, where, hwp=hwp, **variances
        )
        for observable in ("single", "double"):
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                correct(calibration, frames, observable=observable)
            found = [str(one.message) for one in told if re.search(words, str(one.message))]
            assert len(found) == bool(odd), (odd, observable, found)
            if observable == "single":
                assert all(odd in one for one in found), (odd, found)


def test_frames_disagree_by_the_errors_of_each_wavelength(calibration, charis, seen, track):
    """Noise at one wavelength says nothing about how well the calibration is known at others."""
    hwp, positions = track(2)
    positions["derotator"] = np.repeat([55, 62, 70, 77], 2) * u.deg
    rng, light = np.random.default_rng(2), np.array([1e10, 2e8, 1e8])[:, None] * np.ones(22)
    for faint in (1.0, 1e-8):
        for size, odd in ((0.001, False), (0.03, True)):
            stokes = light * np.where(np.arange(22) == 8, faint, 1.0)
            fluxes = seen(calibration, positions, charis.wavelength, stokes)
            fluxes[0, 5] *= 1 + size
            noisy = fluxes + np.sqrt(fluxes) * rng.standard_normal(fluxes.shape)
            variances = dict(zip(("variance_right", "variance_left"), fluxes, strict=True))
            frames = ScienceFrames.from_arrays(
                *noisy, charis.wavelength, positions, hwp=hwp, **variances
            )
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                correct(calibration, frames, observable="double")
            found = [str(one.message) for one in told if "disagree" in str(one.message)]
            assert len(found) == odd, (faint, size, found)


def test_exchanges_in_one_cycle_show_in_the_sums_of_pairs(sky, charis, track, seen):
    """Of cameras or states: the differences agree with each other, and are wrong."""
    vampires = instruments.get("vampires")
    both = vampires.on_sky(vampires.chain(derotator="linear"))
    rng, words = (
        np.random.default_rng(5),
        "the frames disagree: sums .* against those of .* q and u",
    )
    for chain, instrument in ((sky, charis), (both, vampires)):
        hwp, positions = track(1)
        positions["derotator"] = np.full(4, 60) * u.deg
        n, states = 4, chain is both
        if states:
            hwp, n = np.repeat(hwp, 2), 8
            positions = {key: np.repeat(each, 2) for key, each in positions.items()}
            positions["flc_state"] = np.tile([0.0, 1.0], 4)
        wavelength = instrument.wavelength
        light = np.array([1e6, 2e4, 1e4])[:, None] * np.ones(len(wavelength))
        clean = seen(chain, positions, wavelength, light) * np.linspace(0.5, 1, n)[:, None]
        # gains differ by some percent, not the same at all wavelengths
        clean[0] *= 1 + np.linspace(0.02, 0.05, len(wavelength))
        half, exchanged = clean.copy(), np.arange(n) < n // 2
        half[:, exchanged] = clean[::-1, exchanged]
        cases = [(clean, positions, ()), (half, positions, exchanged)]
        if states:
            wrong = positions["flc_state"].copy()
            wrong[:2] = 1, 0
            cases += [(clean, positions | {"flc_state": wrong}, np.arange(n) < 2)]
        for fluxes, where, odd in cases:
            noisy = fluxes + np.sqrt(fluxes) * rng.standard_normal(fluxes.shape)
            variances = dict(zip(("variance_right", "variance_left"), fluxes, strict=True))
            frames = ScienceFrames.from_arrays(*noisy, wavelength, where, hwp=hwp, **variances)
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                found = correct(chain, frames, observable="double")
            told = [str(one.message) for one in told if "disagree" in str(one.message)]
            off = np.hypot(found.q - 0.02, found.u - 0.01)
            assert (off.max() > 0.01) == (len(odd) > 0), (instrument.name, odd)
            assert len(told) == (len(odd) > 0), (instrument.name, odd, told)
            for one in told:
                named = [int(i) for i in re.findall(r"frame (\d)", re.search(words, one)[0])]
                # two pairs, of which one is right
                assert len(named) == 4
                assert set(odd[named]) == {True, False}, (one, odd)


def test_one_frame_that_is_off_is_told_where_all_others_agree(sky, charis, track, seen):
    """Of eight cycles, by some times the noise: not what scatters evenly by twice the noise."""
    hwp, positions = track(8)
    positions["derotator"] = np.repeat(np.linspace(55, 69, 8), 4) * u.deg
    light = np.array([1e6, 2e4, 1e4])[:, None] * np.ones(22)
    clean = seen(sky, positions, charis.wavelength, light)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise, frame = rng.standard_normal(clean.shape), rng.integers(32)
        for scatter, size, odd in ((1, 0, False), (2, 0, False), (1, 5.5e-3, True)):
            noisy = clean + scatter * np.sqrt(clean) * noise
            noisy[0, frame] *= 1 + size
            variances = dict(zip(("variance_right", "variance_left"), clean, strict=True))
            frames = ScienceFrames.from_arrays(
                *noisy, charis.wavelength, positions, hwp=hwp, **variances
            )
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                found = correct(sky, frames)
            told = [str(one.message) for one in told if "disagree" in str(one.message)]
            error = found.fractional_errors()["q"][0] / np.sqrt(22)
            off = np.hypot(found.q.mean() - 0.02, found.u.mean() - 0.01) / error
            assert off < 8, (seed, scatter, size)
            assert len(told) == odd, (seed, scatter, size, told)
            assert all(f"frame {frame} " in one or f"frame {frame};" in one for one in told), told


def test_a_spectrum_polarized_by_more_than_all_of_it_is_told(star, sky, charis, seen, track):
    positions = track(1)[1]
    for degree, odd in ((0.99, False), (1.2, True)):
        light = star.stokes[:1] * [[1], [degree], [0]]
        fluxes = seen(sky, positions, charis.wavelength, light)
        frames = ScienceFrames.from_arrays(*fluxes, charis.wavelength, positions)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            correct(sky, frames)
        found = [str(one.message) for one in told]
        assert any("polarized by 120 %" in one for one in found) == odd, (degree, found)


def test_offsets_only_leaves_the_crosstalk(disk_frames, sky, charis):
    stokes = disk_frames[0]
    whole = correct(sky, frames_of(disk_frames, charis))
    offsets = correct(sky, frames_of(disk_frames, charis), mode="ip")
    truth = stokes[1] / stokes[0]
    assert np.abs(whole.q - truth).max() < 1e-10
    assert 0.01 < np.abs(offsets.q - truth).max() < 0.3


def test_offsets_only_is_right_for_unpolarized_light(sky, charis, track, seen):
    _, positions = track()
    stokes = np.array([1e4, 0, 0])[:, None] * np.ones(22)
    right, left = seen(sky, positions, charis.wavelength, stokes)
    frames = ScienceFrames.from_arrays(right, left, charis.wavelength, positions)
    np.testing.assert_allclose(correct(sky, frames, mode="ip").q, 0, atol=1e-12)


def test_bad_pixels_count_in_the_other_frames(disk_frames, sky, charis):
    stokes, right, left, positions, hwp = disk_frames
    right, left = right.copy(), left.copy()
    right[2, 5, 8, 8] = left[7, 5, 8, 8] = np.nan
    right[:, 6, 3, 4] = np.nan
    left[:, 9, 1, 1] = right[:, 9, 1, 1] = np.nan
    frames = ScienceFrames.from_arrays(right, left, charis.wavelength, positions, hwp=hwp)
    for observable in ("intensity", "double"):
        found = correct(sky, frames, observable=observable)
        assert found.q[5, 8, 8] == pytest.approx((stokes[1] / stokes[0])[5, 8, 8], abs=1e-10)
        assert np.isnan(found.q[9, 1, 1])
        assert np.isfinite(found.q).sum() >= found.q.size - 2
    # one beam alone says something too, if all the intensities count
    assert np.isfinite(correct(sky, frames, observable="intensity").q[6, 3, 4])


@pytest.mark.slow
def test_dask_changes_no_number(disk_frames, sky, charis):
    da = pytest.importorskip("dask.array", reason="dask is not installed")
    _, right, left, positions, _ = disk_frames
    right = right.copy()
    right[3, :, 4, 4] = np.nan
    frames = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, variance_right=left, variance_left=left
    )
    plain = correct(sky, frames)
    for settings in ({"workers": 2}, {"workers": 1, "chunk": 5}, {"chunk": 22}):
        other = correct(sky, frames, **settings)
        np.testing.assert_array_equal(other.stokes, plain.stokes)
        np.testing.assert_array_equal(other.covariance, plain.covariance)
    lazy = ScienceFrames.from_arrays(
        da.from_array(right, chunks=(16, 2, 21, 21)),
        da.from_array(left, chunks=(16, 2, 21, 21)),
        charis.wavelength,
        positions,
    )
    np.testing.assert_array_equal(correct(sky, lazy, workers=2).stokes, plain.stokes)


def test_a_gain_of_one_beam_cancels_in_pairs_of_unequal_brightness(sky, charis, track, seen):
    """Of spectra, of images, and of pixels that lack a flux in one frame."""
    hwp, positions = track(2)
    positions["derotator"] = np.repeat([60, 70], 4) * u.deg
    light = np.array([1e5, 2e3, -1e3])[:, None] * np.ones(22)
    beams = seen(sky, positions, charis.wavelength, light)
    beams *= np.array([0.4, 1.0, 0.7, 0.5, 1.2, 0.8, 1.0, 0.6])[:, None]
    beams[0] *= 1.1
    images = beams[..., None, None] * np.ones((3, 3))
    images[0, 2, :, 1, 1] = np.nan
    for fluxes in (beams, images):
        frames = ScienceFrames.from_arrays(*fluxes, charis.wavelength, positions, hwp=hwp)
        found = correct(sky, frames, observable="double")
        # what is left is of second order: a gain changes the sum of polarized beams too
        np.testing.assert_allclose(found.q, 0.02, atol=4e-4)
        np.testing.assert_allclose(found.u, -0.01, atol=4e-4)


def test_clouds_are_seen_in_the_light_itself(sky, charis, track, scene, seen):
    for spectrum in [True, False]:
        from astropolcal.correction import measurement_rows

        _, positions = track()
        stokes = scene(22, size=9)
        if spectrum:
            stokes = stokes.sum(axis=(2, 3))
        beams = seen(sky, positions, charis.wavelength, stokes)
        clouds = np.random.default_rng(3).uniform(0.3, 1, size=(16, 22))
        clouds /= clouds.mean(axis=0)
        beams *= clouds.reshape(16, 22, *[1] * (stokes.ndim - 2))
        frames = ScienceFrames.from_arrays(*beams, charis.wavelength, positions)
        given = correct(sky, frames, brightness="given")
        assert np.abs(given.q - stokes[1] / stokes[0]).max() > 1e-3, spectrum
        # unless it is known it is measured
        np.testing.assert_allclose(correct(sky, frames).q, stokes[1] / stokes[0], atol=1e-10)
        known = dataclasses.replace(frames, scale=clouds.T)
        np.testing.assert_array_equal(
            correct(sky, known).q, correct(sky, known, brightness="given").q
        )
        clear = frames.with_brightness(measurement_rows(sky, positions, charis.wavelength))
        np.testing.assert_allclose(clear.scale, clouds.T, rtol=1e-10)
        np.testing.assert_allclose(correct(sky, clear).q, stokes[1] / stokes[0], atol=1e-10)


def test_light_in_one_frame_at_one_wavelength_is_named(sky, charis, track, scene, seen):
    """A cosmic ray that nobody masked; neither noise nor coloured clouds are one."""
    _, positions = track()
    beams = seen(sky, positions, charis.wavelength, scene(22, size=9))
    rng = np.random.default_rng(1)
    clouds = np.linspace(0.6, 1.4, 16)[:, None] ** np.linspace(0.8, 1.2, 22)
    beams *= (clouds * rng.normal(1, 0.002, clouds.shape))[:, :, None, None]
    correct(sky, ScienceFrames.from_arrays(*beams, charis.wavelength, positions))
    beams[1, 5, 7, 2, 3] += 0.2 * beams[:, 5, 7].sum()
    frames = ScienceFrames.from_arrays(*beams, charis.wavelength, positions)
    words = rf"1 of 352 frames .*, most frame 5 at {frames.wavelength[7]:.6g}, by \+23 %"
    with pytest.warns(AstropolcalWarning, match=words):
        correct(sky, frames)
    # two wavelengths do not tell which of them it is
    two = ScienceFrames.from_arrays(*beams[:, :, 6:8], charis.wavelength[6:8], positions)
    assert _uneven(dataclasses.replace(two, scale=np.eye(2, 16) + 1)) == []


def test_what_is_fitted_is_what_the_calibration_fitted(calibration, sky, star, charis, seen):
    right, left = seen(calibration, star.positions, charis.wavelength, star.stokes)

    def frames(**settings):
        beams = (1.02 * right[:n], left[:n])
        positions = {name: angle[:n] for name, angle in star.positions.items()}
        return ScienceFrames.from_arrays(*beams, charis.wavelength, positions, **settings)

    n, truth = 16, star.stokes[1] / star.stokes[0]
    paired = correct(calibration, frames(hwp=star.hwp))
    assert paired.observable == "double"
    # beams of unequal gain cancel in double differences, and nowhere else
    np.testing.assert_allclose(paired.q, truth, atol=2e-4)
    with pytest.warns(AstropolcalWarning, match="have none .* their intensities are fitted"):
        alone = correct(calibration, frames())
    assert alone.observable == "intensity"
    assert np.abs(alone.q - truth).max() > 1e-3
    n = 15
    words = r"1 of 15 frames have no partner .* derotator within 2 deg and are left out.*frame 14"
    with pytest.warns(AstropolcalWarning, match=words):
        assert correct(calibration, frames(hwp=star.hwp[:15])).observable == "double"
    singles = dataclasses.replace(
        calibration, settings=calibration.settings | {"observable": "normalized_single_difference"}
    )
    n = 16
    assert correct(singles, frames(hwp=star.hwp)).observable == "single"
    # a chain that nobody fitted
    assert correct(sky, frames(hwp=star.hwp)).observable == "double"
    assert correct(sky, frames()).observable == "intensity"
    with pytest.warns(AstropolcalWarning, match="have none .* their intensities are fitted"):
        assert correct(sky, frames(hwp=np.zeros(16) * u.deg)).observable == "intensity"


def test_frames_must_say_when_and_how_they_were_taken(calibration, star, charis):
    dated = with_validity(calibration, valid_from="2025-10-01", mode="broadband JHK")

    def frames(**settings):
        beams = (star.right, star.left, charis.wavelength, star.positions)
        return ScienceFrames.from_arrays(*beams, hwp=star.hwp, **settings)

    known = {"date": "2025-10-09", "mode": "Broadband JHK"}
    found = correct(dated, frames(**known))
    for settings, words in (
        (known | {"date": None}, r"frame 0: its date is not known.*ScienceFrames\(..., date=\)"),
        (known | {"mode": None}, r"frame 0: its mode is not known.*mode='broadband JHK'"),
        (known | {"date": ["2025-10-09"] * 15 + ["2025-09-09"]}, "frame 15 was taken 2025-09-09"),
        (known | {"mode": "J"}, "frame 0 is in mode 'J'"),
        (known | {"date": "2026-03-01"}, "M3 was recoated between"),
    ):
        with pytest.raises(CalibrationFileError, match=words):
            correct(dated, frames(**settings))
        if "mode" not in words:
            again = correct(dated, frames(**settings), any_date=True)
            np.testing.assert_array_equal(again.stokes, found.stokes)
    with pytest.warns(AstropolcalWarning, match="0.0 yr from the data of the calibration"):
        correct(dated, frames(**known), max_age=1 * u.day)
    with pytest.raises(ParameterError, match="3 values of mode; allowed are one for all"):
        correct(dated, frames(**known | {"mode": ["J", "H", "K"]}))


def test_brightness_that_cannot_be_measured_is_said(star, sky, charis):
    beams = np.stack([star.right, star.left])
    beams[:, 5, 3] = 0.0
    frames = ScienceFrames.from_arrays(*beams, charis.wavelength, star.positions, hwp=star.hwp)
    with pytest.warns(AstropolcalWarning, match="taken as all the same: frame 5 has no light"):
        correct(sky, frames)
    with pytest.raises(ParameterError, match="brightness = 'guessed'"):
        correct(sky, frames, brightness="guessed")
    # a flux that is missing is left out, as if the frame were not there
    beams[:, 5, 3] = np.nan
    frames = ScienceFrames.from_arrays(*beams, charis.wavelength, star.positions, hwp=star.hwp)
    np.testing.assert_allclose(correct(sky, frames).q, star.stokes[1] / star.stokes[0], atol=1e-9)


def test_a_dark_frame_has_no_brightness(star, sky, charis):
    from astropolcal.correction import measurement_rows
    from astropolcal.correction.solve import frame_brightness

    rows = measurement_rows(sky, star.positions, charis.wavelength)
    fluxes = np.stack([star.right, star.left])
    fluxes[:, 5, 3] = 0
    with pytest.raises(ObservationError, match="frame 5 has no light at wavelength 3"):
        frame_brightness(rows, fluxes)
    rng = np.random.default_rng(1)
    with pytest.raises(ObservationError, match=r"does not settle|not determined"):
        frame_brightness(rows, rng.normal(size=fluxes.shape) ** 8)


def test_single_differences_as_input(star, sky, charis):
    frames = ScienceFrames.from_differences(
        star.right - star.left,
        star.right + star.left,
        charis.wavelength,
        star.positions,
        variance=np.ones(star.right.shape),
    )
    found = correct(sky, frames, observable="single")
    np.testing.assert_allclose(found.q, star.stokes[1] / star.stokes[0], atol=1e-10)
    assert found.covariance.shape == (6, 22)


def test_a_poor_wavelength_is_flagged(calibration, star, charis, track):
    from astropolcal import optics
    from astropolcal.chain import join, leaves

    chain = calibration.chain.copy()
    found = leaves(chain)
    efficiency = np.array(chain["wollaston"].efficiency.value)
    efficiency[4] = 1e-6
    blind = join(
        optics.WollastonPrism(efficiency=efficiency, name="wollaston")
        if leaf.name == "wollaston"
        else leaf
        for leaf in found
    )
    frames = ScienceFrames.from_arrays(star.right, star.left, charis.wavelength, track()[1])
    with pytest.warns(AstropolcalWarning, match=r"poorly determined at 1 of 22 .* 1328\.63 nm"):
        result = correct(charis.on_sky(blind), frames)
    assert np.isnan(result.q[4])
    assert np.isfinite(np.delete(result.q, 4)).all()
    assert np.isfinite(np.delete(result["I"], 4)).all()


def test_open_calibrations_warn(open_calibration, star, charis):
    known = {"hwp": star.hwp, "mode": "broadband JHK"}
    frames = ScienceFrames.from_arrays(
        star.right, star.left, charis.wavelength, star.positions, **known
    )
    with pytest.warns(
        AstropolcalWarning, match="does not determine how Q and U turn.*--prior.*--open-directions"
    ):
        found = correct(open_calibration, frames)
    assert np.isinf(found.fractional_errors("systematic")["q"]).all()
    assert np.isinf(found.polarization()["s_chi_systematic"]).all()
    known = correct(open_calibration, frames, open_directions="ignore")
    assert (known.polarization()["s_p_systematic"] < 1e-3).all()


def test_bad_choices(star, sky, charis, calibration):
    for settings, words in [
        ({"mode": "mueller"}, "mode = 'mueller'"),
        ({"weights": "photon"}, "weights = 'photon'"),
        ({"weights": "variance"}, "need variances"),
        ({"chunk": 0}, "chunk = 0"),
        ({"chunk": 1.5}, "chunk = 1.5; allowed are whole numbers from 1"),
        ({"workers": -1}, "workers = -1"),
        ({"workers": "2"}, "workers = '2'; allowed are whole numbers from 1"),
        ({"max_condition": "x"}, "max_condition = 'x' is not a number"),
        ({"max_condition": [30]}, "must be one number above 1"),
        # of a chain, too, which has no systematic errors
        ({"open_directions": -1.0}, r"open_directions = -1\.0"),
        ({"open_directions": "maybe"}, "open_directions = 'maybe'"),
        ({"open_directions": None}, "open_directions = None"),
        ({"n_samples": 1}, "n_samples = 1; allowed are whole numbers from 2"),
        ({"n_samples": "x"}, "n_samples = 'x'; allowed are whole numbers from 2"),
        ({"n_samples": 5, "seed": -1}, "seed = -1; allowed are whole numbers from 0 up"),
    ]:
        frames = ScienceFrames.from_arrays(star.right, star.left, charis.wavelength, star.positions)
        with pytest.raises(ParameterError, match=words):
            correct(sky, frames, **settings)
    # frames that do not fit
    with pytest.raises(ObservationError, match="22 wavelengths"):
        ScienceFrames.from_arrays(star.right, star.left, charis.wavelength[:5], star.positions)
    with pytest.raises(ObservationError, match="one shape"):
        ScienceFrames.from_arrays(star.right, star.left[:3], charis.wavelength, star.positions)
    with pytest.raises(ObservationError, match="altitude has 3 positions"):
        ScienceFrames.from_arrays(
            star.right, star.left, charis.wavelength, {"altitude": [1, 2, 3] * u.deg}
        )
    with pytest.raises(ObservationError, match="one beam only"):
        ScienceFrames.from_arrays(
            star.right, star.left, charis.wavelength, star.positions, variance_right=star.left
        )
    with pytest.raises(ObservationError, match=r"one shape .* without a zero is needed"):
        ScienceFrames.from_arrays(star.right[:0], star.left[:0], charis.wavelength, {})
    frames = ScienceFrames.from_arrays(
        star.right[:, :2], star.left[:, :2], [1.3, 1.4] * u.um, star.positions
    )
    with pytest.raises(WavelengthRangeError, match="none of the 22"):
        correct(calibration, frames)


# ---- laws and other implementations -----------------------------------------------------------


@pytest.mark.slow
@given(turn=st.floats(-90, 90))
def test_turning_the_sky_turns_q_and_u(star, sky, charis, turn):
    positions = star.positions | {"parallactic": star.positions["parallactic"] + turn * u.deg}
    frames = ScienceFrames.from_arrays(star.right, star.left, charis.wavelength, positions)
    found = correct(sky, frames)
    q, stokes_u = star.stokes[1:] / star.stokes[0]
    c, s = np.cos(2 * np.deg2rad(turn)), np.sin(2 * np.deg2rad(turn))
    np.testing.assert_allclose(found.q, c * q - s * stokes_u, atol=1e-10)
    np.testing.assert_allclose(found.u, s * q + c * stokes_u, atol=1e-10)


def test_scaling_the_fluxes_scales_all(star, sky, charis):
    def solved(factor):
        return correct(
            sky,
            ScienceFrames.from_arrays(
                factor * star.right,
                factor * star.left,
                charis.wavelength,
                star.positions,
                variance_right=factor**2 * star.right,
                variance_left=factor**2 * star.left,
            ),
        )

    one, seven = solved(1.0), solved(7.0)
    np.testing.assert_allclose(seven.stokes, 7 * one.stokes)
    for name, values in one.polarization().items():
        np.testing.assert_allclose(seven.polarization()[name], values, rtol=1e-9)


def test_against_numpy_least_squares(star, sky, charis):
    from astropolcal.correction import measurement_rows

    rng = np.random.default_rng(9)
    fluxes = np.stack([star.right, star.left])
    variances = rng.uniform(50, 500, size=fluxes.shape)
    fluxes = fluxes + rng.normal(size=fluxes.shape) * np.sqrt(variances)
    frames = ScienceFrames.from_arrays(
        *fluxes,
        charis.wavelength,
        star.positions,
        variance_right=variances[0],
        variance_left=variances[1],
    )
    found = correct(sky, frames, weights="variance", brightness="given")
    rows = measurement_rows(sky, star.positions, charis.wavelength)[..., :3]
    for w in range(22):
        sigma = np.sqrt(variances[:, :, w]).ravel()
        design = rows[:, w].reshape(-1, 3) / sigma[:, None]
        solution = np.linalg.lstsq(design, fluxes[:, :, w].ravel() / sigma, rcond=None)[0]
        np.testing.assert_allclose(found.stokes[:, w], solution, rtol=1e-9)
        covariance = np.linalg.inv(design.T @ design)
        np.testing.assert_allclose(found.covariances()[:, :, w], covariance, rtol=1e-8, atol=1e-9)


def test_systematic_errors_against_those_of_double_differences(calibration, charis, track, seen):
    from astropolcal.calibration.uncertainty import derived_sky

    _, positions = track(1)
    hwp = positions["hwp"][0] + [0, 45, 22.5, 67.5] * u.deg
    positions = {k: np.full(4, v[0].value) * v.unit for k, v in positions.items()} | {"hwp": hwp}
    stokes = np.array([1.0, 0.1, -0.04])[:, None] * np.ones(22)
    right, left = seen(calibration, positions, charis.wavelength, stokes)
    frames = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, pairs=[(0, 1), (2, 3)]
    )
    ours = correct(calibration, frames, observable="double").fractional_errors("systematic")
    plus = {name: angle[[0, 2]] for name, angle in positions.items()}
    theirs = derived_sky(calibration, 0.1, -0.04, plus, chain=charis.on_sky(calibration.chain)).std
    np.testing.assert_allclose(ours["q"], theirs[:, 0], rtol=0.02)
    np.testing.assert_allclose(ours["u"], theirs[:, 1], rtol=0.02)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*unstable lamp")
@pytest.mark.filterwarnings("ignore:systematic errors do not count another solution")
def test_claims_agree_with_what_is_left_of_real_standards(shared_data, charis):
    """
    Unpolarized stars are what the fit has found of them, and zero within all errors.

    The fit has seen them, so that little is left beside what it found. How far they are from zero
    is held against the errors of the calibration and of the catalogue together.
    """
    folder = shared_data / "data" / "charis"
    for names, most, catalogue in (
        (("dataset3_polarized_2025-10-05", "dataset4_unpolarized_2025-10-05",
          "hd293396_unpolarized_standard_2025-11-03"), 8e-4, 1.8e-3),
        (("dataset1_polarized_2025-07-15", "hd35532_unpolarized_standard"), 3.5e-4, 2e-3),
    ):  # fmt: skip
        tables = [charis.prepare(Observations.read(folder / f"{name}.ecsv")) for name in names]
        fitted = calibrate(charis.chains_for(tables), tables, instrument="charis")
        star = tables[-1]
        frames = ScienceFrames.from_arrays(
            star.flux_right,
            star.flux_left,
            star.wavelength,
            {k: v * u.rad for k, v in charis.positions(star, sky_chain(fitted)).items()},
            hwp=star.frames["hwp"],
            date=star.meta.get("date", "2025-07-15"),
            mode=star.meta["mode"],
        )
        found = correct(fitted, frames)
        (known,) = fitted_stars(fitted)
        off = [getattr(found, key) - known[key].to_value(u.one) for key in "qu"]
        left = np.sqrt(np.mean(np.square(off)))
        assert left < most
        errors = found.fractional_errors("systematic")
        for key in "qu":
            stated = np.hypot(errors[key], catalogue)
            assert np.sqrt(np.mean((getattr(found, key) / stated) ** 2)) < 1.7
            # of the first wavelength, of which parameters that all share follow bent valleys
            assert errors[key].max() < 2.75e-3


def test_fluxes_that_data_share_count_once_in_the_errors(sky, charis, track, seen):
    """Weights by equal variances are equal weights, and so must be the covariances."""
    positions = track(2)[1]
    stokes = np.array([1e5, 2e4, -1e4])[:, None, None] * np.ones((22, 3))
    beams = seen(sky, positions, charis.wavelength, stokes)
    unequal = {f"variance_{beam}": np.full(beams[0].shape, v) for beam, v in zip(
        ("right", "left"), (100.0, 900.0), strict=True)}  # fmt: skip
    twice = [[0, 1], [2, 3], [4, 5], [6, 7]] * 2
    shared = [[0, 1], [0, 5], [4, 1], [4, 5], [2, 3], [2, 7], [6, 3], [6, 7]]
    for observable, pairs in (("single", None), ("double", shared), ("double", twice)):
        frames = ScienceFrames.from_arrays(
            *beams, charis.wavelength, positions, pairs=pairs, **unequal
        )
        equal, by_variance = (
            correct(sky, frames, observable=observable, brightness="given", weights=weights)
            for weights in (None, "variance")
        )
        scale = np.sqrt(equal.covariance[0])
        np.testing.assert_allclose(by_variance.stokes, equal.stokes, rtol=1e-9)
        np.testing.assert_allclose(
            by_variance.covariance / scale**2, equal.covariance / scale**2, atol=1e-9
        )
    # what is masked is no weight
    weights = np.ma.array([1e9] + 7 * [1.0], mask=[True] + 7 * [False])
    with pytest.raises(ParameterError, match="weights = nan"):
        correct(sky, frames, observable="single", weights=weights)


@pytest.mark.long
def test_an_aperture_of_turned_images_has_the_noise_of_a_sum():
    """Neighbours of resampled pixels are correlated: their variances do not add up to it."""
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    chain, hwp = chain | optics.WollastonPrism(name="wollaston"), [0, 45, 22.5, 67.5] * u.deg
    # the wavelengths are draws of the noise
    noise = 1000 + 30 * np.random.default_rng(1).standard_normal((2, 4, 200, 17, 17))
    known = {"variance_right": np.full(noise[0].shape, 900.0)}
    known["variance_left"] = known["variance_right"]
    for camera in ([0, 0, 0, 0], [90, 17, 30, 45], [20, 20, 20, 20]):
        frames = ScienceFrames.from_arrays(
            *noise, np.linspace(1, 2, 200) * u.um, {"hwp": hwp}, position_angle=camera * u.deg,
            **known,
        )  # fmt: skip
        star = correct(chain, frames, brightness="given").aperture(6)
        # both components, each of as many draws
        scatter = np.hypot(star["Q"].std(), star["U"].std())
        claimed = np.hypot(star.error("Q").mean(), star.error("U").mean())
        assert claimed == pytest.approx(scatter, rel=0.06), camera


def test_a_sign_that_the_calibration_does_not_tell_is_said(calibration, disk_frames, charis):
    words = "derotator.retardance at 2200.0 nm: with the other sign: the data do not tell the sign"
    finding = dataclasses.replace(calibration.identifiability, mirrors=[words, "of no effect"])
    other = copy.copy(calibration)
    # of a fit with plain errors; otherwise they count among those of the model
    other.identifiability, other.fit = finding, other.fit | {"model_error": None}
    with pytest.warns(AstropolcalWarning) as caught:
        correct(other, frames_of(disk_frames, charis))
    told = [str(one.message) for one in caught]
    assert f"systematic errors do not count another solution: {words}" in told
    assert not any("of no effect" in one for one in told)
