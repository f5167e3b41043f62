# Licensed under a 3-clause BSD style license - see LICENSE
"""
Challenges, which ask whether a diagnosis is right where the truth is known.

A challenge is a simulated calibration of an instrument with a fault in it, or none. A diagnosis
sees the data and the nominal chains; the key stays sealed until it has answered. Cases can be
written to files and the answers of any tool can be scored.
"""

import json
from contextlib import closing
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.stats import binom_conf_interval
from astropy.table import QTable

from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.files import append_line, atomic_path, read_lines, understood
from astropolcal.gap._bench import DETECTOR, Bench, Fault, Setup
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.effects import EFFECTS, get_effect
from astropolcal.pipeline.tasks import ended_tasks
from astropolcal.progress import shown, steps
from astropolcal.units import check_seed
from astropolcal.words import check_choice, counted

__all__ = ["ChallengeResult", "make_challenge", "run_challenge", "score_answer"]

#: Kinds of challenges, and how often each is drawn where nothing else is asked for.
KINDS = {
    "none": 0.15,
    "cell": 0.3,
    "listed": 0.15,
    "pair": 0.1,
    "detector": 0.1,
    "frame": 0.08,
    "mechanism": 0.08,
    "absorbed": 0.04,
}
# a fault of a pair is drawn at most so many times until it can be seen
_DRAWS = 20
#: A fault whose signal-to-noise ratio stays below this cannot be seen.
_INVISIBLE = 3.0
# what a right answer carries of the signal, and what a wrong one does not
_ENOUGH, _HALF = 0.9, 0.5
# a step this many frames from another one is the same
_STEP = 4
#: What an answer may be; what is wrong is confidently wrong.
RESULTS = ("right", "silent", "wrong")
_WORDS = {"right": "right", "silent": "silent", "wrong": "confidently wrong"}
_SNR_EDGES = np.array([0, 3, 10, 20, 40, 80, np.inf])
_EDGES = np.array([0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1])


def make_challenge(seed, *, kind="cell", snr=30.0, setup=None, fault=None):
    """
    Make a challenge.

    Parameters
    ----------
    seed : int or `~numpy.random.SeedSequence`
        Seed of everything that is random.
    kind : str
        One of ``KINDS``.
    snr : float
        Signal-to-noise ratio of each fault, after the nominal model is fitted
        again. A fault that cannot be so large is as large as it can.
    setup : Setup, optional
        What is simulated.
    fault : dict, optional
        What is to be known of the fault, such as its ``place``; the rest is drawn.

    Returns
    -------
    observations : list of Observations
        The datasets.
    chains : list
        Their nominal chains, at starting values that are not the truth.
    case : dict
        The key, as it is written to ``key.json``.

    Raises
    ------
    GapError
        If the kind or something of the fault is unknown.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, make_challenge
    >>> small = Setup(n_wavelengths=5, n_derotator=3)
    >>> drift = {"place": "in:derotator", "kind": "retardance_h", "dependence": "time"}
    >>> data, chains, case = make_challenge(1, snr=20, setup=small, fault=drift)
    >>> [observations.n_frames for observations in data], round(case["snr"])
    ([24, 24], 20)
    >>> case["faults"][0]["cells"]["in:derotator/retardance_h/time"] > 0.98
    True
    """
    check_choice("kind", kind, KINDS, GapError)
    if not (np.isfinite(snr) and snr > 0):
        raise GapError(f"snr = {snr}; it must be finite and positive")
    setup = Setup() if setup is None else setup
    if not setup.sources:
        raise GapError(f"{setup.instrument}: has no source on the bench")
    bench = Bench(setup, np.random.default_rng(check_seed(seed)))
    kinds = {"none": [], "pair": [bench.rng.choice(("cell", "listed")) for _ in range(2)]}
    known, faults, told = fault or {}, [], []
    for one in kinds.get(kind, [kind]):
        # the effects that contain, or are part of, what there is already
        there = {one.told["effect"] for one in faults if one.told.get("effect")}
        windows = {getattr(get_effect(name), "thickness", None) for name in there} - {None}
        there |= {name for name, e in EFFECTS.items() if getattr(e, "thickness", None) in windows}
        for _ in range(_DRAWS):
            drawn = Fault(bench, {"type": str(one), **known})
            residual, fit = bench.scale(drawn, 1.0 if kind == "absorbed" else snr)
            absorbed = drawn.snr < _INVISIBLE
            # an effect that is there already is not another fault, and what cannot be seen alone
            # may show through another one, by how much is not known
            other = "effect" in known or drawn.told.get("effect") not in there
            if kind != "pair" or (other and not absorbed):
                break
        faults.append(drawn)
        size = {"amplitude": drawn.amplitude, "snr": round(drawn.snr, 1), "absorbed": absorbed}
        cells = {} if absorbed else drawn.cells(residual, fit)
        told.append({**drawn.told, **size, "cells": cells})
    case = {
        "kind": kind,
        "snr": min((one["snr"] for one in told if not one["absorbed"]), default=0.0),
        "absorbed": bool(told) and all(one["absorbed"] for one in told),
        "shuffled": bench.shuffled,
        "instrument": setup.instrument,
        "options": setup.options,
        "tables": [f"{source}.ecsv" for source in setup.sources],
        "faults": told,
    }
    return bench.record(bench.expose(faults)), setup.chains(), case


