# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects on sky and those that need time: found at a known significance, their aliases, a star."""

import astropy.units as u
import numpy as np
import pytest
from sky_data import sky_track
from test_effects import (
    CASES,
    SKY,
    WAVELENGTH,
    clean,
    context_of,
    fitted,
    noisy,
    problem_of,
    with_size,
)

from astropolcal import calibrate, instruments, optics
from astropolcal.chain import insert_optic, join, leaves, replace_optic
from astropolcal.gap.attribution import scan
from astropolcal.gap.channels import orthonormal
from astropolcal.gap.effects import EFFECTS, Roles, get_effect
from astropolcal.gap.model import Model
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.selection import ENOUGH, select
from astropolcal.instruments.telescope import published_mirror
from astropolcal.observations import Observations
from astropolcal.observations.pointings import sky_angles, tracked
from astropolcal.simulation import simulate

SMOOTH = [effect for effect in EFFECTS.values() if effect.kind != "discrete"]
NEW = (
    "derotator_band_average",
    "derotator_elliptical_retardance",
    "derotator_motion",
    "dichroic_band_average",
    "fringes_drift",
    "fringes_drift_12_um",
    "m3_diattenuation",
    "m3_recoating",
    "m3_retardance",
    "parallactic_offset",
    "sky_background",
    "sky_motion",
    "standard_polarization",
)


def planted(name, chains, data, snr, size, seed=5):
    """Return data with an effect whose signature has a length of so many standard errors."""
    edit = EFFECTS[name].edit(chains, context_of(data))
    nominal, problem = GapProblem(chains, data), problem_of(edit, data)
    nominal.settle_noise()
    problem = GapProblem(edit.chains, data, ties=problem.ties, laws=problem.laws, like=nominal)
    q, _ = with_size(problem, edit.parameters, size)
    rows = problem.jacobian(problem.start) @ (q - problem.start)
    tangent = orthonormal(nominal.jacobian(nominal.start))
    length = np.linalg.norm(rows - tangent @ (tangent.T @ rows))
    q = problem.start + snr / length * (q - problem.start)
    return noisy(problem, q, data, seed)


def group(model):
    """Return the effect that explains the data best, and what cannot be told from it."""
    found = scan(model, SMOOTH, cells=False).candidates
    most = max((one.statistic for one in found), default=0.0)
    near = [one for one in found if one.statistic > 0.95 * most or one is found[0]]
    return [one.name for one in near if one.evidence > ENOUGH]


@pytest.mark.long
def test_is_found_at_a_significance_of_thirty():
    for name in NEW:
        chains, data = clean(name)
        model = fitted(chains, planted(name, chains, data, 30, CASES[name].size))
        # an elliptical derotator of which only the circular part shows has the simpler name
        simpler = {"derotator_elliptical_retardance": "derotator_circular_retardance"}
        assert {name, simpler.get(name)} & set(group(model))


@pytest.mark.slow
def test_nothing_is_found_where_there_is_nothing():
    for sky in [False, True]:
        name = "m3_retardance" if sky else "fringes_drift"
        chains, data = clean(name)
        problem = GapProblem(chains, data)
        model = fitted(chains, noisy(problem, problem.start, data, seed=8))
        assert group(model) == []


# ---- aliases ---------------------------------------------------------------------------------


def one_star(parallactic, altitude):
    """Return the chain of an unpolarized star without its mirror, gains free, and clean data."""
    charis = instruments.get("charis")
    chain = charis.chain("unpolarized standard star", wavelength=WAVELENGTH, derotator="linear")
    optics_ = [leaf.copy() for leaf in leaves(chain) if leaf.name != "m3"]
    for leaf in optics_:
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    gain = optics.BeamGain(imbalance=np.zeros(WAVELENGTH.size), name="flat")
    chain = join([*optics_, gain])
    frames = sky_track(12, parallactic, altitude)
    return [chain], [simulate(chain, WAVELENGTH, frames, flux=1e8, noise=False)]


