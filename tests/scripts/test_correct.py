# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal correct``."""

import json
import re
import shutil
import warnings
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.calibration.result.calibration import with_validity
from astropolcal.converters.calibration import content_hash
from astropolcal.correction import Corrected, ScienceFrames, correct, measurement_rows
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ObservationError
from astropolcal.pipeline import tasks
from astropolcal.pipeline.library import Library
from astropolcal.reduction import frames as frame_files
from astropolcal.reduction.cubes import (
    CubeFiles,
    DetectorModel,
    ImageModel,
    simulate_cubes,
)
from astropolcal.reduction.frames import configured, read_night, survey_frames
from astropolcal.reduction.headers import Frame
from astropolcal.scripts import _correct
from astropolcal.scripts._correct import (
    _WAYS,
    _middle,
    _position_angles,
    choose_calibration,
)
from astropolcal.scripts.main import build_parser
from astropolcal.simulation import half_wave_plate_cycles, simulate

Q, U = 0.03, -0.02


def command(*words):
    arguments = build_parser().parse_args(["correct", *map(str, words)])
    arguments.run(arguments)


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A calibration, and a star through the same instrument."""
    folder = tmp_path_factory.mktemp("night")
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(derotator=[45, 55, 65, 75, 85] * u.deg)
    chain = charis.chain(derotator="linear", optics_in=["nbs"])
    meta = {"instrument": "charis", "source": "polarized", "date": "2025-10-05"}
    meta |= {"nasmyth_beam_switcher": "installed"}
    data = simulate(chain, charis.wavelength, frames, flux=1e8, seed=2, meta=meta)
    calibration = calibrate(chain, data, instrument="charis")
    calibration.write(folder / "charis.asdf")
    star = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, [60, 62] * u.deg)
    star["parallactic"] = np.linspace(20, 26, 8) * u.deg
    star["altitude"] = np.linspace(70, 72, 8) * u.deg
    simulate_cubes(
        folder / "cubes",
        charis.on_sky(calibration.chain),
        charis,
        star,
        source="star",
        stokes=(1, Q, U, 0),
        flux=2e6,
        image=ImageModel(psf="gaussian"),
        detector=DetectorModel(noise=False),
        files=CubeFiles(headers={"OBJECT": "HD 1"}, raw=False),
    )
    return folder


@pytest.mark.slow
def test_cubes_to_product(night, tmp_path, capsys):
    out, summary, table = tmp_path / "out.fits", tmp_path / "s.json", tmp_path / "star.ecsv"
    command(
        night / "cubes", "--calibration", night / "charis.asdf", "-o", out, "--size", 31,
        "--json", summary, "--spectrum", table, "--rotation", "pupil", "--camera-angle", 12,
        "--plot", tmp_path / "out.png", "-q", "--workers", 2,
    )  # fmt: skip
    content = json.loads(summary.read_text())
    assert content["n_frames"] == 8
    assert len(content["calibration_hash"]) == 64
    assert max(content["condition"]) < 5
    np.testing.assert_allclose(content["aperture"]["q"], Q, atol=1e-4)
    np.testing.assert_allclose(content["aperture"]["u"], U, atol=1e-4)
    assert 0 < content["aperture"]["s_p_systematic"][3] < 1e-3
    product = Corrected.read(out)
    assert product.north_up
    assert product.stokes.shape == (3, 22, 31, 31)
    assert product.covariance is not None
    header = fits.getheader(out)
    assert header["CALHASH"] == content["calibration_hash"]
    assert header["POLCONV"] == "IAU"
    spectrum = QTable.read(table)
    np.testing.assert_allclose(spectrum["q"], content["aperture"]["q"])
    assert capsys.readouterr().out == ""
    assert (tmp_path / "out.png").stat().st_size > 1e4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::astropolcal.exceptions.AstropolcalWarning")
def test_pixels_that_measure_nothing_are_left_to_the_other_frames(night, tmp_path):
    """Zeros of a lost packet, and a cosmic ray, beside the star in one beam of one frame."""
    files = [shutil.copy(path, tmp_path) for path in sorted((night / "cubes").glob("*.fits"))[:4]]
    for i, path in enumerate(files):
        with fits.open(path, mode="update") as hdus:
            # no pixel of a detector that has noise is an exact zero
            hdus[1].data += 1e-3
            if i == 2:
                hdus[1].data[:, 118:123, 136:141] = 0.0
                hdus[1].data[3, 121, 125] = 2e4
    command(
        *files, "--calibration", night / "charis.asdf", "-o", tmp_path / "out.fits", "--size", 21,
        "--json", tmp_path / "s.json", "-q", "--rotation", "pupil", "--centre", "69.9,84.7",
    )  # fmt: skip
    aperture = json.loads((tmp_path / "s.json").read_text())["aperture"]
    for key, truth in (("q", Q), ("u", U)):
        np.testing.assert_allclose(aperture[key], truth, atol=1e-3)


@pytest.mark.long
def test_a_product_is_not_usable_where_its_calibration_is_not(night, tmp_path, capsys):
    calibration = Calibration.read(night / "charis.asdf")
    calibration.fit["converged"] = False
    calibration.write(tmp_path / "bad.asdf")
    words = [*sorted((night / "cubes").glob("*.fits"))[:4], "--size", 11, "--rotation", "pupil"]
    words += ["-o", tmp_path / "out.fits", "--centre", "69.9,84.7", "--json", tmp_path / "s.json"]
    words, told = [*words, "--calibration"], "the fit did not converge"
    with pytest.warns(AstropolcalWarning, match=f"bad.asdf: NOT USABLE AS IT IS: {told}"):
        command(*words, tmp_path / "bad.asdf")
    assert f"NOT USABLE AS IT IS: the calibration is not: {told}\n" in capsys.readouterr().out
    assert json.loads((tmp_path / "s.json").read_text())["calibration_faults"] == [told]
    # what it leaves open is in the errors, of which the user may know better
    command(*words, night / "charis.asdf", "--open-directions", "ignore")
    assert "\nUsable" in capsys.readouterr().out


def test_light_polarized_by_more_than_all_of_it_is_not_usable():
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    chain = chain | optics.WollastonPrism(name="wollaston")
    positions = {"hwp": [0, 45, 22.5, 67.5] * u.deg}
    told = {"calibration": "a.asdf", "calibration_hash": "", "calibration_faults": []}
    arguments = SimpleNamespace(output="out.fits", spectrum=None, plot=None, json=None, full=False)
    arguments.radius, arguments.size = 2.0, 5
    for degree, verdict in (
        (0.99, "Usable"),
        (1.8, "NOT USABLE AS IT IS: the star is polarized by 180 %, which no light is"),
    ):
        beams = measurement_rows(chain, positions, [1.6] * u.um) @ [1e3, 1e3 * degree, 0, 0]
        images = np.moveaxis(beams, 1, 2)[..., None, None] * np.ones((5, 5))
        frames = ScienceFrames.from_arrays(*images, [1.6] * u.um, positions)
        result = correct(chain, frames, provenance=told)
        summary = _correct._summary(result, result.aperture(2.0), arguments, 4)
        assert any(verdict in line for line in _correct._words(summary, None, arguments)), degree


@pytest.mark.long
def test_a_star_is_subtracted_and_told(night, tmp_path, capsys):
    out, summary = tmp_path / "out.fits", tmp_path / "s.json"
    paths, cal = sorted((night / "cubes").glob("*.fits"))[:4], night / "charis.asdf"
    common = [*paths, "--calibration", cal, "-o", out, "--size", 31, "--full", "--json", summary]
    common += ["--centre", "69.9,84.7"]
    command(*common, "--subtract-star", "annulus=0,12")
    content = json.loads(summary.read_text())
    # the star as it is, and what is left of it
    np.testing.assert_allclose(content["aperture"]["q"], Q, atol=1e-4)
    np.testing.assert_allclose(content["subtracted_star"]["u"], U, atol=1e-4)
    left = Corrected.read(out)
    np.testing.assert_allclose(left.aperture(10).q, 0, atol=1e-4)
    assert left.star.meta["star"] == fits.getheader(out)["STARSUB"] == "annulus of 0 to 12 pixels"
    degree, angle = 100 * np.hypot(Q, U), np.rad2deg(np.arctan2(U, Q)) / 2 % 180
    words = content["subtracted_star"]["words"]
    assert f"subtracted from all light: {words} (annulus of 0" in capsys.readouterr().out
    np.testing.assert_allclose(
        [float(w) for w in (words.split()[0], words.split()[5])], [degree, angle], rtol=0.01
    )
    command(*common, "--subtract-star", f"{degree}+-0.1,{angle}+-1")
    np.testing.assert_allclose(Corrected.read(out).aperture(10).u, 0, atol=1e-4)
    with pytest.raises(SystemExit):
        command(*common, "--subtract-star", "101,3")
    assert "'101,3': 101 %; allowed are 0 to 100 %" in capsys.readouterr().err


@pytest.mark.long
def test_modes_differ(night, tmp_path):
    words = [night / "cubes", "--calibration", night / "charis.asdf", "-q", "--size", 21]
    for mode in ("stokes", "ip"):
        command(
            *words, "-o", tmp_path / f"{mode}.fits", "--mode", mode, "--json", tmp_path / mode,
            "--observable", "double", "--centre", "69.875,84.7",
        )  # fmt: skip
    q = {
        m: np.array(json.loads((tmp_path / m).read_text())["aperture"]["q"])
        for m in ("stokes", "ip")
    }
    np.testing.assert_allclose(q["stokes"], Q, atol=2e-4)
    assert np.abs(q["ip"] - Q).max() > 1e-3


@pytest.mark.long
def test_the_calibration_comes_from_a_library(night, tmp_path):
    library = pytest.importorskip("astropolcal.pipeline.library").Library
    from astropolcal import Calibration

    (tmp_path / "lib").mkdir()
    calibration = Calibration.read(night / "charis.asdf")
    library(tmp_path / "lib").add(calibration, valid_from="2025-10-01")
    words = [night / "cubes", "--calibration", tmp_path / "lib", "-q", "--size", 11]
    command(*words, "-o", tmp_path / "out.fits", "--radius", 4)
    assert str(tmp_path / "lib") in fits.getheader(tmp_path / "out.fits")["CALFILE"]


@pytest.mark.slow
def test_a_file_that_does_not_hold_is_refused(night, tmp_path):
    from astropolcal import Calibration
    from astropolcal.calibration.result.calibration import with_validity

    old = with_validity(Calibration.read(night / "charis.asdf"), valid_from="2026-01-01")
    old.write(tmp_path / "old.asdf")
    words = ["-o", tmp_path / "out.fits", "-q", "--size", 5, "--radius", 2]
    words = [night / "cubes", "--calibration", tmp_path / "old.asdf", *words]
    words += ["--centre", "69.9,84.7", "--brightness", "measured"]
    with pytest.raises(
        AstropolcalError, match=r"2025-10-05T08.*, but .*old\.asdf holds for .*any-date"
    ):
        command(*words)
    assert not (tmp_path / "out.fits").exists()
    command(*words, "--any-date")
    assert (tmp_path / "out.fits").exists()


def test_another_instrument_is_refused(night, tmp_path):
    path = sorted((night / "cubes").glob("*.fits"))[0]
    (tmp_path / path.name).write_bytes(path.read_bytes())
    fits.setval(tmp_path / path.name, "INSTRUME", value="HiCIAO")
    words = ["-o", tmp_path / "out.fits", "-q", "--centre", "69.9,84.7"]
    with pytest.raises(AstropolcalError, match="INSTRUME = 'HiCIAO', allowed are CHARIS"):
        command(tmp_path / path.name, "--calibration", night / "charis.asdf", *words)


@pytest.mark.slow
def test_a_frame_without_angles_is_named(night, tmp_path):
    paths = sorted((night / "cubes").glob("*.fits"))[:2]
    for path in paths:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with fits.open(tmp_path / paths[1].name, mode="update") as hdus:
        del hdus[0].header["D_IMRANG"]
    with pytest.raises(AstropolcalError, match=rf"{paths[1].name}.*derotator|D_IMRANG"):
        command(
            *(tmp_path / path.name for path in paths), "--calibration", night / "charis.asdf",
            "-o", tmp_path / "out.fits", "-q", "--centre", "69.9,84.7",
        )  # fmt: skip
    assert not (tmp_path / "out.fits").exists()


@pytest.mark.slow
def test_bad_input(night, tmp_path, monkeypatch):
    cubes = sorted((night / "cubes").glob("*.fits"))[:4]
    for words, message in [
        (["--optics-in", "dichroic"], "no chain with dichroic; it holds for .* with nbs"),
        (["--optics-in", ""], "no chain no optional optics; it holds for .* with nbs"),
        (["--centre", "300,5"], "outside the image"),
        (["--cluster", "tcp://127.0.0.1:1"], "cluster tcp"),
        (["--size", "4000"], "size = 4000; the images are 201 x 201 pixels, allowed are 1 to 402"),
        (["--max-condition", "0.5"], "max_condition = 0.5"),
        (["--radius", "0"], "no pixel is inside"),
        (["--radius", "3"], r"--radius 3: leaves the images of --size 5; allowed are up to 2\.5"),
        (["--mirrored"], "--mirrored needs --rotation fixed"),
        (["--camera-angle", "113"], r"--camera-angle 113 needs --rotation fixed\|pupil"),
        (
            ["--camera-angle", "0", "--rotation", "none"],
            "--camera-angle 0 needs --rotation fixed",
        ),
        (["--subtract-star", "annulus=2,3"], "annulus=...,3: leaves the images of --size 5; allow"),
        (["--subtract-star", "annulus=2,1"], "two radii in pixels are needed"),
        (["--seed", "3"], "--seed 3 needs --samples N"),
        (["--samples", "20", "--seed", "-1"], "seed = -1; allowed are whole numbers from 0 up"),
        (["-o", "out.asdf"], r"-o out\.asdf: the name must end with \.fits"),
        (["--calibration", "nowhere"], "nowhere"),
        (["--spectrum", "star.txt"], r"--spectrum star\.txt: the name must end with \.ecsv"),
    ]:
        monkeypatch.setattr(tasks, "_TIMEOUT", 1)
        if "--centre" not in words:
            words = [*words, "--centre", "69.9,84.7"]
        out = ["-o", tmp_path / "out.fits", "-q", "--size", "5"]
        with pytest.raises(AstropolcalError, match=message):
            command(*cubes, "--calibration", night / "charis.asdf", *out, *words)


def test_too_few_angles(night, tmp_path):
    paths = sorted((night / "cubes").glob("*.fits"))[:1]
    with pytest.raises(AstropolcalError, match=r"Q and U are not determined .* 1 frame \("):
        command(
            *paths, "--calibration", night / "charis.asdf", "-o", tmp_path / "o.fits", "-q",
            "--centre", "69.9,84.7",
        )  # fmt: skip


def changed(night, folder, *keywords):
    """Copy two cubes and change keywords of the second, or of both."""
    paths = []
    for i, path in enumerate(sorted((night / "cubes").glob("*.fits"))[:2]):
        paths.append(folder / path.name)
        paths[-1].write_bytes(path.read_bytes())
        for keyword, *values in keywords:
            fits.setval(paths[-1], keyword, value=values[min(i, len(values) - 1)])
    return paths


@pytest.mark.long
def test_a_derotator_that_kept_something_else_than_stated(night, tmp_path):
    """While the parallactic angle turns from 20 to 32 deg at an altitude of 70 deg."""
    plate = instruments.get("charis").sky_law.plate_law()
    for derotator, stated, others, words in [
        (
            (95, 95),
            "fixed",
            "pupil",
            r"3.0 deg off .* keeps the field, and 0.0 deg off .* the pupil",
        ),
        ((95, 95), "pupil", "pupil", None),
        # half a turn is none
        (
            (95, 281),
            "pupil",
            "fixed",
            r"3.0 deg off .* keeps the pupil, and 0.0 deg off .* the field",
        ),
        ((95, 101), "fixed", "fixed", None),
        # neither law holds
        ((95, 98), "fixed", "fixed", None),
        # images of different orientation are summed
        (
            (95, 95),
            "none",
            None,
            r"turned by up to 12.0 deg between frames, 2.2 pixels at",
        ),
        ((95, 281), "none", None, None),
    ]:
        hwp = [h + plate[0] * p + plate[1] * 70 for h, p in ((0, 20), (45, 32))]
        keywords = [("PARANG", 20, 32), ("ALTITUDE", 70), ("D_IMRANG", *derotator)]
        paths = changed(night, tmp_path, *keywords, ("RET-POS1", *hwp))
        words_of = [*paths, "--calibration", night / "charis.asdf", "-o", tmp_path / "o.fits"]
        words_of += ["--centre", "69.9,84.7", "--size", "21", "-q", "--rotation", stated]
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            # two frames may be too few for a product
            with suppress(ObservationError):
                command(*words_of)
        told = [str(one.message) for one in told if "--rotation" in str(one.message)]
        assert len(told) == (words is not None), (derotator, stated, told)
        if words:
            assert re.search(words, told[0])
            assert others is None or f"(--rotation {others})" in told[0]


@pytest.mark.slow
def test_frames_of_another_set_up(night, tmp_path):
    calibration = Calibration.read(night / "charis.asdf")
    stated = with_validity(calibration, mode="broadband JHK", valid_from="2025-01-01")
    for keywords, message in [
        ([("FILTNAME", "J", "K")], "is in mode 'J', .* in 'K': correct apart"),
        ([("FILTNAME", "J")], "in mode 'J', but .*charis.asdf holds for .*--filter 'broadband"),
        (
            [("MJD", 60800.5)],
            "cube.fits: time: the Modified Julian Date 60800.5 is 2025-05-05, the ",
        ),
        (
            [("MJD", 60950.5, 60800.5), ("UTC-DATE", "2025-10-02", "2025-05-05")],
            "nbs was in the beam in .*, and not in ",
        ),
        (
            [("MJD", 60800.5), ("UTC-DATE", "2025-05-05"), ("FILTNAME", "broadband JHK")],
            "switcher was installed between the data",
        ),
    ]:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        stated.write(folder / "charis.asdf")
        with pytest.raises(AstropolcalError, match=message):
            command(
                *changed(night, folder, *keywords), "--calibration", folder / "charis.asdf",
                "-o", folder / "o.fits", "-q", "--centre", "69.9,84.7",
            )  # fmt: skip


CHARIS = instruments.get("charis")


@pytest.fixture
def told(monkeypatch):
    """Function that returns what is made of headers with these values."""

    def tell(*frames, centre=(70.0, 85.0), **options):
        files = [f"CRSA{i:08d}_cube.fits" for i in range(len(frames))]
        known = dict(zip(files, frames, strict=True))
        monkeypatch.setattr(
            frame_files,
            "_survey",
            lambda *_: [Frame(f, values=dict(known[f]), unit=known[f].get("unit")) for f in files],
        )
        return survey_frames(files, CHARIS.files, centre=centre, **options)

    return tell


# ---- headers ---------------------------------------------------------------------------


def test_angles_and_states_are_columns(told):
    table, centres, scale, detectors = told({"hwp": 0.0, "altitude": 60.0}, {"hwp": 45.0})
    assert table["hwp"].to_value(u.deg).tolist() == [0.0, 45.0]
    assert np.isnan(table["altitude"].value).tolist() == [False, True]
    assert set(table.colnames) == {"hwp", "altitude"}
    assert centres == (70.0, 85.0)
    assert scale is None
    # one file holds both beams
    assert all(right == left for right, left in detectors)
    # the true angle of the plate is used of all frames or of none
    both = told({"hwp": 0.0, "hwp_true": 10.0}, {"hwp": 45.0, "hwp_true": 55.0})[0]
    assert both["hwp_true"].to_value(u.deg).tolist() == [10.0, 55.0]
    assert "hwp_true" not in told({"hwp": 0.0, "hwp_true": 10.0}, {"hwp": 45.0})[0].colnames
    table = told({"hwp": 0.0, "flc_state": "A"}, {"hwp": 0.0, "flc_state": "B"})[0]
    assert table["flc_state"].tolist() == ["A", "B"]


def test_frames_are_as_bright_as_their_exposures(told):
    for seconds, scale in [
        ((10.0, 10.0, 10.0), None),
        # rounding of a header
        ((10.0, 10.000001, 10.0), None),
        ((10.0, 20.0, 10.0), [1.0, 2.0, 1.0]),
        ((5.0, 10.0, 20.0), [0.5, 1.0, 2.0]),
        # what one header does not say is not guessed
        ((10.0, None, 20.0), None),
    ]:
        frames = [{"hwp": 0.0} | ({} if s is None else {"exposure_time": s}) for s in seconds]
        found = told(*frames)[2]
        assert found is None if scale is None else found.tolist() == scale, (seconds, scale)
    # where nothing else tells it has to be there
    with pytest.raises(ObservationError, match=r"01_cube.fits: no keyword EXPTIME in its header"):
        told({"hwp": 0.0, "exposure_time": 1.0}, {"hwp": 0.0}, {"hwp": 0.0}, exposed=True)


def test_rates_are_as_bright_at_all_exposures(told):
    frames = [{"hwp": 0.0, "exposure_time": s, "unit": "adu/s"} for s in (10.0, 20.0)]
    table, _, scale, detectors = told(*frames)
    assert scale is None
    assert [right.unit for right, _ in detectors] == [u.adu / u.s] * len(table)
    # an adu is not an electron
    with pytest.raises(ObservationError, match="is in adu, CRSA00000001"):
        told({"hwp": 0.0}, {"hwp": 0.0, "unit": "electron"})


def test_frames_are_checked_where_the_place_of_the_star_is_known(tmp_path):
    def found(*frames):
        files = []
        for number, cards in enumerate(frames):
            data = np.arange(8.0).reshape(2, 2, 2) + cards.pop("first", number)
            cube = fits.ImageHDU(data, fits.Header({"BUNIT": cards.pop("BUNIT", "adu")}))
            plate = {"RET-ANG1": 0.0, "RET-POS1": 80.0, "PARANG": 20.0, "ALTITUDE": 70.0}
            primary = fits.PrimaryHDU(header=fits.Header(plate | {"D_IMRANG": 60.0} | cards))
            files.append(tmp_path / f"CRSA0000000{number}_cube.fits")
            fits.HDUList([primary, cube]).writeto(files[-1], overwrite=True)
        return survey_frames(files, CHARIS.files, centre=(70, 85))

    (right, left), _ = found({"BUNIT": "electron"}, {"BUNIT": "electron"})[3]
    # the cube says it, not the first header
    assert right.gain == left.gain == 1.0
    with pytest.raises(ObservationError, match=r"1_cube\.fits: the same data as .*0_cube\.fits"):
        found({}, {"first": 0, "OBJECT": "renamed"})
    with pytest.raises(
        ObservationError, match=r"1_cube\.fits: RET-POS1 = 95 deg is \+15\.00 deg off"
    ):
        found({}, {"RET-POS1": 95.0})


def test_star_that_is_not_found_names_the_file(monkeypatch):
    def frame(file):
        x = np.full((2, 3), np.nan if "1_cube" in file else 70.0)
        found = Frame(file, values={"hwp": 0.0})
        found.photometry = SimpleNamespace(x=x, y=x + 15.0, fwhm=x, failed=np.zeros(3, dtype=bool))
        # what most slices do not show stands at zero
        if "2_cube" in file:
            found.photometry.x[:, :2] = found.photometry.y[:, :2] = 0.0
            found.photometry.failed[:2] = True
        return found

    monkeypatch.setattr(frame_files, "_survey", lambda files, *_: [frame(file) for file in files])
    files = [f"CRSA0000000{i}_cube.fits" for i in range(3)]
    words = "CRSA00000001_cube.fits: the star was not found; give its place with --centre"
    with pytest.raises(ObservationError, match=words):
        survey_frames(files, CHARIS.files, ways=_WAYS)
    centres = survey_frames([files[0], files[2]], CHARIS.files)[1]
    # x and y in the right and in the left beam
    assert [c.tolist() for c in centres] == [[[70.0, 85.0]] * 2] * 2


def test_raw_frames_are_advised_where_they_may_help(monkeypatch):
    for error, advised in (
        ("no keyword D_IMRANG in its header", True),
        ("no keyword PARANG in its header, and no right_ascension", False),
        ("no slice can be used: saturated", False),
    ):
        frame = Frame("a.fits", errors=[error])
        monkeypatch.setattr(frame_files, "_survey", lambda *_, frame=frame: [frame])
        with pytest.raises(ObservationError, match=error) as refused:
            survey_frames(["a.fits"], CHARIS.files, ways=_WAYS)
        assert ("--raw" in str(refused.value)) == advised, error


def test_what_is_odd_about_science_frames_is_told(monkeypatch, tmp_path):
    """A pixel that the photometry of the star leaves out is left out of the images, too."""
    frames = half_wave_plate_cycles([0, 22.5] * u.deg, [60] * u.deg)
    frames["parallactic"], frames["altitude"] = [20, 20] * u.deg, [70, 70] * u.deg
    simulate_cubes(
        tmp_path, CHARIS.on_sky(CHARIS.published()), CHARIS, frames, source="star",
        stokes=(1, 0, 0, 0), flux=1e6, detector=DetectorModel(noise=False),
        files=CubeFiles(raw=False),
    )  # fmt: skip
    paths = sorted(tmp_path.glob("*.fits"))
    survey_frames(paths, CHARIS.files)
    with fits.open(paths[1], mode="update") as hdus:
        hdus[1].data[3, 124, 133] += 2e4
    with pytest.warns(AstropolcalWarning, match="1 file: single pixels .* were left out") as told:
        *_, detectors = survey_frames(paths, CHARIS.files)
    assert paths[1].name in str(told[0].message)
    found = detectors[1][0].spoilt(fits.getdata(paths[1], 1))
    assert found[3, 124, 133]
    assert not found[[0, 1, 2], 110:130, 120:140].any()


def test_copies_and_other_objects_among_science_frames(monkeypatch):
    def told(*frames):
        found = [Frame(f"{i}.fits", unit="adu", **one) for i, one in enumerate(frames)]
        monkeypatch.setattr(frame_files, "_survey", lambda *_: found)
        return survey_frames([f"{i}.fits" for i in range(len(found))], CHARIS.files, centre=(5, 5))

    one, other = ({"values": {"hwp": 0.0, "object": name}} for name in ("HD 1", "HD_2"))
    told(one, {"values": {"object": "hd1"} | one["values"]})
    with pytest.warns(AstropolcalWarning, match=r"0\.fits is of object 'HD 1', 1\.fits of 'HD_2'"):
        told(one, other)
    with pytest.raises(ObservationError, match=r"1\.fits: the same data as 0\.fits"):
        told(one | {"digest": "a"}, one | {"digest": "a"})


# ---- options -----------------------------------------------------------------------------


def test_position_angle_of_the_camera():
    for rotation, camera, angles in [
        ("none", 12.0, None),
        ("fixed", 12.0, [12.0, 12.0]),
        ("pupil", 12.0, [32.0, 36.0]),
        ("pupil", -90.0, [-70.0, -66.0]),
    ]:
        table = QTable({"parallactic": [20.0, 24.0] * u.deg})
        arguments = SimpleNamespace(rotation=rotation, camera_angle=camera)
        found = _position_angles(table, arguments)
        assert found is None if angles is None else found.to_value(u.deg).tolist() == angles, (
            rotation
        )
    arguments = SimpleNamespace(rotation="pupil", camera_angle=0.0)
    with pytest.raises(ObservationError, match="--rotation pupil needs the parallactic angle of"):
        _position_angles(QTable({"hwp": [0.0] * u.deg}), arguments)


# ---- the report --------------------------------------------------------------------------


def test_middle_of_angles_and_numbers():
    for values, words in [
        ([1.0, 2.0, 30.0], "2.0 deg"),
        ([1.0, None, 3.0], "2.0 deg"),
        # neighbours across 180 deg, whose plain median would be 90
        ([179.0, 1.0], "0.0 deg"),
        ([178.0, 179.0, 2.0], "179.0 deg"),
        ([178.0, 2.0, 3.0], "2.0 deg"),
        # rounds to half a turn, which is none
        ([179.97, 179.97], "0.0 deg"),
        ([-0.01, -0.01], "0.0 deg"),
        ([89.0, 91.0], "90.0 deg"),
        ([None, None], "not known"),
        ([], "not known"),
    ]:
        assert _middle(np.array(values, dtype=float), ".1f", " deg", turns=True) == words, values
    for values, words in [([0.01, 0.03], "0.0200"), ([None, 0.5], "0.5000"), ([None], "not known")]:
        assert _middle(np.array(values, dtype=float), ".4f", "") == words, (values, words)


def test_report_has_units():
    for systematic, words in [
        (None, "not known"),
        (SimpleNamespace(is_open=False), "not known"),
        (SimpleNamespace(is_open=True), "infinite"),
    ]:
        aperture = {"radius": 10.0, "dolp": np.array([0.0099]), "aolp": np.array([30.0])}
        aperture |= {"s_p_statistical": np.array([0.0012]), "s_chi_statistical": np.array([2.0])}
        aperture |= {"s_p_systematic": np.array([np.nan]), "s_chi_systematic": np.array([np.inf])}
        aperture["q"] = aperture["u"] = np.array([0.005])
        summary = {
            "output": "o.fits", "n_frames": 4, "mode": "stokes", "calibration": "c.asdf",
            "components": "IQU", "condition": np.array([1.5, np.nan, 1.6]), "poorly_determined": {},
            "wavelength_nm": np.array([1600.0]),
            "aperture": aperture, "held": ["m3.b1", "m3.m1"],
        }  # fmt: skip
        outputs = {"output": "o.fits", "spectrum": None, "plot": None, "json": "-", "full": False}
        lines = _correct._words(summary, systematic, SimpleNamespace(**outputs))
        assert "  condition number of the solution for IQU: 1.5 to 1.6" in lines, systematic
        assert "    degree of linear polarization: 0.99 %" in lines, (systematic, words)
        assert "      statistical error: 0.12 %" in lines, (systematic, words)
        assert "    angle of linear polarization: 30.0 deg" in lines, (systematic, words)
        assert "      statistical error: 2 deg" in lines, (systematic, words)
        assert lines.count(f"      systematic error: {words}") == 2, (systematic, words)
        # a telescope as published does not err less than one that was calibrated
        assert any("m3.b1, m3.m1" in line for line in lines), (systematic, words)
        assert "statistical errors:" not in " ".join(lines)
        verdict = lines[lines.index("") + 1]
        is_open = words == "infinite"
        told = "NOT USABLE AS IT IS: the calibration does not determine DoLP and AoLP"
        assert verdict == (told if is_open else "Usable"), (systematic, words)
        assert lines[-1] == "Written:    o.fits", (systematic, words)
    # of V where it was solved for
    assert "V" not in " ".join(lines)
    full = aperture | {"v": np.array([-0.0042]), "v_statistical": np.array([0.0011])}
    full |= {"v_systematic": np.array([np.nan])}
    lines = _correct._words(summary | {"aperture": full}, None, SimpleNamespace(**outputs))
    place = lines.index("    circular polarization V / I: -0.42 %")
    assert lines[place + 1] == "      statistical error: 0.11 %"
    # frames that tell all but V are of use
    summary["poorly_determined"] = {"0": "0.07 U +1.00 V"}
    full["v"] = np.array([np.nan])
    lines = _correct._words(summary | {"aperture": full}, None, SimpleNamespace(**outputs))
    assert lines[lines.index("") + 1] == "Usable"
    assert "Determined  IQU at 1 of 1 wavelengths, V at 0" in lines
    summary["poorly_determined"] = {}
    # wavelengths at which the aperture has no value are not usable, whatever the frames determine
    summary["wavelength_nm"] = [1200.0, 1600.0]
    for q, told in (
        ([0.005, np.nan], "Usable: without a value at 1 wavelength"),
        ([np.nan, np.nan], "NOT USABLE AS IT IS: no light within 10 pixels of the star"),
    ):
        aperture["q"] = aperture["u"] = np.array(q)
        lines = _correct._words(summary, None, SimpleNamespace(**outputs))
        assert lines[lines.index("") + 1] == told
        assert f"IQU at {np.isfinite(q).sum()} of 2 wavelengths" in " ".join(lines)


def test_light_at_the_edge_is_told():
    images = np.zeros((3, 2, 21, 21))
    images[0, :, 10, 10] = 1e4
    light = images[:, :, 10, 10].copy()
    light[0, 1] += 100
    noise = np.random.default_rng(1).normal(0, 0.5, images.shape)
    halo = (
        20 / np.hypot(*(np.indices((21, 21)) - 10.001)) * np.array([1, 0, 0])[:, None, None, None]
    )
    errors = np.full((2, 2), 1e-3)
    # noise, a halo and what no wavelength has are no sky
    for known in (noise, halo, halo**2, np.nan):
        _correct._warn_of_sky(images + known, light, errors, 5)
    images[0, 1] += 2
    # so near to the star the edge has light of its own
    _correct._warn_of_sky(images, light, errors, 8)
    for known in (0, noise / 50):
        words = r"has 1\.6 % of the light within 5 pixels .* must be subtracted"
        with pytest.warns(AstropolcalWarning, match=words):
            _correct._warn_of_sky(images + known, light, errors, 5)


OLD = Path(__file__).parents[1] / "calibration" / "data" / "calibration-1.0.0.asdf"


@pytest.fixture
def frames_with(tmp_path):
    """Function that writes headers, one a call of keywords, and returns the files."""

    def write(*headers):
        files = []
        for i, changes in enumerate(headers):
            cards = {
                "INSTRUME": "CHARIS",
                "RET-ANG1": 0.0,
                "D_IMRANG": 45.0,
                "MJD": 60982.5,
            }
            cards["FILTNAME"] = "broadband JHK"
            header = fits.Header({k: v for k, v in (cards | changes).items() if v is not None})
            files.append(tmp_path / f"CRSA{i + 1:08d}_cube.fits")
            fits.PrimaryHDU(header=header).writeto(files[-1], overwrite=True)
        return files

    return write


def chosen(calibration, files, **options):
    """Return the provenance of what is chosen, with the options of the command."""
    known = {"calibration": str(calibration), "instrument": None, "optics_in": None}
    known |= {"any_date": False, "filter": None, "max_age": None} | options
    return choose_calibration(SimpleNamespace(**known), files)[2]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Two calibrations that follow each other on 2025-12-01."""
    folder = tmp_path_factory.mktemp("library")
    known, base = Library(folder), Calibration.read(OLD)
    known.add(base, name="a.asdf", valid_from="2025-10-01", valid_until="2025-12-01")
    known.add(base, name="b.asdf", valid_from="2025-12-01")
    return folder


