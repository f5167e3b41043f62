# Licensed under a 3-clause BSD style license - see LICENSE
"""What stars leave open of the telescope's mirrors, and what would determine it."""

from astropolcal.chain import leaves
from astropolcal.optics import Rotator

__all__ = ["telescope_words"]


def telescope_words(finding, measurement):
    """
    Say which parameters of the mirrors before the half-wave plate the stars leave open.

    Parameters
    ----------
    finding : Identifiability
        With its null directions and those that are determined badly.
    measurement : Measurement
        The measurement.

    Returns
    -------
    list of str
        One sentence a mirror, if something is open.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from astropolcal.calibration._telescope import telescope_words
    >>> telescope_words(SimpleNamespace(directions=[], near_null=[]), SimpleNamespace(datasets=[]))
    []
    """
    open_names = {
        name
        for direction in (*finding.directions, *finding.near_null)
        for name in direction["parameters"]
    }
    held = measurement.free.at_bounds(measurement.vector()) if measurement.datasets else []
    # what ran to a bound is as open as what drifts
    at_bound = [n for n, stuck in zip(_names(measurement), held, strict=True) if stuck]
    words = []
    for mirror in sorted(_mirrors(measurement)):
        own = sorted(n for n in {*open_names, *at_bound} if n.startswith(f"{mirror}."))
        if own:
            words.append(
                f"{', '.join(own)}: an unpolarized star shows the diattenuation of {mirror} and "
                "nothing else, at any altitude, so the numbers of its law trade off; a star of "
                "known polarization over a wide range of parallactic angle adds the retardance, "
                "a measured film or index (a prior) does the rest"
            )
    return words


def _names(measurement):
    return measurement.free.names if measurement.datasets else []


def _mirrors(measurement):
    """Return the names of what stands between the parallactic angle and the half-wave plate."""
    found = set()
    for chain, _ in zip(getattr(measurement, "chains", ()), measurement.datasets, strict=False):
        train = leaves(chain)
        stages = [leaf.stage for leaf in train]
        # the plate ends the telescope, or where there is none its last axis
        last = next((s for s in ("hwp", "altitude") if s in stages), None)
        if "parallactic" in stages and last is not None:
            inner = train[stages.index("parallactic") + 1 : stages.index(last)]
            found |= {leaf.name for leaf in inner if not isinstance(leaf, Rotator)}
    return found
