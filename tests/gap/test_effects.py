# Licensed under a 3-clause BSD style license - see LICENSE
"""
Every effect of the library: laws, recovery from noisy data, serialization.

`CASES` has an entry for each registered effect; a test fails where one lacks.
"""

import json
from dataclasses import dataclass
from functools import cache

import asdf
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from gap_data import effect_basis
from gap_data import errors as errors_of
from sky_data import sky_track

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.chain import insert_optic, leaves, remove_optic
from astropolcal.exceptions import GapError
from astropolcal.gap.attribution import scan
from astropolcal.gap.cells import places
from astropolcal.gap.channels import orthonormal
from astropolcal.gap.effects import (
    EFFECTS,
    KINDS,
    Context,
    Effect,
    Roles,
    check_effect,
    get_effect,
    register_effect,
)
from astropolcal.gap.effects._laws import Held
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import Model
from astropolcal.gap.problem import Fit, GapProblem
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import canonical_factor

WAVELENGTH = np.geomspace(1.16, 2.3, 6) * u.um
FRAMES = half_wave_plate_cycles(derotator=[45, 62, 77, 98] * u.deg)
LONG = half_wave_plate_cycles(np.arange(0, 360, 33.75) * u.deg, [45, 62, 77, 98] * u.deg)
BACK_AND_FORTH = half_wave_plate_cycles(derotator=[45, 77, 62, 98, 52, 85] * u.deg)
SKY = sky_track(12, parallactic=(-50, 70), altitude=(50, 75))
#: Photons of a beam, at first.
FLUX = 1e8


def _transit():
    """Return the frames of a star near transit, which turns fastest in the middle."""
    table, n = SKY.copy(), len(SKY)
    commanded = table["hwp"] - 0.5 * table["parallactic"] - table["altitude"]
    x = np.linspace(-3, 3, n)
    table["parallactic"], table["altitude"] = 60 * np.tanh(x) * u.deg, (80 - x**2) * u.deg
    table["derotator"] = 0.5 * (table["altitude"] - table["parallactic"]) + 63.5 * u.deg
    table["hwp"] = commanded + 0.5 * table["parallactic"] + table["altitude"]
    return table


TRANSIT = _transit()


def lamp(n_frames):
    """Return the brightness of a lamp that grows dim, frame by frame."""
    return np.exp(-0.7 * np.linspace(0, 1, n_frames))


def _nothing(chains):
    return chains


def _hold(*names):
    """Return what fixes the orientation of optics."""

    def change(chains):
        for leaf in (leaf for chain in chains for leaf in leaves(chain)):
            if leaf.name in names:
                leaf.theta.fixed = True
        return chains

    return change


def _bounded(optic, key, low, high):
    """Return what narrows the bounds of a parameter, so that its value is at one."""

    def change(chains):
        for leaf in (leaf for chain in chains for leaf in leaves(chain)):
            if leaf.name == optic:
                parameter = getattr(leaf, key)
                value = np.asarray(parameter.value)
                parameter.bounds = (value.min() + low, value.max() + high)
        return chains

    return change


def _steep_dichroic(chains):
    """Put in a retarder that stands still and is steep in wavelength, held where it is."""
    values = 40 * np.tanh(np.linspace(-3, 3, WAVELENGTH.size)) * u.deg
    dichroic = optics.LinearRetarder(retardance=values, theta=40 * u.deg, name="dichroic")
    dichroic.retardance.fixed = True
    return [insert_optic(chain, dichroic.copy(), before="wollaston") for chain in chains]


def _hold_mirror(chains):
    for chain in chains:
        chain["m3"].diattenuation.fixed = True
    return chains


def _without_mirror(chains):
    return [
        remove_optic(chain, "fold_mirror") if "fold_mirror" in chain.submodel_names else chain
        for chain in chains
    ]


@dataclass
class Case:
    """How an effect is tested."""

    #: Coefficients in units of the size to expect, one a coefficient, repeated as needed.
    size: tuple = (1.0, -0.6, 0.4)
    #: What the nominal chains need before the effect has a place.
    prepare: object = _nothing
    frames: object = None
    #: Whether the chains are those of two stars.
    sky: bool = False


