# Licensed under a 3-clause BSD style license - see LICENSE
"""
The architecture is tested, not remembered.

Sizes, public names, docstrings, forbidden calls, imports between layers and
the cost of ``import astropolcal``. Every message says how to comply.
"""

import ast
import importlib
import inspect
import io
import pkgutil
import re
import subprocess
import sys
import tokenize
from pathlib import Path
from statistics import median

import pytest

import astropolcal

REPOSITORY = Path(__file__).resolve().parents[1]
# the installed package, which is the source tree in a development installation
PACKAGE = Path(astropolcal.__file__).resolve().parent

MAX_MODULE_LINES = 800
MAX_MEDIAN_MODULE_LINES = 250
MAX_FUNCTION_LINES = 80
MAX_FUNCTION_LINES_95 = 45
MAX_MEDIAN_FUNCTION_LINES = 9
# per 100 lines of code, which are those that are neither blank nor docstring
MIN_COMMENTS, MAX_COMMENTS = 5, 15
MIN_TEST_LINES = 0.8

FORBIDDEN_IMPORTS = {"pickle", "cPickle", "dill", "marshal", "shelve"}
FORBIDDEN_CALLS = {"eval", "exec", "yaml.load", "yaml.full_load", "yaml.unsafe_load"}
HEAVY = (
    "arviz_stats",
    "asdf",
    "corner",
    "dask",
    "distributed",
    "emcee",
    "jinja2",
    "h5py",
    "matplotlib",
    "photutils",
    "specutils",
)

WITHOUT_REFERENCE_PAGE = {
    "conftest",
    "converters",
    "data",
    "extension",
    "resources",
    "scripts",
    "version",
}

FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.name != "_version.py")
assert FILES, f"no source found in {PACKAGE}"


def _id(path):
    return path.relative_to(PACKAGE).as_posix()


def _module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _tree(path):
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def _is_public(path):
    return not any(
        part.startswith("_") and part != "__init__"
        for part in path.relative_to(PACKAGE).with_suffix("").parts
    )


PUBLIC_FILES = [p for p in FILES if _is_public(p)]
TOP_LEVEL = sorted({p.relative_to(PACKAGE).parts[0].removesuffix(".py") for p in PUBLIC_FILES})
TOP_LEVEL.remove("__init__")


def _has_docstring(node):
    first = node.body[0]
    return isinstance(first, ast.Expr) and isinstance(getattr(first.value, "value", None), str)


def _body_length(node):
    """Lines of a function's body without its docstring."""
    body = node.body[1:] if _has_docstring(node) else node.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def _functions(path):
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    return [node for node in ast.walk(_tree(path)) if isinstance(node, kinds)]


def _public_objects():
    """Classes and functions that ``__all__`` names, by the name of their definition."""
    found = {}
    for path in PUBLIC_FILES:
        try:
            module = importlib.import_module(_module_name(path))
        except Exception:  # test_public_module_has_complete_all reports it
            continue
        for name in getattr(module, "__all__", ()):
            thing = getattr(module, name, None)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return {k: v for k, v in sorted(found.items()) if k.startswith("astropolcal.")}


PUBLIC = _public_objects()


def _is_exception(thing):
    return inspect.isclass(thing) and issubclass(thing, BaseException)


# --- size ---------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_module_is_not_too_long(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= MAX_MODULE_LINES, (
        f"{_id(path)} has {lines} lines, allowed are {MAX_MODULE_LINES}: split it by subject "
        "into a package whose __init__ keeps the public names"
    )


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_no_function_is_too_long(path):
    long = {
        f"{node.name} (line {node.lineno})": _body_length(node)
        for node in _functions(path)
        if _body_length(node) > MAX_FUNCTION_LINES
    }
    assert not long, (
        f"{_id(path)}: {long} lines of body, allowed are {MAX_FUNCTION_LINES} without the "
        "docstring: give the steps names as helper functions"
    )


