# Licensed under a 3-clause BSD style license - see LICENSE
"""
From rows of a table to arrays of frame and wavelength.

Rows may come in any order and some may be absent. Here they are checked against each other, sorted
into a grid of shape (F, W), and cells that cannot be used are masked with a reason.

Frames of a run that cannot be used, found from the table and masked with a reason.

Nothing is dropped: a masked frame stays in the table with its reason, and one warning per reason
says how many there are and which. Single cells are judged while a table is read.
"""

import re
import warnings
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table, vstack

from astropolcal.exceptions import ObservationError, warn
from astropolcal.observations.pointings import angle_or_zero, axes_apart, frame_names
from astropolcal.observations.reading import check_table, first_bad_row, numeric_column
from astropolcal.units import angle_to_rad
from astropolcal.words import counted, listed

__all__ = []

BEAM_ERRORS = ("flux_right_err", "flux_left_err")
"""Columns with the standard deviations of R and L."""

SINGLE_ERRORS = ("single_difference_err", "single_sum_err")
"""Columns with the standard deviations of R - L and R + L."""

REQUIRED = ("frame", "bin", "wavelength")
BEAMS = ("flux_right", "flux_left")
"""Columns of two beams; of one beam at a time it is ``flux``."""
CELL_COLUMNS = (*BEAMS, *BEAM_ERRORS, *SINGLE_ERRORS, "flux", "flux_err")
CELL_COLUMNS += ("bin", "wavelength", "mask_reason")
_ANGLES = ("hwp", "derotator", "parallactic", "altitude")
# relative; beyond what files round away, far below what is between two bins
_SAME_WAVELENGTH = 1e-6
# um; far beyond any polarimeter, so that only wrong units are refused
_WAVELENGTHS = (1e-6, 1e6)
# a few wild frame numbers must not ask for an array of gigabytes
_MAX_EMPTY = 10**6
# in degree; beyond this the fraction of a turn loses its digits
_MAX_ANGLE = 1e6


@dataclass(frozen=True)
class Grid:
    """The arrays of a table of observations: F frames, W wavelengths."""

    # one row per frame, ordered by ``frame``, and the first data row (from 1) of each
    frames: QTable
    rows: np.ndarray
    # (W,)
    bin: np.ndarray
    wavelength: u.Quantity
    flux_unit: u.UnitBase
    # (F, W), NaN where masked; of one beam at a time the left one is zero
    flux_right: np.ndarray
    flux_left: np.ndarray
    # error columns as given, (F, W) each; empty if there are none
    errors: dict
    # (F, W): 0 usable, else 1 + index in ``reasons``
    reason: np.ndarray
    reasons: tuple
    # whether a frame has one beam only
    single: bool = False


