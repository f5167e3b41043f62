# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal sample``, as a person or a pipeline calls it."""

import contextlib
import io
import json
import sys

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import Calibration, instruments
from astropolcal.calibration.posterior.checkpoint import Chain
from astropolcal.scripts.main import build_parser, main
from astropolcal.simulation import half_wave_plate_cycles, simulate

for package in ("emcee", "h5py", "arviz_stats", "corner"):
    pytest.importorskip(package)

NAMES = ["hwp.w_sio2", "wollaston.efficiency[1]"]
WHAT = ["--parameters", *NAMES, "--walkers", "12", "--seed", "3"]
# one run that converges, and short ones that say that they do not
LONG, RUN = ([*WHAT, "--steps", steps] for steps in ("2400", "60"))

# as for a user: warnings are printed
pytestmark = [
    pytest.mark.slow,
    pytest.mark.samplers,
    pytest.mark.filterwarnings("default::astropolcal.exceptions.AstropolcalWarning"),
]


def make_table(path, seed, **options):
    charis = instruments.get("charis")
    wavelength = charis.wavelength[[9, 12, 16]]
    chain = charis.chain("polarized", ["nbs"], wavelength=wavelength)
    chain["wollaston"].efficiency = [0.95, 0.95, 0.95]
    frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
    meta = charis.published_meta()
    simulate(chain, wavelength, frames, seed=seed, meta=meta, **options).write(path)
    return str(path)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    return make_table(tmp_path_factory.mktemp("tables") / "small.ecsv", 5, flux=1e5)


@pytest.fixture(scope="module")
def calibration(table, tmp_path_factory):
    """A calibration file in which a prior closes an open direction."""
    path = tmp_path_factory.mktemp("calibrations") / "cal.asdf"
    options = ["--prior", "hwp.theta=0+-0.1deg", "--fix", "derotator.theta=0"]
    assert main(["calibrate", table, "-q", "-o", str(path), *options]) == 0
    return str(path)


@pytest.fixture(scope="module")
def sampled(calibration, table, tmp_path_factory):
    """All that a run writes, and prints."""
    folder = tmp_path_factory.mktemp("sampled")
    outputs = ["-o", folder / "out.asdf", "--json", folder / "out.json", "--plots", folder / "p"]
    argv = ["sample", calibration, table, *LONG, *map(str, outputs)]
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        # the figures are made, but not painted, which takes most of the time
        patch.setattr(Figure, "savefig", lambda self, path, **_: path.write_bytes(b"painted"))
        assert main(argv) == 0
    (folder / "out.txt").write_text(out.getvalue())
    return folder


def fails(capsys, *argv):
    """Run the command on bad input; return its one line of complaint."""
    try:
        status = main(["sample", *map(str, argv)])
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2
    assert "Traceback" not in error
    (complaint,) = [line for line in error.splitlines() if "error" in line]
    return complaint


# ---- what comes out ------------------------------------------------------------------


@pytest.mark.slow
def test_samples_stay_with_the_calibration(sampled, calibration):
    again = Calibration.read(sampled / "out.asdf")
    assert again.posterior.names == NAMES
    assert again.posterior.converged
    before = Calibration.read(calibration).to_dict()
    assert before.pop("posterior") is None
    after = again.to_dict()
    assert {key: after[key] for key in before} == before


def test_samples_are_about_the_fit_and_as_wide_as_is_known_otherwise(sampled, calibration, table):
    """Two parameters alone: the inverse of their part of the normal matrix."""
    from astropolcal import Observations

    posterior = Calibration.read(sampled / "out.asdf").posterior
    cal = Calibration.read(calibration).with_observations(Observations.read(table))
    live = cal.measurement
    rows = [live.free.names.index(name) for name in NAMES]
    sigma = np.sqrt(np.sum(cal.residuals**2) / (live.n_data - live.free.size))
    part = live.jacobian(live.vector())[rows] / sigma
    expected = np.sqrt(np.diag(np.linalg.inv(part @ part.T))) / live.free.factors()[rows]
    # the noise of three wavelengths is not the same
    np.testing.assert_allclose(posterior.convergence.std, expected, rtol=0.3)
    assert np.abs((posterior.convergence.median - posterior.fitted) / expected).max() < 1.5


