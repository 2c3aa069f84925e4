"""A forked process tracks, whatever the one before did, and ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from helpers.programs import QUICK
from helpers.tracking import ROOT, make_tracker, sample

from toftrack.api import compute_device
from toftrack.compute import compiling
from toftrack.errors import ToftrackError
from toftrack.tracking.tracker import Tracker

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs /proc")
_LIMIT_S = 100.0
"""A process that takes so long hangs."""


@contextmanager
def _several_threads() -> Iterator[None]:
    """OpenMP has threads in this process, which a forked one will lack."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.ones(1 << 20).exp().sum()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _follow(tracker: Tracker) -> None:
    scene = sample()
    found = [tracker.step(depth, scene.k) for depth in scene.depth_m[:3]]
    assert found[-1].state_name == "tracking"
    assert all(one.values() for one in found), "what is computed on demand, too"


def _follow_anew() -> None:
    _follow(make_tracker(*QUICK))


def _ends_well(task: Callable[..., None], *given: object) -> bool:
    """Whether a forked process does a task and ends; one that does not is ended."""
    child = multiprocessing.get_context("fork").Process(target=task, args=given)
    child.start()
    child.join(_LIMIT_S)
    child.kill()
    child.join()
    return child.exitcode == 0


@pytest.mark.parametrize("tracker", ["the same", "another"])
def test_a_process_forked_after_tracking_tracks_and_ends(tracker: str) -> None:
    with _several_threads():
        used = make_tracker(*QUICK)
        _follow(used)
        assert _ends_well(_follow, used) if tracker == "the same" else _ends_well(_follow_anew)
        _follow(used)


def test_a_fork_waits_until_another_thread_has_compiled() -> None:
    """Or the forked process would wait for a lock that nobody there will release."""
    begun, go_on = threading.Event(), threading.Event()

    def compile_something() -> None:
        with compiling.lock:
            begun.set()
            go_on.wait(_LIMIT_S)

    thread = threading.Thread(target=compile_something)
    thread.start()
    begun.wait(_LIMIT_S)
    threading.Timer(0.1, go_on.set).start()
    assert _ends_well(_take_the_lock)
    thread.join()


def _take_the_lock() -> None:
    with compiling.lock:
        pass


PROGRAM = """
import os, sys
import toftrack

settings = sys.argv[1:]
def follow(tracker):
    with toftrack.make_device("device=synthetic", "device.frames=3") as device:
        for frame in device:
            depth_m = device.camera.rectify(frame.depth, frame.radial)
            estimate = tracker.step(depth_m, device.camera.K)
    return estimate.state_name

child = os.fork()
if child == 0:
    print("child", follow(toftrack.make_tracker(*settings)), flush=True)
    os._exit(0)  # as multiprocessing does: at sys.exit ONNX Runtime 1.29 and later wait for ever
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print("parent", follow(toftrack.make_tracker(*settings)), status, flush=True)
"""


@pytest.mark.slow
def test_a_program_that_forks_before_it_tracks_goes_on_in_both_processes() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *QUICK],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "2"},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        reported, _ = process.communicate(timeout=2 * _LIMIT_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    assert reported.splitlines() == ["child tracking", "parent tracking 0"]
    assert process.returncode == 0


def test_after_a_fork_of_a_process_with_a_gpu_it_is_refused(monkeypatch) -> None:
    def init() -> None:
        raise RuntimeError("Cannot re-initialize CUDA in forked subprocess")

    monkeypatch.setattr(torch.cuda, "init", init)
    with pytest.raises(ToftrackError, match="multiprocessing's spawn, or give compute=cpu"):
        compute_device("cuda")
    for name in ("auto", "cpu"):
        assert compute_device(name).type == "cpu"
