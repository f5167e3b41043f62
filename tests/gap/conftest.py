# Licensed under a 3-clause BSD style license - see LICENSE
"""Makes the small data of this folder importable, and their instruments known."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))


@pytest.fixture
def own_instruments(monkeypatch):
    """Know the instruments of the tests by name."""
    from gap_setups import OWN

    from astropolcal import instruments

    monkeypatch.setattr(instruments, "_REGISTRY", instruments._REGISTRY | OWN)
