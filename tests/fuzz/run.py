# Licensed under a 3-clause BSD style license - see LICENSE
"""
Spoil files and see what their readers do.

``python -m tests.fuzz.run READER --count N --seed S`` makes the mutations
0 to N - 1 of a seed, each of which is always the same. It goes on where it was
stopped (``--state``), prints each failure with what makes it again, and ends
with the counts. ``--only INDEX`` makes one, and ``--keep FOLDER`` keeps the files
that failed.

A reader may give a valid object or raise an `AstropolcalError` of one line. Any
other error, a warning that is not ours, a time above 5 s of the processor, 500 MB
of memory, a file or a program touched, and a wrong object are failures.
"""

import argparse
import collections
import csv
import hashlib
import json
import os
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
from astropy.utils.exceptions import AstropyWarning
from erfa import ErfaWarning

from astropolcal.exceptions import AstropolcalError
from tests.fuzz import guard
from tests.fuzz.readers import READERS, keep_schemas

__all__ = ["attempt", "main", "mutation", "run"]

SECONDS, MEGABYTES = 5.0, 500
#: A hang is told by the time of the processor; this is for what sleeps.
WALL = 90.0
LONGEST = 700
CANARY = b"a file that no reader has any business with\n"


def mutation(reader, seed, index):
    """Return the name of the good file and the spoiled one that a seed and an index make."""
    key = int.from_bytes(hashlib.sha256(type(reader).__name__.encode()).digest()[:4], "little")
    rng = np.random.default_rng([seed, index, key])
    seeds = _seeds(type(reader))
    name = sorted(seeds)[int(rng.integers(len(seeds)))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return name, reader.mutate(rng, seeds[name])


_SEEDS = {}


def _seeds(kind):
    if kind not in _SEEDS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _SEEDS[kind] = kind().seeds()
    return _SEEDS[kind]


# ---- one file ----------------------------------------------------------------------


def attempt(reader, content, folder):
    """
    Read a file that may be spoiled.

    Returns
    -------
    outcome : {"valid", "error", "failure"}
    words : str
        The error's message, or what is wrong.
    """
    path = Path(folder) / f"input{reader.suffix}"
    path.write_bytes(content)
    _plant(folder)
    start, memory = time.process_time(), guard.reset_peak()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with guard.watching(folder) as seen:
            outcome, words = _read(reader, path)
    problems = [f"it touched {what}" for what in seen] + _traces(folder, path)
    problems += [f"warned: {w.message}" for w in caught if not _is_ours(w)]
    if time.process_time() - start > SECONDS:
        problems.append(f"took {time.process_time() - start:.1f} s")
    if guard.peak() - memory > MEGABYTES:
        problems.append(f"took {guard.peak() - memory:.0f} MB")
    if problems and outcome != "failure":
        outcome, words = "failure", "; ".join(problems)[:LONGEST]
    return outcome, words


def _is_ours(warning):
    # what astropy says of a header that it repairs is as good
    return issubclass(warning.category, (AstropyWarning, ErfaWarning))


def _read(reader, path):
    try:
        found = reader.read(path)
    except AstropolcalError as error:
        return _judged(error)
    except BaseException as error:
        return "failure", _shown(error)
    try:
        reader.check(found, path)
    except BaseException as error:
        return "failure", f"wrong object: {_shown(error)}"
    return "valid", ""


def _judged(error):
    text, cause = str(error), error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "failure", f"ran out of memory: {text[:200]}"
        cause = cause.__cause__ or cause.__context__
    if not text.strip() or "\n" in text or len(text) > LONGEST:
        return "failure", f"message of {len(text)} characters: {text[:300]!r}"
    return "error", text


def _shown(error):
    frames = traceback.extract_tb(error.__traceback__)[-3:]
    where = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames))
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]} ({where})"


def _plant(folder):
    (Path(folder) / "canary.txt").write_bytes(CANARY)


def _traces(folder, path):
    """Return what a reader left behind or changed."""
    found = []
    for other in Path(folder).iterdir():
        if other.name == "canary.txt":
            found += [] if other.read_bytes() == CANARY else ["changed canary.txt"]
        elif other != path:
            found.append(f"left {other.name}")
            other.unlink()
    return found


# ---- many files, in a process that may die -----------------------------------------


def _work(reader, seed, indices, folder, out):
    """Report on each mutation, one line before it and one after."""
    guard.die_with_parent()
    sys.setrecursionlimit(1000)
    os.chdir(folder)
    os.environ["TMPDIR"] = folder
    warnings.simplefilter("ignore")
    keep_schemas()
    for content in _seeds(type(reader)).values():
        # whatever is imported on the way is imported before anything is watched
        attempt(reader, content, folder)
    guard.install()
    guard.limit_memory(4 * MEGABYTES)
    for index in indices:
        _say(out, {"start": index})
        name, content = mutation(reader, seed, index)
        outcome, words = attempt(reader, content, folder)
        _say(out, {"index": index, "outcome": outcome, "words": words, "file": name})
    _say(out, {"done": True})


