# Licensed under a 3-clause BSD style license - see LICENSE
"""Every reference from one place of the documentation to another leads somewhere."""

import argparse
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import pytest

import astropolcal
from astropolcal.gap.effects import EFFECTS
from astropolcal.optics import OPTICS
from astropolcal.scripts.main import build_parser

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = sorted(
    path
    for path in (*DOCS.glob("*.rst"), *DOCS.glob("reference/*.rst"), *DOCS.glob("tutorials/*"))
    if path.suffix in (".rst", ".py")
)
MARKDOWN = sorted(REPOSITORY.glob("*.md"))
MODULES = sorted(
    path for path in Path(astropolcal.__file__).parent.rglob("*.py") if path.name != "_version.py"
)


def _id(path):
    # the installed package may lie elsewhere
    return "/".join(path.parts[-2:])


@cache
def _text(path):
    return path.read_text(encoding="utf-8")


# --- pages in Markdown ------------------------------------------------------------------


def _anchors(path):
    """Anchors that GitHub gives to the headings of a page."""
    without_code = re.sub(r"^```.*?^```", "", _text(path), flags=re.S | re.M)
    for heading in re.findall(r"^#+ (.*)$", without_code, re.M):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _markdown_links(text):
    without_code = re.sub(r"```.*?```|`[^`]*`\]?", "", text, flags=re.S)
    return re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"^\[.+\]: (\S+)", without_code, re.M)


def test_links_in_markdown_lead_somewhere():
    for path in MARKDOWN:
        for link in _markdown_links(_text(path)):
            if "://" in link or link.startswith("mailto:"):
                continue
            target, _, anchor = link.partition("#")
            there = path.parent / target if target else path
            assert there.exists(), f"{path.name}: there is no {target}"
            if anchor:
                assert anchor in set(_anchors(there)), f"{path.name}: {target} has no '#{anchor}'"