# ---- an answer is scored ----------------------------------------------------------------------


def _share(fault, entry):
    """Return the share of a fault's signal that a cause, or one of its aliases, carries."""
    if isinstance(entry, str):
        entry = {"effect": entry}
    if entry.get("effect") is not None and entry["effect"] == fault.get("effect"):
        return 1.0
    cell = entry.get("cell")
    if not isinstance(cell, dict):
        return 0.0
    place, kind, dependence = (str(cell.get(x)) for x in ("place", "kind", "dependence"))
    # it is the same whatever it is said to depend on
    dependence = DETECTOR.get(kind, dependence)
    cells = fault.get("cells", {})
    if not dependence.startswith("step:"):
        return cells.get(f"{place}/{kind}/{dependence}", 0.0)
    start = f"{place}/{kind}/step:"
    frames = {int(name[len(start) :]): name for name in cells if name.startswith(start)}
    at = int(dependence[5:]) if dependence[5:].isdigit() else np.inf
    near = min(frames, key=lambda frame: abs(frame - at), default=np.inf)
    return cells[frames[near]] if abs(near - at) <= _STEP else 0.0


def _carried(fault, cause):
    return max(_share(fault, one) for one in [cause, *(cause.get("aliases") or [])])


def score_answer(case, answer):
    """
    Score an answer.

    Parameters
    ----------
    case : dict
        Of ``key.json``.
    answer : dict
        As ``astropolcal diagnose --json`` writes it: ``verdict``, ``causes`` and ``frames``;
        an empty one is not an answer.

    Returns
    -------
    str
        ``"right"``, ``"silent"`` or ``"wrong"``, which is confidently wrong.

    Raises
    ------
    GapError
        If one of the two is not of that form.

    Examples
    --------
    >>> from astropolcal.gap.challenge import score_answer
    >>> fault = {"type": "cell", "absorbed": False, "cells": {"source/rotation/time": 1.0}}
    >>> cell = {"place": "source", "kind": "rotation", "dependence": "time"}
    >>> answer = {"verdict": "located", "causes": [{"probability": 0.9, "cell": cell}]}
    >>> score_answer({"kind": "cell", "faults": [fault]}, answer)
    'right'
    """
    try:
        return _score(case, answer)[0]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as problem:
        raise GapError(f"neither a case nor an answer: {problem!r}") from None