# ---- what headers tell -----------------------------------------------------------------


def test_first_and_last_date_whatever_the_order(frames_with):
    for days, dates in (
        ((60983.0, 60982.5, 60982.75), ["2025-11-03T12:00", "2025-11-04T00:00"]),
        ((60982.5, 60982.5), ["2025-11-03T12:00"]),
        ((None,), []),
    ):
        files = frames_with(*({"MJD": day, "FILTNAME": None} for day in days))
        found = read_night(files, CHARIS)
        assert [date[:16] for date in found.dates] == dates, days
        assert found.mode is None, days


def test_frames_of_two_modes_are_refused(frames_with):
    files = frames_with({"FILTNAME": "Broadband"}, {"FILTNAME": "J"}, {"FILTNAME": None})
    words = r"1_cube.fits is in mode 'Broadband', .*2_cube.fits in 'J': correct apart"
    with pytest.raises(ObservationError, match=words):
        read_night(files, CHARIS)
    assert read_night(files[1:], CHARIS).mode == "J"


def test_instrument_without_file_layout_is_refused(frames_with):
    bare = SimpleNamespace(name="bare", files=None)
    with pytest.raises(AstropolcalError, match="bare: it is not known how its files look"):
        read_night(frames_with({}), bare)


def test_files_that_cannot_be_read_leave_the_instrument_as_it_is():
    for files in [[], ["nowhere.fits"], [__file__]]:
        assert configured(CHARIS, files) is CHARIS, files


