# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal simulate``: beam fluxes of an instrument, with noise."""

from astropolcal.scripts._common import check_outputs, edit_chains, write_json

#: What the packaged example was made with.
EXAMPLE = {"flux": 4e6, "gain": 1.0, "read_noise": 100.0, "seed": 20251005}


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "simulate",
        help="simulate an observation table, with photon and read noise",
        description="Simulate the beam fluxes of an instrument's chain: the published values, "
        "or those of a calibration file.",
    )
    parser.add_argument("-o", "--output", metavar="OBS.ecsv", required=True, help="the table")
    parser.add_argument("--instrument", metavar="NAME", default="charis", help="default: charis")
    parser.add_argument("--calibration", metavar="CAL.asdf", help="take the chain from this file")
    parser.add_argument(
        "--hwp",
        metavar="DEG,DEG,...",
        type=_angles,
        default=None,
        help="half-wave-plate angles (default: 0 to 78.75 by 11.25)",
    )
    parser.add_argument(
        "--derotator",
        metavar="DEG,DEG,...",
        type=_angles,
        default=None,
        help="derotator angles (default: 45 to 132.5 by 12.5)",
    )
    parser.add_argument(
        "--flux",
        type=float,
        default=EXAMPLE["flux"],
        metavar="ADU",
        help="flux that enters, per wavelength (default: %(default)g)",
    )
    parser.add_argument(
        "--gain",
        type=float,
        default=EXAMPLE["gain"],
        metavar="E/ADU",
        help="electrons per adu (default: %(default)g)",
    )
    parser.add_argument(
        "--read-noise",
        type=float,
        default=EXAMPLE["read_noise"],
        metavar="E",
        help="electrons per beam and frame (default: %(default)g)",
    )
    parser.add_argument("--no-noise", action="store_true", help="leave the noise out")
    parser.add_argument("--seed", type=int, default=EXAMPLE["seed"], help="default: %(default)s")
    parser.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a parameter of the true chain",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="OPTIC",
        help="take an optic out of the true chain",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write a summary for machines (- for stdout)"
    )
    parser.set_defaults(run=run)


def _angles(text):
    """Return the angles of a comma-separated list, in degree."""
    import argparse

    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of angles in degree") from None


def run(arguments):
    """Simulate and write the table."""
    import astropy.units as u

    from astropolcal.simulation import half_wave_plate_cycles, simulate

    check_outputs(arguments.output, arguments.json)
    chain, wavelength, meta = _truth(arguments)
    (chain,) = edit_chains([chain], without=arguments.without, fix=arguments.fix)
    given = {"hwp": arguments.hwp, "derotator": arguments.derotator or _derotator_angles()}
    frames = half_wave_plate_cycles(**{k: v * u.deg for k, v in given.items() if v is not None})
    observations = simulate(
        chain,
        wavelength,
        frames,
        flux=arguments.flux,
        gain=arguments.gain,
        read_noise=arguments.read_noise,
        noise=not arguments.no_noise,
        seed=arguments.seed,
        meta=_meta(meta, arguments.without),
        name="simulated",
    )
    observations.write(arguments.output, overwrite=True)
    if arguments.json:
        write_json(_summary(observations, arguments), arguments.json)
    if arguments.json != "-":
        print(
            f"Written: {arguments.output} ({observations.n_frames} frames x "
            f"{observations.n_bins} wavelengths)"
        )


def _derotator_angles():
    return [45 + 12.5 * i for i in range(8)]


def _truth(arguments):
    """Return the true chain, its wavelengths and the meta that describe its set-up."""
    from astropolcal import instruments

    if arguments.calibration:
        from astropolcal.calibration import Calibration

        calibration = Calibration.read(arguments.calibration)
        return calibration.chain.copy(), calibration.wavelength, dict(calibration.datasets[0].meta)
    instrument = instruments.get(arguments.instrument)
    return instrument.published(), instrument.wavelength, instrument.published_meta()


def _meta(meta, without):
    """Return the meta of the table: the set-up, less the optics taken out."""
    absent = {
        "nbs": {"nasmyth_beam_switcher": "not installed"},
        "dichroic": {"yjh50_dichroic": "out"},
    }
    for optic in without:
        meta = meta | absent.get(optic, {})
    return meta | {"simulated": True}


def _summary(observations, arguments):
    return {
        "output": str(arguments.output),
        "n_frames": observations.n_frames,
        "n_wavelengths": observations.n_bins,
        "content_hash": observations.content_hash,
        "seed": arguments.seed,
        "flux": arguments.flux,
        "gain": arguments.gain,
        "read_noise": arguments.read_noise,
    }
