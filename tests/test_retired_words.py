# Licensed under a 3-clause BSD style license - see LICENSE
"""Words that were replaced by plainer ones do not come back."""

import io
import re
import tokenize
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_name("retired_words.txt")
WHERE = (
    *("*.md", "docs/*.rst", "docs/changes/*.rst", "docs/tutorials/*", "docs/gallery/**/*"),
    *("astropolcal/**/*.py", "astropolcal/**/*.html", "astropolcal/**/*.yaml"),
)


def retired(text):
    """Yield regular expression and what to write instead, of each line of a list."""
    for line in text.splitlines():
        if line and not line.startswith("#"):
            pattern, _, instead = line.rpartition("|")
            space = r"(?:[ \t]+\n?[ \t]*|\n[ \t]*)"
            yield re.compile(rf"\b(?:{pattern})\b".replace(" ", space), re.I), instead


def prose(source):
    """Return a Python source with only its strings; the code is one kind of character."""
    lines = [list(re.sub(r"\S", "\0", line)) for line in source.splitlines(keepends=True)]
    strings = {tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in strings:
            row, column = token.start
            text = re.sub(r'^[a-zA-Z]{0,2}("""|"|\')|["\']+$', _blank, token.string)
            if re.match("[rR]?[fF]", token.string):
                text = re.sub(r"\{(?:[^{}]|\{[^{}]*\})*\}", _blank, text)
            for part in text.splitlines():
                lines[row - 1][column : column + len(part)] = part
                row, column = row + 1, 0
    return "".join(chain.from_iterable(lines))


def _blank(match):
    return " " * len(match.group())


def found(text, words):
    """Yield the line and what is said there, of each retired word of a text."""
    for pattern, instead in words:
        for match in pattern.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            yield line, f"{' '.join(match.group().split())!r}: write {instead or 'it plainly'}"


def test_retired_words_do_not_occur():
    words = list(retired(LIST.read_text(encoding="utf-8")))
    # one look for all of them, as hardly a file has any
    any_of_them = re.compile("|".join(f"(?:{pattern.pattern})" for pattern, _ in words), re.I)
    report = []
    for path in sorted({path for pattern in WHERE for path in ROOT.glob(pattern)}):
        if path.is_file() and path.suffix in {".md", ".rst", ".py", ".html", ".yaml", ".jinja"}:
            text = path.read_text(encoding="utf-8")
            if path.match("tutorials/*.py"):
                # their comments are paragraphs of a page
                text = re.sub("^#", " ", text, flags=re.M)
            elif path.suffix == ".py":
                text = prose(text)
            name = path.relative_to(ROOT)
            if any_of_them.search(text):
                report += [f"{name}:{line}: {what}" for line, what in found(text, words)]
    assert not report, "\n" + "\n".join(report)


def test_words_are_found_over_lines_and_only_in_prose():
    words = list(retired("(value|row) a (wavelength|frame)|per\nbehind|downstream of\n"))
    source = (
        '"""One value a\n    wavelength."""\nbehind = 1  # behind\nf"{behind} row " "a frame"\n'
    )
    lines = [line for line, _ in found(prose(source), words)]
    assert lines == [1, 4]
    assert list(found("A value per wavelength.", words)) == []
