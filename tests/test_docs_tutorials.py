# Licensed under a 3-clause BSD style license - see LICENSE
"""The tutorials run, on simulated data and on real tables, and become notebooks."""

import json
import runpy
from pathlib import Path

import pytest

TUTORIALS = sorted((Path(__file__).resolve().parents[1] / "docs" / "tutorials").glob("plot_*.py"))
# those that take longer than about five seconds
LONG = ("plot_5_cubes", "plot_6_figures_of_the_paper")
ON_TABLES = ("plot_1_internal_source", "plot_2_stars", "plot_3_diagnosis", LONG[1])


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """Run in an empty folder, and close the figures."""
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ASTROPOLCAL_DATA", raising=False)
    yield plt
    plt.close("all")


def _slow(path):
    return [pytest.mark.slow] if path.stem in LONG else []


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=_slow(path), id=path.stem) for path in TUTORIALS]
)
def test_tutorial_runs(path, in_folder, tmp_path):
    runpy.run_path(str(path))
    assert in_folder.get_fignums(), f"{path.name} draws nothing"
    assert not list(tmp_path.iterdir()), f"{path.name} leaves files behind"


# that frames of the warming lamp are masked is said by a warning
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*frames masked:astropolcal.exceptions.AstropolcalWarning")
@pytest.mark.parametrize("name", ON_TABLES)
def test_tutorial_runs_on_real_tables(name, in_folder, monkeypatch, shared_data):
    monkeypatch.setenv("ASTROPOLCAL_DATA", str(shared_data / "data" / "charis"))
    (path,) = [each for each in TUTORIALS if each.stem == name]
    found = runpy.run_path(str(path))
    assert found["folder"]
    assert in_folder.get_fignums()


def test_there_are_tutorials():
    assert len(TUTORIALS) >= 6


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial_becomes_a_notebook(path):
    parser = pytest.importorskip("sphinx_gallery.py_source_parser")
    notebook = pytest.importorskip("sphinx_gallery.notebook")
    from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF

    _, blocks = parser.split_code_and_text_blocks(str(path))
    made = notebook.jupyter_notebook(blocks, dict(DEFAULT_GALLERY_CONF), str(path.parent))
    cells = json.loads(json.dumps(made))["cells"]
    kinds = [cell["cell_type"] for cell in cells]
    assert kinds[0] == "markdown"
    assert kinds.count("code") >= 3