_ONE_SIGN = (1.0,)
CASES = {
    "angles_early": Case(),
    "angles_late": Case(),
    "anisotropic_depolarizer": Case((-1.0, 0.3, 0.2)),
    "background": Case((2.0, -0.6, 0.4)),
    "beam_crosstalk": Case((-1.0, 0.3, 0.2)),
    "beam_gain": Case(),
    "altitude_sign": Case(sky=True),
    "beams_swapped": Case(),
    "derotator_45_retardance": Case(),
    "derotator_angle_bound": Case(_ONE_SIGN, _bounded("derotator", "theta", -5, 0)),
    "derotator_backlash": Case(frames=BACK_AND_FORTH),
    "derotator_band_average": Case((-1.0, -2.0)),
    "derotator_circular_retardance": Case(),
    "derotator_diattenuation": Case(),
    "derotator_doubled": Case(),
    "derotator_early": Case(),
    "derotator_elliptical_retardance": Case(),
    "derotator_encoder": Case(),
    "derotator_encoder_eccentricity": Case((5.0, 5.0)),
    "derotator_halved": Case(),
    "derotator_late": Case(),
    "derotator_misalignment": Case(_ONE_SIGN, _hold("derotator")),
    "derotator_motion": Case((2.0,), sky=True, frames=TRANSIT),
    "derotator_offset": Case(),
    "derotator_retardance_bound": Case(_ONE_SIGN, _bounded("derotator", "retardance", -400, 0)),
    "derotator_sign": Case(),
    "detector_nonlinearity": Case(),
    "dichroic_band_average": Case((-1.0, -3.0), _steep_dichroic),
    "dichroic_j_band": Case((1.0, -0.6, 0.4, 0.8, -1.0)),
    "fringes": Case(),
    "fringes_12_um": Case(),
    "fringes_4_um": Case(),
    "fringes_drift": Case(),
    "fringes_drift_12_um": Case(),
    "fringes_drift_4_um": Case(),
    "hwp_angle_bound": Case(_ONE_SIGN, _bounded("hwp", "theta", -5, 0)),
    "hwp_axis_dispersion": Case(),
    "hwp_backlash": Case(),
    "hwp_beam_wander": Case(frames=LONG),
    "hwp_diattenuation": Case(),
    "hwp_doubled": Case(),
    "hwp_early": Case(),
    "hwp_encoder_eccentricity": Case(frames=LONG),
    "hwp_encoder_two_lobe": Case(frames=LONG),
    "hwp_halved": Case(),
    "hwp_late": Case(),
    "hwp_reversed": Case(),
    "hwp_misalignment": Case(_ONE_SIGN, _hold("hwp")),
    "hwp_not_tracking": Case(sky=True),
    "hwp_offset": Case(),
    "hwp_retardance": Case(),
    "hwp_retardance_free": Case((1.0, -0.6, 0.4, 0.8, -1.0)),
    "hwp_sign": Case(),
    "hwp_thickness_bound": Case(_ONE_SIGN, _bounded("hwp", "w_sio2", -0.1, 0)),
    "hwp_tilt": Case(frames=LONG),
    "hwp_tracking_altitude_sign": Case(sky=True),
    "hwp_tracking_parallactic_sign": Case(sky=True),
    "hwp_transmission": Case(frames=LONG),
    "hwp_transmission_once": Case(frames=LONG),
    "m3_diattenuation": Case((0.5, -0.1, 0.05), _hold_mirror, sky=True),
    "m3_recoating": Case((1.0, -0.3, 0.1), sky=True),
    "m3_retardance": Case(sky=True),
    "mirror_flip": Case(),
    "mirror_flip_before_plate": Case(),
    "mirror_misalignment": Case((4.0,)),
    "parallactic_offset": Case((2.0,), sky=True),
    "parallactic_sign": Case(sky=True),
    "persistence": Case((0.3,)),
    "polarizer_angle_bound": Case(_ONE_SIGN, _bounded("calibration_polarizer", "theta", -5, 0)),
    "polarizer_leak": Case((-1.0, 0.3, 0.2)),
    "polarizer_misalignment": Case(_ONE_SIGN, _hold("calibration_polarizer")),
    "retarder_before_plate": Case(),
    "sky_background": Case(sky=True),
    "sky_motion": Case((2.0,), sky=True, frames=TRANSIT),
    "source_circular": Case(),
    "source_linear": Case(prepare=_without_mirror),
    "source_rotation_drift": Case((5.0,)),
    "standard_polarization": Case(sky=True),
    "static_diattenuator": Case(),
    "static_retarder": Case(),
    "wavelength_scale": Case(),
    "wollaston_orientation": Case(),
}
#: One effect of each kind of fingerprint, against which the others are scanned.
RIVALS = (
    "beam_gain",
    "derotator_45_retardance",
    "derotator_encoder",
    "detector_nonlinearity",
    "hwp_axis_dispersion",
    "hwp_diattenuation",
    "hwp_encoder_two_lobe",
    "hwp_retardance",
    "source_circular",
    "static_retarder",
)
#: The same for chains of stars.
SKY_RIVALS = ("beam_gain", "hwp_diattenuation", "m3_diattenuation", "m3_recoating",
              "m3_retardance", "sky_background", "standard_polarization")  # fmt: skip
