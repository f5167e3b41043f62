# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal reduce`` without cubes: what is said of a run, and options that do not fit."""

from types import SimpleNamespace

import pytest

from astropolcal.exceptions import AstropolcalError
from astropolcal.scripts._reduce import _by_reason, _options, _report

DOUBT = "no keyword RET-POS1: the tracking of the half-wave plate was not checked"


class Reduced:
    """As much of a reduction as a report reads."""

    def __init__(self, n_problems=0, doubts=None, flags=None, n_frames=2):
        self.problems = {f"night/a{i:02d}.fits": ["no star", "old"] for i in range(n_problems)}
        self.doubts = doubts or {}
        self.flags, self.n_frames = flags or {}, n_frames

    def summary(self):
        return {
            "n_frames": self.n_frames, "n_cells": 4 * self.n_frames,
            "n_masked": sum(self.flags.values()), "flags": self.flags,
        }  # fmt: skip


def said(capsys, reduction, figures=(), **options):
    arguments = {"output": "run.ecsv", "quiet": False, "json": None, "quicklook": "look"} | options
    _report(reduction, SimpleNamespace(**arguments), figures)
    return capsys.readouterr()


def test_run_without_fault_is_one_line(capsys):
    assert said(capsys, Reduced()) == ("Written: run.ecsv (2 frames, 0 of 8 cells masked)\n", "")
    assert said(capsys, Reduced(n_frames=1)).out.startswith("Written: run.ecsv (1 frame, 0 of 4 c")


def test_masked_cells_and_figures_are_counted(capsys):
    out = said(capsys, Reduced(flags={"saturated": 3, "edge": 1}), ["a.png"]).out
    assert out.splitlines() == [
        "Written: run.ecsv (2 frames, 4 of 8 cells masked)",
        "  masked, saturated: 3 cells",
        "  masked, edge: 1 cell",
        "Figures: look (1 file)",
    ]


@pytest.mark.parametrize(
    ("n", "listed", "last"),
    [
        (1, 1, "astropolcal: left out: a00.fits: no star; old"),
        (20, 20, "astropolcal: left out: a19.fits: no star; old"),
        (21, 20, "astropolcal: left out: 1 more file (--json lists all)"),
        (25, 20, "astropolcal: left out: 5 more files (--json lists all)"),
    ],
)
@pytest.mark.parametrize("quiet", [False, True])
def test_what_is_left_out_is_listed_up_to_a_limit(capsys, n, listed, last, quiet):
    out, err = said(capsys, Reduced(n), quiet=quiet)
    lines = err.splitlines()
    assert sum("no star; old" in line for line in lines) == listed
    assert lines[-1] == last
    assert (out == "") == quiet


def test_doubts_are_counted_by_reason(capsys):
    doubts = {"a": [DOUBT, "odd"], "b": [DOUBT], "c": [DOUBT]}
    assert _by_reason(doubts) == {DOUBT: 3, "odd": 1}
    assert said(capsys, Reduced(doubts=doubts)).err.splitlines() == [
        f"astropolcal: doubtful: 3 files: {DOUBT}",
        "astropolcal: doubtful: 1 file: odd",
    ]


def test_json_on_the_standard_output_is_alone(capsys):
    out, err = said(capsys, Reduced(1), json="-")
    assert out == ""
    assert "left out" in err


# ---- options -----------------------------------------------------------------------------


def options(source, **given):
    known = {"background": None, "radius": None, "aperture_correction": None} | given
    return _options(SimpleNamespace(source=source, **known))


@pytest.mark.parametrize(
    ("source", "given"),
    [
        ("internal", {}),
        ("polarized", {"background": "outside"}),
        ("star", {"radius": "growth", "aperture_correction": True}),
        ("unpolarized standard star", {"radius": 12.0}),
    ],
)
def test_options_are_passed_on_if_they_were_given(source, given):
    assert options(source, **given) == given


@pytest.mark.parametrize(
    ("source", "given", "words"),
    [
        ("star", {"background": "none"}, "--background is for the internal source, not for --sou"),
        ("internal", {"radius": 3.0}, "--radius is for stars, not for --source internal"),
        (
            "unpolarized",
            {"radius": 3.0, "aperture_correction": True},
            "--aperture-correction, --radius is for stars",
        ),
    ],
)
def test_options_of_the_other_photometry_are_refused(source, given, words):
    with pytest.raises(AstropolcalError, match=words):
        options(source, **given)
