# Licensed under a 3-clause BSD style license - see LICENSE
"""``python -m astropolcal`` is the command ``astropolcal``."""

import sys

from astropolcal.scripts.main import main

if __name__ == "__main__":
    sys.exit(main())