def build_grid(table, label):
    """
    Check a table of observations (one row per frame and wavelength) and sort it into a `Grid`.

    ``label`` is the file or name for messages. Cells that are masked give one warning per reason.
    """
    height = None
    if isinstance(table, Table) and len(table):
        height = len(table)
        table = beams_as_frames(check_table(table, label, ()), label)
    there = set(getattr(table, "colnames", ()))
    single = "flux" in there and not there & {*BEAMS}
    table = check_table(table, label, (*REQUIRED, "flux") if single else (*REQUIRED, *BEAMS))
    frame, bins = (_integers(table, name, label) for name in ("frame", "bin"))
    wavelength, angles = _positions(table, label)

    # first: row in which a frame appears first, for its own columns and for messages
    number = frame
    if single and "beam" in table.colnames:
        beams, beam = np.unique(np.asarray(table["beam"], dtype=str), return_inverse=True)
        number = frame * len(beams) + beam
    _, first, frame_index = np.unique(number, return_index=True, return_inverse=True)
    bin_numbers, bin_index = np.unique(bins, return_inverse=True)
    shape = (len(first), len(bin_numbers))
    _check_cells(frame_index * shape[1] + bin_index, frame, bins, shape, label)
    unit = table["wavelength"].unit
    by_bin, order = _wavelength_by_bin(wavelength, bins, bin_index, bin_numbers, unit, label)
    # the columns that belong to frames, after checking that they do
    frames = QTable({"frame": frame[first]})
    for name in (name for name in table.colnames if name not in ("frame", *CELL_COLUMNS)):
        column = angles.get(name, table[name])
        _check_constant(column, name, first[frame_index], frame, label)
        frames[name] = column[first]
        # a format of the file would round what is written again
        frames[name].info.format = None

    flux_unit, values = _measured(table, label, ("flux",) if single else BEAMS)
    code, reasons = mask_rows(table, values, label, height)
    # -1: no row has spoken for this cell yet
    reason, bin_index = np.full(shape, -1), np.argsort(order)[bin_index]
    reason[frame_index, bin_index] = code
    mask_missing(reason, reasons, frame_names(frames), bin_numbers[order], label)
    if reason.all():
        raise ObservationError(
            f"{label}: all {reason.size} cells are masked ({', '.join(reasons)}), "
            "at least one usable cell is needed"
        )
    arrays = {}
    for name, column in values.items():
        arrays[name] = np.full(shape, np.nan)
        # NaN also where a number is there but not usable, so that it cannot slip into a sum
        arrays[name][frame_index, bin_index] = np.where(code > 0, np.nan, column)
    return Grid(
        frames=frames,
        rows=first + 1,
        bin=bin_numbers,
        wavelength=by_bin,
        flux_unit=flux_unit,
        flux_right=(right := arrays.pop("flux" if single else "flux_right")),
        flux_left=np.where(np.isnan(right), np.nan, 0.0) if single else arrays.pop("flux_left"),
        errors=arrays,
        reason=reason,
        reasons=tuple(reasons),
        single=single,
    )


def warn_of_copies(grid, label):
    """Warn of frames with the same fluxes and errors to the last digit, which noise never makes."""
    cells = np.stack([grid.flux_right, grid.flux_left, *grid.errors.values()], axis=1)
    seen, copies = {}, []
    for number, cell in zip(frame_names(grid.frames), cells, strict=True):
        if np.isfinite(cell).any() and (first := seen.setdefault(cell.tobytes(), number)) != number:
            copies.append((number, first))
    if copies and grid.errors:
        warn(
            f"{label}: {counted(len(copies), 'frame')} with exactly the fluxes of another one "
            "(first: frame {} those of frame {}); copies make all errors too small, remove "
            "them".format(*copies[0]),
            stacklevel=3,
        )


def beams_as_frames(table, label):
    """
    Return a table with columns ``flux_NAME`` of other beams as one of a single ``flux``.

    Each beam becomes a frame of the same number, with its name in the column ``beam``; that number
    is in ``group`` too, as they share the brightness of the source.
    """
    if {"flux", *BEAMS} & set(table.colnames):
        return table
    named = [name for name in table.colnames if name.startswith("flux_")]
    beams = [name for name in named if not name.endswith("_err")]
    # what is missing then is named together
    if not beams or not set(REQUIRED) <= set(table.colnames):
        return table
    errors = [f"{name}_err" for name in beams]
    lacking = [name for name in errors if name not in named]
    if 0 < len(lacking) < len(beams):
        raise ObservationError(f"{label}: missing column {', '.join(lacking)}")
    if len(beams) > 1 and "beam" in table.colnames:
        raise ObservationError(
            f"{label}: columns beam and {', '.join(beams)}; one of both tells the beam"
        )
    frame = _integers(table, "frame", label)
    parts = []
    for name in beams:
        part = table.copy()
        part.remove_columns([one for one in named if one in beams or one in errors])
        part["flux"] = table[name]
        if not lacking:
            part["flux_err"] = table[f"{name}_err"]
        if len(beams) > 1:
            part["beam"] = name.removeprefix("flux_")
            part["group"] = part["group"] if "group" in part.colnames else frame
        parts.append(part)
    try:
        return vstack(parts, metadata_conflicts="silent")
    except u.UnitConversionError:
        units = ", ".join(f"{name} in {table[name].unit or 'no unit'}" for name in named)
        raise ObservationError(f"{label}: fluxes need one unit, not {units}") from None


