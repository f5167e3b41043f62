# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Simulate an observation table or image cubes, with photon and read noise.

The chain has the published values, or those of a calibration file.

For example::

  astropolcal simulate -o run.ecsv                      the packaged example
  astropolcal simulate -o run.ecsv --derotator 45,70,95 --fix hwp.w_sio2=1.66mm
  astropolcal simulate -o true.ecsv --cubes lamp        image cubes, raw headers
  astropolcal simulate --cubes star --source star --altitude 67,64 \
      --parallactic 24,30 --derotator 97 --fix star.q=0.01
"""

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import AstropolcalError
from astropolcal.files import one_line
from astropolcal.scripts import _common as common
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.words import counted

#: What the packaged example was made with.
EXAMPLE = {"flux": 4e6, "gain": 1.0, "read_noise": 100.0, "seed": 20251005}

# what of the options of --cubes tells of the image, and what of the detector
_IMAGE = ("psf", "fwhm", "halo", "motion", "seeing")
_DETECTOR = ("background", "bad_pixels", "flat_error", "saturate")
_DEROTATOR = [45 + 12.5 * i for i in range(8)]
OPTIONS = f"""
-o --output OBS.ecsv Output  the table (required without --cubes; with it, the true fluxes);
    overwritten if it exists
--instrument NAME  default: that of --calibration, or charis
--calibration CAL.asdf Input  take the chain from this file
--hwp DEG,DEG,... angles  half-wave-plate angles (default: 0 to 78.75 by 11.25; of a star 0, 45,
    22.5 and 67.5)
--derotator DEG,DEG,... angles  derotator angles (default: 45 to 132.5 by 12.5)
--source {{internal,star}} =internal  the internal source, or a star (default: %(default)s)
--altitude DEG[,DEG] angles  altitude angle of a star in all frames, or in the first and last
--parallactic DEG[,DEG] angles  parallactic angle of a star in all frames, or in the first and last
--flux ADU float  flux that enters, per wavelength (default: {EXAMPLE["flux"]:g}; cubes: less where
    the brightest pixel would be above half of the saturation)