def test_modules_are_short_on_the_whole():
    middle = median(len(p.read_text(encoding="utf-8").splitlines()) for p in FILES)
    assert middle <= MAX_MEDIAN_MODULE_LINES, (
        f"the median module has {middle} lines, the budget is {MAX_MEDIAN_MODULE_LINES}"
    )


def test_functions_are_short_on_the_whole():
    lengths = sorted(_body_length(node) for path in FILES for node in _functions(path))
    at_95 = lengths[int(0.95 * (len(lengths) - 1))]
    assert median(lengths) <= MAX_MEDIAN_FUNCTION_LINES, (
        f"the median function body has {median(lengths)} lines, the budget is "
        f"{MAX_MEDIAN_FUNCTION_LINES}: name the steps as helper functions"
    )
    assert at_95 <= MAX_FUNCTION_LINES_95, (
        f"95 % of the function bodies have up to {at_95} lines, the budget is "
        f"{MAX_FUNCTION_LINES_95}: shorten the longest"
    )


def test_body_length_leaves_out_the_docstring():
    source = 'def f(x):\n    """One.\n\n    Two.\n    """\n    y = x\n\n    return y\n'
    assert _body_length(ast.parse(source).body[0]) == 3


def _docstring_lines(source):
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, kinds) and ast.get_docstring(node):
            first = node.body[0]
            yield "\n".join(lines[first.lineno - 1 : first.end_lineno])


def _not_blank(source):
    return sum(1 for line in source.splitlines() if line.strip())


