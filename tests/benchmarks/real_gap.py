# Licensed under a 3-clause BSD style license - see LICENSE
"""
The gap of the real SCExAO/CHARIS: all numbers of docs/real_gap.rst.

``python tests/benchmarks/real_gap.py DATA docs`` diagnoses the published runs in the folder DATA,
writes ``real_gap.json`` and the tables of the page, ``real_gap_*.csv``. Cases may be named behind
the folders, to do these again only; the others keep what is in the file. With ``--tables`` nothing
is diagnosed, and the tables are written anew.
"""

import argparse
import csv
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from astropolcal import instruments
from astropolcal.chain import leaves, remove_optic
from astropolcal.files import atomic_path
from astropolcal.gap import diagnose
from astropolcal.gap.alternatives import thinned
from astropolcal.gap.effects import get_effect
from astropolcal.gap.report import to_dict
from astropolcal.gap.shrinkage import foreseen, frame_groups
from astropolcal.observations import Observations

CHARIS = instruments.get("charis")
RUNS = {
    1: "dataset1_polarized_2025-07-15",
    3: "dataset3_polarized_2025-10-05",
    4: "dataset4_unpolarized_2025-10-05",
}
"""File of each dataset of McIntosh et al. (2026)."""
_HALVES = {"even": 0, "odd": 1}
# so many wavelengths are enough for an effect that was withheld
_FEW = 8
# titles and cells of so many aliases are kept
_ALIASES = 5


def read(folder, *numbers, half=None):
    """Return datasets, of every other wavelength if a half is wanted."""
    tables = [Observations.read(Path(folder) / f"{RUNS[number]}.ecsv") for number in numbers]
    if half is None:
        return tables
    return [o.select_bins(np.arange(o.n_bins) % 2 == _HALVES[half]) for o in tables]


def gaps(diagnosis):
    """Return the gap of the paper's model, and of that with unequal gains of the beams, in %."""
    nominal = diagnosis.nominal
    groups = frame_groups(nominal.observations)
    # one gain a wavelength: no smooth law describes it
    bins = replace(nominal.context, degree=None)
    gains = nominal.with_effect(get_effect("beam_gain"), bins)
    return {"nominal": foreseen(nominal, groups).percent, "gains": foreseen(gains, groups).percent}


# ---- cases ---------------------------------------------------------------------------------------


def one_run(folder, number):
    """A run as it is."""
    data = read(folder, number)
    found = diagnose(CHARIS.chains_for(data), data)
    return summarized(found) | {"left_out_percent": gaps(found) | {"causes": _after(found)}}


def nested(folder, number):
    """A run whose causes are chosen anew without each angle that is left out: takes minutes."""
    data = read(folder, number)
    found = diagnose(CHARIS.chains_for(data), data, nested=True)
    by_angle = 100 * np.sqrt(found.nested.squares / found.nested.counts)
    angles = dict(zip(found.nested.labels, by_angle.tolist(), strict=True))
    return {"nested_percent": found.nested.percent, "by_angle_percent": angles}


def both_runs(folder):
    """Datasets 1 and 3 at once."""
    data = read(folder, 1, 3)
    found = diagnose(CHARIS.chains_for(data), data)
    runs = [_of_run(found, i) for i in range(len(data))]
    return summarized(found) | {"left_out_percent": {"causes": _after(found), "runs": runs}}


def half_of(folder, number, half):
    """Every other wavelength of a run."""
    data = read(folder, number, half=half)
    return summarized(diagnose(CHARIS.chains_for(data), data))


def without(folder, number, optic, count=22):
    """A run whose model lacks an optic."""
    data = read(folder, number)
    chains = [remove_optic(chain, optic) for chain in CHARIS.chains_for(data)]
    return summarized(diagnose(*thinned(chains, data, count)))


def linear(folder, number):
    """A run whose derotator is a linear retarder, all orientations held at zero."""
    data = read(folder, number)
    chains = CHARIS.chains_for(data, derotator="linear")
    for chain in chains:
        for leaf in leaves(chain):
            leaf.theta.fixed = True
    return summarized(diagnose(*thinned(chains, data, _FEW)))