--gain E/ADU float ={EXAMPLE["gain"]}  electrons per adu (default: %(default)g; cubes: the
    instrument's)
--read-noise E float ={EXAMPLE["read_noise"]}  electrons per beam and frame (default: %(default)g;
    cubes: the instrument's)
--no-noise  leave the noise out
--seed SEED int ={EXAMPLE["seed"]}  default: %(default)s
--fix NAME=VALUE ...  set a parameter of the true chain
--without OPTIC ...  take an optic out of the true chain
@ json quiet
[image cubes]
--cubes DIR Folder  write image cubes to this folder, raw headers to DIR/raw
--psf {{moffat,gaussian}} =moffat needs:cubes  profile of a star's core (default: %(default)s)
--fwhm PIX float =5 needs:cubes  full width of a star's core at half maximum (default: %(default)g)
--halo SHARE float =0 needs:cubes  share of a star's light in its halo (default: %(default)g)
--motion PIX float =0 needs:cubes  standard deviation of a star's place from frame to frame
    (default: %(default)g)
--seeing PART float =0 needs:cubes  relative standard deviation of its width (default: %(default)g)
--background ADU float =0 needs:cubes  of each pixel (default: %(default)g)
--bad-pixels SHARE float =0 needs:cubes  share of the pixels without a value (default: %(default)g)
--flat-error PART float =0 needs:cubes  relative standard deviation of the pixels' response
    (default: %(default)g)
--saturate needs:cubes  cut pixels off at the instrument's saturation
"""


def run(arguments):
    """Simulate and write the table, the cubes or both."""
    from astropolcal.reduction import DetectorModel, ImageModel, simulate_cubes
    from astropolcal.reduction.cubes import _usual_flux, true_observations

    if not (arguments.output or arguments.cubes):
        raise AstropolcalError("nothing to write: give -o OBS.ecsv, --cubes DIR or both")
    common.check_suffix("-o", arguments.output, ".ecsv")
    instrument, chain, wavelength, meta = _truth(arguments)
    # free and prior mean nothing for what is true
    (chain,) = common.edit_chains([chain], without=arguments.without, fix=arguments.fix)
    frames = _frames(arguments, chain)
    image = ImageModel(**{name: getattr(arguments, name) for name in _IMAGE})
    scene = {"wavelength": wavelength, "source": arguments.source}
    if arguments.flux is None:
        arguments.flux = EXAMPLE["flux"]
        if arguments.cubes:
            look = {"image": image, "background": arguments.background}
            arguments.flux = _usual_flux(chain, instrument, frames, arguments.flux, **scene, **look)
    given = {name: getattr(arguments, name) for name in ("seed", "flux", "gain", "read_noise")}
    options = given | {
        # beside cubes the table is the truth that a reduction must find again
        "noise": not (arguments.no_noise or arguments.cubes),
        # of the set-up, less the optics taken out
        "meta": meta | instrument.meta_without(arguments.without) | {"simulated": True},
        "name": "simulated",
    }
    if arguments.source == "internal":
        observations = simulate(chain, wavelength, frames, **options)
    else:
        observations = true_observations(chain, instrument, frames, **scene, **options)
    written = []
    if arguments.cubes:
        response = {name: getattr(arguments, name) for name in _DETECTOR}
        detector = DetectorModel(noise=not arguments.no_noise, **response)
        cubes = {"image": image, "detector": detector} | {k: given[k] for k in ("flux", "seed")}
        paths = simulate_cubes(arguments.cubes, chain, instrument, frames, **cubes, **scene)
        written.append(f"{one_line(arguments.cubes, None)} ({counted(len(paths), 'cube')})")
    if arguments.output:
        observations.write(arguments.output, overwrite=True)
        size = counted(observations.n_frames, "frame"), counted(observations.n_bins, "wavelength")
        written.append(f"{one_line(arguments.output, None)} ({' x '.join(size)})")
    content = {
        "output": arguments.output and str(arguments.output),
        "cubes": arguments.cubes and str(arguments.cubes),
        "source": arguments.source,
        "n_frames": observations.n_frames,
        "n_wavelengths": observations.n_bins,
        "content_hash": observations.content_hash,
    }
    common.give(arguments, [f"Written: {', '.join(written)}"], content | given)


def _frames(arguments, chain):
    """Return half-wave-plate cycles in all states, for a star with the pointing of each frame."""
    from astropolcal.reduction.cubes import both_states

    star = arguments.source == "star"
    # double differences of Q, then of U: the order in which stars are observed
    hwp = arguments.hwp or ([0, 45, 22.5, 67.5] if star else None)
    given = {"derotator": arguments.derotator or _DEROTATOR} | ({"hwp": hwp} if hwp else {})
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


def _truth(arguments):
    """Return the instrument, its true chain, wavelengths and the meta that describe the set-up."""
    if arguments.calibration:
        from astropolcal.calibration import Calibration

        calibration = Calibration.read(arguments.calibration)
        told = arguments.calibration, arguments.instrument
        instrument = common.calibrated_instrument(calibration, *told)
        # a copy: it is edited
        chain, wavelength = calibration.chain.copy(), calibration.wavelength
        meta = dict(calibration.datasets[0].meta)
    else:
        instrument = instruments.get(arguments.instrument or "charis")
        chain, wavelength = instrument.published(), instrument.wavelength
        meta = instrument.published_meta()
    # a calibration of stars has its telescope already
    on_sky = "parallactic" in stages(chain)
    if arguments.source != "star":
        if on_sky:
            words = "the chain begins on sky; give --source star and where it points"
            raise AstropolcalError(words)
        return instrument, chain, wavelength, meta
    if not on_sky:
        if not any(leaf.stage == "hwp" for leaf in leaves(chain)):
            raise AstropolcalError("a star needs a chain with an optic on the stage hwp")
        # its first optic is the source, behind which the telescope is as published
        star = leaves(instrument.chain(source="star", wavelength=wavelength))[0]
        told = {"wavelength": wavelength, "date": meta.get("date")}
        chain = join([star, *leaves(instrument._from_sky(chain, **told))])
    return instrument, chain, wavelength, meta | {"source": "star"}
