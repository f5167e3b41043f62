# Licensed under a 3-clause BSD style license - see LICENSE
"""The calibration as an object: values, validity, verdict, summary, comparison."""

from astropolcal.calibration.result.verdict import Verdict

__all__ = ["Verdict"]
