# Licensed under a 3-clause BSD style license - see LICENSE
"""What ASDF finds of this package, and what it costs a program that does not use it."""

import subprocess
import sys
from importlib.metadata import entry_points
from importlib.resources import files

import yaml

from astropolcal.converters.extension import (
    MANIFEST_URI,
    OPTIC_MODULES,
    get_converters,
    get_extensions,
    get_resource_mappings,
)

BASE = "asdf://astropolcal.org/astropolcal"


def test_each_file_of_the_resources_has_its_uri():
    """The place of a file and the id in it say the same."""
    found = {uri: text for mapping in get_resource_mappings() for uri, text in mapping.items()}
    root = files("astropolcal") / "resources"
    paths = [p for kind in ("schemas", "manifests") for p in (root / kind).rglob("*.yaml")]
    assert len(found) == len(paths) > 25
    for path in paths:
        inside = path.relative_to(root).with_suffix("").as_posix()
        assert yaml.safe_load(found[f"{BASE}/{inside}"])["id"] == f"{BASE}/{inside}"


def test_one_converter_for_each_tag():
    (extension,) = get_extensions()
    assert (
        extension.extension_uri
        == yaml.safe_load(
            (files("astropolcal") / "resources/manifests/astropolcal-1.0.0.yaml").read_text()
        )["extension_uri"]
    )
    of_converters = [tag for converter in get_converters() for tag in converter.tags]
    assert len(of_converters) == len(set(of_converters))
    assert {definition.tag_uri for definition in extension.tags} == set(of_converters)
    # one for each optic, one for chains, and one for calibrations of all versions
    assert len(get_converters()) == len(OPTIC_MODULES) + 2


def test_types_are_those_that_are_there():
    """They are named, not imported: a name that is wrong would never be converted."""
    from importlib import import_module

    for converter in get_converters():
        for name in converter.types:
            module, _, cls = name.rpartition(".")
            found = getattr(import_module(module), cls)
            assert found.__module__ == module
            assert found.__name__ == cls


def test_asdf_finds_both_functions():
    for group in ["asdf.resource_mappings", "asdf.extensions"]:
        named = [
            point for point in entry_points(group=group) if point.value.startswith("astropolcal.")
        ]
        assert {point.load() for point in named} <= {get_extensions, get_resource_mappings}, group
        assert len(named) == 1, group


def test_no_physics_is_imported_for_files_of_others():
    """Both are called whenever any file of ASDF is opened."""
    code = """
import sys
from astropolcal.converters.extension import get_extensions, get_resource_mappings
[list(mapping) for mapping in get_resource_mappings()], get_extensions()[0].converters
heavy = ("optics", "calibration", "chain", "measurement", "mueller", "observations")
print([name for name in heavy if f"astropolcal.{name}" in sys.modules])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_manifest_is_named_by_its_uri():
    assert any(MANIFEST_URI in mapping for mapping in get_resource_mappings())
    assert f"{BASE}/schemas/unheard-of" not in get_resource_mappings()[0]