def _score(case, answer):
    """Return the score, and of each cause its probability and whether it is right."""
    verdict, causes = answer.get("verdict"), answer.get("causes") or []
    faults = [fault for fault in case["faults"] if not fault["absorbed"]]
    best = [max((_carried(fault, cause) for fault in faults), default=0.0) for cause in causes]
    # a tool that gives no probabilities is sure
    given = [cause.get("probability") for cause in causes]
    given = [1.0 if p is None else float(p) for p in given]
    if not all(0 <= p <= 1 for p in given):
        raise ValueError(f"probabilities = {given}")
    claims = [[p, share >= _ENOUGH] for p, share in zip(given, best, strict=True)]
    if not faults:
        return {"none": "right", None: "silent"}.get(verdict, "wrong"), claims
    if faults[0]["type"] == "frame":
        named = {frame["frame"] for frame in answer.get("frames") or []}
        right = bool(named & {faults[0]["frame"], faults[0]["with"]})
        return "wrong" if causes else "right" if right else "silent", claims
    if faults[0]["type"] == "mechanism" and verdict == "unexplained":
        return "right", claims
    if any(p >= _HALF > share for p, share in zip(given, best, strict=True)):
        return "wrong", claims
    found = all(any(_carried(fault, c) >= _ENOUGH for c in causes) for fault in faults)
    return "right" if found and best[0] >= _ENOUGH else "silent", claims


def _named(entry):
    """Return a fault or a cause in a few words."""
    cell = entry.get("cell") or entry
    parts = [cell[k] for k in ("place", "kind", "dependence") if cell.get(k) is not None]
    return str(entry.get("effect") or entry.get("what") or "/".join(map(str, parts)))


def _scored(case, answer):
    """Return what a record says of a case and its answer."""
    result, claims = _score(case, answer)
    return {
        "kind": case["kind"],
        "snr": float(case["snr"]),
        "faults": [_named(fault) for fault in case["faults"]],
        "verdict": str(answer.get("verdict")),
        "causes": [_named(cause) for cause in answer.get("causes") or []],
        "result": result,
        "claims": claims,
    }


# ---- many of them -----------------------------------------------------------------------------


def _make_one(index, settings):
    """Return the challenge of that number."""
    # independent streams, so that one challenge does not depend on which others were made
    seed = np.random.SeedSequence(settings["seed"], spawn_key=(index,))
    choice, making = (np.random.default_rng(s) for s in seed.spawn(2))
    weights = np.array([KINDS[kind] for kind in settings["kinds"]])
    kind = str(choice.choice(settings["kinds"], p=weights / weights.sum()))
    low, high = settings["snr"]
    # evenly in the logarithm: as many faint as strong ones
    snr = float(np.exp(choice.uniform(np.log(low), np.log(high))))
    return make_challenge(making, kind=kind, snr=snr, setup=Setup(**settings["setup"]))


def _write_one(index, settings, folder=None):
    """Write the tables of a challenge, and return its case."""
    observations, _, case = _make_one(index, settings)
    own = Path(folder) / f"case{index:03d}"
    own.mkdir(exist_ok=True)
    for one, table in zip(observations, case["tables"], strict=True):
        one.write(own / table, overwrite=True)
    return {"index": index, "case": case}


def _run_one(index, settings):
    """Make, answer and score the challenge of that number."""
    # a page, tables and words are worked out here
    from astropolcal.gap.report import to_dict

    observations, chains, case = _make_one(index, settings)
    try:
        answer = to_dict(diagnose(chains, observations))
    except AstropolcalError as error:
        return {"index": index, **_scored(case, {}), "verdict": "error", "error": str(error)}
    return {"index": index, **_scored(case, answer), "seconds": round(answer["seconds"], 2)}


def make_cases(
    folder, n, seed=0, *, snr=(12.0, 120.0), kinds=tuple(KINDS), setup=None, workers=1,
    cluster=None, progress=False,
):  # fmt: skip
    """Make challenges and write them to files, for any tool to answer."""
    settings = _settings(n, seed, snr, kinds, setup)
    path = Path(folder) / "key.json"
    if path.exists():
        raise GapError(f"{path}: is there already; remove it, or name another folder")
    with understood(folder, GapError, "cannot be written", reads=False):
        path.parent.mkdir(parents=True, exist_ok=True)
    function = partial(_write_one, settings=settings, folder=str(folder))
    made = _each(function, range(n), n, workers, cluster, progress)
    key = {f"case{one['index']:03d}": one["case"] for one in made}
    with atomic_path(path, GapError) as new:
        Path(new).write_text(json.dumps(dict(sorted(key.items())), indent=1) + "\n")
    return key


