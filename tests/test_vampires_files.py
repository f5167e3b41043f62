# Licensed under a 3-clause BSD style license - see LICENSE
"""VAMPIRES: headers, detectors, files of two cameras, and a run from cubes to the truth."""

import json
import re
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments
from astropolcal.calibration import calibrate
from astropolcal.chain import join, leaves
from astropolcal.correction import ScienceFrames, correct
from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments.layout import FileLayout, ReadOut
from astropolcal.instruments.vampires import layout_of, slices_of
from astropolcal.observations import Observations
from astropolcal.reduction import reduce_run
from astropolcal.reduction.cubes import both_states, expose, simulate_cubes
from astropolcal.reduction.headers import read_header
from astropolcal.reduction.photometry import Detector, detector_of
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles

VAMPIRES = instruments.get("vampires")
SIDE = 48
SMALL = {"NAXIS1": SIDE, "NAXIS2": SIDE}
FILTER = [725] * u.nm


class Window(type(VAMPIRES)):
    """VAMPIRES with images that are quickly simulated."""

    def configured(self, header):
        return super().configured(SMALL | dict(header))


def frames(hwp=(0, 45, 22.5, 67.5), derotator=(45, 80)):
    return both_states(half_wave_plate_cycles(hwp * u.deg, derotator * u.deg))


def chain(**options):
    return VAMPIRES.chain(wavelength=FILTER, derotator="linear", **options)


def write(folder, table=None, **options):
    options = {"wavelength": FILTER, "flux": 1e6, "seed": 3} | options
    table = frames() if table is None else table
    return simulate_cubes(folder, chain(), Window(), table, **options)


@pytest.fixture(scope="module")
def cubes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cubes")
    write(folder)
    return folder