# ---- a single calibration --------------------------------------------------------------


def test_file_that_holds_is_taken_with_its_hash(frames_with):
    # not one of another instrument, whatever its frames do not say
    with pytest.raises(AstropolcalError, match="is of instrument 'charis', not 'irdis'"):
        chosen(OLD, frames_with({}), optics_in=["nbs"], instrument="irdis", any_date=True)
    found = chosen(OLD, frames_with({}), optics_in=["nbs"], instrument="SCExAO/CHARIS")
    assert found["calibration"] == str(OLD)
    assert found["calibration_hash"] == content_hash(Calibration.read(OLD))


def test_file_for_another_date_is_refused_unless_it_is_wanted(frames_with):
    words = r"was taken 2024-07-09, but .* holds for .*; --any-date takes it all the same"
    with pytest.raises(AstropolcalError, match=words):
        chosen(OLD, frames_with({"MJD": 60500.0}, {"MJD": 60500.5}), optics_in=["nbs"])
    assert chosen(OLD, frames_with({"MJD": 60500.0}), any_date=True, optics_in=["nbs"])


def test_mode_of_a_file_is_compared(frames_with, tmp_path):
    path = tmp_path / "c.asdf"
    with_validity(Calibration.read(OLD), mode="Broadband").write(path)
    files = frames_with({"FILTNAME": "J"}, {"FILTNAME": "BROADBAND"})
    words = r"in mode 'J', but .*c.asdf holds for .*; if it is the same by .* --filter 'Broadband'"
    with pytest.raises(AstropolcalError, match=words):
        chosen(path, files[:1], optics_in=["nbs"])
    assert chosen(path, files[:1], optics_in=["nbs"], filter="Broadband")
    # the spelling of a mode does not matter
    assert chosen(path, files[1:], optics_in=["nbs"])
    # one that is stated
    with pytest.raises(AstropolcalError, match=r"mode 'foo', but .*--filter 'Broadband'"):
        chosen(path, files[:1], optics_in=["nbs"], filter="foo")
    with_validity(Calibration.read(OLD), mode="broadband JHK").write(path, overwrite=True)
    assert chosen(path, files[:1], optics_in=["nbs"], filter="Broadband  jhk")


