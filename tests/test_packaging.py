# Licensed under a 3-clause BSD style license - see LICENSE
"""What is built, what it depends on, and the workflows that check both agree with each other."""

import configparser
import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import astropolcal

REPOSITORY = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))


def _text(*parts):
    return REPOSITORY.joinpath(*parts).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def project():
    return tomllib.loads(_text("pyproject.toml"))["project"]


@pytest.fixture(scope="module")
def tool():
    return tomllib.loads(_text("pyproject.toml"))["tool"]


@pytest.fixture(scope="module")
def tox():
    parsed = configparser.ConfigParser(interpolation=None)
    parsed.read(REPOSITORY / "tox.ini", encoding="utf-8")
    return parsed


@pytest.fixture(scope="module")
def environments(tox):
    """Names of the environments of tox, those with factors written out."""
    listed = tox["tox"]["env_list"].split()
    written = []
    for name in listed:
        factors = re.search(r"\{(.*)\}", name)
        for factor in factors.group(1).split(",") if factors else [""]:
            written.append(re.sub(r"\{.*\}", factor, name))
    return set(written) | {s.removeprefix("testenv:") for s in tox.sections() if ":" in s}


def _requirement(text):
    """Name and lower limit of a requirement."""
    name, _, rest = re.match(r"([\w-]+)(\[.*\])?(.*)", text).groups()
    return name, re.search(r">=\s*([\d.]+)", rest).group(1)


# --- dependencies -----------------------------------------------------------------------


def test_every_dependency_has_a_lower_limit(project):
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    own = f"{project['name']}["
    without = [
        text for texts in lists for text in texts if not text.startswith(own) and ">=" not in text
    ]
    assert not without, f"pyproject.toml: say from which version on {without} will do"


def test_oldest_environment_pins_the_lower_limits(project, tox):
    """The versions that we promise to work with are those that are tested."""
    pins = dict(re.findall(r"^([\w-]+)==([\d.]+)\.\*$", tox["testenv:oldest"]["deps"], re.M))
    assert pins == dict(map(_requirement, project["dependencies"]))


def test_base_python_of_the_oldest_environment(project, tox):
    oldest = project["requires-python"].removeprefix(">=")
    assert tox["testenv:oldest"]["base_python"] == "py" + oldest.replace(".", "")


def test_classifiers_name_the_tested_versions_of_python(project, environments):
    named = {
        text.rpartition(" ")[2].replace(".", "")
        for text in project["classifiers"]
        if re.search(r":: 3\.\d+$", text)
    }
    tested = {name[2:-5] for name in environments if re.fullmatch(r"py\d+-test", name)}
    assert named == tested
    assert min(named) == project["requires-python"].removeprefix(">=").replace(".", "")


def test_everything_that_is_imported_is_a_dependency(project):
    """No module of the package imports what an installation would not have."""
    # astropy itself needs pyerfa and PyYAML
    names = {"asdf_astropy": "asdf-astropy", "arviz_stats": "arviz-stats"}
    names |= dict.fromkeys(("erfa", "yaml"), "astropy")
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    known = {re.match(r"[\w-]+", text).group().lower() for texts in lists for text in texts}
    pattern = re.compile(r"^\s*(?:from|import) (\w+)", re.M)
    for path in Path(astropolcal.__file__).parent.rglob("*.py"):
        # of a docstring only the examples import anything, behind their prompt
        code = re.sub(r'"{3}.*?"{3}', "", path.read_text(encoding="utf-8"), flags=re.S)
        for name in set(pattern.findall(code)) - set(sys.stdlib_module_names) - {"astropolcal"}:
            assert names.get(name, name).lower() in known, f"{path.name} imports {name}"


def test_installation_page_lists_every_extra(project):
    for extra in ["mcmc", "materials", "dask", "completion", "all", "test", "docs"]:
        assert extra in project["optional-dependencies"], extra
        assert re.search(rf"^``{extra}`` +\w", _text("docs", "installation.rst"), re.M), extra


def test_installation_page_lists_the_dependencies(project):
    page = " ".join(_text("docs", "installation.rst").split())
    (listed,) = re.findall(r"installs it with what it needs: (.*?)\.", page)
    needed = {name for name, _ in map(_requirement, project["dependencies"])}
    assert set(re.split(r", | and ", listed)) == needed


