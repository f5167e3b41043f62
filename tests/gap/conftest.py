# Licensed under a 3-clause BSD style license - see LICENSE
"""Makes the small data of this folder importable, and their instruments known."""

import sys
from pathlib import Path

import pytest

# small data of this folder, and the star of the one above
sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]


@pytest.fixture
def own_instruments(monkeypatch):
    """Know the instruments of the tests by name."""
    from gap_setups import OWN

    from astropolcal import instruments

    monkeypatch.setattr(instruments, "_REGISTRY", instruments._REGISTRY | OWN)
