# Licensed under a 3-clause BSD style license - see LICENSE
"""What the README promises is what runs."""

import re
import shlex

import pytest

from astropolcal.scripts.main import build_parser


@pytest.fixture(scope="module")
def readme(repository):
    return (repository / "README.md").read_text(encoding="utf-8")


def _blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.mark.slow
def test_the_example_runs(readme, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (code,) = _blocks(readme, "python")
    exec(compile(code, "README.md", "exec"), {})
    assert "On sky" in capsys.readouterr().out
    assert (tmp_path / "charis.asdf").exists()


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


def test_numbers_are_those_of_the_page_on_charis(readme, repository):
    """Medians of the accuracy: ours of the joint fit, theirs of the fit per wavelength."""
    page = (repository / "docs" / "charis.rst").read_text(encoding="utf-8")
    rows = {}
    for line in re.findall(r"^(?:astropolcal|published), .* +\d+\.\d+.*$", page, re.M):
        name, *numbers = re.split(r"\s{2,}", line.strip())
        rows[name] = numbers[-2:]
    ours = rows["astropolcal, joint fit (the default)"]
    theirs = rows["published, per wavelength, misalignments zero"]
    for month, a, b in zip(("October 2025", "July 2025"), ours, theirs, strict=True):
        (line,) = [line for line in readme.splitlines() if line.startswith(f"| {month}")]
        assert [cell.strip() for cell in line.split("|")[2:4]] == [a, b]


def test_size_of_the_fit_is_that_of_the_page(readme, repository):
    page = (repository / "docs" / "first_calibration.rst").read_text(encoding="utf-8")
    bins, frames, parameters = re.search(
        r"\((\d+) wavelengths,\s+(\d+) frames, (\d+) parameters", readme
    ).groups()
    assert f"{frames} frames and {bins} wavelengths" in " ".join(page.split())
    assert f"Fit         {parameters} parameters" in page


def test_figure_is_the_one_that_the_command_draws(readme, repository):
    """The picture has the name of the file in its folder, and is what a browser can show."""
    (image,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", readme)
    assert (repository / image).read_bytes().startswith(b"\x89PNG")
    assert "`figures/double_differences.png`" in readme
