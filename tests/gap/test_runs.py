# Licensed under a 3-clause BSD style license - see LICENSE
"""Several runs of the same kind of source in one diagnosis, and what changed between them."""

import json
from types import SimpleNamespace

import astropy.units as u
import gap_data as data
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.chain import insert_optic, join, leaves
from astropolcal.exceptions import GapError, ParameterError
from astropolcal.gap import diagnose
from astropolcal.gap.cells import Cell, Probes, dependences
from astropolcal.gap.effects import Context
from astropolcal.gap.effects.effect import CellEffect, label_of
from astropolcal.gap.report import summary, to_dict
from astropolcal.gap.runs import changes, distinct, paragraph
from astropolcal.observations import Observations
from astropolcal.optics import LinearRetarder, Perturbation
from astropolcal.optics.perturbations import Dependence
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles

JULY, OCTOBER = "July: 15", "October 5"


def with_cell(*cells, chain=None):
    """Return a chain with cells of certain sizes, each (place, kind, dependence, size)."""
    chains = [data.chain() if chain is None else chain]
    for *cell, size in cells:
        edit = CellEffect(Cell(*cell)).edit(chains, Context(data.WAVELENGTH.to_value(u.um)))
        chains = edit.chains
        for parameter in edit.parameters:
            optic, key = parameter.name.split(".")
            one = next(leaf for leaf in leaves(chains[0]) if leaf.name == optic)
            target = getattr(one, key)
            target.value = np.full(np.shape(target.value), size)
    return join(leaves(chains[0]))


def pair(first=(), second=(), names=(JULY, OCTOBER)):
    return [
        data.observed(with_cell(*cells), seed=seed, name=name)
        for seed, (cells, name) in enumerate(zip((first, second), names, strict=True), 3)
    ]


GAIN = ("detector", "gain", "constant", 0.01)
# so small that no sign is looked for that may be wrong, which takes half of the time
BEHIND = ("after:derotator", "retardance_d", "constant", 0.03)


# ---- wavelengths of their own ------------------------------------------------------------------


@pytest.mark.long
def test_a_fault_of_one_of_two_runs_at_other_wavelengths():
    one, other = np.arange(7) == 1, np.arange(7) == 4
    first, second = pair([], [BEHIND])
    exchanged = pair()[1].to_table()
    exchanged.rename_columns(["flux_right", "flux_left"], ["other", "flux_right"])
    exchanged.rename_column("other", "flux_left")
    exchanged = Observations.from_table(exchanged, name=OCTOBER)
    nominal = data.chain(data.WAVELENGTH[one | other])
    for run, name in [
        (second, "after:derotator/retardance_d/dataset:October 5"),
        (exchanged, "beams_swapped/dataset:October 5"),
    ]:
        runs = [first.select_bins(one), run.select_bins(other)]
        (cause,) = diagnose([nominal] * 2, runs).causes
        assert cause.name == name


# ---- what changed ------------------------------------------------------------------------------


@pytest.mark.long
def test_a_stage_with_another_zero_is_one_change():
    for role, optic, flux in (("hwp", "hwp", 1e6), ("polarizer", "calibration_polarizer", 1e8)):
        second = data.chain()
        second[optic].theta = second[optic].theta.quantity + 0.4 * u.deg
        runs = [
            data.observed(true, seed=i, name=name, flux=flux)
            for i, (true, name) in enumerate([(data.chain(), JULY), (second, OCTOBER)])
        ]
        found = diagnose(data.chain(), runs, changes=True)
        assert [cause.name for cause in found.causes] == [f"{role}_zero/dataset:{OCTOBER}"]
        (change,) = to_dict(found)["changes"]
        name = {"hwp": "half-wave plate", "polarizer": "calibration polarizer"}[role]
        assert f"the zero of the angle of the {name} changed by 0." in change["words"]
        (size,) = change["size"].values()
        assert np.allclose(size["value"], 0.4, atol=0.02)


