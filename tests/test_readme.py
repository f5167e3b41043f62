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


def test_the_example_runs(readme, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (code,) = _blocks(readme, "python")
    exec(compile(code, "README.md", "exec"), {})
    assert "Accuracy" in capsys.readouterr().out
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
