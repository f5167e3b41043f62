# Licensed under a 3-clause BSD style license - see LICENSE
"""Fixtures and settings common to all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

REPOSITORY = Path(__file__).resolve().parents[1]

# no window system is needed to test a figure
os.environ.setdefault("MPLBACKEND", "agg")

# the same examples every time, however slow the machine
settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_configure(config):
    """Name the versions that matter in the header of the report."""
    try:
        from pytest_astropy_header.display import PYTEST_HEADER_MODULES, TESTED_VERSIONS
    except ImportError:
        return
    config.option.astropy_header = True
    PYTEST_HEADER_MODULES.clear()
    for name in ("numpy", "scipy", "astropy", "asdf", "matplotlib", "photutils", "specutils"):
        PYTEST_HEADER_MODULES[name] = name
    from astropolcal.version import version

    TESTED_VERSIONS["astropolcal"] = version


@pytest.fixture(scope="session")
def repository():
    """Root folder of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data():
    """Folder of reference measurements beside the repository, or skip."""
    folder = REPOSITORY.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"reference data are absent: no folder {folder.name!r} beside the repository")
    return folder
