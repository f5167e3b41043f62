# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarization of stars as a calibration sees it, and the check with a star no fit has seen."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import standards, stokes
from astropolcal.calibration.noise.estimates import mean_of_known
from astropolcal.calibration.validation.cross_validation import (
    add_percent,
    keep,
    predicted_measurement,
    refuse_fitted,
)
from astropolcal.calibration.validation.targets import target_accuracies
from astropolcal.chain import join, leaves
from astropolcal.exceptions import (
    AstropolcalError,
    ChainError,
    ObservationError,
    WavelengthRangeError,
)
from astropolcal.files import columns
from astropolcal.observations.grid import cycle_numbers
from astropolcal.observations.reading import bins_on_grid
from astropolcal.optics import PolarizedSource, StarSource
from astropolcal.stokes import polarization_angle, polarization_errors
from astropolcal.words import listed

__all__ = ["fitted_stars", "star_accuracy", "star_check", "star_stokes"]

# efficiency from which on a cycle determines q and u
_LEAST = 1e-3


def star_stokes(calibration, chain, observations, positions=None):
    """
    Return q and u of a star on sky from every cycle of the half-wave plate.

    The data are linear in q and u to first order of the instrumental polarization; the
    normalized double differences of each cycle are inverted by least squares, with all that the
    calibration knows of the instrument. The star's own q and u in the chain do not count.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    chain : `~astropy.modeling.CompoundModel`
        Chain of the star, with a `~astropolcal.optics.PolarizedSource` first.
    observations : Observations
        The star.
    positions : dict of str to `~numpy.ndarray`, optional
        See `~astropolcal.measurement.Measurement`.

    Returns
    -------
    `~astropy.table.QTable`
        One row per wavelength: ``wavelength``; ``q``, ``u`` (means over the cycles) and their
        standard errors ``q_err``, ``u_err``, from the scatter of the cycles; ``dolp`` (debiased)
        and ``aolp`` with errors; ``n_cycles``; ``q_cycles`` and ``u_cycles``, one per cycle, NaN
        where a cycle does not determine them. A single cycle has no error, and so no ``dolp``.

    Raises
    ------
    ChainError
        If the chain has no polarized source.
    ObservationError
        If no cycle determines q and u.

    Examples
    --------
    Frames of a star downstream of a telescope that does nothing, seen as they are:

    >>> import astropy.units as u
    >>> from astropolcal.calibration.validation import star_stokes
    >>> from astropolcal import calibrate, instruments, optics
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2))
    >>> star = optics.PolarizedSource(q=0.02, u=0.01, name="star")
    >>> sky = star | chain["hwp"] | chain["derotator"] | chain["wollaston"]
    >>> table = star_stokes(cal, sky, simulate(sky, lam, frames, seed=3))
    >>> table["q"].round(1)
    <Quantity [2., 2., 2.] %>
    """
    first, *rest = leaves(chain)
    if not isinstance(first, PolarizedSource):
        raise ChainError("the chain of a star begins with a PolarizedSource")
    chain = join([PolarizedSource(q=0.0, u=0.0, name=first.name), *rest])
    measurement = predicted_measurement(calibration, chain, observations, positions, sources=True)
    vector, (part,) = measurement.vector(), measurement.datasets
    # around an unpolarized star (q = u = 0): what is left is the star's, to first order linear
    jacobian = measurement.jacobian(vector)
    residuals = measurement.residuals(vector)
    slots = (measurement.free.by_name[f"{first.name}.{key}"] for key in "qu")
    slopes = np.stack([jacobian[slot.start] for slot in slots])
    cycle = cycle_numbers(observations)[part.frames[:, 0]][part.group_of_datum]
    labels = np.unique(cycle)
    found = np.full((2, len(part.bins), len(labels)), np.nan)
    for i, b in enumerate(part.bins):
        for j, label in enumerate(labels):
            rows = (part.bin_of_datum == b) & (cycle == label)
            own = slopes[:, rows]
            # the smaller singular value is the efficiency in the direction measured worst
            if rows.sum() > 1 and np.linalg.svd(own, compute_uv=False)[1] >= _LEAST:
                found[:, i, j] = np.linalg.lstsq(own.T, residuals[rows], rcond=None)[0]
    if np.isnan(found).all():
        raise ObservationError(f"{observations.name}: no cycle determines q and u")
    return _table(observations.wavelength, found)


