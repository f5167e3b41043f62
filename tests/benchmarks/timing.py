# Licensed under a 3-clause BSD style license - see LICENSE
"""
Times of functions that do the same, taken in turns in one process.

A busy machine slows both sides of a ratio. The least time of many is that of a turn in which
nothing else ran; where a function takes longer than such a turn, the time of the processor does
not count the waiting.
"""

import re
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

# seconds that a process mostly gets without a pause
_TURN = 2e-3


def interleaved(*functions, repeats=25, clock=time.perf_counter):
    """Return the median time (s) of each function, run in turns."""
    return [statistics.median(kept) for kept in _times(functions, repeats, clock)]


def fastest(*functions, repeats=25, clock=None):
    """
    Return the least time (s) of each function, run in turns.

    The clock is that of the wall if all functions are short, else that of the processor. A
    short function is run three times a turn, as a fit does: the first finds the caches full
    of what the others left.
    """
    runs = 1
    if clock is None:
        long = any(kept[0] > _TURN for kept in _times(functions, 1, time.process_time))
        clock, runs = (time.process_time, 1) if long else (time.perf_counter, 3)
    return [min(kept) for kept in _times(functions, repeats, clock, runs)]


def _times(functions, repeats, clock, runs=1):
    times = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(repeats):
        for kept, function in zip(times, functions, strict=True):
            for _ in range(runs):
                started = clock()
                function()
                kept.append(clock() - started)
    return times


def in_new_process(function, *arguments):
    """Return the result of a function, and the most memory (MB) that a process of its own had.

    The peak of the system's accounting survives the start of another program in a process, and so
    would be that of who started it; the one that is asked for here is forgotten first.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_with_memory, function, arguments).result()


def _with_memory(function, arguments):
    # Linux: the largest resident set is counted from now on
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    result = function(*arguments)
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return result, int(re.search(r"VmHWM:\s+(\d+)", text)[1]) / 1024
