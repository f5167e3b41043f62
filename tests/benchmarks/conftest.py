# Licensed under a 3-clause BSD style license - see LICENSE
"""Lets the benchmarks import what times them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
