# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal correct``: from science cubes to Stokes parameters."""

import argparse

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.files import one_line
from astropolcal.scripts._choosing import choose_calibration, configured
from astropolcal.scripts._common import (
    Frames,
    Input,
    Output,
    add_json,
    add_online,
    add_quiet,
    check_suffix,
    cube_files,
    is_quiet,
    number_or,
    show,
    wrapped,
    write_json,
)
from astropolcal.units import plain_number
from astropolcal.words import counted

_EPILOG = """\
examples:
  astropolcal correct --calibration cal.asdf cubes/ --raw raw/ -o stokes.fits
  astropolcal correct --calibration library/ cubes/ -o out.fits --plot fig.png
  astropolcal correct --calibration cal.asdf cubes/ -o disk.fits \\
      --rotation pupil --camera-angle 113 --open-directions ignore
"""

_OUTPUT = "the product; overwritten if it exists"

# what a chain may ask of a frame
_ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "correct",
        help="correct science cubes with a calibration and write Stokes parameters",
        description="Solve for the Stokes parameters of the light that entered the telescope, by\n"
        "least squares over all frames, and write them with their errors.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "cubes", metavar="CUBES", nargs="+", type=Frames, help="cubes, or folders of them (*.fits)"
    )
    parser.add_argument(
        "--calibration",
        metavar="LIB_OR_FILE",
        type=Input,
        required=True,
        help="a calibration file, or a folder of them, from which the one that holds for the "
        "frames is taken",
    )
    parser.add_argument(
        "-o", "--output", metavar="OUT.fits", type=Output, required=True, help=_OUTPUT
    )
    _add_solution(parser)
    _add_instrument(parser)
    _add_images(parser)
    _add_errors(parser)
    parser.add_argument(
        "--spectrum",
        metavar="OUT.ecsv",
        type=Output,
        help="table of the star in an aperture",
    )
    parser.add_argument(
        "--radius",
        metavar="PIXELS",
        type=float,
        help="of the aperture (default: 10, or half of a smaller --size)",
    )
    parser.add_argument("--plot", metavar="FILE", type=Output, help="figure of the result")
    parser.add_argument("--workers", metavar="N", type=int, help="threads of dask")
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of dask.distributed")
    add_json(parser)
    add_online(parser)
    add_quiet(parser)
    parser.set_defaults(run=run)


def _add_solution(parser):
    """Add what says what is solved for, and from what."""
    parser.add_argument(
        "--mode",
        choices=("stokes", "ip"),
        default="stokes",
        help="stokes (default): invert the Mueller matrices; ip: instrumental polarization only",
    )
    parser.add_argument(
        "--observable",
        choices=("intensity", "single", "double"),
        help="what is fitted: the beams, or their single or double differences and sums "
        "(default: what the calibration fitted)",
    )
    parser.add_argument(
        "--components", choices=("IQU", "IQUV"), default="IQU", help="default: IQU, V is zero"
    )
    parser.add_argument(
        "--weights",
        choices=("equal", "variance"),
        default="equal",
        help="of the fluxes: equal (default), or one over their variances",
    )
    parser.add_argument(
        "--brightness",
        choices=("exposure", "measured"),
        default="measured",
        help="relative brightness of the frames: by the light in the images (default), or by "
        "their exposure times alone",
    )
    parser.add_argument(
        "--max-condition",
        metavar="X",
        type=float,
        default=30.0,
        help="condition number from which on Stokes parameters count as poorly determined "
        "and are left out (default: 30)",
    )


def _add_errors(parser):
    """Add what says how the calibration's errors are propagated."""
    parser.add_argument(
        "--open-directions",
        metavar="SIGMA",
        type=number_or("infinite", "ignore"),
        default="infinite",
        help="systematic errors along what the calibration leaves open: infinite (default), "
        "ignore, or the standard deviation of the angle that each is named after, in degrees",
    )
    parser.add_argument(
        "--samples",
        metavar="N",
        type=int,
        default=0,
        help="systematic errors from N samples of the calibration (default: linearized)",
    )
    parser.add_argument("--seed", metavar="N", type=int, help="of the random numbers of --samples")


