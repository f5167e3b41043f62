# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal simulate``: beam fluxes or image cubes of an instrument, with noise."""

from astropolcal.exceptions import AstropolcalError
from astropolcal.files import one_line
from astropolcal.scripts._common import (
    Folder,
    Input,
    Output,
    add_command,
    add_shared,
    adder,
    angles,
    check_suffix,
    edit_chains,
    printer,
    write_json,
)
from astropolcal.words import counted

#: What the packaged example was made with.
EXAMPLE = {"flux": 4e6, "gain": 1.0, "read_noise": 100.0, "seed": 20251005}

# double differences of Q, then of U: the order in which stars are observed
_STAR_CYCLE = [0, 45, 22.5, 67.5]

_EXAMPLES = """\
examples:
  astropolcal simulate -o run.ecsv                      the packaged example
  astropolcal simulate -o run.ecsv --derotator 45,70,95 --fix hwp.w_sio2=1.66mm
  astropolcal simulate -o true.ecsv --cubes lamp        image cubes, raw headers
  astropolcal simulate --cubes star --source star --altitude 67,64 \\
      --parallactic 24,30 --derotator 97 --fix star.q=0.01
"""

# of the light in an image
_LOOKS = ("source", "psf", "fwhm", "halo", "background")
_DEROTATOR = [45 + 12.5 * i for i in range(8)]
_PSF = "moffat"

#: Options of ``--cubes`` that are numbers: default, unit and meaning.
_IMAGES = {
    "fwhm": (5.0, "PIX", "full width of a star's core at half maximum"),
    "halo": (0.0, "SHARE", "share of a star's light in its halo"),
    "motion": (0.0, "PIX", "standard deviation of a star's place from frame to frame"),
    "seeing": (0.0, "PART", "relative standard deviation of its width"),
    "background": (0.0, "ADU", "of each pixel"),
    "bad_pixels": (0.0, "SHARE", "share of the pixels without a value"),
    "flat_error": (0.0, "PART", "relative standard deviation of the pixels' response"),
}


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = add_command(
        commands,
        "simulate",
        run,
        "simulate an observation table or image cubes, with photon and read noise",
        "Simulate the beam fluxes of an instrument's chain: the published values,\n"
        "or those of a calibration file. With --cubes, simulate its image cubes.",
        _EXAMPLES,
    )
    add = adder(parser)
    add(
        "-o --output OBS.ecsv",
        "the table (required without --cubes; with it, the true fluxes); overwritten if it exists",
        type=Output,
    )
    add("--instrument NAME", "default: charis", default="charis")
    add("--calibration CAL.asdf", "take the chain from this file", type=Input)
    _add_frames(add)
    _add_cubes(adder(parser.add_argument_group("image cubes")))
    _add_noise(add)
    add("--fix NAME=VALUE ...", "set a parameter of the true chain")
    add("--without OPTIC ...", "take an optic out of the true chain")
    add_shared(parser, "json", "quiet")


def _add_frames(add):
    add(
        "--hwp DEG,DEG,...",
        "half-wave-plate angles (default: 0 to 78.75 by 11.25; of a star 0, 45, 22.5 and 67.5)",
        type=angles,
    )
    add(
        "--derotator DEG,DEG,...",
        "derotator angles (default: 45 to 132.5 by 12.5)",
        type=angles,
    )
    add(
        "--source",
        "the internal source, or a star (default: %(default)s)",
        choices=("internal", "star"),
        default="internal",
    )
    for name in ("altitude", "parallactic"):
        meaning = f"{name} angle of a star in all frames, or in the first and last"
        add(f"--{name} DEG[,DEG]", meaning, type=angles)


def _add_noise(add):
    add(
        "--flux ADU",
        f"flux that enters, per wavelength (default: {EXAMPLE['flux']:g}; cubes: less where "
        "the brightest pixel would be above half of the saturation)",
        type=float,
    )
    add(
        "--gain E/ADU",
        "electrons per adu (default: %(default)g; cubes: the instrument's)",
        type=float,
        default=EXAMPLE["gain"],
    )
    add(
        "--read-noise E",
        "electrons per beam and frame (default: %(default)g; cubes: the instrument's)",
        type=float,
        default=EXAMPLE["read_noise"],
    )
    add("--no-noise", "leave the noise out")
    add("--seed SEED", "default: %(default)s", type=int, default=EXAMPLE["seed"])


def _add_cubes(add):
    add("--cubes DIR", "write image cubes to this folder, raw headers to DIR/raw", type=Folder)
    add(
        "--psf",
        "profile of a star's core (default: %(default)s)",
        choices=("moffat", "gaussian"),
        default=_PSF,
    )
    for name, (default, unit, meaning) in _IMAGES.items():
        add(
            f"--{name.replace('_', '-')} {unit}",
            f"{meaning} (default: %(default)g)",
            type=float,
            default=default,
        )
    add("--saturate", "cut pixels off at the instrument's saturation")


