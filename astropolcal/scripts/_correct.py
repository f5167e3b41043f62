# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Correct science cubes with a calibration and write Stokes parameters.

They are those of the light that entered the telescope, by least squares over
all frames, with their errors. The cubes must be without sky background: it is
not subtracted.

For example::

  astropolcal correct --calibration cal.asdf cubes/ --raw raw/ -o stokes.fits
  astropolcal correct --calibration library/ cubes/ -o out.fits --plot fig.png
  astropolcal correct --calibration cal.asdf cubes/ -o disk.fits \
      --rotation pupil --camera-angle 113 --open-directions ignore
  astropolcal correct --calibration library/ nights/ --archive out --workers 8
"""

import argparse
import copy
import os
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.exceptions import (
    AstropolcalError,
    CalibrationFileError,
    ObservationError,
    ParameterError,
    warn,
)
from astropolcal.files import one_line
from astropolcal.scripts import _common as common
from astropolcal.scripts._archive import is_archive, run_archive
from astropolcal.units import check_seed, plain_number
from astropolcal.words import counted

OPTIONS = """
cubes CUBES + Frames  cubes, or folders of them (*.fits)
--calibration LIB_OR_FILE Input required  a calibration file, or a folder of them, from which the
    one that holds for the frames is taken
-o --output OUT.fits Output not:archive  the product; overwritten if it exists
--mode {stokes,ip} =stokes  stokes (default): invert the Mueller matrices; ip: instrumental
    polarization only
--observable {intensity,single,double}  what is fitted: the beams, or their single or double
    differences and sums (default: what the calibration fitted)
--components {IQU,IQUV} =IQU  default: IQU, V is zero
--weights {equal,variance} =equal  of the fluxes: equal (default), or one over their variances
--brightness {exposure,measured} =measured  relative brightness of the frames: by the light in the
    images (default), or by their exposure times alone
--max-condition X float =30  condition number from which on Stokes parameters count as poorly
    determined and are left out (default: 30)
--instrument NAME  default: that of the calibration
--raw DIR Frames  folder of raw frames, for keywords that the cubes lack
--optics-in NAME,NAME,... names  all optional optics that were in the beam ('' for none), where
    headers do not tell and the calibration has several sets of them
--filter MODE  mode of the instrument, as the calibration calls it; default: what headers say
--any-date  take the calibration even if it does not hold for the date of the frames
--max-age YEARS float  time between the data of the calibration and the frames from which on there
    is a warning (default: that of the instrument, mostly 1)
--interpolate  interpolate parameters that are known at the calibrated wavelengths only
--centre X,Y point  place of the star in the left beam, 0-based; by default it is found
--size PIXELS int =51  width of the images of the product (default: 51)
--rotation {none,fixed,pupil} =none  how the field turned: not known, images stay as they are
    (default); the +y axis at a fixed position angle; at a fixed angle from the zenith
--camera-angle DEG angle needs:rotation  position angle of the +y axis, or with --rotation
    pupil that from the zenith (default: 0)
--mirrored needs:rotation  east is to the right of north
--subtract-star STAR star  subtract the polarization of the star from its light: annulus=IN,OUT
    measures it between two radii in pixels, DEG%%,DEG (0.8+-0.1,45+-3) states degree in percent and
    angle, with their errors (exact without them)
--open-directions SIGMA sigma =infinite  systematic errors along what the calibration does not
    determine: infinite (default), ignore, or the standard deviation of the angle that each is
    named after, in degrees
