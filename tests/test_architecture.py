# Licensed under a 3-clause BSD style license - see LICENSE
"""
The architecture is tested, not remembered.

Sizes, public names and their docstrings, forbidden calls, imports between layers
and the cost of ``import astropolcal``. Every message says how to comply.
"""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import astropolcal

REPOSITORY = Path(__file__).resolve().parents[1]
# the installed package, which is the source tree in a development installation
PACKAGE = Path(astropolcal.__file__).resolve().parent
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.name != "_version.py")
LICENSE_LINE = "# Licensed under a 3-clause BSD style license - see LICENSE\n"

# a module is a subject; lines of code are those that are neither blank, comment nor docstring
MAX_MODULE_LINES = 600
MAX_FUNCTION_LINES = 60
# these were longer when the limit was set; the list may only shrink
LONG_MODULES = set()
LONG_FUNCTIONS = set()

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

# what is no interface for users
WITHOUT_REFERENCE_PAGE = {
    "conftest",
    "converters",
    "data",
    "resources",
    "scripts",
    "version",
}


def _id(path):
    return path.relative_to(PACKAGE).as_posix()


def _module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.fixture(scope="module")
def sources():
    """Text and syntax tree of each module by its path in the package."""
    texts = {_id(path): path.read_text(encoding="utf-8") for path in FILES}
    return {name: (text, ast.parse(text, filename=name)) for name, text in texts.items()}


def _documented(node):
    return isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))


def _code_lines(text, tree):
    """Lines that are neither blank, comment nor docstring."""
    docstrings = set()
    for node in ast.walk(tree):
        if _documented(node) and ast.get_docstring(node) is not None:
            docstrings.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return sum(
        1
        for i, line in enumerate(text.splitlines(), 1)
        if i not in docstrings and line.strip() and not line.lstrip().startswith("#")
    )


def _body_length(node):
    """Lines of a function's body without its docstring."""
    body = node.body if ast.get_docstring(node) is None else node.body[1:]
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


# --- size ---------------------------------------------------------------------


def test_no_module_is_too_long(sources):
    lengths = {name: _code_lines(*source) for name, source in sources.items()}
    long = {n: lines for n, lines in lengths.items() if lines > MAX_MODULE_LINES}
    assert not set(long) - LONG_MODULES, (
        f"lines of code {long}, allowed are {MAX_MODULE_LINES}: split by subject into a package "
        "whose __init__ keeps the public names"
    )


def test_no_function_is_too_long(sources):
    long = {
        f"{name}: {node.name}": _body_length(node)
        for name, (_, tree) in sources.items()
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and _body_length(node) > MAX_FUNCTION_LINES
    }
    assert not set(long) - LONG_FUNCTIONS, (
        f"lines of body {long}, allowed are {MAX_FUNCTION_LINES} without the docstring: "
        "give the steps names as functions"
    )


def test_lines_are_counted_without_docstrings():
    source = 'def f(x):\n    """One.\n\n    Two.\n    """\n    y = x\n\n    # why\n    return y\n'
    tree = ast.parse(source)
    assert _body_length(tree.body[0]) == 4
    assert _code_lines(source, tree) == 3


# --- names and docstrings -----------------------------------------------------


def test_files_have_license_line_and_docstrings(sources):
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    bare = []
    for name, (text, tree) in sources.items():
        assert text.startswith(LICENSE_LINE), (
            f"{name}: make the license line the first line, as in astropolcal/units.py"
        )
        assert ast.get_docstring(tree), f"{name}: say in a module docstring what it is for"
        # names with an underscore, and those of such a module, may do without
        if not re.search(r"(^|/)_(?!_)", name):
            nodes = [n for n in tree.body if isinstance(n, kinds) and n.name[0] != "_"]
            bare += [f"{name}: {n.name}" for n in nodes if not ast.get_docstring(n)]
    assert not bare, f"{bare} have no docstring; one sentence will do for private names"


def test_all_names_what_the_module_has():
    for name in map(_module_name, FILES):
        module = importlib.import_module(name)
        names = getattr(module, "__all__", [])
        missing = [n for n in names if not hasattr(module, n)]
        assert not missing, f"{name}: __all__ names {missing}, which the module does not have"
        assert len(set(names)) == len(names), f"{name}: __all__ repeats a name"


