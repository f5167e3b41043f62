# Licensed under a 3-clause BSD style license - see LICENSE
"""Runs: what is left out and why, resuming, processes, the table, other people's tables."""

import os
import re
import warnings
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from reduction_lab import Small, expose, pair, reduce_frame_or_die, star_image, write_cube

from astropolcal import instruments
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    InstrumentError,
    ObservationError,
    ParameterError,
)
from astropolcal.instruments.layout import FileLayout
from astropolcal.observations import Observations, pointing
from astropolcal.plotting.reduction import save_quicklook
from astropolcal.reduction import read_pypolcal, reduce_cubes, reduce_run
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.reduction.frames import Frame, reduce_frame
from astropolcal.reduction.photometry import rectangles
from astropolcal.reduction.run import Journal
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAYOUT = Small.files
CYCLE = [0.0, 45.0, 22.5, 67.5]


def star_frames(folder, count=4, **changes):
    """Write good frames of a star, as the tracking law wants them."""
    paths = []
    for i in range(count):
        hwp = CYCLE[i % 4]
        cube = expose(star_image(pair(LAYOUT)), LAYOUT, seed=i)
        path = folder / f"CRSA{i + 1:08d}_cube.fits"
        paths.append(write_cube(path, cube, RET__ANG1=hwp, RET__POS1=hwp + 80.0, **changes))
    return paths


def flat_frames(folder, angles=(*CYCLE, 90.0), derotator=45.0, start=1):
    paths = []
    for i, hwp in enumerate(angles):
        cube = expose(np.full((201, 201), 400.0), LAYOUT, seed=start + i)
        path = folder / f"CRSA{start + i:08d}_cube.fits"
        paths.append(write_cube(path, cube, RET__ANG1=hwp, RET__POS1=hwp, D_IMRANG=derotator))
    return paths


# --- from cubes to truth ---------------------------------------------------------


@pytest.mark.slow
def test_internal_run_recovers_the_fluxes_and_calibrates(tmp_path):
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(derotator=[45, 70] * u.deg)
    paths = simulate_cubes(tmp_path, charis.published(), charis, frames, flux=1e7, seed=1)
    reduction = reduce_run(paths, charis, raw=tmp_path / "raw", meta={"yjh50_dichroic": "in"})
    obs = reduction.observations
    assert reduction.problems == {}
    assert obs.source == "polarized"
    assert charis.setup(obs) == ("polarized", ("dichroic", "nbs"))
    true = simulate(charis.published(), charis.wavelength, frames, flux=1e7, noise=False)
    pulls = (obs.flux_right - true.flux_right) / np.sqrt(obs.variance_right)
    assert abs(pulls.mean()) < 0.25
    assert pulls.std() == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(obs.flux_left.sum(), true.flux_left.sum(), rtol=1e-4)
    assert len(obs.pairs()) == 8


def test_star_run(tmp_path, small):
    reduction = reduce_run(star_frames(tmp_path), small, source="unpolarized standard star")
    obs = reduction.observations
    assert reduction.problems == {}
    assert obs.n_frames == 4
    assert obs.meta["object"] == "HD 293396"
    assert obs.meta["date"] == "2025-11-03"
    assert obs.source == "unpolarized standard star"
    np.testing.assert_allclose(np.rad2deg(obs.position("hwp")), CYCLE)
    np.testing.assert_allclose(np.rad2deg(obs.position("parallactic")), 20.0)
    np.testing.assert_allclose(obs.flux_right, 2e5, rtol=0.01)
    table = reduction.photometry
    assert {"x_right", "fwhm_left", "background_right"} <= set(table.colnames)


def test_pointing_of_a_run_is_computed_without_the_network(tmp_path, small, no_network):
    """Headers without angles: one warning where the Earth's rotation is not known, not one each."""
    place = {"RA": "05:05:05", "DEC": "+10:00:00", "drop": ("PARANG", "ALTITUDE", "RET-POS1")}
    dates = {"1990-11-03": (48198.5, True), "2026-12-05": (61379.5, True)}
    for date, (mjd, covered) in (dates | {"2031-11-03": (63173.5, False)}).items():
        folder = tmp_path / date
        folder.mkdir()
        paths = star_frames(folder, 3, UTC__DATE=date, MJD=mjd, **place)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            frames = reduce_run(paths, small, source="star").frames
        assert [str(w.message).split(":")[0][:11] for w in caught] == ["times after"] * (
            not covered
        )
        star = SkyCoord("05:05:05", "+10:00:00", unit=(u.hourangle, u.deg), frame="fk5")
        altitude, parallactic = pointing(star, Time(mjd, format="mjd"), small.location)
        for frame in frames:
            assert frame.values["altitude"] == pytest.approx(altitude.value, abs=1e-9)
            assert frame.values["parallactic"] == pytest.approx(parallactic.value, abs=1e-9)
            assert "parallactic and altitude computed" in frame.doubts[0]


