# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sealed challenges, which ask whether the diagnosis is right where the truth is known.

A challenge is a simulated calibration of an instrument with a random effect in
it, or none, or one that no library holds. The diagnosis sees the data and the
nominal chains; the key stays sealed until it has answered. Many of them give
recall, false alarms, errors of the sizes, and the gap that is left, against the
signal-to-noise ratio of the effect.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.files import append_line, understood
from astropolcal.gap._bench import UNKNOWN, Bench, Key, Setup, plant
from astropolcal.gap._outcome import ChallengeResult
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.effects import get_effect
from astropolcal.gap.shrinkage import frame_groups, held_out

__all__ = [
    "KINDS",
    "ChallengeResult",
    "Key",
    "Setup",
    "make_challenge",
    "run_challenge",
]

#: Kinds of challenges, and how often each is drawn where nothing else is asked for.
KINDS = {
    "single": 0.45,
    "none": 0.15,
    "pair": 0.12,
    "absorbed": 0.07,
    "unlisted": 0.08,
    "withheld": 0.08,
}
# a size counts as measured where its error is below this share of its prior
_MEASURED = 0.3


def make_challenge(seed, *, kind="single", effect=None, snr=30.0, setup=None):
    """
    Make a sealed challenge.

    Parameters
    ----------
    seed : int or `~numpy.random.SeedSequence`
        Seed of everything that is random.
    kind : str
        ``"single"``: an effect of the library. ``"none"``: no effect. ``"pair"``:
        two effects. ``"absorbed"``: an effect that the nominal parameters take
        up. ``"unlisted"``: an effect that is in no library. ``"withheld"``: an
        effect that is to be taken out of the library that is asked.
    effect : str, optional
        The effect; by default one is drawn.
    snr : float
        Signal-to-noise ratio of each effect, after the nominal model is fitted
        again. An effect that cannot be so large is as large as it can.
    setup : Setup, optional
        What is simulated.

    Returns
    -------
    observations : list of Observations
        The datasets.
    chains : list
        Their nominal chains, at starting values that are not the truth.
    key : Key

    Raises
    ------
    GapError
        If the kind or the effect is unknown, or no effect fits the kind.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, make_challenge
    >>> small = Setup(n_wavelengths=5, n_derotator=3)
    >>> data, chains, key = make_challenge(1, effect="beam_gain", snr=20, setup=small)
    >>> [observations.n_frames for observations in data], round(key.snr[0])
    ([24, 24], 20)
    """
    if kind not in KINDS:
        raise GapError(f"kind = {kind!r}; allowed are {', '.join(KINDS)}")
    if not (np.isfinite(snr) and snr > 0):
        raise GapError(f"snr = {snr}; it must be finite and positive")
    bench = Bench(Setup() if setup is None else setup, np.random.default_rng(seed))
    planted = [] if kind == "none" else _planted(bench, kind, effect, snr)
    key = Key(
        kind,
        [one.name for one in planted],
        [one.snr for one in planted],
        [one.shares for one in planted],
        [one.values for one in planted],
    )
    fluxes, key.chains = bench.expose(planted)
    return bench.record(fluxes), bench.setup.chains(), key


def _planted(bench, kind, effect, snr):
    """Return the effects of a challenge; what fails names the kind that was asked for."""
    if kind != "pair":
        return plant(bench, kind, effect, snr)
    if effect is not None:
        # an unknown name is another mistake than no pair
        get_effect(effect)
    try:
        return plant(bench, kind, effect, snr)
    except GapError as error:
        # each of a pair is planted like a single effect
        what = kind if effect is None else f"{kind} with {effect!r}"
        raise GapError(f"no two effects found for a challenge of kind {what}") from error


# ---- a challenge is answered and scored ------------------------------------------------------


def _answer(observations, chains, key):
    """Diagnose blind, then open the key; return a record."""
    record = {"kind": key.kind, "effects": key.effects, "snr": key.snr}
    record["alternatives"] = [
        {name: share for name, share in shares.items() if share >= UNKNOWN}
        for shares in key.alternatives
    ]
    try:
        diagnosis = diagnose(chains, observations, effects=key.library)
    except AstropolcalError as error:
        return record | {"verdict": "error", "right": False, "error": str(error), "causes": []}
    groups = [[cause.name, *cause.aliases] for cause in diagnosis.causes]
    record |= {
        "verdict": diagnosis.verdict,
        "causes": groups,
        "explained": [round(cause.explained, 4) for cause in diagnosis.causes],
        "remainder_p_value": diagnosis.remainder_p_value,
        "right": _is_right(key, diagnosis.verdict, groups),
        "seconds": round(diagnosis.seconds, 2),
    }
    if key.kind in ("single", "pair"):
        record |= _sizes_and_shrinkage(observations, key, diagnosis)
    return record


