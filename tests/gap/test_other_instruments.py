# Licensed under a 3-clause BSD style license - see LICENSE
"""Diagnosis of instruments of other kinds: the library adapts itself to their chains."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic, join, leaves
from astropolcal.exceptions import GapError
from astropolcal.gap import diagnose
from astropolcal.gap.effects import (
    EFFECTS,
    Context,
    Roles,
    adapted,
    check_effect,
    get_effect,
    tracking_laws,
)
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.25, 1.65, 2.2] * u.um
N = WAVELENGTH.size
PLATE = np.arange(0, 180, 22.5) * u.deg
MISALIGNED = {"fixed": {"theta": False}, "bounds": {"theta": (-5, 5)}}


def _star():
    return optics.PolarizedSource(q=np.zeros(N), u=np.zeros(N), name="star")


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
            _star()
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


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    """Both instruments are known by name, for the time of a test."""
    known = {cls.name: cls for cls in (Cassegrain, Rotating)}
    monkeypatch.setattr(instruments, "_REGISTRY", instruments._REGISTRY | known)


def planted(name, chains, wavelength, sizes, laws=()):
    """Return the chains with an effect of given sizes, the same at all wavelengths."""
    context = Context(wavelength.to_value(u.um), tracking=laws)
    edit = get_effect(name).edit(chains, context)
    values = {parameter.name: sizes[parameter.name.split(".")[1]] for parameter in edit.parameters}
    factors = {target: (tie.source, tie.factor) for target, tie in edit.ties.items()}
    values |= {t: f * values[s] for t, (s, f) in factors.items() if s in values}
    for chain in edit.chains:
        for full, value in values.items():
            optic, key = full.split(".")
            if optic in chain.submodel_names:
                parameter = getattr(chain[optic], key)
                size, unit = (u.Quantity(value).value, u.Quantity(value).unit)
                setattr(chain[optic], key, np.broadcast_to(size, parameter.shape) * unit)
    return edit.chains


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


def observed(chain, wavelength, frames, meta, seed=1):
    """Simulate; the stage of the plate is where ``hwp_true`` says, if it is there."""
    table = frames.copy()
    if "hwp_true" in table.colnames:
        table["commanded"], table["hwp"] = table["hwp"], table["hwp_true"]
    data = simulate(chain, wavelength, table, flux=3e7, seed=seed, meta=meta, name="night")
    if "hwp_true" not in frames.colnames:
        return data
    found = data.to_table()
    found["hwp"] = found["commanded"]
    found.remove_columns(["commanded", "hwp_true"])
    return type(data).from_table(found, name="night")


def names(found):
    return [name for cause in found.causes for name in (cause.name, *cause.aliases)]


# ---- what is diagnosed ---------------------------------------------------------------------


def cassegrain():
    """Return nominal and true chain, frames and meta."""
    truth = Cassegrain().chain()
    truth["star"].q, truth["star"].u = [0.02, 0.015, 0.012], [-0.01, -0.01, -0.008]
    truth["telescope"].horizontal, truth["telescope"].diagonal = [-0.003] * N, [0.004] * N
    truth["hwp"].retardance = [172, 176, 178] * u.deg
    meta = {"instrument": "cassegrain-like", "source": "star"}
    return Cassegrain().chain(), truth, frames_of_star(6, parallactic=(-60, 70)), meta


def rotating():
    truth = Rotating().chain()
    truth["polarizer"].theta, truth["hwp"].theta = 0 * u.deg, 0.4 * u.deg
    truth["wollaston"].efficiency = [0.97, 0.98, 0.99]
    meta = {"instrument": "rotator-like", "source": "polarized"}
    return Rotating().chain(), truth, frames_of_lamp(np.arange(0, 90, 15), "rotator"), meta


def irdis_lamp():
    irdis = instruments.get("irdis")
    chain = irdis.chain("polarized", wavelength=irdis.wavelength[1:])
    truth = chain.copy()
    truth["derotator"].retardance = [155, 101, 85] * u.deg
    return chain, truth, frames_of_lamp(np.arange(0, 90, 15)), irdis.published_meta()


def irdis_star(mode="field"):
    irdis = instruments.get("irdis")
    chain = irdis.chain("star", wavelength=irdis.wavelength[1:])
    train = [leaf.copy() for leaf in leaves(chain)]
    for leaf in train[1:]:
        # as an internal calibration has them
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    truth = join([leaf.copy() for leaf in train])
    truth["star"].q, truth["star"].u = [0.02, 0.015, 0.012], [-0.01, -0.01, -0.008]
    law = irdis.sky_law
    frames = frames_of_star(8, law.plate_law(mode), law.derotator_law(mode))
    meta = {"instrument": "SPHERE/IRDIS", "source": "star", "date": "2018-05-01", "tracking": mode}
    return join(train), truth, frames, meta


def vampires():
    vampires = instruments.get("vampires")
    wavelength = [625, 675, 750] * u.nm
    chain = vampires.chain("polarized", ("flc",), wavelength=wavelength, derotator="linear")
    frames = frames_of_lamp(np.arange(45, 135, 15))
    twice = frames[np.repeat(np.arange(len(frames)), 2)]
    twice["flc_state"] = np.tile([0, 1], len(frames))
    meta = {"instrument": "SCExAO/VAMPIRES", "source": "polarized", "flc": "in"}
    return chain, chain.copy(), twice, meta


SETUPS = {
    "cassegrain": cassegrain,
    "rotating": rotating,
    "irdis lamp": irdis_lamp,
    "irdis star": irdis_star,
    "vampires": vampires,
}


def grid_of(name):
    grids = {"irdis": instruments.get("irdis").wavelength[1:], "vampires": [625, 675, 750] * u.nm}
    return grids.get(name.split()[0], WAVELENGTH)


def make(name, effect=None, **sizes):
    """Return the nominal chain, and data that have an effect in them."""
    nominal, truth, frames, meta = SETUPS[name]()
    law = instruments.get(meta["instrument"]).sky_law
    laws = (law.plate_law(meta.get("tracking", next(iter(law.modes), None))),)
    if effect is not None:
        (truth,) = planted(effect, [truth], grid_of(name), sizes, laws)
    return nominal, observed(truth, grid_of(name), frames, meta)


@pytest.mark.parametrize("name", SETUPS)
def test_nothing_is_found_where_nothing_is_missing(name):
    nominal, data = make(name)
    found = diagnose(nominal, data)
    assert (found.verdict, found.causes) == ("none", [])


CASES = [
    ("cassegrain", "beam_gain", {"imbalance": 0.01}),
    ("cassegrain", "hwp_diattenuation", {"diattenuation": 0.01}),
    ("cassegrain", "parallactic_sign", {}),
    ("rotating", "derotator_diattenuation", {"diattenuation": 0.01}),
    ("rotating", "derotator_elliptical_retardance", {"diagonal": 4 * u.deg, "circular": 2 * u.deg}),
    ("rotating", "derotator_sign", {}),
    ("irdis lamp", "hwp_tilt", {"cosine": 1 * u.deg, "sine": 0.5 * u.deg}),
    ("irdis lamp", "derotator_encoder", {"cosine": 0.2 * u.deg, "sine": 0.1 * u.deg}),
    ("irdis star", "m3_diattenuation:m4", {"diattenuation": 0.01}),
    ("irdis star", "hwp_tracking_parallactic_sign", {}),
    ("vampires", "hwp_tilt", {"cosine": 1 * u.deg, "sine": 0.5 * u.deg}),
    ("vampires", "derotator_elliptical_retardance", {"diagonal": 4 * u.deg, "circular": 2 * u.deg}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "effect", "sizes"), CASES)
def test_effect_is_found(name, effect, sizes):
    nominal, data = make(name, effect, **sizes)
    found = diagnose(nominal, data, cross_validate=False)
    assert found.verdict == "effect"
    assert effect in (found.causes[0].name, *found.causes[0].aliases)
    assert found.gap_after_percent < 1.3 * found.noise_floor_percent


# ---- how the library adapts itself ---------------------------------------------------------


def offered(chain, effects=None):
    """Return the effects of a chain by name."""
    return {one.name: one for one in adapted(effects or EFFECTS.values(), [chain])}


def test_no_effect_of_a_derotator_or_an_axis_that_is_absent():
    found = offered(Cassegrain().chain())
    assert not [name for name in found if name.startswith(("derotator", "altitude", "m3"))]
    assert not [one for one in found.values() if "derotator" in one.title + one.place]
    assert {"parallactic_sign", "sky_background", "static_retarder", "hwp_tilt"} <= set(found)
    assert "source_linear" not in found
    # where nothing in front of the plate may polarize, something may
    train = [leaf for leaf in leaves(Cassegrain().chain()) if leaf.name != "telescope"]
    assert "source_linear" in offered(join(train))


def test_derotator_is_known_by_what_it_does():
    chain = Rotating().chain()
    assert Roles(chain).derotator.name == "rotator"
    found = offered(chain)
    assert {"derotator_sign", "derotator_encoder", "derotator_45_retardance"} <= set(found)
    (edited,) = found["derotator_diattenuation"].edit([chain], Context(np.ones(3))).chains
    assert edited["gap_derotator_diattenuation"].mount == "rotator"


def test_one_effect_for_each_optic_of_a_kind():
    second = optics.LinearRetarder(
        retardance=90 * u.deg, mount="quarter", name="quarter", theta=3 * u.deg
    )
    chain = insert_optic(Rotating().chain(), second, before="hwp")
    found = offered(chain, [get_effect(name) for name in ("hwp_tilt", "hwp_sign", "beam_gain")])
    assert list(found) == ["hwp_tilt", "hwp_tilt:quarter", "hwp_sign", "hwp_sign:quarter",
                           "beam_gain"]  # fmt: skip
    (edited,) = found["hwp_tilt:quarter"].edit([chain], Context(np.ones(3))).chains
    names_of = [leaf.name for leaf in leaves(edited)]
    assert names_of[1:3] == ["gap_hwp_tilt_quarter", "quarter"]
    (turned,) = found["hwp_sign:quarter"].edit([chain], None).chains
    assert (turned["quarter"].mount, turned["hwp"].mount) == ("-quarter", "hwp")
    assert get_effect("hwp_tilt:quarter").optic == "quarter"
    assert "(quarter)" in get_effect("hwp_tilt:quarter").title


def test_an_optic_that_is_absent_has_no_effect_of_its_own():
    assert not get_effect("hwp_tilt:other").applies([Rotating().chain()])
    with pytest.raises(GapError, match="no effect 'beam_gain:other'"):
        get_effect("beam_gain:other")


def test_law_of_the_plate_is_that_of_each_datasets_instrument():
    _, star = make("cassegrain")
    _, field = make("irdis star")
    assert tracking_laws([star, field]) == ((0.0, 0.0), (-1.0, 1.0))
    unknown = star.to_table()
    unknown.meta["instrument"] = "nowhere"
    assert tracking_laws([type(star).from_table(unknown)]) == ((0.5, 1.0),)


@pytest.mark.parametrize("factors", [("hwp_tracking_parallactic_sign", (-1, 1)),
                                     ("hwp_tracking_altitude_sign", (1, -1)),
                                     ("hwp_not_tracking", (0, 0))])  # fmt: skip
@pytest.mark.parametrize("law", [(-1.0, 1.0), (-0.5, 1.0), (0.3, -0.2)])
def test_plate_of_another_law_is_that_of_other_angles(factors, law):
    name, signs = factors
    _, truth, frames, _meta = irdis_star()
    grid = grid_of("irdis")
    context = Context(grid.to_value(u.um), tracking=(law,))
    (edited,) = get_effect(name).edit([truth], context).chains
    sky = frames["parallactic"], frames["altitude"]
    table = frames.copy()
    table["hwp"] = frames["hwp"] + law[0] * sky[0] + law[1] * sky[1]
    other = frames.copy()
    other["hwp"] = frames["hwp"] + signs[0] * law[0] * sky[0] + signs[1] * law[1] * sky[1]
    for one in (table, other):
        one.remove_column("hwp_true")
    settings = {"noise": False, "flux": 1e6}
    found = simulate(edited, grid, table, **settings)
    expected = simulate(truth, grid, other, **settings)
    np.testing.assert_allclose(found.flux_right, expected.flux_right, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETUPS)
def test_every_effect_with_a_place_keeps_what_a_diagnosis_relies_on(name):
    nominal, data = make(name)
    for effect in adapted(EFFECTS.values(), [nominal]):
        check_effect(effect.name, [nominal], [data])
