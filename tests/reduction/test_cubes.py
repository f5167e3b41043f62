# Licensed under a 3-clause BSD style license - see LICENSE
"""Simulated cubes: what is in the images and headers, and what comes back out of them."""

from dataclasses import fields, replace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import calibrate, instruments, optics
from astropolcal.chain import join, leaves
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    InstrumentError,
    ObservationError,
    ParameterError,
)
from astropolcal.instruments import Instrument
from astropolcal.instruments.layout import FileLayout
from astropolcal.reduction import cubes as _images
from astropolcal.reduction.cubes import (
    CubeFiles,
    DetectorModel,
    ImageModel,
    _usual_flux,
    simulate_cubes,
    true_observations,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.25, 1.65, 2.15] * u.um
PLATE = [0, 45, 22.5, 67.5] * u.deg


class Small(Instrument):
    """Two wide beams on a small detector, and files of its own kind."""

    name = "small"
    wavelength = WAVELENGTH
    files = FileLayout(
        keywords={
            "hwp": "HWP_CMD",
            "hwp_true": "HWP_POS",
            "derotator": "IMR",
            "parallactic": "PA",
            "altitude": "EL",
            "exposure_time": "ITIME",
            "date": "DAY",
            "time": "CLOCK",
            "object": "TARGET",
            "instrument": "INST",
        },
        units={"exposure_time": "ms", "altitude": "rad"},
        transforms={"derotator": (-2.0, 10.0)},
        raw_columns=("hwp", "hwp_true"),
        identities=("SMALL",),
        shape=(3, 64, 90),
        cube_extension=2,
        gain=1.5,
        read_noise=3.0,
        saturation=5000.0,
        internal_apertures=((24.0, 30.0), (62.0, 33.0), 20.0, 30.0, 0.2),
        star_offset=(38.0, 3.0),
        pixel_scale=20.0,
    )

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        return (
            optics.LinearPolarizer(name="polarizer", theta=10 * u.deg)
            | optics.LinearRetarder(mount="hwp", retardance=175 * u.deg, name="hwp")
            | optics.LinearRetarder(mount="derotator", retardance=[100, 150, 190] * u.deg,
                                    name="derotator")
            | optics.WollastonPrism(name="wollaston")
        )  # fmt: skip

    def setup(self, observations):
        return "polarized", ()


SMALL = Small()


