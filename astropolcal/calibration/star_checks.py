# Licensed under a 3-clause BSD style license - see LICENSE
"""
Check of a calibration with a star of known polarization that no fit has seen.
"""

import astropy.units as u
import numpy as np

from astropolcal import standards
from astropolcal.calibration.standards import refuse_fitted, rows_on_grid
from astropolcal.calibration.stars import star_accuracy, star_stokes
from astropolcal.calibration.targets import target_accuracies
from astropolcal.exceptions import (
    AstropolcalError,
    ObservationError,
    WavelengthRangeError,
)
from astropolcal.stokes import polarization_angle

__all__ = ["add_star_check", "star_check"]

# what is kept with a calibration, and in which unit
_KEPT = {
    "dolp": u.percent,
    "dolp_err": u.percent,
    "dolp_sys_err": u.percent,
    "dolp_known": u.percent,
    "dolp_known_err": u.percent,
    "aolp": u.deg,
    "aolp_err": u.deg,
    "aolp_sys_err": u.deg,
    "aolp_known": u.deg,
    "aolp_known_err": u.deg,
    "dolp_error": u.percent,
    "aolp_error": u.deg,
    "s_dolp": u.percent,
    "s_q": u.percent,
    "s_u": u.percent,
}


def star_check(calibration, chain, observations, positions=None, star=None):
    """
    Compare the polarization of a standard star with that of the catalogue, per wavelength.

    Every half-wave-plate cycle is inverted with the calibration, see
    `~astropolcal.calibration.star_stokes`; the means are compared with the Serkowski law of the
    star, or with zero. This is the check with HD 30675 of McIntosh et al. (2026, appendix).

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    chain : `~astropy.modeling.CompoundModel`
        Chain of the star, with a `~astropolcal.optics.PolarizedSource` first.
    observations : Observations
        The star; it must not have taken part in the fit.
    positions : dict of str to `~numpy.ndarray`, optional
        See `~astropolcal.measurement.Measurement`.
    star : str or `~astropolcal.standards.StandardStar`, optional
        The standard, by default the ``object`` of the table.

    Returns
    -------
    `~astropy.table.QTable`
        The columns of `~astropolcal.calibration.star_stokes` and
        `~astropolcal.calibration.star_accuracy`; ``dolp_sys_err`` and ``aolp_sys_err``, what the
        calibration claims of such light, see `~astropolcal.calibration.target_accuracies`; and
        ``q_known``, ``u_known``, ``dolp_known``,
        ``aolp_known`` of the catalogue with ``dolp_known_err`` and ``aolp_known_err``, NaN
        where no errors are published. Meta ``star``, ``name`` and ``words``.

    Raises
    ------
    FitError
        If the observations took part in the fit.
    ObservationError
        If the table does not name its star, or the catalogue has no polarization for it.
    ChainError
        If the chain has no polarized source.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments, optics, standards
    >>> from astropolcal.calibration import star_check
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2))
    >>> known = standards.get("HD 30675").stokes(lam)
    >>> star = optics.PolarizedSource(q=known.q, u=known.u, name="star")
    >>> sky = star | chain["hwp"] | chain["derotator"] | chain["wollaston"]
    >>> night = simulate(sky, lam, frames, seed=3, meta={"object": "HD 30675"})
    >>> table = star_check(cal, sky, night)
    >>> print(table["dolp"].round(1), table["dolp_known"].round(1))
    [2.  1.1 0.5] % [2.  1.1 0.5] %
    """
    refuse_fitted(calibration, observations)
    known = _known(observations, star)
    table = star_stokes(calibration, chain, observations, positions)
    table.meta |= {"name": observations.name, "star": known.name}
    q, stokes_u, covariance = known.stokes(table["wavelength"])
    accuracy = star_accuracy(table, q, stokes_u)
    for key in accuracy.colnames[1:]:
        table[key] = accuracy[key]
    _add_known(table, np.asarray(q), np.asarray(stokes_u), covariance)
    _add_claims(table, calibration, rows_on_grid(calibration, observations))
    table.meta["words"] = _words(table)
    return table


def _known(observations, star):
    """Return the standard star, if the catalogue knows its polarization."""
    if star is None:
        star = observations.meta.get("object")
        if not star:
            raise ObservationError(
                f"{observations.name}: no entry 'object' in the table's meta names the star"
            )
    found = star if isinstance(star, standards.StandardStar) else standards.get(str(star))
    try:
        found.stokes(observations.wavelength)
    except WavelengthRangeError:
        raise
    except AstropolcalError as error:
        raise ObservationError(f"{observations.name}: {error}") from error
    return found


