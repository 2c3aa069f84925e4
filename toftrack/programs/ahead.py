"""A second process that compiles kernels during the first run on a machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import toftrack
from toftrack.compute.compiling import nothing_kept

_PROGRAM = """
from toftrack import make_device, make_tracker
tracker = make_tracker("experiment=paper", "hand.side=right")
with make_device("device=sample", "device.stop=2") as device:
    for frame in device:
        tracker.step(frame.depth, device.camera.K)
"""
"""It tracks as the paper does. That needs what the default tracker needs last, so that each process
compiles another half."""


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Within, a second process compiles if nothing is compiled yet and there are cores for both."""
    helper = None
    if nothing_kept() and _cores() > 1:
        with suppress(OSError):
            helper = _helper()
    try:
        yield
    finally:
        if helper is not None:
            helper.terminate()
            helper.wait()


def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)  # Windows and macOS do without
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _helper() -> subprocess.Popen:
    packages = [str(Path(toftrack.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, packages))},
    )