def score_cases(folder, outputs):
    """Score the answers of any tool to cases in files."""
    path, records = Path(folder) / "key.json", []
    with understood(path, GapError, "is not a key of challenges"):
        key = json.loads(path.read_text())
        for case in key.values():
            _scored(case, {})
    for index, (name, case) in enumerate(sorted(key.items())):
        answer = Path(outputs) / f"{name}.json"
        if answer.exists():
            with understood(answer, GapError, "is not an answer to a challenge"):
                records.append({"index": index, **_scored(case, json.loads(answer.read_text()))})
        else:
            records.append({"index": index, **_scored(case, {}), "verdict": "missing"})
    if all(record["verdict"] == "missing" for record in records):
        raise GapError(f"{outputs}: holds no answer to any of the {len(key)} cases of {folder}")
    return ChallengeResult(records, {"cases": str(folder)})


def run_challenge(
    n, seed=0, *, snr=(12.0, 120.0), kinds=tuple(KINDS), setup=None, workers=1, cluster=None,
    checkpoint=None, progress=False,
):  # fmt: skip
    """
    Make challenges, diagnose each blind, and score the answers.

    Parameters
    ----------
    n : int
        How many.
    seed : int
        Challenge number i of a seed is always the same.
    snr : (float, float)
        Range of the signal-to-noise ratio, drawn evenly in its logarithm.
    kinds : sequence of str
        Of ``KINDS``, drawn with the frequencies given there.
    setup : Setup, optional
        What is simulated.
    workers : int
        Number of processes.
    cluster : str, optional
        Address of a ``dask.distributed`` scheduler, in place of processes.
    checkpoint : path-like, optional
        File to which each record is appended as a line of JSON. A run with the
        same settings goes on from it.
    progress : bool
        Whether to show how far it is; on a terminal only.

    Returns
    -------
    ChallengeResult

    Raises
    ------
    GapError
        If a number or kind is not allowed, or the checkpoint is of other settings.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, run_challenge
    >>> small = Setup(n_wavelengths=5, n_derotator=3)
    >>> run_challenge(1, seed=2, kinds=["none"], setup=small).rate("right")[0]
    1.0
    """
    settings = _settings(n, seed, snr, kinds, setup)
    records = _journal(checkpoint, settings)
    todo = [i for i in range(n) if i not in records]
    for record in _each(partial(_run_one, settings=settings), todo, n, workers, cluster, progress):
        records[record["index"]] = record
        _append(checkpoint, record)
    return ChallengeResult([records[i] for i in range(n)], settings)


def _settings(n, seed, snr, kinds, setup):
    for name, value in (("n", n), ("seed", seed)):
        if not isinstance(value, (int, np.integer)) or value < (name == "n"):
            raise GapError(f"{name} = {value!r}; allowed are whole numbers from {int(name == 'n')}")
    if not len(kinds):
        raise GapError(f"kinds = {list(kinds)}; allowed are {', '.join(KINDS)}")
    for kind in kinds:
        check_choice("kinds", kind, KINDS, GapError)
    low, high = (float(x) for x in snr)
    if not (0 < low <= high < np.inf):
        raise GapError(f"snr = {snr}; allowed are two positive numbers, the lower first")
    setup = asdict(Setup() if setup is None else setup)
    return {"seed": int(seed), "snr": [low, high], "kinds": list(kinds), "setup": setup}


def _each(function, todo, n, workers, cluster, progress):
    """Yield what a function gives for each number, as it is ready, and say how far it is."""
    if workers == 1 and cluster is None:
        found = map(function, todo)
    else:
        found = _elsewhere(function, todo, workers, cluster)
    with shown(progress):
        yield from steps(found, "challenges", n, n - len(todo))


def _elsewhere(function, todo, workers, cluster):
    """Yield the same from other processes, in any order: each record carries its number."""
    ended = ended_tasks(function, todo, workers=workers, cluster=cluster, preload=[__name__])
    with closing(ended):
        for each in ended:
            if each.reason is not None:
                raise GapError(f"challenge {each.task}: {each.reason}")
            yield each.result


