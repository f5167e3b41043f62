# Licensed under a 3-clause BSD style license - see LICENSE
"""The settings of Sphinx: a build and its pages need no network unless they are told to."""

import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("sphinx_astropy", reason="the extra 'docs' is not installed")
pytest.importorskip("sphinx_gallery", reason="the extra 'docs' is not installed")

DOCS = Path(__file__).resolve().parents[1] / "docs"
ADDRESSES = ("READTHEDOCS", "ASTROPOLCAL_DOCS_ONLINE")


@pytest.fixture
def settings(monkeypatch):
    """Function that reads ``conf.py`` with some variables of the environment set."""
    pytest.importorskip("sphinx_astropy.conf.v3")

    def read(**variables):
        for name in ADDRESSES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        # conf.py puts its folder on the path, and changes lists of the shared settings
        monkeypatch.setattr(sys, "path", list(sys.path))
        for name in [name for name in sys.modules if name.startswith("sphinx_astropy.conf")]:
            monkeypatch.delitem(sys.modules, name)
        return runpy.run_path(str(DOCS / "conf.py"))

    return read


def test_without_network_no_other_documentation_is_asked(settings):
    found = settings()
    assert found["intersphinx_mapping"] == {}
    assert not any("intersphinx_toggle" in name for name in found["extensions"])


def test_page_of_changes_has_those_of_the_next_version(settings):
    settings()
    page = (DOCS / "generated" / "unreleased.txt").read_text(encoding="utf-8")
    for path in (DOCS / "changes").glob("*.*.rst"):
        first = path.read_text(encoding="utf-8").strip().splitlines()[0]
        assert f"- {first}" in page, path.name


def test_with_network_links_are_followed_where_there_are_any(settings):
    """A name of a package without an inventory would be an error of every build otherwise."""
    for variable in ADDRESSES:
        found = settings(**{variable: "1"})
        linked = set(found["intersphinx_mapping"])
        assert {"astropy", "numpy", "scipy", "matplotlib", "asdf", "photutils"} <= linked, variable
        patterns = [pattern for _, pattern in found["nitpick_ignore_regex"]]
        for name in found["EXTERNAL"]:
            ignored = any(re.fullmatch(pattern, f"{name}.anything") for pattern in patterns)
            assert ignored is (name not in linked), name


def test_only_names_of_other_packages_may_be_without_a_link(settings):
    for target, ignored in [
        ("numpy.ndarray", True),
        ("astropy.units.Quantity", True),
        ("ValueError", True),
        ("pathlib.Path", True),
        ("io.BytesIO", True),
        ("astropolcal.gap._words.State", True),
        ("astropolcal.calibration.Calibration", False),
        ("numpyx.array", False),
    ]:
        patterns = [pattern for _, pattern in settings()["nitpick_ignore_regex"]]
        assert any(re.fullmatch(pattern, target) for pattern in patterns) is ignored, (
            target,
            ignored,
        )


def test_nothing_is_loaded_from_the_network(settings):
    found = settings()
    assert found["html_theme_options"]["goatcounter_analytics_url"] == ""
    assert "://" not in found["mathjax_path"]
    script = found["html_static_path"][0]
    assert Path(script).name == found["mathjax_path"]
    assert Path(script).is_file()


def test_equations_are_drawn_by_the_script_beside_the_page(settings, tmp_path):
    """One page with an equation, built with the settings for equations and nothing else."""
    from sphinx.testing.util import SphinxTestApp

    found = settings()
    (tmp_path / "index.rst").write_text("Title\n=====\n\n.. math:: \\epsilon = \\frac12\n")
    (tmp_path / "conf.py").write_text("extensions = ['sphinx.ext.mathjax']\n")
    names = ("mathjax_path", "html_static_path")
    (tmp_path / "_static").mkdir()
    app = SphinxTestApp("html", srcdir=tmp_path, confoverrides={n: found[n] for n in names})
    try:
        app.build()
        page = (Path(app.outdir) / "index.html").read_text(encoding="utf-8")
        sources = re.findall(r'<script[^>]* src="([^"?]+)', page)
        assert f"_static/{found['mathjax_path']}" in sources
        assert not any("://" in source for source in sources)
        assert (Path(app.outdir) / "_static" / found["mathjax_path"]).stat().st_size > 1e6
        assert r"\[\epsilon = \frac12\]" in page
    finally:
        app.cleanup()


def test_pages_that_are_no_pages_are_left_out(settings):
    """Fragments of the changelog and scripts of the tutorials are read by others."""
    found = settings()
    assert {"changes/*", "tutorials", "gallery"} <= set(found["exclude_patterns"])
    assert found["nitpicky"] is True
    assert found["sphinx_gallery_conf"]["abort_on_example_error"] is True


def test_version_has_no_local_part(settings):
    found = settings()
    assert "+" not in found["version"]
    assert found["release"].startswith(found["version"])