@pytest.mark.slow
def test_json_has_the_calibration_and_its_posterior(sampled, calibration):
    content = json.loads((sampled / "out.json").read_text())
    assert content["n_free"] == len(Calibration.read(calibration).covariance)
    posterior = content["posterior"]
    assert set(posterior) == {
        "converged", "words", "n_steps", "n_walkers", "burn_in", "n_samples", "acceptance", "seed",
        "settings", "parameters",
    }  # fmt: skip
    assert posterior["converged"]
    assert (posterior["n_steps"], posterior["n_walkers"], posterior["seed"]) == (2400, 12, 3)
    assert list(posterior["parameters"]) == NAMES
    entry = posterior["parameters"]["hwp.w_sio2"]
    assert entry["unit"] == "mm"
    assert entry["lower"] < entry["median"] < entry["upper"]
    assert entry["r_hat"] < 1.05
    assert min(entry["ess_bulk"], entry["ess_tail"]) > 400
    settings = posterior["settings"]
    assert settings["priors"] == [
        {"parameter": "hwp.theta", "unit": "deg", "distribution": "norm", "mean": 0, "std": 0.1}
    ]
    assert "hwp.theta" in settings["held"]
    assert not set(settings["held"]) & set(NAMES)
    assert 0 < settings["noise"]["least"] <= settings["noise"]["largest"] < 0.1


def test_figures_have_those_of_the_posterior(sampled):
    found = {path.name for path in (sampled / "p").iterdir()}
    # the data are there too
    assert {"corner.png", "residuals.png", "accuracy.png"} <= found


@pytest.mark.slow
def test_words_and_table_on_the_terminal(sampled):
    text = (sampled / "out.txt").read_text()
    lines = text.splitlines()
    assert "2400 steps of 12 walkers in 2 parameters." in lines
    assert any(line.startswith("R-hat is 1.0") for line in lines)
    assert "NOT CONVERGED" not in text
    (row,) = [line.split() for line in lines if line.startswith("hwp.w_sio2")]
    median, lower, upper, fitted = map(float, row[1:5])
    assert lower < median < upper
    assert lower - 0.01 < fitted < upper + 0.01
    assert row[5] == "mm"
    assert "1 value given per wavelength is in the file" in text
    assert f"Written:    {sampled / 'out.asdf'}" in text


@pytest.mark.slow
def test_short_run_warns_and_says_so_in_the_file(calibration, table, capsys, tmp_path):
    out = tmp_path / "out.asdf"
    assert main(["sample", calibration, table, *RUN, "-q", "-o", str(out)]) == 0
    assert "warning: the chain is shorter than 50 autocorrelation times" in capsys.readouterr().err
    posterior = Calibration.read(out).posterior
    assert not posterior.converged
    assert "NOT CONVERGED" in posterior.words()


