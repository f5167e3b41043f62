# Licensed under a 3-clause BSD style license - see LICENSE
"""Places, kinds and dependences, and the derivative of the data to each cell."""

import json
from itertools import product

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from gap_setups import SETUPS

from astropolcal.exceptions import ObservationError
from astropolcal.gap.cells import Cell, Probes, dependences, places
from astropolcal.gap.effects import Effect, check_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import nominal_model
from astropolcal.gap.problem import GapProblem
from astropolcal.optics.perturbations import GENERATORS
from astropolcal.simulation import half_wave_plate_cycles

pytestmark = pytest.mark.usefixtures("own_instruments")
EPS = 1e-4


def model_of(name):
    setup = SETUPS[name]()
    return nominal_model([setup.truth], [setup.observed()])


def spread(probes):
    """Return every place with every kind, and every dependence (one step of many) among them."""
    steps = [name for name in probes.waves if name.startswith("step")]
    waves = [name for name in probes.waves if name not in steps[1:]]
    pairs = [pair for pair in probes.slopes if pair[1] in GENERATORS]
    cells = [Cell(*pair, waves[i % len(waves)]) for i, pair in enumerate(pairs)]
    detected = [key for key in probes.slopes if key[1] not in GENERATORS]
    return cells + [Cell(*key, text) for key in detected for text in probes.dependences_of(*key)]


def differences(model, cell, dataset=0):
    """Return the slope of both channels to each function of a cell, by central differences."""
    edited = model.edited((CellEffect(cell, 0), None))
    problem, (parameters,) = edited.problem, edited.added.values()
    rows = [i for p in parameters for i in range(*problem.slices[p.name].indices(problem.size))]
    for row in rows:
        ends = []
        for sign in (1, -1):
            moved = problem.start.copy()
            moved[row] += sign * EPS
            ends.append(problem.differences(moved)[dataset])
        # the gap is the observed less the predicted
        yield (ends[1] - ends[0]) / (2 * EPS)


def test_a_step_among_masked_frames_is_no_dependence():
    """It would be the same as a constant, or the fault of the few frames before it."""
    seen = data.observed()
    clouds = np.tile((np.arange(seen.n_frames) < 9)[:, None], seen.n_bins)
    model = data.fitted(seen.with_mask(clouds, "clouds"))
    probes, cell = Probes(model), Cell("after:hwp", "rotation", "step:11")
    names = [*dependences(model.problem), *(one.dependence for one in probes.steps_near(cell))]
    steps = [int(name[5:]) for name in names if name.startswith("step:")]
    assert min(steps) == 13
    assert "step:9" in dependences(data.fitted(seen).problem)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["charis", "cassegrain", "irdis lamp", "vampires"])
def test_derivative_of_every_cell_is_that_of_the_chain_with_its_optic(name):
    model = model_of(name)
    probes = Probes(model)
    cells = spread(probes)
    assert {cell.dependence.partition(":")[0] for cell in cells} >= {
        name.partition(":")[0] for name in probes.waves
    }
    for cell in cells:
        detector = cell.kind not in GENERATORS
        slope = probes.slopes[cell.place, cell.kind][0]
        found = [slope * wave for wave in probes.waves_of(cell)[0]]
        expected = list(differences(model, cell))
        assert len(found) == len(expected), cell.name
        for one, other in zip(found, expected, strict=True):
            # the size of what follows the flux is in units of a usual flux, which is a mean or not
            scale = np.sum(one * other) / np.sum(one * one) if detector else 1.0
            assert scale == pytest.approx(1, abs=0.1), cell.name
            error = np.linalg.norm(other - scale * one) / max(np.linalg.norm(other), 1.0)
            assert error < (0.01 if detector else 1e-5), cell.name


def test_what_a_detector_does_is_the_same_in_runs_of_any_flux():
    """A background of both has one size, as the optic that is fitted, however bright a lamp is."""
    model = data.fitted([data.observed(), data.observed(flux=3e6, seed=2, name="bright")])
    probes = Probes(model)
    for kind in ("background", "background_of_one_beam", "nonlinearity", "persistence"):
        (dependence, *_), scales = probes.dependences_of("detector", kind), []
        for i, slope in probes.slopes["detector", kind].items():
            (expected,) = differences(model, Cell("detector", kind, dependence), i)
            scales.append(np.sum(slope * expected) / np.sum(slope**2))
        assert scales == pytest.approx([1, 1], abs=0.02), kind