def _say(out, line):
    out.write(json.dumps(line) + "\n")
    out.flush()


def _spawn(reader, seed, indices, folder):
    """Start a process that works; return its number and the end of a pipe."""
    read, write = os.pipe()
    child = os.fork()
    if child:
        os.close(write)
        return child, read
    os.close(read)
    code = 1
    try:
        # only this process's own words are wanted
        null = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(null, number)
        with os.fdopen(write, "w") as out:
            _work(reader, seed, indices, folder, out)
        code = 0
    finally:
        os._exit(code)


def outcomes(reader, seed, indices):
    """Yield the outcome of each mutation, with a process anew after each that dies."""
    waiting = collections.deque(indices)
    _seeds(type(reader))
    while waiting:
        with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
            child, pipe = _spawn(reader, seed, list(waiting), folder)
            yield from _followed(child, pipe, waiting)


def _followed(child, pipe, waiting):
    """Yield what a process reports, and a failure for the mutation at which it ends."""
    current, used, since = None, 0.0, time.monotonic()
    lines, rest, why = collections.deque(), b"", "died"
    while True:
        ready, _, _ = select.select([pipe], [], [], 0.5)
        if ready:
            new = os.read(pipe, 1 << 16)
            if not new:
                break
            *whole, rest = (rest + new).split(b"\n")
            lines.extend(json.loads(line) for line in whole)
        while lines:
            line = lines.popleft()
            if "start" in line:
                current, used, since = line["start"], guard.seconds_of(child), time.monotonic()
            elif "index" in line:
                current = None
                waiting.remove(line["index"])
                yield line
        hung = guard.seconds_of(child) - used > 1.6 * SECONDS or time.monotonic() - since > WALL
        if current is not None and hung:
            why = "hangs"
            os.kill(child, signal.SIGKILL)
    os.close(pipe)
    _, status = os.waitpid(child, 0)
    if current is not None:
        waiting.remove(current)
        words = f"{why}, status {os.waitstatus_to_exitcode(status)}"
        yield {"index": current, "outcome": "failure", "words": words, "file": "?"}
    elif status and waiting:
        raise RuntimeError(f"the process that reads ended with status {status} before it began")


def run(name, count, seed, *, state=None, only=None, keep=None, show=print):
    """
    Make mutations of a reader's files, and return the counts of the outcomes.

    Parameters
    ----------
    name : str
        Of ``READERS``.
    count, seed : int
        How many, and of which series.
    state : path-like, optional
        File that outcomes are written to, and from which a run goes on.
    only : sequence of int, optional
        Which ones, in place of all.
    keep : path-like, optional
        Folder for files that failed.
    show : callable
        What prints.
    """
    reader, counts = READERS[name](), collections.Counter()
    done = {}
    if state and Path(state).exists():
        lines = (json.loads(line) for line in Path(state).read_text().splitlines())
        done = {line["index"]: line for line in lines if line["seed"] == seed}
    wanted = range(count) if only is None else only
    counts.update(done[i]["outcome"] for i in wanted if i in done)
    for line in outcomes(reader, seed, [i for i in wanted if i not in done]):
        counts[line["outcome"]] += 1
        if state:
            with open(state, "a", encoding="utf-8") as stream:
                kept = line if line["outcome"] == "failure" else line | {"words": ""}
                stream.write(json.dumps(kept | {"seed": seed}) + "\n")
        if line["outcome"] == "failure":
            show(f"{name} --seed {seed} --only {line['index']}: {line['words']}", flush=True)
            if keep:
                Path(keep).mkdir(exist_ok=True)
                place = Path(keep) / f"{name}-{seed}-{line['index']}{reader.suffix}"
                place.write_bytes(mutation(reader, seed, line["index"])[1])
    return counts


def main(argv=None):
    """Run as a command; the status is 1 if there was a failure."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.run", description=__doc__)
    parser.add_argument("reader", choices=[*READERS, "all"])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--state", help="file of outcomes, from which a run goes on")
    parser.add_argument("--keep", help="folder for files that failed")
    parser.add_argument("--record", help="table of the counts (CSV) that docs/trust.rst shows")
    arguments = parser.parse_args(argv)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    failed, table = 0, [("Read as", "Refused", "Valid", "Failed")]
    for name in READERS if arguments.reader == "all" else [arguments.reader]:
        counts = run(
            name,
            arguments.count,
            arguments.seed,
            state=arguments.state,
            only=arguments.only,
            keep=arguments.keep,
        )
        failed += counts["failure"]
        title = READERS[name].__doc__.strip().splitlines()[0].rstrip(".").replace("`", "")
        table.append((title, *(counts[key] for key in ("error", "valid", "failure"))))
        shown = ", ".join(f"{counts[key]} {key}" for key in ("error", "valid", "failure"))
        print(f"{name}: {sum(counts.values())} mutations: {shown}", flush=True)
    if arguments.record:
        with open(arguments.record, "w", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows(table)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