def test_unpolarized_source_is_recognized_and_a_statement_wins(tmp_path, small):
    paths = flat_frames(tmp_path, CYCLE)
    assert reduce_cubes(paths, small).source == "unpolarized"
    assert reduce_cubes(paths, small, meta={"source": "lamp"}).source == "lamp"
    words = "source 'polarized' is stated, but the fluxes change with the plate as if unpolarized"
    with pytest.warns(AstropolcalWarning, match=words):
        assert reduce_cubes(paths, small, source="polarized").source == "polarized"
    # too few angles to tell
    assert reduce_cubes(paths[:2], small).source is None


# --- the table -------------------------------------------------------------------


def test_masked_cells_have_a_reason_and_no_nan_in_the_file(tmp_path, small):
    paths = star_frames(tmp_path)
    with fits.open(paths[1], mode="update", memmap=False) as hdus:
        hdus[1].data[2] = np.nan
    reduction = reduce_run(paths, small, source="star")
    assert reduction.flags == {"empty slice": 1}
    target = tmp_path / "obs.ecsv"
    reduction.write(target)
    assert "nan" not in target.read_text().lower()
    again = Observations.read(target)
    assert again.mask_reasons == {"empty slice": 1}
    assert again.content_hash == reduction.observations.content_hash
    with pytest.raises(ObservationError, match="exists already"):
        reduction.write(target)
    reduction.write(target, overwrite=True)


def test_shared_noise_goes_into_the_errors_of_difference_and_sum(tmp_path, small):
    image = np.full((201, 201), 40.0)
    for rows, columns, weights in rectangles(LAYOUT.internal_apertures, (201, 201)):
        image[rows, columns] += 300.0 * weights
    paths = [
        write_cube(tmp_path / f"CRSA{i:08d}_cube.fits", expose(image, LAYOUT, i), RET__ANG1=hwp)
        for i, hwp in enumerate(CYCLE)
    ]
    # RET-POS1 is the same in all headers
    with pytest.warns(AstropolcalWarning, match=r"4 files doubtful .*CRSA00000000.*RET-POS1"):
        own = reduce_cubes(paths, small)
    with pytest.warns(AstropolcalWarning, match="doubtful"):
        shared = reduce_cubes(paths, small, background="outside")
    assert (own.covariance == 0).all()
    assert (shared.covariance > 0).all()


def test_frames_of_other_days_and_files_left_out_are_told_of(tmp_path, small):
    paths = flat_frames(tmp_path, CYCLE)
    for path, mjd in zip(paths, (60871.3, 60871.31, 60953.3, 60953.31), strict=True):
        fits.setval(path, "MJD", value=mjd)
        fits.delval(path, "UTC-DATE")
    doubts = reduce_run(paths, small).doubts
    assert all("more than a day" in " ".join(doubts[str(path)]) for path in paths)
    fits.setval(paths[0], "D_IMRANG", value="?")
    with (
        pytest.warns(AstropolcalWarning, match=f"1 file left out .*{paths[0].name}: D_IMRANG"),
        pytest.warns(AstropolcalWarning, match="doubtful"),
    ):
        assert reduce_cubes(paths, small).n_frames == 3


# --- bad input -------------------------------------------------------------------


def bad_files(folder):
    """Write every kind of bad file; return path and what its reason must say."""
    good = expose(star_image(pair(LAYOUT)), LAYOUT)
    cut = write_cube(folder / "CRSA00000101_cube.fits", good)
    cut.write_bytes(cut.read_bytes()[:200000])
    noise = folder / "CRSA00000102_cube.fits"
    noise.write_bytes(b"this is not FITS" * 300)
    two = pair(LAYOUT) + pair(LAYOUT, 45.0, 60.0, 0.6)
    made = {
        "103": (write_cube(folder / "CRSA00000103_cube.fits", good[:2]), "shape"),
        "104": (write_cube(folder / "CRSA00000104_cube.fits", None), "extension 1"),
        "105": (write_cube(folder / "CRSA00000105_cube.fits", good, drop=["RET-ANG1"]), "RET-ANG1"),
        "106": (write_cube(folder / "CRSA00000106_cube.fits", good * np.nan), "no pixel"),
        "107": (write_cube(folder / "CRSA00000107_cube.fits", good, INSTRUME="HICIAO"), "HICIAO"),
        "108": (
            write_cube(folder / "CRSA00000108_cube.fits", expose(star_image(two), LAYOUT)),
            "two stars",
        ),
        "109": (
            write_cube(folder / "CRSA00000109_cube.fits", expose(star_image([]), LAYOUT)),
            "no star",
        ),
        "110": (write_cube(folder / "CRSA00000110_cube.fits", good, ALTITUDE=99.0), "ALTITUDE"),
        "111": (write_cube(folder / "CRSA00000111_cube.fits", good, RET__POS1=50.0), "tracking"),
        "112": (write_cube(folder / "CRSA00000112_cube.fits", good, PARANG="x"), "PARANG"),
        "113": (write_cube(folder / "CRSA00000113_cube.fits", good, BUNIT="Jy"), "Jy"),
    }
    listed = dict(made.values())
    listed |= {cut: "", noise: "is not a FITS file", folder / "CRSA00000114.fits": "no such file"}
    return listed