SMOOTH = [name for name in CASES if EFFECTS[name].kind != "discrete"]
SHOWN = [name for name in SMOOTH if EFFECTS[name].absorbed_by is None]


def star_chains(case):
    """Return the chains of an unpolarized and a polarized star; all behind the mirror is held."""
    charis = instruments.get("charis")
    options = {"wavelength": WAVELENGTH, "derotator": "linear"}
    made = [
        charis.chain("unpolarized standard star", **options),
        charis.chain("star", star="other", **options),
    ]
    made[1]["other"].q, made[1]["other"].u = np.full((2, WAVELENGTH.size), [[0.03], [-0.05]])
    for chain in made:
        chain["m3"].diattenuation = 0.017 - 0.001 * np.arange(WAVELENGTH.size)
        for leaf in leaves(chain)[4:]:
            for key in leaf.param_names:
                getattr(leaf, key).fixed = True
    return case.prepare(made)


def nominal_chains(case):
    """Return a polarized and an unpolarized chain at their true values."""
    if case.sky:
        return star_chains(case)
    charis = instruments.get("charis")
    made = [
        charis.chain(source, wavelength=WAVELENGTH, derotator="linear")
        for source in ("polarized", "unpolarized")
    ]
    made[1]["fold_mirror"].diattenuation = 0.013 + 0.001 * np.arange(WAVELENGTH.size)
    return case.prepare(made)


@cache
def clean(name):
    """Return nominal chains of a case, and noiseless data."""
    case = CASES[name]
    chains = nominal_chains(case)
    usual = SKY if case.sky else FRAMES
    frames = usual if case.frames is None else case.frames
    settings = {"flux": FLUX, "lamp": lamp(len(frames)), "noise": False}
    data = [simulate(chain, WAVELENGTH, frames, **settings) for chain in chains]
    return chains, data


def context_of(data):
    flux = np.median([np.median(o.flux_right + o.flux_left) / 2 for o in data])
    return Context(WAVELENGTH.to_value(u.um), float(flux))


def problem_of(edit, data):
    laws = {p.name: p.basis for p in edit.parameters if p.basis is not None}
    return GapProblem(edit.chains, data, ties=edit.ties, laws=laws, neutral=edit.neutral)


def canonical(value):
    value = u.Quantity(value)
    return value.value * canonical_factor(value.unit)


def with_size(problem, parameters, size):
    """Return coefficients with the effect at a size, and where its own are."""
    q, own = problem.start.copy(), []
    for parameter in parameters:
        where = problem.slices[parameter.name]
        k = where.stop - where.start
        q[where] += np.resize(size, k) * canonical(parameter.scale)
        own += range(where.start, where.stop)
    return q, own


def noisy(problem, q, data, seed):
    """Return data as a problem predicts them, with photon noise."""
    rng, found = np.random.default_rng(seed), []
    for dataset, old in zip(problem.datasets, data, strict=True):
        shape = (WAVELENGTH.size, old.n_frames)
        fluxes = np.stack(
            [np.broadcast_to(f, shape) for f in dataset.forward(problem.vector(q)).fluxes]
        )
        fluxes = fluxes * FLUX * lamp(old.n_frames)
        drawn = fluxes + rng.normal(size=fluxes.shape) * np.sqrt(fluxes)
        frames = np.repeat(np.arange(old.n_frames), WAVELENGTH.size)
        table = QTable({"frame": frames, "wavelength": np.tile(WAVELENGTH, old.n_frames)})
        table["bin"] = np.tile(np.arange(WAVELENGTH.size), old.n_frames)
        there = ("hwp", "derotator", "parallactic", "altitude")
        for stage in (key for key in there if key in old.frames.colnames):
            table[stage] = old.position(stage)[frames] * u.rad
        for beam, flux, mean in zip(("right", "left"), drawn, fluxes, strict=True):
            table[f"flux_{beam}"] = flux.T.ravel() * u.adu
            table[f"flux_{beam}_err"] = np.sqrt(mean).T.ravel() * u.adu
        found.append(Observations.from_table(table, name=old.name))
    return found


def fitted(chains, data):
    """Return the nominal model, fitted from the true values."""
    problem = GapProblem(chains, data)
    problem.settle_noise()
    problem.settle_noise(problem.fit().coefficients)
    return Model(problem, problem.fit())


