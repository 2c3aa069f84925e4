"""Before the first frame: kernels that were never compiled here are, by two processes at once.

numba compiles one kernel after the other in a process, and keeps the code on the disk for all.
`python -m toftrack.programs.ahead` is the second process; it compiles the refinement's.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

import toftrack
from toftrack.api import build_hands_tracker, compute_device
from toftrack.hand.shape import default_hand_shape
from toftrack.tracking.hands import HandsTracker
from toftrack.tracking.model import TrackerModel

_log = logging.getLogger(__name__)


def ready_tracker(config: DictConfig) -> HandsTracker:
    """The tracker of a configuration, with its kernels compiled."""
    helper = _helper(config)
    try:
        tracker = build_hands_tracker(config)
        if helper is not None:
            _compile_here(tracker.model)
            helper.wait()
    finally:
        if helper is not None:
            helper.kill()
            helper.wait()
    return tracker


def _compile_here(model: TrackerModel) -> None:
    """The large kernels but for the one that the second process compiles."""
    model.backend.make_scorer(model.shape)
    if model.relocaliser is not None:
        nothing = np.zeros((72, 88), np.float32)
        k = np.array([[110.0, 0, 44], [0, 110.0, 36], [0, 0, 1]])
        model.relocaliser.glance(nothing, k, np.array([[0.0, 0.0, 0.5]]), model.shape.side)


def _helper(config: DictConfig) -> subprocess.Popen | None:
    """The second process; None where there is nothing to do for it, or no core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    numba = config.renderer in ("auto", "numba") and compute_device(config.compute).type == "cpu"
    if (cores or 1) < 2 or not numba or getattr(sys, "frozen", False):
        return None
    try:
        from toftrack.refinement.gauss_newton_numba import refine_hands
    except ImportError:  # without numba everything is done by torch
        return None
    if not must_be_compiled(refine_hands):
        return None
    _log.info("compiling kernels (once on a machine, about 10 s)")
    here = str(Path(toftrack.__file__).parents[1])
    places = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-m", "toftrack.programs.ahead"],
        env=os.environ | {"PYTHONPATH": places},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def must_be_compiled(kernel: Any) -> bool:
    """Whether an entry point's code is not on the disk, but can be kept there."""
    folder = kernel.stats.cache_path
    if folder is None or kernel.signatures:
        return False
    return not any(Path(folder).glob(f"*.{kernel.py_func.__qualname__}-*.nbi"))


def main() -> None:
    """What the second process does."""
    from toftrack.refinement.gauss_newton_numba import CompiledRefiner

    CompiledRefiner(default_hand_shape())


if __name__ == "__main__":
    main()
