# Licensed under a 3-clause BSD style license - see LICENSE
"""What effects are made of: contexts, parameters, edits, roles, held values, bounds, pairs."""

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.chain import leaves, system_mueller, with_beam
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import (
    EFFECTS,
    Context,
    Edit,
    EffectParameter,
    Roles,
    adapted,
    get_effect,
)
from astropolcal.gap.effects._laws import (
    around,
    held_star,
    lagging,
    retardance_slopes,
    without_constant,
)
from astropolcal.gap.effects.effect import label_of, tracking_laws
from astropolcal.gap.effects.where import Where
from astropolcal.observations import Observations, example_table

GRID = np.array([1.2, 1.4, 1.7, 2.0, 2.2])


# ---- context -------------------------------------------------------------------------------


def test_degree_of_the_context_stands_above_that_of_the_effect():
    assert Context(GRID).basis(2).shape == (5, 3)
    assert Context(GRID, degree=1).basis(2).shape == (5, 2)
    np.testing.assert_array_equal(Context(GRID, degree=None).basis(2), np.eye(5))


def test_a_basis_without_a_constant_cannot_make_one():
    for degree, columns in [(1, 1), (2, 2), (None, 4)]:
        basis = without_constant(Context(GRID, degree=degree))
        assert basis.shape == (5, columns)
        with_it = np.column_stack([basis, np.ones(5)])
        assert np.linalg.matrix_rank(with_it) == columns + 1
        # together they hold what the whole basis does
        whole = Context(GRID, degree=degree).basis(2)
        both = np.column_stack([with_it, whole])
        assert np.linalg.matrix_rank(both, tol=1e-9) == columns + 1


def test_values_less_their_mean_are_orthonormal():
    basis = without_constant(Context(GRID, degree=None))
    np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(basis.sum(axis=0), 0, atol=1e-12)


def test_flux_of_the_context_is_that_of_a_beam():
    one, two = data.observed(flux=1e5), data.observed(flux=3e5, seed=2)
    context = Context.of(data.WAVELENGTH.to_value(u.um), [one, two])
    middle = [np.median(o.flux_right + o.flux_left) / 2 for o in (one, two)]
    assert context.flux == pytest.approx(np.mean(middle))
    assert context.tracking == ((0.5, 1.0),) * 2


def test_law_of_the_plate_where_the_instrument_is_not_known():
    table = example_table()
    table.meta["instrument"] = "an instrument of my own"
    assert tracking_laws([Observations.from_table(table)]) == ((0.5, 1.0),)


# ---- parameters and edits ------------------------------------------------------------------


def test_sizes_are_canonical_inside():
    for scale, limit, expected in [
        (1 * u.deg, 30 * u.deg, (np.pi / 180, np.pi / 6)),
        (0.02 * u.mm, 0.5 * u.mm, (20.0, 500.0)),
        (0.003, 0.1, (0.003, 0.1)),
        (0.3 * u.percent, 10 * u.percent, (0.003, 0.1)),
    ]:
        one = EffectParameter("a.b", scale, limit)
        assert (one.canonical_scale, one.canonical_limit) == pytest.approx(expected)


def test_where_an_effect_is_absent():
    for name, neutral, expected in [
        ("a.theta", None, 0.0),
        ("a.retained_q", None, 1.0),
        ("a.theta", 90 * u.deg, np.pi / 2),
        ("a.retained_q", 0.9, 0.9),
        ("retained.theta", None, 0.0),
    ]:
        one = EffectParameter(name, 1, 1, neutral=neutral)
        assert one.canonical_neutral == pytest.approx(expected)
        assert one.is_retained == ("retained" in name.partition(".")[2])


def test_neutral_values_per_wavelength_stay_an_array():
    one = EffectParameter("a.w", 1, 1, neutral=[1, 2] * u.mm)
    np.testing.assert_allclose(one.canonical_neutral, [1000.0, 2000.0])


