# Licensed under a 3-clause BSD style license - see LICENSE
"""The documentation: links and command lines are right, and every model gets its page."""

import inspect
import json
import re
import shlex
import sys
import tomllib

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter

from astropolcal.gap.effects import EFFECTS
from astropolcal.optics import OPTICS, Optic
from astropolcal.scripts.main import build_parser

pytest.importorskip("jinja2", reason="jinja2 is not installed")
pytest.importorskip("numpydoc", reason="numpydoc is not installed")


@pytest.fixture(scope="module")
def docs(repository):
    return repository / "docs"


@pytest.fixture(scope="module")
def pages(docs):
    """Text of every page that is written by hand, by its name."""
    found = [*docs.glob("*.rst"), *docs.glob("reference/*.rst"), *docs.glob("tutorials/*")]
    return {
        path.relative_to(docs).as_posix(): path.read_text(encoding="utf-8")
        for path in found
        if path.suffix in (".rst", ".py")
    }


@pytest.fixture(scope="module")
def gallery(docs):
    """The package that writes the gallery, which is not installed."""
    sys.path.insert(0, str(docs))
    try:
        from gallery import build, examples, fingerprints, form, optic_figures
        from gallery import pages as written

        yield {
            module.__name__.rpartition(".")[2]: module
            for module in (build, examples, fingerprints, form, optic_figures, written)
        }
    finally:
        sys.path.remove(str(docs))


def written_by_a_build(docs):
    """Names of the pages that a build writes."""
    names = {f"generated/tutorials/{p.stem}" for p in docs.glob("tutorials/plot_*.py")}
    names |= {f"generated/models/optics/{name}" for name in OPTICS}
    names |= {f"generated/models/effects/{name}" for name in EFFECTS}
    return names | {
        "generated/tutorials/index",
        "generated/models/optics",
        "generated/models/effects",
    }


# ---- links and command lines ---------------------------------------------------------------


def test_links_between_pages_lead_somewhere(docs, pages):
    known = {p.relative_to(docs).with_suffix("").as_posix() for p in docs.rglob("*.rst")}
    known |= written_by_a_build(docs)
    wrong = [
        f"{page}: {target}"
        for page, text in pages.items()
        for target in re.findall(r":doc:`(?:[^`<]*<)?([^`>]+)>?`", text)
        if target.lstrip("/") not in known
    ]
    assert not wrong


def test_every_page_is_in_a_table_of_contents(docs, pages):
    listed = set()
    for text in pages.values():
        for block in re.findall(r"\.\. toctree::\n((?:\s*\n|[ ]+.*\n?)+)", text):
            listed |= {line.strip() for line in block.splitlines() if line.strip()[:1] != ":"}
    for page in pages:
        name = page.removesuffix(".rst")
        if page.endswith(".rst") and name not in ("index", "tutorials/GALLERY_HEADER"):
            assert name in listed, f"docs/{page} is in no toctree: add it to docs/index.rst"


def _commands(text):
    """Command lines of astropolcal in blocks of code."""
    blocks = re.findall(r"(?:code-block:: bash|::)\n\n((?:[ ]{3,}.*\n|\n)+)", text)
    for block in blocks:
        for line in block.replace("\\\n", " ").splitlines():
            # what stands behind several spaces says what the line does
            line = re.split(r"\s{3,}", line.strip().removeprefix("$ "))[0]
            if line.startswith("astropolcal ") and not re.search(r"[\[|]|\.\.\.", line):
                yield line


def _status(line):
    """Return the exit status with which the command would refuse a line, 0 if it does not."""
    try:
        build_parser().parse_args(shlex.split(line, comments=True)[1:])
    except SystemExit as end:
        # --help and --version end the program, too
        return end.code
    return 0


def test_command_lines_are_understood(pages):
    lines = [(page, line) for page, text in pages.items() for line in _commands(text)]
    assert len(lines) > 20
    wrong = [f"docs/{page}: {line}" for page, line in lines if _status(line) != 0]
    assert not wrong


def test_blocks_of_python_compile(pages):
    for page, text in pages.items():
        for block in re.findall(r"code-block:: python\n\n((?:[ ]{4}.*\n|\n)+)", text):
            compile(inspect.cleandoc("\n" + block), page, "exec")