def test_entry_points_lead_somewhere(project):
    groups = [*project["entry-points"].values(), project["scripts"]]
    for where in (where for group in groups for where in group.values()):
        module, _, name = where.partition(":")
        assert callable(getattr(importlib.import_module(module), name)), where


# --- what is in the wheel ---------------------------------------------------------------


def test_package_data_names_every_file_that_is_no_module(tool):
    """A template or schema that no pattern names would be missing after an installation."""
    package = REPOSITORY / "astropolcal"
    if not package.is_dir():
        pytest.skip("no source tree")
    patterns = tool["setuptools"]["package-data"]["astropolcal"]
    named = {path for pattern in patterns for path in package.glob(pattern)}
    others = {
        path
        for path in package.rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc") and "__pycache__" not in path.parts
    }
    assert others == named


def test_installed_package_has_its_data():
    for pattern in ["resources/**/*.yaml", "data/*.ecsv", "data/*.toml", "gap/templates/*.html"]:
        assert list(Path(astropolcal.__file__).parent.glob(pattern)), pattern


def test_every_folder_of_modules_is_a_package():
    """``find`` leaves out a folder without ``__init__.py``."""
    folders = {path.parent for path in Path(astropolcal.__file__).parent.rglob("*.py")}
    assert all((folder / "__init__.py").is_file() for folder in folders)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A copy of the sources that git knows, and the wheel made of it."""
    # older ones do not know a license as an expression
    pytest.importorskip("setuptools", minversion="77")
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(git, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a clone")
    # a copy, since a build writes into the folder of its source
    source = tmp_path_factory.mktemp("source")
    for name in listed.stdout.splitlines():
        if (REPOSITORY / name).is_file() and (name.startswith("astropolcal/") or "/" not in name):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((REPOSITORY / name).read_bytes())
    files = {p.relative_to(source).as_posix() for p in source.glob("astropolcal/**/*.*")}
    # the version is not what is tested, so setuptools-scm is not needed
    config = source / "pyproject.toml"
    text = config.read_text(encoding="utf-8").replace('dynamic = ["version"]', 'version = "0"')
    config.write_text(text, encoding="utf-8")
    target = tmp_path_factory.mktemp("wheel")
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(target)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, check=True)
    (wheel,) = target.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        yield files, archive


@pytest.mark.slow
def test_wheel_has_the_package_and_nothing_else(built):
    files, archive = built
    inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert inside == files
    assert not any(Path(name).name.startswith("test_") for name in inside)


@pytest.mark.slow
def test_wheel_says_what_it_needs(built, project):
    """Metadata in two places make setuptools leave out the dependencies."""
    (name,) = [name for name in built[1].namelist() if name.endswith(".dist-info/METADATA")]
    metadata = built[1].read(name).decode()
    needed = re.findall(r"^Requires-Dist: ([\w-]+)[^;\n]*$", metadata, re.M)
    assert set(needed) == {name for name, _ in map(_requirement, project["dependencies"])}
    assert f"Requires-Python: {project['requires-python']}" in metadata
    assert "License-Expression: BSD-3-Clause" in metadata


# --- workflows --------------------------------------------------------------------------


def _jobs(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]


def _steps(path):
    return [(name, step) for name, job in _jobs(path).items() for step in job["steps"]]


def _environments_of(job):
    """Environments of tox that a job runs, those of its matrix too."""
    matrix = job.get("strategy", {}).get("matrix", {})
    named = {case["toxenv"] for case in matrix.get("include", [])} | set(matrix.get("toxenv", []))
    commands = " ".join(step.get("run", "") for step in job["steps"])
    return named | set(re.findall(r"tox -e ([\w-]+)", commands))


def test_workflow_is_there():
    for name in ["tests", "docs", "release", "audit"]:
        assert REPOSITORY / ".github" / "workflows" / f"{name}.yml" in WORKFLOWS, name


def test_workflows_run_environments_that_tox_has(environments):
    for path in WORKFLOWS:
        for name, job in _jobs(path).items():
            assert _environments_of(job) <= environments, f"{path.name}, {name}"


def test_every_environment_is_run_by_a_workflow(environments):
    jobs = [job for path in WORKFLOWS for job in _jobs(path).values()]
    run = set().union(*map(_environments_of, jobs))
    # a look before a commit, and measurements that a shared machine would spoil
    assert environments - run == {"fast", "benchmarks"}


def test_workflow_has_few_rights_and_pinned_actions():
    for path in WORKFLOWS:
        text = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert text["permissions"] == {"contents": "read"}, path
        for name, step in _steps(path):
            if "uses" in step:
                assert re.fullmatch(r"[\w.-]+/[\w.-]+@(v\d+|release/v\d+)", step["uses"]), name
            if step.get("uses", "").startswith("actions/checkout@"):
                # setuptools-scm reads the version off the tags
                assert step["with"] == {"fetch-depth": 0, "persist-credentials": False}, path


def test_workflows_use_one_version_of_each_action():
    used = {step["uses"] for path in WORKFLOWS for _, step in _steps(path) if "uses" in step}
    names = [each.partition("@")[0] for each in used]
    assert sorted(names) == sorted(set(names))


def test_matrix_runs_every_python_with_its_own_environment():
    job = _jobs(REPOSITORY / ".github" / "workflows" / "tests.yml")["tests"]
    cases = job["strategy"]["matrix"]["include"]
    assert {case["os"].partition("-")[0] for case in cases} == {"ubuntu", "macos", "windows"}
    for case in cases:
        if case["toxenv"].startswith("py"):
            assert case["toxenv"] == f"py{case['python'].replace('.', '')}-test"


def test_publishing_waits_for_the_checks_and_a_tag():
    jobs = _jobs(REPOSITORY / ".github" / "workflows" / "release.yml")
    assert jobs["publish"]["needs"] == "build"
    assert "startsWith(github.ref, 'refs/tags/v')" in jobs["publish"]["if"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"}


def test_hooks_have_versions():
    repositories = yaml.safe_load(_text(".pre-commit-config.yaml"))["repos"]
    assert all(re.fullmatch(r"v?\d+\.\d+(\.\d+)?", each["rev"]) for each in repositories)


def test_read_the_docs_installs_what_the_pages_need(project):
    config = yaml.safe_load(_text(".readthedocs.yaml"))
    (install,) = config["python"]["install"]
    assert set(install["extra_requirements"]) <= set(project["optional-dependencies"])
    assert config["sphinx"]["fail_on_warning"] is True
    assert (REPOSITORY / config["sphinx"]["configuration"]).is_file()


# --- changelog and citation -------------------------------------------------------------

FRAGMENTS = sorted(p for p in (REPOSITORY / "docs" / "changes").glob("*.rst") if p.stem != "README")


@pytest.fixture(scope="module")
def kinds(tool):
    return {kind["directory"] for kind in tool["towncrier"]["type"]}


def test_changelog_has_a_place_for_fragments(tool):
    start = tool["towncrier"]["start_string"]
    assert _text(tool["towncrier"]["filename"]).count(start.strip()) == 1


def test_kinds_of_fragments_are_explained(kinds):
    explained = re.findall(r"^- ``(\w+)``", _text("docs", "changes", "README.rst"), re.M)
    assert set(explained) == kinds


def test_fragment_is_named_and_written_as_it_should_be(kinds):
    for path in FRAGMENTS:
        found = re.fullmatch(r"(\+\w+|\d+)\.(\w+)\.rst", path.name)
        assert found, f"docs/changes/{path.name}: NUMBER.TYPE.rst, or +word.TYPE.rst"
        assert found.group(2) in kinds, f"docs/changes/{path.name}: TYPE is one of {sorted(kinds)}"
        text = path.read_text(encoding="utf-8")
        assert text.strip().endswith("."), f"docs/changes/{path.name}: one or two sentences"
        assert len(text.split()) < 120, f"docs/changes/{path.name}: one or two sentences"


def test_citation_is_complete(project):
    citation = yaml.safe_load(_text("CITATION.cff"))
    assert {"cff-version", "title", "message", "authors"} <= set(citation)
    assert citation["license"] == project["license"]
    assert citation["repository-code"] == project["urls"]["Source"]
    for reference in citation["references"]:
        assert {"type", "title", "authors", "year"} <= set(reference)
        assert re.fullmatch(r"10\.\d{4,}/\S+", reference.get("doi", "10.1234/none"))


def test_citation_has_the_authors_of_the_paper(shared_data):
    """All authors of the recalibration, in their order."""
    source = (shared_data / "paper" / "charis_recalibration.tex").read_text(encoding="utf-8")
    names = re.findall(r"^\\author\[.*?\]\{(.*?)\}", source, re.M)
    cited = yaml.safe_load(_text("CITATION.cff"))["references"][0]["authors"]
    assert [f"{a['given-names']} {a['family-names']}" for a in cited] == names
