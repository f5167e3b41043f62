# Licensed under a 3-clause BSD style license - see LICENSE
"""What the gallery of models writes and draws is what the registries and the optics say."""

import json
import re
import sys
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter

import astropolcal
from astropolcal import optics
from astropolcal.gap.effects import EFFECTS
from astropolcal.optics import OPTICS

pytest.importorskip("jinja2", reason="jinja2 is not installed")
pytest.importorskip("numpydoc", reason="numpydoc is not installed")

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module", autouse=True)
def on_path():
    """The gallery is a package of the documentation and not installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(DOCS), *sys.path])
        yield


@pytest.fixture(scope="module")
def pages(on_path):
    from gallery import pages

    return pages


@pytest.fixture(scope="module")
def build(on_path):
    from gallery import build

    return build


@pytest.fixture(scope="module")
def drawings(on_path):
    from gallery import drawings

    return drawings


@pytest.fixture
def pyplot():
    plt = pytest.importorskip("matplotlib.pyplot")
    yield plt
    plt.close("all")


# --- words of the pages -----------------------------------------------------------------


def test_bounds_in_words(pages):
    for bounds, words in [
        ((None, None), "none"),
        ((0, None), "from 0"),
        ((None, 2.5), "up to 2.5"),
        ((-5, 5), "-5 to 5"),
    ]:
        assert pages._bounds(Parameter(default=1, bounds=bounds)) == words, (bounds, words)


def test_sizes_in_words(pages):
    for value, words in [(0.004, "0.4 %"), (2 * u.deg, "2 deg"), (30 * u.nm, "30 nm")]:
        assert pages._quantity(value) == words, (value, words)


def test_laws_in_words(pages):
    for columns, words in [
        (1, "one number"),
        (2, "polynomial of degree 1 in wavelength"),
        (4, "polynomial of degree 3 in wavelength"),
        (22, "one value per wavelength"),
    ]:
        from astropolcal.gap.problem import law_basis

        grid = np.linspace(1.2, 2.4, 22)
        basis = law_basis(grid, columns - 1) if columns < 22 else np.eye(22)
        assert pages._law(basis, True, grid) == words, (columns, words)


def test_laws_that_are_no_polynomials(pages):
    grid = np.linspace(1.2, 2.4, 22)
    assert pages._law(np.sin(9 * grid)[:, None], True, grid) == (
        "a function of wavelength, times a number"
    )
    assert pages._law(np.sin(np.outer(grid, [7, 9, 11])), True, grid) == "3 functions of wavelength"
    assert pages._law(None, True, grid) == "one value per wavelength"
    assert pages._law(None, False, grid) == "one number"


def test_names_of_a_docstring_work_on_any_page(pages):
    for text, linked in [
        ("as a `LinearRetarder` is", "as a `~astropolcal.optics.LinearRetarder` is"),
        ("see `evaluate`", "see ``evaluate``"),
        (":math:`x` and ``y``", ":math:`x` and ``y``"),
        ("`Title`_", "`Title`_"),
    ]:
        assert pages._linked(text) == linked, (text, linked)


INDICES = [(OPTICS, "optics_index"), (EFFECTS, "effects_index")]


def test_index_lists_every_member_once(pages):
    for registry, make in INDICES:
        page = getattr(pages, make)()
        folder = make.removesuffix("_index")
        listed = re.findall(rf":doc:`(\w+) <{folder}/\1>`", page)
        assert sorted(listed) == sorted(registry), (registry, make)
        hidden = re.findall(rf"^   {folder}/(\w+)$", page, re.M)
        assert hidden == listed, (registry, make)


def test_every_kind_of_effect_has_a_title(pages):
    assert {effect.kind for effect in EFFECTS.values()} <= set(pages.KINDS)


def test_an_unknown_value_of_a_template_is_an_error(pages):
    import jinja2

    with pytest.raises(jinja2.UndefinedError, match="words"):
        pages.render("index", title="Optics", groups=[], folder="optics")


# --- the form of a matrix ---------------------------------------------------------------

C, S = r"\cos(\mathrm{retardance})", r"\sin(\mathrm{retardance})"
D, ROOT = r"\mathrm{diattenuation}", r"\sqrt{1 - \mathrm{diattenuation}^2}"


def test_matrices_are_those_of_the_paper(on_path):
    for name, rows in [
        # McIntosh et al. 2026, Eqs. of a linear retarder, a diattenuator, a rotation and the
        # beam switcher
        ("LinearRetarder", ["1 0 0 0", "0 1 0 0", f"0 0 {C} {S}", f"0 0 -{S} {C}"]),
        ("Diattenuator", [f"1 {D} 0 0", f"{D} 1 0 0", f"0 0 {ROOT} 0", f"0 0 0 {ROOT}"]),
        ("ParityFlip", ["1 0 0 0", "0 -1 0 0", "0 0 1 0", "0 0 0 -1"]),
        (
            "Rotator",
            [
                "1 0 0 0",
                r"0 \cos(2\,\theta) \sin(2\,\theta) 0",
                r"0 -\sin(2\,\theta) \cos(2\,\theta) 0",
                "0 0 0 1",
            ],
        ),
    ]:
        from gallery.examples import example_of
        from gallery.form import form_of

        matrix, _ = form_of(example_of(OPTICS[name]))
        inside = re.search(r"\\begin\{pmatrix\}(.*)\\end\{pmatrix\}", matrix).group(1)
        found = [[cell.strip() for cell in row.split(" & ")] for row in inside.split(r"\\ ")]
        without_spaces = [[cell.replace(" ", "") for cell in row] for row in found]
        assert without_spaces == [row.replace("1 - ", "1-").split(" ") for row in rows], (
            name,
            rows,
        )


EXAMPLE = """
A plate.