def test_laws_limits_and_priors_of_an_edit():
    basis = np.ones((5, 1))
    first = EffectParameter("a.b", 1 * u.deg, 20 * u.deg, basis)
    second = EffectParameter("a.c", 0.1, 0.5)
    edit = Edit([], [first, second])
    assert list(edit.laws) == ["a.b"]
    assert edit.laws["a.b"] is basis
    assert edit.limits == pytest.approx({"a.b": np.pi / 9, "a.c": 0.5})
    assert edit.priors == pytest.approx({"a.b": np.pi / 18, "a.c": 0.25})


@pytest.mark.slow
@given(st.text("aZ0 _.:/~\"'\\\n\té中", min_size=1, max_size=12))
def test_label_is_a_name_that_an_optic_may_have(name):
    label = label_of(name)
    assert label.startswith("gap_")
    assert "." not in label
    assert " " not in label
    assert label_of("fringes:a") == "gap_fringes_a"


# ---- names ---------------------------------------------------------------------------------


def test_an_unknown_effect_gets_near_names_and_the_way_to_all():
    with pytest.raises(GapError) as caught:
        get_effect("derotator_diatenuation")
    message = str(caught.value)
    assert message.startswith("no effect 'derotator_diatenuation'; did you mean ")
    assert "'derotator_diattenuation' or '" in message
    assert f"All {len(EFFECTS)} are listed by 'astropolcal diagnose --effects help'" in message
    # one line that a terminal can show
    assert len(message) < 260
    assert "\n" not in message


def test_without_a_near_name_all_are_pointed_to():
    with pytest.raises(GapError, match=rf"^no effect 'zzz'; all {len(EFFECTS)} are listed by "):
        get_effect("zzz")


def test_an_effect_of_one_optic_has_a_name_of_its_own():
    one = get_effect("m3_diattenuation:m4")
    assert (one.optic, one.name) == ("m4", "m3_diattenuation:m4")
    assert one.title.endswith("(m4)")
    assert get_effect(one) is one
    # the library's own is left as it is
    assert get_effect("m3_diattenuation").optic is None
    assert repr(one).startswith("<Effect m3_diattenuation:m4: ")


def test_what_acts_on_one_optic_is_not_divided_again():
    one = get_effect("m3_diattenuation:m4")
    assert one.per_optic([]) == [one]
    gain = get_effect("beam_gain")
    assert gain.per_optic([data.chain()]) == [gain]


# ---- roles ---------------------------------------------------------------------------------


def plate(name="hwp", mount="hwp"):
    return optics.LinearRetarder(retardance=180 * u.deg, mount=mount, name=name)


def turned(name="k", mount="derotator"):
    return optics.LinearRetarder(retardance=90 * u.deg, mount=mount, name=name)


WOLLASTON = optics.WollastonPrism(name="wollaston")


def test_roles_of_a_bare_chain():
    roles = Roles(plate() | WOLLASTON)
    assert roles.plate.name == roles.relay.name == roles.entrance.name == "hwp"
    assert roles.splitter.name == "wollaston"
    assert roles.derotator is roles.polarizer is roles.mirror is roles.telescope_mirror is None
    assert roles.all("derotator") == []
    assert roles.all("no such role") == []


def test_a_place_without_an_optic_has_no_anchor():
    """Not even where an optic has no name."""
    roles = Roles(optics.LinearRetarder() | plate() | WOLLASTON)
    for place in ("source", "telescope", "detector"):
        assert Where.of(place).anchor(roles) is None, place
    assert Where.of("after:hwp").anchor(roles).name == "hwp"


def test_a_retarder_in_front_of_the_plate_is_a_plate_and_behind_a_derotator():
    chain = plate("quarter", "qwp") | plate() | turned() | turned("second", "k2") | WOLLASTON
    roles = Roles(chain)
    assert [o.name for o in roles.all("plate")] == ["hwp", "quarter"]
    assert [o.name for o in roles.all("derotator")] == ["k", "second"]
    # the stage called derotator comes first, wherever it stands
    other = Roles(plate() | turned("second", "k2") | turned() | WOLLASTON)
    assert [o.name for o in other.all("derotator")] == ["k", "second"]