def test_places_are_met_in_the_order_of_the_light():
    expected = {
        "charis": ["source", "in:hwp", "after:hwp", "in:derotator", "after:derotator"],
        "cassegrain": ["source", "telescope", "in:hwp", "after:hwp"],
        "rotating": ["source", "in:hwp", "after:hwp", "in:rotator", "after:rotator"],
    }
    for name, names in expected.items():
        assert [place.name for place in places(SETUPS[name]().nominal)] == names, name
    for make in SETUPS.values():
        chain = make().nominal
        found = [place.name for place in places(chain)]
        assert len(set(found)) == len(found)
        # what is in front of the first optic that turns, and what stands behind the last
        assert found[0] in ("source", "telescope")
        # an optic of a cell makes no place of its own
        edited = CellEffect(Cell(found[-1], "rotation", "time")).edit([chain], make().context())
        assert [place.name for place in places(edited.chains[0])] == found


def test_only_what_data_can_tell_is_a_dependence():
    def of(observations, chains=None):
        observations = observations if isinstance(observations, list) else [observations]
        return dependences(GapProblem([data.chain()] * len(observations), observations))

    whole = of(data.observed())
    for name, waves in whole.items():
        assert name == "constant" or np.ptp(waves[0]) > 0, name
        assert waves[0].shape == (2 if name.startswith("harmonic") else 1, 32)
    steps = [name for name in whole if name.startswith("step")]
    # of 16 the first and the last would be faults of two frames
    assert len(steps) == 14
    # one plate angle and one derotator angle are no harmonics, and a short run has no steps
    table = half_wave_plate_cycles(np.zeros(6) * u.deg, [45] * u.deg)
    assert set(of(data.observed(table=table))) == {"constant", "time", "time2", "brightness"}
    # datasets of one source may differ, and are told by their names
    pair = [data.observed(name="July"), data.observed(seed=2, name="October")]
    both = of(pair)
    assert {"dataset:July", "dataset:October"} <= set(both)
    assert [float(w.mean()) for w in both["dataset:July"]] == [1.0, 0.0]
    assert not [name for name in whole if "dataset" in name]
    # what changes may do so in one of them only
    assert not both["time/dataset:July"][1].any()
    np.testing.assert_allclose(both["time/dataset:July"][0], whole["time"][0])


def test_moves_of_every_stage_are_dependences():
    setup = SETUPS["rotating"]()
    seen = setup.observed()
    chains = [setup.nominal]
    effect = Effect("e", "e", "in:rotator", "orientation", "move:rotator", "number")
    check_effect(effect, chains, [seen])
    assert {"move:hwp", "move:rotator"} <= set(dependences(GapProblem(chains, [seen])))
    moves = np.diff(seen.position("rotator"), prepend=seen.position("rotator")[:1])
    np.testing.assert_allclose(seen.position("rotator_move"), moves)
    with pytest.raises(ObservationError, match="no column 'nothing'"):
        seen.position("nothing_next")


def test_every_cell_has_a_name_and_words_of_its_own():
    cells = [
        Cell(place, kind, dependence)
        for (place, kind), dependence in product(
            Probes(data.clean_model()).slopes, ["constant", "time", "time2", "harmonic:hwp:2"]
        )
    ]
    extra = ["step:7", "frame:7", "direction:hwp", "move:derotator"]
    extra += ["dataset:July", "time/dataset:July", "time/dataset:October"]
    cells += [Cell("in:hwp", "rotation", dependence) for dependence in extra]
    assert len({cell.title for cell in cells}) == len(cells)
    # whatever numbers its frames have
    step = Cell("in:hwp", "diattenuation_h", "step:11")
    assert step.title.endswith("that changes at the 12th frame of the table")
    for cell in cells:
        again = Cell(**json.loads(json.dumps(cell.to_dict())))
        # to machines an optic that is turned is a rotation in its frame, as to the names of those
        if cell.kind in ("orientation", "nonlinearity_of_right_beam", "nonlinearity_of_left_beam"):
            assert again.kind in ("rotation", "nonlinearity")
            assert again.title
        else:
            assert (again, again.name) == (cell, cell.name)
        assert 0 < cell.scale < 1
        assert cell.optic in (None, "hwp", "derotator")