Examples
--------
>>> import astropy.units as u
>>> from astropolcal.optics import LinearRetarder
>>> plate = LinearRetarder(retardance=123 * u.deg, mount="hwp")
>>> plate.retardance = 5 * u.deg
>>> other = LinearRetarder(retardance=6 * u.deg)
"""


def test_example_is_the_first_optic_as_it_was_made(on_path, monkeypatch):
    from gallery.examples import example_of

    cls = optics.LinearRetarder
    before = cls.__init__
    monkeypatch.setattr(cls, "__doc__", EXAMPLE)
    found = example_of(cls)
    assert (found.retardance.value, found.mount) == (123, "hwp")
    # the class is left as it was
    assert cls.__init__ is before


def test_docstring_without_an_example_gives_the_defaults(on_path, monkeypatch):
    from gallery.examples import example_of

    cls = optics.LinearRetarder
    monkeypatch.setattr(cls, "__doc__", "A plate.")
    assert example_of(cls).retardance.value == cls().retardance.value


# --- what is drawn when -------------------------------------------------------------------


def test_figures_depend_on_files_that_are_there(build):
    """A part that was renamed would let old figures stand."""
    package = Path(astropolcal.__file__).parent
    for part in build._COMMON + build._OF_EFFECTS:
        there = package / part
        assert there.is_dir() or there.is_file(), f"docs/gallery/build.py: {part}"
    for name in build._DRAWING:
        assert (DOCS / "gallery" / f"{name}.py").is_file()


def test_stamp_changes_with_the_code(build, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "_PACKAGE", tmp_path)
    (tmp_path / "optics").mkdir()
    module = tmp_path / "optics" / "one.py"
    module.write_text("x = 1\n")
    first = build._digest(("optics",))
    assert build._digest(("optics",)) == first
    module.write_text("x = 2\n")
    assert build._digest(("optics",)) != first


def test_pages_are_written_once_and_old_ones_go(build, tmp_path, monkeypatch):
    """A build that changes nothing leaves the pages as they are, so Sphinx reads none again."""
    from gallery import pages

    monkeypatch.setattr(build, "OPTICS", {"Rotator": OPTICS["Rotator"]})
    monkeypatch.setattr(build, "EFFECTS", {"beam_gain": EFFECTS["beam_gain"]})
    monkeypatch.setattr(build, "draw_optic", lambda name, folder: ("wavelength", "somewhere"))
    monkeypatch.setattr(build, "draw_effect", lambda name, folder: "a scene")
    monkeypatch.setattr(pages, "optic_page", lambda name, label, place: f"{name} {label} {place}\n")
    monkeypatch.setattr(pages, "effect_page", lambda name, words: f"{name} {words}\n")
    build.write_gallery(tmp_path)
    page = tmp_path / "optics" / "Rotator.rst"
    assert page.read_text() == "Rotator wavelength somewhere\n"
    assert (tmp_path / "effects" / "beam_gain.rst").read_text() == "beam_gain a scene\n"
    (tmp_path / "optics" / "Gone.rst").write_text("a class that was removed\n")
    when = page.stat().st_mtime_ns
    build.write_gallery(tmp_path)
    assert page.stat().st_mtime_ns == when
    assert not (tmp_path / "optics" / "Gone.rst").exists()


# --- the drawings of the conventions and of double differences ------------------------------


def test_angles_are_drawn_counter_clockwise_from_vertical(drawings, pyplot):
    """+U at 45 deg is up on the left, looking into the beam."""
    figure = drawings.conventions()
    places = {t.get_text(): t.get_position() for axis in figure.axes for t in axis.texts}
    x, y = places["+Q"]
    assert (round(x, 9), y > 0) == (0, True)
    assert places["+U"][0] < 0 < places["+U"][1]
    minus_u = places["\N{MINUS SIGN}U"]
    assert minus_u[0] > 0
    assert minus_u[1] > 0
    assert places["\N{MINUS SIGN}Q"][0] < 0


def test_chain_is_drawn_in_the_order_of_the_light(drawings, pyplot):
    """As `astropolcal.instruments` builds it for a star."""
    figure = drawings.conventions()
    train = figure.axes[-1]
    boxes = [t for t in train.texts if t.get_bbox_patch() is not None]
    words = [t.get_text().split("\n")[0] for t in sorted(boxes, key=lambda t: t.get_position()[0])]
    assert words == [
        *("sky", "M3", "altitude", "half-wave plate", "derotator", "dichroic,", "Wollaston")
    ]


def test_drawing_of_double_differences_has_the_numbers_of_the_page(drawings, pyplot):
    """The page prints them with two or fewer digits."""
    figure = drawings.hidden_by_double_differences()
    (axis,) = figure.axes
    single, double = (np.asarray(points.get_offsets()) for points in axis.collections[1:3])
    page = (DOCS / "double_differences.rst").read_text(encoding="utf-8")
    printed = re.findall(r"^.+? single +([\d.]+?)\.\.\. +double +([\d.]+?)\.\.\.$", page, re.M)
    assert len(printed) == len(single) == 5
    for (a, b), drawn_single, drawn_double in zip(printed, single[:, 0], double[:, 0], strict=True):
        assert f"{drawn_single:6.3f}".strip().startswith(a)
        assert f"{drawn_double:6.3f}".strip().startswith(b)


# ---- the figure of the first page ------------------------------------------------------------


@pytest.mark.slow
def test_figure_of_the_first_page_is_what_its_script_draws():
    """Its file holds the words and the lines that were drawn, so that a stale one is found."""
    image = pytest.importorskip("PIL.Image")
    import draw_landing

    kept = json.loads(image.open(draw_landing.FIGURE).text["Comment"])
    drawn = draw_landing.content(draw_landing.draw())
    stale = "docs/images/landing.png is stale: run python docs/draw_landing.py"
    number = re.compile(r"\d+")
    kept_words, words = ([number.sub("", w) for w in one["words"]] for one in (kept, drawn))
    assert kept_words == words, stale
    for one, other in zip(kept["words"], drawn["words"], strict=True):
        # a probability may be rounded differently on another processor
        pairs = zip(map(int, number.findall(one)), map(int, number.findall(other)), strict=True)
        assert all(abs(a - b) <= 1 for a, b in pairs), stale
    assert len(kept["lines"]) == len(drawn["lines"]) > 8
    for one, other in zip(kept["lines"], drawn["lines"], strict=True):
        np.testing.assert_allclose(one, other, rtol=0.02, atol=0.003, err_msg=stale)
