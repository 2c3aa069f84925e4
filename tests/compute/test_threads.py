"""Who may use how many threads, and how they share tasks."""

import functools

import numpy as np
import pytest
import torch

from toftrack.compute import compiling
from toftrack.compute.compiling import entry_point
from toftrack.compute.threads import beside, run_shared, small_operations, threads


@entry_point
def _count(counter, done):
    while True:
        i = compiling.take(counter)
        if i >= len(done):
            break
        done[i] += 1


def test_small_operations_leave_the_threads_to_others() -> None:
    torch.set_num_threads(3)  # `one_thread` of conftest.py takes it back
    allowed = threads()
    with small_operations():
        assert torch.get_num_threads() == 1
        assert threads() == allowed
    assert torch.get_num_threads() == 3


@pytest.mark.parametrize("tasks", [0, 1, 1000])
def test_every_task_is_done_once(tasks: int) -> None:
    done = np.zeros(tasks, np.int64)
    run_shared(functools.partial(_count, np.zeros(1, np.int64), done), tasks)
    assert (done == 1).all()


def test_what_fails_in_a_thread_fails_here() -> None:
    def task() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        run_shared(task, 1)


@pytest.mark.parametrize("count", [1, 2])
def test_a_task_beside_is_waited_for_and_fails_where_it_is_waited_for(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toftrack.compute.threads.threads", lambda: count)
    assert beside(lambda: 7)() == 7
    waits = beside(lambda: [][0])
    with pytest.raises(IndexError):
        waits()
