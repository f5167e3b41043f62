# Licensed under a 3-clause BSD style license - see LICENSE
"""What the subcommands share: places to write to, inputs, edits of the model, outputs."""

import argparse
import json
import os
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from astropolcal import Observations, instruments
from astropolcal.chain import leaves
from astropolcal.exceptions import (
    AstropolcalError,
    ChainError,
    InstrumentError,
    ObservationError,
    ParameterError,
)
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import Context
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.observations import example_table
from astropolcal.scripts._common import (
    Continued,
    Drawing,
    Folder,
    Frames,
    Input,
    Output,
    _normal,
    _value,
    check_paths,
    cube_files,
    edit_chains,
    give,
    instrument_of,
    is_quiet,
    number_or,
    numbers,
    read_datasets,
    say,
    text_type,
    wrapped,
    write_json,
)
from astropolcal.scripts.main import main


@pytest.fixture
def locked(tmp_path, monkeypatch):
    """A folder that the system says may not be written to, as it says nothing to root."""
    folder = tmp_path / "locked"
    folder.mkdir()
    real = os.access

    def access(path, mode):
        return False if Path(path) == folder and mode & os.W_OK else real(path, mode)

    monkeypatch.setattr(os, "access", access)
    return folder


@pytest.fixture
def chains():
    """Two chains of CHARIS that share no optic object."""
    charis = instruments.get("charis")
    return [charis.chain(source, ["nbs"]) for source in ("polarized", "unpolarized")]


# ---- places to write to ----------------------------------------------------------------


def check(*paths, **others):
    """Check outputs that are given as options of any names, and others by name."""
    given = {f"out{i}": path for i, path in enumerate(paths)}
    check_paths(SimpleNamespace(**given, **others))