def sky_chain(q=0.01, theta=25.0):
    """A star of polarization q, seen through the rotations of an alt-azimuth telescope."""
    return (
        optics.Diattenuator(diattenuation=q, theta=theta * u.deg, name="star")
        | optics.Rotator(mount="parallactic", name="sky")
        | optics.Rotator(mount="-altitude", name="telescope")
        | optics.LinearRetarder(retardance=172 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=150 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(name="wollaston")
    )


def sky_frames(n_cycles=1):
    frames = half_wave_plate_cycles(PLATE, np.full(n_cycles, 100.0) * u.deg)
    frames["parallactic"] = np.linspace(24, 30, len(frames)) * u.deg
    frames["altitude"] = np.linspace(67, 64, len(frames)) * u.deg
    return frames


def parted(options):
    """Options of `simulate_cubes`, those of its models and files given by their names alone."""
    options = dict(options)
    for name, kind in (("image", ImageModel), ("detector", DetectorModel), ("files", CubeFiles)):
        own = {f.name for f in fields(kind)} & set(options)
        options[name] = kind(**{key: options.pop(key) for key in own})
    return options


def write(folder, frames=None, **options):
    frames = half_wave_plate_cycles(PLATE) if frames is None else frames
    options = {"flux": 1e6, "seed": 3} | options
    return simulate_cubes(folder, SMALL.chain(), SMALL, frames, **parted(options))


def write_star(folder, **options):
    options = {"source": "star", "flux": 1e5, "seed": 3, "psf": "gaussian", "fwhm": 4.0} | options
    frames = options.pop("frames", None)
    frames = sky_frames() if frames is None else frames
    chain = options.pop("chain", sky_chain())
    return simulate_cubes(folder, chain, SMALL, frames, **parted(options))


def image(path):
    return fits.getdata(path, SMALL.files.cube_extension).astype(float)


def half(cube, side):
    """The light of one beam of a star: beams lie left and right of column 43."""
    return cube[:, :, 43:] if side == "right" else cube[:, :, :43]


# --- internal source -------------------------------------------------------------


def test_aperture_of_the_layout_holds_the_flux_of_the_beam(tmp_path):
    photutils = pytest.importorskip("photutils.aperture")
    frames = half_wave_plate_cycles(PLATE)
    true = simulate(SMALL.chain(), WAVELENGTH, frames, flux=1e6, noise=False)
    true = np.stack([true.flux_right, true.flux_left])
    left, right, width, height, angle = SMALL.files.internal_apertures
    for i, path in enumerate(write(tmp_path, frames, noise=False)):
        for beam, centre in enumerate((right, left)):
            aperture = photutils.RectangularAperture(centre, width, height, theta=angle)
            mask = aperture.to_mask(method="subpixel", subpixels=16)
            sums = [mask.multiply(piece).sum() for piece in image(path)]
            np.testing.assert_allclose(sums, true[beam, i], rtol=3e-4, atol=1e-3)


def test_field_stop_leaves_the_rest_dark(tmp_path):
    cube = image(write(tmp_path, noise=False, background=7.0)[0])
    assert cube[:, :3].max() == cube.min() == 7.0
    assert np.ptp(cube[0, 20:40, 24]) < 1e-3


def test_lamp_and_flux_scale_the_image(tmp_path):
    frames = half_wave_plate_cycles([0, 0] * u.deg)
    paths = write(tmp_path, frames, noise=False, lamp=[1, 1.5], flux=np.array([1e6, 2e6, 3e6]))
    plain, bright = (image(path) for path in paths)
    np.testing.assert_allclose(bright, 1.5 * plain, rtol=1e-6)
    unit = image(write(tmp_path, frames[:1], noise=False, first=9)[0])
    np.testing.assert_allclose(plain, unit * np.array([1, 2, 3])[:, None, None], rtol=1e-6)


@given(
    width=st.floats(5, 20), height=st.floats(5, 20), angle=st.floats(-4, 4),
    x=st.floats(25, 35), y=st.floats(25, 35),
)  # fmt: skip
def test_area_of_a_turned_rectangle_is_kept(width, height, angle, x, y):
    area = _images.rectangle((60, 60), (x, y), (width, height), angle).sum()
    assert area == pytest.approx(width * height, rel=0.03)


# --- stars -----------------------------------------------------------------------


@given(
    x=st.floats(28, 32), y=st.floats(28, 32), fwhm=st.floats(2, 8),
    profile=st.sampled_from([(_images.gaussian, 0.0), (_images.moffat, 3.5)]),
)  # fmt: skip
def test_profiles_have_unit_sum_and_the_place_asked_for(x, y, fwhm, profile):
    function, beta = profile
    box = (slice(0, 62), slice(0, 61))
    share = function(box, (x, y), fwhm, beta)
    lost = 2e-2 if beta else 1e-6
    assert 1 - lost < share.sum() <= 1 + 2e-5
    rows, columns = np.indices(share.shape)
    weight = np.where(np.hypot(rows - y, columns - x) < 20, share, 0)
    assert (weight * columns).sum() / weight.sum() == pytest.approx(x, abs=0.01)
    assert (weight * rows).sum() / weight.sum() == pytest.approx(y, abs=0.01)


def test_moffat_falls_to_half_at_half_its_width():
    for beta in [2.0, 3.5]:
        share = _images.moffat((slice(0, 161), slice(0, 161)), (80.0, 80.0), 40.0, beta)
        assert share[80, 100] / share[80, 80] == pytest.approx(0.5, rel=2e-3), beta
        assert share[60, 80] == pytest.approx(share[80, 100]), beta


def test_moffat_pixels_are_integrals():
    box, place, fwhm, beta = (slice(0, 21), slice(0, 21)), (10.2, 9.7), 3.0, 3.0
    node, weight = np.polynomial.legendre.leggauss(12)
    alpha = fwhm / (2 * np.sqrt(2 ** (1 / beta) - 1))
    fine = (np.arange(21)[:, None] + node / 2).ravel()
    profile = (1 + np.add.outer((fine - 9.7) ** 2, (fine - 10.2) ** 2) / alpha**2) ** -beta
    profile *= (beta - 1) / (np.pi * alpha**2)
    exact = np.einsum("iajb,a,b->ij", profile.reshape(21, 12, 21, 12), weight / 2, weight / 2)
    assert _images.moffat(box, place, fwhm, beta) == pytest.approx(exact, abs=1e-3 * exact.max())


def test_both_beams_hold_the_flux_that_tracking_gives(tmp_path):
    frames = sky_frames()
    moved = frames.copy()
    moved["hwp"] = frames["hwp"] + 0.5 * frames["parallactic"] + frames["altitude"]
    true = simulate(sky_chain(), WAVELENGTH, moved, flux=1e5, noise=False)
    true = np.stack([true.flux_right, true.flux_left])
    same = true_observations(sky_chain(), SMALL, frames, source="star", flux=1e5)
    np.testing.assert_allclose([same.flux_right, same.flux_left], true)
    assert same.frames["hwp"].value.tolist() == frames["hwp"].value.tolist()
    np.testing.assert_allclose(same.frames["hwp_true"] - moved["hwp"], 0 * u.deg, atol=1e-9 * u.deg)
    for i, path in enumerate(write_star(tmp_path, frames=frames, noise=False)):
        sums = [half(image(path), side).sum(axis=(1, 2)) for side in ("right", "left")]
        np.testing.assert_allclose(sums, true[:, i], rtol=1e-5)


def test_right_image_lies_at_the_offset_of_the_layout(tmp_path):
    cube = image(write_star(tmp_path, noise=False, centre=(22.3, 31.6))[0])
    x, y = np.arange(90), np.arange(64)
    for side, place in (("left", (22.3, 31.6)), ("right", (60.3, 34.6))):
        light = half(cube, side)[1]
        columns = x[43:] if side == "right" else x[:43]
        found = (light.sum(axis=0) @ columns, light.sum(axis=1) @ y) / light.sum()
        np.testing.assert_allclose(found, place, atol=1e-4)


def test_an_angle_is_a_width_too_and_one_may_be_given_a_wavelength(tmp_path):
    paths = write_star(tmp_path, noise=False, fwhm=[60, 80, 100] * u.mas)
    peaks = image(paths[0]).max(axis=(1, 2))
    same = image(write_star(tmp_path, noise=False, fwhm=[3.0, 4.0, 5.0], first=20)[0])
    np.testing.assert_array_equal(peaks, same.max(axis=(1, 2)))
    assert peaks[0] > 1.5 * peaks[1] > 2 * peaks[2]


def test_halo_takes_its_share_of_the_core(tmp_path):
    plain = image(write_star(tmp_path, noise=False)[0])
    with_halo = image(write_star(tmp_path, noise=False, halo=0.3, halo_fwhm=25, first=20)[0])
    assert with_halo.max() / plain.max() == pytest.approx(0.7, abs=0.03)
    assert with_halo.sum() < plain.sum()  # the field stop cuts the wings
    assert with_halo[0, 30, 33] > 10 * plain[0, 30, 33]


@pytest.mark.slow
def test_motion_and_seeing_change_from_frame_to_frame(tmp_path):
    frames = sky_frames()[[0] * 40]
    moving = [image(p)[0] for p in write_star(tmp_path, frames=frames, noise=False, motion=0.5)]
    columns = np.arange(43)
    places = np.array([c[:, :43].sum(axis=0) @ columns / c[:, :43].sum() for c in moving])
    assert 0.3 < places.std() < 0.7
    widths = write_star(tmp_path, frames=frames, noise=False, seeing=0.1, first=100)
    peaks = np.array([image(p)[0].max() for p in widths])
    assert 0.12 < np.log(peaks).std() < 0.28


# --- detector --------------------------------------------------------------------


def test_noise_has_the_variance_that_stands_beside_it(tmp_path):
    frames = half_wave_plate_cycles([0] * u.deg)
    expected = image(write(tmp_path, frames, noise=False, background=4.0)[0])
    (path,) = write(tmp_path, frames, background=4.0, first=5)
    weight = fits.getdata(path, "IVAR")
    pulls = (image(path) - expected) * np.sqrt(weight)
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert pulls.std() == pytest.approx(1, abs=0.02)
    dark = weight[0, 0, 0]
    assert 1 / dark == pytest.approx((1.5 * 4 + 3**2) / 1.5**2)


def test_gain_and_read_noise_can_be_given(tmp_path):
    (path,) = write(tmp_path, half_wave_plate_cycles([0] * u.deg), gain=4.0, read_noise=20.0)
    assert image(path)[:, :4].std() == pytest.approx(5, rel=0.1)


def test_seed_makes_it_repeatable(tmp_path):
    frames = half_wave_plate_cycles([0, 0] * u.deg)
    one, two = (image(p) for p in write(tmp_path, frames))
    again = image(write(tmp_path, frames, first=10)[0])
    other = image(write(tmp_path, frames, first=20, seed=4)[0])
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, two)
    assert not np.array_equal(one, other)