def _comments_and_code(source):
    """Comments but for the license line, and lines that are neither blank nor docstring."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = [
        token.string
        for token in tokens
        if token.type == tokenize.COMMENT and not token.string.startswith("# Licensed under")
    ]
    docstrings = sum(map(_not_blank, _docstring_lines(source)))
    return len(comments), _not_blank(source) - docstrings


def _share_of_comments(paths):
    counts = [_comments_and_code(path.read_text(encoding="utf-8")) for path in paths]
    comments, code = map(sum, zip(*counts, strict=True))
    return 100 * comments / code


def test_code_says_why():
    share = _share_of_comments(FILES)
    areas = {path.relative_to(PACKAGE).parts[0] for path in FILES}
    poorest = sorted(
        (_share_of_comments([p for p in FILES if p.relative_to(PACKAGE).parts[0] == area]), area)
        for area in areas
    )[:5]
    assert MIN_COMMENTS <= share <= MAX_COMMENTS, (
        f"{share:.1f} comments per 100 lines of code, the budget is {MIN_COMMENTS} to "
        f"{MAX_COMMENTS}: where a reader would stop, say why it is so (equation, sign, unit, "
        f"shape, tolerance), never what the line does; fewest have {poorest}"
    )


def test_tests_are_as_long_as_they_should_be():
    tests, source = (
        sum(_not_blank(path.read_text(encoding="utf-8")) for path in paths)
        for paths in ((REPOSITORY / "tests").rglob("*.py"), FILES)
    )
    assert tests >= MIN_TEST_LINES * source, (
        f"{tests} lines of tests for {source} of source, {tests / source:.2f}, the budget is "
        f"{MIN_TEST_LINES}: ask of each function which plausible wrong result no test would "
        "notice, and write that test"
    )


def test_comments_and_code_are_counted():
    source = "# Licensed under a licence\n"
    source += '"""Module.\n\nMore.\n"""\n\nx = "# none"  # why\n\n# how\ny = 1\n'
    # the licence line and the two lines with code, and the comment between them
    assert _comments_and_code(source) == (2, 4)


# --- public names and docstrings ------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_file_has_license_line_and_module_docstring(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# Licensed under a 3-clause BSD style license - see LICENSE\n"), (
        f"{_id(path)}: make the license line the first line, as in astropolcal/units.py"
    )
    assert ast.get_docstring(_tree(path)), f"{_id(path)}: say in a module docstring what it is for"


@pytest.mark.parametrize("path", PUBLIC_FILES, ids=_id)
def test_public_module_has_complete_all(path):
    module = importlib.import_module(_module_name(path))
    assert hasattr(module, "__all__"), f"{_id(path)}: list the public names in __all__"
    missing = [name for name in module.__all__ if not hasattr(module, name)]
    assert not missing, f"{_id(path)}: __all__ names {missing}, which the module does not have"
    assert len(set(module.__all__)) == len(module.__all__), f"{_id(path)}: __all__ repeats a name"


@pytest.mark.parametrize(
    "path", [path for path in PUBLIC_FILES if path.name == "__init__.py"], ids=_id
)
def test_no_function_hides_a_module_of_its_name(path):
    """Else it depends on what was imported first which of the two a name is."""
    package = importlib.import_module(_module_name(path))
    modules = {info.name for info in pkgutil.iter_modules(package.__path__)}
    hidden = [
        n for n in modules & set(package.__all__) if not inspect.ismodule(getattr(package, n))
    ]
    assert not hidden, f"{_module_name(path)}: {hidden}: name the modules otherwise"


@pytest.mark.parametrize("name", PUBLIC)
def test_public_object_has_docstring_with_example(name):
    # read from the class itself: an inherited docstring describes another class
    doc = PUBLIC[name].__dict__.get("__doc__") if inspect.isclass(PUBLIC[name]) else None
    doc = inspect.cleandoc(doc or PUBLIC[name].__doc__ or "")
    assert doc, f"{name} has no docstring: write one in numpydoc form"
    if not _is_exception(PUBLIC[name]):
        assert "Examples\n--------" in doc, (
            f"{name}: add an 'Examples' section with a few lines that run; they are tested"
        )
        assert ">>> " in doc.split("Examples\n--------")[1], (
            f"{name}: the 'Examples' section has no line starting with '>>> '"
        )


@pytest.mark.parametrize("name", [k for k, v in PUBLIC.items() if not _is_exception(v)])
def test_public_docstring_is_numpydoc(name):
    docscrape = pytest.importorskip("numpydoc.docscrape", reason="numpydoc is not installed")
    thing = PUBLIC[name]
    documentation = docscrape.NumpyDocString(inspect.cleandoc(thing.__doc__ or ""))
    if not inspect.isfunction(thing):
        return
    described = {
        part.strip().lstrip("*")
        for section in ("Parameters", "Other Parameters")
        for entry in documentation[section]
        for part in entry.name.split(",")
    }
    if not described:
        # a one-argument helper may say it all in its summary line
        assert len(_argument_names(thing)) <= 1, (
            f"{name}: describe {_argument_names(thing)} in a 'Parameters' section"
        )
        return
    assert described == set(_argument_names(thing)), (
        f"{name}: 'Parameters' describes {sorted(described)}, the arguments are "
        f"{_argument_names(thing)}: make them agree"
    )


def _argument_names(function):
    return [n for n in inspect.signature(function).parameters if not n.startswith("_")]


@pytest.mark.parametrize("name", TOP_LEVEL)
def test_top_level_module_has_reference_page(name):
    if name in WITHOUT_REFERENCE_PAGE:
        pytest.skip(f"{name} is not an interface for users")
    page = REPOSITORY / "docs" / "reference" / f"{name}.rst"
    assert page.is_file(), (
        f"add docs/reference/{name}.rst, like the others there, and name it in docs/api.rst"
    )
    assert f"automodapi:: astropolcal.{name}" in page.read_text(encoding="utf-8")


def _documented_names():
    """Module and name of what the reference shows."""
    pattern = re.compile(r"automodapi:: (\S+)\n((?:[ ]+:.*\n)*)")
    for page in (REPOSITORY / "docs" / "reference").glob("*.rst"):
        for module, options in pattern.findall(page.read_text(encoding="utf-8")):
            left_out = re.search(r":skip: (.*)", options)
            left_out = set(re.split(r",\s*", left_out.group(1))) if left_out else set()
            shown = importlib.import_module(module)
            for name in set(shown.__all__) - left_out:
                yield _definition(shown, name)


def _definition(module, name):
    thing = getattr(module, name)
    if hasattr(thing, "__qualname__"):
        return thing.__module__, thing.__qualname__
    return (thing.__name__, "") if inspect.ismodule(thing) else (name, id(thing))


@pytest.fixture(scope="module")
def documented_names():
    return set(_documented_names())


@pytest.mark.parametrize("name", [n for n in TOP_LEVEL if n not in WITHOUT_REFERENCE_PAGE])
def test_reference_shows_every_public_name(name, documented_names):
    module = importlib.import_module(f"astropolcal.{name}")
    hidden = [n for n in module.__all__ if _definition(module, n) not in documented_names]
    assert not hidden, (
        f"the reference does not show {hidden} of astropolcal.{name}: take them out of ':skip:' "
        "or give their module an 'automodapi' on the page"
    )


@pytest.mark.parametrize("name", sorted(set(astropolcal.__all__) - {"__version__"}))
def test_reference_introduces_the_names_to_start_with(name):
    page = (REPOSITORY / "docs" / "api.rst").read_text(encoding="utf-8")
    assert re.search(rf"`~?astropolcal\.([a-z_]+\.)*{name}`", page), (
        f"docs/api.rst: say in one line what astropolcal.{name} is for"
    )


# --- what the package must not do -----------------------------------------------


def _dotted(node):
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _forbidden(tree):
    """Line and name of every import or call that could run a stranger's code."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            names = []
        for name in names:
            if name.split(".")[0] in FORBIDDEN_IMPORTS:
                yield node.lineno, f"import {name}"
        if isinstance(node, ast.Call) and _dotted(node.func) in FORBIDDEN_CALLS:
            yield node.lineno, f"{_dotted(node.func)}()"


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_nothing_executes_foreign_code(path):
    found = list(_forbidden(_tree(path)))
    assert not found, (
        f"{_id(path)}: {found} can execute code hidden in a file: use ASDF, JSON or "
        "yaml.safe_load, and ordinary functions"
    )