CASES = {
    "dataset 1": lambda folder: one_run(folder, 1),
    "dataset 3": lambda folder: one_run(folder, 3),
    "dataset 3 even": lambda folder: half_of(folder, 3, "even"),
    "dataset 3 odd": lambda folder: half_of(folder, 3, "odd"),
    "dataset 1 even": lambda folder: half_of(folder, 1, "even"),
    "dataset 1 odd": lambda folder: half_of(folder, 1, "odd"),
    "datasets 1 and 3": both_runs,
    "dataset 1 nested": lambda folder: nested(folder, 1),
    "dataset 3 nested": lambda folder: nested(folder, 3),
    "dataset 3 without the beam switcher": lambda folder: without(folder, 3, "nbs"),
    "dataset 3 with a linear derotator": lambda folder: linear(folder, 3),
    "dataset 1 with a linear derotator": lambda folder: linear(folder, 1),
    "dataset 4 without the fold mirror": lambda folder: without(folder, 4, "fold_mirror", _FEW),
}
"""What is diagnosed, by name."""


# ---- what is kept ------------------------------------------------------------------------------


def _after(diagnosis):
    return diagnosis.held_out[-1].percent if diagnosis.held_out else None


def _of_run(diagnosis, i):
    """Return the gap of one of several runs, with all causes, in percent."""
    labels, numbers = frame_groups(diagnosis.improved.observations)
    # nothing of the other runs is left out, so that nothing of them is counted
    numbers = [one if k == i else np.full_like(one, -1) for k, one in enumerate(numbers)]
    return foreseen(diagnosis.improved, (labels, numbers)).percent


def summarized(diagnosis):
    """Return what of a diagnosis the page needs, ready for JSON."""
    content = to_dict(diagnosis)
    keys = (
        "verdict", "double_difference", "gap_before_percent", "gap_after_percent",
        "noise_floor_percent", "shrinkage_percent", "gap_p_value", "remainder_p_value",
        "unlisted_probability", "left_share", "frames", "sentences", "n_data",
    )  # fmt: skip
    kept = {key: content[key] for key in keys}
    kept["causes"] = [_cause(cause) for cause in content["causes"]]
    kept["changes"] = [change["words"] for change in content["changes"]]
    kept["next"] = [one["words"] for one in content["next_observations"]]
    kept["where_left"] = content["where_left"]
    return kept


def _cause(cause):
    keys = (
        "name", "title", "effect", "cell", "probability", "share", "explained", "stability",
        "significance", "physical", "double_difference_share", "evidence_by_dataset",
    )  # fmt: skip
    group = [cause, *cause["aliases"]]
    return {key: cause[key] for key in keys} | {
        "aliases": [
            {key: one[key] for key in ("name", "title", "probability")}
            for one in cause["aliases"][:_ALIASES]
        ],
        "places": sorted({place_of(one) for one in group}),
        "left_out_after_percent": cause["left_out_after_percent"],
    }


def place_of(entry):
    """Return place and kind of a cause or alias; what is no single cell is its own."""
    cell = entry["cell"]
    return f"{cell['place']}/{cell['kind']}" if cell else f"{entry['name']}/"


def jaccard(causes, others, kinds=True):
    """
    Return the share of causes that two answers have in common.

    Two causes agree where their groups of aliases share a place and kind, or a place.
    """
    groups = [[set(one["places"]) for one in part] for part in (causes, others)]
    if not kinds:
        groups = [[{text.partition("/")[0] for text in g} for g in part] for part in groups]
    table = np.array([[bool(a & b) for b in groups[1]] for a in groups[0]], dtype=float)
    if not table.size:
        return float(len(causes) == len(others))
    # each cause has one counterpart at most
    common = table[linear_sum_assignment(table, maximize=True)].sum()
    return float(common / (len(causes) + len(others) - common))


# ---- tables of the page ------------------------------------------------------------------------


