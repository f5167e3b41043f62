# Licensed under a 3-clause BSD style license - see LICENSE
"""Schemas and manifest are valid, complete, packaged, and agree with the classes."""

from importlib.metadata import PackageNotFoundError, distribution
from importlib.resources import files

import asdf
import pytest
import yaml
from asdf.schema import check_schema, load_schema

from astropolcal.converters.extension import (
    MANIFEST_URI,
    get_converters,
    get_extensions,
    get_resource_mappings,
    optic_tag,
)
from astropolcal.optics import OPTICS

ROOT = files("astropolcal") / "resources"
SCHEMAS = {
    uri: content
    for mapping in get_resource_mappings()
    for uri, content in mapping.items()
    if "/schemas/" in uri
}
KINDS = {"angle": "deg", "thickness": "mm", "film": "nm", "number": None}


def manifest():
    return yaml.safe_load((ROOT / "manifests" / "astropolcal-1.0.0.yaml").read_text())


def schema_of(name):
    stem = optic_tag(name).rpartition("/")[2]
    return yaml.safe_load((ROOT / "schemas" / "optics" / f"{stem}.yaml").read_text())


def test_there_are_schemas_for_all():
    # one an optic, what they share, and two versions of the calibration with what they share
    assert len(SCHEMAS) == len(OPTICS) + 4


@pytest.mark.slow
def test_schema_is_valid():
    for uri in sorted(SCHEMAS):
        schema = yaml.safe_load(SCHEMAS[uri])
        assert schema["id"] == uri
        assert schema["title"]
        check_schema(load_schema(uri, resolve_references=True))


def test_every_tag_has_a_schema_and_every_schema_a_tag():
    entries = manifest()["tags"]
    tagged = {entry["schema_uri"] for entry in entries}
    shared = {uri for uri in SCHEMAS if "/optics/optic-" in uri or "/fit-" in uri}
    assert tagged | shared == set(SCHEMAS)
    for entry in entries:
        tag, uri = entry["tag_uri"], entry["schema_uri"]
        assert tag.partition("/")[2] == uri.partition("/schemas/")[2]


def test_manifest_lists_the_tags_of_all_converters():
    converted = {tag for converter in get_converters() for tag in converter.tags}
    listed = {entry["tag_uri"] for entry in manifest()["tags"]}
    assert listed == converted, "resources/manifests and the converters name different tags"
    (extension,) = get_extensions()
    assert {tag.tag_uri for tag in extension.tags} == converted
    assert manifest()["id"] == MANIFEST_URI


def test_schema_has_the_parameters_units_and_settings_of_the_class():
    for name in sorted(OPTICS):
        cls = OPTICS[name]
        parameters = schema_of(name)["properties"]["parameters"]
        message = f"the schema of {name} and its class differ: a changed class needs a new version"
        assert parameters["required"] == list(cls.param_names), message
        assert parameters["additionalProperties"] is False
        assert set(parameters["properties"]) == set(cls.param_names), message
        for key, entry in parameters["properties"].items():
            (reference,) = entry["allOf"]
            unit = cls()._declared(key).unit
            kind = reference["$ref"].rpartition("/")[2]
            assert KINDS[kind] == (unit and unit.to_string()), f"{name}.{key}: {message}"
    for name in sorted(OPTICS):
        schema = schema_of(name)
        assert set(schema["properties"]) == set(OPTICS[name]()._settings()) | {"parameters"}
        assert schema["additionalProperties"] is False


def test_asdf_finds_the_schemas_of_the_installed_package():
    try:
        distribution("astropolcal")
    except PackageNotFoundError:
        pytest.skip("astropolcal is on the path but not installed, so it has no entry points")
    manager = asdf.get_config().resource_manager
    for uri in [*SCHEMAS, MANIFEST_URI]:
        assert manager[uri].startswith(b"%YAML 1.1")


def test_resources_are_packaged(repository):
    pyproject = (repository / "pyproject.toml").read_text(encoding="utf-8")
    assert '"resources/**/*.yaml"' in pyproject
    assert all(path.suffix == ".yaml" for path in ROOT.rglob("*.*")), "only *.yaml is packaged"