def test_bad_files_are_listed_and_do_not_stop_the_run(tmp_path, small):
    good = star_frames(tmp_path)
    listed = bad_files(tmp_path)
    reduction = reduce_run([*listed, *good], small, source="star")
    assert len(reduction.frames) == 4
    assert set(reduction.problems) == {str(path) for path in listed}
    for path, words in listed.items():
        assert words in "; ".join(reduction.problems[str(path)])


def test_copies_other_modes_and_other_units_are_left_out(tmp_path, small):
    good = star_frames(tmp_path)
    folder = tmp_path / "more"
    folder.mkdir()
    other = expose(star_image(pair(LAYOUT)), LAYOUT, seed=50)
    copy = folder / "copy_CRSA00000099_cube.fits"
    copy.write_bytes(good[0].read_bytes())
    again = write_cube(folder / "CRSA00000002_cube.fits", other)
    mode = write_cube(folder / "CRSA00000090_cube.fits", other * 1.01, FILTNAME="H")
    unit = write_cube(folder / "CRSA00000091_cube.fits", other * 1.02, BUNIT="electron")
    reduction = reduce_run([*good, copy, again, mode, unit], small, source="star")
    why = {path: "; ".join(reasons) for path, reasons in reduction.problems.items()}
    assert "the same data as CRSA00000001_cube.fits" in why[str(copy)]
    # of two files of one name the folder must be told
    assert f"the same frame as {good[1]}" in why[str(again)]
    assert "filter 'H'" in why[str(mode)]
    assert "unit 'electron'" in why[str(unit)]
    assert len(reduction.frames) == 4


def test_frames_of_another_star_pickoff_or_source_are_left_out(tmp_path, small):
    good = star_frames(tmp_path, X_CHAPKO="mirror")
    star = expose(star_image(pair(LAYOUT)), LAYOUT, seed=60)
    spelt = write_cube(tmp_path / "CRSA00000011_cube.fits", star, OBJECT="HD293396")
    other = write_cube(tmp_path / "CRSA00000012_cube.fits", star * 1.1, OBJECT="HD 30675")
    pickoff = write_cube(tmp_path / "CRSA00000013_cube.fits", star * 1.2, X_CHAPKO="YJH50")
    reduction = reduce_run([*good, spelt, other, pickoff], small, source="star")
    assert len(reduction.frames) == 5
    assert reduction.problems == {
        str(other): ["object 'HD 30675', the others of the run have 'HD 293396'"],
        str(pickoff): ["pickoff 'YJH50', the others of the run have 'mirror'"],
    }


def test_date_that_would_spoil_the_table_is_refused_before_the_work(tmp_path, small):
    with pytest.raises(ObservationError, match=r"reduced: date in the meta = 'May' is not a date"):
        reduce_run([tmp_path / "nowhere.fits"], small, meta={"date": "May"})


def test_hot_pixels_are_counted_and_told(tmp_path, small):
    paths = flat_frames(tmp_path, CYCLE)
    clean = reduce_run(paths, small)
    assert (clean.summary()["n_outliers"], clean.doubts) == (0, {})
    with fits.open(paths[2], mode="update") as hdus:
        hdus[1].data[:, 90, 75] = 39_000.0
    found = reduce_run(paths, small)
    assert found.summary()["n_outliers"] == len(small.wavelength)
    assert found.doubts == {str(paths[2]): ["single pixels far off their neighbours were left out"]}
    np.testing.assert_allclose(
        found.observations.flux_left, clean.observations.flux_left, rtol=1e-3
    )