@pytest.mark.slow
def test_mirror_and_polarized_star_are_alike_where_the_sky_hardly_turns():
    """What a polarized star explains of the gap that the mirror leaves."""
    for parallactic, altitude, share in [
        ((20, 24), (60, 60.5), (0.97, 1.05)),
        ((-60, 60), (50, 70), (0.0, 0.6)),
    ]:
        chains, data = one_star(parallactic, altitude)
        seen = planted("m3_diattenuation", chains, data, 30, (1.0, -0.1, 0.05))
        model = fitted(chains, seen)
        assert group(model)[0] == "m3_diattenuation"
        names = ("m3_diattenuation", "standard_polarization")
        found = scan(model, list(map(get_effect, names)), cells=False).candidates
        scores = {one.name: one for one in found}
        mirror, star = (scores[name].statistic for name in names)
        assert share[0] < star / mirror < share[1]


# ---- where effects have their place ------------------------------------------------------------

SKY_ONLY = [name for name, case in CASES.items() if case.sky]


def test_effects_on_sky_have_no_place_on_the_bench():
    for name in SKY_ONLY:
        charis = instruments.get("charis")
        bench = [charis.chain("polarized"), charis.chain("unpolarized")]
        assert not EFFECTS[name].applies(bench * 2)


def test_chains_of_the_bench_stay_next_to_those_of_stars():
    chains, _ = clean("m3_recoating")
    bench = instruments.get("charis").chain(wavelength=WAVELENGTH)
    context = context_of(clean("m3_recoating")[1])
    for name in SKY_ONLY:
        ready = CASES[name].prepare([chain.copy() for chain in chains])
        edit = EFFECTS[name].edit([bench, *ready], context)
        assert edit.chains[0] is bench
        assert any(new is not old for new, old in zip(edit.chains[1:], ready, strict=True))


def test_mirror_with_free_parameters_is_left_to_the_fit():
    charis = instruments.get("charis")
    for m3 in ("free", "power law", "metal"):
        chain = charis.chain("star", m3=m3)
        assert not EFFECTS["m3_diattenuation"].applies([chain])
        assert EFFECTS["m3_retardance"].applies([chain]) == (m3 == "free")
    held = charis.on_sky(charis.published())
    for key in held["m3"].param_names:
        getattr(held["m3"], key).fixed = True
    assert EFFECTS["m3_diattenuation"].applies([held])
    assert EFFECTS["m3_retardance"].applies([held])


def test_mirror_keeps_its_orientation():
    chain = instruments.get("charis").chain("star", wavelength=WAVELENGTH)
    chain["m3"].diattenuation.fixed = True
    chain["m3"].theta = 3 * u.deg
    edit = EFFECTS["m3_diattenuation"].edit([chain], context_of(clean("m3_retardance")[1]))
    order = [leaf.name for leaf in leaves(edit.chains[0])]
    assert order[1:5] == ["parallactic", "m3", "gap_m3_diattenuation", "altitude"]
    assert edit.chains[0]["gap_m3_diattenuation"].theta.value == 3


def test_recoating_has_a_change_for_each_dataset_but_the_first():
    chains, data = clean("m3_recoating")
    edit = EFFECTS["m3_recoating"].edit([*chains, chains[0]], context_of(data))
    assert [parameter.name for parameter in edit.parameters] == [
        "gap_m3_recoating_1.diattenuation",
        "gap_m3_recoating_2.diattenuation",
    ]
    assert edit.chains[0] is chains[0]


def test_star_held_at_a_catalogue_value_starts_there():
    chains, data = clean("standard_polarization")
    held = 0.02 + 0.01 * np.sin(np.arange(WAVELENGTH.size))
    star = chains[1]["other"].with_parameters(q=held, u=-held)
    star.q.fixed = star.u.fixed = True
    chain = replace_optic(chains[1], "other", star)
    edit = EFFECTS["standard_polarization"].edit([chain], context_of(data))
    problem = problem_of(edit, data[1:])
    values = problem.vector(problem.start)[problem.free.by_name["other.q"].slice]
    np.testing.assert_allclose(values, held, atol=1e-14)