def _journal(path, settings):
    """Return the records of a checkpoint; the first line of the file holds the settings."""
    if path is None:
        return {}
    # a line that is damaged, or was cut off, is a challenge to do again
    found, _ = read_lines(path, _entry, "a checkpoint of challenges", GapError)
    if not found:
        _append(path, {"settings": settings})
        return {}
    known = dict(found).get("settings")
    if known is None:
        raise GapError(f"{path}: is not a checkpoint of challenges; take another name")
    wrong = [key for key in settings if known.get(key) != settings[key]]
    if wrong:
        raise GapError(f"{path}: is of other settings ({', '.join(wrong)}); remove it")
    return {index: record for index, record in found if index != "settings"}


def _entry(content):
    """Return what a line of a checkpoint holds: "settings", or the index of a record; and it.

    Or raise where the record lacks what a record has.
    """
    if "settings" in content:
        return "settings", dict(content["settings"])
    texts = ("kind", "verdict", "result")
    good = type(content["index"]) is int and content["result"] in RESULTS
    good &= all(isinstance(content[key], str) for key in texts)
    good &= isinstance(content["snr"], int | float) and np.isfinite(content["snr"])
    for probability, right in content["claims"]:
        good &= isinstance(probability, int | float) and 0 <= probability <= 1
        good &= isinstance(right, bool)
    for key in ("faults", "causes"):
        good &= isinstance(content[key], list) and all(isinstance(x, str) for x in content[key])
    if not good:
        raise TypeError("no record of a challenge")
    return content["index"], content


def _append(path, content):
    if path is not None:
        # a record that was reported is on the disk, whatever happens then
        append_line(path, json.dumps(content), GapError)