def test_a_star_is_no_internal_source(tmp_path, small):
    lamp = flat_frames(tmp_path, CYCLE)
    (tmp_path / "sky").mkdir()
    star = star_frames(tmp_path / "sky", 1)[0].rename(tmp_path / "CRSA00000020_cube.fits")
    mixed = reduce_run([*lamp, star], small)
    assert mixed.problems == {
        str(star): ["light 'uneven', the others of the run have 'even'"],
    }
    # nothing else to compare it with
    alone = reduce_run([star], small)
    tracked, light = alone.doubts[str(star)]
    assert tracked.startswith("RET-POS1 and RET-ANG1 differ by more than 1 deg")
    assert "as that of a star" in light


def test_light_outside_the_beams_of_a_lamp_is_told(tmp_path, small):
    """Subtracted it is told no more; where there is as much as inside the lamp fills the field."""
    image = np.zeros((201, 201))
    for rows, columns, weights in rectangles(LAYOUT.internal_apertures, (201, 201)):
        image[rows, columns] += 400.0 * weights
    for level, background, told in (
        (0.0, "none", None),
        (2.0, "none", None),
        (20.0, "none", r"there is 4\.\d % of the light inside"),
        (20.0, "outside", None),
        (300.0, "none", "there is 4[0-9] %"),
        (1e4, "none", None),
    ):
        path = write_cube(tmp_path / "CRSA00000001_cube.fits", expose(image + level, LAYOUT))
        doubts = str(reduce_run([path], small, background=background).doubts)
        assert bool(re.search(told or "outside the beams", doubts)) == bool(told), (level, doubts)


def test_lamp_is_no_star_and_says_so_without_warnings(tmp_path, small):
    image = np.zeros((201, 201))
    for rows, columns, weights in rectangles(LAYOUT.internal_apertures, (201, 201)):
        image[rows, columns] += 400.0 * weights
    path = write_cube(tmp_path / "CRSA00000001_cube.fits", expose(image, LAYOUT))
    with pytest.raises(ObservationError, match="no slice can be used"):
        reduce_run([path], small, source="star")


def test_headers_say_which_optics_are_in_the_beam(tmp_path, small):
    words = {"dichroic_x": ("pickoff", {"(?i)yjh": "in", ".": "out"})}
    told = type("Told", (Small,), {"files": replace(LAYOUT, optics=words)})()
    folders = {"YJH50": "in", "mirror": "out"}
    for pickoff, word in folders.items():
        (tmp_path / pickoff).mkdir()
        paths = star_frames(tmp_path / pickoff, 2, X_CHAPKO=pickoff)
        assert reduce_run(paths, told, source="star").meta["dichroic_x"] == word
    given = reduce_run(paths, told, source="star", meta={"dichroic_x": "in"})
    assert given.meta["dichroic_x"] == "in"


def test_dark_and_flat_are_taken_out_with_their_bad_pixels(tmp_path, small):
    rng = np.random.default_rng(5)
    clean, raw = tmp_path / "clean", tmp_path / "raw"
    dark = rng.uniform(60, 100, (201, 201))
    flat = rng.uniform(0.5, 1.5, (201, 201))
    paths = []
    for folder in (clean, raw):
        folder.mkdir()
        paths.append(flat_frames(folder))
    for path in paths[1]:
        with fits.open(path, mode="update") as hdus:
            hdus[1].data = (hdus[1].data * flat + dark).astype("f4")
    # a bad pixel of each in a rectangle
    (rows, columns, _), _ = rectangles(LAYOUT.internal_apertures, (201, 201))
    bad = rows.start + 9, columns.start + 9
    dark[bad], flat[bad[0] + 3, bad[1]] = np.nan, 0.0
    for name, image in (("dark", dark), ("flat", 3 * flat)):
        fits.writeto(tmp_path / f"{name}.fits", image)
    masters = {name: tmp_path / f"{name}.fits" for name in ("dark", "flat")}
    wanted = reduce_run(paths[0], small).observations
    found = reduce_run(paths[1], small, **masters).observations
    # up to the median of the flat
    ratio = found.flux_right / wanted.flux_right
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=2e-3)
    np.testing.assert_allclose(np.median(ratio), np.median(flat), rtol=5e-3)
    spoilt = reduce_run(paths[1], small).observations
    assert abs(spoilt.flux_right / wanted.flux_right - 1).max() > 0.05
    # the dark was subtracted before, as pixels without light show
    for path in paths[0]:
        with fits.open(path, mode="update") as hdus:
            hdus[1].data[:, :20] = rng.normal(0.0, 5.0, (20, 201))
    told = reduce_run(paths[0], small, dark=masters["dark"]).doubts
    assert all("was subtracted before" in "; ".join(why) for why in told.values())
    assert len(told) == len(CYCLE)
    assert "before" not in str(reduce_run(paths[1], small, **masters).doubts)
    # a journal, and a session, know when a dark was made again
    journal = {"resume": tmp_path / "journal"}
    for level in (0.0, 30.0):
        fits.writeto(masters["dark"], dark - level, overwrite=True)
        again = reduce_run(paths[1], small, **masters, **journal).observations
        np.testing.assert_allclose(again.flux_right > found.flux_right, level > 0)
    fits.writeto(tmp_path / "other.fits", np.ones((20, 20)))
    fits.writeto(tmp_path / "empty.fits", np.zeros((201, 201)))
    for path, words in [
        ("other.fits", r"\(20, 20\); .* is needed"),
        ("none.fits", "no such file"),
        ("empty.fits", "all its pixels are 0"),
    ]:
        with pytest.raises(AstropolcalError, match=words):
            reduce_run(paths[1], small, dark=tmp_path / path)