def _positions(table, label):
    """Return the wavelength of each row, and its angles by name, or refuse what cannot be."""
    micrometres, (low, high) = numeric_column(table, "wavelength", label, u.um), _WAVELENGTHS
    wrong = ~((micrometres >= low) & (micrometres <= high))
    # in the unit of the limits, whatever that of the table
    shown, allowed = np.char.mod("%.9g um", micrometres), f"({low:g} to {high:g} um)"
    first_bad_row(wrong, "wavelength", shown, label, f"lengths above zero {allowed}")
    wavelength, angles = numeric_column(table, "wavelength", label), {}
    for name in (name for name in _ANGLES if name in table.colnames):
        degrees = numeric_column(table, name, label, u.deg)
        allowed = f"finite angles up to {_MAX_ANGLE:g} deg"
        # written so that NaN, which compares as false, is bad
        first_bad_row(~(np.abs(degrees) <= _MAX_ANGLE), name, degrees, label, allowed)
        if name == "altitude":
            first_bad_row(np.abs(degrees) > 90, name, degrees, label, "-90 to 90 deg")
        angles[name] = numeric_column(table, name, label) * table[name].unit
    return wavelength, angles


def _integers(table, name, label):
    values = numeric_column(table, name, label)
    # beyond 2^53 floats have no ones digit, and two frames could become one
    whole = np.isfinite(values) & (np.abs(values) < 2.0**53) & (values == np.rint(values))
    first_bad_row(~whole, name, values, label, "whole numbers")
    return values.astype(np.int64)


def _check_cells(cell, frame, bins, shape, label):
    """Refuse a cell given twice, and a grid that is nearly all holes."""
    # stable: among equal cells the first row stays the first
    order = np.argsort(cell, kind="stable")
    again = order[1:][cell[order[1:]] == cell[order[:-1]]]
    if again.size:
        row = int(again.min())
        before = int(np.argmax(cell == cell[row]))
        raise ObservationError(
            f"{label}, row {row + 1}: frame = {frame[row]}, bin = {bins[row]} is given already in "
            f"row {before + 1}; one row per frame and bin is allowed"
        )
    if shape[0] * shape[1] > max(_MAX_EMPTY, 20 * len(cell)):
        raise ObservationError(
            f"{label}: {len(cell)} rows for {counted(shape[0], 'frame')} and "
            f"{counted(shape[1], 'bin')}; "
            "at least one in 20 of their combinations is needed"
        )


def _wavelength_by_bin(wavelength, bins, bin_index, bin_numbers, unit, label):
    """Return the wavelengths in ascending order, and the order of the bins that they have."""
    by_bin = np.full(len(bin_numbers), np.inf)
    # the least of each bin as its reference; plain indexing would keep one at random
    np.minimum.at(by_bin, bin_index, wavelength)
    differs = np.abs(wavelength / by_bin[bin_index] - 1.0) > _SAME_WAVELENGTH
    if differs.any():
        row = int(np.argmax(differs))
        raise ObservationError(
            f"{label}, row {row + 1}: wavelength = {wavelength[row]:.9g} {unit} in bin "
            f"{bins[row]}, other rows of this bin have {by_bin[bin_index[row]]:.9g} {unit}; "
            "one per bin is allowed"
        )
    order = np.argsort(by_bin)
    # two bins of one wavelength would count every photon twice in a fit
    same = np.diff(by_bin[order]) <= _SAME_WAVELENGTH * by_bin[order[1:]]
    if same.any():
        one, two = sorted(order[np.argmax(same) : np.argmax(same) + 2])
        row = int(np.argmax(bin_index == two))
        raise ObservationError(
            f"{label}, row {row + 1}: wavelength = {wavelength[row]:.9g} {unit} of bin "
            f"{bin_numbers[two]} is also that of bin {bin_numbers[one]}; one bin each is allowed"
        )
    if not np.array_equal(order, np.arange(len(order))):
        warn(
            f"{label}: the wavelengths of its bins do not ascend; here they do, and values per "
            "wavelength have to",
            stacklevel=4,
        )
    return by_bin[order] * unit, order


