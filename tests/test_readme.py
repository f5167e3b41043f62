# Licensed under a 3-clause BSD style license - see LICENSE
"""What the README promises is what runs."""

import re
import shlex

import pytest

from astropolcal.scripts.main import build_parser, main


@pytest.fixture(scope="module")
def readme(repository):
    return (repository / "README.md").read_text(encoding="utf-8")


def _blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_every_command_line_is_understood(readme):
    lines = [
        line
        for block in _blocks(readme, "bash")
        for line in re.split(r"\n|&&", block)
        if line.strip().startswith("astropolcal")
    ]
    assert len(lines) >= 4
    for line in lines:
        build_parser().parse_args(shlex.split(line)[1:])


def test_one_marked_command_installs_and_tests(readme):
    marked = re.findall(r"<!-- ci: test -->\s*```bash\n(.*?)```", readme, flags=re.DOTALL)
    assert len(marked) == 1
    assert len(marked[0].strip().splitlines()) == 1
    assert 'pip install -q -e ".[test]"' in marked[0]


@pytest.mark.slow
def test_the_first_command_says_what_the_page_says(readme, capsys):
    command = next(line for line in readme.split("&& ") if line.startswith("astropolcal calibrate"))
    words = shlex.split(command.splitlines()[0])[1:]
    words = words[: words.index("--plots")]
    for options, first in (
        (words, "NOT USABLE AS IT IS"),
        ([*words, "--fix", "hwp.theta"], "Usable"),
    ):
        assert f"`{first}`" in readme
        assert main(options) == 0
        assert f"\n{first}" in capsys.readouterr().out
    assert "`--fix hwp.theta`" in readme


def test_numbers_are_those_of_the_page_on_charis(readme, repository):
    """Medians of the accuracy: ours of the joint fit, theirs of the fit per wavelength."""
    page = (repository / "docs" / "charis_fits.rst").read_text(encoding="utf-8")
    pattern = r"to (0\.\d+) % of polarization, the published software to (0\.\d+) %"
    ours, theirs = re.search(pattern, " ".join(readme.split())).groups()
    for name, number in [
        ("astropolcal, joint fit (the default)", ours),
        ("published, per wavelength, misalignments zero", theirs),
    ]:
        assert re.search(rf"^{re.escape(name)} +\d +{number} ", page, re.M), name


def test_figure_is_what_a_browser_can_show(readme, repository):
    (image,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", readme)
    assert (repository / image).read_bytes().startswith(b"\x89PNG")
    assert "`figures/double_differences.png`" in readme
