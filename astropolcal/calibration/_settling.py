# Licensed under a 3-clause BSD style license - see LICENSE
"""Which star settles on sky what the data leave open."""

from functools import lru_cache

import numpy as np

from astropolcal import standards

# a star that culminates lower has little range of parallactic angle, and much air in front
_LOW = 45.0
_EQUATOR = 60.0


def star_words(site):
    """Return a polarized standard star in words, with the name of the best one for a site."""
    name, high = _best_star(None if site is None else site.to_geodetic().lat.deg)
    reach = "" if high is None else f", which reaches {high:.0f} deg here"
    return f"a polarized standard star over a range of parallactic angle (such as {name}{reach})"


@lru_cache
def _best_star(latitude):
    """Return name and greatest altitude of the star whose angle frames tell best."""
    stars, _ = standards.catalogue()
    numbers = {key: np.array(stars[key].value, dtype=float) for key in ("p_max", "p_max_err", "V")}
    high = 90 - np.abs(stars["dec"].to_value("deg") - (latitude or 0.0))
    # photon noise of the angle; a law without errors does not tell what is known of the star
    score = numbers["p_max"] * 10 ** (-0.2 * numbers["V"])
    known = np.isfinite(score) & np.isfinite(numbers["p_max_err"])
    # without a site one that most of them see, as it stands high over the equator
    seen = known & (high >= (_LOW if latitude is not None else _EQUATOR))
    best = int(np.argmax(np.where(seen if seen.any() else known, score, -np.inf)))
    return str(stars["name"][best]), None if latitude is None else float(high[best])
