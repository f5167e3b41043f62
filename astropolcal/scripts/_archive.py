# Licensed under a 3-clause BSD style license - see LICENSE
"""Whole archives: ``astropolcal correct`` and ``reduce`` with ``--archive``."""

import copy
import hashlib
import io
import json
import os
import time
import warnings
from collections import Counter
from contextlib import closing, redirect_stderr
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path

import numpy as np

from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.files import one_line
from astropolcal.progress import counting
from astropolcal.scripts import _common as common
from astropolcal.words import counted, shortened

# what sequences are worked on by, and what does not change a product
_SUFFIX = {"correct": ".fits", "reduce": ".ecsv"}
_DRIVING = (
    *("run", "command", "cubes", "output", "json", "quiet", "full", "online", "archive", "target"),
    *("retry", "timeout", "workers", "cluster", "gap", "cycles"),
)
_PRELOADED = ("scripts._correct", "scripts._reduce", "correction", "reduction", "pipeline.library")
# of an entry of the manifest, what does not tell how the product was made
_OF_ENTRY = ("name", "key", "n_files", "first", "source", "state")
# reasons in the summary for machines: all are in the manifest
_MOST_LISTED, _MOST_DOUBTS = 1000, 20


def is_archive(arguments):
    """Return whether a whole archive is asked for; refuse numbers that none can have."""
    if arguments.archive is None:
        if arguments.output is None:
            raise ParameterError("-o FILE is needed, or --archive DIR for a whole archive")
        return False
    for name in ("gap", "cycles", "timeout"):
        value = getattr(arguments, name)
        if value is not None and not (value > 0 and np.isfinite(value)):
            raise ParameterError(f"--{name} {value:g}: a number above zero is needed")
    return True


def run_archive(command, arguments):
    """Work on all sequences of a tree that are not done; return the exit status."""
    from astropolcal.pipeline.tasks import ended_tasks
    from astropolcal.reduction.archive import Index, Manifest

    folder = Path(arguments.archive)
    folder.mkdir(parents=True, exist_ok=True)
    # as workers need them, whose folder may be another
    settled = copy.copy(arguments)
    for name in ("calibration", "raw", "dark", "flat"):
        value = getattr(arguments, name, None)
        if value is not None:
            setattr(settled, name, type(value)(os.path.abspath(value)))
    settings, source = _settings(settled), _source(arguments)
    where = {"workers": arguments.workers, "cluster": arguments.cluster}
    with closing(Index(folder / "index.sqlite")) as index:
        manifest = Manifest(folder / "manifest.jsonl")
        counts = _indexed(index, arguments, where)

        def sequences():
            options = {"cycles": arguments.cycles, "target": arguments.target}
            for sequence in index.sequences(gap=60 * arguments.gap, **options):
                key = sequence.key(settings)
                yield sequence, key, manifest.state(sequence.name, key, source)

        skipped = ("done",) if arguments.retry else ("done", "failed")
        before = Counter(state for *_, state in sequences())
        total, rest = before.total(), before.total() - sum(before[state] for state in skipped)
        if not total:
            # why the first file belongs to none
            why = next((f"; {path}: {why}" for path, why in index.problems()), "")
            raise AstropolcalError(f"{arguments.cubes[0]}: no sequence in it{why}")

        def todo():
            for s, key, state in sequences():
                if state not in skipped:
                    before = manifest.entries[s.name] if state == "older" else {}
                    yield s.name, key, s.instrument, s.files, before

        preload = [f"astropolcal.{name}" for name in _PRELOADED]
        limit = None if arguments.timeout is None else 60 * arguments.timeout
        work = partial(_worked, command, settled, os.path.abspath(folder))
        ended = ended_tasks(work, todo(), timeout=limit, preload=preload, **where)
        with closing(ended), counting(total, "sequences", total - rest) as add:
            for each in ended:
                name, key, _, files, _ = each.task
                entry = {"name": name, "key": key, "n_files": len(files), "first": files[0]}
                entry |= {"source": source, "state": "done"} | (each.result or {})
                if each.reason is not None:
                    entry |= {"state": "failed", "reason": each.reason}
                    if (old := folder / f"{name}{_SUFFIX[command]}").exists():
                        entry["reason"] += f"; {old.name} is that of an earlier run"
                manifest.add(entry)
                add()
        found = [manifest.entries[s.name] for s, *_ in sequences()]
        content = counts | _content(found, rest, index, folder, arguments)
    common.give(arguments, _lines(content, folder, arguments), content)
    return 1 if content["n_failed"] else 0


def _source(arguments):
    """Return what tells the file or the library of calibrations from what it was, None without."""
    from astropolcal.pipeline.library import Library

    path = getattr(arguments, "calibration", None)
    if path is None or not os.path.exists(path):
        return None
    library = Library(path)
    held = [[e.content_hash, str(e.validity), sorted(e.supersedes)] for e in library.entries]
    text = json.dumps([sorted(held), sorted(map(str, library.problems))])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _indexed(index, arguments, where):
    """Bring the index up to date, and return what was found."""
    if len(arguments.cubes) > 1:
        raise ParameterError(f"{arguments.cubes[1]}: --archive takes one folder")
    (tree,) = arguments.cubes
    if not os.path.isdir(tree):
        raise AstropolcalError(f"{tree}: no such folder; --archive takes one")
    started = time.monotonic()
    options = {"instrument": arguments.instrument, "besides": arguments.archive}
    n_files, n_read = index.update(tree, **options, **where)
    seconds = time.monotonic() - started
    return {"n_files": n_files, "n_headers_read": n_read, "index_seconds": round(seconds, 3)}


