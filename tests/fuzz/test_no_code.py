# Licensed under a 3-clause BSD style license - see LICENSE
"""Nothing that a file holds can be executed: what could do so is not in the package."""

import ast
from pathlib import Path

import astropolcal

PACKAGE = Path(astropolcal.__file__).resolve().parent
FILES = sorted(PACKAGE.rglob("*.py"))

MODULES = {
    *("pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"),
    *("code", "codeop", "ctypes", "cffi", "imp", "runpy"),
}
NAMES = {"eval", "exec", "compile", "__import__", "breakpoint"}
ATTRIBUTES = {
    *("os.system", "os.popen", "os.execv", "os.execve", "os.spawnl", "os.startfile"),
    *("yaml.load", "yaml.load_all", "yaml.full_load", "yaml.unsafe_load", "yaml.FullLoader"),
    *("yaml.Loader", "yaml.UnsafeLoader", "yaml.CLoader", "subprocess.getoutput", "pty.spawn"),
}
FLAGS = {"allow_pickle", "shell"}


def _dotted(node):
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def found_in(text):
    """Return what source text has that can execute what it reads."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [name.name.partition(".")[0] for name in node.names]
            found += [f"import {name}" for name in names if name in MODULES]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            module = (node.module or "").partition(".")[0]
            found += [f"import {module}"] if module in MODULES else []
            dotted = [f"{node.module}.{name.name}" for name in node.names]
            found += [name for name in dotted if name in ATTRIBUTES]
        elif isinstance(node, ast.Attribute) and _dotted(node) in ATTRIBUTES:
            found.append(_dotted(node))
        elif isinstance(node, ast.Call):
            found += _in_call(node)
    return found


def _in_call(node):
    found = [node.func.id] if isinstance(node.func, ast.Name) and node.func.id in NAMES else []
    for keyword in node.keywords:
        off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
        found += [f"{keyword.arg}="] if keyword.arg in FLAGS and not off else []
    return found


def test_nothing_can_be_executed():
    for path in FILES:
        assert found_in(path.read_text(encoding="utf-8")) == [], (
            f"{path}: files are data: read them with json, astropy.table, astropy.io.fits or asdf, "
            "and start programs without a shell"
        )


def test_the_search_finds():
    for text in [
        "import pickle",
        "from pickle import loads",
        "def f():\n    import shelve.x",
        "eval('1')",
        "x = [exec(y) for y in z]",
        "np.load(p, allow_pickle=True)",
        "np.load(p, allow_pickle=flag)",
        "subprocess.run(c, shell=True)",
        "yaml.load(t, Loader=yaml.SafeLoader)",
        "from yaml import unsafe_load",
        "os.system(c)",
        "f = os.popen",
        "from marshal import loads",
    ]:
        assert found_in(text), text


def test_the_search_lets_pass():
    for text in [
        "'import pickle'",
        "# eval(x)",
        "np.load(p, allow_pickle=False)",
        "model.evaluate(x)",
    ]:
        assert not found_in(text), text