--samples N int =0  systematic errors from N samples of the calibration (default: linearized)
--seed N int needs:samples  of the random numbers of --samples
--spectrum OUT.ecsv Output not:archive  table of the star in an aperture
--radius PIXELS float  of the aperture (default: 10, or half of a smaller --size)
--plot FILE Drawing not:archive  figure of the result
--workers N int  threads; with --archive: processes (default: one per processor)
--cluster ADDRESS  scheduler of dask.distributed, in place of these
@ full json online quiet
[whole archives]
@ archive gap cycles target retry timeout
"""
# share of the light in the aperture that the edge of the images may have on its area; that of its
# Q and U which is not the star's, as of a disk or of speckles
_MOST_SKY, _MOST_POLARIZED = 0.01, 5e-4
# degrees by which a derotator may miss the law of what it is said to keep
_OFF_LAW = 1.0
# pixels by which images may move: about half the width of a star, which smears little
_MOST_MOVED = 2.0
# options that `correct` calls the same
_PASSED_ON = (
    *("mode", "observable", "components", "max_condition", "open_directions", "seed"),
    *("workers", "cluster", "interpolate"),
)
# by what a library may ask for
_OPTIONS = {
    "instrument": "--instrument NAME",
    "mode": "--filter MODE",
    "optics_in": "--optics-in NAME,NAME,...",
}
# what a user can do about frames that do not say enough
_WAYS = {
    "date": "--any-date takes it all the same",
    "mode": "--filter {}",
    "other date": "; --any-date takes it all the same",
    "raw": "; --raw names a folder of raw frames",
    "exposure": ", which --brightness exposure needs",
    "centre": "; give its place with --centre",
}


def _star(text):
    """Return the arguments of `Corrected.without_star`."""
    try:
        if text.startswith("annulus="):
            return {"annulus": tuple(common.numbers(text.removeprefix("annulus="), 2))}
        parts = (part.partition("+-") for part in text.split(","))
        pairs = [(plain_number(value), plain_number(error or "0")) for value, _, error in parts]
        (dolp, s_dolp), (aolp, s_aolp) = pairs
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither annulus=IN,OUT nor DOLP,AOLP such as 0.8+-0.1,45+-3"
        ) from None
    if not 0 <= dolp <= 100:
        raise argparse.ArgumentTypeError(f"{text!r}: {dolp:g} %; allowed are 0 to 100 %")
    return {"dolp": dolp / 100, "aolp": aolp * u.deg, "errors": (s_dolp / 100, s_aolp * u.deg)}


TYPES = {
    "star": _star,
    "names": lambda text: [name.strip() for name in text.split(",") if name.strip()],
    "point": common.text_type("X,Y", common.numbers, 2),
    "sigma": common.number_or("infinite", "ignore"),
}


def run(arguments):
    """Correct the cubes, or the archive, and write the product."""
    _check_options(arguments)
    common.check_suffix("--spectrum", arguments.spectrum, ".ecsv")
    if is_archive(arguments):
        return run_archive("correct", arguments)
    common.check_suffix("-o", arguments.output, ".fits")
    return work(arguments)


def work(arguments):
    """Correct the cubes of one product."""
    from astropolcal.correction import ScienceFrames, correct
    from astropolcal.reduction.frames import configured, survey_frames

    files = common.cube_files(arguments.cubes)
    # before the images are opened: which calibration holds is known from headers
    calibration, chain, provenance = choose_calibration(arguments, files)
    instrument = instruments.get(arguments.instrument or calibration.instrument or "charis")
    instrument = configured(instrument, files)
    files, instrument = _sorted(files, instrument)
    table, centres, scale, detectors = survey_frames(
        files,
        instrument.files,
        raw=arguments.raw,
        centre=arguments.centre,
        exposed=arguments.brightness == "exposure",
        ways=_WAYS,
    )
    _warn_of_rotation(table, arguments.rotation, instrument.sky_law)
    frames = ScienceFrames.from_files(
        files,
        instrument,
        table,
        chain,
        centres=centres,
        size=arguments.size,
        position_angle=_position_angles(table, arguments),
        mirrored=arguments.mirrored,
        scale=scale,
        left_scale=[left.units_of(right) for right, left in detectors],
        detectors=detectors,
        unit=detectors[0][0].unit,
        # date and mode were checked when the calibration was chosen
        date=None,
        mode=calibration.validity.mode,
    )
    if arguments.rotation == "none":
        _warn_of_turns(table, instrument.sky_law, arguments.size)
    result = correct(
        calibration,
        frames,
        chain=chain,
        brightness="measured" if arguments.brightness == "measured" else "given",
        weights="variance" if arguments.weights == "variance" else None,
        any_date=True,
        n_samples=arguments.samples,
        provenance=provenance,
        **{name: getattr(arguments, name) for name in _PASSED_ON},
    )
    # for the report, too, not only for --spectrum; the star as it is
    star = result.aperture(_radius(arguments))
    errors = [star.fractional_errors(kind) for kind in ("statistical", "systematic")]
    errors = np.array([np.hypot(*(each[name] for each in errors)) for name in "qu"])
    _warn_of_sky(result.stokes[:3], star.stokes[:3], np.nan_to_num(errors), _radius(arguments))
    if arguments.subtract_star is not None:
        result = result.without_star(**arguments.subtract_star)
    _write(result, star, arguments)
    summary = _summary(result, star, arguments, len(files))
    common.give(arguments, _words(summary, result.systematic, arguments), summary)


def _write(result, star, arguments):
    """Write the product, the spectrum of the star and the figure."""
    result.write(arguments.output, overwrite=True)
    if arguments.spectrum:
        from astropolcal.observations.reading import write_table

        write_table(star.table(), arguments.spectrum, overwrite=True)
    if arguments.plot:
        from astropolcal.plotting._style import save
        from astropolcal.plotting.correction import plot_images

        save(plot_images(result), arguments.plot, ObservationError)


def _sorted(files, instrument):
    """Return one file per frame, and the instrument that knows those of the left beams."""
    from astropolcal.reduction.headers import sort_beams

    files, layout, lost = sort_beams(files, instrument.files)
    for path, why in lost.items():
        raise ObservationError(f"{path}: {'; '.join(why)}")
    # the registry hands out instances that others may hold
    instrument = copy.copy(instrument)
    instrument.files = layout
    return files, instrument


def _check_options(arguments):
    """Refuse options that do not fit one another, before any work is done."""
    check_seed(arguments.seed)
    # a size that is none is refused with the images, whose width it depends on
    largest, star = arguments.size / 2, arguments.subtract_star or {}
    radii = {"--radius {:g}": arguments.radius}
    radii["--subtract-star annulus=...,{:g}"] = star.get("annulus", (0, 0))[1]
    for option, radius in radii.items():
        if radius is not None and radius > largest > 0:
            raise ParameterError(
                f"{option.format(radius)}: leaves the images of --size {arguments.size}; "
                f"allowed are up to {largest:g} pixels"
            )


def _radius(arguments):
    """Return the radius of the aperture; the usual one, as far as it is in the images."""
    return min(10.0, arguments.size / 2) if arguments.radius is None else arguments.radius


def _warn_of_sky(images, star, errors, radius):
    """
    Warn of light at the edge of the images that the aperture has too, and is not the star's.

    More than a halo has, or of another polarization. ``images`` are I, Q and U, (3, n_wavelengths,
    rows, columns), ``star`` those of the aperture, and ``errors`` those of its q and u.
    """
    size = min(images.shape[2:])
    if size < 3 * radius:
        # it is the star itself
        return
    places, area = np.indices(images.shape[2:]), np.pi * radius**2
    depth = np.minimum(places, np.subtract(images.shape[2:], 1)[:, None, None] - places).min(axis=0)
    edge, inner = (images[0][:, depth == place] for place in (0, size // 6))
    good = np.isfinite(edge).any(axis=1) & np.isfinite(inner).any(axis=1) & (star[0] > 0)
    if not good.any():
        return
    level, inside = (np.nanmedian(ring[good], axis=1) for ring in (edge, inner))
    light = star[0, good]
    # a halo falls by 1 / r or faster, to 2 / 3 from the inner ring to the edge
    sky = 3 * level - 2 * inside
    share = np.where(level > _far_off(edge[good]), sky * area / light, 0.0)
    if max(share) > _MOST_SKY:
        warn(
            f"the edge of the images has {100 * max(share):.2g} % of the light within {radius:g} "
            "pixels of the star, on the same area: a sky background changes I, and so q and u, and "
            "must be subtracted from the cubes before"
        )
    outer = images[:, good][..., depth <= size // 6]
    level = np.nanmedian(outer, axis=-1)
    # a halo is polarized as its star
    off = np.abs(level[1:] - star[1:, good] / light * level[0]) * area / light
    least = np.maximum(_MOST_POLARIZED, _far_off(outer[1:]) * area / light)
    told = off * (off > np.maximum(errors[:, good], least))
    if np.median(told.max(axis=0)):
        warn(
            "the edge of the images is polarized differently from the star: on the area of the "
            f"aperture this changes q or u by {100 * np.median(told.max(axis=0)):.2g} %, more than "
            "their errors; a sky background, or a bias of one beam or of some frames, must be "
            "subtracted from the cubes before"
        )


def _far_off(pixels):
    """Return what a median of pixels, the last axis, is not off zero by noise."""
    return 5 * np.nanstd(pixels, axis=-1) / np.sqrt(np.isfinite(pixels).sum(axis=-1))


# ---- the calibration ------------------------------------------------------------------------


def choose_calibration(arguments, files):
    """
    Return the calibration of the frames, its chain and the statements on where it comes from.

    A file that says itself that it does not hold for the frames is refused like one in a library,
    unless the user asks for it for any date.
    """
    from astropolcal.correction.rows import sky_chain
    from astropolcal.pipeline.headers import check_frames
    from astropolcal.reduction.frames import read_night

    path = Path(arguments.calibration)
    # a folder is searched when it is known what the frames need
    calibration, digest = (None, None) if path.is_dir() else _read(path)
    name = arguments.instrument or getattr(calibration, "instrument", None) or "charis"
    if calibration is not None and calibration.instrument:
        common.calibrated_instrument(calibration, path, name)
    night = read_night(files, instruments.get(name))
    # what the user says goes before what headers tell
    beam = night.beam if arguments.optics_in is None else {}
    if calibration is None:
        entry = _of_library(path, arguments, night, beam, files)
        path, calibration, digest = entry.path, entry.calibration, entry.content_hash
    # --filter names the mode as the file does, whatever the headers call it
    mode = arguments.filter or night.mode
    moments = [(file, date, mode) for file, date in night.moments.items()]
    max_age = None if arguments.max_age is None else arguments.max_age * u.yr
    options = {"max_age": max_age, "ways": _WAYS, "dates": not arguments.any_date}
    check_frames(calibration, moments, str(path), **options)
    wanted = {"optics_in": arguments.optics_in, "beam": beam, "date": night.dates or None}
    chain = sky_chain(calibration, label=str(path), **wanted)
    made = {"calibration": str(path), "calibration_hash": digest}
    return calibration, chain, made


def _read(path):
    """Return a calibration and its hash, which many sequences of an archive have in common."""
    from astropolcal.pipeline import library

    state = library._state(path) if os.path.exists(path) else None
    calibration, record = library._read(path, state or ())
    return calibration, record["content_hash"]


@lru_cache(maxsize=1)
def _library(path, changed):
    """Return a library, which many sequences of an archive have in common."""
    from astropolcal.pipeline.library import Library

    return Library(path)


def _of_library(path, arguments, night, beam, files):
    """Return the entry of the calibration that holds for the first and the last frame."""
    # None: the library chooses without a date
    dates = [None] if arguments.any_date else night.dates
    if not dates:
        raise ObservationError(f"{files[0]}: no date in its header to choose a calibration by")
    library, mode = _library(path, os.stat(path).st_mtime_ns), arguments.filter or night.mode
    wanted = {"mode": mode, "optics_in": arguments.optics_in, "beam": beam}
    try:
        found = [library.find(arguments.instrument, date=date, **wanted) for date in dates]
    except CalibrationFileError as error:
        # the library names what it needs, a user types options
        hint = f" ({_OPTIONS[error.argument]})" if error.argument in _OPTIONS else ""
        raise CalibrationFileError(f"{error}{hint}") from error
    # a night across the change of a calibration
    if len({str(entry.path) for entry in found}) > 1:
        raise AstropolcalError(
            f"{path}: the frames from {dates[0]} to {dates[-1]} need two calibrations, "
            f"{found[0].path} and {found[1].path}: correct them apart"
        )
    return library._with_changes(found[0])


# ---- the product ----------------------------------------------------------------------------


def _position_angles(table, arguments):
    if arguments.rotation == "none":
        return None
    # from north through east
    angle = np.full(len(table), arguments.camera_angle or 0.0) * u.deg
    if arguments.rotation == "fixed":
        return angle
    if "parallactic" not in table.colnames:
        raise ObservationError("--rotation pupil needs the parallactic angle of every frame")
    return angle + table["parallactic"]


def _warn_of_rotation(table, rotation, law):
    """Warn where the derotator held fixed what --rotation says to have turned."""
    kept = {"fixed": ("field", "pupil"), "pupil": ("pupil", "field")}.get(rotation, ())
    turns = [_turns(table, law, what) for what in kept]
    if not turns or any(each is None for each in turns):
        return
    off = [np.abs(each).max() / 2 for each in turns]
    if off[0] > _OFF_LAW and off[0] > 3 * off[1]:
        others = {"field": "fixed", "pupil": "pupil"}
        warn(
            f"--rotation {rotation}: the derotator is up to {off[0]:.1f} deg off the law by which "
            f"it keeps the {kept[0]}, and {off[1]:.1f} deg off that by which it keeps the "
            f"{kept[1]} (--rotation {others[kept[1]]}): images may be turned wrongly"
        )


def _turns(table, law, kept):
    """Return by how much the derotator turned what it keeps, from the mean; None if not known."""
    known = {"derotator", "parallactic", "altitude"} <= set(table.colnames)
    if not known or kept not in law.derotator:
        return None
    f, g = law.derotator_law(kept)
    # the image turns by twice its angle, so that half a turn is none
    return _from_mean(2 * (table["derotator"] - f * table["parallactic"] - g * table["altitude"]))


def _from_mean(angles):
    turns = np.exp(1j * angles.to_value(u.rad))
    return np.degrees(np.angle(turns / turns.sum()))


def _warn_of_turns(table, law, size):
    """Warn where the field turned from frame to frame, and images are summed as they are."""
    turns = _turns(table, law, "field")
    if turns is None and "parallactic" in table.colnames:
        # as --rotation pupil has it: nothing else turns the field
        turns = _from_mean(table["parallactic"])
    apart = 0.0 if turns is None else np.ptp(turns)
    # of the pixels at the edge
    moved = np.radians(apart) * size / 2
    if moved > _MOST_MOVED:
        warn(
            f"--rotation none: the field turned by up to {apart:.1f} deg between frames, "
            f"{moved:.2g} pixels at the edge of the images, which are summed as they are: what is "
            "not round about the star is smeared; --rotation fixed or pupil turn them north up"
        )


# names and keys of the polarization of a star, its unit, its factor and the form of the number
_POLARIZATION = (
    ("DoLP", "degree of linear polarization", "dolp", "s_p", " %", 100, ".2f"),
    ("AoLP", "angle of linear polarization", "aolp", "s_chi", " deg", 1, ".1f"),
    ("V/I", "circular polarization V / I", "v", "v", " %", 100, ".2f"),
)


def _summary(result, star, arguments, n_frames):
    spectrum, names = {"radius": _radius(arguments)}, result.components[1:].lower()
    spectrum |= {name: getattr(star, name) for name in names} | star.polarization()
    for kind in ("statistical", "systematic"):
        error = star.fractional_errors(kind)
        spectrum |= {f"{name}_{kind}": error[name] for name in names}
    same = ("mode", "observable", "components", "north_up", "condition")
    kept = ("calibration", "calibration_hash", "calibration_faults")
    summary = {"output": str(arguments.output), "n_frames": n_frames}
    summary |= {key: result.provenance[key] for key in kept}
    summary |= {key: getattr(result, key) for key in same} | {
        "wavelength_nm": result.wavelength.to_value(u.nm),
        "poorly_determined": {str(i): words for i, words in enumerate(result.weak) if words},
        "leakage_q": result.leakage[:, 1],
        "leakage_u": result.leakage[:, 2],
        "held": [] if result.systematic is None else result.systematic.held,
        "aperture": spectrum,
    }
    if (table := result.star) is not None:
        from astropolcal.correction.star import star_words

        told = {"from": table.meta["star"], "words": star_words(table)}
        told |= {name: u.Quantity(table[name]).value for name in table.colnames[1:]}
        summary["subtracted_star"] = told
    return summary


def _words(summary, systematic, arguments):
    """Return what was done, the star within the aperture, and how well both are determined."""
    from astropolcal.correction.result import impossible

    # not finite where nothing was determined
    condition = summary["condition"][np.isfinite(summary["condition"])]
    lines = [
        f"{counted(summary['n_frames'], 'frame')}, mode {summary['mode']}",
        f"  calibration: {one_line(summary['calibration'], None)}",
    ]
    if condition.size:
        limits = f"{min(condition):.3g} to {max(condition):.3g}"
        lines.append(f"  condition number of the solution for {summary['components']}: {limits}")
    for i, words in summary["poorly_determined"].items():
        line = f"  poorly determined at {summary['wavelength_nm'][int(i)]:.6g} nm: {words}"
        lines.append(common.wrapped(line, indent=4))
    star, is_open = summary["aperture"], systematic is not None and systematic.is_open
    lines.append(f"  star within {star['radius']:g} pixels, median over the wavelengths:")
    found, accuracy, lost = _polarization(star, is_open)
    lines += found
    if held := summary.get("held"):
        line = f"  without error, as not free in the calibration: {', '.join(held)}"
        lines.append(common.wrapped(line, indent=4))
    if not summary.get("north_up", True):
        line = "Q_phi and U_phi are made as if north were up, which --rotation none does not know"
        lines.append(common.wrapped(f"  {line}", indent=4))
    if subtracted := summary.get("subtracted_star"):
        lines.append(f"  subtracted from all light: {subtracted['words']} ({subtracted['from']})")
    n, poor = len(summary["wavelength_nm"]), summary["poorly_determined"]
    known = np.isfinite(star["q"]) & np.isfinite(star["u"])
    good = int(known.sum())
    verdict, advice = "Usable", common.following("info", arguments.output)
    if not good and len(poor) < n:
        verdict = f"NOT USABLE AS IT IS: no light within {star['radius']:g} pixels of the star"
        advice = "another --centre X,Y or --radius PIXELS"
    elif not good:
        verdict = "NOT USABLE AS IT IS: the frames determine the Stokes parameters nowhere"
        advice = "frames at more angles of the half-wave plate and of the field"
    elif lost:
        verdict = f"NOT USABLE AS IT IS: the calibration does not determine {' and '.join(lost)}"
        advice = "calibrate with a polarized standard star, or --open-directions SIGMA"
    elif wrong := impossible(star):
        verdict = f"NOT USABLE AS IT IS: the star is {wrong}"
        advice = "whether a background was subtracted twice, and the angles, in the cubes"
    elif faults := summary.get("calibration_faults"):
        verdict = f"NOT USABLE AS IT IS: the calibration is not: {faults[0]}"
        advice = common.following("info", summary["calibration"])
    elif good < n:
        lacking = all(str(w) in poor for w in np.flatnonzero(~known))
        what = "poorly determined" if lacking else "without a value"
        verdict = f"Usable: {what} at {counted(n - good, 'wavelength')}"
    written = [getattr(arguments, name) for name in ("output", "spectrum", "plot", "json")]
    determined = f"IQU at {good} of {n} wavelengths"
    if "v" in star:
        determined += f", V at {np.isfinite(star['v']).sum()}"
    accuracy = f"{accuracy} (statistical + systematic)"
    ends = common.ending(verdict, accuracy, determined, advice, common.written_lines(written))
    return common.with_ending(lines, ends, arguments.full)


def _polarization(star, is_open):
    """Return degree and angle of a star in lines, and their errors in one; which is open."""
    lines, accuracy, lost = [], [], []
    for name, words, key, error, unit, scale, form in _POLARIZATION:
        if key not in star:
            # V is zero, not found to be
            continue
        shown = _middle(scale * star[key], form, unit, turns=name == "AoLP")
        lines.append(f"    {words}: {shown}")
        errors = []
        for kind, unknown in (("statistical", False), ("systematic", is_open)):
            values = scale * star[f"{error}_{kind}"]
            none = "infinite" if unknown else "not known"
            lines.append(f"      {kind} error: {_middle(values, '.2g', unit, none=none)}")
            if unknown and key != "v" and not np.isfinite(values).any():
                lost.append(name)
            none = "open" if name in lost else "unknown"
            errors.append(_middle(values, ".2g", unit, none=none))
        accuracy.append(f"{name} {' + '.join(errors)}")
    # of V there is no room in a line
    accuracy = ", ".join(accuracy[:2])
    if not lost:
        # the unit once: the line is short
        accuracy = accuracy.replace(" % +", " +").replace(" deg +", " +")
    return lines, accuracy, lost


def _middle(values, form, unit, turns=False, none="not known"):
    """Return the median of what is known, as text; angles near 0 and 180 deg are neighbours."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return none
    if turns:
        # mean direction of doubled angles, from which the median is counted
        centre = np.degrees(np.angle(np.exp(2j * np.radians(known)).sum())) / 2
        known = centre + (known - centre + 90) % 180 - 90
        # rounded before the modulus, or 179.97 would be shown as 180.0
        return f"{float(f'{np.median(known):{form}}') % 180:{form}}{unit}"
    return f"{np.median(known):{form}}{unit}"
