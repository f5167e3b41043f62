# Licensed under a 3-clause BSD style license - see LICENSE
"""Settings for the examples in the docstrings, which run as tests."""

import os

import pytest

# pytest finds what it needs by itself
__all__ = []

# examples that draw need no window system
os.environ.setdefault("MPLBACKEND", "agg")


def pytest_ignore_collect(config):
    """Where slow tests are left out, examples are not even looked for: all of them are slow."""
    return True if config.option.markexpr == "not slow" else None


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path, monkeypatch):
    """Run each example in a folder of its own, so that none leaves files there."""
    monkeypatch.chdir(tmp_path)
