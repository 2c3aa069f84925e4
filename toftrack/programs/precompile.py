"""Before the first frame: kernels that were never compiled here are, by two processes at once.

numba compiles one kernel after the other in a process, and keeps the code on the disk for all.
`python -m toftrack.programs.precompile` is the second process; it compiles the refinement's, and
what else takes a second.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

import toftrack
from toftrack.api import build_hands_tracker, compute_device
from toftrack.hand.openxr import openxr_rig
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.tracking.model import FilterModel, TrackerModel
from toftrack.tracking.tracker import HandsTracker

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


def _compile_here(model: FilterModel) -> None:
    """The large kernels but for the one that the second process compiles."""
    model.backend.make_scorer(model.configured.shape)
    if isinstance(model, TrackerModel):
        nothing = np.zeros((72, 88), np.float32)
        k = np.array([[110.0, 0, 44], [0, 110.0, 36], [0, 0, 1]])
        model.detector.detect(nothing, k, np.array([[0.0, 0.0, 0.5]]), model.configured.shape.side)


def _helper(config: DictConfig) -> subprocess.Popen | None:
    """The second process; None where there is nothing to do for it, or no core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    numba = config.renderer in ("auto", "numba") and compute_device(config.compute).type == "cpu"
    if (cores or 1) < 2 or not numba or getattr(sys, "frozen", False):
        return None
    from toftrack.compute.compiling import must_be_compiled
    from toftrack.refinement.gauss_newton_numba import refine_hands

    if not must_be_compiled(refine_hands):
        return None
    _log.info("compiling kernels (once on a machine, about 10 s)")
    here = str(Path(toftrack.__file__).parents[1])
    places = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-m", "toftrack.programs.precompile"],
        env=os.environ | {"PYTHONPATH": places},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def main() -> None:
    """What the second process does."""
    from toftrack.hand.openxr_numba import openxr_hand_compiled
    from toftrack.refinement.gauss_newton_numba import CompiledRefiner
    from toftrack.refinement.penalty_numba import joints_penalty
    from toftrack.refinement.seen_points_numba import nearest_of_labels, smooth_points
    from toftrack.render.numba.median import thinned

    shape = default_hand_shape()
    CompiledRefiner(shape)
    pixel, hand = np.ones((1, 1), np.float32), np.ones((1, 1), bool)
    smooth_points(pixel, hand, (0, 0), np.eye(3, dtype=np.float32), 1.0, 1.0)
    nearest_of_labels(np.ones((1, 1), np.int32), hand, (0, 0))
    joints = forward_kinematics(torch.zeros(1, 27), shape).joints_m
    joints_penalty(joints, shape.hand_length_m, 1.0, None, 0.0)
    openxr_hand_compiled(joints[0].numpy(), np.zeros(27), openxr_rig(shape))
    thinned(np.zeros((3, 3), np.float32), 3, 1)  # of images that are reduced


if __name__ == "__main__":
    main()