def simulated(names, size=None, seed=3):
    """Return chains and noisy data with effects at a size, and the true coefficients."""
    chains, data = clean(names[0])
    edit_chains, parameters, ties = chains, [], {}
    for name in names:
        edit = EFFECTS[name].edit(edit_chains, context_of(data))
        edit_chains, ties = edit.chains, ties | edit.ties
        parameters += edit.parameters
    edit = type(edit)(edit_chains, parameters, ties)
    problem = problem_of(edit, data)
    q, _ = with_size(problem, parameters, CASES[names[0]].size if size is None else size)
    truth = {p.name: q[problem.slices[p.name]] for p in parameters}
    return chains, noisy(problem, q, data, seed), truth


def assert_recovered(model, name, truth):
    found, errors = model.fit.coefficients, errors_of(model.problem, model.fit.coefficients)
    for key in (parameter.name for parameter in model.added[name]):
        where = model.problem.slices[key]
        off = (found[where] - truth[key]) / errors[where]
        assert np.all(np.abs(off) < 4), f"{key}: {off} standard errors"


# ---- the registry --------------------------------------------------------------------------


def test_library_is_large_and_in_words(repository, shared_data):
    assert sorted(EFFECTS) == sorted(CASES), "add an entry to CASES for each registered effect"
    page = (repository / "docs" / "effects.rst").read_text(encoding="utf-8")
    for name, effect in EFFECTS.items():
        assert effect.kind in KINDS
        for words in (effect.title, effect.place, effect.shows, effect.reference):
            assert words
            assert not words.endswith(".")
        assert name in page, f"docs/effects.rst lacks {name}"
    titles = [effect.title for effect in EFFECTS.values()]
    assert len(set(titles)) == len(titles)
    key = json.loads((shared_data / "gap-cases" / "key.json").read_text(encoding="utf-8"))
    known = {case["effect"] for case in key.values()} - {"none", "unlisted_hysteresis"}
    assert known <= set(EFFECTS)


@pytest.mark.slow
def test_checks_of_every_effect():
    """Identity at zero, names, derivatives of both channels against differences."""
    for name in CASES:
        check_effect(name, *clean(name))


def test_places_and_sizes_of_every_effect():
    alone = optics.Depolarizer(name="relay") | optics.ParityFlip(name="nbs")
    for name in SMOOTH:
        effect, (chains, data) = EFFECTS[name], clean(name)
        assert not effect.applies([alone]), name
        edit = effect.edit(chains, context_of(data))
        problem = problem_of(edit, data)
        assert edit.parameters
        for parameter in edit.parameters:
            assert 0 < canonical(parameter.scale) < canonical(parameter.limit)
            assert parameter.name in problem.free.by_name
        names = [leaf.name for leaf in leaves(edit.chains[0])]
        assert len(set(names)) == len(names)
        if isinstance(effect, Held) or name.startswith("derotator_45"):
            assert not effect.applies(edit.chains), name


@pytest.mark.slow
def test_no_effect_is_possible_beyond_the_bounds_of_its_optic():
    """Half way to the nearer of bound and limit it is, on each side that has room."""
    for name in SMOOTH:
        chains, data = clean(name)
        nominal = GapProblem(chains, data)
        model = Model(nominal, Fit(nominal.start, 0.0, True))
        edited = model.edited((EFFECTS[name], context_of(data)))
        problem, parameters = edited.problem, edited.added[name]
        for parameter in parameters:
            slot = problem.free.by_name[parameter.name]
            for side, bound in zip((-1, 1), _own_bounds(chains, problem, slot), strict=True):
                room = np.min(side * (bound - parameter.canonical_neutral))
                limit = parameter.canonical_limit
                for size, possible in ((min(room, limit) / 2, True), (room + limit / 5, False)):
                    if not (np.isfinite(size) and size > 1e-9):
                        continue
                    q = _with_value(problem, parameter, side * size)
                    changed = Model(problem, Fit(q, 0.0, True), {name: parameters})
                    assert changed.is_physical(name) == possible, (parameter.name, side, size)


def _own_bounds(chains, problem, slot):
    """Return the bounds that the class of an optic gives a parameter, or wider ones of a chain."""
    optic, key = slot.name.split(".")
    found = [o for c in chains for o in leaves(c) if o.name == optic and key in o.param_names]
    leaf = next(o for c in problem.measurement.chains for o in leaves(c) if o.name == optic)
    # the angle of a rotator may be a lag in frames, for which the effect sets the bounds
    found.append(leaf if isinstance(leaf, optics.DriftRotator) else type(leaf))
    lows, highs = zip(*(getattr(owner, key).bounds for owner in found), strict=True)
    low = min(-np.inf if end is None else end for end in lows)
    return low * slot.factor, max(np.inf if end is None else end for end in highs) * slot.factor


