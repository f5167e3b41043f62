# Licensed under a 3-clause BSD style license - see LICENSE
"""
Whether an instrument does what the rest of the package relies on.

`check_instrument` takes any instrument, also one of another package, which can run it in its
own tests.
"""

from astropolcal.testing.conformance import RULES, Conformance, check_instrument

__all__ = ["RULES", "Conformance", "check_instrument"]
