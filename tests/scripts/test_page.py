# Licensed under a 3-clause BSD style license - see LICENSE
"""docs/commands against the parsers: every command and option, and nothing else."""

import argparse
import re

import pytest

from astropolcal.scripts.main import build_parser

(COMMANDS,) = (
    action.choices
    for action in build_parser()._actions
    if isinstance(action, argparse._SubParsersAction)
)


def options(parser):
    """Return option strings, the long one where there is one, but for --help."""
    found = [action.option_strings for action in parser._actions if action.option_strings]
    return {max(names, key=len) for names in found} - {"--help"}


@pytest.fixture(scope="module")
def sections(repository):
    """Text of the pages by command."""
    pages = (repository / "docs" / "commands").glob("*.rst")
    return {page.stem: page.read_text(encoding="utf-8") for page in pages}


def table_of(section):
    """Return the first column of the first table of a section."""
    tables = re.split(r"^=+ +=+\n", section, flags=re.MULTILINE)
    return "\n".join(line[:25] for line in tables[1].splitlines()) if len(tables) > 1 else ""


def test_every_command_has_a_page(sections, repository):
    assert set(sections) == set(COMMANDS)
    overview = (repository / "docs" / "command_line.rst").read_text(encoding="utf-8")
    assert set(re.findall(r":doc:`commands/(\w+)`", overview)) == set(COMMANDS)


def test_every_option_is_on_its_page(sections):
    for command in COMMANDS:
        named = set(re.findall(r"(?<![\w-])--?[a-z][a-z0-9-]*", sections[command]))
        missing = options(COMMANDS[command]) - named
        assert not missing, f"docs/commands/{command}.rst: describe {', '.join(sorted(missing))}"


def test_the_table_has_no_option_that_is_gone(sections):
    for command in sorted(set(COMMANDS) - {"info"}):
        named = set(re.findall(r"--[a-z][a-z0-9-]*", table_of(sections[command])))
        assert named, command
        unknown = named - options(COMMANDS[command]) - {"--quiet"}
        assert not unknown, f"docs/commands/{command}.rst: {', '.join(sorted(unknown))} is gone"


def test_stated_defaults_are_those_of_the_parser(sections):
    for command, option, stated in [
        ("simulate", "--seed", "(20251005)"),
        ("simulate", "--fwhm", "(5)"),
        ("sample", "--steps", "by default 5000"),
        ("reduce", "--gap", "by default 30"),
        ("correct", "--size", "by default 51"),
        ("correct", "--max-condition", "by default 30"),
        ("challenge", "-n", "by default 20"),
    ]:
        (row,) = re.findall(rf"^``{option} .*(?:\n {{27}}.*)*", sections[command], re.MULTILINE)
        assert stated in " ".join(row.split()), (command, option, stated)
        default = COMMANDS[command]._option_string_actions[option].default
        assert float(re.search(r"\d[\d.e]*", stated).group()) == default, (command, option, stated)
