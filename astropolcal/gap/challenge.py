# Licensed under a 3-clause BSD style license - see LICENSE
"""
Challenges, which ask whether a diagnosis is right where the truth is known.

A challenge is a simulated calibration of an instrument with a fault in it, or none. A diagnosis
sees the data and the nominal chains; the key stays sealed until it has answered. Cases can be
written to files and the answers of any tool can be scored.
"""

import json
import os
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.files import append_line, atomic_path, understood
from astropolcal.gap._bench import DETECTOR, Bench, Setup
from astropolcal.gap._faults import Fault
from astropolcal.gap._outcome import ChallengeResult, check_record
from astropolcal.gap.diagnosis import diagnose

__all__ = [
    "KINDS",
    "ChallengeResult",
    "Setup",
    "make_cases",
    "make_challenge",
    "run_challenge",
    "score_answer",
    "score_cases",
]

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
#: A fault whose signal-to-noise ratio stays below this cannot be seen.
_INVISIBLE = 3.0
# what a right answer carries of the signal, and what a wrong one does not
_ENOUGH, _HALF = 0.9, 0.5
# a step this many frames from another one is the same
_STEP = 4


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
    if kind not in KINDS:
        raise GapError(f"kind = {kind!r}; allowed are {', '.join(KINDS)}")
    if not (np.isfinite(snr) and snr > 0):
        raise GapError(f"snr = {snr}; it must be finite and positive")
    setup = Setup() if setup is None else setup
    if not setup.sources:
        raise GapError(f"{setup.instrument}: has no source on the bench")
    bench = Bench(setup, np.random.default_rng(seed))
    kinds = {"none": [], "pair": [bench.rng.choice(("cell", "listed")) for _ in range(2)]}
    faults = [Fault(bench, {"type": str(k), **(fault or {})}) for k in kinds.get(kind, [kind])]
    told = []
    for one in faults:
        residual, fit = bench.scale(one, 1.0 if kind == "absorbed" else snr)
        absorbed = one.snr < _INVISIBLE
        size = {"amplitude": one.amplitude, "snr": round(one.snr, 1), "absorbed": absorbed}
        cells = {} if absorbed else one.cells(residual, fit)
        told.append({**one.told, **size, "cells": cells})
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


def _visible(case):
    return [fault for fault in case["faults"] if not fault["absorbed"]]


def _probability(cause):
    # a tool that gives no probabilities is sure
    given = 1.0 if cause.get("probability") is None else float(cause["probability"])
    if not 0 <= given <= 1:
        raise ValueError(f"probability = {given}")
    return given


