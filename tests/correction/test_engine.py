# Licensed under a 3-clause BSD style license - see LICENSE
"""Dividing the work: the same numbers, bounded memory, files read when needed."""

import tracemalloc

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from astropolcal.correction import ScienceFrames, correct
from astropolcal.correction.frames import frame_positions
from astropolcal.correction.sources import ArraySource, CubeFiles, TurnedSource
from astropolcal.exceptions import AstropolcalError, ObservationError, ParameterError


def test_a_cluster_changes_no_number(star, sky, charis, tmp_path):
    """It divides the frames, also those from which a flux is missing."""
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    beams = [np.array(beam) for beam in (star.right, star.left)]
    # it is fitted from the other frames, which are divided too
    beams[0][3, 5] = np.nan
    np.save(tmp_path / "right.npy", beams[0])
    mapped = np.load(tmp_path / "right.npy", mmap_mode="r")
    settings = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with distributed.LocalCluster(processes=False, **settings) as cluster:
        for right, chunk in ((beams[0], 4), (mapped, None)):
            given = (right, beams[1], charis.wavelength, star.positions)
            frames = ScienceFrames.from_arrays(*given)
            found = correct(sky, frames, cluster=cluster.scheduler_address, chunk=chunk)
            np.testing.assert_array_equal(found.stokes, correct(sky, frames).stokes)
    assert np.isfinite(found.stokes).all()


@pytest.mark.long
def test_workers_that_are_processes(cubes_of_stars):
    """Files are opened by each worker; nothing but their names and the solution is sent."""
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    sky, frames = cubes_of_stars
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(processes=True, **settings) as cluster:
        found = correct(sky, frames, cluster=cluster.scheduler_address, chunk=8)
    here = correct(sky, frames)
    np.testing.assert_array_equal(found.stokes, here.stokes)
    np.testing.assert_array_equal(found.covariance, here.covariance)


@pytest.fixture
def cubes_of_stars(sky, charis, track, tmp_path):
    _, positions = track(1)
    rng = np.random.default_rng(2)
    paths = [tmp_path / f"cube{i}.fits" for i in range(4)]
    for path in paths:
        cube = rng.uniform(1, 2, size=(22, 20, 30))
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(cube), fits.ImageHDU(np.full(cube.shape, 4.0))]
        fits.HDUList(hdus).writeto(path)
    source = CubeFiles(paths, CENTRES, 5)
    return sky, ScienceFrames(source, charis.wavelength, positions)


def test_a_cluster_that_does_not_answer(star, sky, charis, monkeypatch):
    pytest.importorskip("distributed", reason="distributed is not installed")
    from astropolcal.pipeline import tasks

    monkeypatch.setattr(tasks, "_TIMEOUT", 0.5)
    frames = ScienceFrames.from_arrays(star.right, star.left, charis.wavelength, star.positions)
    with pytest.raises(AstropolcalError, match=r"cluster tcp://127\.0\.0\.1:1: cannot be used"):
        correct(sky, frames, cluster="tcp://127.0.0.1:1")


def test_an_error_in_a_block_comes_out(star, sky, charis):
    class Broken(ArraySource):
        def fluxes(self, beam, frames, wavelengths):
            raise ObservationError(f"slice {wavelengths.start}")

    source = Broken(star.right, star.left)
    frames = ScienceFrames(source, charis.wavelength, star.positions)
    for workers in (None, 2):
        with pytest.raises(ObservationError, match="slice"):
            correct(sky, frames, brightness="given", workers=workers)


@pytest.mark.slow
def test_memory_does_not_grow_with_frames(sky, charis, track, tmp_path):
    peaks = []
    for cycles in (2, 12):
        _, positions = track(cycles)
        shape = (4 * cycles, 22, 41, 41)
        beams = []
        for name in "rl":
            path = tmp_path / f"{name}{cycles}.npy"
            np.lib.format.open_memmap(path, "w+", "f4", shape)[:] = 1
            beams.append(np.load(path, mmap_mode="r"))
        frames = ScienceFrames.from_arrays(*beams, charis.wavelength, positions)
        correct(sky, frames, workers=1)
        tracemalloc.start()
        result = correct(sky, frames, workers=1)
        peaks.append(tracemalloc.get_traced_memory()[1] - result.stokes.nbytes)
        tracemalloc.stop()
    share = 2 * 8 * 22 * 41 * 41
    assert max(peaks) < 2 * share
    assert peaks[1] < 0.2 * 48 * share


# ---- files -----------------------------------------------------------------------------------


@pytest.fixture
def cubes(tmp_path):
    """Two cubes of 3 x 20 x 30 pixels with a known number in each, and inverse variances."""
    values = np.random.default_rng(1).normal(10, 1, size=(2, 3, 20, 30))
    paths = []
    for i, cube in enumerate(values):
        weight = np.full(cube.shape, 4.0)
        weight[:, 10, 8] = 0
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(cube), fits.ImageHDU(weight)]
        paths.append(tmp_path / f"cube{i}.fits")
        fits.HDUList(hdus).writeto(paths[-1])
    return values, paths


CENTRES = [(20, 10), (8, 10)]