def _with_value(problem, parameter, size):
    """Return coefficients whose largest value is so far from where the effect is absent."""
    q, where = problem.start.copy(), problem.slices[parameter.name]
    slot = problem.free.by_name[parameter.name]
    step = np.zeros(problem.size)
    # as constant as the law can be
    step[where] = problem.coefficients(np.ones(problem.free.size))[where]
    values = problem.vector(step)[slot.slice]
    q[where] += step[where] * size / values[np.argmax(np.abs(values))]
    return q


# ---- cells ---------------------------------------------------------------------------------

#: Effects that are nearest to their cells, and no more.
NEAREST = {
    "derotator_motion", "hwp_transmission", "hwp_transmission_once", "m3_diattenuation",
    "m3_recoating", "m3_retardance", "parallactic_offset", "sky_background", "sky_motion",
    "source_linear", "polarizer_misalignment", "polarizer_angle_bound", "mirror_misalignment",
}  # fmt: skip


def seen(effect, chains, data, like, tangent, size=None):
    """Return what the parameters of an effect do, less what the nominal ones can."""
    edit = effect.edit(chains, Context.of(like.wavelength, data))
    laws = {p.name: p.basis for p in edit.parameters if p.basis is not None}
    problem = GapProblem(edit.chains, data, ties=edit.ties, laws=laws, like=like)
    q, own = with_size(problem, edit.parameters, (1.0,) if size is None else size)
    slopes = problem.jacobian(problem.start)
    slopes = slopes[:, own] if size is None else (slopes @ (q - problem.start))[:, None]
    return slopes - tangent @ (tangent.T @ slopes)


@pytest.mark.slow
def test_every_effect_is_the_cells_that_it_says():
    for name in SMOOTH:
        effect, (chains, data) = EFFECTS[name], clean(name)
        cells = effect.cells(chains)
        assert effect.cell(chains) == cells[0]
        there = {place.name for chain in chains for place in places(chain)} | {"detector"}
        assert {cell.place for cell in cells} <= there, name
        if effect.absorbed_by or name in NEAREST:
            continue
        nominal = GapProblem(chains, data)
        nominal.settle_noise()
        inside = (nominal.start > nominal.low + 1e-9) & (nominal.start < nominal.high - 1e-9)
        # what is known beforehand takes up no more than its error
        inside &= nominal.tight == 0
        tangent = orthonormal(nominal.jacobian(nominal.start)[:, inside])
        own = seen(effect, chains, data, nominal, tangent, CASES[name].size)
        probes = [seen(CellEffect(c, None), chains, data, nominal, tangent) for c in cells]
        basis = orthonormal(np.hstack(probes))
        assert np.sum((basis.T @ own) ** 2) > 0.9 * np.sum(own**2), name
    for name in set(CASES) - set(SMOOTH):
        assert EFFECTS[name].cell(clean(name)[0]) is None
    # what is in the chains is what it was, and what has no place is nothing
    chains, data = clean("hwp_misalignment")
    effect = EFFECTS["hwp_misalignment"]
    assert effect.cell(effect.edit(chains, context_of(data)).chains) == effect.cell(chains)
    bare = [optics.WollastonPrism(name="wollaston") | optics.BeamGain(name="gain")]
    assert EFFECTS["derotator_encoder"].cells(bare) == EFFECTS["hwp_tilt"].cells(bare) == ()


# ---- recovery ------------------------------------------------------------------------------


# a mirror whose angle is known to 0.3 deg takes up a small turn of the prism, and a parameter at
# its bound is freed by the effect itself, not beside it
TAKEN_UP = {"wollaston_orientation", "derotator_retardance_bound"}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SHOWN) - TAKEN_UP))
def test_recovery(name):
    """Each effect comes first among one of each kind of fingerprint, at its true size."""
    chains, data, truth = simulated([name])
    effect, model = EFFECTS[name], fitted(chains, data)
    assert effect.applies(model.chains)
    rivals = SKY_RIVALS if CASES[name].sky else RIVALS
    rivals = [EFFECTS[other] for other in rivals if other != name]
    scores = scan(model, [effect, *rivals], cells=False).candidates
    mine = next(score for score in scores if score.effect is effect)
    assert mine.p_value < 1e-3
    best = max(score.statistic for score in scores if score.rank <= mine.rank)
    assert mine.statistic > 0.95 * best, [s.effect.name for s in scores[:4]]
    improved = model.with_effect(effect)
    assert improved.fit.converged
    assert_recovered(improved, name, truth)
    assert_noise_is_left(improved)


