# Licensed under a 3-clause BSD style license - see LICENSE
"""astropolcal simulate: image cubes and stars."""

import json
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from astropolcal import Observations, calibrate, instruments
from astropolcal.chain import stages
from astropolcal.correction import measurement_rows
from astropolcal.reduction.cubes import DetectorModel, simulate_cubes
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
STAR = ["--source", "star", "--altitude", "67,64", "--parallactic", "24,30"]
TWO = ["--hwp", "0,45", "--derotator", "60"]


def simulated(*argv):
    return main(["simulate", *(str(a) for a in argv)])


def test_cubes_are_those_of_the_published_chain(tmp_path, capsys):
    argv = ["--cubes", tmp_path / "cli", *TWO, "--seed", 5, "--bad-pixels", 0.01, "--json", "-"]
    assert simulated(*argv) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["output"], summary["n_frames"]) == (None, 2)
    paths = sorted((tmp_path / "cli").glob("*.fits"))
    frames = half_wave_plate_cycles([0, 45] * u.deg, 60 * u.deg)
    again = simulate_cubes(
        tmp_path / "api", CHARIS.published(), CHARIS, frames, flux=4e6, seed=5,
        detector=DetectorModel(bad_pixels=0.01),
    )  # fmt: skip
    for path, same in zip(paths, again, strict=True):
        assert path.name == same.name
        np.testing.assert_array_equal(fits.getdata(path, 1), fits.getdata(same, 1))
    assert len(list((tmp_path / "cli" / "raw").glob("*.fits"))) == 2


def test_beside_cubes_the_table_holds_the_truth(tmp_path, capsys):
    table, plain = tmp_path / "true.ecsv", tmp_path / "plain.ecsv"
    assert simulated("--cubes", tmp_path / "cubes", "-o", table, *TWO) == 0
    assert "(2 cubes)" in capsys.readouterr().out
    assert simulated("-o", plain, *TWO, "--no-noise") == 0
    np.testing.assert_array_equal(
        Observations.read(table).flux_left, Observations.read(plain).flux_left
    )


def test_star_stands_before_the_published_optics(tmp_path):
    table = tmp_path / "star.ecsv"
    argv = ["-o", table, *STAR, "--derotator", "97", "--flux", 1e6, "--fix", "star.q=0.01"]
    assert simulated(*argv) == 0
    observations = Observations.read(table)
    assert observations.source == "star"
    assert observations.frames["hwp"].value.tolist() == [0, 45, 22.5, 67.5]
    np.testing.assert_allclose(observations.frames["altitude"].value, [67, 66, 65, 64])
    np.testing.assert_allclose(observations.frames["hwp_true"][0].value, 0 + 12 + 67)
    assert np.isfinite(observations.variance_right).any()


def test_cubes_of_a_star_show_two_images(tmp_path):
    argv = ["--cubes", tmp_path / "c", *STAR, "--hwp", "0", "--derotator", "97", "--flux", 1e6]
    assert simulated(*argv, "--no-noise", "--psf", "gaussian", "--fwhm", 4) == 0
    (path,) = (tmp_path / "c").glob("*.fits")
    image = fits.getdata(path, 1)[12]
    y, x = np.unravel_index(image.argmax(), image.shape)
    image[y - 9 : y + 10, x - 9 : x + 10] = 0
    other = np.unravel_index(image.argmax(), image.shape)
    dx, dy = CHARIS.files.star_offset
    assert abs(other[1] - x) == pytest.approx(dx, abs=1)
    assert abs(other[0] - y) == pytest.approx(dy, abs=1)


@pytest.mark.slow
def test_calibration_of_the_internal_source_serves_for_a_star(tmp_path):
    lamp, cal, table = (tmp_path / name for name in ("lamp.ecsv", "cal.asdf", "star.ecsv"))
    assert simulated("-o", lamp) == 0
    assert main(["calibrate", str(lamp), "-q", "-o", str(cal)]) == 0
    assert simulated("-o", table, "--calibration", cal, *STAR, "--derotator", "97") == 0
    assert Observations.read(table).n_bins == 22


def test_a_calibration_brings_its_instrument(tmp_path, capsys):
    irdis, band = instruments.get("irdis"), [1.625] * u.um
    frames, chain = half_wave_plate_cycles(derotator=[10, 35, 60] * u.deg), irdis.chain
    meta = irdis.published_meta() | {"date": "2018-03-20"}
    lamp = simulate(chain(wavelength=band), band, frames, seed=1, meta=meta)
    cal = calibrate(chain(wavelength=band), lamp, instrument="irdis", cross_validate=False)
    cal.write(tmp_path / "cal.asdf")
    argv = ["-o", tmp_path / "x.ecsv", "--calibration", tmp_path / "cal.asdf", "--no-noise"]
    argv += [*STAR, "--derotator", "20"]
    assert simulated(*argv) == 0
    found = Observations.read(tmp_path / "x.ecsv")
    # behind the mirrors of its own telescope, of that day
    sky = irdis.on_sky(cal.chain, wavelength=band, date="2018-03-20")
    positions = irdis.positions(found, sky)
    right, left = measurement_rows(sky, positions, band)[:, 0, :, 0]
    np.testing.assert_allclose(found.flux_right[:, 0] / found.flux_left[:, 0], right / left)
    assert simulated(*argv, "--instrument", "charis") == 2
    assert "calibration is of instrument 'irdis', not 'charis'" in capsys.readouterr().err


