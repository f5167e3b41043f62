# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal correct``."""

import argparse
import json

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from astropolcal import calibrate, instruments
from astropolcal.correction import Corrected
from astropolcal.correction import correcting as engine
from astropolcal.exceptions import AstropolcalError
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.scripts import _correct
from astropolcal.simulation import half_wave_plate_cycles, simulate

Q, U = 0.03, -0.02


def command(*words):
    parser = argparse.ArgumentParser()
    _correct.add_parser(parser.add_subparsers())
    arguments = parser.parse_args(["correct", *map(str, words)])
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
        noise=False,
        psf="gaussian",
        headers={"OBJECT": "HD 1"},
        raw=False,
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


@pytest.mark.slow
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
def test_no_calibration_holds_for_the_date(night, tmp_path):
    library = pytest.importorskip("astropolcal.pipeline.library").Library
    from astropolcal import Calibration

    (tmp_path / "lib").mkdir()
    calibration = Calibration.read(night / "charis.asdf")
    library(tmp_path / "lib").add(calibration, valid_from="2026-01-01")
    words = ["-o", tmp_path / "out.fits", "-q"]
    with pytest.raises(AstropolcalError, match=r"no calibration .*for date 2025-10-05"):
        command(night / "cubes", "--calibration", tmp_path / "lib", *words)


@pytest.mark.slow
def test_a_file_that_does_not_hold_is_refused(night, tmp_path):
    from astropolcal import Calibration
    from astropolcal.calibration.result.validity import with_validity

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


@pytest.mark.slow
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
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--optics-in", "dichroic"], "no chain with dichroic; it holds for .* with nbs"),
        (["--optics-in", ""], "no chain no optional optics; it holds for .* with nbs"),
        (["--centre", "300,5"], "outside the image"),
        (["--cluster", "tcp://127.0.0.1:1"], "cluster tcp"),
        (["--size", "4000"], "size = 4000; the images are 201 x 201 pixels, allowed are 1 to 402"),
        (["--max-condition", "0.5"], "max_condition = 0.5"),
        (["--radius", "0"], "no pixel is inside"),
        (["--radius", "3"], r"--radius 3: leaves the images of --size 5; allowed are up to 2\.5"),
        (["--camera-angle", "113"], "--camera-angle 113: is for --rotation fixed or --rotation pu"),
        (
            ["--camera-angle", "0", "--rotation", "none"],
            "--camera-angle 0: is for --rotation fixed",
        ),
        (["--seed", "3"], "--seed 3: is for --samples N"),
        (["--samples", "20", "--seed", "-1"], "seed = -1; allowed are whole numbers from 0 up"),
        (["-o", "out.asdf"], r"-o out\.asdf: the name must end with \.fits"),
        (["--spectrum", "star.txt"], r"--spectrum star\.txt: the name must end with \.ecsv"),
    ],
)
def test_bad_input(night, tmp_path, words, message, monkeypatch):
    monkeypatch.setattr(engine, "_TIMEOUT", 1)
    if "--centre" not in words:
        words = [*words, "--centre", "69.9,84.7"]
    out = ["-o", tmp_path / "out.fits", "-q", "--size", "5"]
    with pytest.raises(AstropolcalError, match=message):
        command(night / "cubes", "--calibration", night / "charis.asdf", *out, *words)


@pytest.mark.slow
def test_too_few_angles(night, tmp_path):
    paths = sorted((night / "cubes").glob("*.fits"))[:1]
    with pytest.raises(AstropolcalError, match=r"Q and U are not determined .* 1 frame \("):
        command(
            *paths, "--calibration", night / "charis.asdf", "-o", tmp_path / "o.fits", "-q",
            "--centre", "69.9,84.7",
        )  # fmt: skip


@pytest.mark.slow
def test_no_calibration(night, tmp_path):
    with pytest.raises(AstropolcalError, match="nowhere"):
        command(night / "cubes", "--calibration", tmp_path / "nowhere", "-o", tmp_path / "o.fits")


def changed(night, folder, *keywords):
    """Copy two cubes and change keywords of the second, or of both."""
    paths = []
    for i, path in enumerate(sorted((night / "cubes").glob("*.fits"))[:2]):
        paths.append(folder / path.name)
        paths[-1].write_bytes(path.read_bytes())
        for keyword, *values in keywords:
            fits.setval(paths[-1], keyword, value=values[min(i, len(values) - 1)])
    return paths


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ([("FILTNAME", "J", "K")], "is in mode 'J', .* in 'K': correct apart"),
        ([("FILTNAME", "J")], "in mode 'J', but .*charis.asdf holds for .*--filter 'broadband"),
        ([("MJD", 60950.5, 60800.5)], "nbs was in the beam in .*, and not in "),
        (
            [("MJD", 60800.5), ("FILTNAME", "broadband JHK")],
            "switcher was installed between the data",
        ),
    ],
)
def test_frames_of_another_set_up(night, tmp_path, keywords, message):
    from astropolcal import Calibration
    from astropolcal.calibration.result.validity import with_validity

    calibration = Calibration.read(night / "charis.asdf")
    stated = with_validity(calibration, mode="broadband JHK", valid_from="2025-01-01")
    stated.write(tmp_path / "charis.asdf")
    with pytest.raises(AstropolcalError, match=message):
        command(
            *changed(night, tmp_path, *keywords), "--calibration", tmp_path / "charis.asdf",
            "-o", tmp_path / "o.fits", "-q", "--centre", "69.9,84.7",
        )  # fmt: skip