def test_bad_pixels_and_response_are_the_same_in_all_frames(tmp_path):
    frames = half_wave_plate_cycles([0, 45] * u.deg)
    paths = write(tmp_path, frames, noise=False, bad_pixels=0.02, flat_error=0.01, background=1e3)
    first, second = (image(p) for p in paths)
    bad = np.isnan(first)
    np.testing.assert_array_equal(bad, np.isnan(second))
    assert bad.mean() == pytest.approx(0.02, abs=0.005)
    assert np.all(fits.getdata(paths[0], "IVAR")[bad] == 0)
    dark = first[:, :4][~bad[:, :4]]
    np.testing.assert_allclose(dark, second[:, :4][~bad[:, :4]])
    assert dark.std() == pytest.approx(10, rel=0.2)


def test_saturation_is_an_option(tmp_path):
    with pytest.warns(AstropolcalWarning, match=r"adu, above .* 5000 adu: .*--flux.*--saturate"):
        paths = write_star(tmp_path, fwhm=2.0)
    assert image(paths[0]).max() > 5000
    assert image(write_star(tmp_path, fwhm=2.0, saturate=True, first=20)[0]).max() == 5000


def test_without_a_flux_no_pixel_is_saturated(tmp_path, monkeypatch):
    options = {"flux": None, "noise": False}
    stars = (
        {},
        {"fwhm": 2.0},
        {"psf": "moffat", "halo": 0.3},
        {"background": 1e3},
        {"lamp": [1, 3, 2, 1]},
    )
    for i, star in enumerate(stars):
        brightest = max(image(p).max() for p in write_star(tmp_path / str(i), **options, **star))
        # the star need not be in the middle of a pixel, where it is brightest
        assert 0.3 * 5000 < brightest <= 0.5 * 5000, star
    brightest = max(image(path).max() for path in write(tmp_path / "lamp", **options))
    assert 0.45 * 5000 < brightest <= 0.5 * 5000
    # as much as without a limit
    frames = sky_frames()
    monkeypatch.setattr(Small, "files", replace(Small.files, saturation=np.inf))
    light = {"source": "star", "image": ImageModel(), "background": 0.0}
    assert _usual_flux(sky_chain(), SMALL, frames, 3e6, **light) == 3e6


