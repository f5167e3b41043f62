# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an open direction, or a mirror branch, does to the polarization measured on sky.

The data that were fitted may not change, and yet the q and u that the same optics give of the sky
do. Rotation and gain are the same for all degrees of polarization; instrumental polarization that
is subtracted wrongly is not, and matters the more the fainter the polarization is.
"""

import numpy as np

from astropolcal.calibration._sky_view import view_of_measurement

__all__ = ["sky_consequences"]

#: Degrees of linear polarization for which consequences are given, percent.
DOLPS = (30.0, 1.0, 0.1)
# angles of polarization among which least and largest are sought
_DOUBLE = 2 * np.deg2rad(np.arange(0, 180, 7.5))
# changes on sky that are not worth a number, degree and percent
_NOTHING = 0.005
# and those of a source of 1 % that are worth a warning
_MATTERS = {"aolp_deg": 0.1, "dolp_change_percent": 1.0}


def sky_consequences(measurement, vector, directions, instrument=None):
    """
    Return how recovered AoLP and DoLP change along given directions.

    Parameters
    ----------
    measurement : Measurement
        The measurement. The light comes from the sky through the telescope of a star's chain, or
        through that which the instrument publishes; where there is neither the telescope is left
        out, and the light begins with the first optic on a stage.
    vector : `~numpy.ndarray`
        The solution, canonical values, shape (n_free,).
    directions : `~numpy.ndarray`
        Canonical changes, shape (n_directions, n_free).
    instrument : str, optional
        Name of the instrument, for its telescope.

    Returns
    -------
    list of dict or None
        For each direction ``targets``, a list with an entry for sources of 30, 1 and 0.1 %
        (``dolp_percent``): least and largest change of the AoLP in degree, ``aolp_deg``, and of
        the DoLP in percent of itself, ``dolp_change_percent``, to first order, over wavelengths,
        angles of polarization, and a few settings of telescope and derotator, each one cycle of
        the half-wave plate. ``aolp_deg`` and ``dolp_percent`` beside it are those of 30 %. None
        where the chain has no half-wave plate.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import sky_consequences
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[60, 85] * u.deg)
    >>> measurement = Measurement(chain, simulate(chain, charis.wavelength, frames, seed=1))
    >>> turn = np.zeros((1, measurement.free.size))
    >>> turn[0, measurement.free.by_name["hwp.theta"].start] = np.deg2rad(1)
    >>> sky = sky_consequences(measurement, measurement.vector(), turn)[0]
    >>> [round(max(map(abs, target["aolp_deg"])), 1) for target in sky["targets"]]
    [2.1, 2.1, 2.1]

    The tertiary mirror polarizes, and with a plate at a wrong angle its polarization is
    subtracted at a wrong angle, too:

    >>> sky = sky_consequences(measurement, measurement.vector(), turn, "charis")[0]
    >>> [round(max(map(abs, target["aolp_deg"])), 1) for target in sky["targets"]]
    [2.4, 5.7, 37.4]
    """
    view = view_of_measurement(measurement, vector, instrument)
    return consequences_along(view, directions)


def consequences_along(view, directions):
    """Return the consequences of small steps; None for each direction without a view."""
    if view is None or not len(directions):
        return [None] * len(directions)
    return [_consequences(change[view.good], _small) for change in view.along(directions)]


def consequences_of(view, chain):
    """Return the consequences of taking another chain for the true one, however far it is."""
    change = view.against(chain)
    return _consequences(change[np.isfinite(change).all(axis=(-2, -1))], _whole)


def _consequences(matrices, changed):
    """Return least and largest change for each degree of polarization."""
    targets = []
    for dolp in DOLPS:
        turn, gain = changed(matrices, dolp / 100)
        # an angle cannot be off by more than 90 deg
        turn = np.clip(np.rad2deg(turn), -90, 90)
        spans = {"aolp_deg": _span(turn), "dolp_change_percent": _span(100 * gain)}
        targets.append({"dolp_percent": dolp} | spans)
    first = targets[0]
    both = {"aolp_deg": first["aolp_deg"], "dolp_percent": first["dolp_change_percent"]}
    return both | {"targets": targets}


def light_of(dolp, double=_DOUBLE):
    """Return I, Q and U of light of a degree of polarization at angles, (3, n_angles)."""
    return np.stack([np.ones_like(double), dolp * np.cos(double), dolp * np.sin(double)])


# ---- in words ---------------------------------------------------------------------------


def sky_words(sky):
    """Say what a direction or a branch does on sky."""
    if not shows_on_sky(sky):
        return "on sky nothing changes"
    each = [
        (f"{target['dolp_percent']:g} %", *map(_size, _largest(target)))
        for target in targets_of(sky)
    ]
    (dolp, turn, gain), *fainter = each
    turned, gained = (f"up to {size}" if size[0].isdigit() else size for size in (turn, gain))
    words = f"on sky the AoLP changes by {turned} deg and the DoLP by {gained} % of itself"
    if all(one[1:] == (turn, gain) for one in each):
        return f"{words}, whatever the DoLP"
    others = (f"{dolp}: {turn} deg, {gain} %" for dolp, turn, gain in fainter)
    return "; ".join([f"{words} for a source of {dolp}", *others])


def targets_of(sky):
    """Return the entries for each degree of polarization; a file of before has one."""
    first = {"dolp_percent": DOLPS[0], "aolp_deg": sky["aolp_deg"]}
    return sky.get("targets") or [first | {"dolp_change_percent": sky["dolp_percent"]}]


def shows_on_sky(sky):
    """Return whether the AoLP or the DoLP on sky changes by what is worth a word."""
    return max(max(_largest(target)) for target in targets_of(sky)) >= _NOTHING


def matters(sky):
    """Return whether a source of 1 % changes by so much that a warning is due."""
    target = next(t for t in targets_of(sky) if t["dolp_percent"] == DOLPS[1])
    return any(max(map(abs, target[key])) > limit for key, limit in _MATTERS.items())


def _largest(target):
    return [max(map(abs, target[key])) for key in ("aolp_deg", "dolp_change_percent")]


def _size(value):
    if value < _NOTHING:
        return "less than 0.01"
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


# ---- numbers ----------------------------------------------------------------------------


def _small(matrices, dolp):
    """Return the changes of angle and degree (of itself) to first order."""
    light = light_of(dolp)
    change, (q, u) = matrices @ light, light[1:]
    # q is Q / I, and what is found of I may change, too
    dq, du = (change[..., i, :] - light[i] * change[..., 0, :] for i in (1, 2))
    return (q * du - u * dq) / (2 * dolp**2), (q * dq + u * du) / dolp**2


def _whole(matrices, dolp):
    """Return the changes of angle and degree (of itself), however large."""
    light = light_of(dolp)
    found = light + matrices @ light
    # q + iu, over that of the source: its modulus is the gain, half its phase the turn
    ratio = (found[..., 1, :] + 1j * found[..., 2, :]) / found[..., 0, :]
    ratio = ratio / (light[1] + 1j * light[2])
    return np.angle(ratio) / 2, np.abs(ratio) - 1


def _span(values):
    if not values.size:
        return [0.0, 0.0]
    # adding zero turns -0.0 into 0.0
    return [round(float(values.min()), 4) + 0.0, round(float(values.max()), 4) + 0.0]
