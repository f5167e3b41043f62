# Licensed under a 3-clause BSD style license - see LICENSE
"""
Many tasks on processes of this machine or on a cluster, none of which stops the others.

A task that fails gives its reason. One whose process dies is given to another process, and one that
takes too long is given up, with its process.
"""

import os
import signal
import threading
import time
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import connection, get_all_start_methods, get_context
from uuid import uuid4

from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.files import one_line

__all__ = []

# how often a task is begun whose processes die
_ATTEMPTS = 3
# seconds in which a cluster must answer, and between two looks at what runs
_TIMEOUT, _LOOK = 10, 1.0
# tasks that a cluster holds for each of its workers: one that runs and one that waits
_AHEAD = 2
_BEGUN = "begun"
# tasks after which a process ends and another begins, so that what libraries keep cannot add up
_MOST_TASKS = 500
# a process of a cluster may have several threads, but warnings and streams belong to all of them
_ALONE = threading.Lock()


@dataclass
class Ended:
    """A task that ended: its result, or in one line why there is none."""

    task: object
    result: object = None
    reason: str | None = None


def ended_tasks(function, tasks, *, workers=None, cluster=None, timeout=None, preload=()):
    """Yield what became of tasks, `Ended`, in the order in which they end.

    ``function`` and the tasks are pickled; the tasks are drawn as they are begun. Without a
    ``cluster``, the address of a scheduler of dask.distributed, there are so many processes
    (``workers``, by default the number of processors), which import the modules ``preload`` once.
    ``timeout`` are the seconds after which a task is given up.
    """
    workers = (os.cpu_count() or 1) if workers is None else workers
    for name, value in (("workers", workers), ("timeout", timeout)):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}; a number above zero is needed")
    if cluster is None:
        return _on_processes(function, iter(tasks), workers, timeout, list(preload))
    return _on_cluster(function, iter(tasks), cluster, timeout)


def _tried(function, task):
    """Return result and reason of a task."""
    with _ALONE, warnings.catch_warnings():
        try:
            return function(task), None
        except AstropolcalError as problem:
            return None, one_line(str(problem), None)
        except Exception as problem:
            return None, one_line(problem)


# ---- processes of this machine -------------------------------------------------------------------


class _Worker:
    """A process that works on one task after the other."""

    def __init__(self, context, function):
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, function))
        self.process.start()
        theirs.close()
        self.task = self.attempts = self.began = None
        self.n_tasks = 0

    def give(self, task, attempts):
        self.task, self.attempts, self.began = task, attempts + 1, None
        self.n_tasks += 1
        # one that died while it was idle is found when it is waited for
        with suppress(OSError):
            self.pipe.send(task)

    def late(self, timeout):
        """Return whether its task takes longer than that, its own start not counted."""
        return None not in (timeout, self.began) and time.monotonic() - self.began > timeout

    def answer(self):
        """Return that it has begun, or result and reason, or None if the process is dead."""
        try:
            return self.pipe.recv() if self.pipe.poll() else None
        except (EOFError, OSError):
            return None

    def end(self):
        self.pipe.close()
        self.process.kill()
        self.process.join()


def _serve(pipe, function):
    # an interruption from the keyboard goes to all processes; the first one ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # no more tasks, or nobody who gives them
    with suppress(EOFError, OSError):
        while True:
            task = pipe.recv()
            pipe.send(_BEGUN)
            pipe.send(_tried(function, task))


def process_context(preload):
    """Return how processes are started: from one that has the modules ``preload`` in memory."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    from multiprocessing import forkserver, resource_tracker

    context = get_context("forkserver")
    context.set_forkserver_preload(preload)
    # first: its start unblocks the signal
    resource_tracker.ensure_running()
    # no interruption ever reaches what the processes are forked from
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


@contextmanager
def _interrupted_later():
    """Put off an interruption from the keyboard: processes that are half started complain."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(True)) or signal.SIG_DFL
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


def _on_processes(function, tasks, workers, timeout, preload):
    context, busy, idle = process_context([__name__, *preload]), [], []
    again, fresh = [], ((task, 0) for task in tasks)
    try:
        while True:
            while len(busy) < workers and (given := again.pop() if again else next(fresh, None)):
                with _interrupted_later():
                    busy.append(idle.pop() if idle else _Worker(context, function))
                busy[-1].give(*given)
            if not busy:
                return
            places = [place for w in busy for place in (w.pipe, w.process.sentinel)]
            ready = connection.wait(places, None if timeout is None else _LOOK)
            for worker in list(busy):
                late = worker.late(timeout)
                if not (worker.pipe in ready or worker.process.sentinel in ready or late):
                    continue
                found = worker.answer()
                if found == _BEGUN:
                    worker.began = time.monotonic()
                    continue
                busy.remove(worker)
                if found is not None and worker.n_tasks < _MOST_TASKS:
                    idle.append(worker)
                else:
                    worker.end()
                if found is not None:
                    yield Ended(worker.task, *found)
                    continue
                if late:
                    yield Ended(worker.task, reason=f"it took longer than {timeout:g} s")
                elif worker.attempts < _ATTEMPTS:
                    again.append((worker.task, worker.attempts))
                else:
                    code = worker.process.exitcode
                    how = f"signal {-code}" if (code or 0) < 0 else f"exit status {code}"
                    why = f"the process that worked on it died {_ATTEMPTS} times ({how})"
                    yield Ended(worker.task, reason=why)
    finally:
        for worker in (*busy, *idle):
            worker.end()


# ---- a cluster -----------------------------------------------------------------------------------


def cluster_client(address):
    """Return a client of dask.distributed."""
    try:
        from distributed import Client
    except ImportError:
        raise AstropolcalError(
            'cluster needs dask, which is not installed: pip install "astropolcal[dask]"'
        ) from None
    try:
        return Client(address, timeout=_TIMEOUT)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise AstropolcalError(f"cluster {address}: cannot be used: {reason}") from error


def _on_cluster(function, tasks, address, timeout):
    from asyncio import CancelledError

    client, running, name = cluster_client(address), {}, uuid4().hex
    number = 0
    try:
        while True:
            # workers come and go
            room = _AHEAD * max(1, len(client.nthreads())) - len(running)
            for task in islice(tasks, max(room, 0)):
                # no result is kept: a task that is done again writes the same files
                key, number = f"astropolcal-{name}-{number}", number + 1
                future = client.submit(_tried, function, task, key=key, pure=False)
                running[future] = task, time.monotonic()
            if not running:
                return
            for future in _settled(running, timeout):
                task, _ = running.pop(future)
                try:
                    if not future.done():
                        future.cancel()
                        yield Ended(task, reason=f"no answer within {_AHEAD * timeout:g} s")
                    else:
                        yield Ended(task, *future.result())
                except CancelledError:
                    raise AstropolcalError(
                        f"cluster {address}: it is lost; run again to go on"
                    ) from None
                except Exception as problem:
                    # such as a task whose workers died again and again
                    yield Ended(task, reason=one_line(problem))
                future.release()
    except OSError as problem:
        raise AstropolcalError(f"cluster {address}: {one_line(problem)}") from problem
    finally:
        client.cancel(list(running))
        client.close()


def _settled(running, timeout):
    """Return the futures that ended, or were to have ended, after a look."""
    from distributed import wait

    with suppress(TimeoutError):
        wait(list(running), timeout=_LOOK, return_when="FIRST_COMPLETED")
    ended = [future for future in running if future.done()]
    if timeout is None:
        return ended
    # one may have waited for another on the same worker
    end = time.monotonic() - _AHEAD * timeout
    return ended + [f for f, (_, began) in running.items() if began < end and f not in ended]