def test_anchors_are_those_of_github(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# How well it does?\n\n```bash\n# no heading\n```\n\n## In `Python` (3.11)\n")
    assert list(_anchors(page)) == ["how-well-it-does", "in-python-311"]


def test_links_are_found_beside_code():
    text = "A [page](docs/a.rst#b), `[x](y)` and [`code`](docs/c.rst).\n\n[d]: docs/d.rst\n"
    assert set(_markdown_links(text)) >= {"docs/a.rst#b", "docs/c.rst", "docs/d.rst"}


def test_addresses_are_well_formed():
    """A sentence's full stop or a bracket too many ends in a page that is not there."""
    for path in [*MARKDOWN, *PAGES]:
        for address in re.findall(r"https?://[^\s>)\"'`\]]+", _text(path)):
            assert re.fullmatch(r"https://[\w.-]+\.[a-z]{2,}(/[\w./%~@:+&=?#-]*)?", address), (
                address
            )
        for doi in re.findall(r"doi:(10\.\S+)", _text(path)):
            assert re.fullmatch(r"10\.\d{4,5}/[\w().;/-]+[\w)]", doi.rstrip(".,;")), doi


# --- references of Sphinx ---------------------------------------------------------------


@pytest.fixture(scope="module")
def labels():
    texts = "\n".join(_text(path) for path in PAGES if path.suffix == ".rst")
    return set(re.findall(r"^\.\. _([\w-]+):$", texts, re.M))


def test_labels_are_there(labels):
    for path in [*PAGES, *MODULES]:
        for label in re.findall(r":ref:`(?:[^`<]*<)?([\w-]+)>?`", _text(path)):
            assert label in labels, f"no page has '.. _{label}:'"


def test_labels_are_not_given_twice(labels):
    texts = "\n".join(_text(path) for path in PAGES)
    given = re.findall(r"^\.\. _([\w-]+):$", texts, re.M)
    assert sorted(given) == sorted(labels)


def _titles(text):
    """Titles of sections, which are underlined over their whole length."""
    return {title for title, line in re.findall(r"^(\S.*)\n([=\-~^])\2+$", text, re.M)}


def test_sections_that_are_named_are_on_the_page():
    for path in [p for p in PAGES if p.suffix == ".rst"]:
        text = _text(path)
        for title in re.findall(r"(?<!`)`([^`<>]+)`_(?!_)", text):
            assert " ".join(title.split()) in _titles(text), f"no section '{title}'"


def test_titles_are_found():
    assert _titles("A title\n=======\n\nText.\n\nAnother\n~~~~~~~\n") == {"A title", "Another"}


def test_files_that_are_shown_are_there():
    for path in [p for p in PAGES if p.suffix == ".rst"]:
        shown = re.findall(
            r"^\.\. (?:image|figure|include|literalinclude):: (\S+)", _text(path), re.M
        )
        shown += re.findall(r":download:`(?:[^`<]*<)?([^`>]+)>?`", _text(path))
        for name in shown:
            if name.startswith("generated/"):
                # written as the pages are built
                continue
            there = DOCS / name.lstrip("/") if name.startswith("/") else path.parent / name
            assert there.is_file(), f"{path.name}: {name}"


def test_entries_of_tables_of_contents_are_pages():
    for path in [p for p in PAGES if p.suffix == ".rst"]:
        blocks = re.findall(r"\.\. toctree::\n((?:\s*\n|[ ]+.*\n?)+)", _text(path))
        entries = {line.strip() for block in blocks for line in block.splitlines() if line.strip()}
        for entry in entries - {e for e in entries if e.startswith(":")}:
            written = entry.startswith("generated/")
            assert written or (path.parent / f"{entry}.rst").is_file(), f"{path.name}: {entry}"


def _exists(name):
    """Whether a dotted name can be imported or is an attribute of what can."""
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        for part in parts[n:]:
            known = thing.__dict__ if inspect.isclass(thing) else {}
            # a parameter of a class is a descriptor, which may not be read off the class
            if part not in known and not hasattr(thing, part):
                return part in getattr(thing, "__annotations__", {})
            thing = known.get(part, None) or getattr(thing, part)
        return True
    return False


def test_names_of_the_package_exist():
    """What a page or a docstring calls by its full name."""
    pattern = r"`~?(astropolcal(?:\.\w+)+)(?:\(\))?`"
    named = {
        (_id(path), name)
        for path in [*PAGES, *MODULES]
        for name in re.findall(pattern, _text(path))
    }
    missing = sorted((page, name) for page, name in named if not _exists(name))
    assert not missing


def test_existence_is_told():
    for name, there in [
        ("astropolcal.optics.LinearRetarder.retardance", True),
        ("astropolcal.calibration.Calibration.read", True),
        ("astropolcal.calibration.Calibration.reed", False),
        ("astropolcal.no_such_module", False),
    ]:
        assert _exists(name) is there, (name, there)


# --- files, options and numbers that the text names ---------------------------------------


def test_files_of_the_repository_exist():
    for path in [*PAGES, *MARKDOWN]:
        pattern = r"`((?:astropolcal|docs|tests|\.github)/[\w./-]+)`"
        for name in re.findall(pattern, _text(path)):
            # what a build writes is not there before it, nor what the reader is to write
            if not re.search("docs/(_build|api|generated)|leaky_polarizer", name):
                assert (REPOSITORY / name).exists(), f"{path.name} names {name}"


@cache
def _options():
    """Every option of every command."""
    found, parsers = set(), [build_parser()]
    while parsers:
        for action in parsers.pop()._actions:
            found |= set(action.option_strings)
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
    return found


def test_options_that_the_text_names_exist():
    for path in [p for p in PAGES if p.suffix == ".rst"]:
        for option in re.findall(r"``(--[\w-]+)", _text(path)):
            assert option in _options(), f"no command has {option}"


def test_options_are_those_of_the_commands():
    assert {"--help", "--target", "--nuisance", "--plots"} <= _options()


def test_numbers_of_models_are_right():
    for path in [*PAGES, *DOCS.glob("changes/*.rst"), *MARKDOWN]:
        for number in re.findall(r"(?:library|which) of (\d+) effects", _text(path)):
            assert int(number) == len(EFFECTS), path
        for number in re.findall(r"(?:library|all) of? ?(\d+) optics", _text(path)):
            assert int(number) == len(OPTICS), path


def test_no_page_speaks_of_what_is_not_there():
    """Placeholders, and notes of those who write."""
    for path in PAGES:
        assert not re.search(r"\b(TODO|FIXME|XXX|TBD|lorem ipsum)\b", _text(path), re.I), path
        assert not re.search(r"(?<!\w)/(tmp|work|home|root)/", _text(path)), path