def run(arguments):
    """Simulate and write the table, the cubes or both."""
    from astropolcal import instruments

    if not (arguments.output or arguments.cubes):
        raise AstropolcalError("nothing to write: give -o OBS.ecsv, --cubes DIR or both")
    check_suffix("-o", arguments.output, ".ecsv")
    _check_images(arguments)
    instrument = instruments.get(arguments.instrument)
    chain, wavelength, meta = _truth(arguments, instrument)
    # free and prior mean nothing for what is true
    (chain,) = edit_chains([chain], without=arguments.without, fix=arguments.fix)
    frames = _frames(arguments, chain)
    if arguments.flux is None:
        arguments.flux = _flux(arguments, instrument, chain, wavelength, frames)
    # of the set-up, less the optics taken out
    meta = meta | instrument.meta_without(arguments.without) | {"simulated": True}
    observations = _table(arguments, instrument, chain, wavelength, frames, meta)
    written = []
    if arguments.cubes:
        paths = _write_cubes(arguments, instrument, chain, wavelength, frames)
        written.append(f"{one_line(arguments.cubes, None)} ({counted(len(paths), 'cube')})")
    if arguments.output:
        observations.write(arguments.output, overwrite=True)
        size = counted(observations.n_frames, "frame"), counted(observations.n_bins, "wavelength")
        written.append(f"{one_line(arguments.output, None)} ({' x '.join(size)})")
    if arguments.json:
        write_json(_summary(observations, arguments), arguments.json)
    printer(arguments)(f"Written: {', '.join(written)}")


def _check_images(arguments):
    """Refuse options of image cubes where none are made."""
    if arguments.cubes:
        return
    usual = {name: default for name, (default, *_) in _IMAGES.items()}
    for name, default in (usual | {"psf": _PSF, "saturate": False}).items():
        if getattr(arguments, name) != default:
            raise AstropolcalError(f"--{name.replace('_', '-')}: is for --cubes DIR")


def _frames(arguments, chain):
    """Return half-wave-plate cycles in all states, for a star with the pointing of each frame."""
    import astropy.units as u
    import numpy as np

    from astropolcal.chain import stages
    from astropolcal.reduction.cubes import both_states
    from astropolcal.simulation import half_wave_plate_cycles

    star = arguments.source == "star"
    hwp = arguments.hwp or (_STAR_CYCLE if star else None)
    given = {"derotator": arguments.derotator or _DEROTATOR}
    given |= {"hwp": hwp} if hwp else {}
    frames = half_wave_plate_cycles(**{k: v * u.deg for k, v in given.items()})
    for name in ("altitude", "parallactic"):
        ends = getattr(arguments, name)
        if star and (ends is None or len(ends) > 2):
            raise AstropolcalError(f"a star needs --{name} DEG, or DEG,DEG of first and last frame")
        if ends and not star:
            raise AstropolcalError(f"--{name}: is for --source star")
        if star:
            # linear in the frame: close to the sky over an hour or less
            frames[name] = np.linspace(ends[0], ends[-1], len(frames)) * u.deg
    # a modulator alternates within each setting of the plate
    return both_states(frames) if "flc_state" in stages(chain) else frames


def _flux(arguments, instrument, chain, wavelength, frames):
    """Return the flux where none is given."""
    if not arguments.cubes:
        return EXAMPLE["flux"]
    from astropolcal.reduction.cubes import _usual_flux

    options = {name: getattr(arguments, name) for name in _LOOKS}
    return _usual_flux(chain, instrument, frames, EXAMPLE["flux"], wavelength=wavelength, **options)


def _table(arguments, instrument, chain, wavelength, frames, meta):
    """Return the table: with noise, or beside cubes the true fluxes."""
    from astropolcal.reduction.cubes import true_observations
    from astropolcal.simulation import simulate

    options = {
        **{name: getattr(arguments, name) for name in ("flux", "gain", "read_noise", "seed")},
        # beside cubes the table is the truth that a reduction must find again
        "noise": not (arguments.no_noise or arguments.cubes),
        "meta": meta,
        "name": "simulated",
    }
    if arguments.source == "internal":
        return simulate(chain, wavelength, frames, **options)
    options |= {"wavelength": wavelength, "source": "star"}
    return true_observations(chain, instrument, frames, **options)


def _write_cubes(arguments, instrument, chain, wavelength, frames):
    from astropolcal.reduction.cubes import simulate_cubes

    names = ("source", "flux", "psf", "saturate", "seed", *_IMAGES)
    return simulate_cubes(
        arguments.cubes,
        chain,
        instrument,
        frames,
        wavelength=wavelength,
        noise=not arguments.no_noise,
        progress=not arguments.quiet,
        **{name: getattr(arguments, name) for name in names},
    )


def _truth(arguments, instrument):
    """Return the true chain, its wavelengths and the meta that describe its set-up."""
    if arguments.calibration:
        from astropolcal.calibration import Calibration

        calibration = Calibration.read(arguments.calibration)
        # a copy: it is edited
        chain, wavelength = calibration.chain.copy(), calibration.wavelength
        meta = dict(calibration.datasets[0].meta)
    else:
        chain, wavelength = instrument.published(), instrument.wavelength
        meta = instrument.published_meta()
    if arguments.source == "star":
        chain = _behind_telescope(chain, instrument, wavelength)
        meta |= {"source": "star"}
    return chain, wavelength, meta


def _behind_telescope(chain, instrument, wavelength):
    """Return the chain with star and telescope in the place of the internal source."""
    from astropolcal.chain import join, leaves, stages

    # a calibration of stars has its telescope already
    if "parallactic" in stages(chain):
        return chain
    if not any(leaf.stage == "hwp" for leaf in leaves(chain)):
        raise AstropolcalError("a star needs a chain with an optic on the stage hwp")
    # its first optic is the source
    star = leaves(instrument.chain(source="star", wavelength=wavelength))[0]
    # the telescope as published, behind a star of its own polarization
    return join([star, *leaves(instrument.on_sky(chain))])


def _summary(observations, arguments):
    return {
        "output": arguments.output and str(arguments.output),
        "cubes": arguments.cubes and str(arguments.cubes),
        "source": arguments.source,
        "n_frames": observations.n_frames,
        "n_wavelengths": observations.n_bins,
        "content_hash": observations.content_hash,
        **{name: getattr(arguments, name) for name in ("seed", "flux", "gain", "read_noise")},
    }