def test_a_journal_knows_when_a_raw_header_was_mended(tmp_path, small, flat_cube):
    (tmp_path / "raw").mkdir()
    cube = write_cube(tmp_path / "CRSA00000001_cube.fits", flat_cube, drop=["RET-ANG1"])
    for angle in (0.0, 45.0):
        raw = write_cube(tmp_path / "raw" / "CRSA00000001.fits", None, RET__ANG1=angle)
        # a clock may be coarser than two writes are apart
        os.utime(raw, ns=(0, int(angle * 1e9)))
        options = {"raw": tmp_path / "raw", "resume": tmp_path / "run.journal"}
        (frame,) = reduce_run([cube], small, **options).frames
        assert frame.values["hwp"] == angle


def test_dark_in_another_unit_is_refused_and_of_another_exposure_told(tmp_path, small):
    paths = flat_frames(tmp_path)
    for unit, time, words in [
        ("adu", 10.0, ""),
        (None, 10.0, ""),
        ("adu", 5.0, "exposure_time = 10.0, but 5.0 in its dark"),
        ("electron", 10.0, "dark.fits is in electron, the frame in adu"),
        ("adu/s", 10.0, "dark.fits is in adu/s, the frame in adu"),
    ]:
        cards = fits.Header({"EXPTIME": time} | ({"BUNIT": unit} if unit else {}))
        fits.writeto(tmp_path / "dark.fits", np.ones((201, 201)), cards, overwrite=True)
        if "dark.fits" in words:
            with pytest.raises(ObservationError, match=words):
                reduce_run(paths, small, dark=tmp_path / "dark.fits")
            continue
        told = reduce_run(paths, small, dark=tmp_path / "dark.fits").doubts
        assert all(words in "; ".join(why) for why in told.values()), (unit, time)
        assert bool(told) is bool(words), (unit, time)


def test_pixels_that_lack_exposures_are_as_bright_as_the_others(tmp_path, small):
    """Known in the last exposure only, or not in it, while the lamp fades."""
    layout = replace(LAYOUT, shape=(1, 201, 201), stacked=True)
    light = np.array([1.0, 1.0, 1.0, 1.0, 0.4])
    stack = light[:, None, None] * np.full((5, 201, 201), 400.0)
    rng = np.random.default_rng(1)
    for lost, share in [(slice(4), 0.1), (4, 0.3)]:
        holes = rng.random((201, 201)) < share
        # in the right beam only
        holes[:, :100] = False
        cube = stack.copy()
        cube[lost, holes] = np.nan
        frame = reduce_frame(write_cube(tmp_path / "CRSA00000001_cube.fits", cube), layout)
        right, left = frame.photometry.flux[:, 0]
        assert right / left == pytest.approx(1, abs=1e-6), lost
        assert left == pytest.approx(352 * 44.48 * 112.38, rel=1e-4)


def test_nothing_usable_is_an_error_that_says_why(tmp_path, small):
    with pytest.raises(ObservationError, match=r"none of the 2 files .*no such file.*1 more"):
        reduce_cubes([tmp_path / "a.fits", tmp_path / "b.fits"], small)
    with pytest.raises(ObservationError, match="no files"):
        reduce_cubes([], small)


def test_wrong_options_are_errors_at_once(tmp_path, small):
    paths = star_frames(tmp_path, 1)
    with pytest.raises(ParameterError, match="radius"):
        reduce_cubes(paths, small, source="star", radius="best")
    with pytest.raises(ParameterError, match="source = 'stars'; allowed are internal"):
        reduce_cubes(paths, small, source="stars")
    with pytest.raises(ParameterError, match="workers"):
        reduce_cubes(paths, small, source="star", workers=0)
    bare = type("Bare", (Small,), {"files": None, "name": "bare"})
    with pytest.raises(InstrumentError, match="bare"):
        reduce_cubes(paths, bare())
    short = type("Short", (Small,), {"wavelength": [1.0] * u.um})
    with pytest.raises(InstrumentError, match="1 wavelengths"):
        reduce_cubes(paths, short())