def test_nonsense_is_refused_with_one_line(tmp_path, monkeypatch, capsys):
    for argv, words in [
        ([], "nothing to write"),
        (["-o", "x.ecsv", "--source", "star", "--altitude", "60"], "needs --parallactic"),
        (["-o", "x.ecsv", *STAR, "--altitude", "1,2,3"], "needs --altitude"),
        (["-o", "x.ecsv", "--altitude", "60"], "is for --source star"),
        (["-o", "x.ecsv", "--halo", "0.1"], "--halo 0.1 needs --cubes DIR"),
        (["-o", "x.ecsv", "--bad-pixels", "0.1"], "--bad-pixels 0.1 needs --cubes DIR"),
        (["-o", "x.ecsv", "--psf", "gaussian"], "--psf gaussian needs --cubes DIR"),
        (["-o", "x.ecsv", "--saturate"], "--saturate needs --cubes DIR"),
        (["-o", "x.ecsv", "--seed", "-1"], "seed = -1; allowed are whole numbers from 0 up"),
        (["--cubes", "cubes", *TWO, "--seed", "-1"], "seed = -1; allowed are"),
        (["-o", "x.ecsv", "--instrument", "gpi"], "begins on sky; give --source star"),
        (["-o", "x.fits"], "-o x.fits: the name must end with .ecsv"),
        (["--cubes", "missing/cubes", *TWO], "no folder"),
        (["--cubes", "cubes", *TWO, "--halo", "2"], "halo = 2"),
        (["--cubes", "cubes", *TWO, "--fwhm", "0"], "fwhm = 0"),
        (["--cubes", "cubes", *STAR, "--flux", "-1"], "flux"),
        (["-o", "x.ecsv", "--flux", "-1"], "flux"),
        (["-o", "x.ecsv", "--gain", "0"], "gain"),
        (["-o", "x.ecsv", "--read-noise", "-2"], "read_noise"),
        (["-o", "x.ecsv", "--calibration", "missing.asdf"], "missing.asdf"),
    ]:
        monkeypatch.chdir(tmp_path)
        assert simulated(*argv) == 2, (argv, words)
        (complaint,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
        assert words in complaint, (argv, words)
        assert not list(tmp_path.iterdir()), (argv, words)


def test_cubes_are_not_written_over_others(tmp_path, capsys):
    argv = ["--cubes", tmp_path / "cubes", *TWO]
    assert simulated(*argv) == 0
    assert simulated(*argv) == 2
    # an argument of Python is no way out in a terminal
    assert "exists already; remove it, name another" in capsys.readouterr().err


# IRDIS says that the telescope's mirrors are those of today
@pytest.mark.filterwarnings("ignore:irdis. neither date nor coating")
def test_its_tables_say_what_chain_is_theirs(tmp_path):
    for name in ("charis", "irdis", "vampires"):
        tables = [tmp_path / f"{name}_{source}.ecsv" for source in ("lamp", "star")]
        assert simulated("-o", tables[0], "--instrument", name, "--derotator", "50,65,80") == 0
        assert simulated("-o", tables[1], "--instrument", name, *STAR, "--derotator", "97") == 0
        lamp, star = instruments.get(name).chains_for([Observations.read(t) for t in tables])
        assert "parallactic" in stages(star), name
        assert "parallactic" not in stages(lamp), name


# an internal source and an unpolarized star do not tell where north is
@pytest.mark.filterwarnings("ignore:the calibration does not determine")
# nor do so few frames the sign of the derotator at one wavelength
@pytest.mark.filterwarnings("ignore:systematic errors do not count another solution")
@pytest.mark.long
def test_the_defaults_of_one_command_are_good_input_for_the_next(tmp_path, monkeypatch):
    for name, derotator in [("charis", "50,65,80,95"), ("vampires", "45,60,90")]:
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        cycle, own = ["--hwp", "0,45,22.5,67.5"], ["--instrument", name]
        raw = {"charis": lambda folder: ["--raw", f"{folder}/raw"]}.get(name, lambda folder: [])
        assert simulated("--cubes", "lamp", *own, *cycle, "--derotator", derotator) == 0, name
        assert main(["reduce", "lamp", *raw("lamp"), *own, "-o", "lamp.ecsv"]) == 0, name
        assert simulated("--cubes", "star", *own, *STAR, "--derotator", "97") == 0, name
        assert (
            main(["reduce", "star", *raw("star"), *own, "--source", "star", "-o", "star.ecsv"]) == 0
        ), name
        layout = instruments.get(name).files
        for source in ("lamp", "star"):
            assert not Observations.read(f"{source}.ecsv").mask.any(), (name, derotator)
            cubes = Path(source).glob("*.fits")
            brightest = max(np.nanmax(fits.getdata(path, layout.cube_extension)) for path in cubes)
            # of a star the noise of the brightest pixel is a percent
            assert brightest < 0.55 * layout.saturation, (name, derotator)
        assert (
            main(["calibrate", "lamp.ecsv", "star.ecsv", "--json", "c.json", "-o", "cal.asdf"]) == 0
        ), name
        assert json.loads(Path("c.json").read_text())["converged"], (name, derotator)
        raw = raw("star")
        assert (
            main(["correct", "star", *raw, *own, "--calibration", "cal.asdf", "-o", "c.fits"]) == 0
        ), name