class ChallengeResult:
    """
    Outcome of many challenges.

    Parameters
    ----------
    records : list of dict
        One a challenge: ``index``, ``kind``, ``snr``, ``faults``, ``verdict``, ``causes``,
        ``result``, and ``claims``: the probability of each cause and whether it is right.
    settings : dict
        Seed, range of the signal-to-noise ratio, kinds and set-up.

    Examples
    --------
    >>> from astropolcal.gap.challenge import ChallengeResult
    >>> record = {"index": 0, "kind": "none", "snr": 0.0, "faults": [], "verdict": "none"}
    >>> result = ChallengeResult([record | {"causes": [], "result": "right", "claims": []}], {})
    >>> result.rate("right")[0]
    1.0
    """

    def __init__(self, records, settings):
        self.records, self.settings = list(records), dict(settings)

    def rate(self, result, *kinds, least=-np.inf, below=np.inf):
        """
        Return the share of answers that are right, silent or wrong.

        Parameters
        ----------
        result : str
            ``"right"``, ``"silent"`` or ``"wrong"``.
        *kinds : str
            Of ``KINDS``; by default all.
        least, below : float
            Range of the signal-to-noise ratio.

        Returns
        -------
        rate, low, high : float
            With the interval of Wilson (1927) at 68 %; NaN where there are none.
        count : int
        """
        known = (one for one in self.records if not kinds or one["kind"] in kinds)
        found = [one["result"] for one in known if least <= one["snr"] < below]
        return (*_wilson(found.count(result), len(found)), len(found))

    @property
    def rates(self):
        """Table of the rates: all, by kind, and by SNR of what has a fault to be seen."""
        kinds = sorted({record["kind"] for record in self.records})
        groups = [("all", (), {}), *((kind, (kind,), {}) for kind in kinds)]
        for low, high in pairwise(_SNR_EDGES):
            name = f"SNR {low:g} to {high:g}" if np.isfinite(high) else f"SNR over {low:g}"
            groups.append((name, (), {"least": low or 1e-9, "below": high}))
        rows = []
        for name, kinds, limits in groups:
            rates = [self.rate(result, *kinds, **limits) for result in RESULTS]
            if n := rates[0][3]:
                rows.append((name, n, *np.ravel([rate[:3] for rate in rates])))
        names = [result + end for result in RESULTS for end in ("", "_low", "_high")]
        dtype = [str, int, *[float] * len(names)]
        return QTable(rows=rows or None, names=("challenges", "n", *names), dtype=dtype)

    @property
    def reliability(self):
        """Table of all causes that were given, by probability, and how many of them are right."""
        claims = np.array([c for record in self.records for c in record["claims"]], dtype=float)
        claims = claims.reshape(-1, 2)
        # the last bin holds certainty too
        which = np.searchsorted(_EDGES, claims[:, 0], side="right").clip(1, len(_EDGES) - 1)
        bins = [claims[which == i] for i in range(1, len(_EDGES))]
        rows = [
            (low, high, len(b), b[:, 0].mean(), *_wilson(int(b[:, 1].sum()), len(b)))
            for (low, high), b in zip(pairwise(_EDGES), bins, strict=True)
            if len(b)
        ]
        names = ("from", "to", "n", "probability", "right", "right_low", "right_high")
        return QTable(rows=rows or None, names=names, dtype=[float, float, int, *[float] * 4])

    @property
    def failures(self):
        """Records whose answer was not right."""
        return [record for record in self.records if record["result"] != "right"]

    def to_dict(self):
        """Return settings, tables and records as a dictionary that JSON takes."""
        return {
            "settings": self.settings,
            "rates": _rows(self.rates),
            "reliability": _rows(self.reliability),
            "challenges": self.records,
        }

    def words(self):
        """Return the tables as lines of text."""
        rates, claims = self.rates, self.reliability
        lines = [f"{counted(len(self.records), 'challenge')}; rates with intervals at 68 %, in %"]
        lines.append(f"{'':14}{'n':>5}" + "".join(f"{_WORDS[name]:>20}" for name in RESULTS))
        for row in rates:
            cells = (_percent(row, name) for name in RESULTS)
            lines.append(f"{row['challenges']:14}{row['n']:5}" + "".join(cells))
        if len(claims):
            lines += [
                "",
                "causes by the probability that was given, and how many of them are right",
            ]
        for row in claims:
            given = f"{100 * row['probability']:13.1f}"
            lines.append(f"{given} {row['n']:5}{_percent(row, 'right')}")
        return "\n".join(lines)

    def plot_reliability(self):
        """
        Draw how many of the causes are right against the probability that was given.

        Returns
        -------
        `~matplotlib.figure.Figure`
            Points with the interval of Wilson (1927) at 68 %, numbers of causes below.
        """
        from matplotlib.figure import Figure

        figure, table = Figure((7.5, 5.5), layout="constrained"), self.reliability
        top, below = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
        top.plot([0, 100], [0, 100], color="0.5", linestyle="--", label="as it should be")
        x, y, low, high = (
            100 * np.asarray(table[name])
            for name in ("probability", "right", "right_low", "right_high")
        )
        bars = np.maximum([y - low, high - y], 0)
        top.errorbar(x, y, bars, fmt="o", color="#0072B2", capsize=3, label="causes given")
        top.set(ylim=(-3, 103), ylabel="of them right (%)")
        top.legend(loc="upper left", frameon=False)
        left, right = 100 * np.asarray(table["from"]), 100 * np.asarray(table["to"])
        looks = {"align": "edge", "color": "0.8", "edgecolor": "0.4"}
        below.bar_label(below.bar(left, table["n"], right - left, **looks), padding=2)
        below.set(xlim=(-3, 103), xlabel="probability that was given (%)", ylabel="causes")
        below.margins(y=0.25)
        for ax in (top, below):
            ax.grid(color="0.9", linewidth=0.7)
            ax.set_axisbelow(True)
        return figure


def _rows(table):
    """Return the rows of a table as JSON takes them."""
    return [dict(zip(table.colnames, row, strict=True)) for row in table.as_array().tolist()]


def _percent(row, name):
    value, low, high = (100 * row[name + end] for end in ("", "_low", "_high"))
    return f"{f'{value:.0f} ({low:.0f} to {high:.0f})':>20}"


def _wilson(right, n):
    """Return a share and its interval at 68 % by Wilson (1927)."""
    if not n:
        return np.nan, np.nan, np.nan
    return right / n, *map(float, binom_conf_interval(right, n, interval="wilson"))