def _settings(arguments):
    """Return what a product depends on besides its files."""
    given = {k: v for k, v in vars(arguments).items() if k not in _DRIVING}
    # what is no path is refused later
    masters = [str(given.get(name) or "") for name in ("dark", "flat")]
    if changed := [os.stat(p).st_mtime_ns for p in masters if os.path.isfile(p)]:
        given["changed"] = changed
    return json.loads(json.dumps(given, sort_keys=True, default=str))


def _worked(command, arguments, folder, task):
    """Correct or reduce a sequence, in any process that sees the files; return what was made."""
    from astropolcal.pipeline.store import sha256_of
    from astropolcal.scripts.main import earth

    name, _, instrument, files, before = task
    started, arguments = time.monotonic(), copy.copy(arguments)
    product = os.path.join(folder, f"{name}{_SUFFIX[command]}")
    arguments.cubes, arguments.output, arguments.quiet = files, product, True
    arguments.json = os.path.join(folder, f"{name}.json")
    arguments.cluster, arguments.workers = None, 1 if command == "reduce" else None
    if os.path.isdir(getattr(arguments, "calibration", "")):
        arguments.instrument = arguments.instrument or instrument
    said = io.StringIO()
    with redirect_stderr(said), warnings.catch_warnings(record=True, action="always") as warned:
        warnings.filterwarnings("ignore", message="ERFA function")
        module = import_module(f"astropolcal.scripts._{command}")
        with earth(arguments):
            if before:
                *_, made = module.choose_calibration(arguments, files)
                if made["calibration_hash"] == before.get("calibration_hash"):
                    return {k: v for k, v in before.items() if k not in _OF_ENTRY}
            module.work(arguments)
    doubts = [str(each.message) for each in warned] + said.getvalue().splitlines()
    summary = json.loads(Path(arguments.json).read_text(encoding="utf-8"))
    state = os.stat(product)
    return {
        "product": os.path.basename(product),
        "size": state.st_size,
        "changed": state.st_mtime_ns,
        "sha256": sha256_of(product),
        "calibration": summary.get("calibration"),
        "calibration_hash": summary.get("calibration_hash"),
        "seconds": round(time.monotonic() - started, 3),
        "megabytes": _megabytes(),
        "warnings": [one_line(words) for words in dict.fromkeys(doubts)][:_MOST_DOUBTS],
    }


def _megabytes():
    """Return the most memory that this process has had, None where the system does not say."""
    try:
        text = Path("/proc/self/status").read_text(encoding="ascii")
        return round(int(text.split("VmHWM:")[1].split()[0]) / 1024, 1)
    except (OSError, IndexError, ValueError):
        return None


def _content(found, n_worked, index, folder, arguments):
    """Return the summary for machines."""
    done = [entry for entry in found if entry["state"] == "done"]
    failed = {entry["name"]: entry["reason"] for entry in found if entry["state"] != "done"}
    unread = dict(index.problems())
    sizes = [entry["megabytes"] for entry in done if entry.get("megabytes")]
    return {
        "archive": str(folder),
        "n_sequences": len(found),
        "n_worked_on": n_worked,
        "n_done": len(done),
        "n_failed": len(failed),
        "n_left_out": len(unread),
        "n_warned": sum(bool(entry.get("warnings")) for entry in done),
        "median_seconds": float(np.median([e["seconds"] for e in done])) if done else None,
        "most_megabytes": max(sizes, default=None),
        "calibrations": Counter(e["calibration"] for e in done if e.get("calibration")),
        "failed": dict(islice(failed.items(), _MOST_LISTED)),
        "left_out": dict(islice(unread.items(), _MOST_LISTED)),
    }


def _lines(content, folder, arguments):
    """Return the summary, and what failed as far as there is room."""
    n_failed, total = content["n_failed"], content["n_sequences"]
    n_left, n_warned = content["n_left_out"], content["n_warned"]
    body = [f"  failed: {name}: {why}" for name, why in content["failed"].items()]
    body += [f"  left out: {path}: {why}" for path, why in content["left_out"].items()]
    verdict = f"All {counted(total, 'sequence')} done"
    if n_failed:
        verdict = f"NOT COMPLETE: {n_failed} of {counted(total, 'sequence')} failed"
    now = f"{content['n_worked_on']} worked on now, {content['n_files']} files in the index"
    used = ", ".join(f"{Path(k).name} ({n})" for k, n in content["calibrations"].items())
    cost = "not known"
    if content["n_done"]:
        most = content["most_megabytes"]
        memory = "" if most is None else f", at most {most:.0f} MB of memory"
        cost = f"{content['median_seconds']:.2g} s per sequence{memory}"
    lines = {
        "Sequences": now,
        "Left out": counted(n_left, "file") if n_left else None,
        "Warnings": f"in {counted(n_warned, 'sequence')}, see the manifest" if n_warned else None,
        "Calibration": used or None,
        "Cost": cost,
        "Next": "--retry tries what failed again" if n_failed else None,
    }
    ends = [shortened(f"{key + ':':<13}{words}") for key, words in lines.items() if words]
    names = [str(Path(folder) / "manifest.jsonl"), arguments.json]
    shown = body if arguments.full else [shortened(line) for line in body]
    return common.with_ending(shown, [verdict, *ends, *common.written_lines(names)], arguments.full)
