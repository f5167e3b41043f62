# Licensed under a 3-clause BSD style license - see LICENSE
"""IRDIS images: both halves of a detector, from headers to a disk about a polarized star."""

import json
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from astropolcal import calibrate, instruments
from astropolcal.correction import Corrected, measurement_rows
from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments import IRDIS
from astropolcal.reduction import (
    CubeFiles,
    ImageModel,
    reduce_run,
    simulate_cubes,
    true_observations,
)
from astropolcal.reduction.frames import survey_frames
from astropolcal.reduction.headers import read_header
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles, simulate

IRDIS_ = instruments.get("irdis")
SIDE, LAM = 64, [1.625] * u.um
H = {"ESO INS1 FILT ID": "FILT_BBF_H"}
SMALL = {"NAXIS1": 2 * SIDE, "NAXIS2": SIDE}
DATE = {"files": CubeFiles(start="2018-03-20T03:00:00", headers={"OBJECT": "HD 1"})}


class Small(IRDIS):
    """IRDIS with images that are quickly simulated."""

    def configured(self, header):
        return super().configured(SMALL | dict(header))


def star_frames():
    frames = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, [20, 24] * u.deg)
    frames["parallactic"] = np.linspace(20, 26, 8) * u.deg
    frames["altitude"] = np.linspace(60, 62, 8) * u.deg
    return frames


