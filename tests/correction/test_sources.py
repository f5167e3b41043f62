# Licensed under a 3-clause BSD style license - see LICENSE
"""Where fluxes come from: arrays, arrays turned, files of one or of two cameras."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.utils.masked import Masked

from astropolcal.correction.geometry import derotate, derotate_variance
from astropolcal.correction.sources import ArraySource, CubeFiles, TurnedSource
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.reduction.photometry import Detector

ALL = slice(None)


@pytest.fixture
def images():
    """Fluxes and variances of both beams, (2, 3 frames, 2 wavelengths, 9, 9)."""
    rng = np.random.default_rng(3)
    return rng.normal(10, 1, (2, 3, 2, 9, 9)), rng.uniform(1, 2, (2, 3, 2, 9, 9))


# ---- arrays ----------------------------------------------------------------------------


def test_arrays_are_given_back(images):
    flux, variance = images
    source = ArraySource(*flux, *variance)
    assert (source.n_frames, source.n_wavelengths, source.image_shape) == (3, 2, (9, 9))
    assert source.has_variances
    assert source.names == ["frame 0", "frame 1", "frame 2"]
    for beam in (0, 1):
        np.testing.assert_array_equal(
            source.fluxes(beam, slice(1, 3), slice(1, 2)), flux[beam, 1:, 1:]
        )
        np.testing.assert_array_equal(source.variances(beam, ALL, ALL), variance[beam])


def test_lists_will_do():
    source = ArraySource([[1.0, 2.0]], [[3.0, 4.0]], names=("a",))
    assert source.fluxes(1, ALL, ALL).tolist() == [[3.0, 4.0]]
    assert source.names == ["a"]


def test_how_many_frames_are_read_at_a_time(images, tmp_path):
    """All of what is in memory, one of what is on disk."""
    flux, _ = images
    assert ArraySource(*flux).batches() == [slice(0, 3)]
    np.save(tmp_path / "a.npy", flux[0])
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    one_by_one = [slice(0, 1), slice(1, 2), slice(2, 3)]
    assert ArraySource(mapped, mapped).batches() == one_by_one


def test_chunks_of_dask_are_read_whole(images):
    da = pytest.importorskip("dask.array")
    flux = [da.from_array(beam, chunks=(2, 1, 9, 9)) for beam in images[0]]
    source = ArraySource(*flux)
    assert source.batches() == [slice(0, 2), slice(2, 3)]
    found = source.fluxes(0, slice(0, 2), ALL)
    assert isinstance(found, np.ndarray)
    np.testing.assert_array_equal(found, images[0][0, :2])


def test_variances_of_one_beam_only(images):
    for given in [(True, False), (False, True)]:
        flux, variance = images
        chosen = [v if there else None for v, there in zip(variance, given, strict=True)]
        with pytest.raises(ObservationError, match="variances of one beam only; both or none"):
            ArraySource(*flux, *chosen)


def test_shapes_that_do_not_fit():
    for right, left, variance, shapes in [
        ((3, 2), (3, 1), None, r"\[\(3, 1\), \(3, 2\)\]"),
        ((3, 2), (3, 2), (2, 3), r"\[\(2, 3\), \(3, 2\)\]"),
        ((3,), (3,), None, r"\[\(3,\)\]"),
    ]:
        variances = [None, None] if variance is None else [np.ones(variance)] * 2
        with pytest.raises(ObservationError, match=f"have shapes {shapes}; one shape"):
            ArraySource(np.ones(right), np.ones(left), *variances)


def test_units_and_masks_of_arrays_count(images):
    flux, variance = images
    hidden = np.ma.array(flux[0], mask=flux[0] > 11)
    for right in (hidden, Masked(flux[0], mask=hidden.mask), hidden.data * u.electron):
        source = ArraySource(right, flux[1], *variance, unit=u.electron)
        masked = np.broadcast_to(getattr(right, "mask", False), hidden.shape)
        np.testing.assert_array_equal(np.isnan(source.fluxes(0, ALL, ALL)), masked)
    thousands = ArraySource(flux[0] * (1000 * u.adu), flux[1])
    np.testing.assert_allclose(thousands.fluxes(0, ALL, ALL), 1000 * flux[0])
    for wrong, error in (
        (flux[0] * u.electron, ParameterError),
        (flux[0] + 1j, ObservationError),
        (flux[0].astype(str), ObservationError),
    ):
        with pytest.raises(error, match="right"):
            ArraySource(wrong, flux[1])


def test_variances_that_are_none(images):
    """Zero is that of no measurement, as in files; below zero there is none."""
    flux, variance = images
    variance[0, 1, 0, 2, 3] = 0.0
    found = ArraySource(*flux, *variance).variances(0, ALL, ALL)
    assert np.argwhere(np.isnan(found)).tolist() == [[1, 0, 2, 3]]
    variance[0, 1, 0, 2, 3] = -4.0
    with pytest.raises(ObservationError, match="frame 1: a variance is -4; allowed"):
        ArraySource(*flux, *variance).variances(0, slice(1, 3), ALL)


# ---- turned ----------------------------------------------------------------------------


def test_each_frame_is_turned_by_its_own_angle(images):
    flux, variance = images
    angles = [10, -35, 90] * u.deg
    options = {"centre": (4.5, 3.0), "order": 1, "mirrored": True}
    source = TurnedSource(ArraySource(*flux, *variance), angles, **options)
    assert source.has_variances
    assert source.image_shape == (9, 9)
    for i in range(3):
        one = slice(i, i + 1)
        expected = derotate(flux[1, i], angles[i], **options)
        np.testing.assert_array_equal(source.fluxes(1, one, ALL)[0], expected)
        expected = derotate_variance(variance[1, i], angles[i], **options)
        np.testing.assert_array_equal(source.variances(1, one, ALL)[0], expected)


def test_shape_of_what_is_cut_out(images):
    for size, shape in [(5, (5, 5)), ((3, 7), (3, 7)), (None, (9, 9))]:
        options = {} if size is None else {"size": size}
        source = TurnedSource(ArraySource(*images[0]), [0, 0, 0] * u.deg, **options)
        assert source.image_shape == shape, (size, shape)
        assert source.fluxes(0, ALL, ALL).shape == (3, 2, *shape), (size, shape)
        assert source.batches() == [slice(0, 1), slice(1, 2), slice(2, 3)], (size, shape)


# ---- files -----------------------------------------------------------------------------


@pytest.fixture
def cameras(tmp_path):
    """Two frames of two cameras: cubes and their errors."""
    rng = np.random.default_rng(5)
    values, errors = rng.normal(10, 1, (2, 2, 3, 12, 14)), rng.uniform(0.5, 2, (2, 2, 3, 12, 14))
    errors[:, :, 1, 6, 7] = 0.0
    paths = [[tmp_path / f"n{i}_cam{c}.fits" for i in range(2)] for c in (1, 2)]
    for c in range(2):
        for i in range(2):
            hdus = [fits.PrimaryHDU(values[c, i]), fits.ImageHDU(errors[c, i])]
            fits.HDUList(hdus).writeto(paths[c][i])
    return values, errors, paths


def test_files_of_two_cameras(cameras):
    values, errors, (right, left) = cameras
    source = CubeFiles(
        right,
        [(7, 6), (6, 5)],
        3,
        extension=0,
        left_files=left,
        left_scale=[2.0, 3.0],
        weights="error",
    )
    assert source.names == [str(path) for path in right]
    np.testing.assert_array_equal(source.fluxes(0, ALL, ALL), values[0, :, :, 5:8, 6:9])
    scale = np.array([2.0, 3.0])[:, None, None, None]
    np.testing.assert_allclose(source.fluxes(1, ALL, ALL), scale * values[1, :, :, 4:7, 5:8])
    # errors are squared, and scaled like the flux; zero means that none is known
    expected = np.where(errors > 0, errors**2, np.nan)
    np.testing.assert_allclose(source.variances(0, ALL, ALL), expected[0, :, :, 5:8, 6:9])
    found = source.variances(1, slice(1, 2), slice(0, 2))
    np.testing.assert_allclose(found, 9 * expected[1, 1:, :2, 4:7, 5:8])
    assert np.isnan(source.variances(0, ALL, slice(1, 2))[:, 0, 1, 1]).all()
    for wrong in (np.nan, 0, -1.0, np.inf, [1.0, 2.0, 3.0], "x", [[1.0, 1.0]]):
        with pytest.raises(ParameterError, match="left_scale = "):
            CubeFiles(right, [(7, 6), (6, 5)], 3, extension=0, left_files=left, left_scale=wrong)


def test_centres_may_move_from_frame_to_frame(cameras):
    values, _, (right, _) = cameras
    centres = np.array([[(7, 6), (3, 6)], [(8, 5), (4, 5)]])
    source = CubeFiles(right, centres, 3, extension=0)
    found = source.fluxes(0, ALL, slice(0, 1))[:, 0]
    np.testing.assert_array_equal(found, [values[0, 0, 0, 5:8, 6:9], values[0, 1, 0, 4:7, 7:10]])


def test_files_are_turned_about_their_centre(cameras):
    values, _, (right, _) = cameras
    angles = [20, 90] * u.deg
    source = CubeFiles(right, [(7, 6), (6, 5)], 5, extension=0, position_angle=angles)
    for i in range(2):
        expected = derotate(values[0, i], angles[i], centre=(7, 6), size=5)
        np.testing.assert_array_equal(source.fluxes(0, slice(i, i + 1), ALL)[0], expected)


def test_an_image_is_a_cube_of_one_slice(tmp_path):
    image = np.arange(42.0).reshape(6, 7)
    for name, hdu in (("a", fits.ImageHDU(image)), ("b", fits.CompImageHDU(image.astype("i4")))):
        path = tmp_path / f"{name}.fits"
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
        source = CubeFiles([path], [(3, 3), (3, 2)], 3)
        assert source.n_wavelengths == 1
        found = source.fluxes(0, ALL, ALL)
        np.testing.assert_array_equal(found[0, 0], image[2:5, 2:5])


def test_weights_of_another_shape_are_none(tmp_path):
    """What follows the cube may be something else."""
    path = tmp_path / "a.fits"
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 6, 6))), fits.ImageHDU(np.ones((6, 6)))]
    fits.HDUList(hdus).writeto(path)
    assert not CubeFiles([path], [(3, 3), (3, 2)], 3).has_variances


def test_an_infinite_weight_is_none(tmp_path):
    path, weight = tmp_path / "a.fits", np.full((2, 6, 6), 4.0)
    weight[0, 3, 3] = np.inf
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 6, 6))), fits.ImageHDU(weight)]
    fits.HDUList(hdus).writeto(path)
    for weights, variance in (("inverse variance", 0.25), ("error", 16.0)):
        source = CubeFiles([path], [(3, 3), (3, 3)], 3, weights=weights)
        found = source.variances(0, ALL, ALL)[0]
        assert np.isnan(found[0, 1, 1]), weights
        assert np.all(found[1] == variance), weights


def test_centres_outside_the_image(cameras):
    for centre, words in [
        ((13.6, 6), r"right beam's centre \[13.6, 6.0\] is outside the image of 14 x 12 pixels"),
        ((-0.6, 6), r"right beam's centre \[-0.6, 6.0\] is outside"),
        ((7, 11.5), r"right beam's centre \[7.0, 11.5\] is outside"),
        ((7, np.nan), r"right beam's centre \[7.0, nan\] is outside"),
    ]:
        _, _, (right, _) = cameras
        with pytest.raises(ObservationError, match=words):
            CubeFiles(right, [centre, (6, 5)], 3, extension=0)
        # up to half a pixel beyond the middle of the last one is inside
        CubeFiles(right, [(13.4, 11.4), (-0.4, -0.4)], 3, extension=0)


def test_sizes_that_make_no_sense(cameras):
    for size in [0, 29, 4000]:
        _, _, (right, _) = cameras
        words = rf"size = {size}; the images are 14 x 12 pixels, allowed are 1 to 28"
        with pytest.raises(ParameterError, match=words):
            CubeFiles(right, [(7, 6), (6, 5)], size, extension=0)
        assert CubeFiles(right, [(7, 6), (6, 5)], 28, extension=0).image_shape == (28, 28), size


def test_a_left_file_that_is_missing_is_named(cameras):
    _, _, (right, left) = cameras
    left[1].unlink()
    with pytest.raises(ObservationError, match=r"n1_cam2.fits: no such file"):
        CubeFiles(right, [(7, 6), (6, 5)], 3, extension=0, left_files=left)


def test_a_file_that_is_replaced_by_a_smaller_one(cameras):
    """Compressed ones are opened anew at each reading."""
    _, _, (right, _) = cameras
    fits.CompImageHDU(np.ones((3, 12, 14), "i4")).writeto(right[0], overwrite=True)
    source = CubeFiles(right[:1], [(7, 6), (6, 5)], 3)
    fits.PrimaryHDU(np.ones(3)).writeto(right[0], overwrite=True)
    with pytest.raises(ObservationError, match=r"n0_cam1.fits: cannot be read"):
        source.fluxes(0, ALL, ALL)


def test_a_cube_of_nothing(tmp_path):
    """Numpy cannot write one, but a header can claim it."""
    for shape in [(0, 6, 6), (2, 0, 6)]:
        path = tmp_path / "a.fits"
        fits.PrimaryHDU(np.ones((2, 6, 6), "f4")).writeto(path, overwrite=True)
        content = path.read_bytes()
        for i, (old, new) in enumerate(zip((6, 6, 2), shape[::-1], strict=True), start=1):
            card = f"NAXIS{i}  = {old:20}".encode()
            assert card in content, shape
            content = content.replace(card, f"NAXIS{i}  = {new:20}".encode())
        path.write_bytes(content)
        with pytest.raises(
            ObservationError, match=r"a.fits: .*(three axes|no data|not a readable)"
        ):
            CubeFiles([path], [(3, 3), (3, 2)], 3, extension=0)


def test_a_file_without_an_image(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "a.fits")
    for stacked in (False, True):
        with pytest.raises(ObservationError, match=r"a.fits: a cube of shape \(\)"):
            CubeFiles([tmp_path / "a.fits"], [(3, 3), (3, 2)], 3, extension=0, stacked=stacked)


def test_nans_that_signal_are_nans(tmp_path):
    """A damaged file may hold them; numpy warns where they are used, which is an error here."""
    for kind in [">f4", ">f8"]:
        cube = np.ones((1, 6, 6), kind)
        # the highest bit of the fraction is what makes a NaN quiet
        cube.view(kind.replace("f", "u"))[0, 3, 3] = {">f4": 0x7F800001, ">f8": 0x7FF0000000000001}[
            kind
        ]
        path = tmp_path / "a.fits"
        hdus = fits.HDUList([fits.PrimaryHDU(cube), fits.ImageHDU(cube)])
        hdus.writeto(path, overwrite=True)
        source = CubeFiles([path], [(3, 3), (3, 2)], 3, extension=0)
        for found in (source.fluxes(0, ALL, ALL), source.variances(0, ALL, ALL)):
            assert np.isnan(found[0, 0, 1, 1]), kind
            assert np.isfinite(found).sum() == 8, kind


def test_pixels_that_lack_exposures_are_as_bright_as_the_others(tmp_path):
    cube = np.array([1.0, 1.0, 1.0, 1.0, 0.4])[:, None, None] * np.full((5, 6, 12), 400.0)
    # known in the last exposure only, and in all others
    cube[:4, 3, 3], cube[4, 4, 3] = np.nan, np.nan
    fits.PrimaryHDU(cube).writeto(tmp_path / "a.fits")
    source = CubeFiles([tmp_path / "a.fits"], [(3, 3), (9, 3)], 3, extension=0, stacked=True)
    np.testing.assert_allclose(source.fluxes(0, slice(0, 1), slice(0, 1)), 352.0)


def test_exposures_that_are_no_measurement_take_no_part_in_their_mean(tmp_path):
    class Reader:
        """Of a mean of all exposures, a unit of which is so many electrons."""

        def variance(self, pixels):
            return pixels / 40

    cube, error = np.full((4, 6, 12), 100.0), np.ones((4, 6, 12))
    # a pixel that its error marks as bad, and one that two exposures lack
    cube[0, 3, 3], error[0, 3, 3], cube[:2, 4, 3] = 1e6, 0.0, np.nan
    names = {"error": "error.fits", "inverse variance": "weight.fits", "": "plain.fits"}
    for weights, name in names.items():
        hdus = [fits.PrimaryHDU(cube), fits.ImageHDU(error)][: 2 if weights else 1]
        fits.HDUList(hdus).writeto(tmp_path / name)
        options = {
            "weights": weights or "error",
            "detectors": None if weights else [[Reader()] * 2],
        }
        source = CubeFiles(
            [tmp_path / name], [(3, 3), (9, 3)], 3, extension=0, stacked=True, **options
        )
        flux, variance = (
            read(0, slice(0, 1), slice(0, 1))[0, 0] for read in (source.fluxes, source.variances)
        )
        one = 1.0 if weights else 10.0
        assert (flux[2, 1], variance[2, 1]) == (100.0, one / 2)
        assert (flux[0, 0], variance[0, 0]) == (100.0, one / 4)
        if weights:
            assert (flux[1, 1], variance[1, 1]) == (100.0, one / 3)


def test_saturated_pixels_are_no_measurement(tmp_path):
    detector = Detector(u.adu, gain=2.0, read_noise=3.0, saturation=100.0)
    for stacked, shape in ((False, (1, 6, 12)), (True, (4, 6, 12))):
        cube = np.full(shape, 50.0)
        cube[0, 3, 3] = 100.0
        for n_hdus in (1, 2):
            hdus = [fits.PrimaryHDU(cube), fits.ImageHDU(np.ones(shape))][:n_hdus]
            fits.HDUList(hdus).writeto(tmp_path / "a.fits", overwrite=True)
            options = {"extension": 0, "stacked": stacked, "detectors": [(detector, detector)]}
            source = CubeFiles([tmp_path / "a.fits"], [(3, 3), (9, 3)], 3, **options)
            flux = source.fluxes(0, ALL, ALL)[0, 0]
            # of several exposures the others are left
            assert np.isnan(flux[1, 1]) if not stacked else flux[1, 1] == 50.0
            assert np.isfinite(flux).sum() == 8 + stacked
