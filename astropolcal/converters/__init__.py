# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibration files: nodes of an ASDF tree, and the files themselves."""

__all__ = []

#: Versions of the schema of calibrations that can be read, oldest first; the newest is written.
CALIBRATION_TAGS = tuple(
    f"tag:astropolcal.org:astropolcal/calibration-{version}" for version in ("1.0.0", "1.1.0")
)
CALIBRATION_TAG = CALIBRATION_TAGS[-1]