def _table(wavelength, found):
    count = np.isfinite(found[0]).sum(axis=1)
    mean = mean_of_known(found)
    # standard error of the mean: s / sqrt(n - 1) with the standard deviation s over n
    square = mean_of_known((found - mean[..., None]) ** 2)
    error = np.sqrt(square / np.where(count > 1, count - 1, np.nan))
    table = QTable({"wavelength": wavelength})
    add_percent(table, q=mean[0], u=mean[1], q_err=error[0], u_err=error[1])
    # rms of both components: the degree has the error of one of them
    spread = np.hypot(*error) / np.sqrt(2)
    dolp, known = np.hypot(*mean), np.isfinite(spread)
    debiased = np.full(dolp.shape, np.nan)
    debiased[known] = stokes.debias_dolp(dolp[known], spread[known])
    add_percent(table, dolp=debiased, dolp_err=spread)
    table["aolp"] = stokes.polarization_angle(*mean) * u.deg
    table["aolp_err"] = np.full(dolp.shape, np.nan) * u.deg
    table["aolp_err"][known] = stokes.angle_error(dolp[known], spread[known], True) * u.deg
    table["n_cycles"] = count
    add_percent(table, q_cycles=found[0], u_cycles=found[1])
    return table


def star_accuracy(table, q=0.0, u_=0.0):
    """
    Return how well a star of known polarization came out, per wavelength.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        As from ``star_stokes``.
    q, u_ : float or array_like
        What is known of the star, one per wavelength.

    Returns
    -------
    `~astropy.table.QTable`
        ``wavelength``; ``dolp_error`` and ``aolp_error``, of the mean, observed less known;
        ``s_dolp``, the rms error of single cycles along the known polarization, or of both
        components where it is zero; ``s_q`` and ``s_u``, the rms errors of single cycles.

    Examples
    --------
    >>> from astropolcal.calibration.validation import star_accuracy
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> table = QTable({"wavelength": [1.6] * u.um, "q": [1] * u.percent, "u": [0] * u.percent,
    ...                 "q_cycles": [[0.9, 1.1]] * u.percent,
    ...                 "u_cycles": [[0.1, -0.1]] * u.percent})
    >>> star_accuracy(table, q=0.01)["s_dolp"].round(3)
    <Quantity [0.1] %>
    """
    known = np.stack(np.broadcast_arrays(q, u_, np.zeros(len(table)))[:2])
    mean = np.stack([table[key].to_value(u.one) for key in ("q", "u")])
    off = np.stack([table[f"{k}_cycles"].to_value(u.one) for k in "qu"]) - known[..., None]
    length = np.hypot(*known)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.einsum("kw,kwc->wc", known / length, off)
    # an unpolarized star has no direction: the mean square of q and u
    squares = np.where(length[:, None] > 0, along**2, 0.5 * (off**2).sum(axis=0))
    angle = 0.5 * (np.arctan2(mean[1], mean[0]) - np.arctan2(known[1], known[0]))
    # angles of polarization repeat after 180 deg: the shortest way, -90 to 90 deg
    turn = np.mod(angle + np.pi / 2, np.pi) - np.pi / 2
    result = QTable({"wavelength": table["wavelength"]})
    add_percent(result, dolp_error=np.hypot(*mean) - length)
    result["aolp_error"] = np.rad2deg(np.where(length > 0, turn, np.nan)) * u.deg
    s_q, s_u = np.sqrt(mean_of_known(off**2))
    add_percent(result, s_dolp=np.sqrt(mean_of_known(squares)), s_q=s_q, s_u=s_u)
    return result


# ---- what a calibration has found of its standards -----------------------------------------