def test_extinguished_beam_is_dark_not_an_error(tmp_path):
    ideal = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(mount="hwp", retardance=180 * u.deg, name="hwp")
        | optics.WollastonPrism(name="wollaston", efficiency=1.0)
    )
    frames = half_wave_plate_cycles([0, 45] * u.deg)
    quiet = DetectorModel(noise=False)
    paths = simulate_cubes(tmp_path, ideal, SMALL, frames, detector=quiet, flux=1e6)
    at = {"left": (slice(None), 30, 24), "right": (slice(None), 33, 62)}
    for path, dark, bright in zip(paths, ("left", "right"), ("right", "left"), strict=True):
        assert image(path)[at[dark]].max() < 1e-6
        assert image(path)[at[bright]].min() > 500


# --- files -----------------------------------------------------------------------


def test_headers_are_split_as_the_instrument_splits_them(tmp_path):
    frames = sky_frames()
    frames["object"] = "HD 1"
    paths = write_star(tmp_path, frames=frames, first=17, prefix="SM", headers={"OBSERVER": "me"})
    assert [p.name for p in paths[:2]] == ["SM00000017_cube.fits", "SM00000018_cube.fits"]
    cube, raw = fits.getheader(paths[1]), fits.getheader(tmp_path / "raw" / "SM00000018.fits")
    assert "HWP_CMD" not in cube
    assert "HWP_POS" not in cube
    assert raw["HWP_CMD"] == 45
    assert raw["HWP_POS"] == pytest.approx(45 + 0.5 * 26 + 66)
    for header in (cube, raw):
        assert header["PA"] == 26
        assert header["EL"] == pytest.approx(np.deg2rad(66))
        assert header["IMR"] == pytest.approx((100 - 10) / -2)
        assert header["ITIME"] == 1e4
        assert (header["DAY"], header["CLOCK"]) == ("2025-10-05", "08:00:10.000")
        assert (header["TARGET"], header["INST"], header["OBSERVER"]) == ("HD 1", "SMALL", "me")