def _add_known(table, q, stokes_u, covariance):
    percent = 100 * u.percent
    length = np.hypot(q, stokes_u)
    table["q_known"], table["u_known"] = q * percent, stokes_u * percent
    table["dolp_known"] = length * percent
    table["aolp_known"] = np.where(length > 0, polarization_angle(q, stokes_u), np.nan) * u.deg
    along, across = np.full((2, length.size), np.nan)
    if covariance is not None:
        # the direction of the polarization in the (q, u) plane; of a star without any that of q,
        # as good as another one, and its error of the angle ends in the division by zero below
        c = np.divide(q, length, out=np.ones_like(length), where=length > 0)
        s = np.divide(stokes_u, length, out=np.zeros_like(length), where=length > 0)
        matrix = np.broadcast_to(np.asarray(covariance), (length.size, 2, 2))
        along = _error_along(np.stack([c, s], -1), matrix)
        across = _error_along(np.stack([-s, c], -1), matrix)
    table["dolp_known_err"] = along * percent
    with np.errstate(divide="ignore", invalid="ignore"):
        table["aolp_known_err"] = np.rad2deg(0.5 * across / length) * u.deg


def _add_claims(table, calibration, rows):
    """Add the errors that the calibration claims for light of the catalogue's polarization."""
    degrees = np.clip(table["dolp_known"], 0 * u.percent, 100 * u.percent)
    angles = np.nan_to_num(table["aolp_known"])
    claimed = target_accuracies(calibration, list(zip(degrees, angles, strict=True)))
    for key, name, unit in (("dolp", "s_p", u.percent), ("aolp", "s_chi", u.deg)):
        values = [one[name][row].value for one, row in zip(claimed, rows, strict=bool(claimed))]
        table[f"{key}_sys_err"] = (values or np.full(len(table), np.nan)) * unit


def _pull(table, key):
    """Return by how many of all errors together the star is off, median over the wavelengths."""
    return np.nanmedian(np.abs(table[f"{key}_error"].value) / _stated(table, key))


def _stated(table, key):
    """Return the errors of the star, the calibration and the catalogue together."""
    parts = (table[f"{key}{suffix}"].value for suffix in ("_err", "_sys_err", "_known_err"))
    return np.sqrt(sum(np.nan_to_num(part, posinf=np.inf) ** 2 for part in parts))


def _error_along(direction, matrix):
    """Return the standard error along unit vectors, shape (n_wavelengths, 2)."""
    variance = np.einsum("wi,wij,wj->w", direction, matrix, direction)
    # where it is zero rounding may leave less
    return np.sqrt(np.maximum(variance, 0.0))


def _words(table):
    off = np.abs(table["dolp_error"].to_value(u.percent))
    words = (
        f"DoLP off by {np.nanmedian(off):.2g} % (median over the wavelengths; worst "
        f"{np.nanmax(off):.2g} %; {_pull(table, 'dolp'):.1f} times all errors), single cycles by "
        f"{np.nanmedian(table['s_dolp'].to_value(u.percent)):.2g} %"
    )
    turned = table["aolp_error"].to_value(u.deg)
    if np.isfinite(turned).any():
        words += (
            f"; AoLP by {np.nanmedian(turned):+.2g} deg (median), {_pull(table, 'aolp'):.1f} times "
            "the errors of calibration, star and catalogue together"
        )
    return words


def add_star_check(calibration, chain, observations, positions=None):
    """
    Check a calibration with a star and keep the result with the calibration.

    It goes into ``calibration.fit["stars"]``, and so into summary, JSON and file.

    Parameters
    ----------
    calibration : Calibration
        The calibration; it is changed.
    chain, observations, positions
        As for `star_check`.

    Returns
    -------
    `~astropy.table.QTable`
        As `star_check` gives it.

    Raises
    ------
    FitError, ObservationError, ChainError
        As `star_check`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments, optics
    >>> from astropolcal.calibration import add_star_check
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2))
    >>> sky = optics.PolarizedSource(name="star") | chain["hwp"] | chain["derotator"]
    >>> sky = sky | chain["wollaston"]
    >>> night = simulate(sky, lam, frames, seed=3, meta={"object": "HD 293396"})
    >>> table = add_star_check(cal, sky, night)
    >>> cal.fit["stars"][0]["star"]
    'HD 293396'
    """
    table = star_check(calibration, chain, observations, positions)
    entry = {key: table.meta[key] for key in ("name", "star", "words")}
    entry["content_hash"] = observations.content_hash
    entry["wavelength_nm"] = table["wavelength"].to_value(u.nm).tolist()
    entry["n_cycles"] = np.asarray(table["n_cycles"]).tolist()
    for key, unit in _KEPT.items():
        suffix = "percent" if unit == u.percent else "deg"
        entry[f"{key}_{suffix}"] = table[key].to_value(unit).tolist()
    others = calibration.fit.get("stars", [])
    # checked again, a star replaces its entry
    others = [other for other in others if other["content_hash"] != entry["content_hash"]]
    calibration.fit["stars"] = [*others, entry]
    return table