def _check_constant(column, name, reference, frame, label):
    try:
        equal = _filled(column == column[reference])
        # NaN stands for "unknown" and agrees with itself
        equal |= _filled(column != column) & _filled(column[reference] != column[reference])
        # a masked value agrees with a masked one only
        mask = np.broadcast_to(np.asarray(getattr(column, "mask", False)), equal.shape)
        equal = np.where(mask | mask[reference], mask & mask[reference], equal)
    except (TypeError, ValueError, AttributeError, NotImplementedError):
        raise ObservationError(
            f"{label}: column {name} of type {type(column).__name__} cannot be compared between "
            "rows; allowed are numbers, strings and times"
        ) from None
    if not equal.all():
        row = int(np.argmin(equal))
        value, other = (" ".join(str(column[i]).split()) for i in (row, reference[row]))
        raise ObservationError(
            f"{label}, row {row + 1}: {name} = {value} in frame {frame[row]}, but {other} in row "
            f"{reference[row] + 1}; one value per frame is allowed"
        )


def _filled(comparison):
    """Return a comparison as plain booleans, False where it is masked."""
    plain = getattr(comparison, "unmasked", comparison)
    mask = np.asarray(getattr(comparison, "mask", False))
    return np.array(np.ma.getdata(plain), dtype=bool) & ~mask


def _measured(table, label, beams):
    """Return the unit of the fluxes, and fluxes and errors in it, by name."""
    flux_unit = getattr(table[beams[0]], "unit", None) or u.dimensionless_unscaled
    strange = isinstance(flux_unit, u.UnrecognizedUnit) or not isinstance(flux_unit, u.UnitBase)
    # magnitudes are a unit like others for astropy
    if strange or flux_unit.is_equivalent(u.dex):
        raise ObservationError(
            f"{label}: column {beams[0]} has unit {flux_unit}, a linear unit such as adu is needed"
        )
    # of the beams, of the single differences, of both, or none
    errors = ()
    for names in (BEAM_ERRORS, SINGLE_ERRORS) if beams == BEAMS else (("flux_err",),):
        there = [name for name in names if name in table.colnames]
        if 0 < len(there) < len(names):
            (other,) = {*names} - {*there}
            raise ObservationError(f"{label}: missing column {other}; it has {there[0]}")
        errors += tuple(there)
    # the right beam sets the unit; the left one and the errors are converted
    how = {"unit": flux_unit, "like": beams[0]}
    values = {name: numeric_column(table, name, label, **how) for name in (*beams, *errors)}
    for name in errors:
        first_bad_row(values[name] < 0, name, values[name], label, "errors above zero")
    if len(errors) > 2:
        right, left, difference, total = (values[name] ** 2 for name in errors)
        off = np.abs((difference + total) / (2 * (right + left)) - 1)
        if np.nanmedian(off) > _AT_ODDS:
            warn(
                f"{label}: the squares of {' and '.join(SINGLE_ERRORS)} add up to "
                f"{np.nanmedian((difference + total) / (right + left)):.3g} times those of "
                f"{' and '.join(BEAM_ERRORS)}, not to twice as much; the latter are used alone"
            )
            values = {name: v for name, v in values.items() if name not in SINGLE_ERRORS}
    return flux_unit, values


# ---- cells that cannot be used -------------------------------------------------------------------
# A bad cell is masked with a reason, never dropped in silence: when a table is read, one warning a
# reason says how many cells and where the first is.

# errors of the beams and of their difference and sum that are by more than this share apart
_AT_ODDS = 0.1
# beyond this, and below its inverse, squares would overflow
_HUGE = 1e100


def mask_rows(table, values, label, height=None):
    """Judge the rows by fluxes and errors, each (N,).

    Return codes (0 usable, else 1 + index of the reason) and reasons. What the column
    ``mask_reason`` declares is respected, the rest is warned of, by the row of a table of that
    ``height`` with beams in columns.
    """
    code, reasons = np.zeros(len(table), dtype=int), []
    # what the file declares was warned of when it was made
    if "mask_reason" in table.colnames:
        column = table["mask_reason"]
        if column.dtype.kind not in "US":
            raise ObservationError(
                f"{label}: column mask_reason has type {column.dtype}, strings are needed"
            )
        # an empty string in ECSV may come back as a masked value
        text = np.where(getattr(column, "mask", False), "", np.ma.getdata(column).astype(str))
        reasons = [str(reason) for reason in np.unique(text) if reason]
        for number, reason in enumerate(reasons):
            code[text == reason] = number + 1
    errors = [name for name in values if name.endswith("_err")]
    fluxes = [name for name in values if name not in errors]
    for kind, names in (("flux", fluxes), ("error", errors)):
        both = np.array([values[name] for name in names]).reshape(-1, len(table))
        # NaN compares as false and is lost too
        lost = ~(np.abs(both) < _HUGE).all(axis=0)
        low = ~lost & (both < 1.0 / _HUGE).any(axis=0)
        for bad, reason in ((lost, f"{kind} not finite"), (low, f"{kind} not positive")):
            # the first reason stays
            bad &= code == 0
            if bad.any():
                row = int(np.argmax(bad))
                shown = ", ".join(f"{name} = {values[name][row]:g}" for name in names)
                of = f" (beam {table['beam'][row]})" if "beam" in table.colnames else ""
                place = row % (height or len(table)) + 1
                first = f"row {place}{of}: {shown}; allowed are finite numbers above zero"
                _mask_cells(code, bad, reason, reasons, label, first)
    return code, reasons