def test_a_polarizer_in_front_leaves_no_entrance():
    chain = optics.LinearPolarizer(name="pol") | plate() | WOLLASTON
    roles = Roles(chain)
    assert roles.polarizer.name == "pol"
    assert roles.entrance is None
    assert Roles(turned() | WOLLASTON).entrance is None


def test_the_mirror_of_an_unpolarized_source_stands_still_and_first():
    mirror = optics.Diattenuator(diattenuation=0.01, name="fold")
    assert Roles(mirror | plate() | WOLLASTON).mirror.name == "fold"
    assert Roles(plate() | mirror | WOLLASTON).mirror is None
    moving = optics.Diattenuator(diattenuation=0.01, mount="hwp", name="fold")
    assert Roles(moving | plate() | WOLLASTON).mirror is None


def test_an_optic_may_be_chosen_for_a_role():
    chain = plate() | turned() | turned("second", "k2") | WOLLASTON
    assert Roles(chain, derotator="second").derotator.name == "second"
    assert Roles(chain, derotator="absent").derotator is None


def test_what_an_effect_has_added_has_no_role():
    added = optics.LinearRetarder(retardance=0 * u.deg, mount="hwp", name="gap_hwp_retardance")
    roles = Roles(added | plate() | WOLLASTON)
    assert [o.name for o in roles.all("plate")] == ["hwp"]
    assert roles.entrance.name == "hwp"


def test_a_modulator_is_no_derotator():
    chain = instruments.get("vampires").chain(derotator="linear")
    assert {o.stage for o in Roles(chain).all("derotator")} == {"derotator"}


def test_words_name_the_plate_where_there_is_no_derotator():
    chain = plate() | WOLLASTON
    (one,) = adapted([get_effect("static_diattenuator")], [chain])
    assert one.title == "diattenuator that is static downstream of the half-wave plate"
    assert one.place == "relay downstream of the half-wave plate"
    with_it = plate() | turned() | WOLLASTON
    same, between = adapted([get_effect("static_diattenuator")], [with_it])
    assert same is get_effect("static_diattenuator")
    assert between.title == "diattenuator that is static downstream of the half-wave plate"
    assert {cell.place for cell in between.cells([with_it])} == {"after:hwp"}
    # what says nothing of it stays itself
    assert adapted([get_effect("beam_gain")], [chain]) == [get_effect("beam_gain")]


# ---- held parameters and bounds ------------------------------------------------------------


def test_bounds_leave_room_about_the_value():
    for bounds, value, limit, expected in [
        ((-5, 5), 4.0, 10 * u.deg, (-6.0, 14.0)),
        # never tighter than before
        ((-50, 50), 4.0, 10 * u.deg, (-50.0, 50.0)),
        ((None, 5), 4.0, 10 * u.deg, (None, 14.0)),
        ((-5, None), 4.0, (10 * u.deg).to(u.rad), (-6.0, None)),
        # as far as the optic itself allows
        ((-5, 175), 174.0, 10 * u.deg, (-5.0, 180.0)),
    ]:
        optic = turned()
        optic.theta.bounds, optic.theta = bounds, value * u.deg
        optic.theta.bounds = bounds
        found = around(optic.theta, limit, type(optic).theta.bounds)
        assert [None if x is None else pytest.approx(x) for x in found] == list(expected)


def test_a_parameter_at_its_bound():
    for value, is_at_bound in [
        (5.0, True),
        (-5.0, True),
        (4.9995, True),
        (4.99, False),
        (0, False),
    ]:
        effect, optic = get_effect("derotator_angle_bound"), turned()
        optic.theta.bounds = (-5, 5)
        optic.theta = value * u.deg
        # nearer than a ten thousandth of the limit of ten degrees
        assert effect.is_open(optic.theta) == is_at_bound


def test_a_parameter_without_bounds_is_at_none():
    optic = turned()
    optic.theta.bounds = (None, None)
    assert not get_effect("derotator_angle_bound").is_open(optic.theta)