# --- angles ----------------------------------------------------------------------


def test_ninety_degrees_repeats_zero(tmp_path, small):
    paths = flat_frames(tmp_path)
    reduction = reduce_run(paths, small)
    assert reduction.observations.n_frames == 4
    assert "repeats that of CRSA00000001" in reduction.problems[str(paths[-1])][0]
    assert reduce_run(paths, small, keep_repeats=True).observations.n_frames == 5


def test_corrupted_angles_are_left_out_or_replaced(tmp_path, small):
    paths = flat_frames(tmp_path, CYCLE)
    paths += flat_frames(tmp_path, [0.0, 45.0, 31.0, 67.5], derotator=70.0, start=5)
    reduction = reduce_run(paths, small)
    assert list(reduction.problems) == [str(paths[6])]
    assert "31 deg" in reduction.problems[str(paths[6])][0]
    told = reduce_run(paths, small, hwp_sequence=CYCLE)
    assert told.problems == {}
    assert "replaced by 22.5 deg" in told.doubts[str(paths[6])][0]
    with pytest.raises(ObservationError, match="sequences of 3"):
        reduce_run(paths, small, hwp_sequence=[0, 45, 22.5])
    # four frames are left, which are no sequence
    for path in paths[1:3] + paths[5:7]:
        write_cube(path, np.full((4, 201, 201), np.nan))
    with pytest.raises(ObservationError, match=f"{paths[1].name}: cannot be used; leave out all"):
        reduce_run(paths, small, hwp_sequence=CYCLE)


def test_pointing_is_computed_where_the_header_lacks_it(tmp_path, small):
    where = {"RA": "05:05:05", "DEC": "+10:00:00", "drop": ("PARANG", "ALTITUDE", "RET-POS1")}
    reduction = reduce_run(star_frames(tmp_path, 1, **where), small, source="star")
    frame = reduction.frames[0]
    assert frame.values["altitude"] == pytest.approx(76.85, abs=0.05)
    assert any("computed" in doubt for doubt in frame.doubts)
    assert any("tracking" in doubt for doubt in frame.doubts)


# --- many files ------------------------------------------------------------------


def test_journal_is_used_and_survives_a_line_cut_off(tmp_path, small, monkeypatch):
    paths = star_frames(tmp_path)
    journal = tmp_path / "run.journal"
    first = reduce_run(paths[:2], small, source="star", resume=journal)
    assert first.observations.n_frames == 2
    with open(journal, "a") as stream:
        stream.write('{"key": "cut o')
    seen = []
    monkeypatch.setattr(
        "astropolcal.reduction.run.reduce_frame",
        lambda path, **task: seen.append(path) or reduce_frame(path, **task),
    )
    whole = reduce_run(paths, small, source="star", resume=journal)
    assert seen == [str(path) for path in paths[2:]]
    fresh = reduce_run(paths, small, source="star")
    assert whole.observations.content_hash == fresh.observations.content_hash
    seen.clear()
    reduce_run(paths, small, source="star", resume=journal)
    assert seen == []
    # other options, other results
    reduce_run(paths, small, source="star", resume=journal, radius=10.0)
    assert len(seen) == 4