@pytest.fixture(scope="module")
def lamp(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lamp")
    frames = half_wave_plate_cycles(derotator=[10, 35, 60] * u.deg)
    simulate_cubes(folder, IRDIS_.chain(wavelength=LAM), Small(), frames, wavelength=LAM,
                   flux=1e6, seed=1, **DATE)  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def science(tmp_path_factory):
    folder = tmp_path_factory.mktemp("science")
    sky = IRDIS_.on_sky(IRDIS_.chain(wavelength=LAM), wavelength=LAM, date="2018-03-20")
    simulate_cubes(folder, sky, Small(), star_frames(), wavelength=LAM, source="star", flux=1e6,
                   stokes=(1, 0.02, -0.01, 0), image=ImageModel(fwhm=4.0, halo=0.5),
                   seed=2, **DATE)  # fmt: skip
    return folder


def copied(folder, target):
    for path in folder.glob("*.fits"):
        (target / path.name).write_bytes(path.read_bytes())
    return sorted(target.glob("*.fits"))


def test_headers_are_read_as_frame_table_reads_them(science):
    table = star_frames()
    for path, row in zip(sorted(science.glob("*.fits")), table, strict=True):
        found = read_header(path, Small().configured(fits.getheader(path)).files)
        assert (found.errors, found.doubts) == ([], [])
        for name in ("hwp", "derotator", "parallactic", "altitude"):
            assert found.values[name] == pytest.approx(row[name].value, abs=1e-6), name
        # of field tracking
        law = row["hwp"] - row["parallactic"] + row["altitude"]
        assert found.values["hwp_true"] == pytest.approx(law.value, abs=1e-6)


def test_a_header_that_says_too_little_is_an_error_of_the_file(science, tmp_path):
    path = copied(science, tmp_path)[0]
    with fits.open(path, mode="update") as hdus:
        del hdus[0].header["ESO INS4 COMB ROT"]
    layout = Small().configured(fits.getheader(path)).files
    assert read_header(path, layout).errors == ["no keyword ESO INS4 COMB ROT in its header"]
    with pytest.raises(ObservationError, match=r"fits: no keyword ESO INS4 COMB ROT in its header"):
        survey_frames([path], layout)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["HIERARCH ESO INS4 COMB ROT"] = "FIELD"
        del hdus[0].header["ESO INS4 DROT3 END"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (doubt,) = read_header(path, layout).doubts
    assert doubt.startswith("no keyword ESO INS4 DROT3 END in 1 frame")


def test_frames_of_both_kinds_of_tracking_are_refused_in_any_order(science, tmp_path):
    one, other = copied(science, tmp_path)[:2]
    fits.setval(other, "HIERARCH ESO INS4 COMB ROT", value="PUPIL")
    for files in ([one, other], [other, one]):
        layout = Small().configured(fits.getheader(files[0])).files
        with pytest.raises(ObservationError, match="but most files have another: frames of one"):
            survey_frames(files, layout)


def test_filter_and_size_are_those_of_the_file():
    one = IRDIS_.configured({"ESO INS1 FILT ID": "FILT_BBF_J", "NAXIS1": 400, "NAXIS2": 200})
    assert (one.wavelength, one.files.shape) == ([1.245] * u.um, (1, 200, 400))
    assert one.files.star_offset == (200.0, 0.0)
    assert IRDIS_.mode_header([1.043] * u.um) == {"ESO INS1 FILT ID": "FILT_BBF_Y"}
    for header, message in [
        ({"ESO INS1 FILT ID": "FILT_DBF_H23"}, "has no coefficients; allowed are FILT_BBF_Y"),
        (H | {"NAXIS1": 401}, "images of 401 x 1024 pixels; two ha"),
        # one half, and an image whose axes are exchanged
        (H | {"NAXIS1": 1024}, "images of 1024 x 1024 pixels; two ha"),
        (H | {"NAXIS1": 1024, "NAXIS2": 2048}, "images of 1024 x 2048 pixels; two ha"),
    ]:
        with pytest.raises(InstrumentError, match=message):
            IRDIS_.configured(header)
    with pytest.raises(InstrumentError, match="a file is of one filter, not of Y, J, H, Ks"):
        IRDIS_.mode_header(IRDIS_.wavelength)


def test_frames_without_light_or_without_optics_are_left_out(lamp, tmp_path):
    paths = copied(lamp, tmp_path)
    cases = (
        ("ESO DPR TYPE", "FLAT,LAMP", ""),
        ("ESO DPR TYPE", "DARK", "it has no light of the source"),
        ("ESO INS4 OPTI8 NAME", "h_nir", ""),
        ("ESO INS4 OPTI8 NAME", "CLEAR", "the half-wave plate is not in the beam"),
        ("ESO INS1 OPTI2 NAME", "P0-90", ""),
        ("ESO INS1 OPTI2 NAME", "D_H23", "the pair of polarizers is not in the beam"),
    )
    wanted = {}
    for path, (keyword, word, why) in zip(paths, cases, strict=False):
        fits.setval(path, f"HIERARCH {keyword}", value=word)
        wanted |= {str(path): [f"{keyword} = {word!r}: {why}"]} if why else {}
    assert reduce_run(paths, Small(), source="polarized").problems == wanted


def test_a_mean_of_exposures_has_the_noise_of_all(lamp, tmp_path):
    first = copied(lamp, tmp_path)[0]
    with fits.open(first, mode="update") as hdus:
        image = hdus[0].data[0]
        # four exposures whose mean is the image, with one pixel that is known in one only
        stack = np.stack([image - 1, image + 1, image - 2, image + 2]).astype(np.float32)
        stack[:3, 30, 30] = np.nan
        hdus[0].data = stack
        del hdus[1]
    (one,) = reduce_run([first], Small(), source="polarized").frames
    assert one.values["exposures"] == 4
    (other,) = reduce_run([lamp / first.name], Small(), source="polarized").frames
    np.testing.assert_allclose(one.photometry.flux, other.photometry.flux, rtol=1e-3)
    np.testing.assert_allclose(4 * one.photometry.variance, other.photometry.variance, rtol=0.05)


def test_frames_of_a_lamp_calibrate(lamp):
    table = reduce_run(sorted(lamp.glob("*.fits")), Small(), source="polarized").observations
    assert (table.n_frames, table.wavelength) == (24, LAM)
    assert table.meta["mode"] == "FILT_BBF_H"
    frames = half_wave_plate_cycles(derotator=[10, 35, 60] * u.deg)
    truth = true_observations(IRDIS_.chain(wavelength=LAM), Small().configured(H), frames, flux=1e6)
    for beam in ("flux_right", "flux_left"):
        off = getattr(table, beam) - getattr(truth, beam)
        pulls = off / np.sqrt(getattr(table, beam.replace("flux", "variance")))
        assert np.sqrt(np.mean(pulls**2)) == pytest.approx(1, abs=0.3)


@pytest.mark.slow
@pytest.mark.filterwarnings("always::astropolcal.exceptions.AstropolcalWarning")
def test_a_bias_of_one_beam_in_some_frames_is_told(science, tmp_path, capsys):
    """It looks like polarization of the star; not a bias of all, nor one below the errors."""
    chain, cal = IRDIS_.chain(wavelength=LAM), tmp_path / "irdis.asdf"
    frames = half_wave_plate_cycles(derotator=[10, 35, 60] * u.deg)
    data = simulate(chain, LAM, frames, flux=1e8, seed=1)
    calibrate(chain, data, instrument="irdis").write(cal)
    paths, found = copied(science, tmp_path), []
    images, words = [fits.getdata(path) for path in paths], "edge of the images is polarized diff"
    command = ["correct", *map(str, paths), "--calibration", str(cal), "--any-date", "-q"]
    command += ["-o", str(tmp_path / "out.fits"), "--json", str(tmp_path / "s.json")]
    command += ["--rotation", "fixed", "--open-directions", "ignore"]
    # of left and right beam where the plate is at 0 and 22.5 deg, and where it is not
    for first, second, odd in (
        ((0, 0), (0, 0), False),
        ((6, 6), (6, 6), False),
        ((0, 1), (0, 0), False),
        ((0, -30), (0, 0), True),
    ):
        for i, (path, image) in enumerate(zip(paths, images, strict=True)):
            bias = np.repeat(second if i % 2 else first, SIDE)
            with fits.open(path, mode="update") as hdus:
                hdus[0].data = (image + bias).astype(np.float32)
        assert main(command) in (0, None)
        told = words in capsys.readouterr().err
        aperture = json.loads((tmp_path / "s.json").read_text())["aperture"]
        found.append(np.array([aperture["q"][0], aperture["u"][0]]))
        error = np.hypot(aperture["q_statistical"], aperture["q_systematic"])[0]
        changed = np.hypot(*(found[-1] - found[0])) > 1.5 * error
        assert (changed, told) == (odd, odd), (first, second)


@pytest.mark.slow
def test_commands_leave_the_disk_of_a_polarized_star(lamp, science, tmp_path, capsys):
    """A disk about a star of 2.2 %, in images whose files hold no errors."""
    table, cal, out = (tmp_path / name for name in ("run.ecsv", "irdis.asdf", "stokes.fits"))
    images = copied(science, tmp_path)
    sky = IRDIS_.on_sky(IRDIS_.chain(wavelength=LAM), wavelength=LAM, date="2018-03-20")
    frames = star_frames()
    positions = {name: frames[name] for name in ("derotator", "parallactic", "altitude")}
    positions["hwp"] = frames["hwp"] - frames["parallactic"] + frames["altitude"]
    rows, columns = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    radius, angle = np.hypot(rows, columns), np.arctan2(-columns, rows)
    ring = 200 * np.exp(-0.5 * ((radius - 12) / 2) ** 2)
    disk = np.stack([ring, -0.4 * ring * np.cos(2 * angle), -0.4 * ring * np.sin(2 * angle)])
    seen = np.einsum("bfs,syx->bfyx", measurement_rows(sky, positions, LAM)[:, 0, :, :3], disk)
    for i, path in enumerate(images):
        with fits.open(path, mode="update") as hdus:
            hdus[0].data[0] += np.concatenate([seen[1, i], seen[0, i]], axis=1)
            # what pipelines leave: images alone
            del hdus[1]
    main(["reduce", str(lamp), "--source", "polarized", "-q",
          "-o", str(table)])  # fmt: skip
    main(["calibrate", str(table), "-o", str(cal), "-q"])
    ways = ["--size", "51", "--rotation", "fixed", "--camera-angle", "0", "--json"]
    command = ["correct", *map(str, images), "--calibration", str(cal), "-o", str(out), *ways]
    command += [str(tmp_path / "s.json"), "--open-directions", "ignore", "--full"]
    assert main([*command, "--subtract-star", "annulus=19,25"]) in (0, None)
    assert "subtracted from all light: 2." in capsys.readouterr().out
    summary, found = json.loads((tmp_path / "s.json").read_text()), Corrected.read(out)
    star = found.star[0]
    for name, true in (("q", 0.02), ("u", -0.01)):
        error = np.hypot(star[f"{name}_statistical"], star[f"{name}_systematic"])
        assert 0 < error < 5e-3
        assert abs(star[name] - true) < 4 * error
    assert summary["subtracted_star"]["from"] == "annulus of 19 to 25 pixels"
    told, distance = found.azimuthal(), np.hypot(*(np.indices((51, 51)) - 25))
    inside = (distance > 6) & (distance < 18)
    ring = 200 * np.exp(-0.5 * ((distance - 12) / 2) ** 2)
    error = np.hypot(told["q_phi_statistical"], told["q_phi_systematic"])[0]
    for name, true in (("q_phi", 0.4 * ring), ("u_phi", 0 * ring)):
        pulls = ((told[name][0] - true) / error)[inside]
        assert np.sqrt(np.mean(pulls**2)) == pytest.approx(1, abs=0.15)