def fitted_stars(calibration):
    """
    Return the polarization that a calibration has found of its standard stars.

    The field turns a star against the telescope, so that a calibration can tell the two apart as
    far as it has turned. What it cannot tell rests on the catalogue.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.

    Returns
    -------
    list of `~astropy.table.QTable`
        One per star whose polarization had a prior: ``wavelength``, ``q``, ``q_err``, ``q_prior``,
        ``q_prior_err`` and the same of u, in percent and in the frame of the sky. Meta ``name`` of
        the optic, ``from_data``, the share of the prior variance that the data have taken away, 0
        to 1, and ``words``.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.calibration import fitted_stars
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.observations import Observations
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain("unpolarized standard star", derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> frames["parallactic"] = np.linspace(-40, 40, len(frames)) * u.deg
    >>> frames["altitude"] = np.linspace(60, 70, len(frames)) * u.deg
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2), cross_validate=False)
    >>> fitted_stars(cal)[0].colnames[:4]
    ['wavelength', 'q', 'q_err', 'q_prior']
    """
    found = {}
    for chain in calibration.chains:
        star = leaves(chain)[0]
        free = [key for key in star.param_names if not getattr(star, key).fixed]
        with_prior = any(getattr(star, key).prior for key in free)
        if isinstance(star, StarSource) and with_prior and star.name not in found:
            found[star.name] = _fitted_star(calibration, star, free)
    return list(found.values())


def _fitted_star(calibration, star, free):
    """Return q and u of a fitted star with their errors, and those of its priors."""
    wavelength, covariance = calibration.wavelength, calibration.covariance
    slopes = star.mueller_derivatives(wavelength)
    means = {key: getattr(star, key).prior for key in free}
    units = {key: getattr(star, key).unit or u.one for key in free}
    before = star.with_parameters(**{key: p.mean() * units[key] for key, p in means.items()})
    table = QTable({"wavelength": wavelength})
    share = []
    for row, key in ((1, "q"), (2, "u")):
        matrix = np.zeros((wavelength.size, len(covariance)))
        prior = np.zeros(wavelength.size)
        for name in free:
            slope = (slopes[name] * units[name]).to_value(u.one)[..., row, 0]
            matrix[:, covariance.names.index(f"{star.name}.{name}")] = slope
            prior += (slope * means[name].std()) ** 2
        error = np.sqrt(np.diag(covariance.propagate(matrix)))
        value, known = (one.mueller(wavelength)[..., row, 0] for one in (star, before))
        columns = {key: value, f"{key}_err": error, f"{key}_prior": known}
        add_percent(table, **columns, **{f"{key}_prior_err": np.sqrt(prior)})
        share.append(1 - np.clip(error**2 / prior, 0, 1))
    table.meta |= {"name": star.name, "from_data": float(np.median(share))}
    i = len(table) // 2
    parts = [
        f"{key} {table[key][i].value:+.2f} +- {table[f'{key}_err'][i].value:.2f}" for key in "qu"
    ]
    prior = max(table[f"{key}_prior_err"][i].value for key in "qu")
    nm = table["wavelength"][i].to_value(u.nm)
    table.meta["words"] = (
        f"{table.meta['name']:<27} {', '.join(parts)} % ({nm:.0f} nm; +- {prior:.2f} before; "
        f"{100 * table.meta['from_data']:.0f} % by the data)"
    )
    return table


# ---- check of a calibration with a star of known polarization that no fit has seen ----


# what is kept with a calibration
_KEPT = (
    *("dolp", "dolp_err", "dolp_sys_err", "dolp_known", "dolp_known_err"),
    *("aolp", "aolp_err", "aolp_sys_err", "aolp_known", "aolp_known_err"),
    *("dolp_error", "aolp_error", "s_dolp", "s_q", "s_u"),
)


