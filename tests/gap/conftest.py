# Licensed under a 3-clause BSD style license - see LICENSE
"""Makes the small data of gap_data.py importable in the tests of this folder."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