def _add_instrument(parser):
    parser.add_argument("--instrument", metavar="NAME", help="default: that of the calibration")
    parser.add_argument(
        "--raw",
        metavar="DIR",
        type=Frames,
        help="folder of raw frames, for keywords that the cubes lack",
    )
    parser.add_argument(
        "--optics-in",
        metavar="NAME,NAME,...",
        type=lambda text: [name.strip() for name in text.split(",") if name.strip()],
        help="all optional optics that were in the beam ('' for none), where headers do not tell "
        "and the calibration has several sets of them",
    )
    parser.add_argument(
        "--filter",
        metavar="MODE",
        help="mode of the instrument, as the calibration calls it; default: what headers say",
    )
    parser.add_argument(
        "--any-date",
        action="store_true",
        help="take the calibration even if it does not hold for the date of the frames",
    )
    parser.add_argument(
        "--max-age",
        metavar="YEARS",
        type=float,
        help="time between the data of the calibration and the frames from which on there is a "
        "warning (default: that of the instrument, mostly 1)",
    )
    parser.add_argument(
        "--interpolate",
        action="store_true",
        help="interpolate parameters that are known at the calibrated wavelengths only",
    )


def _add_images(parser):
    parser.add_argument(
        "--centre",
        metavar="X,Y",
        type=_point,
        help="place of the star in the left beam, 0-based; by default it is found",
    )
    parser.add_argument(
        "--size",
        metavar="PIXELS",
        type=int,
        default=51,
        help="width of the images of the product (default: 51)",
    )
    parser.add_argument(
        "--rotation",
        choices=("none", "fixed", "pupil"),
        default="none",
        help="how the field turned: not known, images stay as they are (default); the +y axis at a "
        "fixed position angle; at a fixed angle from the zenith",
    )
    parser.add_argument(
        "--camera-angle",
        metavar="DEG",
        type=float,
        help="position angle of the +y axis, or with --rotation pupil that from the zenith "
        "(default: 0)",
    )
    parser.add_argument("--mirrored", action="store_true", help="east is to the right of north")