def test_derotator_with_one_component_free_is_not_made_elliptical():
    charis = instruments.get("charis")
    linear, elliptical = charis.chain(derotator="linear"), charis.chain()
    effect = EFFECTS["derotator_elliptical_retardance"]
    assert effect.applies([linear])
    assert not effect.applies([elliptical])
    elliptical["derotator"].diagonal.fixed = True
    assert not effect.applies([elliptical])
    assert EFFECTS["derotator_45_retardance"].applies([elliptical])
    elliptical["derotator"].circular.fixed = True
    assert effect.applies([elliptical])


# ---- laws --------------------------------------------------------------------------------------


def test_band_average_is_that_of_many_retarders():
    """The depolarizer, at the coefficient of the theory, against a mean over the bin."""
    chains, data = clean("dichroic_band_average")
    edit = EFFECTS["dichroic_band_average"].edit(chains, context_of(data))
    dichroic = chains[0]["dichroic"].retardance.value
    slope = np.gradient(np.deg2rad(dichroic))
    place = int(np.abs(slope).argmax())
    loss = slope[place] ** 2 / 24
    optic = edit.chains[0]["gap_dichroic_band_average"]
    law = edit.parameters[0].basis[:, 1]
    assert law[place] == 1.0
    keep = (1 - loss * law)[place]
    averaged = optics.Depolarizer(retained_u=keep, retained_v=keep, theta=optic.theta.value * u.deg)
    points, weights = np.polynomial.legendre.leggauss(16)
    within = np.deg2rad(dichroic[place]) + 0.5 * points * slope[place]
    many = [optics.LinearRetarder(retardance=d * u.rad, theta=40 * u.deg).mueller() for d in within]
    expected = np.einsum("n,nij->ij", weights / 2, many)
    one = optics.LinearRetarder(retardance=dichroic[place] * u.deg, theta=40 * u.deg).mueller()
    found = averaged.mueller() @ one
    assert np.abs(one - expected).max() > 10 * np.abs(found - expected).max()


def test_depolarizer_of_an_elliptical_retarder_lies_along_its_steep_axis(other_svd):
    size = WAVELENGTH.size
    steep = 30 * np.tanh(np.linspace(-3, 3, size)) * u.deg
    optic = optics.EllipticalRetarder(
        horizontal=np.zeros(size) * u.deg, diagonal=steep, name="dichroic"
    )
    chains, data = clean("fringes_drift")
    chain = insert_optic(chains[0], optic, before="wollaston")
    for _ in range(2):
        edit = EFFECTS["dichroic_band_average"].edit([chain], context_of(data))
        assert edit.chains[0]["gap_dichroic_band_average"].theta.value == pytest.approx(45)
        other_svd()


def test_fringes_whose_phase_drifts_are_a_cosine_and_a_sine():
    """To first order, with the phase of the middle of the run."""
    effect = get_effect("fringes_drift")
    context = context_of(clean("fringes_drift")[1])
    law = effect.law(context)
    x, rate, amplitude = np.linspace(0, 1, 5), 0.1, 2.0
    phase = 2 * np.pi * effect.thickness / context.wavelength
    exact = amplitude * np.cos(phase[:, None] + rate * (x - 0.5))
    static = law @ [amplitude, amplitude * rate / 2]
    drift = law @ [0.0, -amplitude * rate]
    linear = static[:, None] + drift[:, None] * x
    assert np.abs(exact - linear).max() < 0.5 * amplitude * (rate / 2) ** 2 * 1.01


# ---- signs -------------------------------------------------------------------------------------