def test_windows_of_both_beams(cubes):
    values, paths = cubes
    source = CubeFiles(paths, CENTRES, 5)
    assert (source.n_frames, source.n_wavelengths, source.image_shape) == (2, 3, (5, 5))
    every = slice(None)
    right, left = (source.fluxes(beam, every, slice(1, 3)) for beam in (0, 1))
    np.testing.assert_array_equal(right, values[:, 1:, 8:13, 18:23])
    np.testing.assert_array_equal(left, values[:, 1:, 8:13, 6:11])
    variances = source.variances(1, every, every)
    assert np.isnan(variances[..., 2, 2]).all()
    assert np.nanmax(variances) == np.nanmin(variances) == 0.25


def test_all_kinds_of_files(cubes, tmp_path):
    for kind in ["scaled", "compressed", "gzipped", "float32", "primary"]:
        values, _ = cubes
        cube = np.rint(values[0] * 100)
        path, extension = tmp_path / "one.fits", 1
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(cube)]
        if kind == "scaled":
            hdus[1] = fits.ImageHDU(cube.astype("i4"))
            hdus[1].scale("int16", bzero=32768)
        elif kind == "compressed":
            hdus[1] = fits.CompImageHDU(cube.astype("i4"))
        elif kind == "gzipped":
            path = tmp_path / "one.fits.gz"
        elif kind == "float32":
            hdus[1] = fits.ImageHDU(cube.astype("f4"))
        else:
            hdus, extension = [fits.PrimaryHDU(cube)], 0
        fits.HDUList(hdus).writeto(path, overwrite=True)
        source = CubeFiles([path], CENTRES, 5, extension=extension)
        found = source.fluxes(0, slice(0, 1), slice(2, 3))
        np.testing.assert_array_equal(found[0, 0], cube[2, 8:13, 18:23])
        assert not source.has_variances


def test_a_file_that_shrinks_is_named(cubes):
    _, paths = cubes
    source = CubeFiles(paths, CENTRES, 5)
    content = paths[1].read_bytes()
    paths[1].write_bytes(content[: len(content) // 4])
    with pytest.raises(ObservationError, match=r"cube1\.fits"):
        source.fluxes(0, slice(0, 2), slice(0, 3))


def test_files_that_do_not_fit(cubes, tmp_path):
    _, paths = cubes
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((3, 5, 5)))]).writeto(
        tmp_path / "x.fits"
    )
    with pytest.raises(ObservationError, match=r"x\.fits: a cube of shape \(3, 5, 5\)"):
        CubeFiles([*paths, tmp_path / "x.fits"], CENTRES, 5)
    with pytest.raises(ObservationError, match="no extension 7"):
        CubeFiles(paths, CENTRES, 5, extension=7)
    (tmp_path / "text.fits").write_text("no FITS")
    with pytest.raises(ObservationError, match=r"text\.fits: is not a FITS file"):
        CubeFiles([tmp_path / "text.fits"], CENTRES, 5)
    with pytest.raises(ObservationError, match="no files"):
        CubeFiles([], CENTRES, 5)
    with pytest.raises(ObservationError, match=r"left beam's centre .* outside"):
        CubeFiles(paths, [(20, 10), (-8, 10)], 5)


def test_turned_sources_need_images():
    with pytest.raises(ParameterError, match="cannot be turned"):
        TurnedSource(ArraySource(np.ones((2, 3)), np.ones((2, 3))), [0, 0] * u.deg)
    image = np.ones((2, 3, 4, 4))
    with pytest.raises(ParameterError, match="each of the 2 frames"):
        TurnedSource(ArraySource(image, image), [0, 0, 0] * u.deg)
    for centre in (5, [5], [[5], [6]], [1, 2, 3], "here", np.ones((3, 2, 2))):
        with pytest.raises(ParameterError, match=r"centre = .*; x and y are needed"):
            TurnedSource(ArraySource(image, image), [0, 0] * u.deg, centre=centre)


# ---- angles ----------------------------------------------------------------------------------


def angles(**changed):
    plain = {"hwp": [0.0, 45.0], "derotator": [60.0, 60.0], "parallactic": [20.0, 21.0]}
    plain |= {"altitude": [70.0, 70.5]} | changed
    return QTable({name: values * u.deg for name, values in plain.items() if values is not None})


def test_the_plate_follows_the_sky(sky, charis):
    found = frame_positions(charis, angles(), sky)
    np.testing.assert_allclose(np.rad2deg(found["hwp"]), [80, 126])
    true = frame_positions(charis, angles(hwp_true=[80.2, 126.2]), sky)
    np.testing.assert_allclose(np.rad2deg(true["hwp"]), [80.2, 126.2])


def test_a_missing_angle_is_named_with_its_frame(sky, charis):
    for name in ["hwp", "derotator", "parallactic", "altitude"]:
        with pytest.raises(ObservationError, match=rf"a\.fits: no angle '{name}'"):
            frame_positions(charis, angles(**{name: None}), sky, names=["a.fits", "b.fits"])
        table = angles(**{name: [30.0, np.nan]})
        with pytest.raises(ObservationError, match=rf"b\.fits: no angle '{name}'"):
            frame_positions(charis, table, sky, names=["a.fits", "b.fits"])