def mask_missing(code, reasons, frame_numbers, bin_numbers, label):
    """Give cells (F, W) without a row, code -1, the reason "missing", in place; warn of them."""
    # a hole in the grid is masked like a bad value: a pair that needs it drops out
    missing = code < 0
    if missing.any():
        frame, column = np.argwhere(missing)[0]
        first = f"frame {frame_numbers[frame]}, bin {bin_numbers[column]} has no row"
        _mask_cells(code, missing, "missing", reasons, label, first)


def _mask_cells(code, bad, reason, reasons, label, first):
    """Give cells the code of a reason, which is added to the list where it is new; warn of them."""
    if reason not in reasons:
        reasons.append(reason)
    code[bad] = reasons.index(reason) + 1
    message = f"{label}: {counted(int(bad.sum()), 'cell')} masked, {reason} (first: {first})"
    warn(message)


# ---- errors of the beams -------------------------------------------------------------------------


def beam_variances(flux_right, flux_left, errors):
    """Return the variances of both beams and their covariance, (F, W) each.

    ``errors`` are standard deviations under the names of `BEAM_ERRORS`, `SINGLE_ERRORS` or both;
    none give NaN. With S = R + L and D = R - L, var(S) + var(D) = 2 (var(R) + var(L)) and var(S) -
    var(D) = 4 cov(R, L). Errors of S and D alone do not determine how the variance is shared
    between the beams: it is shared in proportion to their fluxes, as photon noise would be, but
    never so unevenly that the matrix ceases to be a covariance.
    """
    if not errors:
        return tuple(np.full_like(flux_right, np.nan) for _ in range(3))
    if "flux_err" in errors:
        dark = np.where(np.isnan(flux_right), np.nan, 0.0)
        return errors["flux_err"] ** 2, dark, dark
    known = [errors[name] ** 2 for name in (*BEAM_ERRORS, *SINGLE_ERRORS) if name in errors]
    if len(known) == 2 and BEAM_ERRORS[0] in errors:
        return *known, np.where(np.isnan(known[0]), np.nan, 0.0)
    difference, total = known[-2:]
    # both at once: var(S) - var(D) = 4 cov
    covariance = 0.25 * (total - difference)
    if len(known) > 2:
        most = np.sqrt(known[0] * known[1])
        return *known[:2], np.clip(covariance, -most, most)
    # var(R) + var(L)
    both = 0.5 * (total + difference)
    # var(R) var(L) >= cov^2 bounds the share of the right beam around one half
    reach = np.sqrt(np.maximum(0.25 - (covariance / both) ** 2, 0.0))
    share = np.clip(flux_right / (flux_right + flux_left), 0.5 - reach, 0.5 + reach)
    return both * share, both * (1.0 - share), covariance


# ---- quality -------------------------------------------------------------------------------


#: Derotator angles, radian, that differ by less belong to one run.
SAME_ANGLE = np.deg2rad(0.5)
# angles closer than this are one step, as for pairs
_PLATE_STEPS = np.deg2rad(0.3)
#: Median absolute deviation to standard deviation, for normal noise.
MAD_TO_SIGMA = 1.4826
_MOST_NAMED = 8


def is_star(source):
    """Return whether the source in the meta of a table is a star."""
    words = plain_source(source).split()
    return "star" in words or "sky" in words