def test_mode_is_not_compared_where_the_file_holds_for_any(frames_with, monkeypatch):
    from astropolcal.calibration.result.calibration import Validity
    from astropolcal.pipeline import headers

    monkeypatch.setattr(headers, "validity_of", lambda _: Validity("charis"))
    assert chosen(OLD, frames_with({"FILTNAME": "J"}), optics_in=["nbs"], filter="foo")


def test_frames_that_do_not_say_enough(frames_with, tmp_path):
    bare = {"MJD": None, "FILTNAME": None}
    for lacking, option in (
        ({"MJD"}, {"any_date": True}),
        ({"FILTNAME"}, {"filter": "broadband JHK"}),
    ):
        (file,) = frames_with({key: value for key, value in bare.items() if key in lacking})
        with pytest.raises(AstropolcalError, match=r"cube.fits: its \w+ is not known, .*--(an|fi)"):
            chosen(OLD, [file], optics_in=["nbs"])
        assert chosen(OLD, [file], optics_in=["nbs"], **option)
        file.unlink()


def test_calibration_that_is_old(frames_with):
    early, late = frames_with({"MJD": 60990.0}, {"MJD": 61313.5})
    with pytest.raises(AstropolcalError, match=r"M3 was recoated between .*--any-date"):
        chosen(OLD, [early, late], optics_in=["nbs"])
    with pytest.warns(AstropolcalWarning, match="0.1 yr from the data"):
        chosen(OLD, [early], optics_in=["nbs"], max_age=0.01)
    # also where no age is looked at
    with pytest.raises(AstropolcalError, match=r"max_age = -1\.0 yr; a time from zero"):
        chosen(OLD, [early], optics_in=["nbs"], max_age=-1, any_date=True)