def test_releasing_frees_the_parameter_and_remembers_its_value():
    chain = plate() | turned() | WOLLASTON
    chain["k"].theta.fixed = True
    chain["k"].theta = 7 * u.deg
    effect = get_effect("derotator_misalignment")
    assert effect.applies([chain])
    edit = effect.edit([chain], Context(GRID))
    assert not edit.chains[0]["k"].theta.fixed
    assert chain["k"].theta.fixed
    (parameter,) = edit.parameters
    assert parameter.name == "k.theta"
    assert parameter.canonical_neutral == pytest.approx(np.deg2rad(7))


def test_of_two_datasets_a_common_parameter_is_freed_once():
    chain = plate() | turned() | WOLLASTON
    chain["k"].theta.fixed = True
    edit = get_effect("derotator_misalignment").edit([chain, chain], Context(GRID))
    assert [p.name for p in edit.parameters] == ["k.theta"]
    assert all(not one["k"].theta.fixed for one in edit.chains)


# ---- pairs, lags, slopes -------------------------------------------------------------------


def test_what_stands_behind_undoes_what_stands_in_front():
    chain = data.chain()
    edit = get_effect("hwp_encoder_eccentricity").edit([chain], Context(GRID))
    order = [leaf.name for leaf in leaves(edit.chains[0])]
    label = "gap_hwp_encoder_eccentricity"
    at = order.index("hwp")
    assert order[at - 1 : at + 2] == [label, "hwp", f"{label}_back"]
    for key in ("cosine", "sine"):
        tie = edit.ties[f"{label}_back.{key}"]
        assert (tie.source, tie.factor) == (f"{label}.{key}", -1.0)


def test_a_lag_is_a_rotator_by_the_rate():
    turn = lagging("-parallactic")
    assert (turn.stage, turn.stage_sign) == ("parallactic_rate", -1)
    assert turn.rate.bounds == (-360, 360)


def test_slopes_of_a_retardance_are_its_differences_from_bin_to_bin():
    # degrees per bin: 10 inside; a wrap at 180 deg is none
    values = np.mod(np.arange(6) * 10.0 + 150 + 180, 360) - 180
    retarder = optics.LinearRetarder(retardance=values * u.deg, name="r")
    found = retardance_slopes(retarder)
    np.testing.assert_allclose(found, np.deg2rad([[10.0, 0.0]] * 6), atol=1e-12)


def test_what_has_no_slopes():
    for retarder in [
        None,
        optics.LinearRetarder(retardance=90 * u.deg, name="r"),
        optics.LinearRetarder(retardance=[90, 90, 90] * u.deg, name="r"),
        optics.LinearRetarder(retardance=[90, 95] * u.deg, name="r"),
        optics.Diattenuator(diattenuation=[0.1, 0.2, 0.3], name="d"),
    ]:
        assert retardance_slopes(retarder) is None


# ---- stars ---------------------------------------------------------------------------------


def test_only_a_star_whose_polarization_is_held_is_held():
    star = optics.PolarizedSource(name="star")
    star.q.fixed = star.u.fixed = True
    assert held_star([plate(), star]) is star
    star.u.fixed = False
    assert held_star([star]) is None


# ---- laws of special effects ---------------------------------------------------------------


def test_fringes_have_a_sine_and_a_cosine_in_the_wavenumber():
    law = get_effect("fringes_12_um").law(Context(GRID))
    phase = 2 * np.pi * 12 / GRID
    np.testing.assert_allclose(law, np.stack([np.cos(phase), np.sin(phase)], axis=1))
    assert get_effect("fringes_12_um").law(Context(GRID[:4])) is None