def test_journal_refuses_other_files(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("my notes\n")
    with pytest.raises(ObservationError, match="not a journal"):
        Journal(path, {})
    assert path.read_text() == "my notes\n"


def test_frames_survive_the_journal(tmp_path, small):
    frame = reduce_frame(star_frames(tmp_path, 1)[0], LAYOUT, source="star")
    again = Frame.from_dict(frame.to_dict())
    np.testing.assert_array_equal(again.photometry.flux, frame.photometry.flux)
    assert again.values == frame.values


@pytest.mark.slow
def test_processes_give_the_same(tmp_path, small):
    paths = star_frames(tmp_path)
    many = reduce_cubes(paths, small, source="star", workers=2)
    one = reduce_cubes(paths, small, source="star", workers=1)
    assert many.content_hash == one.content_hash
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    settings = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with distributed.LocalCluster(processes=False, **settings) as cluster:
        address = cluster.scheduler_address
        there = reduce_cubes(paths, small, source="star", cluster=address)
    assert there.content_hash == one.content_hash


@pytest.mark.slow
def test_file_that_kills_its_process_does_not_take_the_others_with_it(tmp_path, small, monkeypatch):
    paths = star_frames(tmp_path)
    paths[1] = paths[1].rename(tmp_path / "deadly_00000002_cube.fits")
    monkeypatch.setattr("astropolcal.reduction.run.reduce_frame", reduce_frame_or_die)
    reduction = reduce_run(paths, small, source="star", workers=2)
    assert len(reduction.frames) == 3
    died = "the process that worked on it died 3 times (exit status 9)"
    assert reduction.problems == {str(paths[1]): [died]}


# --- pyPolCal --------------------------------------------------------------------

COLUMNS = "filepath,D_IMRANG,RET-ANG1,single_sum,single_diff,LCOUNTS,RCOUNTS,sum_std,diff_std"


def write_csv(path, wavelength, *, extra="", values=(), angle=0.0):
    rows = [f"{COLUMNS},wavelength_bin{',p,a' if extra else ''}"]
    for i, hwp in enumerate(CYCLE):
        rows.append(
            f"/d/CRSA{i:08d}_cube.fits, 45.0, {hwp + angle}, 300.0, 100.0, 100.0, 200.0, 17.3, "
            f"17.3, {wavelength}{extra}"
        )
    path.write_text("\n".join([*rows, *values]) + "\n")
    return path


def test_pypolcal_tables(tmp_path):
    for k, wavelength in enumerate((1159.5614, 1199.6970)):
        write_csv(tmp_path / f"bin{k}.csv", wavelength, extra=", 20.5, 67.0")
    obs = read_pypolcal(tmp_path, {"source": "unpolarized standard star"})
    assert (obs.n_frames, obs.n_bins) == (4, 2)
    assert obs.flux_right[0, 0] == 200.0
    assert obs.flux_left[0, 0] == 100.0
    np.testing.assert_allclose(np.rad2deg(obs.position("altitude")), 67.0)
    np.testing.assert_allclose(np.rad2deg(obs.position("hwp")), CYCLE)
    assert len(obs.pairs()) == 2
    np.testing.assert_allclose(obs.variance_right + obs.variance_left, 17.3**2)


def test_pypolcal_errors_name_file_and_line(tmp_path):
    for angle in ("1_0", "?"):
        row = f"x, 45.0, {angle}, 1,1,1,1,1,1,1159.5614"
        path = write_csv(tmp_path / "bin0.csv", 1159.5614, values=[row])
        words = f"bin0.csv, line 6: RET-ANG1 = '{angle}', a number"
        with pytest.raises(ObservationError, match=re.escape(words)):
            read_pypolcal(path)
    row = path.read_text().splitlines()[1]
    with pytest.raises(ObservationError, match=r"line 6: .* is given already in .*line 2"):
        read_pypolcal(write_csv(tmp_path / "twice.csv", 1159.5614, values=[row]))
    # a comma too many, as of decimals, or a column too few would move numbers to other columns
    whole = path.read_text()
    for old, new in [(row, f"{row},3"), (row, row.rpartition(",")[0])]:
        path.write_text(whole.replace(old, new).replace("\n", "\n\n", 1))
        with pytest.raises(ObservationError, match=r"line 3: each of its \d+ columns needs a name"):
            read_pypolcal(path)
    # at the end of each line, and of the first one or not, it moves nothing
    lines = whole.splitlines()
    for first, rest in (("", ","), (",", ","), (",", "")):
        path.write_text("\n".join([lines[0] + first, *(line + rest for line in lines[1:5])]))
        assert read_pypolcal(path).flux_right[0, 0] == 200.0, (first, rest)
    bare = tmp_path / "bare.csv"
    bare.write_text("filepath,D_IMRANG\na,1\n")
    with pytest.raises(ObservationError, match="missing columns RET-ANG1, LCOUNTS"):
        read_pypolcal(bare)
    with pytest.raises(ObservationError, match="no such file"):
        read_pypolcal(tmp_path / "none.csv")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ObservationError, match="no CSV file"):
        read_pypolcal(empty)


def test_pypolcal_agrees_with_the_table_made_of_it(tmp_path, shared_data):
    theirs = Observations.read(shared_data / "data/charis/dataset3_polarized_2025-10-05.ecsv")
    table = QTable(theirs.to_table())
    for k in range(2):
        part = table[table["bin"] == k]
        rows = [f"{COLUMNS},wavelength_bin"]
        rows += [
            f"/x/{r['file']},{r['derotator'].value},{r['hwp'].value},0,0,{r['flux_left'].value},"
            f"{r['flux_right'].value},{r['single_sum_err'].value},"
            f"{r['single_difference_err'].value},{r['wavelength'].value}"
            for r in part
        ]
        (tmp_path / f"bin{k}.csv").write_text("\n".join(rows))
    ours = read_pypolcal(tmp_path, {"source": "polarized"})
    np.testing.assert_allclose(ours.flux_right, theirs.flux_right[:, :2], rtol=1e-9)
    np.testing.assert_array_equal(ours.pairs(), theirs.pairs())