@pytest.mark.long
def test_an_optic_of_any_axis_that_one_run_has_is_one_change():
    # of the second one the derivatives alone say that it depends on the wavelength
    for run, size, theta in ((OCTOBER, 1.6, 100), (JULY, 2.2, 92)):
        film = LinearRetarder(retardance=size * u.deg, theta=theta * u.deg, name="film")
        chains = {name: data.chain() for name in (JULY, OCTOBER)}
        chains[run] = insert_optic(chains[run], film, after="hwp")
        runs = [data.observed(chains[JULY], seed=3, name=JULY)]
        runs.append(data.observed(chains[OCTOBER], name=OCTOBER))
        found = diagnose(data.chain(), runs, changes=True, cross_validate=False)
        assert [cause.name for cause in found.causes] == [f"static_retarder:hwp/dataset:{run}"]
        (change,) = to_dict(found)["changes"]
        assert change["words"].startswith(
            f'In "{run}" only there is a retarder that is static downstream of the half-wave plate'
        )
        assert change["cell"]["place"] == "after:hwp"


@pytest.mark.slow
def test_a_change_is_found_with_its_run_cell_and_size():
    found = diagnose(data.chain(), pair([GAIN], [GAIN, BEHIND]), changes=True)
    content = to_dict(found)
    first, *others = content["changes"]
    assert not others
    assert {key: first["cell"][key] for key in ("place", "kind")} == {
        "place": "after:derotator",
        "kind": "retardance_d",
    }
    assert first["dataset"] in (JULY, OCTOBER)
    assert first["cell"]["dependence"] == f"dataset:{first['dataset']}"
    assert first["probability"] > 0.9
    (size,) = first["size"].values()
    sign = 1 if first["dataset"] == OCTOBER else -1
    assert size["unit"] == "deg"
    np.testing.assert_allclose(np.deg2rad(sign * np.array(size["value"])), 0.03, atol=0.006)
    assert first["brought_by"] == []
    told = "the retardance at 45 deg to the axes downstream of the derotator changed by 1.7"
    assert first["words"].startswith(f'Between "{JULY}" and "{OCTOBER}" {told}')
    # the opposite change of the other run is the same one
    assert first["words"].endswith("(probability 97 %).")
    assert first["words"] in content["sentences"]
    assert "1.7" in summary(found)
    json.dumps(content)
    # before the cause that both share, for which each run by itself asks
    assert found.causes[0].cell.run in (JULY, OCTOBER)
    assert {"beam_gain", "detector/gain/constant"} & {cause.name for cause in found.causes[1:]}
    assert all(cause.cell.run is None for cause in found.causes[1:])
    shared = next(c for c in content["causes"] if "gain" in c["name"])
    assert set(shared["evidence_by_dataset"]) == {JULY, OCTOBER}
    assert min(shared["evidence_by_dataset"].values()) > 20
    own = next(c for c in content["causes"] if "retardance" in c["name"])
    assert own["evidence_by_dataset"] == {}


@pytest.mark.long
def test_a_change_that_others_look_like_is_not_told_as_sure():
    turned = ("source", "rotation", "constant", np.deg2rad(0.1))
    content = to_dict(diagnose(data.chain(), pair([], [turned]), changes=True))
    (change,) = content["changes"]
    named = [
        name for name in ("half-wave plate", "calibration polarizer") if name in change["words"]
    ]
    assert len(named) == 2
    assert "(probability 99 % of this or what looks the same, such as zero of" in change["words"]


def test_which_of_three_runs_changed_is_not_told_as_sure_where_two_may_have():
    cell = {"place": "after:derotator", "kind": "retardance_d", "dependence": "dataset:a"}
    alias = {"cell": cell | {"dependence": "dataset:b"}, "probability": 0.48, "effect": None}
    alias |= {"name": "after:derotator/retardance_d/dataset:b", "title": "that of b"}
    cause = alias | {"cell": cell, "share": 0.5, "aliases": [alias], "size": {}}
    cause |= {"name": alias["name"][:-1] + "a", "probability": 0.97, "significance": 5.0}
    like = "97 % of this or what looks the same, such as that of b (48 %))."
    for names, end in (("ab", "97 %)."), ("abc", like)):
        model = data.fitted([data.observed(name=name) for name in names])
        (change,) = changes(SimpleNamespace(improved=model), [cause])
        assert change["words"].endswith(end)