def test_law_of_a_wavelength_scale_is_what_a_shift_and_a_stretch_do_to_the_plate():
    plate, context = data.chain()["hwp"], Context(data.WAVELENGTH.to_value(u.um))
    (parameter,) = get_effect("wavelength_scale").edit([data.chain()], context).parameters
    assert parameter.basis.shape == (7, 2)
    assert np.abs(parameter.basis).max() <= 1 + 1e-9
    at = data.WAVELENGTH
    for moved in (at + 0.1 * u.nm, at * 1.0001):
        change = (plate.retardance(moved) - plate.retardance(at)).to_value(u.deg)
        size = np.linalg.lstsq(parameter.basis, change, rcond=None)[0]
        left = np.abs(change - parameter.basis @ size).max()
        assert left < 1e-3 * np.abs(change).max(), moved


def test_a_single_wavelength_has_no_law():
    context = Context(np.array([1.6]))
    assert get_effect("beam_gain").law(context) is None
    assert get_effect("dichroic_j_band").law(context) is None


def test_both_beams_share_the_gain_of_a_detector():
    edit = get_effect("detector_nonlinearity").edit([data.chain()], Context(GRID, flux=500.0))
    assert [p.name for p in edit.parameters] == ["gap_detector_nonlinearity.right"]
    tie = edit.ties["gap_detector_nonlinearity.left"]
    assert tie.source == "gap_detector_nonlinearity.right"
    assert edit.chains[0]["gap_detector_nonlinearity"].reference == 500.0


# ---- alternatives --------------------------------------------------------------------------


def test_a_flip_that_the_model_has_is_taken_out():
    flip = get_effect("mirror_flip")
    (once,) = flip.edit([data.chain()], None).chains
    names = [leaf.name for leaf in leaves(once)]
    assert names.index("gap_mirror_flip") == names.index("wollaston") - 1
    own = plate() | turned() | optics.ParityFlip(name="odd") | WOLLASTON
    (without,) = flip.edit([own], None).chains
    assert [leaf.name for leaf in leaves(without)] == ["hwp", "k", "wollaston"]


def test_two_signs_are_none():
    for name in ["hwp_sign", "derotator_sign"]:
        effect = get_effect(name)
        chain = plate() | turned() | WOLLASTON
        key = "hwp" if name == "hwp_sign" else "k"
        (once,) = effect.edit([chain], None).chains
        assert once[key].stage_sign == -1
        (twice,) = effect.edit([once], None).chains
        assert twice[key].mount == chain[key].mount
        assert chain[key].stage_sign == 1


def test_another_zero_takes_the_bounds_along():
    chain = plate() | turned() | WOLLASTON
    chain["k"].theta.bounds = (-5, None)
    (moved,) = get_effect("derotator_offset").edit([chain], None).chains
    assert moved["k"].theta.value == pytest.approx(45)
    assert moved["k"].theta.bounds == (40, None)


def test_chains_without_the_place_are_left_alone():
    chains = [plate() | WOLLASTON, plate() | turned() | WOLLASTON]
    edit = get_effect("derotator_sign").edit(chains, None)
    assert edit.chains[0] is chains[0]
    assert edit.chains[1]["k"].stage_sign == -1
    assert edit.parameters == []


def test_beams_that_are_exchanged_in_a_part_of_a_run_are_a_mistake_of_its_table():
    whole, names = get_effect("beams_swapped"), ["lamp", "lamp from frame 3"]
    part = whole.in_run(names[1])
    assert part.is_of_table
    assert not whole.is_of_table
    assert part.title.endswith('exchanged in "lamp from frame 3" only')
    tables = [Observations.from_table(example_table(), name=name) for name in names]
    chain = data.chain()
    edited = part.edit([chain, chain], Context.of(GRID, tables)).chains
    assert [len(leaves(one)) - len(leaves(chain)) for one in edited] == [0, 1]
    places = {"hwp": np.array([20, 60]) * u.deg, "derotator": np.array([70, 80]) * u.deg}
    right, left = (
        system_mueller(with_beam(one, beam), data.WAVELENGTH, places)
        for one, beam in zip(edited, ("right", "left"), strict=True)
    )
    np.testing.assert_allclose(right[..., 0, :], left[..., 0, :], atol=1e-12)
