# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Polarimetric efficiency over wavelength, derotator angle and pointing.

It is the share of the linear polarization that an observation measures; and
the derotator offset that loses least of it. Without a calibration the
published values are taken. Without a half-wave plate, the efficiencies of I,
Q, U and V in the frames that were calibrated.

For example::

  astropolcal efficiency                         published values of CHARIS
  astropolcal efficiency cal.asdf --altitude 60 --parallactic 94 -o plot.png
  astropolcal efficiency cal.asdf --derotator 45 70 90 --wavelength 1.2 1.6 2.2
  astropolcal efficiency cal.asdf --target 75.2,28.3 \
      --night 2025-11-03T08:00/2025-11-03T12:00
"""

from contextlib import suppress

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from astropolcal import efficiency, instruments
from astropolcal.chain import stages
from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.observations import pointing
from astropolcal.observations.pointings import offline
from astropolcal.optics import COORDINATES
from astropolcal.scripts import _common as common
from astropolcal.units import iso_date
from astropolcal.words import counted

_TITLE = "Polarimetric efficiency of {}"


# altitude and others have no default, so that it is known whether the table was asked for
OPTIONS = """
file CAL.asdf ? Input  calibration
--instrument NAME  default: that of the file, or charis
--altitude DEG angle  default: 60
--parallactic DEG angle  default: 0
--derotator DEG + angle  angles of the table (default: 0 to 90 in steps of 15)
--wavelength UM + float  wavelengths of the table in micrometre, the nearest calibrated ones
--target RA,DEC needs:night  for the best derotator offset: degrees, or 05:26:06,+16:42:00
--night START/END needs:target  times in UTC, with --target
--law MODE  what the derotator stabilizes, such as field (default: pupil); with --target, or where
    the law of the half-wave plate depends on it