def assert_noise_is_left(model):
    n = model.problem.n_data
    assert model.fit.chi2 < n + 5 * np.sqrt(2 * n), list(model.added)


def test_absorbed_effects_add_no_direction():
    for name in set(SMOOTH) - set(SHOWN):
        chains, data, _ = simulated([name])
        model = fitted(chains, data)
        nominal = model.problem.tangent(model.fit.coefficients)
        assert effect_basis(model, EFFECTS[name], nominal).shape[1] == 0
        optic, key = EFFECTS[name].absorbed_by.split(".")
        assert not getattr(chains[0][optic], key).fixed
        assert_noise_is_left(model)


# ---- several at once ------------------------------------------------------------------------

PAIRS = [
    ("derotator_circular_retardance", "derotator_45_retardance"),
    ("derotator_encoder", "derotator_encoder_eccentricity"),
    ("hwp_axis_dispersion", "hwp_encoder_two_lobe"),
    ("beam_gain", "background"),
]


@pytest.mark.slow
def test_pairs():
    """Two effects in one chain, whichever is added first."""
    for pair in PAIRS:
        chains, data, truth = simulated(list(pair))
        nominal = fitted(chains, data)
        for order in (pair, pair[::-1]):
            model = nominal
            for name in order:
                model = model.with_effect(EFFECTS[name])
            assert model.fit.converged
            assert list(model.added) == list(order)
            for name in pair:
                assert_recovered(model, name, truth)
            assert_noise_is_left(model)


# ---- improved chains are ordinary chains ---------------------------------------------------


@pytest.mark.slow
def test_improved_chains_serialize(tmp_path):
    written = {}
    for name in CASES:
        chains, data = clean(name)
        edit = EFFECTS[name].edit(chains, context_of(data))
        edited = edit.chains
        if edit.parameters:
            problem = problem_of(edit, data)
            q, _ = with_size(problem, edit.parameters, CASES[name].size)
            edited = problem.measurement.put_back(problem.vector(q))
        # what the nominal chains have is no matter of effects
        known = {(type(leaf), leaf.name, leaf.mount) for c in chains for leaf in leaves(c)}
        new = {leaf.name: leaf for chain in edited for leaf in leaves(chain)}
        written[name] = [o for o in new.values() if (type(o), o.name, o.mount) not in known]
    path = tmp_path / "chains.asdf"
    asdf.AsdfFile(written).write_to(path)
    with asdf.open(path) as file:
        for name, mine in written.items():
            for ours, theirs in zip(mine, file[name], strict=True):
                assert type(ours) is type(theirs)
                assert ours._settings() == theirs._settings()
                for key in ours.param_names:
                    own, read = getattr(ours, key), getattr(theirs, key)
                    assert np.array_equal(own.value, read.value)
                    assert (own.fixed, tuple(own.bounds)) == (read.fixed, tuple(read.bounds))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::astropolcal.exceptions.AstropolcalWarning")
@pytest.mark.parametrize("name", ["static_retarder", "derotator_encoder", "hwp_tilt"])
def test_improved_chains_calibrate(name, tmp_path):
    chains, data, _ = simulated([name])
    improved = fitted(chains, data).with_effect(EFFECTS[name])
    calibration = calibrate(improved.chains, data, ties=improved.problem.ties, cross_validate=False)
    path = tmp_path / "improved.asdf"
    calibration.write(path)
    read = Calibration.read(path)
    for ours, theirs in zip(calibration.chains, read.chains, strict=True):
        assert [leaf.name for leaf in leaves(ours)] == [leaf.name for leaf in leaves(theirs)]
    assert any(leaf.name.startswith("gap_") for leaf in leaves(read.chains[0]))


# ---- what is refused -----------------------------------------------------------------------


def tinted(degrees=0.0, kind=optics.LinearRetarder, **settings):
    """Return a retarder behind the derotator as an effect."""
    optic = kind(retardance=degrees * u.deg, theta=45 * u.deg, name="test_tinted")
    settings = {"title": "a test", "limit": 10 * u.deg, "name": "test_tinted"} | settings
    return Effect(place="after:derotator", inserted=optic, **settings)


class Crooked(optics.LinearRetarder):
    """A retarder whose derivative is wrong."""

    def _derivatives(self, dispersion, retardance):
        return tuple(1.01 * one for one in super()._derivatives(dispersion, retardance))