def test_a_mistake_in_the_table_of_one_run_is_a_change():
    model = data.fitted([data.observed(name=name) for name in "ab"])
    cause = {"name": "beams_swapped/dataset:b", "title": 'beams exchanged in "b" only'}
    cause |= {"cell": None, "aliases": [], "size": {}, "share": 1.0}
    cause |= {"probability": 0.99, "significance": None}
    found = changes(SimpleNamespace(improved=model), [cause, cause | {"name": "mirror_flip"}])
    assert [(one["dataset"], one["cell"], one["brought_by"]) for one in found] == [("b", None, [])]
    (words,) = paragraph({"changes": found, "verdict": "named"}, "ab", asked=True)
    assert words == 'What changed: beams exchanged in "b" only (probability 99 %).'


@pytest.mark.slow
def test_what_both_runs_lack_is_no_change():
    found = diagnose(data.chain(), pair([GAIN], [GAIN]))
    assert [cause.name for cause in found.causes] == ["beam_gain"]
    content = to_dict(found)
    assert content["changes"] == []
    assert not any("changed" in line for line in content["sentences"])


def test_nothing_changed_is_said_where_it_was_asked():
    found = diagnose(data.chain(), pair(), changes=True)
    assert found.verdict == "none"
    line = f'Nothing changed between "{JULY}" and "{OCTOBER}" that the data can tell.'
    assert to_dict(found)["sentences"][-1] == line
    assert "Nothing changed between" in summary(found)


@pytest.mark.long
def test_a_gain_is_told_as_the_difference_of_the_beams():
    runs = pair()
    runs[1] = data.with_flux(runs[1], np.full(runs[1].n_frames, 1.02))
    found = diagnose(data.chain(), runs, changes=True, cross_validate=False)
    (change,) = to_dict(found)["changes"]
    assert (
        "the gain of one beam against the other at the detector changed by 2.0" in change["words"]
    )
    assert "size (half the difference of the beams): " in summary(found)


def test_of_a_gap_without_a_cause_it_is_not_said_that_nothing_changed():
    content = {"changes": [], "verdict": "unexplained"}
    assert "is not known" in paragraph(content, (JULY, OCTOBER), asked=True)[0]
    assert paragraph(content, (JULY, OCTOBER)) == []


@pytest.mark.long
def test_one_of_three_runs_differs():
    runs = [*pair(names=("a", "b")), data.observed(with_cell(BEHIND), seed=9, name="c")]
    content = to_dict(diagnose(data.chain(), runs, changes=True))
    (one,) = content["changes"]
    assert one["dataset"] == "c"
    assert one["cell"] == {
        "place": "after:derotator",
        "kind": "retardance_d",
        "dependence": "dataset:c",
    }
    assert (
        'In "c" the retardance at 45 deg to the axes downstream of the derotator differs'
        in one["words"]
    )


@pytest.mark.long
def test_a_gain_of_one_run_that_drifts():
    drift = ("detector", "gain", "harmonic:derotator:1", 0.01)
    found = diagnose(data.chain(), pair([], [drift]), changes=True)
    content = to_dict(found)
    assert {one["dataset"] for one in content["changes"]} == {OCTOBER}
    one = content["changes"][0]["cell"]
    assert (one["place"], one["kind"]) == ("detector", "gain")
    assert one["dependence"].endswith(f"/dataset:{OCTOBER}")
    assert found.remainder_p_value > 1e-4


