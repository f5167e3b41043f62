# Licensed under a 3-clause BSD style license - see LICENSE
"""Fixtures of the reduction; what makes the cubes is in reduction_lab.py."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from reduction_lab import Small, expose, pair, star_image


@pytest.fixture(scope="session")
def small():
    """CHARIS with few wavelengths."""
    return Small()


@pytest.fixture(scope="session")
def star_cube(small):
    """Noisy slices of a star."""
    return expose(star_image(pair(small.files)), small.files)


@pytest.fixture(scope="session")
def flat_cube(small):
    """Noisy slices of an evenly lit field."""
    return expose(np.full((201, 201), 500.0), small.files)