@pytest.mark.parametrize(
    "source", ["import pickle", "from pickle import load", "eval('1')", "yaml.load(f)"]
)
def test_forbidden_code_is_recognized(source):
    assert list(_forbidden(ast.parse(source)))


@pytest.mark.parametrize("source", ["model.eval_all()", "yaml.safe_load(f)", "self.exec(1)"])
def test_innocent_code_is_not_forbidden(source):
    assert not list(_forbidden(ast.parse(source)))


def test_import_is_light():
    code = f"import sys, astropolcal; print(*sorted(set({HEAVY!r}) & set(sys.modules)), end='')"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True, check=True
    )
    assert result.stdout == "", (
        f"'import astropolcal' imports {result.stdout}: import these inside the functions "
        "that use them"
    )


def test_import_contract_holds():
    pytest.importorskip("importlinter", reason="import-linter is not installed")
    code = "from importlinter.cli import lint_imports; import sys; sys.exit("
    code += "lint_imports(config_filename='setup.cfg', no_cache=True))"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, (
        "an import breaks the contract of setup.cfg; move what both sides need to the lower "
        f"layer, or import a heavy library higher up:\n{result.stdout}\n{result.stderr}"
    )


@pytest.mark.parametrize("name", ["setup.cfg", "pyproject.toml"])
def test_metadata_live_in_one_place(name):
    # dependencies in both files make setuptools build a wheel without any
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    if name == "setup.cfg":
        assert "[options" not in text, "setup.cfg: move all metadata to pyproject.toml"
        assert "[metadata]" not in text, "setup.cfg: move all metadata to pyproject.toml"
        assert "[tool:pytest]" not in text, "setup.cfg: pytest is configured in pyproject.toml"
    else:
        assert "\ndependencies = [" in text
        assert "[tool.pytest.ini_options]" in text