# ---- a library -------------------------------------------------------------------------


def test_library_gives_what_holds_for_the_date(frames_with, library):
    for mjd, name in [(60982.5, "a.asdf"), (61050.0, "b.asdf")]:
        found = chosen(library, frames_with({"MJD": mjd}), optics_in=["nbs"])
        assert Path(found["calibration"]).name == name, (mjd, name)
    with pytest.raises(AstropolcalError, match="2020"):
        chosen(library, frames_with({"MJD": 59000.0}), optics_in=["nbs"])
    files = frames_with({"MJD": 60982.5}, {"MJD": 61050.0})
    words = r"the frames from 2025-11-03.* to 2026-01-10.* need two calibrations, .*a.asdf and .*b"
    with pytest.raises(AstropolcalError, match=words):
        chosen(library, files, optics_in=["nbs"])
    with pytest.raises(ObservationError, match="no date in its header to choose a calibration by"):
        chosen(library, frames_with({"MJD": None}), optics_in=["nbs"])


def test_what_changed_between_calibrations_is_told(frames_with, library, tmp_path):
    files = frames_with({"MJD": 60982.5})
    # two that are the same say nothing
    chosen(library, files, optics_in=["nbs"])
    other = Calibration.read(OLD)
    for chain in other.chains:
        chain["hwp"].theta.value += 3.0
    moved = Library(tmp_path)
    moved.add(Calibration.read(OLD), name="a.asdf", valid_until="2025-12-01")
    moved.add(other, name="b.asdf", valid_from="2025-12-01")
    with pytest.warns(AstropolcalWarning, match=r"a.asdf differs from b.asdf by \d+ \(hwp by"):
        found = chosen(tmp_path, files, optics_in=["nbs"])
    assert Path(found["calibration"]).name == "a.asdf"


def test_options_are_named_where_a_library_needs_to_know_more(frames_with, tmp_path):
    for mode in ("J", "H"):
        with_validity(Calibration.read(OLD), mode=mode).write(tmp_path / f"{mode}.asdf")
    with pytest.raises(AstropolcalError, match=r"say which mode is meant \(--filter MODE\)"):
        chosen(tmp_path, frames_with({"FILTNAME": None}), optics_in=["nbs"])