def test_no_name_hides_a_module():
    """Else it depends on what was imported first which of the two a name is."""
    for name in (_module_name(path) for path in FILES if path.name == "__init__.py"):
        package = importlib.import_module(name)
        modules = {info.name for info in pkgutil.iter_modules(package.__path__)}
        public = modules & set(getattr(package, "__all__", ()))
        hidden = [n for n in public if not inspect.ismodule(getattr(package, n))]
        assert not hidden, f"{name}: {hidden}: name the modules otherwise"


def _reference():
    """Module and options of everything that the pages of the reference show."""
    pattern = re.compile(r"automodapi:: (\S+)\n((?:[ ]+:.*\n)*)")
    for page in sorted((REPOSITORY / "docs" / "reference").glob("*.rst")):
        yield from pattern.findall(page.read_text(encoding="utf-8"))


def _top_level():
    names = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES}
    return sorted(name for name in names if name[0] != "_")


@pytest.fixture(scope="module")
def public():
    """Classes and functions that a package's ``__all__`` names or the reference shows."""
    if not (REPOSITORY / "docs").is_dir():
        pytest.skip("the documentation is not here")
    shown = set(_top_level()) - WITHOUT_REFERENCE_PAGE
    modules = {"astropolcal", *(f"astropolcal.{name}" for name in shown)}
    modules |= {module for module, _ in _reference()}
    found = {}
    for module in map(importlib.import_module, sorted(modules)):
        for thing in (getattr(module, name) for name in getattr(module, "__all__", ())):
            if inspect.isclass(thing) or inspect.isfunction(thing):
                found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return {name: found[name] for name in sorted(found) if name.startswith("astropolcal.")}


def _is_exception(thing):
    return inspect.isclass(thing) and issubclass(thing, BaseException)


def test_public_names_have_a_docstring_with_an_example(public):
    for name, thing in public.items():
        # read from the class itself: an inherited docstring describes another class
        doc = thing.__dict__.get("__doc__") if inspect.isclass(thing) else thing.__doc__
        assert doc, f"{name} has no docstring: write one in numpydoc form"
        _, _, example = inspect.cleandoc(doc).partition("Examples\n--------")
        assert _is_exception(thing) or ">>> " in example, (
            f"{name}: add an 'Examples' section with a few lines that run, which are tested, or "
            "take the name out of __all__"
        )


def _argument_names(function):
    return [n for n in inspect.signature(function).parameters if not n.startswith("_")]


def test_public_docstrings_are_numpydoc(public):
    docscrape = pytest.importorskip("numpydoc.docscrape", reason="numpydoc is not installed")
    for name, thing in public.items():
        # warns of sections that it does not know, and warnings are errors
        documentation = docscrape.NumpyDocString(inspect.cleandoc(thing.__doc__ or ""))
        if not inspect.isfunction(thing):
            continue
        described = {
            part.strip().lstrip("*")
            for section in ("Parameters", "Other Parameters")
            for entry in documentation[section]
            for part in entry.name.split(",")
        }
        arguments = _argument_names(thing)
        # a function of one argument may say it all in its summary line
        assert described == set(arguments) or (not described and len(arguments) <= 1), (
            f"{name}: 'Parameters' describes {sorted(described)}, the arguments are "
            f"{arguments}: make them agree"
        )


def _definition(module, name):
    thing = getattr(module, name)
    if hasattr(thing, "__qualname__"):
        return thing.__module__, thing.__qualname__
    return (thing.__name__, "") if inspect.ismodule(thing) else (name, id(thing))


def _shown():
    for module_name, options in _reference():
        left_out = re.search(r":skip: (.*)", options)
        left_out = set(re.split(r",\s*", left_out.group(1))) if left_out else set()
        module = importlib.import_module(module_name)
        for name in set(getattr(module, "__all__", ())) - left_out:
            yield _definition(module, name)