# --- one beam, and more than two ------------------------------------------------------------------


def beams_of(layout, places, states=(), **settings):
    """Return an instrument whose images hold a star or a lamp at some places, one for each beam."""
    keywords = {"angle": "ROTOR", "exposure_time": "EXPTIME", "mjd": "MJD", "object": "OBJECT"}
    keywords |= {name: name.upper() for name in states}
    own = FileLayout(
        keywords,
        (1, 201, 201),
        beams=layout,
        stages=("angle", *states),
        texts=states,
        star_offsets=places,
        units={"mjd": "d"},
        gain=2.0,
        read_noise=10.0,
        **settings,
    )

    class Other(Small):
        name, aliases, wavelength, files = "other", (), [0.6] * u.um, own

    return Other()


def test_one_beam_and_four_beams_are_measured_as_two_are(tmp_path):
    cases = {
        ("only",): [(100.0, 90.0)],
        ("i0", "i45", "i90", "i135"): [(50.0, 50.0), (150.0, 55.0), (50.0, 150.0), (150.0, 155.0)],
    }
    for number, (names, places) in enumerate(cases.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        star = beams_of(names, tuple(places), ("wheel",))
        lamp = beams_of(names, (), internal_apertures=(*places, 20.0, 20.0, 0.0))
        shares, files = 1 + 0.3 * np.arange(len(names)), []
        for i, angle in enumerate((0.0, 30.0, 60.0)):
            image = star_image([(x, y, f) for (x, y), f in zip(places, shares, strict=True)])
            more = {"ROTOR": angle, "WHEEL": "POL60", "MJD": 61000.0 + i}
            header = fits.Header(more | {"EXPTIME": 1.0, "OBJECT": "HD 1"})
            files.append(folder / f"frame{i}.fits")
            data = expose(image, star.files, seed=i, n_wavelengths=1)
            fits.HDUList([fits.PrimaryHDU(header=header), fits.ImageHDU(data)]).writeto(files[-1])
        table = reduce_run(files, star, source="star").table
        columns = ["flux"] if len(names) == 1 else [f"flux_{name}" for name in names]
        assert table["angle"].tolist() == [0, 30, 60]
        assert table["wheel"].tolist() == ["POL60"] * 3
        for column, share in zip(columns, shares, strict=True):
            pulls = (table[column] - 2e5 * share) / table[f"{column}_err"]
            assert np.all(np.abs(pulls) < 5), (column, pulls)
        found = Observations.from_table(table)
        assert found.single_beam
        assert found.n_frames == 3 * len(names)
        rectangles = reduce_run(files, lamp).table
        ratio = rectangles[columns[-1]] / rectangles[columns[0]]
        background = 20.0 * 20**2
        wanted = (2e5 * shares[-1] + background) / (2e5 + background)
        np.testing.assert_allclose(ratio, wanted, rtol=0.02)
        with pytest.raises(ParameterError, match="the profile of the wings is that of two beams"):
            reduce_run(files, star, source="star", aperture_correction=True)
        with pytest.raises(ParameterError, match="they are of right and left"):
            save_quicklook(reduce_run(files, star, source="star"), folder)
    with pytest.raises(InstrumentError, match="beams = \\('a', 'a'\\)"):
        beams_of(("a", "a"), ())


@pytest.mark.slow
def test_part_of_a_beam_unlike_that_in_the_other_frames_is_told(tmp_path, small):
    paths = flat_frames(tmp_path, np.arange(0, 90, 11.25).tolist())
    rows, columns = np.indices((201, 201))
    for number, path in enumerate(paths):
        with fits.open(path, mode="update") as hdus:
            # a lamp that moves, and another response in each beam, are the same to both
            lamp = 1 + 0.2 * np.sin(number) * (rows - 100) / 100
            hdus[1].data = (hdus[1].data * lamp * (1 + (columns > 100) * rows / 400)).astype("f4")
    assert reduce_run(paths, small).doubts == {}
    for path, change in zip(paths[1:3], (0.5, None), strict=True):
        with fits.open(path, mode="update") as hdus:
            if change:
                # a third of one beam is cut
                hdus[1].data[:, :70, :] *= np.float32(change)
            else:
                # pixels that all say the same
                hdus[1].data[:, 90:120, 60:80] = 300.0
    doubts = reduce_run(paths, small).doubts
    assert sorted(doubts) == [str(path) for path in paths[1:3]]
    for why in doubts.values():
        assert "in a part of the rectangles the beams compare differently from the other" in why[-1]