def plain_source(source):
    """
    Return a source in lower case with single spaces.

    "star" for "standard star", of which nobody says how polarized it is.
    """
    words = re.sub(r"[\s_-]+", " ", (source or "").lower()).strip()
    return "star" if words == "standard star" else words


def clusters(values, gap=SAME_ANGLE, turn=None):
    """
    Return the number of each value's cluster; clusters are more than ``gap`` apart.

    Angles are the same again after a ``turn``.
    """
    values = values if turn is None else np.mod(values, turn)
    order = np.argsort(values, kind="stable")
    number = np.empty(len(values), dtype=int)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > gap)])
    # the last one may be the first one, on the other side of zero
    joined = turn is not None and np.ptp(values) >= turn - gap
    return number % max(number.max(), 1) if joined else number


def runs_of_frames(count, number):
    """Return the run of each frame where frames, one after the other, fall in so many, (F,)."""
    return np.arange(count) * number // count


def derotator_runs(observations):
    """Return the number of the run of frames at one derotator angle of every frame, (F,)."""
    angle = angle_or_zero(observations, "derotator")
    return np.cumsum(axes_apart(angle, np.concatenate([angle[:1], angle[:-1]])) > SAME_ANGLE)


# ---- cycles of the half-wave plate ---------------------------------------------------------------


def cycle_numbers(observations, start=None):
    """Return the number of the half-wave-plate cycle of every frame, from 0, (F,).

    That of the column ``cycle``; else a cycle ends where a plate angle (of a beam, in a state of
    a modulator) comes again, the derotator moves, or ``start`` comes, the angle with which a cycle
    begins.
    """
    frames = observations.frames
    if "cycle" in frames.colnames:
        # numbers of cycles need not be consecutive
        return np.unique(np.asarray(frames["cycle"]), return_inverse=True)[1]
    # with the first of a cycle, if it is known; 180 deg is 0 deg again, and so is a bit less
    known = [] if start is None else [float(angle_to_rad(start, "start"))]
    plate = clusters(np.append(angle_or_zero(observations, "hwp"), known), _PLATE_STEPS, np.pi)
    plate, first = plate[: observations.n_frames], plate[observations.n_frames :]
    states = [np.asarray(frames[n]) for n in ("flc_state", "beam") if n in frames.colnames]
    moved = np.diff(derotator_runs(observations), prepend=0) > 0
    cycle, number, seen = np.zeros(len(plate), dtype=int), 0, set()
    for i, key in enumerate(zip(plate.tolist(), *states, strict=True)):
        # with its first angle, unless nothing but that angle was seen: all states share it
        begins = key[0] in first and any(angle != key[0] for angle, *_ in seen)
        if i and (moved[i] or begins or key in seen):
            number, seen = number + 1, set()
        seen.add(key)
        cycle[i] = number
    return cycle


def mask_incomplete_cycles(observations):
    """
    Mask the frames of cycles that lack one of the angles 0, 45, 22.5, 67.5 deg of the plate.

    They give q without u, or neither. A frame masked at all wavelengths counts as missing. Without
    a half-wave plate all frames stay.
    """
    if "hwp" not in observations.frame_columns:
        return observations
    wanted = np.deg2rad([0, 45, 22.5, 67.5])
    plate, cycle = observations.position("hwp"), cycle_numbers(observations, wanted[0] * u.rad)
    lost = observations.mask.all(axis=1)
    # (frames, wanted angles)
    there = (axes_apart(plate[:, None], wanted) < _PLATE_STEPS) & ~lost[:, None]
    complete = np.array([there[cycle == c].any(axis=0).all() for c in range(cycle.max() + 1)])
    if not complete.any():
        raise ObservationError(
            f"{observations.name}: none of its {len(complete)} half-wave-plate cycles has all "
            "of the angles 0, 45, 22.5, 67.5 deg"
        )
    return _masked(observations, ~complete[cycle] & ~lost, "incomplete half-wave-plate cycle")


# ---- detector and lamp ---------------------------------------------------------------------------