def score_answer(case, answer):
    """
    Score an answer.

    Parameters
    ----------
    case : dict
        Of ``key.json``.
    answer : dict
        As ``astropolcal diagnose --json`` writes it: ``verdict``, ``causes`` and ``frames``;
        an empty one is no answer.

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
    faults = _visible(case)
    best = [max((_carried(fault, cause) for fault in faults), default=0.0) for cause in causes]
    claims = [[_probability(c), s >= _ENOUGH] for c, s in zip(causes, best, strict=True)]
    if not faults:
        return {"none": "right", None: "silent"}.get(verdict, "wrong"), claims
    if faults[0]["type"] == "frame":
        named = {frame["frame"] for frame in answer.get("frames") or []}
        right = bool(named & {faults[0]["frame"], faults[0]["with"]})
        return "wrong" if causes else "right" if right else "silent", claims
    if faults[0]["type"] == "mechanism" and verdict == "unexplained":
        return "right", claims
    if any(p >= _HALF > share for (p, _), share in zip(claims, best, strict=True)):
        return "wrong", claims
    found = all(any(_carried(fault, c) >= _ENOUGH for c in causes) for fault in faults)
    return "right" if found and best[0] >= _ENOUGH else "silent", claims


def _named(entry):
    """Return a fault or a cause in a few words."""
    if isinstance(entry, str):
        return entry
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
    folder, n, seed=0, *, snr=(12.0, 120.0), kinds=tuple(KINDS), setup=None, client=None,
    progress=False,
):  # fmt: skip
    """
    Make challenges and write them to files, for any tool to answer.

    Parameters
    ----------
    folder : path-like
        Where ``key.json`` and a folder with the tables of each case are written.
    n, seed, snr, kinds, setup, client, progress
        As ``run_challenge`` takes them.

    Returns
    -------
    dict
        The key: case by name.

    Raises
    ------
    GapError
        As ``run_challenge``; or if there is a key already, or nothing can be written.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, make_cases
    >>> small = Setup(n_wavelengths=3, n_derotator=3)
    >>> key = make_cases("sealed", 1, seed=3, kinds=["none"], setup=small)
    >>> key["case000"]["kind"]
    'none'
    """
    settings = _settings(n, seed, snr, kinds, setup)
    path = Path(folder) / "key.json"
    if path.exists():
        raise GapError(f"{path}: is there already; remove it, or name another folder")
    with understood(folder, GapError, "cannot be written", reads=False):
        path.parent.mkdir(parents=True, exist_ok=True)
    made = _each(partial(_write_one, folder=str(folder)), range(n), n, settings, client, progress)
    key = {f"case{one['index']:03d}": one["case"] for one in made}
    with atomic_path(path, GapError) as new:
        Path(new).write_text(json.dumps(dict(sorted(key.items())), indent=1) + "\n")
    return key


def score_cases(folder, outputs):
    """
    Score the answers of any tool to cases in files.

    Parameters
    ----------
    folder : path-like
        Of the cases, with ``key.json``.
    outputs : path-like
        Folder with an answer ``caseNNN.json`` for each case; a missing one is silent.

    Returns
    -------
    ChallengeResult

    Raises
    ------
    GapError
        If the key or an answer is damaged, or there is no answer at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> from astropolcal.gap.challenge import Setup, make_cases, score_cases
    >>> small = Setup(n_wavelengths=3, n_derotator=3)
    >>> key = make_cases("others", 1, seed=3, kinds=["none"], setup=small)
    >>> _ = Path("others", "case000.json").write_text('{"verdict": "none"}')
    >>> score_cases("others", "others").records[0]["result"]
    'right'
    """
    path, records = Path(folder) / "key.json", []
    with understood(path, GapError, "is no key of challenges"):
        key = json.loads(path.read_text())
        for case in key.values():
            _scored(case, {})
    for index, (name, case) in enumerate(sorted(key.items())):
        answer = Path(outputs) / f"{name}.json"
        if answer.exists():
            with understood(answer, GapError, "is no answer to a challenge"):
                records.append({"index": index, **_scored(case, json.loads(answer.read_text()))})
        else:
            records.append({"index": index, **_scored(case, {}), "verdict": "missing"})
    if all(record["verdict"] == "missing" for record in records):
        raise GapError(f"{outputs}: holds no answer to any of the {len(key)} cases of {folder}")
    return ChallengeResult(records, {"cases": str(folder)})


def run_challenge(
    n, seed=0, *, snr=(12.0, 120.0), kinds=tuple(KINDS), setup=None, client=None, checkpoint=None,
    progress=False,
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
    client : optional
        A ``dask.distributed.Client``, or an executor of ``concurrent.futures``;
        by default they run here, one after the other.
    checkpoint : path-like, optional
        File to which each record is appended as a line of JSON. A run with the
        same settings goes on from it.
    progress : bool or callable
        Whether to show a bar on a terminal, or what is called after each
        challenge with how many are done and how many there are.

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
    for record in _each(_run_one, todo, n, settings, client, progress):
        records[record["index"]] = record
        _append(checkpoint, record)
    return ChallengeResult([records[i] for i in range(n)], settings)


def _settings(n, seed, snr, kinds, setup):
    for name, value in (("n", n), ("seed", seed)):
        if not isinstance(value, (int, np.integer)) or value < (name == "n"):
            raise GapError(f"{name} = {value!r}; allowed are whole numbers from {int(name == 'n')}")
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not len(kinds):
        raise GapError(f"kinds = {list(kinds)}; allowed are {', '.join(KINDS)}")
    low, high = (float(x) for x in snr)
    if not (0 < low <= high < np.inf):
        raise GapError(f"snr = {snr}; allowed are two positive numbers, the lower first")
    setup = asdict(Setup() if setup is None else setup)
    return {"seed": int(seed), "snr": [low, high], "kinds": list(kinds), "setup": setup}


def _each(function, todo, n, settings, client, progress):
    """Yield what a function gives for each number, as it is ready, and say how far it is."""
    # disable=None shows the bar on a terminal only
    hidden, before = None if progress is True else True, n - len(todo)
    with tqdm(total=n, initial=before, desc="challenges", disable=hidden) as bar:
        for done, one in enumerate(_outcomes(function, todo, settings, client), before + 1):
            yield one
            bar.update()
            if callable(progress):
                progress(done, n)


def _outcomes(function, todo, settings, client):
    if client is None:
        for index in todo:
            yield function(index, settings)
        return
    # in any order: each record carries its number
    futures = [client.submit(function, index, settings) for index in todo]
    if type(client).__module__.startswith("distributed"):
        from distributed import as_completed
    else:
        from concurrent.futures import as_completed
    for future in as_completed(futures):
        yield future.result()


def _journal(path, settings):
    """Return the records of a checkpoint; the first line of the file holds the settings."""
    if path is None:
        return {}
    path = Path(path)
    text = b""
    if os.path.exists(path):
        with understood(path, GapError, "cannot be read"):
            text = path.read_bytes()
    if not text:
        _append(path, {"settings": settings})
        return {}
    whole = text[: text.rfind(b"\n") + 1]
    try:
        first, *others = [json.loads(line) for line in whole.splitlines()]
        known = dict(first["settings"])
        records = {record["index"]: record for record in others}
        for record in others:
            check_record(record)
    except Exception:  # a damaged line may hold anything
        raise GapError(f"{path}: is no checkpoint of challenges") from None
    wrong = [key for key in settings if known.get(key) != settings[key]]
    if wrong:
        raise GapError(f"{path}: is of other settings ({', '.join(wrong)}); remove it")
    # a run that was killed may have left half a line
    if len(whole) < len(text):
        try:
            os.truncate(path, len(whole))
        except OSError as problem:
            raise GapError(f"{path}: cannot be written: {problem.strerror}") from problem
    return records


def _append(path, content):
    if path is not None:
        # a record that was reported is on the disk, whatever happens then
        append_line(path, json.dumps(content), GapError)
