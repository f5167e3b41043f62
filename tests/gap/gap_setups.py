# Licensed under a 3-clause BSD style license - see LICENSE
"""Small simulated runs of several instruments, for the tests of the diagnosis."""

from dataclasses import dataclass

import astropy.units as u
import gap_data
import numpy as np

from astropolcal import instruments, optics
from astropolcal.chain import join, leaves, stages
from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.25, 1.65, 2.2] * u.um
N = WAVELENGTH.size
PLATE = np.arange(0, 180, 22.5) * u.deg
MISALIGNED = {"fixed": {"theta": False}, "bounds": {"theta": (-5, 5)}}


class Cassegrain(Instrument):
    """As GPI: the sky turns in front of the instrument, and there is no derotator."""

    name = "cassegrain-like"
    wavelength = WAVELENGTH
    sky_law = SkyLaw(plate=(0, 0), derotator={})
    sources = ("star",)

    def chain(self, source="star", optics_in=(), *, wavelength=None):
        zero = np.zeros(N)
        near = {"bounds": {"retardance": (140, 220)}}
        plate = optics.LinearRetarder(
            retardance=np.full(N, 175) * u.deg, mount="hwp", name="hwp", **near
        )
        return (
            optics.PolarizedSource(q=zero, u=zero, name="star")
            | optics.Rotator(mount="parallactic", name="sky")
            | optics.VectorDiattenuator(horizontal=zero, diagonal=zero, name="telescope")
            | plate
            | optics.WollastonPrism(
                efficiency=np.full(N, 0.98), name="wollaston", fixed={"efficiency": True}
            )
        )

    def setup(self, observations):
        return "star", ()


class Rotating(Instrument):
    """As NIRC2: a K-mirror on a stage that has another name, behind a lamp with a polarizer."""

    name = "rotator-like"
    wavelength = WAVELENGTH
    keywords = {"rotator": "ROTPDEST"}
    sources = ("polarized",)

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        mirrors = optics.KMirror(film_thickness=0 * u.nm, mount="rotator", name="rotator")
        mirrors.film_thickness.fixed = True
        plate = optics.LinearRetarder(
            retardance=np.full(N, 175) * u.deg, mount="hwp", name="hwp", **MISALIGNED
        )
        plate.retardance.bounds = (140, 220)
        return (
            optics.LinearPolarizer(name="polarizer")
            | plate
            | mirrors
            | optics.WollastonPrism(efficiency=np.full(N, 0.98), name="wollaston")
        )

    def setup(self, observations):
        return "polarized", ()


OWN = {cls.name: cls for cls in (Cassegrain, Rotating)}


@dataclass
class Setup:
    """Nominal and true chain of a run, its wavelengths, frames and header."""

    nominal: object
    truth: object
    wavelength: u.Quantity
    frames: object
    meta: dict

    @property
    def laws(self):
        """How the plate follows the sky."""
        cls = OWN.get(self.meta.get("instrument"))
        known = cls() if cls else instruments.get(self.meta.get("instrument", "charis"))
        if known.sky_law is None:
            return ()
        mode = self.meta.get("tracking", next(iter(known.sky_law.modes), None))
        return (known.sky_law.plate_law(mode),)

    def context(self, flux=3e7):
        return Context(self.wavelength.to_value(u.um), flux, tracking=self.laws)

    def observed(self, truth=None, *, seed=1, flux=3e7, **options):
        """Simulate; the stage of the plate is where ``hwp_true`` says, if it is there."""
        truth, table = self.truth if truth is None else truth, self.frames.copy()
        follows = "hwp_true" in table.colnames
        if follows:
            table["commanded"], table["hwp"] = table["hwp"], table["hwp_true"]
        options = {"meta": self.meta, "name": "night"} | options
        # what a cell may follow is known once there are frames
        extra = [stage for stage in stages(truth) if stage not in table.colnames]
        if extra:
            clean = self.observed(self.nominal, noise=False, lamp=options.get("lamp"))
            for stage in extra:
                table[stage] = clean.position(stage)
        data = simulate(truth, self.wavelength, table, flux=flux, seed=seed, **options)
        found = data.to_table()
        if follows:
            found["hwp"] = found["commanded"]
            found.remove_columns(["commanded", "hwp_true"])
        found.remove_columns([stage for stage in extra if stage != "frame"])
        return type(data).from_table(found, name=data.name)

    def with_detector(self, kind, size, course=1.0, **options):
        """Simulate a detector that has an error of a kind, perhaps with a course through the run.

        That is a function of the table of the frames.
        """
        data = self.observed(**options)
        right, left = data.flux_right, data.flux_left
        usual = np.median([right, left])
        size = size * (course(data.frames)[:, None] if callable(course) else course)
        if kind == "nonlinearity":
            changed = [flux * (1 + size * flux / usual) for flux in (right, left)]
        elif kind == "nonlinearity_of_right_beam":
            changed = [right * (1 + size * right / usual), left]
        elif kind == "persistence":
            changed = [flux + size * np.roll(flux, 1, axis=0) for flux in (right, left)]
        elif kind == "crosstalk":
            changed = [right + size * (left - right), left + size * (right - left)]
        else:
            both = kind == "background"
            changed = [right + size * usual, left + both * size * usual]
        table = data.to_table()
        for beam, flux in zip(("right", "left"), changed, strict=True):
            table[f"flux_{beam}"] = flux.ravel() * table[f"flux_{beam}"].unit
        return type(data).from_table(table, name=data.name)

    def with_cell(self, cell, *sizes, flux=3e7):
        """Return the true chain with a cell of a size, and another for its second function."""
        edit = CellEffect(cell, None).edit([self.truth], self.context(flux))
        for parameter, size in zip(edit.parameters, sizes, strict=False):
            optic, key = parameter.name.split(".")
            target = getattr(edit.chains[0][optic], key)
            target.value = np.full(np.shape(target.value), size)
        for target, tie in edit.ties.items():
            (optic, key), (other, source) = target.split("."), tie.source.split(".")
            value = getattr(edit.chains[0][other], source).value
            getattr(edit.chains[0][optic], key).value = tie.factor * value
        return edit.chains[0]

    def with_effect(self, name, **sizes):
        """Return the true chain with an effect of given sizes, the same at all wavelengths."""
        edit = get_effect(name).edit([self.truth], self.context())
        values = {one.name: sizes[one.name.split(".")[1]] for one in edit.parameters}
        values |= {
            target: tie.factor * values[tie.source]
            for target, tie in edit.ties.items()
            if tie.source in values
        }
        (chain,) = edit.chains
        for full, value in values.items():
            optic, key = full.split(".")
            parameter, size = getattr(chain[optic], key), u.Quantity(value)
            setattr(chain[optic], key, np.broadcast_to(size.value, parameter.shape) * size.unit)
        return chain