def test_good_places_for_files(tmp_path, monkeypatch):
    (tmp_path / "old.json").write_text("old")
    (tmp_path / "link.json").symlink_to("dangling.json")
    names = ("new.json", "old.json", "link.json")
    check(*(Output(tmp_path / name) for name in names), Output("-"), Output("-"), none=None)
    monkeypatch.chdir(tmp_path)
    check(Output("new.json"), Output("./old.json"), Output("/dev/null"), Output("/dev/null"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "old.json"]


def test_bad_places_for_files(tmp_path, locked):
    (tmp_path / "note.txt").write_text("")
    (tmp_path / "to_locked.json").symlink_to("locked/new.json")
    for place, words in [
        ("no/x.json", "no/x.json: there is no folder .*no"),
        (".", "is a folder, not a file"),
        ("note.txt/x.json", "there is no folder .*note.txt"),
        ("locked/x.json", "locked/x.json: no permission to write to .*locked; name a folder that"),
        ("to_locked.json", "to_locked.json: no permission to write to .*locked"),
        ("n" * 256, "nnn: cannot be written: File name too long"),
        ("a\0b", "cannot be written: it is not the name of a file .embedded null byte"),
    ]:
        with pytest.raises(AstropolcalError, match=words):
            check(Output(tmp_path / "good.json"), Output(tmp_path / place))


def test_a_figure_in_no_known_format_is_refused_before_anything_runs(tmp_path):
    check(Drawing(tmp_path / "a.pdf"))
    with pytest.raises(AstropolcalError, match=r"the name must end with \.png"):
        check(Drawing(tmp_path / "a.bmp"))


def test_good_places_for_folders(tmp_path, monkeypatch):
    (tmp_path / "old").mkdir()
    check(*(Folder(tmp_path / name) for name in ("old", "new", "a/b/c")))
    monkeypatch.chdir(tmp_path)
    check(Folder("new"), Folder("a/b"))
    # only looked at, not made
    assert [p.name for p in tmp_path.iterdir()] == ["old"]


def test_bad_places_for_folders(tmp_path, locked):
    for place, words in [
        ("note.txt", "note.txt: is a file, not a folder"),
        ("note.txt/figures/all", "note.txt: is a file, not a folder"),
        ("locked", "locked: no permission to write to .*locked"),
        ("locked/figures", "locked/figures: no permission to write to .*locked; name a folder"),
        ("locked/figures/all", "locked/figures/all: no permission"),
        ("new/" + "n" * 256, "nnn: cannot be written: File name too long"),
        ("new/a\0b", "cannot be written: it is not the name of a file"),
    ]:
        (tmp_path / "note.txt").write_text("")
        with pytest.raises(AstropolcalError, match=words):
            check(Folder(tmp_path / place))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_what_cannot_be_an_input(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place, words in (
        ("pipe", "pipe: is a pipe; a regular file is needed"),
        ("/dev/zero", "/dev/zero: is a device; a regular file is needed"),
        ("n" * 256, "nnn: cannot be read: File name too long"),
        ("a\0b", "cannot be read: it is not the name of a file"),
    ):
        with pytest.raises(AstropolcalError, match=words):
            check(files=[Input(tmp_path), Input(tmp_path / place)])
    # its reader says what is wanted
    check(file=Input(tmp_path / "no.ecsv"))


# ---- outputs that are inputs, or one another -------------------------------------------


def test_outputs_that_would_overwrite_something(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("run.ecsv", "cubes/a.fits", "cubes/b.FIT", "lib/one.asdf", "elsewhere.fits"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("x")
    Path("link.ecsv").symlink_to("run.ecsv")
    Path("dangling.json").symlink_to("new.json")
    Path("folder").symlink_to("cubes", target_is_directory=True)
    os.link("run.ecsv", "hard.ecsv")
    os.link("cubes/a.fits", "hard.fits")
    Path("cubes/far.fits").symlink_to("../elsewhere.fits")
    table, frames, library = Input("run.ecsv"), Frames("cubes"), Input("lib")
    taken = [
        (table, ["run.ecsv", "./lib/../run.ecsv", "link.ecsv", "hard.ecsv", tmp_path / "run.ecsv"]),
        (frames, ["cubes/a.fits", "folder/a.fits", "cubes/b.FIT", "hard.fits", "elsewhere.fits"]),
        # the next run would take them for frames
        (frames, ["cubes/new.fits", "folder/new.fits.gz"]),
        (library, ["lib/one.asdf", "lib/new.asdf"]),
    ]
    for source, outputs in taken:
        for path in outputs:
            with pytest.raises(AstropolcalError, match=f"^--json {path}: .*{source}"):
                check(files=[Input("other.ecsv"), source], json=Output(path))
    for path in ("cubes/run.ecsv", "cubes/raw/a.fits", "new.fits", "lib/one.json"):
        Path(path).parent.mkdir(exist_ok=True)
        check(files=[table, frames, library], json=Output(path), plots=Folder("cubes"))
    for one, other in (
        (Output("x"), Output("./x")),
        (Output("new.json"), Output("dangling.json")),
        (Output("run.ecsv"), Output("hard.ecsv")),
        (Output("x.png"), Folder("x.png")),
        (Output("x"), Folder("x/figures")),
        (Output("cubes/residuals.png"), Folder("folder")),
        (Continued("x.h5"), Output("x.h5")),
    ):
        for first, second in ((one, other), (other, one)):
            with pytest.raises(AstropolcalError, match=f"^-o {second}: .* --json {first}"):
                check(json=first, output=second)
    # files of left beams are read with those of the right ones, which are named
    Path("a_cam1.fits").write_text("x")
    with pytest.raises(AstropolcalError, match=r"^--json a_cam2\.fits: would overwrite"):
        check(cubes=[Frames("a_cam1.fits")], json=Output("a_cam2.fits"))
    check(cubes=[Frames("a_cam1.fits")], json=Output("b_cam2.fits"))
    # what a command goes on with is no input that it would overwrite
    check(files=[table], resume=Continued("old.h5"), output=Output("x"), plots=Folder("figures"))


# ---- what is printed and written -------------------------------------------------------


def test_who_prints(capsys):
    for quiet, to, silent in [
        (False, None, False),
        (True, None, True),
        (False, "-", True),
        (False, "x.json", False),
    ]:
        arguments = SimpleNamespace(quiet=quiet, json=to)
        assert is_quiet(arguments) == silent, (quiet, to, silent)
        say(arguments, "words")
        assert capsys.readouterr().out == ("" if silent else "words\n"), (quiet, to, silent)


def test_json_is_complete_and_has_null_for_what_is_no_finite_number(tmp_path, capsys):
    write_json({"a": [1.5, None]}, tmp_path / "x.json")
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": [1.5, None]}
    write_json({"a": 1}, "-")
    assert json.loads(capsys.readouterr().out) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]
    given = {1: np.array([[1.5, np.nan]]), "b": (np.float32(2), np.inf), "c": Path("x\ny")}
    write_json(given | {"d": [np.bool_(True), np.int64(3), None, "é"]}, "-")
    told = json.loads(capsys.readouterr().out)
    assert told["1"] == [[1.5, None]]
    assert told["b"] == [2.0, None]
    # text for a path, in one line
    assert told["c"] == "x y"
    assert told["d"] == [True, 3, None, "é"]


def test_files_are_listed_a_line_each(capsys):
    arguments = SimpleNamespace(quiet=False, json=None)
    give(arguments, ["words"], {}, "a.asdf", None, "b\n\x1b[2J.json", "-")
    give(arguments, ["words"], {}, None)
    written = "\nWritten:    a.asdf\nWritten:    b ?[2J.json\n"
    assert capsys.readouterr().out == f"words\n{written}words\n"


def test_lines_break_at_80_columns_and_words_stay_whole():
    text = wrapped("  " + "word " * 30 + "x" * 90, indent=4)
    lines = text.splitlines()
    assert max(map(len, lines[:-1])) <= 80
    assert all(line.startswith("    ") for line in lines[1:])
    assert lines[-1].strip() == "x" * 90


# ---- values of options -----------------------------------------------------------------


def test_lists_of_numbers_and_words_or_a_number():
    angles = text_type("a list of angles in degree", numbers)
    assert angles("0,22.5,-45") == [0.0, 22.5, -45.0]
    for text in ("", "0,", "a", "0;45", "0,nan"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a list of angles in degree"):
            angles(text)
    assert text_type("X,Y", numbers, 2)("69.9, 1e2") == [69.9, 100.0]
    with pytest.raises(argparse.ArgumentTypeError, match="'7' is not X,Y"):
        text_type("X,Y", numbers, 2)("7")
    convert = number_or("fwhm", "growth")
    assert [convert("growth"), convert("3e1")] == ["growth", 30.0]
    with pytest.raises(argparse.ArgumentTypeError, match="'wide' is not fwhm, growth or a number"):
        convert("wide")


# ---- inputs ----------------------------------------------------------------------------


def test_folders_stand_for_their_fits_files(tmp_path):
    for name in ("b.fits", "a.fits.gz", "c.txt"):
        (tmp_path / name).touch()
    found = cube_files([tmp_path, tmp_path / "c.txt"])
    assert [path.name for path in found] == ["a.fits.gz", "b.fits", "c.txt"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(AstropolcalError, match="empty: no FITS file in this folder"):
        cube_files([tmp_path, tmp_path / "empty"])


@pytest.fixture
def table(tmp_path):
    """Function that writes a table of an instrument."""

    def write(instrument="charis", name="run.ecsv", **options):
        known = example_table(**options)
        known.meta["instrument"] = instrument
        if instrument is None:
            del known.meta["instrument"]
        known.write(tmp_path / name, format="ascii.ecsv", overwrite=True)
        return tmp_path / name

    return write


def test_same_frames_under_another_name_are_refused(table):
    files = table(), table(name="copy.ecsv"), table(name="other.ecsv", polarization=0.31)
    assert [d.name for d in read_datasets([files[0], files[2]])] == ["run", "other"]
    with pytest.raises(AstropolcalError, match=r"copy.ecsv: holds the same frames as .*run.ecsv"):
        read_datasets(files)


def test_files_that_are_no_tables(tmp_path, table):
    """Calibrations and cubes are sent to their commands; others are judged by the reader."""
    path = tmp_path / "cal.asdf"
    path.write_bytes(b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n")
    words = (
        r"cal.asdf: is an ASDF file, such as a calibration, where an observation table .*--start"
    )
    with pytest.raises(AstropolcalError, match=words) as caught:
        read_datasets([table(), path])
    for command in ("info", "diagnose", "sample", "efficiency", "correct --calibration"):
        assert command in str(caught.value)
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(tmp_path / "cube.fits")
    with pytest.raises(AstropolcalError, match=r"cube.fits: is a FITS file, .*; reduce makes one"):
        read_datasets([tmp_path / "cube.fits"])
    for content, words in [(b"", "not an ECSV table"), (b"hello", "not an")]:
        (tmp_path / "x.ecsv").write_bytes(content)
        with pytest.raises(ObservationError, match=words):
            read_datasets([tmp_path / "x.ecsv"])
        with pytest.raises(ObservationError, match="no such file"):
            read_datasets([tmp_path / "y.ecsv"])


def instrument(path, given=None):
    datasets = [Observations.read(path)]
    return instrument_of(SimpleNamespace(instrument=given), datasets).name


def test_instrument_that_is_given_goes_before_that_of_the_table(table):
    assert instrument(table("charis")) == "charis"
    assert instrument(table("SCExAO/CHARIS"), "irdis") == "irdis"
    assert instrument(table(None), "charis") == "charis"


def test_instrument_that_is_unknown_or_not_told(table):
    words = r"run.ecsv: unknown instrument 'charix'; .*did you mean 'charis'\?; --instrument NAME"
    with pytest.raises(InstrumentError, match=words):
        instrument(table("charix"))
    # that of the user is in no file
    with pytest.raises(InstrumentError, match=r"^unknown instrument 'irdi'"):
        instrument(table("charis"), "irdi")
    with pytest.raises(InstrumentError, match="run: the table names no instrument; give --instr"):
        instrument(table(None))


# ---- edits of the model ----------------------------------------------------------------


def parameter(chain, name):
    optic, _, key = name.partition(".")
    (leaf,) = (leaf for leaf in leaves(chain) if leaf.name == optic)
    return getattr(leaf, key)


def test_edits_reach_all_chains(chains):
    edited = edit_chains(
        chains, free=["wollaston.theta"], fix=["hwp.theta=6arcmin", "derotator"],
        prior=["hwp.w_sio2=1.65+-0.01"],
    )  # fmt: skip
    for chain in edited:
        assert not parameter(chain, "wollaston.theta").fixed
        assert parameter(chain, "hwp.theta").fixed
        assert parameter(chain, "hwp.theta").value == pytest.approx(0.1)
        assert all(parameter(chain, f"derotator.{key}").fixed for key in ("theta", "horizontal"))
        assert not parameter(chain, "hwp.w_sio2").fixed
        prior = parameter(chain, "hwp.w_sio2").prior
        assert prior.mean == 1.65 * u.mm
        assert prior.std == 0.01 * u.mm


def test_an_optic_that_only_one_chain_has_may_be_taken_out(chains):
    names = [{leaf.name for leaf in leaves(chain)} for chain in chains]
    (only,) = names[0] - names[1]
    edited = edit_chains(chains, without=[only])
    assert only not in {leaf.name for leaf in leaves(edited[0])}
    assert edited[1] is chains[1]
    with pytest.raises(ChainError, match="no optic 'nobody' in the chain"):
        edit_chains(chains, without=["nobody"])


def test_an_effect_goes_with_the_rotations_around_it(chains):
    effect = CellEffect(Cell("in:derotator", "retardance_h", "constant"), 0)
    added = effect.edit(chains, Context(np.array([1.2, 1.6]))).chains
    names = [[leaf.name for leaf in leaves(chain)] for chain in (chains[0], added[0])]
    into, own, out_of = (name for name in names[1] if name not in names[0])
    assert (into, out_of) == (f"{own}_in", f"{own}_out")
    edited = edit_chains(added, without=[own])
    assert [leaf.name for leaf in leaves(edited[0])] == names[0]


def test_bad_edits(chains):
    for edit, error, words in [
        ({"fix": ["nobody.theta=0"]}, ChainError, "no optic 'nobody'"),
        ({"free": ["hwp.phi"]}, ParameterError, "hwp has no parameter 'phi'; it has "),
        ({"fix": ["hwp.theta=6"]}, ParameterError, r"hwp.theta=6: allowed is -5.0 to 5.0 deg"),
        ({"fix": ["hwp.w_sio2=-1mm"]}, ParameterError, r"allowed is 0\.980388 to 2\.287572 mm"),
        ({"fix": ["hwp.theta=nan"]}, ParameterError, "hwp.theta=nan: not a number"),
        ({"prior": ["hwp.theta"]}, ParameterError, r"prior hwp.theta=: write it as MEAN\+-STD"),
        ({"prior": ["hwp.theta=0+-1s"]}, ParameterError, "its unit is not convertible to deg"),
        ({"prior": ["hwp.theta=x+-1"]}, ParameterError, "hwp.theta=x: not a number"),
    ]:
        with pytest.raises(error, match=words):
            edit_chains(chains, **edit)


def test_numbers_with_and_without_unit(chains):
    for text, value in [
        ("1.5", 1.5),
        (" -2e-1 ", -0.2),
        ("90arcmin", 1.5),
        ("0.5 deg", 0.5),
        ("1e-1deg", 0.1),
        (f"{np.pi}rad", 180.0),
    ]:
        assert _value("hwp.theta", parameter(chains[0], "hwp.theta"), text) == pytest.approx(
            value
        ), text
    # what is no number of that unit
    for text in ["", "1,5", "deg", "1 2", "1..2", "--1", "1 nonsense", "1 s"]:
        with pytest.raises(ParameterError, match=r"hwp\.theta="):
            _value("hwp.theta", parameter(chains[0], "hwp.theta"), text)


def test_a_unit_given_once_holds_for_mean_and_std(chains):
    for text, mean, std in [
        ("0+-0.1deg", 0.0, 0.1),
        ("1+-6arcmin", 1 / 60, 0.1),
        ("1deg+-6arcmin", 1.0, 0.1),
        ("-0.5+-0.1", -0.5, 0.1),
        ("1e-1+-1e-2", 0.1, 0.01),
    ]:
        prior = _normal("hwp.theta", parameter(chains[0], "hwp.theta"), text)
        assert prior.mean.to_value(u.deg) == pytest.approx(mean), (text, mean, std)
        assert prior.std.to_value(u.deg) == pytest.approx(std), (text, mean, std)


def test_a_value_is_of_one_parameter():
    """One value for theta and retardance is what nobody means."""
    charis = instruments.get("charis")
    chains = [charis.chain(derotator="linear", wavelength=[1.2, 1.6] * u.um)]
    for options in ({"fix": ["derotator=3deg"]}, {"prior": ["derotator=0+-1deg"]}):
        with pytest.raises(ParameterError, match=r"of derotator.theta, derotator.retardance"):
            edit_chains(chains, **options)
    edit_chains(chains, fix=["derotator"])
    assert chains[0]["derotator"].theta.fixed
    assert chains[0]["derotator"].retardance.fixed


def test_the_table_of_options_says_what_goes_together(capsys):
    for argv, words in [
        (["simulate", "-o", "x.ecsv", "--halo", "0.1"], "--halo 0.1 needs --cubes DIR"),
        (["standards", "--site", "subaru"], "--site subaru needs --night YYYY-MM-DD"),
        (["standards", "HD 30675", "--limit", "2"], "--limit 2 cannot be combined with NAME"),
        (["info", "x.asdf", "--instruments"], "--instruments cannot be combined with FILE|DIR"),
        (["calibrate", "--start", "a.asdf", "--fix", "hwp"], "--fix cannot be combined with --sta"),
        # what is typed as it is without being typed contradicts nothing
        (["simulate", "-o", "nowhere/x.ecsv", "--halo", "0"], "there is no folder nowhere"),
    ]:
        assert main(argv) == 2, argv
        assert words in capsys.readouterr().err, argv
