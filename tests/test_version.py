# Licensed under a 3-clause BSD style license - see LICENSE
"""The version is known however the package got here."""

import importlib.metadata
import importlib.util
import sys
from types import SimpleNamespace

import pytest

from astropolcal import version as module


@pytest.fixture
def fresh_version():
    """Execute the module anew under another name, and return its version."""

    def load():
        spec = importlib.util.spec_from_file_location("_fresh_version", module.__file__)
        fresh = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(fresh)
        return fresh.version

    return load


def test_built_version_comes_first(monkeypatch, fresh_version):
    monkeypatch.setitem(sys.modules, "astropolcal._version", SimpleNamespace(version="1.2.3"))
    assert fresh_version() == "1.2.3"


def test_unbuilt_tree_asks_the_installed_distribution(monkeypatch, fresh_version):
    monkeypatch.setitem(sys.modules, "astropolcal._version", None)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: f"4.5.6 of {name}")
    assert fresh_version() == "4.5.6 of astropolcal"


def test_unknown_version_is_said_to_be_unknown(monkeypatch, fresh_version):
    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setitem(sys.modules, "astropolcal._version", None)
    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert fresh_version() == "0.0.0+unknown"