def mask_saturated(observations):
    """Mask the frames whose column ``saturated`` is true or above zero."""
    frames = observations.frames
    if "saturated" not in frames.colnames:
        return observations
    flag = np.asarray(getattr(frames["saturated"], "value", frames["saturated"]))
    if flag.dtype.kind not in "biuf":
        raise ObservationError(
            f"{observations.name}: column saturated has type {flag.dtype}; booleans or numbers "
            "are needed"
        )
    return _masked(observations, np.nan_to_num(flag.astype(float)) > 0, "saturated")


def mean_of_exposures(stack, good):
    """
    Return the mean of the known exposures (N, Y, X) of each pixel, and how many all amount to.

    A pixel that lacks some is scaled to the brightness of all, which is the median of the pixels
    that lack none: a cosmic ray does not count. NaN where none is known.
    """
    pixels = stack[:, good.all(axis=0)]
    # a part of them tells it as well
    pixels = pixels[:, :: 1 + pixels.shape[1] // 20_000].astype(float)
    level = np.median(pixels, axis=0)
    ratio = pixels[:, level > 0] / level[level > 0]
    light = np.median(ratio, axis=1) if ratio.size else np.ones(len(stack))
    light = light / light.mean() if light.min() > 0 else np.ones(len(stack))
    number = np.tensordot(light, good, 1)[None]
    number = np.where(number > 0, number, np.nan)
    return np.where(good, stack, 0.0).sum(axis=0, keepdims=True) / number, number


def brightness(observations):
    """
    Return how bright each frame is, (F,).

    The sum of the beams over its median frame, median over the wavelengths; NaN where all are
    masked.
    """
    total = np.where(observations.mask, np.nan, observations.flux_right + observations.flux_left)
    # frames and bins without any cell
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        # each bin by its own median, so that faint wavelengths count as bright ones do
        relative = total / np.nanmedian(total, axis=0)
        return np.nanmedian(relative, axis=1)


def mask_unstable_lamp(observations):
    """Mask the frames of an internal source whose brightness leaves its slow drift.

    The drift is the parabola in the order of the frames with the least absolute deviations. A frame
    is unstable if ln(brightness) is off by more than 0.1 and by more than 6 robust standard
    deviations. Where at least half of the frames at one derotator angle are, all frames of
    that angle are masked, as pairs are formed within it.
    """
    if observations.single_beam:
        # its flux follows the modulation, not only the lamp
        return observations
    # a lamp changes by factors
    logarithm = np.log(brightness(observations))
    degree = min(2, max(int(np.isfinite(logarithm).sum()) - 4, 0))
    drift = robust_curve(np.linspace(-1, 1, len(logarithm)), logarithm, degree)
    off = np.abs(logarithm - drift)
    spread = MAD_TO_SIGMA * np.nanmedian(off)
    # NaN, a frame masked already, is not far
    far = np.nan_to_num(off) > max(0.1, 6 * spread)
    run = derotator_runs(observations)
    far |= (np.bincount(run, far) >= 0.5 * np.bincount(run))[run]
    return _masked(observations, far, "unstable lamp")


def robust_curve(x, values, degree):
    """
    Return at all x the polynomial of least absolute deviations, which a bad run does not bend.

    x runs from -1 to 1; values are NaN where there is none.
    """
    known = np.isfinite(values)
    curve = np.polynomial.legendre.legvander(x, degree)
    # the median is where the least deviations of a constant are
    solution = np.zeros(degree + 1)
    solution[0] = np.nanmedian(values)
    # iterated weights: squares over the last deviation are absolute values where they converge
    for _ in range(50):
        off = np.abs(values - curve @ solution)[known]
        weight = 1 / np.sqrt(np.maximum(off, 1e-3 * max(np.median(off), 1e-12)))
        rows = curve[known] * weight[:, None]
        solution = np.linalg.lstsq(rows, values[known] * weight, rcond=None)[0]
    return curve @ solution


def _masked(observations, frames, reason):
    """Mask whole frames with a reason, and say so; leave the rest untouched."""
    new = frames & ~observations.mask.all(axis=1)
    if not new.any():
        return observations
    result = observations.with_mask(np.asarray(new), reason)
    names = np.array(frame_names(observations.frames))[new]
    warn(
        f"{observations.name}: {len(names)} of {counted(observations.n_frames, 'frame')} masked, "
        f"{reason}: frame {listed(names, most=_MOST_NAMED)}",
        stacklevel=3,
    )
    return result
