# Licensed under a 3-clause BSD style license - see LICENSE
"""Tasks on processes, of which some fail, die or take too long."""

import math
import os
import time

import pytest

from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.pipeline.tasks import ended_tasks


def ended(function, tasks, **options):
    return {
        each.task: (each.result, each.reason) for each in ended_tasks(function, tasks, **options)
    }


@pytest.mark.slow
def test_a_task_that_fails_gives_its_reason_and_stops_no_other():
    found = ended(math.sqrt, [4, -1, 9, "x"], workers=2)
    assert found[4] == (2.0, None)
    assert found[9] == (3.0, None)
    assert found[-1] == (None, "math domain error")
    assert found["x"][1].startswith("TypeError: must be real number")


@pytest.mark.slow
def test_a_process_that_dies_takes_its_task_only():
    found = ended(os._exit, [3, 0], workers=2)
    assert found[3] == (None, "the process that worked on it died 3 times (exit status 3)")
    assert "exit status 0" in found[0][1]


@pytest.mark.long
def test_a_task_that_takes_too_long_is_given_up():
    started = time.monotonic()
    found = ended(time.sleep, [60, 0.01, 0.02], workers=2, timeout=2)
    assert found[60] == (None, "it took longer than 2 s")
    assert found[0.01] == found[0.02] == (None, None)
    assert time.monotonic() - started < 30


@pytest.mark.slow
def test_processes_are_renewed(monkeypatch):
    """So that no library can use more and more memory."""
    from astropolcal.pipeline import tasks

    monkeypatch.setattr(tasks, "_MOST_TASKS", 2)
    found = [
        each.result for each in ended_tasks(eval, ["__import__('os').getpid()"] * 5, workers=1)
    ]
    assert [found.count(pid) for pid in dict.fromkeys(found)] == [2, 2, 1]


def test_tasks_are_drawn_as_they_are_begun():
    drawn = []

    def tasks():
        for number in range(100):
            drawn.append(number)
            yield number

    running = ended_tasks(math.sqrt, tasks(), workers=2)
    next(running)
    assert len(drawn) < 10
    running.close()


def test_bad_input():
    with pytest.raises(ParameterError, match="workers = 0; a number above zero"):
        ended(math.sqrt, [4], workers=0)
    with pytest.raises(ParameterError, match="timeout = -1"):
        ended(math.sqrt, [4], timeout=-1)


@pytest.mark.long
def test_a_cluster_does_the_same():
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    options = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with distributed.LocalCluster(processes=False, **options) as cluster:
        found = ended(math.sqrt, [4, -1, 9], cluster=cluster.scheduler_address)
        late = ended(time.sleep, [5, 0.01], cluster=cluster.scheduler_address, timeout=1)
    assert found == {4: (2.0, None), -1: (None, "math domain error"), 9: (3.0, None)}
    assert late[5] == (None, "no answer within 2 s")


def test_a_cluster_that_does_not_answer(monkeypatch):
    pytest.importorskip("distributed", reason="distributed is not installed")
    from astropolcal.pipeline import tasks

    monkeypatch.setattr(tasks, "_TIMEOUT", 0.5)
    with pytest.raises(AstropolcalError, match=r"cluster tcp://127\.0\.0\.1:1: cannot be used"):
        ended(math.sqrt, [4], cluster="tcp://127.0.0.1:1")