def test_columns_of_the_frames_come_before_what_is_worked_out(tmp_path):
    frames = sky_frames()
    frames["time"] = Time("2025-11-03T23:59:50") + [0, 10, 20, 30] * u.s
    frames["exposure_time"] = [1, 2, 3, 4] * u.s
    frames["hwp_true"] = [10, 20, 30, 40] * u.deg
    paths = write_star(tmp_path, frames=frames, raw=False, noise=False)
    first, second = (fits.getheader(path) for path in paths[:2])
    assert (first["DAY"], first["CLOCK"]) == ("2025-11-03", "23:59:50.000")
    assert (second["DAY"], second["ITIME"], second["HWP_POS"]) == ("2025-11-04", 2000, 20)
    moved = sky_frames()
    moved["hwp"] = frames["hwp_true"]
    true = simulate(sky_chain(), WAVELENGTH, moved, flux=1e5, noise=False)
    sums = [half(image(p), "right").sum(axis=(1, 2)) for p in paths]
    np.testing.assert_allclose(sums, true.flux_right, rtol=1e-5)
    same = true_observations(sky_chain(), SMALL, frames, source="star", flux=1e5)
    np.testing.assert_allclose(same.flux_right, true.flux_right)


def test_without_raw_headers_all_is_in_the_cube(tmp_path):
    header = fits.getheader(write(tmp_path, raw=False)[1])
    assert header["HWP_CMD"] == header["HWP_POS"] == 45
    assert not (tmp_path / "raw").exists()


def test_progress_is_for_terminals_only(tmp_path, capsys):
    write(tmp_path, progress=True)
    assert capsys.readouterr().err == ""


def test_files_are_not_overwritten_unasked(tmp_path):
    paths = write(tmp_path)
    before = paths[0].read_bytes()
    with pytest.raises(ObservationError, match=r"00000001_cube\.fits: exists"):
        write(tmp_path, seed=8)
    assert paths[0].read_bytes() == before
    write(tmp_path, seed=8, overwrite=True)
    assert paths[0].read_bytes() != before
    assert not list(tmp_path.glob("*.tmp*"))


def test_nonsense_is_refused_before_anything_is_written(tmp_path):
    for options, error, words in [
        ({"source": "lamp"}, ParameterError, "source = 'lamp'; allowed are internal, star"),
        ({"psf": "airy"}, ParameterError, "psf = 'airy'"),
        ({"wavelength": [1.2, 1.6] * u.um}, ParameterError, "the cubes have 3 slices"),
        ({"flux": -1}, ParameterError, "flux = -1"),
        ({"fwhm": 0.0}, ParameterError, "fwhm = 0 pixels"),
        ({"fwhm": [1, 2]}, ParameterError, r"fwhm = .* of shape \(\) or \(3,\)"),
        ({"fwhm": 3 * u.m}, AstropolcalError, "fwhm"),
        ({"beta": 1.0}, ParameterError, "beta = 1"),
        ({"halo": 1.2}, ParameterError, "halo = 1.2"),
        ({"motion": -1.0}, ParameterError, "motion"),
        ({"seeing": np.nan}, ParameterError, "seeing = nan"),
        ({"centre": (1, 2, 3)}, ParameterError, "centre"),
        ({"margin": 0.0}, ParameterError, "the field stop cuts the apertures"),
        ({"background": -1}, ParameterError, "background"),
        ({"gain": 0.0}, ParameterError, "gain = 0"),
        ({"read_noise": -2}, ParameterError, "read_noise = -2"),
        ({"bad_pixels": 1.0}, ParameterError, "bad_pixels = 1"),
        ({"flat_error": 0.9}, ParameterError, "flat_error = 0.9"),
        ({"exposure_time": 0 * u.s}, ParameterError, "exposure_time = 0"),
        ({"prefix": "7"}, ParameterError, "must match"),
        ({"first": -1}, ParameterError, "must match"),
        ({"lamp": [1, 2]}, ParameterError, "lamp"),
        ({"frames": QTable({"hwp": [0] * u.deg})}, ObservationError, "derotator"),
        ({"source": "star"}, ObservationError, "altitude and parallactic missing"),
    ]:
        with pytest.raises(error, match=words):
            write(tmp_path, **options)
        assert not list(tmp_path.iterdir()), (options, error, words)