--date DATE  of the telescope's mirrors, where that matters
-o --output FILE Drawing  save the figure (PNG, PDF, SVG), of instruments with a half-wave plate
@ json online quiet
"""


def run(arguments):
    """Print the table, draw the figure and write what was asked for."""
    asked = (arguments.altitude, arguments.parallactic, arguments.derotator, arguments.wavelength)
    planned = bool(arguments.target)
    # a target has its own pointing, not that of the table
    tabulated = not planned or any(a is not None for a in asked)
    arguments.altitude = 60.0 if arguments.altitude is None else arguments.altitude
    arguments.parallactic = arguments.parallactic or 0.0
    instrument, (chain, *others), grid, settings = _chains(arguments)
    if not efficiency.has_plate(chain):
        chains = [chain, *others]
        content, lines = _any_modulation(arguments, instrument, chains, grid, settings)
    else:
        content, lines = _table(arguments, instrument, chain, grid)
        if planned:
            content["best_derotator"], words = _best(arguments, instrument, chain, grid)
            lines = [*lines, "", *words] if tabulated else words
    if arguments.output:
        _draw(arguments, instrument, chain, grid)
    common.give(arguments, lines, content, arguments.output, arguments.json)


def _chains(arguments):
    """Return instrument, chains, that from the sky first, wavelengths and frames."""
    from astropolcal import Calibration
    from astropolcal.pipeline.headers import faults_of

    if arguments.file is None:
        instrument = instruments.get(arguments.instrument or "charis")
        chain, grid = instrument.published(), instrument.wavelength
        return instrument, [_on_sky(instrument, chain, grid, arguments)], grid, {}
    calibration = Calibration.read(arguments.file)
    grid = calibration.wavelength
    instrument = common.calibrated_instrument(calibration, arguments.file, arguments.instrument)
    faults_of(calibration, arguments.file)
    # a chain that has the telescope already is better than the published one
    chains = sorted(calibration.chains, key=lambda chain: "parallactic" not in stages(chain))
    chains[0] = _on_sky(instrument, chains[0], grid, arguments)
    return instrument, chains, grid, calibration.fit.get("sky_settings") or {}


def _any_modulation(arguments, instrument, chains, grid, settings):
    """Return the efficiencies of the frames that were calibrated, of any modulator."""
    from astropolcal.calibration.identifiability.sky import chain_from_sky, sequence_of

    for option in ("derotator", "target", "night", "law", "output"):
        if getattr(arguments, option):
            label = common.label_of(option)
            raise ParameterError(f"{label}: is for instruments with a half-wave plate")
    chain = chain_from_sky(chains, instrument, grid, arguments.date)[0]
    own = [stage for stage in stages(chain) if stage not in ("altitude", "parallactic")]
    placed = sequence_of(own, settings)
    if placed is None:
        raise ParameterError(f"{instrument.name}: no frames are known; give a calibration file")
    frames, pointing = QTable(), _pointing(arguments, chain)
    for stage, values in placed[0].items():
        device, is_state, state = stage.partition("=")
        if not is_state:
            frames[stage] = values * (1 if stage in COORDINATES else u.rad)
            continue
        before = frames.columns.get(device, np.full(len(values), "", dtype=object))
        frames[device] = np.where(values > 0, state, before)
    for stage, angle in pointing.items():
        frames[stage] = np.full(len(frames), angle.value) * angle.unit
    # what lacks Q or U is refused; a V that is hardly modulated would only add its noise to them
    found = efficiency.demodulation(chain, grid, frames, components="IQU")
    with suppress(ParameterError):
        whole = efficiency.demodulation(chain, grid, frames)
        # from which efficiency on V is solved for, too
        found = whole if whole.efficiency[:, 3].min() > 0.1 else found
    rows = _rows(arguments.wavelength, grid)
    content = {"instrument": instrument.name, "n_frames": len(frames)}
    content |= {f"{key}_deg": angle.value for key, angle in pointing.items()}
    content |= {"wavelength_nm": grid.to_value(u.nm)[rows], "components": list(found.components)}
    content["efficiency"] = found.efficiency.T[:, rows]
    words = f"Efficiencies of {counted(len(frames), 'frame')} of {instrument.name} "
    words += "(del Toro Iniesta & Collados 2000)"
    return content, _table_lines(words, " ", found.components, content)


def _table_lines(title, corner, names, content):
    """Return a table of efficiencies by wavelength with the names of its rows."""
    rows = zip(names, content["efficiency"], strict=True)
    return [
        *(title, "", corner + "".join(f"{lam:8.0f}" for lam in content["wavelength_nm"]) + " nm"),
        *(name + "".join(f"{value:z8.3f}" for value in row) for name, row in rows),
    ]


def _on_sky(instrument, chain, grid, arguments):
    """Return the chain downstream of the telescope; as it is where no telescope is known."""
    if not instrument.has_telescope or "parallactic" in stages(chain):
        return chain
    if arguments.date is not None and "date" not in instrument.sky_options:
        raise ParameterError(f"--date: the telescope of {instrument.name} is that of any date")
    return instrument._from_sky(chain, wavelength=grid, date=arguments.date)


def _table(arguments, instrument, chain, grid):
    """Return the table of an instrument with a half-wave plate, and what is printed of it."""
    turns = efficiency.has_derotator(chain)
    if arguments.derotator and not turns:
        raise ParameterError(f"--derotator: {instrument.name} has none in this chain")
    derotator = np.array(arguments.derotator or np.arange(0, 91, 15), dtype=float)
    rows, pointing = _rows(arguments.wavelength, grid), _pointing(arguments, chain)
    settings = {"instrument": instrument, "mode": _mode(arguments, instrument)} | pointing
    settings["derotator"] = derotator * u.deg if turns else None
    values = np.atleast_2d(efficiency.polarimetric_efficiency(chain, grid, **settings))[:, rows]
    content = {"instrument": instrument.name}
    content |= {f"{key}_deg": a.value for key, a in pointing.items()}
    # absent where there is none, not empty
    content |= {"derotator_deg": derotator} if turns else {}
    content |= {"wavelength_nm": grid.to_value(u.nm)[rows], "efficiency": values}
    where = "downstream of the internal source"
    if pointing:
        where = "at altitude {altitude_deg:g} deg, parallactic angle {parallactic_deg:g} deg"
    corner, names = "", [""]
    if turns:
        corner, names = "derotator", [f"{angle:8.2f} " for angle in derotator]
    title = f"{_TITLE.format(instrument.name)} {where.format_map(content)}"
    lines = _table_lines(title, corner, names, content)
    # what is printed as more than 1
    if np.max(values) >= 1.0005:
        lines.append("Above 1: optics before the analyzer add polarization of their own.")
    return content, lines


def _pointing(arguments, chain):
    """Return the angles of the telescope, where the chain has one."""
    on_sky = {"altitude", "parallactic"} & set(stages(chain))
    keys = ("altitude", "parallactic") if on_sky else ()
    return {key: getattr(arguments, key) * u.deg for key in keys}


def _mode(arguments, instrument):
    """Return what the derotator stabilizes; the pupil, if it can and nothing is stated."""
    modes = instrument.sky_law.modes
    if arguments.law is not None and modes and arguments.law not in modes:
        raise ParameterError(
            f"--law {arguments.law}: allowed of {instrument.name} are {', '.join(modes)}"
        )
    if arguments.law and not (arguments.target or instrument.sky_law.plate_depends_on_mode):
        raise ParameterError(
            f"--law {arguments.law}: of {instrument.name} it only tells the best offset of the "
            "derotator, which needs --target and --night"
        )
    # high-contrast imaging keeps the pupil still
    usual = "pupil" if "pupil" in modes else next(iter(modes), None)
    return arguments.law or usual


def _rows(wanted, grid):
    lam = grid.to_value(u.um)
    if wanted is None:
        # eight columns fit a terminal
        return np.unique(np.linspace(0, lam.size - 1, min(8, lam.size)).astype(int))
    wanted = np.array(wanted)
    # 2 %: a rounded wavelength of the first or last bin is meant
    outside = (wanted < 0.98 * lam.min()) | (wanted > 1.02 * lam.max())
    if outside.any():
        raise ParameterError(
            f"--wavelength {wanted[outside][0]:g}: allowed are {lam.min():.3f} to "
            f"{lam.max():.3f} um"
        )
    return np.unique(np.abs(wanted[:, None] - lam).argmin(axis=1))


def _best(arguments, instrument, chain, grid):
    """Return the statements on the best derotator offset, and the same in words."""
    if instrument.location is None:
        raise InstrumentError(f"{instrument.name}: its site is not known")
    target = common.sky_position(arguments.target, "--target")
    altitude, parallactic = pointing(target, _times(arguments.night), instrument.location)
    mode = _mode(arguments, instrument)
    best = efficiency.best_derotator(
        chain, grid, altitude, parallactic, law=mode, instrument=instrument
    )
    # north of the zenith the angle passes 180 deg, and goes on at -180 deg
    turned = np.unwrap(parallactic.to_value(u.deg), period=360)
    # the offset whose worst moment is the best
    row = int(np.argmax(best.table["least"]))
    found = {
        "law": best.law,
        "offset_deg": best.offset.to_value(u.deg),
        "least": best.table["least"][row],
        "mean": best.table["mean"][row],
        "least_of_any_offset": np.min(best.table["least"]),
        "altitude_deg": [altitude.value.min(), altitude.value.max()],
        "parallactic_deg": [turned.min(), turned.max()],
    }
    (low, high), (east, west) = found["altitude_deg"], found["parallactic_deg"]
    words = [
        f"Target at altitude {low:z.1f} to {high:z.1f} deg, parallactic angle {east:z.1f} to "
        f"{west:z.1f} deg",
        f"Best derotator offset of {instrument.name}, {best.law} stabilized: "
        f"{found['offset_deg']:zg} deg",
        "  efficiency over times, wavelengths and angles of polarization: least "
        f"{found['least']:z.3f},",
        f"  mean {found['mean']:z.3f}; with the worst offset the least is "
        f"{found['least_of_any_offset']:z.3f}",
    ]
    return found, words


def _times(text):
    """Return moments over the observation."""
    try:
        with offline():
            start, end = (Time(iso_date(part), scale="utc") for part in text.split("/"))
            moments = start + (end - start) * np.linspace(0, 1, 25)
    except ValueError:
        raise ParameterError(
            f"--night {text}: write START/END in UTC, such as 2025-11-03T08:00/2025-11-03T12:00"
        ) from None
    if end < start:
        raise ParameterError(f"--night {text}: ends before it starts; write START/END")
    return moments


def _draw(arguments, instrument, chain, grid):
    """Draw the efficiency against derotator angle, wavelength and pointing."""
    from astropolcal.plotting._style import save
    from astropolcal.plotting.efficiency import plot_polarimetric_efficiency

    settings = {key: getattr(arguments, key) * u.deg for key in ("altitude", "parallactic")}
    shown = None if arguments.wavelength is None else arguments.wavelength * u.um
    # one angle a figure, the last that was asked for
    settings |= {"derotator": (arguments.derotator or [90.0])[-1] * u.deg, "shown": shown}
    settings |= {"instrument": instrument, "mode": _mode(arguments, instrument)}
    title = _TITLE.format(instrument.name)
    save(plot_polarimetric_efficiency(chain, grid, title=title, **settings), arguments.output)
