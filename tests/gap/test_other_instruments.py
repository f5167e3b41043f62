# Licensed under a 3-clause BSD style license - see LICENSE
"""The library adapts itself to the chains of instruments of other kinds."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from gap_setups import SETUPS, Cassegrain, Rotating, irdis_star

from astropolcal import optics
from astropolcal.chain import insert_optic, join, leaves
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import (
    EFFECTS,
    Context,
    Roles,
    adapted,
    check_effect,
    get_effect,
)
from astropolcal.gap.effects.effect import tracking_laws
from astropolcal.measurement.parameters import with_own
from astropolcal.simulation import simulate

pytestmark = pytest.mark.usefixtures("own_instruments")


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


def test_an_optic_is_the_same_in_all_datasets_whatever_is_upstream_of_it():
    """A calibration unit of polarizer and retarder, and the light of a lamp without it."""
    free = {"fixed": {"theta": False}, "bounds": {"theta": (-5, 5)}}
    polarizer = optics.LinearPolarizer(mount="first", name="polarizer", **free)
    retarder = optics.LinearRetarder(retardance=80 * u.deg, mount="unit", name="retarder", **free)
    inner = [
        optics.DiattenuatorRetarder(diattenuation=0.03, retardance=170 * u.deg, name="mirror"),
        optics.LinearRetarder(retardance=125 * u.deg, mount="turning", name="modulator", **free),
        optics.WollastonPrism(efficiency=0.98, name="prism"),
    ]
    chains = [join([*unit, *inner]) for unit in ([polarizer], [polarizer, retarder], [])]
    at = [("first", [0, 45, 90, 135]), ("unit", [0, 30, 60, 90, 120, 150]), ("first", [0])]
    data = []
    for chain, (stage, angles) in zip(chains, at, strict=True):
        frames = QTable({"first": np.zeros(8 * len(angles)) * u.deg})
        frames[stage] = np.repeat(angles, 8) * u.deg
        frames["turning"] = np.tile(np.arange(8) * 22.5, len(angles)) * u.deg
        data.append(simulate(chain, [0.5, 0.6, 0.7] * u.um, frames, name=f"run {len(data)}"))
    found = {one.name: one for one in adapted(EFFECTS.values(), chains)}
    for effect in found.values():
        check_effect(effect.name, chains, data)
    for name, place, there in [
        ("hwp_diattenuation:modulator", "modulator", 3),
        ("hwp_diattenuation:retarder", "retarder", 1),
        ("static_diattenuator", "prism", 3),
    ]:
        edited = found[name].edit(chains, Context(np.ones(3))).chains
        trains = [[leaf.name for leaf in leaves(chain)] for chain in edited]
        upstream = [train[train.index(place) - 1] for train in trains if place in train]
        assert upstream == [f"gap_{name}".replace(":", "_")] * there
        assert "half-wave" not in found[name].title
    assert found["static_diattenuator"].title.endswith("modulator")


def test_plates_with_values_of_their_own_share_no_effect_with_one_in_front_of_them():
    free = {"fixed": {"theta": False}}
    modulator, unit = (
        optics.LinearRetarder(retardance=90 * u.deg, mount=name, name=name, **free)
        for name in ("modulator", "unit")
    )
    alone, both = (
        [*front, optics.WollastonPrism(name="prism")] for front in ([modulator], [unit, modulator])
    )
    for runs, expected in [
        ((alone, alone), [""]),
        ((both, both), ["", ":modulator", ":modulator_b"]),
        ((alone, both), [":modulator", ":unit", ":modulator_b"]),
    ]:
        chains = with_own([join(run) for run in runs], "ab", ["modulator.theta"])[0]
        found = adapted([get_effect("hwp_diattenuation")], chains)
        assert [one.name for one in found] == [f"hwp_diattenuation{end}" for end in expected]


def test_law_of_the_plate_is_that_of_each_datasets_instrument():
    star, field = (SETUPS[name]().observed() for name in ("cassegrain", "irdis star"))
    assert tracking_laws([star, field]) == ((0.0, 0.0), (-1.0, 1.0))
    unknown = star.to_table()
    unknown.meta["instrument"] = "nowhere"
    assert tracking_laws([type(star).from_table(unknown)]) == ((0.5, 1.0),)


def test_plate_of_another_law_is_that_of_other_angles():
    for law in [(-1.0, 1.0), (-0.5, 1.0), (0.3, -0.2)]:
        for factors in [
            ("hwp_tracking_parallactic_sign", (-1, 1)),
            ("hwp_tracking_altitude_sign", (1, -1)),
            ("hwp_not_tracking", (0, 0)),
        ]:
            name, signs = factors
            setup = irdis_star()
            truth, frames, grid = setup.truth, setup.frames, setup.wavelength
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
    nominal, data = SETUPS[name]().nominal, SETUPS[name]().observed()
    for effect in adapted(EFFECTS.values(), [nominal]):
        check_effect(effect.name, [nominal], [data])