def _is_right(key, verdict, groups):
    if key.kind in ("none", "absorbed"):
        return verdict == "none"
    if key.kind in ("unlisted", "withheld"):
        return verdict == "unexplained"
    if verdict != "effect":
        return False
    if key.kind == "pair":
        named = {name for group in groups for name in group}
        return all(names & named for names in key.accepted)
    return bool(key.accepted[0] & set(groups[0])) if groups else False


def _sizes_and_shrinkage(observations, key, diagnosis):
    """Return the pulls of the sizes, and how far the gap shrank, against an oracle."""
    oracle = diagnosis.nominal
    for name in key.effects:
        oracle = oracle.with_effect(get_effect(name))
    last = held_out(oracle, frame_groups(observations))
    before, after = diagnosis.held_out[0], diagnosis.held_out[-1]
    found = [name for name in key.effects if name in diagnosis.improved.added]
    return {
        "gap_percent": [one.percent for one in (before, after, last)],
        "gap_chi2": [one.chi2 for one in (before, after, last)],
        "pulls": _pulls(diagnosis.improved, key, found),
    }


def _pulls(model, key, names):
    """Return fitted less true coefficients by their errors, where the data determine them."""
    if not names:
        return []
    errors, found = model.problem.errors(model.fit.coefficients), []
    for name in names:
        values = key.values[key.effects.index(name)]
        for parameter in model.added[name]:
            where = model.problem.slices[parameter.name]
            # values to coefficients of the law, for it is these that have errors
            true = np.atleast_1d(values[parameter.name])
            if parameter.basis is not None:
                true = np.linalg.lstsq(parameter.basis, true, rcond=None)[0]
            measured = errors[where] < _MEASURED * parameter.canonical_limit / 2
            pull = (model.fit.coefficients[where] - true) / errors[where]
            found += [round(float(p), 4) for p in pull[measured]]
    return found


def _run_one(index, settings):
    """Make, answer and score the challenge of that number."""
    # independent streams, so that one challenge does not depend on which others were run
    seed = np.random.SeedSequence(settings["seed"], spawn_key=(index,))
    choice, making = (np.random.default_rng(s) for s in seed.spawn(2))
    kinds = settings["kinds"]
    weights = np.array([KINDS[kind] for kind in kinds])
    kind = str(choice.choice(kinds, p=weights / weights.sum()))
    low, high = settings["snr"]
    # evenly in the logarithm: as many faint as strong ones
    snr = float(np.exp(choice.uniform(np.log(low), np.log(high))))
    setup = Setup(**settings["setup"])
    try:
        sealed = make_challenge(making, kind=kind, snr=snr, setup=setup)
    except AstropolcalError as error:
        return {"index": index, "kind": kind, "verdict": "not made", "error": str(error)}
    return {"index": index, "target": snr, **_answer(*sealed)}


def run_challenge(
    n,
    seed=0,
    *,
    snr=(8.0, 300.0),
    kinds=tuple(KINDS),
    setup=None,
    client=None,
    checkpoint=None,
    progress=False,
):
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
    >>> run_challenge(1, seed=2, kinds=["single"], snr=(60, 60), setup=small).rate("single")[0]
    1.0
    """
    settings = _settings(n, seed, snr, kinds, Setup() if setup is None else setup)
    records = _journal(checkpoint, settings)
    todo = [i for i in range(n) if i not in records]
    # disable=None shows the bar on a terminal only
    hidden = None if progress is True else True
    with tqdm(total=n, initial=n - len(todo), desc="challenges", disable=hidden) as bar:
        outcomes = _outcomes(todo, settings, client)
        for done, record in enumerate(outcomes, n - len(todo) + 1):
            records[record["index"]] = record
            _append(checkpoint, record)
            bar.update()
            if callable(progress):
                progress(done, n)
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
    return {"seed": int(seed), "snr": [low, high], "kinds": list(kinds), "setup": asdict(setup)}


def _outcomes(todo, settings, client):
    """Yield records as they are ready."""
    if client is None:
        for index in todo:
            yield _run_one(index, settings)
        return
    # in any order: each record carries its number
    futures = [client.submit(_run_one, index, settings) for index in todo]
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
        known, records = first["settings"], {_index(record): record for record in others}
        known = dict(known)
        # whatever is asked of the records must have an answer, and one that can be computed
        result = ChallengeResult(list(records.values()), known)
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            repr(result), result.summary(), result.table
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


def _index(record):
    """Return the number of a record that has what a record has, or raise."""
    numbers = [record.get(key, []) for key in ("snr", "gap_percent", "pulls")]
    plain = all(isinstance(x, int | float) for part in numbers for x in part)
    texts = all(isinstance(record[key], str) for key in ("kind", "verdict"))
    if type(record["index"]) is not int or not (plain and texts):
        raise TypeError("no record of a challenge")
    if "right" in record and not isinstance(record["right"], bool):
        raise TypeError("right or wrong")
    return record["index"]


def _append(path, content):
    if path is None:
        return
    # a record that was reported is on the disk, whatever happens then
    append_line(path, json.dumps(content), GapError)