@pytest.fixture
def copied(cubes, tmp_path):
    """Files that a test may change."""
    for path in cubes.glob("*.fits"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def edit(path, factor=None, **keywords):
    with fits.open(path, mode="update") as hdus:
        hdus[0].header.update(keywords)
        if factor is not None:
            hdus[0].data = hdus[0].data * np.float32(factor)


def reduced(folder, **options):
    return reduce_run(sorted(folder.glob("*.fits")), Window(), source="polarized", **options)


# --- headers -------------------------------------------------------------------------------------


def header_values(**keywords):
    header = fits.Header({"RET-ANG1": 22.5, "D_IMRANG": 45.0} | keywords)
    found = read_header("night_00000001_cam1.fits", VAMPIRES.files, header=header)
    return found.values, found.errors


def test_keywords_of_the_detectors_since_2023():
    values, errors = header_values(U_FLC="B", U_FLCST="IN", U_CAMERA=1.0, U_DETMOD="Slow")
    assert errors == []
    assert values["flc_state"] == "B"
    assert VAMPIRES.files.read_out(values) == ReadOut(0.105, 0.245, 65535.0)
    values["camera"] = 2.0
    assert VAMPIRES.files.read_out(values).read_noise == 0.220


def test_keywords_of_the_detectors_before():
    values, errors = header_values(U_FLCSTT=1, U_CAMERA=2, U_EMGAIN=300.0)
    assert errors == []
    assert values["flc_state"] == "A"
    how = VAMPIRES.files.read_out(values)
    assert how.gain == pytest.approx(4.5 / 300)
    # the read noise that the pipeline of the instrument states, a third of an electron
    assert how.read_noise == pytest.approx(89 / 300)
    assert how.excess_noise == pytest.approx(np.sqrt(2))
    conventional = VAMPIRES.files.read_out({"em_gain": 0.0})
    assert (conventional.read_noise, conventional.excess_noise) == (9.6, 1.0)


def test_states_in_headers():
    for value, state in [("NA", None), (2, "B"), (2.0, "B"), (" A ", "A")]:
        values, errors = header_values(U_FLC=value)
        assert (values.get("flc_state"), errors) == (state, []), (value, state)


def test_a_state_that_there_is_not():
    values, errors = header_values(U_FLC="C")
    assert "flc_state" not in values
    assert errors == ["U_FLC = 'C', allowed are A, B, 1, 2, NA"]


def test_impossible_detector_settings():
    with pytest.raises(ObservationError, match=r"U_EMGAIN = 0\.105; allowed are 0 .* and 1 and ab"):
        VAMPIRES.files.read_out({"em_gain": 0.105})
    with pytest.raises(ObservationError, match="U_DETMOD = 'turbo'; allowed are slow 1, slow 2"):
        VAMPIRES.files.read_out({"read_mode": "Turbo"})
    assert header_values(U_EMGAIN=-2.0)[1] == ["U_EMGAIN = -2.0, allowed are 0 to 100000"]
    with pytest.raises(InstrumentError, match="excess_noise at least 1"):
        ReadOut(excess_noise=0.5)


def test_modes_and_wavelengths():
    assert slices_of({"OBS-MOD": "IPOL_MBIR"}).value.tolist() == [670, 720, 760]
    for wavelength in ([610, 670, 720, 760], [670, 720, 760], [775], [680]):
        header = VAMPIRES.mode_header(wavelength * u.nm)
        assert slices_of(header).value.tolist() == wavelength
        assert layout_of(header).shape[0] == len(wavelength)
    with pytest.raises(InstrumentError, match="no file has slices of 610, 625 nm; allowed are one"):
        VAMPIRES.mode_header([610, 625] * u.nm)
    with pytest.raises(InstrumentError, match=r"FILTER01 = 'K'.*no wavelength is known"):
        slices_of({"FILTER01": "K"})
    with pytest.raises(InstrumentError, match="no keyword FILTER01"):
        slices_of({})
    with pytest.raises(InstrumentError, match="images of 64 x 32 pixels; square ones"):
        layout_of({"FILTER01": "Open", "NAXIS1": 64, "NAXIS2": 32})


def test_liquid_crystal_in_the_beam():
    assert VAMPIRES.optics_of({"U_FLCST": "IN  "}) == {"flc": True}
    assert VAMPIRES.optics_of({"U_FLCST": "OUT"}) == {"flc": False}
    assert VAMPIRES.optics_of({}) == {}


def test_files_of_a_frame():
    layout = VAMPIRES.files
    assert layout.left_file("a/x_cam1_calib.fits").as_posix() == "a/x_cam2_calib.fits"
    with pytest.raises(ObservationError, match=r"x\.fits: a frame needs the file of the right b"):
        layout.left_file("x.fits")
    for wrong in ({"beam_files": ("cam1",)}, {"weights": "variance"}):
        with pytest.raises(InstrumentError, match=next(iter(wrong))):
            FileLayout({}, (1, 8, 16), **wrong)


# --- electron multiplication ---------------------------------------------------------------------


@given(st.floats(1, 1000), st.floats(10, 1e6))
def test_excess_noise_doubles_the_photon_noise(em_gain, electrons):
    layout = FileLayout({"em_gain": "EMGAIN"}, (1, 8, 8), gain=4.5, read_noise=0.0)
    signal = electrons * em_gain / 4.5
    detector = detector_of(layout, "adu", values={"em_gain": em_gain})
    noise = np.sqrt(detector.variance(signal)) / signal
    factor = np.sqrt(2) if em_gain > 1 else 1.0
    assert noise == pytest.approx(factor / np.sqrt(electrons), rel=1e-9)
    assert layout.read_out({}).excess_noise == 1


def test_simulated_multiplication_has_mean_and_scatter_of_a_register():
    how = ReadOut(0.015, 0.3, excess_noise=np.sqrt(2))
    light = np.full((1, 200, 200), 400.0 / 0.015)
    image, weight = expose(light, how, 1.0, np.random.default_rng(5))
    electrons = image * 0.015
    assert electrons.mean() == pytest.approx(400, rel=1e-3)
    assert electrons.var() == pytest.approx(2 * 400, rel=0.03)
    np.testing.assert_allclose(1 / weight, image.var(), rtol=0.03)


def test_detectors_of_two_beams():
    one = Detector(u.adu, 2.0, 5.0, 4e4)
    both = Detector(u.adu, 2.0, 5.0, 4e4, left=Detector(u.adu, 1.0, 5.0, 4e4).in_units_of(one))
    assert both.of(0) is both
    # an adu of the left is half an electron of the right
    assert (both.of(1).gain, both.of(1).read_noise, both.of(1).saturation) == (2.0, 2.5, 2e4)
    assert one.of(1) is one


def test_errors_of_fluxes_have_the_excess_noise(tmp_path):
    table = frames(hwp=[0], derotator=np.full(20, 45.0))
    table["em_gain"] = np.full(len(table), 300.0)
    write(tmp_path, table, flux=1e8)
    run = reduced(tmp_path, keep_repeats=True)
    observations = run.observations
    same = observations.position("flc_state") == 0
    for flux, variance in (
        (observations.flux_right, observations.variance_right),
        (observations.flux_left, observations.variance_left),
    ):
        # 40 frames in both states, so that a standard deviation is known to 16 per cent
        ratio = flux[same].std(ddof=1) / np.sqrt(variance[same].mean())
        assert 0.55 < ratio < 1.5
        photons = flux[same].mean() / (4.5 / 300)
        assert variance[same].mean() > 1.9 * photons


def test_each_frame_is_read_out_as_its_row_says(tmp_path):
    table = frames(hwp=[0], derotator=[45.0])
    table["em_gain"] = [1.0, 300.0]
    # so faint that the noise is that of the read-out, electrons over electrons per adu
    for path, noise in zip(write(tmp_path, table, flux=1e-9), (9.6 / 4.5, 89 / 4.5), strict=True):
        image, error = (fits.getdata(path, i) for i in (0, 1))
        assert image.std() == pytest.approx(noise, rel=0.1)
        assert error.mean() == pytest.approx(noise, rel=0.01)


# --- files of two cameras ------------------------------------------------------------------------


def test_a_frame_is_two_files(cubes):
    assert len(list(cubes.glob("*_cam1.fits"))) == len(list(cubes.glob("*_cam2.fits"))) == 16
    with fits.open(cubes / "VMPA00000002_cam2.fits") as hdus:
        assert hdus[0].data.shape == (1, SIDE, SIDE)
        assert hdus[1].name == "ERR"
        header = hdus[0].header
        assert (header["U_CAMERA"], header["U_FLC"], header["FILTER01"]) == (2, "B", "725-50")
    assert not (cubes / "raw").exists()


def test_table_of_a_run(cubes):
    run = reduced(cubes)
    assert run.problems == {}
    assert (run.instrument.wavelength, run.meta["pairing"]) == (FILTER, "flc_state")
    observations = run.observations
    assert (observations.n_frames, observations.n_bins) == (16, 1)
    assert observations.frames["flc_state"].tolist() == ["A", "B"] * 8
    assert len(observations.pairs()) == 8
    assert len(observations.groups(4)) == 4
    assert VAMPIRES.setup(observations) == ("polarized", ("flc",))


def test_cameras_of_other_gains_count_the_same_electrons(copied):
    before = reduced(copied).observations
    for path in copied.glob("*.fits"):
        left = "cam2" in path.name
        # the electrons of a pixel are as many
        edit(path, factor=0.105 / 4.5 * (600 if left else 300), U_EMGAIN=600 if left else 300)
    after = reduced(copied).observations
    scale = 0.105 / 4.5 * 300
    np.testing.assert_allclose(after.flux_right, scale * before.flux_right, rtol=1e-6)
    np.testing.assert_allclose(after.flux_left, scale * before.flux_left, rtol=1e-6)


def test_cameras_that_contradict_each_other(copied):
    path = copied / "VMPA00000001_cam2.fits"
    content = path.read_bytes()
    for wrong, message in [
        ({"RET-ANG1": 30.0}, "hwp = 0.0, but 30.0 in VMPA00000001_cam2.fits"),
        ({"U_FLC": "B"}, "flc_state = A, but B in VMPA00000001_cam2.fits"),
        ({"U_CAMERA": 1}, "U_CAMERA = 1, its name says 'cam2'"),
        ({"U_EMGAIN": 300}, "em_gain = None, but 300.0 in VMPA00000001_cam2.fits"),
        ({"U_FLC": "C"}, "VMPA00000001_cam2.fits: U_FLC = 'C', allowed are A, B"),
    ]:
        path.write_bytes(content)
        edit(path, **wrong)
        problems = reduced(copied).problems
        assert [p.rpartition("/")[2] for p in problems] == ["VMPA00000001_cam1.fits"], wrong
        assert message in "; ".join(next(iter(problems.values())))


def test_masters_of_other_settings_are_told(copied):
    size, word = (SIDE, SIDE), VAMPIRES.files.keywords["filter"]
    cards = {"EXPTIME": 10.0, "U_CAMERA": 1, "U_EMGAIN": 300.0}
    for kind, changes, words in (
        ("dark", {}, ""),
        ("dark", {"U_EMGAIN": 10.0}, "em_gain = 300.0, but 10.0 in its dark"),
        ("dark", {"U_CAMERA": 2}, "camera = 1.0, but 2.0 in its dark"),
        ("flat", {"EXPTIME": 1.0, word: "625-50", "U_EMGAIN": 1.0}, ""),
        ("flat", {word: "675-50"}, "filter = 625-50, but 675-50 in its flat"),
    ):
        for camera in (1, 2):
            image = np.full(size, 1.0 if kind == "flat" else 1e-3)
            header = fits.Header(cards | changes)
            fits.writeto(copied / f"{kind}_cam{camera}.fit", image, header, overwrite=True)
        for path in copied.glob("*.fits"):
            edit(path, U_EMGAIN=300.0, **{word: "625-50"})
        told = reduced(copied, **{kind: copied / f"{kind}_cam1.fit"}).doubts
        assert {"; ".join(why) for why in told.values()} == ({words} if words else set()), changes


def test_a_camera_that_is_missing(copied):
    (copied / "VMPA00000001_cam2.fits").unlink()
    (copied / "VMPA00000002_cam1.fits").unlink()
    problems = {path.rpartition("/")[2]: why for path, why in reduced(copied).problems.items()}
    assert problems["VMPA00000001_cam1.fits"] == [
        "no file VMPA00000001_cam2.fits of the left beam beside it"
    ]
    assert "the file of the right beam, with 'cam1' in its name" in "; ".join(
        problems["VMPA00000002_cam2.fits"]
    )


def test_a_frame_without_a_state_is_left_out_and_its_partner_named(copied, tmp_path):
    for camera in (1, 2):
        edit(copied / f"VMPA00000003_cam{camera}.fits", U_FLC="NA")
    run = reduced(copied)
    assert run.problems == {
        str(copied / "VMPA00000003_cam1.fits"): [
            "no state of the modulator, A or B, in its header (U_FLC), which others have"
        ]
    }
    run.write(tmp_path / "obs.ecsv")
    observations = Observations.read(tmp_path / "obs.ecsv")
    for find in (observations.pairs, lambda: observations.groups(4)):
        with pytest.raises(
            ObservationError, match=r"obs\.ecsv, row 3: flc_state B at hwp = 45 deg"
        ):
            find()


def test_frames_of_other_optics_than_most_are_left_out(copied):
    for path in copied.glob("*.fits"):
        # the words of the header have changed
        edit(path, U_FLCST="In" if "0001" in path.name else "IN")
    for camera in (1, 2):
        edit(copied / f"VMPA00000002_cam{camera}.fits", U_FLCST="OUT")
        edit(copied / f"VMPA00000003_cam{camera}.fits", **{"DATA-TYP": "DARK"})
    run = reduced(copied)
    (one, (typed, *_)), (other, word) = run.problems.items()
    assert (one[-17:], other[-17:]) == ("00000003_cam1.fits"[1:], "00000002_cam1.fits"[1:])
    assert typed == "DATA-TYP = 'DARK': it has no light of the source"
    assert word == ["flc 'out', the others of the run have 'in'"]
    assert run.meta["flc"] == "in"


@pytest.mark.slow
def test_a_first_file_of_another_mode_does_not_name_that_of_the_run(copied):
    wanted = reduced(copied).observations
    first = [copied / f"VMPA00000001_cam{camera}.fits" for camera in (1, 2)]
    for words, why in (
        ({"FILTER01": "625-50"}, "filter '625-50', the others of the run have '725-50'"),
        ({"FILTER01": "H-alpha"}, "filter 'H-alpha', the others of the run have '725-50'"),
        ({"OBS-MOD": "IPOL_MBI"}, "pickoff 'IPOL_MBI', the others of the run have 'IPOL'"),
    ):
        for path in first:
            edit(path, **{"OBS-MOD": "IPOL", "FILTER01": "725-50"} | words)
        run = reduced(copied)
        assert run.problems == {str(first[0]): [why]}, words
        assert run.observations.wavelength == wanted.wavelength == FILTER
    for path in copied.glob("*.fits"):
        edit(path, FILTER01="H-alpha", **{"OBS-MOD": "IPOL"})
    with pytest.raises(InstrumentError, match=r"VMPA00000001_cam1.fits: FILTER01 = 'H-alpha'"):
        reduced(copied)


def test_images_of_another_size(copied):
    header = fits.getheader(copied / "VMPA00000001_cam2.fits")
    fits.writeto(
        copied / "VMPA00000001_cam2.fits", np.ones((1, 20, 20)), header=header, overwrite=True
    )
    (why,) = reduced(copied).problems.values()
    assert "shape (1, 20, 20) in extension 0, (1, 48, 48) is needed" in why[0]


def test_images_without_an_axis_of_wavelengths(copied):
    before = reduced(copied).observations
    for path in copied.glob("*.fits"):
        with fits.open(path) as hdus:
            data, header, errors = hdus[0].data[0], hdus[0].header, hdus[1].data[0]
        new = fits.HDUList([fits.PrimaryHDU(data, header), fits.ImageHDU(errors, name="ERR")])
        new.writeto(path, overwrite=True)
    np.testing.assert_array_equal(reduced(copied).observations.flux_left, before.flux_left)


# --- from cubes to the truth ---------------------------------------------------------------------


@pytest.mark.slow
def test_cubes_give_back_the_truth(tmp_path):
    table = frames(hwp=np.arange(0, 180, 22.5), derotator=[45, 65, 85, 105, 125])
    write(tmp_path, table, flux=1e8)
    night = reduced(tmp_path).observations
    start = VAMPIRES.chains_for([night], derotator="linear")[0]
    start["hwp"].retardance, start["derotator"].retardance = [-160] * u.deg, [215] * u.deg
    start["wollaston"].efficiency = [0.9]
    found = calibrate(start, night, cross_validate=False)
    truth = chain()
    for name, key in (("hwp", "retardance"), ("derotator", "retardance")):
        value, true = (getattr(c[name], key).value for c in (found.chain, truth))
        np.testing.assert_allclose(value, true, atol=0.3)
    assert np.sqrt(np.mean(found.residuals**2)) < 1e-3


@pytest.mark.long
def test_commands_from_simulation_to_a_corrected_star(tmp_path, capsys):
    cubes, star, table = tmp_path / "cubes", tmp_path / "star", tmp_path / "obs.ecsv"
    cal, summary = tmp_path / "cal.asdf", tmp_path / "star.json"
    simulate = ["simulate", "--instrument", "vampires"]
    main([*simulate, "--cubes", str(cubes), "--hwp", "0,45,22.5,67.5", "--derotator", "45,75,105"])
    reduce = ["reduce", str(cubes), "--instrument", "vampires", "--source", "polarized", "-q"]
    assert main([*reduce, "-o", str(table)]) in (0, None)
    fix = [word for name in ("relay", "flc") for word in ("--fix", f"{name}.retardance")]
    main(["calibrate", str(table), "-o", str(cal), *fix])
    pointing = ["--source", "star", "--altitude", "60,64", "--parallactic=-20,0"]
    seen = ["--cubes", str(star), "--flux", "2e6", "--fwhm", "3.5", "--no-noise"]
    values = ["--fix", "star.q=0.03", "--fix", "star.u=-0.02", "--derotator", "60"]
    main([*simulate, "--calibration", str(cal), *pointing, *seen, *values])
    ways = ["--any-date", "--open-directions", "ignore", "--size", "31", "-q"]
    ways += ["--rotation", "pupil"]
    main(["correct", str(star), "--calibration", str(cal), *ways, "-o", str(tmp_path / "s.fits"),
          "--json", str(summary)])  # fmt: skip
    content = json.loads(summary.read_text())
    assert content["n_frames"] == 8
    np.testing.assert_allclose(content["aperture"]["q"], 0.03, atol=2e-4)
    np.testing.assert_allclose(content["aperture"]["u"], -0.02, atol=2e-4)
    capsys.readouterr()


# --- raw frames, which headers sort --------------------------------------------------------------


@pytest.fixture
def raw(cubes, tmp_path):
    """Frames under names that tell neither camera nor state, as cubes of three exposures."""
    folder = tmp_path / "raw"
    folder.mkdir()
    for number, path in enumerate(sorted(cubes.glob("*.fits"), key=lambda p: (p.name[-6], p.name))):
        with fits.open(path) as hdus:
            image = hdus[0].data[0]
            stack = np.stack([image - 1, image, image + 1]).astype(np.float32)
            # seconds of each of the exposures
            header = hdus[0].header.copy()
            header["EXPTIME"] /= 3
            fits.writeto(folder / f"VMPA{number:08d}.fits", stack, header)
    return folder


def test_raw_frames_are_sorted_by_state_and_camera(raw, cubes):
    found, named = reduced(raw), reduced(cubes)
    assert (found.problems, len(found.frames)) == ({}, 16)
    assert {frame.values["exposures"] for frame in found.frames} == {3}
    states = found.observations.frames["flc_state"]
    assert states.tolist().count("A") == states.tolist().count("B") == 8

    def by_position(reduction):
        return {
            (f.values["hwp"], f.values["derotator"], f.values["flc_state"]): f.photometry.flux
            for f in reduction.frames
        }

    expected = by_position(named)
    for key, flux in by_position(found).items():
        # right stays right and left left, whatever the names
        np.testing.assert_allclose(flux, expected[key], rtol=1e-4)


def test_raw_frames_that_cannot_be_sorted_are_named(raw):
    paths = sorted(raw.glob("*.fits"))
    headers = [fits.getheader(path) for path in paths]
    right = [i for i, header in enumerate(headers) if header["U_CAMERA"] == 1]
    changes = [("U_CAMERA", 3), ("U_FLC", "C"), ("U_FLCSTT", None), ("U_FLC", None)]
    state = headers[right[2]]["U_FLC"]
    for i, (keyword, value) in zip(right, changes, strict=False):
        with fits.open(paths[i], mode="update") as hdus:
            if keyword == "U_FLCSTT":
                hdus[0].header[keyword] = {"A": 2, "B": 1}[state]
            elif value is None:
                del hdus[0].header[keyword]
            else:
                hdus[0].header[keyword] = value
    problems = {path.rpartition("/")[2]: why for path, why in reduced(raw).problems.items()}
    words = [
        "U_CAMERA = 3 in its header; allowed are 1, 2",
        "U_FLC = 'C', allowed are A, B, 1, 2, NA",
        f"U_FLC = '{state}', but U_FLCSTT = ",
        "no state of the modulator (U_FLC) in its header, which others have",
    ]
    for i, said in zip(right, words, strict=False):
        assert said in "; ".join(problems.pop(paths[i].name))
    # their partners of the other camera
    assert len(problems) == 4
    for why in problems.values():
        assert why[0].startswith("no frame of camera 1 in state ")


def test_a_saturated_exposure_spoils_a_mean(raw, tmp_path):
    for camera in (1, 2):
        fits.writeto(tmp_path / f"flat_cam{camera}.fits", np.full((SIDE, SIDE), 2.0))
    paths = [path for path in sorted(raw.glob("*.fits")) if fits.getval(path, "U_CAMERA") == 1]
    # what a full pixel is in each unit
    for path, unit, gain in zip(paths, ("adu", "electron"), (1, 0.105), strict=False):
        with fits.open(path, mode="update") as hdus:
            hdus[0].data *= np.float32(gain)
            hdus[0].data[1, 20, 20] = gain * 65535
            hdus[0].header["BUNIT"] = unit
    for options in ({}, {"flat": tmp_path / "flat_cam1.fits"}):
        problems = reduced(raw, **options).problems
        assert [*map(str, paths[:2])] == [*problems]
        for why in problems.values():
            assert why == ["no slice can be used: saturated"]


def test_exposures_without_a_value_are_refused(raw):
    path = sorted(raw.glob("*.fits"))[0]
    with fits.open(path, mode="update") as hdus:
        hdus[0].data[1] = np.nan
    (why,) = reduced(raw).problems.values()
    assert "1 of its 3 exposures, such as number 2, have no pixel with a value" in why[0]


@pytest.mark.slow
def test_exposures_that_one_camera_lacks_are_refused(raw):
    paths = sorted(raw.glob("*.fits"))
    spoilt = next(path for path in paths if fits.getval(path, "U_CAMERA") == 1)

    def scale(path, factor):
        with fits.open(path, mode="update") as hdus:
            hdus[0].data[2] *= np.float32(factor)

    scale(spoilt, 0.02)
    (why,) = reduced(raw).problems.values()
    assert "1 of its 3 exposures, such as number 3 with 2% of the usual light, where VMPA" in why[0]
    # a lamp that fades does so in both
    for path in paths:
        scale(path, 1.0 if path == spoilt else 0.02)
    assert reduced(raw).problems == {}


@pytest.mark.slow
def test_whole_numbers_of_a_camera_are_read_and_need_a_dark(raw, tmp_path):
    """As cameras write them: 16 bits without a sign, with a bias."""
    wanted = reduced(raw).observations
    for path in raw.glob("*.fits"):
        with fits.open(path) as hdus:
            data, header = np.rint(hdus[0].data + 200).astype("u2"), hdus[0].header
        fits.writeto(path, data, header, overwrite=True)
    for camera in (1, 2):
        dark = np.full((SIDE, SIDE), 200.0)
        fits.writeto(tmp_path / f"dark_cam{camera}.fits", dark, fits.Header({"U_CAMERA": camera}))
    told = reduced(raw).doubts
    assert len(told) == 16
    assert all("whole numbers, as of a raw frame, and no dark" in why[0] for why in told.values())
    found = reduced(raw, dark=tmp_path / "dark_cam1.fits")
    assert found.doubts == {}
    np.testing.assert_allclose(found.observations.flux_right, wanted.flux_right, rtol=1e-3)


@pytest.mark.slow
def test_a_camera_in_a_wrong_unit_is_told_by_the_light_of_both(copied):
    """Its electrons would be ten times as many, and what is polarized seem less so."""
    optics, words = join(leaves(chain())[1:]), "beam has .* times the light of the left one"
    for unit, odd in (("adu", False), ("electron", True)):
        for path in copied.glob("*_cam2.fits"):
            edit(path, BUNIT=unit)
        reduction = reduced(copied)
        told = [one for why in reduction.doubts.values() for one in why if re.search(words, one)]
        assert len(told) == odd * len(reduction.frames), (unit, told)
        table = reduction.table
        positions = {name: table[name].quantity for name in ("hwp", "derotator")}
        positions["flc_state"] = (table["flc_state"] == "B").astype(float)
        right, left = (table[f"flux_{beam}"].value[:, None] for beam in ("right", "left"))
        frames = ScienceFrames.from_arrays(right, left, FILTER, positions, hwp=positions["hwp"])
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = correct(optics, frames)
        assert (np.hypot(found.q, found.u)[0] < 0.9) == odd, unit
        assert any(re.search(words, str(one.message)) for one in told) == odd, unit