class Named(Effect):
    """Names another parameter than that of its optic."""

    other = "hwp.theta"

    def parameters(self, names, chains, context):
        return super().parameters([self.other], chains, context)


class Vandal(Effect):
    """Changes the chains that it is given."""

    def edit(self, chains, context):
        for chain in chains:
            Roles(chain).splitter.theta = 1 * u.deg
        return super().edit(chains, context)


def refused():
    """Yield effects that are not right, and what is said of them."""
    known = {"title": "a test", "limit": 10 * u.deg, "place": "after:derotator"}
    optic = optics.LinearRetarder(retardance=0 * u.deg, name="test")
    yield tinted(kind=Crooked), "test_tinted: derivative to .* differs .* by (1|1\\.0.*) %"
    yield tinted(1.0), "at zero parameters"
    yield Named("test", inserted=optic, **known), "hwp.theta is free in the chains without it"
    unknown = Named("test", inserted=optic, **known).changed(other="relay.theta")
    yield unknown, "relay.theta is not free in its chains; new and free: gap_test.retardance"
    yield tinted(limit=1 * u.um), "um"
    yield Vandal("test", inserted=optic, **known), "changes the chains that it is given"
    yield Vandal("beam_gain", inserted=optic, **known), "'beam_gain' is registered already"
    yield tinted(category="discrete"), "discrete and has parameters"
    yield tinted(when=lambda roles: False), "has no place"
    yield tinted(title=""), "lacks title"
    yield tinted(category="magic"), "kind = 'magic'; allowed are optic"


def test_check_refuses():
    chains, data = clean("beam_gain")
    check_effect(tinted(), chains, data)
    for effect, words in refused():
        with pytest.raises(GapError, match=words):
            check_effect(effect, [chain.copy() for chain in chains], data)


def test_declarations_that_are_refused():
    with pytest.raises(GapError, match="kind 'diattenuatoin'; did you mean 'diattenuation'"):
        Effect("x", "x", "after:hwp", "diattenuatoin")
    with pytest.raises(GapError, match="effect x: dependence = 'clock'"):
        Effect("x", "x", "after:hwp", "diattenuation", "clock")
    with pytest.raises(GapError, match="place = 'hwp'; allowed are 'after:OPTIC'"):
        Effect("x", "x", "hwp", "diattenuation")
    chains, data = clean("beam_gain")
    film, context = optics.EllipticalRetarder(name="film"), context_of(data)
    for limit in (1 * u.s, 1 * u.um, "x", np.nan, 0, -1 * u.deg, [1, 2] * u.deg, 0.1):
        with pytest.raises(GapError, match="effect film: limit"):
            Effect.insert(film, before="wollaston", limit=limit).edit(chains, context)
    with pytest.raises(GapError, match="effect a: size has unit m"):
        Effect("a", "a", "after:hwp", "diattenuation", limit=1 * u.m)._sizes()
    with pytest.raises(GapError, match="no setting 'limits'; did you mean 'limit'"):
        Effect("x", "x", "after:hwp", "diattenuation", limits=3)
    with pytest.raises(GapError, match="it must do nothing"):
        Effect.insert(optics.LinearRetarder(retardance=9 * u.deg, name="x"), after="hwp")
    with pytest.raises(GapError, match="no parameter of ParityFlip is free"):
        Effect.insert(optics.ParityFlip(name="x"), after="hwp")
    with pytest.raises(GapError, match="optic is of type Chain; a single Optic is needed"):
        Effect.insert(film | optics.Rotator(name="x"), after="hwp")
    for one, words in (
        (Effect("a", "a", "after:hwp"), "effect a lacks kind"),
        (Effect("a", "a", kind="gain"), "effect a lacks place"),
        (Effect.insert(optics.Diattenuator(), after="hwp"), "lacks name"),
    ):
        for use in (register_effect, get_effect):
            with pytest.raises(GapError, match=words):
                use(one)
    with pytest.raises(GapError, match="give one of after=, before= and inside="):
        Effect.insert(optics.Diattenuator(name="x"))


def test_the_degree_of_an_effect_is_checked_when_it_is_declared():
    for degree in ("x", -1, 1.5, [1]):
        with pytest.raises(GapError, match=r"effect a: degree = .*; allowed are whole numbers"):
            Effect("a", "a", "after:hwp", "diattenuation", degree=degree)
    # of a file, a text that is equal to "number" and not the same object
    chains, data = clean("beam_gain")
    written = Effect("a", "a", "after:hwp", "diattenuation", degree="".join(["num", "ber"]))
    check_effect(written, chains, data)