def write_tables(cases, folder):
    """Write what the page shows, once both runs are known."""
    if not {"dataset 1", "dataset 3"} <= cases.keys():
        return
    for name, rows in (
        ("runs", _runs(cases)),
        ("together", _together(cases)),
        ("causes", _causes(cases)),
        ("halves", _halves(cases)),
        ("withheld", _withheld(cases)),
    ):
        with atomic_path(Path(folder) / f"real_gap_{name}.csv") as new:
            with new.open("w", encoding="utf-8", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows(rows)


def _runs(cases):
    runs = [cases[name] for name in ("dataset 1", "dataset 3")]
    left, double = ([run[key] for run in runs] for key in ("left_out_percent", "double_difference"))
    lines = {
        "Single differences, paper's model": [one["nominal"] for one in left],
        "with unequal gains of the beams": [one["gains"] for one in left],
        "with all causes": [one["causes"] for one in left],
        "with all causes, chosen without the angle left out": [
            cases.get(f"{name} nested", {}).get("nested_percent")
            for name in ("dataset 1", "dataset 3")
        ],
        "noise": [run["noise_floor_percent"] for run in runs],
        "Double differences, paper's model": [one["before_percent"] for one in double],
        "with all causes, their sizes held": [one["after_percent"] for one in double],
        "noise of these": [one["noise_percent"] for one in double],
    }
    yield ["Error on left-out angles (percent)", "Dataset 1", "Dataset 3"]
    yield from ([text, *map(_number, values)] for text, values in lines.items())


def _together(cases):
    yield ["", "Dataset 1", "Dataset 3"]
    apart = [cases[name]["left_out_percent"]["causes"] for name in ("dataset 1", "dataset 3")]
    yield ["each run alone (percent)", *map(_number, apart)]
    if "datasets 1 and 3" in cases:
        runs = cases["datasets 1 and 3"]["left_out_percent"]["runs"]
        yield ["both at once (percent)", *map(_number, runs)]


def _causes(cases):
    yield ["Run", "Cause", "Probability", "Stability", "Explained", "Not distinguished from it"]
    for name in ("dataset 1", "dataset 3"):
        for cause in cases[name]["causes"]:
            # a name and the cell that it is are the same
            own = "/".join(cause["cell"].values()) if cause["cell"] else None
            others = [one["title"] for one in cause["aliases"] if one["name"] != own][:2]
            shares = [_share(cause[key]) for key in ("probability", "stability", "explained")]
            yield [name.split()[1], cause["title"], *shares, "; ".join(others) or "\N{EN DASH}"]


def _halves(cases):
    yield ["Run", "Causes, even", "Causes, odd", "Same place and kind", "Same place"]
    for name in ("dataset 1", "dataset 3"):
        halves = [cases.get(f"{name} {half}") for half in _HALVES]
        if None not in halves:
            found = [half["causes"] for half in halves]
            common = [jaccard(*found), jaccard(*found, kinds=False)]
            yield [name.capitalize(), *map(len, found), *(f"{value:.2f}" for value in common)]


def _withheld(cases):
    yield ["Model", "Verdict", "First cause", "Explained", "Before (percent)", "After (percent)"]
    for name, case in cases.items():
        if " with" not in name:
            continue
        first = [case["causes"][0]["title"], _share(case["causes"][0]["explained"])]
        gap = [_number(case[f"gap_{when}_percent"]) for when in ("before", "after")]
        yield [name.capitalize(), case["verdict"], *first, *gap]


def _number(value):
    return "\N{EN DASH}" if value is None else f"{value:.3f}" if value < 1 else f"{value:.2f}"


def _share(value):
    if value is None:
        return "\N{EN DASH}"
    if value < 0.001:
        return "< 0.1 %"
    return f"{100 * value:.0f} %" if value >= 0.01 else f"{100 * value:.1f} %"


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", nargs="*", help=f"default: all of {', '.join(CASES)}")
    parser.add_argument("--tables", action="store_true", help="write no more than the tables")
    arguments = parser.parse_args()
    path = arguments.folder / "real_gap.json"
    if arguments.tables:
        write_tables(json.loads(path.read_text(encoding="utf-8")), arguments.folder)
        return
    for name in arguments.cases or CASES:
        started = time.process_time()
        case = CASES[name](arguments.data)
        case["cpu_seconds"] = round(time.process_time() - started, 1)
        known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        known[name] = rounded(case)
        ordered = {key: known[key] for key in CASES if key in known}
        with atomic_path(path) as new:
            text = json.dumps(ordered, indent=1, ensure_ascii=False)
            new.write_text(f"{text}\n", encoding="utf-8")
        write_tables(ordered, arguments.folder)
        print(f"{name}: {case.get('verdict')}, {case['cpu_seconds']} s", flush=True)


def rounded(value):
    """Return the same with six digits, so that the file does not change with the last bits."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