def star_check(calibration, chain, observations, positions=None, star=None):
    """
    Compare the polarization of a standard star with that of the catalogue, per wavelength.

    Every half-wave-plate cycle is inverted with the calibration, see
    ``star_stokes``; the means are compared with the Serkowski law of the
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
        The columns of `~astropolcal.calibration.validation.star_stokes` and ``star_accuracy``;
        ``dolp_sys_err`` and ``aolp_sys_err``, what the calibration claims of such light, see
        `~astropolcal.calibration.target_accuracies`; and ``q_known``, ``u_known``, ``dolp_known``,
        ``aolp_known`` of the catalogue with ``dolp_known_err`` and ``aolp_known_err``, NaN where no
        errors are published. Meta ``star``, ``name`` and ``words``.

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
    table.update(star_accuracy(table, q, stokes_u))
    _add_known(table, np.asarray(q), np.asarray(stokes_u), covariance)
    rows = bins_on_grid(observations, calibration.wavelength.to_value(u.um))
    degrees = np.clip(table["dolp_known"], 0 * u.percent, 100 * u.percent)
    angles = np.nan_to_num(table["aolp_known"])
    claimed = target_accuracies(calibration, list(zip(degrees, angles, strict=True)))
    for key, name, unit in (("dolp", "s_p", u.percent), ("aolp", "s_chi", u.deg)):
        values = [one[name][row].value for one, row in zip(claimed, rows, strict=bool(claimed))]
        table[f"{key}_sys_err"] = (values or np.full(len(table), np.nan)) * unit
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
    length = np.hypot(q, stokes_u)
    add_percent(table, q_known=q, u_known=stokes_u, dolp_known=length)
    table["aolp_known"] = np.where(length > 0, polarization_angle(q, stokes_u), np.nan) * u.deg
    along, across = np.full((2, length.size), np.nan)
    if covariance is not None:
        # of a star without polarization in the direction of q, which is as good as another one,
        # and its error of the angle ends in the division by zero below
        pair = np.where(length > 0, [q, stokes_u], [[1.0], [0.0]])
        (qq, qu), (_, uu) = np.broadcast_to(covariance, (length.size, 2, 2)).transpose(1, 2, 0)
        along, across = polarization_errors(*pair, np.sqrt(qq), np.sqrt(uu), qu)
    add_percent(table, dolp_known_err=along)
    with np.errstate(divide="ignore", invalid="ignore"):
        # as the catalogue states it, which made the error across of it in this way
        table["aolp_known_err"] = np.rad2deg(0.5 * across / length) * u.deg


def _pull(table, key):
    """Say by how many errors the star is off, and whose they are: not all need be known."""
    suffixes = {"star": "_err", "calibration": "_sys_err", "catalogue": "_known_err"}
    parts = {whose: table[f"{key}{suffix}"].value for whose, suffix in suffixes.items()}
    known = {whose: part for whose, part in parts.items() if not np.isnan(part).all()}
    if not known:
        return "no error is known"
    # where there is no polarization q and u are off, each by an error of its own
    both = (key == "dolp") & (table["dolp_known"].value == 0)
    stated = np.sqrt(np.where(both, 2, 1) * sum(part**2 for part in known.values()))
    times = np.nanmedian(np.abs(table[f"{key}_error"].value) / stated)
    return f"{times:.1f} times the errors of {listed(known)}"


def _words(table):
    off = np.abs(table["dolp_error"].to_value(u.percent))
    words = (
        f"DoLP off by {np.nanmedian(off):.2g} % (median over the wavelengths; worst "
        f"{np.nanmax(off):.2g} %; {_pull(table, 'dolp')}), single cycles by "
        f"{np.nanmedian(table['s_dolp'].to_value(u.percent)):.2g} %"
    )
    turned = table["aolp_error"].to_value(u.deg)
    if np.isfinite(turned).any():
        words += f"; AoLP by {np.nanmedian(turned):+.2g} deg (median), {_pull(table, 'aolp')}"
    return words


def add_star_check(calibration, chain, observations, positions=None):
    """Check a calibration with a star, as `star_check`, and keep the result in ``fit["stars"]``."""
    table = star_check(calibration, chain, observations, positions)
    entry = {"content_hash": observations.content_hash}
    entry |= table.meta | columns(table, "wavelength", "n_cycles", *_KEPT)
    keep(calibration, "stars", entry)
    return table
