"""A forked process tracks, whatever the one before did, and ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
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


@pytest.mark.parametrize("tracker", ["the same", "another"])
def test_a_process_forked_after_tracking_tracks_and_ends(tracker: str) -> None:
    with _several_threads():
        used = make_tracker(*QUICK)
        _follow(used)
        context = multiprocessing.get_context("fork")
        if tracker == "the same":
            child = context.Process(target=_follow, args=(used,))
        else:
            child = context.Process(target=_follow_anew)
        child.start()
        try:
            child.join(_LIMIT_S)
            assert child.exitcode == 0
        finally:
            child.kill()
            child.join()
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
    child = os.fork()
    if child == 0:
        with compiling.lock:
            os._exit(7)
    thread.join()
    assert _status(child) == 7


def _status(child: int) -> int:
    """How a process ended; one that does not is ended."""
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


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