@pytest.mark.long
def test_an_angle_that_differs_is_told_where_no_cause_is_sure():
    """Plates that reach no angle exactly hide the cause, and not what the runs differ in."""
    few, runs = data.WAVELENGTH[::3], []
    for seed, move in enumerate((0.0, 2.0)):
        true, frames = data.chain(few), data.frames()
        true["derotator"].theta.value += move
        errors = np.random.default_rng(seed).normal(0, 0.3, len(frames))
        frames["hwp"] += errors * u.deg
        table = data.observed(true, seed=seed, table=frames, wavelength=few).to_table()
        table["hwp"] = np.repeat(data.frames()["hwp"], len(few))
        runs.append(Observations.from_table(table, name=f"run {seed}"))
    found = diagnose(data.chain(few), runs, changes=True, cross_validate=False)
    assert found.verdict == "unexplained"
    words = "derotator.theta differs in run 1 by +2 deg"
    assert any(words in sentence for sentence in to_dict(found)["sentences"])


@pytest.mark.long
def test_what_an_optic_of_one_run_brought():
    parts = list(leaves(data.chain()))
    dichroic = LinearRetarder(name="dichroic", fixed={"retardance": True})
    nominal = [data.chain(), join([*parts[:-1], dichroic, parts[-1]])]
    true = nominal[1].copy()
    true["dichroic"].retardance, true["dichroic"].theta = 4 * u.deg, 45 * u.deg
    runs = [data.observed(name="out"), data.observed(true, seed=4, name="in")]
    content = to_dict(diagnose(nominal, runs, changes=True))
    one = content["changes"][0]
    assert one["brought_by"] == ["dichroic"]
    assert one["cell"]["kind"] == "retardance_d"
    assert "only one run has (dichroic)" in content["sentences"][-1]


@pytest.mark.long
def test_steps_in_one_of_two_runs_are_no_harmonic_of_a_stage():
    """They look like one; a course in that run does better, and has its steps."""
    first, table = (
        data.observed(seed=3, name=JULY),
        data.observed(seed=4, name=OCTOBER).to_table(),
    )
    grown = 1 + 0.01 * ((table["frame"] > 8).astype(float) + (table["frame"] > 20))
    table["flux_right"] *= grown
    second = Observations.from_table(table, name=OCTOBER)
    found = diagnose(data.chain(), [first, second], cross_validate=False)
    assert max(cause.probability for cause in found.causes) < 0.5
    assert found.courses[0].shape == f'with steps at frames 9 and 21 of "{OCTOBER}"'
    assert "gain" in found.courses[0].kind


# ---- parts -------------------------------------------------------------------------------------


def test_a_dependence_in_one_run():
    for name in ["July", "with space", "a:b", "a/dataset:b", "x/y:own"]:
        assert Dependence(f"dataset:{name}").run == name
        both = Dependence(f"harmonic:hwp:2/dataset:{name.replace('/dataset', '')}")
        assert (both.kind, both.driver, both.count) == ("harmonic", "hwp", 2)
        assert both.run == name.replace("/dataset", "")
        with pytest.raises(ParameterError, match="also with /dataset:NAME"):
            Dependence(f"sometimes/dataset:{name}")


def test_labels_of_runs_are_told_apart():
    names = [f"in:hwp/rotation/dataset:{name}" for name in ("a b", "a:b", "a_b", "a.b")]
    labels = [label_of(name) for name in names]
    assert len(set(labels)) == len(labels)
    assert all(label.isidentifier() for label in labels)


def test_cells_of_runs_are_put_into_their_chains_only():
    chains = [data.chain(), data.chain()]
    context = Context(data.WAVELENGTH.to_value(u.um), datasets=(JULY, OCTOBER))
    for kind in ("rotation", "gain", "background", "persistence"):
        place = "detector" if kind != "rotation" else "in:hwp"
        edit = CellEffect(Cell(place, kind, f"dataset:{OCTOBER}")).edit(chains, context)
        added = [sum(o.name.startswith("gap_") for o in leaves(c)) for c in edit.chains]
        assert added[0] == 0 < added[1]
        assert len(edit.parameters) == 1


