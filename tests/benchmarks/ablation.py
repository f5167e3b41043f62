# Licensed under a 3-clause BSD style license - see LICENSE
"""
What each rule of the search for causes is worth: the table of docs/challenge.rst.

``python tests/benchmarks/ablation.py DATA docs`` answers the same challenges with every rule in
turn out of force, and the published runs in the folder DATA, and writes ``challenge_rules.csv``.
A rule is out of force where its constants have other values.
"""

import argparse
import csv
import importlib
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np

from astropolcal.exceptions import AstropolcalError
from astropolcal.files import atomic_path
from astropolcal.gap import attribution, diagnose
from astropolcal.gap.challenge import make_challenge, score_answer
from astropolcal.gap.report import to_dict

#: By words, the constants of each rule and what they are without it.
RULES = {
    "all rules": {},
    "several sets side by side": {"selection._WIDTH": (1,)},
    "only promising sets are fitted": {"selection._PROMISING": 0.0},
    "one cause with much freedom is weighed against two": {"selection._DEAR": np.inf},
    "two of up to four causes are tried as one": {"selection._MERGED": (99, 4)},
    "more than two causes are ranked by left-out frames": {"selection._BY_EVIDENCE": 99},
    "names are asked for beside at most two causes": {"selection._NAMES": 99},
    "among structure, left-out frames have to be better": {"selection._STRUCTURED": np.inf},
    "evidence a cause needs: 10, not 7": {"selection.ENOUGH": 7.0},
    "a rival has to be ahead by 3": {"selection._CLEARLY": 0.0},
    "a name may be behind its cell by 1": {"selection._AS_GOOD": 0.0},
    "odds of a name against a cell: 5, not 1": {"attribution.NAMED": 1.0},
    "what changes needs a reason": {
        "attribution._DEPENDENCE": {},
        "attribution._OTHER": 0.0,
        "attribution._ALONE": 0.0,
    },
    "sizes are known within two orders": {"attribution._SIZES": (1.0,)},
    "laws in wavelength are freed": {"attribution._FREER": ()},
    "far rivals and those of strong signals are fitted in full": {
        "selection._FAR": np.inf,
        "selection._NEAR": -1.0,
    },
    "many causes are one that no table has": {"selection._UNLISTED": (0.0, *[0.02] * 8)},
    "what noise may hide lowers a single cause": {"selection._UNSEEN": (0.0, 0.0)},
    "one course that does as well is in place of them": {
        "selection._ONE_COURSE": 0.0,
        "selection._BETTER_COURSE": 0.0,
    },
    "two not in all parts of the data are one that no table has": {"selection._SHAKY": 0.0},
    "what is left lowers all probabilities": {"selection._LEFT": np.inf},
    "noise is measured again beside the causes": {"diagnosis._TOO_QUIET": -1.0},
}
_KINDS = ("cell", "pair", "mechanism")
_SEED = 45
_RUNS = (1, 3)


def without(rule, function):
    """Return what a function gives while a rule is out of force."""
    kept = []
    try:
        for path, value in RULES[rule].items():
            module, _, name = path.partition(".")
            owner = importlib.import_module(f"astropolcal.gap.{module}")
            kept.append((owner, name, getattr(owner, name)))
            setattr(owner, name, value)
        # it remembers what it was told
        attribution._prior.cache_clear()
        return function()
    finally:
        attribution._prior.cache_clear()
        for owner, name, value in kept:
            setattr(owner, name, value)


def challenge(index):
    """Return score and causes of one challenge, by rule that is out of force."""
    rng = np.random.default_rng([_SEED, index])
    snr = float(np.exp(rng.uniform(np.log(12), np.log(120))))
    kind = _KINDS[index % len(_KINDS)]
    observations, chains, case = make_challenge([_SEED, index], kind=kind, snr=snr)
    found = {}
    for rule in RULES:
        try:
            answer = without(rule, lambda: to_dict(diagnose(chains, observations)))
        except AstropolcalError:
            answer = {}
        causes = [(c["name"], round(c["probability"], 2)) for c in answer.get("causes", ())]
        found[rule] = score_answer(case, answer), causes
    return found


def real(folder, job):
    """Return the error on left-out angles (percent) of a published run without a rule."""
    # the script beside this one
    from real_gap import CHARIS, read

    number, rule = job
    data = read(folder, number)
    chains = CHARIS.chains_for(data)
    return without(rule, lambda: diagnose(chains, data).held_out[-1].percent)


def table(answers, runs):
    """Yield the rows of the table."""
    yield ["Without the rule", "Answers", "Right", "Silent", "Wrong", "Dataset 1", "Dataset 3"]
    for rule in RULES:
        scores = [one[rule][0] for one in answers]
        differ = sum(one[rule][1] != one["all rules"][1] for one in answers)
        counts = [scores.count(word) for word in ("right", "silent", "wrong")]
        errors = [f"{runs[number, rule]:.3f}" for number in _RUNS]
        yield [rule, differ if rule != "all rules" else "", *counts, *errors]


def main(arguments=None):
    """Read the command line and write the table."""
    from real_gap import read

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("data", help="folder of the published tables")
    parser.add_argument("docs", help="folder of the table")
    parser.add_argument("--count", type=int, default=48, help="challenges")
    arguments = parser.parse_args(arguments)
    # before the long work
    read(arguments.data, *_RUNS)
    if not Path(arguments.docs).is_dir():
        parser.error(f"{arguments.docs} is no folder")
    jobs = [(number, rule) for number in _RUNS for rule in RULES]
    with ProcessPoolExecutor(2) as pool:
        futures = {pool.submit(challenge, i): i for i in range(arguments.count)}
        of_runs = pool.map(partial(real, arguments.data), jobs)
        found = {}
        for future in as_completed(futures):
            found[futures[future]] = future.result()
            print(f"{len(found)} of {arguments.count}", end="\r", flush=True)
        runs = dict(zip(jobs, of_runs, strict=True))
    answers = [found[i] for i in sorted(found)]
    with (
        atomic_path(Path(arguments.docs) / "challenge_rules.csv") as new,
        new.open("w", encoding="utf-8", newline="") as file,
    ):
        csv.writer(file, lineterminator="\n").writerows(table(answers, runs))


if __name__ == "__main__":
    main()