# ---- frames ------------------------------------------------------------------------------------


def frames_of_lamp(angles, stage="derotator"):
    frames = half_wave_plate_cycles(PLATE, angles * u.deg)
    frames[stage] = frames["derotator"]
    return frames


def frames_of_star(n_cycles, law=(0, 0), turn=(0, 0), parallactic=(-30, 30)):
    """A star that rises: plate and derotator as they follow it."""
    # one after the other, as the derotator moves on in the meantime
    pairs = [0, 45, 22.5, 67.5, 90, 135, 112.5, 157.5] * u.deg
    frames = half_wave_plate_cycles(pairs, np.zeros(n_cycles) * u.deg)
    frames["parallactic"] = np.linspace(*parallactic, len(frames)) * u.deg
    frames["altitude"] = np.linspace(55, 70, len(frames)) * u.deg
    sky = frames["parallactic"], frames["altitude"]
    frames["derotator"] = turn[0] * sky[0] + turn[1] * sky[1]
    frames["hwp_true"] = frames["hwp"] + law[0] * sky[0] + law[1] * sky[1]
    return frames


# ---- the runs ----------------------------------------------------------------------------------


def charis():
    chain = gap_data.chain()
    return Setup(chain, chain.copy(), gap_data.WAVELENGTH, gap_data.frames(), {})


def cassegrain():
    truth = Cassegrain().chain()
    truth["star"].q, truth["star"].u = [0.02, 0.015, 0.012], [-0.01, -0.01, -0.008]
    truth["telescope"].horizontal, truth["telescope"].diagonal = [-0.003] * N, [0.004] * N
    truth["hwp"].retardance = [172, 176, 178] * u.deg
    meta = {"instrument": "cassegrain-like", "source": "star"}
    frames = frames_of_star(6, parallactic=(-60, 70))
    return Setup(Cassegrain().chain(), truth, WAVELENGTH, frames, meta)


def rotating():
    truth = Rotating().chain()
    truth["polarizer"].theta, truth["hwp"].theta = 0 * u.deg, 0.4 * u.deg
    truth["wollaston"].efficiency = [0.97, 0.98, 0.99]
    meta = {"instrument": "rotator-like", "source": "polarized"}
    frames = frames_of_lamp(np.arange(0, 90, 15), "rotator")
    return Setup(Rotating().chain(), truth, WAVELENGTH, frames, meta)


def irdis_lamp():
    irdis = instruments.get("irdis")
    wavelength = irdis.wavelength[1:]
    chain = irdis.chain("polarized", wavelength=wavelength)
    truth = chain.copy()
    truth["derotator"].retardance = [155, 101, 85] * u.deg
    frames = frames_of_lamp(np.arange(0, 90, 15))
    return Setup(chain, truth, wavelength, frames, irdis.published_meta())


def irdis_star(mode="field"):
    irdis = instruments.get("irdis")
    wavelength = irdis.wavelength[1:]
    train = [leaf.copy() for leaf in leaves(irdis.chain("star", wavelength=wavelength))]
    for leaf in train[1:]:
        # as an internal calibration has them
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    truth = join([leaf.copy() for leaf in train])
    truth["star"].q, truth["star"].u = [0.02, 0.015, 0.012], [-0.01, -0.01, -0.008]
    law = irdis.sky_law
    frames = frames_of_star(8, law.plate_law(mode), law.derotator_law(mode))
    meta = {"instrument": "SPHERE/IRDIS", "source": "star", "date": "2018-05-01", "tracking": mode}
    return Setup(join(train), truth, wavelength, frames, meta)


def vampires():
    vampires, wavelength = instruments.get("vampires"), [625, 675, 750] * u.nm
    chain = vampires.chain("polarized", ("flc",), wavelength=wavelength, derotator="linear")
    frames = frames_of_lamp(np.arange(45, 135, 15))
    twice = frames[np.repeat(np.arange(len(frames)), 2)]
    twice["flc_state"] = np.tile([0, 1], len(frames))
    meta = {"instrument": "SCExAO/VAMPIRES", "source": "polarized", "flc": "in"}
    return Setup(chain, chain.copy(), wavelength, twice, meta)


SETUPS = {
    "charis": charis,
    "cassegrain": cassegrain,
    "rotating": rotating,
    "irdis lamp": irdis_lamp,
    "irdis star": irdis_star,
    "vampires": vampires,
}