def test_probes_have_every_dependence_in_each_run():
    model = data.fitted(pair())
    waves = dependences(model.problem)
    assert f"dataset:{JULY}" in waves
    assert f"time/dataset:{OCTOBER}" in waves
    assert not any(name.startswith("step") and "dataset" not in name for name in waves)
    np.testing.assert_array_equal(waves[f"time/dataset:{OCTOBER}"][0], 0)
    assert np.ptp(waves[f"time/dataset:{OCTOBER}"][1]) == pytest.approx(2)
    probes = Probes(model)
    assert f"dataset:{JULY}" in probes.dependences_of("detector", "background")
    assert probes.run_of(Cell("in:hwp", "rotation", f"dataset:{JULY}")) == JULY
    assert probes.run_of(Cell("in:hwp", "rotation", "time")) is None


def test_one_run_has_no_cells_of_its_own():
    waves = dependences(data.clean_model().problem)
    assert not any("dataset:" in name for name in waves)


def test_the_derivative_of_a_cell_in_one_run_is_that_of_its_optic():
    model = data.fitted(pair())
    probes = Probes(model)
    cell = Cell("in:derotator", "retardance_h", f"time/dataset:{OCTOBER}")
    edited = model.edited((CellEffect(cell, 0), None))
    problem, (parameters,) = edited.problem, edited.added.values()
    where = problem.slices[parameters[0].name]
    slope = problem.jacobian(problem.start)[:, where][:, 0]
    cut = problem.segments[0].stop
    np.testing.assert_array_equal(slope[:cut], 0)
    wave = probes.waves_of(cell)[1]
    white = problem.channels[1].whiten(probes.slopes[cell.place, cell.kind][1] * wave[0])
    np.testing.assert_allclose(slope[cut:], white.ravel(), atol=1e-6 * np.abs(slope).max())


def test_a_perturbation_keeps_its_run():
    one = Perturbation(kind="rotation", dependence=f"time/dataset:{JULY}", name="x")
    assert one.copy().dependence == f"time/dataset:{JULY}"
    assert one.mount == "sequence"


def two_runs(*tables, flux=1e6):
    """Return a run of July and one of October, with three faults each."""
    planted = {
        JULY: [
            ("detector", "gain", "constant", 0.02),
            ("after:derotator", "retardance_d", "constant", 0.1),
            ("after:hwp", "retardance_h", "harmonic:derotator:1", 0.05),
        ],
        OCTOBER: [
            ("detector", "gain", "harmonic:derotator:1", -0.02),
            ("in:hwp", "retardance_d", "harmonic:hwp:1", 0.05),
            ("in:derotator", "rotation", "harmonic:derotator:2", 0.02),
        ],
    }
    runs = []
    for seed, (name, cells) in enumerate(planted.items(), 3):
        chain = instruments.get("charis").chain(wavelength=data.WAVELENGTH)
        if name == OCTOBER:
            # what the nominal model has for both runs together is not the same either
            derotator = next(leaf for leaf in leaves(chain) if leaf.name == "derotator")
            rng = np.random.default_rng(2)
            for key in ("horizontal", "circular"):
                parameter = getattr(derotator, key)
                parameter.value = parameter.value + rng.normal(0, 3, 7)
        options = {"name": name, "flux": flux, "table": tables[seed - 3] if tables else None}
        runs.append(data.observed(with_cell(*cells, chain=chain), seed=seed, **options))
    return runs


@pytest.mark.long
def test_runs_of_two_derotator_angles_each_are_described_together():
    """By itself neither has enough of them to leave one out."""
    angles = [45, 70] * u.deg, [95, 120] * u.deg
    plate = [0, 22.5, 45, 67.5] * u.deg
    runs = two_runs(*(half_wave_plate_cycles(plate, derotator=a) for a in angles), flux=1e10)
    found = diagnose(instruments.get("charis").chain(wavelength=data.WAVELENGTH), runs)
    assert found.verdict == "unexplained"
    assert found.improved.mean_square < 0.1 * found.nominal.mean_square
    assert len(found.causes) > 4