def _point(text):
    try:
        x, y = (plain_number(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y") from None
    return x, y


def run(arguments):
    """Correct the cubes and write the product."""
    from astropolcal import instruments
    from astropolcal.correction import ScienceFrames

    check_suffix("-o", arguments.output, ".fits")
    check_suffix("--spectrum", arguments.spectrum, ".ecsv")
    _check_options(arguments)
    files = cube_files(arguments.cubes)
    # before the images are opened: which calibration holds is known from headers
    calibration, chain, provenance = choose_calibration(arguments, files)
    instrument = instruments.get(arguments.instrument or calibration.instrument or "charis")
    instrument = configured(instrument, files)
    # one a frame: files of left beams follow those of the right ones
    files = instrument.files.frame_files(files)
    table, centres, scale, left_scale = _headers(files, instrument, arguments)
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
        left_scale=left_scale,
        # date and mode were checked when the calibration was chosen
        date=None,
        mode=calibration.validity.mode,
    )
    result = _corrected(calibration, frames, chain, arguments, provenance)
    result.write(arguments.output, overwrite=True)
    # for the report, too, not only for --spectrum
    star = result.aperture(_radius(arguments))
    _write_others(result, star, arguments)
    summary = _summary(result, star, arguments, len(files))
    if arguments.json:
        write_json(summary, arguments.json)
    if not is_quiet(arguments):
        _report(summary, result.systematic)


def _check_options(arguments):
    """Refuse options that have no meaning beside the others, before any work is done."""
    from astropolcal.simulation import check_seed

    if arguments.rotation == "none" and arguments.camera_angle is not None:
        raise ParameterError(
            f"--camera-angle {arguments.camera_angle:g}: is for --rotation fixed or --rotation "
            "pupil; with --rotation none the images are not turned"
        )
    if arguments.seed is not None and not arguments.samples:
        raise ParameterError(f"--seed {arguments.seed}: is for --samples N")
    check_seed(arguments.seed)
    # a size that is none is refused with the images, whose width it depends on
    largest = arguments.size / 2
    if arguments.radius is not None and arguments.radius > largest > 0:
        raise ParameterError(
            f"--radius {arguments.radius:g}: leaves the images of --size {arguments.size}; "
            f"allowed are up to {largest:g} pixels"
        )


def _radius(arguments):
    """Return the radius of the aperture; the usual one, as far as it is in the images."""
    return min(10.0, arguments.size / 2) if arguments.radius is None else arguments.radius


def _corrected(calibration, frames, chain, arguments, provenance):
    from astropolcal.correction import correct

    return correct(
        calibration,
        frames,
        mode=arguments.mode,
        observable=arguments.observable,
        brightness="measured" if arguments.brightness == "measured" else "given",
        components=arguments.components,
        weights="variance" if arguments.weights == "variance" else None,
        max_condition=arguments.max_condition,
        open_directions=arguments.open_directions,
        any_date=True,
        n_samples=arguments.samples,
        seed=arguments.seed,
        workers=arguments.workers,
        cluster=arguments.cluster,
        progress=not arguments.quiet,
        provenance=provenance,
        chain=chain,
        interpolate=arguments.interpolate,
    )


def _headers(files, instrument, arguments):
    """Return angles of all frames, places of the star, exposures, and scales of the left beam."""
    from astropy.table import QTable

    from astropolcal.reduction.frames import beam_scale
    from astropolcal.reduction.headers import raw_frames

    layout = instrument.files
    raw = None if arguments.raw is None else raw_frames(arguments.raw, layout)
    found = _frames(files, layout, raw, arguments.centre)
    table = QTable()
    for name in _ANGLES:
        # an angle that no header has is no column at all
        values = [frame.values.get(name, np.nan) for frame in found]
        if np.isfinite(values).any():
            table[name] = values * u.deg
    states = [frame.values.get("flc_state", "") for frame in found]
    if any(states):
        table["flc_state"] = states
    if "hwp_true" in table.colnames and not np.isfinite(table["hwp_true"]).all():
        # an angle that some headers lack follows from the tracking law in all
        table.remove_column("hwp_true")
    centres = arguments.centre
    if centres is None:
        # (beam, x and y): the star stands still over the slices within a fraction of a pixel
        centres = [np.median([f.photometry.x, f.photometry.y], axis=2).T for f in found]
        first = np.asarray(centres)
        if not np.isfinite(first).all():
            bad = files[int(np.argmin(np.isfinite(first).all(axis=(1, 2))))]
            raise ObservationError(f"{bad}: the star was not found; give its place with --centre")
    # frames of equal exposures need no scale, known or not
    exposure = np.array([frame.values.get("exposure_time", np.nan) for frame in found])
    differ = np.isfinite(exposure).all() and np.ptp(exposure) > 1e-6 * exposure.max()
    left = [beam_scale(file, layout, f.values) for file, f in zip(files, found, strict=True)]
    return table, centres, exposure / np.median(exposure) if differ else None, left


def _frames(files, layout, raw, centre):
    """Return what is known of the files; refuse one that cannot be used."""
    from astropolcal.reduction.frames import check_stars, reduce_frame
    from astropolcal.reduction.headers import add_pointing, not_of_instrument, read_header

    if centre is None:
        # finds the star, which takes the time of this step
        frames = [reduce_frame(file, layout, source="star", raw=raw) for file in files]
        check_stars(frames, layout)
    else:
        frames = [read_header(file, layout, raw=raw) for file in files]
        # whether they are needed depends on the calibration
        add_pointing(frames, layout, needed=False)
    for file, frame in zip(files, frames, strict=True):
        foreign = not_of_instrument(frame.values, layout)
        if foreign:
            raise ObservationError(f"{file}: {foreign}")
        if frame.errors:
            raw_hint = "; --raw names a folder of raw frames"
            hint = raw_hint if raw is None and layout.raw_columns else ""
            raise ObservationError(f"{file}: {'; '.join(frame.errors)}{hint}")
    return frames


def _position_angles(table, arguments):
    if arguments.rotation == "none":
        return None
    # from north through east
    angle = np.full(len(table), arguments.camera_angle or 0.0) * u.deg
    if arguments.rotation == "pupil":
        if "parallactic" not in table.colnames:
            raise ObservationError("--rotation pupil needs the parallactic angle of every frame")
        angle = angle + table["parallactic"]
    return angle


def _write_others(result, star, arguments):
    if arguments.spectrum:
        from astropolcal.files import atomic_path

        table = star.table()
        with atomic_path(arguments.spectrum, ObservationError) as temporary:
            table.write(temporary, format="ascii.ecsv", overwrite=True)
    if arguments.plot:
        from astropolcal.plotting.correction import plot_corrected, save_figure

        save_figure(plot_corrected(result), arguments.plot)


def _summary(result, star, arguments, n_frames):
    known = star.polarization()
    errors = {kind: star.fractional_errors(kind) for kind in ("statistical", "systematic")}
    spectrum = {"q": star.q, "u": star.u} | known
    for kind, error in errors.items():
        spectrum |= {f"q_{kind}": error["q"], f"u_{kind}": error["u"]}
    return {
        "output": str(arguments.output),
        "calibration": result.provenance["calibration"],
        "calibration_hash": result.provenance["calibration_hash"],
        "mode": result.mode,
        "observable": result.observable,
        "components": result.components,
        "n_frames": n_frames,
        "north_up": result.north_up,
        "wavelength_nm": result.wavelength.to_value(u.nm).tolist(),
        "condition": _plain(result.condition),
        "poorly_determined": dict((str(i), words) for i, words in enumerate(result.weak) if words),
        "leakage_q": _plain(result.leakage[:, 1]),
        "leakage_u": _plain(result.leakage[:, 2]),
        "held": [] if result.systematic is None else result.systematic.held,
        "aperture": {"radius": _radius(arguments)}
        | {name: _plain(values) for name, values in spectrum.items()},
    }


def _plain(values):
    """Return numbers for JSON, None where there is none."""
    # JSON has no NaN
    return [float(value) if np.isfinite(value) else None for value in values]


def _report(summary, systematic):
    # None where nothing was determined
    condition = [value for value in summary["condition"] if value is not None]
    frames = counted(summary["n_frames"], "frame")
    written, calibration = (one_line(summary[key], None) for key in ("output", "calibration"))
    show(f"Written: {written} ({frames}, mode {summary['mode']})")
    show(f"  calibration: {calibration}")
    if condition:
        show(
            f"  condition number of the solution for {summary['components']}: "
            f"{min(condition):.3g} to {max(condition):.3g}"
        )
    for i, words in summary["poorly_determined"].items():
        line = f"  poorly determined at {summary['wavelength_nm'][int(i)]:.6g} nm: {words}"
        show(wrapped(line, indent=4))
    aperture = summary["aperture"]
    show(f"  star within {aperture['radius']:g} pixels, median over the wavelengths:")
    # JSON has null where it is infinite
    unknown = "infinite" if systematic is not None and systematic.is_open else "not known"
    for name, unit, error, words, scale in (
        ("dolp", " %", "s_p", "degree of linear polarization", 100),
        ("aolp", " deg", "s_chi", "angle of linear polarization", 1),
    ):
        values = _scaled(aperture[name], scale)
        shown = _middle(values, ".2f" if name == "dolp" else ".1f", unit, name == "aolp")
        show(f"    {words}: {shown}")
        for kind, none in (("statistical", "not known"), ("systematic", unknown)):
            values = _scaled(aperture[f"{error}_{kind}"], scale)
            show(f"      {kind} error: {_middle(values, '.2g', unit, none=none)}")


def _scaled(values, scale):
    return [None if value is None else scale * value for value in values]


def _middle(values, form, unit, turns=False, none="not known"):
    """Return the median of what is known, as text; angles near 0 and 180 deg are neighbours."""
    known = np.array([value for value in values if value is not None])
    if known.size == 0:
        return none
    if turns:
        # mean direction of doubled angles, from which the median is counted
        centre = np.degrees(np.angle(np.exp(2j * np.radians(known)).sum())) / 2
        known = centre + (known - centre + 90) % 180 - 90
        # rounded before the modulus, or 179.97 would be shown as 180.0
        return f"{float(f'{np.median(known):{form}}') % 180:{form}}{unit}"
    return f"{np.median(known):{form}}{unit}"