def test_json_on_the_standard_output_is_nothing_but_json(calibration, table, capsys):
    assert main(["sample", calibration, table, *RUN, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["posterior"]["n_steps"] == 60


@pytest.mark.slow
def test_quiet_prints_nothing_but_warnings(calibration, table, capsys):
    assert main(["sample", calibration, table, *RUN, "-q"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1


def test_all_free_parameters_by_default(calibration, table, tmp_path):
    out = tmp_path / "out.asdf"
    argv = [calibration, table, "-q", "--steps", "40", "--seed", "1", "-o", str(out)]
    assert main(["sample", *argv]) == 0
    again = Calibration.read(out)
    assert again.posterior.names == again.covariance.names
    assert again.posterior.chain.shape[1] == max(2 * len(again.covariance), 24)


@pytest.mark.slow
def test_burn_in(calibration, table, tmp_path):
    """A run as short as this leaves out half of itself."""
    for text, expected in [("17", 17), ("auto", 30)]:
        out = tmp_path / "out.asdf"
        assert (
            main(["sample", calibration, table, *RUN, "-q", "-o", str(out), "--burn", text]) == 0
        ), text
        assert Calibration.read(out).posterior.convergence.burn_in == expected, (text, expected)


@pytest.mark.slow
def test_reader_that_goes_away_does_not_cost_the_samples(calibration, table, tmp_path, monkeypatch):
    def gone(*_):
        raise BrokenPipeError

    out = tmp_path / "out.asdf"
    monkeypatch.setattr("astropolcal.scripts._sample._words", gone)
    arguments = build_parser().parse_args(["sample", calibration, table, *RUN, "-o", str(out)])
    with pytest.raises(BrokenPipeError):
        arguments.run(arguments)
    assert Calibration.read(out).posterior.names == NAMES


def test_file_may_be_replaced_by_itself(calibration, table, tmp_path):
    path = tmp_path / "cal.asdf"
    Calibration.read(calibration).write(path)
    assert main(["sample", str(path), table, *RUN, "-q", "-o", str(path)]) == 0
    assert Calibration.read(path).posterior.names == NAMES
    # and sampled again
    assert main(["sample", str(path), table, *RUN, "-q", "-o", str(path)]) == 0


@pytest.mark.slow
def test_two_tables_in_any_order(tmp_path):
    tables = [make_table(tmp_path / f"{i}.ecsv", i) for i in (1, 2)]
    path = tmp_path / "both.asdf"
    assert main(["calibrate", *tables, "-q", "-o", str(path)]) == 0
    assert main(["sample", str(path), *tables[::-1], "-q", *RUN, "-o", str(path)]) == 0
    assert Calibration.read(path).posterior.names == NAMES


def test_info_of_a_file_with_samples(sampled, capsys):
    assert main(["info", str(sampled / "out.asdf")]) == 0
    assert "Calibration of charis from small" in capsys.readouterr().out


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_missing_corner_costs_one_figure(calibration, table, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "corner", None)
    folder = tmp_path / "p"
    argv = ["sample", calibration, table, *RUN, "-q", "--plots", str(folder)]
    assert main(argv) == 0
    error = capsys.readouterr().err
    assert "corner.png is not drawn: the corner plot needs the package corner" in error
    assert 'pip install "astropolcal[mcmc]"' in error
    names = {path.name for path in folder.iterdir()}
    assert "correlations.png" in names
    assert "corner.png" not in names


# ---- interrupted ---------------------------------------------------------------------


def interrupt_after(patch, count):
    append = Chain.append

    def interrupted(self, *args):
        append(self, *args)
        if self.count == count:
            raise KeyboardInterrupt

    patch.setattr(Chain, "append", interrupted)


@pytest.mark.slow
def test_interrupted_run_goes_on(calibration, table, tmp_path, capsys):
    checkpoint = tmp_path / "run.h5"
    whole = ["sample", calibration, table, *RUN, "-q"]
    argv = [*whole, "--checkpoint", str(checkpoint)]
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, 33)
        assert main([*argv, "-o", str(tmp_path / "out.asdf")]) == 130
    error = capsys.readouterr().err
    assert f"the steps so far are in {checkpoint}; the same command with --resume" in error
    assert not (tmp_path / "out.asdf").exists()
    assert main([*argv, "--resume", "-o", str(tmp_path / "out.asdf")]) == 0
    assert main([*whole, "-o", str(tmp_path / "whole.asdf")]) == 0
    first, second = (Calibration.read(tmp_path / f"{n}.asdf").posterior for n in ("out", "whole"))
    assert first == second


@pytest.mark.slow
def test_resume_without_a_checkpoint_yet_begins_one(calibration, table, tmp_path):
    checkpoint = tmp_path / "run.h5"
    argv = ["sample", calibration, table, *RUN, "-q", "--checkpoint", str(checkpoint), "--resume"]
    assert main(argv) == 0
    assert checkpoint.exists()
    # a longer run goes on from a finished one
    longer = ["80" if text == "60" else text for text in argv]
    assert main([*longer, "--json", str(tmp_path / "out.json")]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["posterior"]["n_steps"] == 80


@pytest.mark.slow
def test_checkpoint_is_not_overwritten(calibration, table, tmp_path, capsys):
    checkpoint = tmp_path / "run.h5"
    checkpoint.write_bytes(b"precious")
    argv = (calibration, table, *RUN, "--checkpoint", checkpoint)
    assert "run.h5: exists already; --resume goes on" in fails(capsys, *argv)
    assert "run.h5: is not a checkpoint" in fails(capsys, *argv, "--resume")
    assert checkpoint.read_bytes() == b"precious"


def test_checkpoint_of_another_run(calibration, table, tmp_path, capsys):
    checkpoint = tmp_path / "run.h5"
    argv = ["sample", calibration, table, *RUN, "-q", "--checkpoint", str(checkpoint)]
    assert main(argv) == 0
    other = ["4" if text == "3" else text for text in argv[1:]]
    assert "differs in seed" in fails(capsys, *other, "--resume")


# ---- bad input -----------------------------------------------------------------------


@pytest.mark.slow
def test_tables_of_something_else(calibration, table, capsys, tmp_path):
    other = make_table(tmp_path / "other.ecsv", 99)
    complaint = fails(capsys, calibration, other)
    assert "other: the calibration was not made from this table, whose content hash is" in complaint
    assert "it was made from small (" in complaint
    assert "other: the calibration was not" in fails(capsys, calibration, table, other)
    assert "same frames" in fails(capsys, calibration, table, table)


def test_bad_options_get_one_line_and_status_two(calibration, table, capsys, tmp_path, monkeypatch):
    for options, complaint in [
        (["--parameters", "hwp.tilt"], "no free parameter 'hwp.tilt'"),
        (["--parameters", "derotator.theta"], "no free parameter 'derotator.theta'"),
        (["--walkers", "3"], "need a whole number from"),
        (["--walkers", "many"], "--walkers"),
        (["--steps", "0"], "--steps 0; allowed"),
        (["--steps", "100", "--burn", "99"], "--burn 99; 100 steps allow"),
        (["--burn", "-1"], "--burn -1"),
        (["--steps", "1"], "--steps 1; allowed are whole numbers from 2 up"),
        (["-o", "out.fits"], "-o out.fits: the name must end with .asdf"),
        (["--burn", "some"], "'some' is not auto or a number"),
        (["--seed", "-1"], "--seed -1"),
        (["--resume"], "--resume needs --checkpoint"),
        (["-o", "nowhere/out.asdf"], "no folder"),
        (["--json", "nowhere/out.json"], "no folder"),
        (["--checkpoint", "nowhere/run.h5"], "no folder"),
        (["--plots", __file__], "is a file, not a folder"),
    ]:
        monkeypatch.chdir(tmp_path)
        assert complaint in fails(capsys, calibration, table, *options), (options, complaint)
        assert list(tmp_path.iterdir()) == [], (options, complaint)


@pytest.mark.slow
def test_files_that_are_none(calibration, table, capsys, tmp_path):
    assert "the following arguments are required: FILE" in fails(capsys, calibration)
    assert "missing.asdf: no such file" in fails(capsys, tmp_path / "missing.asdf", table)
    assert "not an ASDF file" in fails(capsys, table, table)
    assert "missing.ecsv: no such file" in fails(capsys, calibration, tmp_path / "missing.ecsv")


def test_missing_emcee(calibration, table, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "emcee", None)
    complaint = fails(capsys, calibration, table)
    assert "sampling needs the package emcee, which is not installed" in complaint
    assert 'in a clone pip install ".[mcmc]"' in complaint
    # what can be mended without installing anything is said first
    complaint = fails(capsys, calibration, table, "--parameters", "hwp.tilt")
    assert "no free parameter 'hwp.tilt'" in complaint


@pytest.mark.slow
def test_what_only_the_summary_needs_is_missed_before_the_run(
    calibration, table, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "arviz_stats.base", None)
    assert "summary of a posterior needs the package arviz-stats" in fails(
        capsys, calibration, table
    )