def test_readme_shows_files_that_are_there(repository):
    text = (repository / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if "://" not in target:
            assert (repository / target).is_file(), f"README.md: {target}"


def test_metadata_of_the_software_agree(repository):
    meta = json.loads((repository / "codemeta.json").read_text(encoding="utf-8"))
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert meta["name"] == project["name"]
    assert meta["description"] == project["description"]
    assert meta["license"].endswith(project["license"])
    assert meta["codeRepository"] == project["urls"]["Source"]
    assert meta["issueTracker"] == project["urls"]["Issues"]
    assert sorted(meta["keywords"]) == sorted(project["keywords"])
    needed = {re.match(r"[\w-]+", each).group() for each in project["dependencies"]}
    assert set(meta["softwareRequirements"]) == needed
    assert meta["runtimePlatform"].endswith(project["requires-python"])


# ---- the gallery of models -----------------------------------------------------------------


@pytest.mark.long
def test_every_optic_has_a_page(gallery):
    for name in OPTICS:
        page = gallery["pages"].optic_page(name, "wavelength", "somewhere")
        assert page.startswith(".."), name
        assert f"\n{name}\n{'=' * len(name)}\n" in page, name
        assert r"\begin{pmatrix}" in page, name
        for key in OPTICS[name].param_names:
            assert f"``{key}``" in page, name
        assert "!<tag:astropolcal.org:astropolcal/optics/" in page, name
        assert f"import {name}" in page, name


@pytest.mark.slow
def test_every_effect_has_a_page_and_a_scene(gallery):
    for name in EFFECTS:
        effect, make = EFFECTS[name], gallery["fingerprints"].scene_of(name)
        assert make is not None, f"no scene of docs/gallery/fingerprints.py has a place for {name}"
        page = gallery["pages"].effect_page(name, make().words)
        for words in (effect.place, effect.shows, effect.reference):
            assert words in page, name
        images = gallery["fingerprints"].fingerprint(name, make)
        assert len(images) == (1 if effect.kind == "discrete" else 2), name
        assert max(np.abs(image).max() for image in images[0]) > 1e-4, name


@pytest.mark.slow
def test_a_new_optic_needs_no_more_than_its_class(gallery, monkeypatch):
    class Attenuator(Optic):
        """
        Filter of neutral density.

        Examples
        --------
        >>> 1 + 1
        2
        """

        share = Parameter(default=0.5, bounds=(0, 1), description="share that gets through")

        def _matrix(self, dispersion, share):
            return np.asarray(share)[..., None, None] * np.eye(4)

        def _derivatives(self, dispersion, share):
            return (np.ones_like(share)[..., None, None] * np.eye(4),)

    pages = gallery["pages"]
    monkeypatch.setitem(OPTICS, "Attenuator", Attenuator)
    monkeypatch.setattr(pages, "yaml_of", lambda **tree: "optic: a stand-in")
    page = pages.optic_page("Attenuator", "share", "somewhere")
    assert "share that gets through" in page
    assert r"\mathrm{share} & 0 & 0 & 0" in page
    assert "Attenuator" in pages.optics_index()


def test_the_form_of_a_matrix_is_read_off_its_numbers(gallery):
    for name, latex in [
        ("LinearRetarder", r"\cos(\mathrm{retardance}) & \sin(\mathrm{retardance})"),
        ("Diattenuator", r"\sqrt{1 - \mathrm{diattenuation}^2}"),
        ("Rotator", r"\cos(2\,\theta) & \sin(2\,\theta)"),
        ("WollastonPrism", r"\tfrac12 & \tfrac12\,\mathrm{efficiency}"),
        ("ParityFlip", r"0 & -1 & 0 & 0"),
    ]:
        matrix, words = gallery["form"].form_of(gallery["examples"].example_of(OPTICS[name]))
        assert latex in matrix, (name, latex)
        assert words == ("" if not OPTICS[name].depends_on_beam else "Of the right beam."), (
            name,
            latex,
        )


def test_what_has_no_simple_form_gets_letters(gallery):
    example = gallery["examples"].example_of(OPTICS["TwoLayerWaveplate"])
    matrix, words = gallery["form"].form_of(example)
    assert r"0 & 0 & a & b\\ 0 & 0 & -b & a" in matrix
    assert "and wavelength" in words


def test_unequal_gains_are_left_by_the_nominal_model(gallery):
    prints = gallery["fingerprints"]
    raw, left = prints.fingerprint("beam_gain", prints.bench)
    assert np.allclose(raw[1], left[1], atol=0.02)


def test_what_a_parameter_takes_up_is_gone(gallery):
    prints = gallery["fingerprints"]
    raw, left = prints.fingerprint("beam_crosstalk", prints.bench)
    assert EFFECTS["beam_crosstalk"].absorbed_by == "wollaston.efficiency"
    assert np.abs(raw[0]).max() > 1
    assert np.abs(left[0]).max() < 1e-9


def test_figures_are_drawn_once(gallery, tmp_path):
    build = gallery["build"]
    drawn = []

    def draw(name, folder):
        drawn.append(name)
        return "a scene"

    for stamp in ("one", "one", "two"):
        found = build._drawn(["a", "b"], draw, tmp_path, stamp, lambda line: None)
        assert found == {"a": ["a scene"], "b": ["a scene"]}
    assert drawn == ["a", "b", "a", "b"]


@pytest.mark.slow
def test_figures_of_an_optic(gallery, tmp_path):
    for name in ["KMirror", "FluxGain", "PolarizedSource"]:
        words = gallery["build"].draw_optic(name, tmp_path)
        assert len(words) == 2, name
        for what in ("elements", "measurement"):
            assert (tmp_path / f"{name}_{what}.png").stat().st_size > 5000, name


def test_an_optic_at_rest_does_nothing_to_a_measurement(gallery):
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    still = OPTICS["LinearRetarder"](retardance=0 * u.deg)
    place = gallery["optic_figures"].draw_measurement(figure, still)
    assert place == "between half-wave plate and beam splitter"
    lines = [line for axis in figure.axes for line in axis.get_lines() if len(line.get_xdata()) > 2]
    assert lines
    assert all(np.abs(line.get_ydata()).max() < 1e-9 for line in lines)