def test_missing_folder_and_layout_are_named(tmp_path):
    assert len(write(tmp_path / "new")) == 4
    with pytest.raises(ObservationError, match="there is no folder"):
        write(tmp_path / "absent" / "new")
    (tmp_path / "file").write_text("")
    with pytest.raises(ObservationError, match="is a file"):
        write(tmp_path / "file")

    class Bare(Small):
        name, files = "bare", None

    with pytest.raises(InstrumentError, match="bare: its class does not say"):
        simulate_cubes(tmp_path, SMALL.chain(), Bare(), half_wave_plate_cycles(PLATE))


def test_layout_of_charis_gives_both_beams_room():
    layout = instruments.get("charis").files
    scene = _images.Scene(ImageModel(fwhm=1.0, halo_fwhm=1.0), layout, "internal", 22)
    apart = np.subtract(*scene.centres(scene.centre))
    assert tuple(apart) == pytest.approx(layout.star_offset)
    image = scene.light(np.ones((2, 22)), scene.centre, 1.0)
    assert image.max() * scene.area == pytest.approx(1)  # the images do not overlap
    assert image[:, 0].max() == image[:, -1].max() == 0


# --- through the reduction ---------------------------------------------------------


def reduced(paths, instrument, **options):
    from astropolcal.reduction import reduce_cubes

    return reduce_cubes(paths, instrument, raw=paths[0].parent / "raw", workers=1, **options)


def agreement(observations, true):
    """Relative error of the mean flux, and mean and width of the pulls."""
    measured = np.stack([observations.flux_right, observations.flux_left])
    variance = np.stack([observations.variance_right, observations.variance_left])
    expected = np.stack([true.flux_right, true.flux_left])
    pulls = (measured - expected) / np.sqrt(variance)
    return measured.sum() / expected.sum() - 1, pulls.mean(), pulls.std()


def on_sky(n_cycles, q, u_):
    """Frames of CHARIS on a star of known polarization, with the published optics."""
    charis = instruments.get("charis")
    star, published = charis.chain("star"), leaves(charis.published())
    first = [leaf.stage for leaf in published].index("hwp")
    chain = join([*leaves(star)[: star.submodel_names.index("hwp")], *published[first:]])
    chain["star"].q, chain["star"].u = np.full(22, q), np.full(22, u_)
    frames = half_wave_plate_cycles(PLATE, np.full(n_cycles, 97.0) * u.deg)
    frames["parallactic"] = np.linspace(24, 40, len(frames)) * u.deg
    frames["altitude"] = np.linspace(67, 60, len(frames)) * u.deg
    return charis, chain, frames


@pytest.mark.long
def test_internal_source_comes_back_unbiased(tmp_path):
    charis = instruments.get("charis")
    # 1056 fluxes: the mean of their pulls is known to 0.03
    frames = half_wave_plate_cycles(PLATE, np.arange(50, 110, 10) * u.deg)
    paths = simulate_cubes(tmp_path, charis.published(), charis, frames, flux=4e6,
                           detector=DetectorModel(bad_pixels=1e-3), seed=7)  # fmt: skip
    observations = reduced(paths, charis, source="internal")
    true = true_observations(charis.published(), charis, frames, flux=4e6)
    bias, mean, width = agreement(observations, true)
    assert abs(bias) < 1e-3
    assert abs(mean) < 0.1
    assert width == pytest.approx(1, abs=0.15)
    np.testing.assert_allclose(observations.frames["hwp"], frames["hwp"])
    np.testing.assert_allclose(observations.frames["derotator"], frames["derotator"])