@pytest.mark.long
def test_two_runs_are_described_together_as_well_as_apart():
    runs = two_runs()
    nominal = instruments.get("charis").chain(wavelength=data.WAVELENGTH)
    apart = [diagnose(nominal, run).gap_after_percent for run in runs]
    found = diagnose(nominal, runs)
    assert found.gap_after_percent < 1.2 * np.sqrt(np.mean(np.square(apart)))
    assert 0.8 < found.improved.mean_square < 1.2
    names = {cause.name for cause in found.causes}
    assert {
        f"in:derotator/{kind}/dataset:{OCTOBER}" for kind in ("retardance_h", "rotation")
    } <= names
    # so many causes are no names
    assert found.verdict == "unexplained"
    assert max(cause.probability for cause in found.causes) < 0.1


def test_words_of_a_change_that_is_doubtful():
    found = {"words": "A.", "probability": 0.1, "brought_by": ["dichroic"]}
    words = paragraph({"changes": [found] * 6}, [JULY, OCTOBER])
    assert words[:4] == ["A."] * 4
    assert words[4] == "2 smaller changes are listed below."
    assert "need not be the true ones" in words[5]
    assert words[6].startswith("6 of the changes are at or downstream of what only one run has")


def test_a_single_run_has_no_changes():
    found = diagnose(data.chain(), data.observed())
    assert to_dict(found)["changes"] == []
    assert changes(found, [{}]) == []


# ---- bad input ---------------------------------------------------------------------------------


def test_one_run_has_nothing_to_compare():
    with pytest.raises(
        GapError, match=r"same kind of source only; given: lamp \(no source stated\)"
    ):
        diagnose(data.chain(), data.observed(), changes=True)


def test_the_same_data_twice():
    run = data.observed()
    again = data.observed(name="copy")
    with pytest.raises(GapError, match="the same data are given twice: lamp and copy"):
        diagnose(data.chain(), [run, again])


def test_runs_of_different_instruments():
    runs = pair()
    runs[0].meta["instrument"] = "CHARIS"
    runs[1].meta["instrument"] = "IRDIS"
    with pytest.raises(GapError, match="datasets are of different instruments: CHARIS and IRDIS"):
        diagnose(data.chain(), runs, changes=True)


def test_changes_need_cells():
    with pytest.raises(GapError, match="found by cells"):
        diagnose(data.chain(), pair(), changes=True, cells=False)


def test_runs_of_one_name_get_names_of_their_own():
    runs = distinct(pair(names=("a", "a")))
    assert [run.name for run in runs] == ["a", "a (2)"]


# ---- command line ------------------------------------------------------------------------------


@pytest.fixture
def tables(tmp_path):
    meta = {"instrument": "CHARIS", "source": "polarized", "yjh50_dichroic": "out",
            "nasmyth_beam_switcher": "not installed"}  # fmt: skip
    true = (with_cell(GAIN), with_cell(GAIN, BEHIND))
    found = []
    for seed, (chain, name) in enumerate(zip(true, ("july", "october"), strict=True), 3):
        found.append(tmp_path / f"{name}.ecsv")
        data.observed(chain, seed=seed, meta=meta).write(found[-1])
    return found


@pytest.mark.long
def test_changes_on_the_command_line(tables, tmp_path, capsys):
    out = tmp_path / "out.json"
    options = ["--derotator", "linear", "--changes", "-q", "--json", str(out)]
    assert main(["diagnose", *map(str, tables), *options]) == 0
    (one,) = json.loads(out.read_text())["changes"]
    assert one["dataset"] in ("july", "october")
    assert one["cell"]["place"] == "after:derotator"


def test_bad_input_on_the_command_line(tables, capsys):
    for which, words in [([0], "july (polarized)"), ([0, 0], "holds the same frames as")]:
        files = [str(tables[i]) for i in which]
        assert main(["diagnose", *files, "--changes", "-q"]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line