def test_effects_of_ones_own():
    """Declared ones at every sort of place, with every sort of dependence, and inserted ones."""
    chains, data = clean("beam_gain")
    some = [
        Effect("a", "a", "after:hwp", "diattenuation", "harmonic:derotator:1", limit=0.1),
        Effect("a", "a", "in:derotator", "retardance", "time", limit=10 * u.deg),
        Effect("a", "a", "in:hwp", "orientation", "harmonic:hwp:4", "number"),
        Effect("a", "a", "source", "depolarization_linear", "step:7", 0),
        Effect("a", "a", "detector", "gain", "harmonic:hwp:3", None),
        Effect("a", "a", "before:wollaston", ("rotation", "retardance_d"), degree=1),
        Effect.insert(optics.Diattenuator(name="a"), before="wollaston", limit=0.1),
        Effect.insert(optics.LinearRetarder(retardance=0 * u.deg, name="a"), inside="derotator"),
        Effect.insert(optics.BeamGain(name="a"), after="wollaston", degree="number"),
        Effect.insert(optics.DiattenuatorRetarder(theta=20 * u.deg, name="a"), before="wollaston"),
    ]
    film = optics.Diattenuator(theta=30 * u.deg, name="a")
    some.append(Effect.insert(film, inside="derotator", limit=0.1))
    for effect in some:
        check_effect(effect, chains, data)
        if effect.kinds:
            assert len(effect.cells(chains)) == len(effect.kinds) * (1 + effect.around)
    # sizes are by unit, and by name where they are given
    given = {"limit": {"retardance": 40 * u.deg}, "scale": {"diattenuation": 0.001}}
    for settings, expected in (
        ({}, {"diattenuation": (0.02, 0.5), "retardance": (0.02 * u.rad, 0.5 * u.rad)}),
        (given, {"diattenuation": (0.001, 0.5), "retardance": (4 * u.deg, 40 * u.deg)}),
    ):
        mirror = Effect.insert(
            optics.DiattenuatorRetarder(name="a"), before="wollaston", **settings
        )
        found = mirror.edit(chains, context_of(data)).parameters
        assert {p.name.partition(".")[2]: (p.scale, p.limit) for p in found} == expected
    # its axis is relative to that of the optic, also where that is free
    for fixed in (True, False):
        chain = chains[0].copy()
        chain["derotator"].theta, chain["derotator"].theta.fixed = 2 * u.deg, fixed
        edit = some[-1].edit([chain], context_of(data))
        assert edit.chains[0]["gap_a"].theta.value == 32
        assert [tie.offset for tie in edit.ties.values()] == [30 * u.deg] * (not fixed)
    assert not Effect("a", "a", "telescope", "rotation").applies(chains)
    assert not Effect("a", "a", "after:hwp", "rotation", "harmonic:other:1").applies(chains)


def test_registration():
    before = dict(EFFECTS)
    for one in (tinted(title=""), tinted(category="magic"), tinted(name="beam_gain"), dict):
        with pytest.raises(GapError, match=r"lacks|kind|registered|is not an Effect"):
            register_effect(one)
    assert before == EFFECTS
    try:
        one = register_effect(tinted())
        assert get_effect("test_tinted") is one
        with pytest.raises(GapError, match="another name"):
            register_effect(one)
    finally:
        EFFECTS.pop("test_tinted", None)
    with pytest.raises(GapError, match="did you mean 'beam_gain'"):
        get_effect("beam_gian")


# ---- parameters that are held, or at a bound -------------------------------------------------


def test_held_parameters_have_no_place_where_they_are_free():
    chains, _ = clean("beam_gain")
    for name in ("hwp_misalignment", "derotator_misalignment", "polarizer_misalignment"):
        assert not EFFECTS[name].applies(chains)
    for name in CASES:
        if EFFECTS[name].kind == "bound":
            assert not EFFECTS[name].applies(chains)


def test_bounds_are_lifted_on_a_copy():
    chains, data = clean("hwp_angle_bound")
    edit = EFFECTS["hwp_angle_bound"].edit(chains, context_of(data))
    assert chains[0]["hwp"].theta.bounds == (-5, 0)
    assert edit.chains[0]["hwp"].theta.bounds == (-10, 10)
    assert edit.parameters[0].name == "hwp.theta"


def test_size_of_a_held_angle_counts_from_where_it_was_held():
    chains, data = clean("polarizer_misalignment")
    edit = EFFECTS["polarizer_misalignment"].edit(chains, context_of(data))
    assert edit.parameters[0].neutral == 90 * u.deg
    assert chains[0]["calibration_polarizer"].theta.fixed