SIGNS = {
    "hwp_tracking_parallactic_sign": lambda p, a: -0.5 * p + a,
    "hwp_tracking_altitude_sign": lambda p, a: 0.5 * p - a,
    "hwp_not_tracking": lambda p, a: 0.0 * p,
}


def test_alternative_is_a_plate_with_another_tracking_law():
    """Other angles in the table, or another chain: the same fluxes."""
    for name in SIGNS:
        chains, _ = clean("m3_retardance")
        parallactic, altitude = SKY["parallactic"], SKY["altitude"]
        commanded = SKY["hwp"] - 0.5 * parallactic - altitude
        wrong = SKY.copy()
        wrong["hwp"] = commanded + SIGNS[name](parallactic, altitude)
        edited = EFFECTS[name].edit(chains[1:], None).chains[0]
        settings = {"noise": False, "flux": 1e6}
        found = simulate(edited, WAVELENGTH, SKY, **settings)
        expected = simulate(chains[1], WAVELENGTH, wrong, **settings)
        np.testing.assert_allclose(found.flux_right, expected.flux_right, rtol=1e-10)
        plain = simulate(chains[1], WAVELENGTH, SKY, **settings)
        assert np.abs(found.flux_right / plain.flux_right - 1).max() > 0.01


def test_sign_of_an_axis_turns_the_mount():
    for name in ["altitude", "parallactic"]:
        chains, _ = clean("m3_retardance")
        effect = EFFECTS[f"{name}_sign"]
        once = effect.edit(chains, None).chains
        twice = effect.edit(once, None).chains
        assert chains[0][name].mount != once[0][name].mount
        assert chains[0][name].mount == twice[0][name].mount
        assert Roles(once[0]).plate.name == "hwp"


# ---- a star ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def standard(shared_data):
    """Return an unpolarized standard, its plate angles as the plate had them."""
    charis, folder = instruments.get("charis"), shared_data / "data" / "charis"
    lamp = Observations.read(folder / "dataset3_polarized_2025-10-05.ecsv")
    star = Observations.read(folder / "hd293396_unpolarized_standard_2025-11-03.ecsv")
    inside = calibrate(charis.chain(*charis.setup(lamp)), lamp, cross_validate=False).chains[0]
    table = star.to_table()
    altitude, parallactic = (np.repeat(a, star.n_bins) * u.rad for a in sky_angles(star))
    table["hwp"] = tracked(table["hwp"], parallactic, altitude).to(u.deg)
    table.meta.pop("instrument")
    outside = leaves(charis.chain(*charis.setup(star)))[:4]
    start = [leaf.name for leaf in leaves(inside)].index("hwp")
    train = [leaf.copy() for leaf in (*outside, *leaves(inside)[start:])]
    for leaf in train:
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    train = [leaf for leaf in train if leaf.name != "m3"]
    gain = optics.BeamGain(imbalance=np.zeros(star.n_bins), name="flat")
    return join([*train, gain]), Observations.from_table(table, name=star.name)


@pytest.mark.long
def test_real_star_misses_the_tertiary_mirror(standard):
    """The internal optics as the lamp has them, gains free, and no mirror in the chain."""
    chain, star = standard
    problem = GapProblem([chain], [star])
    problem.settle_noise()
    problem.settle_noise(problem.fit().coefficients)
    model = Model(problem, problem.fit())
    found = select(model, SMOOTH, None, lambda line: None, cells=False)
    assert found.groups[0].best.name == "m3_diattenuation"
    assert found.model.is_physical("m3_diattenuation")
    # what else these data ask for takes some of it, with little probability
    alone = model.with_effects([found.groups[0].best.recipe])
    measured = alone.chains[0]["gap_m3_diattenuation"].diattenuation.value
    published = published_mirror().diattenuation(star.wavelength)
    assert np.sqrt(np.mean((measured - published) ** 2)) < 0.0015
    assert all(group.probability < 0.5 for group in found.groups[1:])