def test_reference_shows_every_public_name():
    shown = set(_shown())
    for name in _top_level():
        module = importlib.import_module(f"astropolcal.{name}")
        names = getattr(module, "__all__", [])
        if name in WITHOUT_REFERENCE_PAGE or not names:
            continue
        page = REPOSITORY / "docs" / "reference" / f"{name}.rst"
        assert page.is_file(), (
            f"add docs/reference/{name}.rst, like the others there, and name it in docs/api.rst"
        )
        assert f"automodapi:: astropolcal.{name}\n" in page.read_text(encoding="utf-8")
        hidden = [n for n in names if _definition(module, n) not in shown]
        assert not hidden, (
            f"the reference does not show {hidden} of astropolcal.{name}: take them out of "
            "':skip:' or of __all__, or give their module an 'automodapi' on the page"
        )


def test_reference_introduces_the_names_to_start_with():
    page = (REPOSITORY / "docs" / "api.rst").read_text(encoding="utf-8")
    for name in sorted(set(astropolcal.__all__) - {"__version__"}):
        assert re.search(rf"`~?astropolcal\.([a-z_]+\.)*{name}`", page), (
            f"docs/api.rst: say in one line what astropolcal.{name} is for"
        )


# --- what the package must not do ---------------------------------------------


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


def test_nothing_executes_foreign_code(sources):
    found = {name: list(_forbidden(tree)) for name, (_, tree) in sources.items()}
    found = {name: where for name, where in found.items() if where}
    assert not found, (
        f"{found} can execute code hidden in a file: use ASDF, JSON or yaml.safe_load, and "
        "ordinary functions"
    )


def test_forbidden_code_is_recognized():
    for source in ("import pickle", "from pickle import load", "eval('1')", "yaml.load(f)"):
        assert list(_forbidden(ast.parse(source))), source
    for source in ("model.eval_all()", "yaml.safe_load(f)", "self.exec(1)"):
        assert not list(_forbidden(ast.parse(source))), source


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


def test_no_two_modules_import_each_other(sources):
    """In functions neither; only a name that is looked up by a string may lead upward."""
    trees = {_module_name(PACKAGE / name): tree for name, (_, tree) in sources.items()}
    graph = {name: set() for name in trees}
    for name, tree in trees.items():
        for node in (n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                graph[name].add(full if full in trees else node.module)
    # raises CycleError, which shows the circle
    order = list(TopologicalSorter(graph).static_order())
    assert order.index("astropolcal.mueller") < order.index("astropolcal.scripts.main")


def test_map_shows_contract_and_imports(monkeypatch):
    if not (REPOSITORY / "docs").is_dir():
        pytest.skip("the documentation is not here")
    monkeypatch.syspath_prepend(REPOSITORY / "docs")
    draw_architecture = importlib.import_module("draw_architecture")
    page = (REPOSITORY / "docs" / "architecture.rst").read_text(encoding="utf-8")
    table = re.split(r"^=+ +=+$", page, flags=re.MULTILINE)[2]
    rows = [re.findall(r"``(\w+)``", line[:38]) for line in table.splitlines()]
    layers, rooms, core = draw_architecture.contract()
    names = [name for layer in layers for name in layer]
    assert sorted(name for row in rows for name in row) == sorted(names), (
        "docs/architecture.rst: say in its table what each layer of setup.cfg holds"
    )
    drawn = draw_architecture.MAP.read_text(encoding="utf-8")
    assert drawn == draw_architecture.draw(), (
        "the map is not that of setup.cfg and the imports: run 'python docs/draw_architecture.py'"
    )
    for name in [*names, *(room for row in rooms for room in row)]:
        assert re.search(rf"\b{name}\b", drawn), name
    assert {"optics", "measurement"} <= core


def test_imports_that_others_imply_are_left_out(monkeypatch):
    monkeypatch.syspath_prepend(REPOSITORY / "docs")
    draw_architecture = importlib.import_module("draw_architecture")
    graph = {"a": {"b", "c", "d"}, "b": {"c"}, "c": set(), "d": set()}
    assert draw_architecture.reduced(graph) == [("a", "b"), ("a", "d"), ("b", "c")]


def test_metadata_live_in_one_place():
    # dependencies in both files make setuptools build a wheel without any
    text = (REPOSITORY / "setup.cfg").read_text(encoding="utf-8")
    for section in ("[options", "[metadata]", "[tool:pytest]"):
        assert section not in text, f"setup.cfg: move {section} to pyproject.toml"
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert "\ndependencies = [" in text
    assert "[tool.pytest.ini_options]" in text
