# Licensed under a 3-clause BSD style license - see LICENSE
"""
How long work is done: in one thread, and with how much is done and the time left in one line.

The line is written over, and erased at the end. It needs a terminal, and is asked for: by a
function with ``progress=True``, or the command line without ``--quiet``, see `shown`.
"""

import shutil
import sys
import time
from contextlib import ContextDecorator, contextmanager
from contextvars import ContextVar
from datetime import timedelta
from threading import Lock

__all__ = []

# seconds after which work is long, and between two looks of the line
_LONG, _BETWEEN = 2.0, 0.1
_LINE = ContextVar("line", default=None)


class _Line:
    """The last line of a terminal; ``is_taken`` while a count is shown in it."""

    def __init__(self):
        self.began, self.written, self.length = time.monotonic(), 0.0, 0
        self.stage, self.is_taken = "", False

    def write(self, words):
        # a line that is longer than the terminal could not be written over
        text = words[: shutil.get_terminal_size().columns - 1]
        print(f"\r{text.ljust(self.length)}", end="" if text else "\r", file=sys.stderr, flush=True)
        self.written, self.length = time.monotonic(), len(text)

    def count(self, done, total, unit, rest):
        now = time.monotonic()
        if now - self.began > _LONG and now - self.written > _BETWEEN:
            left = f", {timedelta(seconds=round(rest))} left" if done else ""
            stage = f"{self.stage}: " if self.stage else ""
            self.write(f"astropolcal: {stage}{done} of {total} {unit}{left}")


@contextmanager
def shown(wanted=True):
    """Show how far the work inside is; what is inside that again has no line of its own."""
    if not wanted or _LINE.get() or not sys.stderr.isatty():
        yield
        return
    token = _LINE.set(_Line())
    try:
        yield
    finally:
        clear()
        _LINE.reset(token)


def clear():
    """Make room for a line that stays."""
    line = _LINE.get()
    if line and line.length:
        line.write("")


def stage(words):
    """Say what is done next, and after how many seconds."""
    line = _LINE.get()
    if line and not line.is_taken:
        line.stage = words
        line.write(f"astropolcal: {words} ({time.monotonic() - line.began:.0f} s)")


@contextmanager
def counting(total, unit, done=0):
    """Return what is called with how many more are done; ``done`` of them took no time."""
    line, began, first = _LINE.get(), time.monotonic(), done
    if line is None or line.is_taken or total < 2:
        yield lambda more=1: None
        return

    def add(more=1):
        nonlocal done
        done += more
        rest = (time.monotonic() - began) / max(done - first, 1) * (total - done)
        line.count(done, total, unit, rest)

    line.is_taken = True
    try:
        yield add
    finally:
        line.is_taken = False


def steps(items, unit, total=None, done=0):
    """Yield the items, and show how many are done."""
    with counting(done + len(items) if total is None else total, unit, done) as add:
        for item in items:
            yield item
            add()


class _OneThread(ContextDecorator):
    """The first of all that run at a time sets the limit, and the last lifts it."""

    def __init__(self):
        self.count, self.lock, self.limit = 0, Lock(), None

    def __enter__(self):
        # not above: what only loads a calibration needs neither. scipy brings a BLAS of its own,
        # which has to be there
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_limits

        with self.lock:
            if not self.count:
                self.limit = threadpool_limits(1, user_api="blas")
            self.count += 1

    def __exit__(self, *error):
        with self.lock:
            self.count -= 1
            if not self.count:
                self.limit.restore_original_limits()


#: Decorator of what solves many small problems: more threads of BLAS gain nothing there, and where
#: other work takes the cores they wait for each other.
in_one_thread = _OneThread()