@pytest.mark.long
def test_star_comes_back_unbiased_and_so_does_its_polarization(tmp_path):
    q, u_ = 0.008, -0.006
    charis, chain, frames = on_sky(4, q, u_)
    paths = simulate_cubes(
        tmp_path, chain, charis, frames, source="star", flux=5e5, seed=8,
        image=ImageModel(psf="gaussian", fwhm=4.0, motion=1.0, seeing=0.05),
        detector=DetectorModel(background=5.0),
    )  # fmt: skip
    observations = reduced(paths, charis, source="star")
    true = true_observations(chain, charis, frames, source="star", flux=5e5)
    bias, mean, width = agreement(observations, true)
    assert abs(bias) < 1e-3
    assert abs(mean) < 0.1
    assert width == pytest.approx(1, abs=0.15)
    _polarization_agrees(chain, observations, charis, q, u_)


@pytest.mark.long
def test_aperture_correction_recovers_the_wings_and_the_polarization(tmp_path):
    """A Moffat star with a halo, of whose light a tenth lies outside of the apertures."""
    q, u_ = 0.008, -0.006
    charis, chain, frames = on_sky(2, q, u_)
    paths = simulate_cubes(
        tmp_path, chain, charis, frames, source="star", flux=5e5, seed=8,
        image=ImageModel(fwhm=np.linspace(4, 6, 22), beta=2.5, halo=0.05, motion=1.0, seeing=0.05),
        detector=DetectorModel(background=5.0),
    )  # fmt: skip
    true = true_observations(chain, charis, frames, source="star", flux=5e5)
    plain = agreement(reduced(paths, charis, source="star"), true)[0]
    corrected = reduced(paths, charis, source="star", aperture_correction=True)
    bias, mean, width = agreement(corrected, true)
    assert plain < -0.05
    # the errors of the eight corrections are known to a thousandth
    assert abs(bias) < 3e-3
    assert abs(mean) < 1.0
    assert 0.6 < width < 1.3
    _polarization_agrees(chain, corrected, charis, q, u_)


@pytest.mark.slow
def test_polarization_survives_wings_outside_the_aperture(tmp_path):
    q, u_ = 0.008, -0.006
    charis, chain, frames = on_sky(2, q, u_)
    lamp = np.random.default_rng(3).uniform(0.7, 1.0, len(frames))
    paths = simulate_cubes(
        tmp_path, chain, charis, frames, source="star", flux=5e5, lamp=lamp, seed=9,
        image=ImageModel(fwhm=np.linspace(4, 6, 22), halo=0.2, motion=1.0, seeing=0.1),
        detector=DetectorModel(bad_pixels=1e-3),
    )  # fmt: skip
    _polarization_agrees(chain, reduced(paths, charis, source="star"), charis, q, u_)


def _polarization_agrees(chain, observations, instrument, q, u_):
    """Fit q and u of the star with all optics known, and compare them with the truth."""
    model = chain.copy()
    for leaf in leaves(model):
        for name in leaf.param_names:
            getattr(leaf, name).fixed = (leaf.name, name) not in {("star", "q"), ("star", "u")}
    model["star"].q = model["star"].u = np.zeros(22)
    found = calibrate(
        model,
        observations,
        instrument=instrument.name,
        weights="errors",
        errors="white",
        cross_validate=False,
    )
    pulls = []
    for name, true in (("q", q), ("u", u_)):
        errors = [found.covariance.std(f"star.{name}[{i}]") for i in range(22)]
        values = getattr(found.chain["star"], name).value
        assert np.max(errors) < 2e-3
        assert abs(values.mean() - true) < 4 * np.mean(errors) / np.sqrt(22)
        pulls += list((values - true) / errors)
    assert np.std(pulls) == pytest.approx(1, abs=0.35)
