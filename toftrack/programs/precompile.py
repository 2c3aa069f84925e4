"""Before the first frame: kernels that were never compiled here are, by two processes at once.

numba compiles one kernel after the other in a process, and keeps the code on the disk for all. The
second process compiles what poses a single hand (refinement, decoding, penalty, OpenXR), whose
kernels have functions in common; the first process all others, which takes as long. What only some
recordings need (the median of large images, handedness) is compiled when they do.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import warnings
from multiprocessing.process import BaseProcess

import numpy as np
import torch
from omegaconf import DictConfig

from toftrack.api import build_hands_tracker, compute_device
from toftrack.compute.threads import small_operations
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
            helper.join()
            _load(tracker.model)
    finally:
        if helper is not None:
            helper.kill()
            helper.join()
    return tracker


def _compile_here(model: FilterModel) -> None:
    """What the second process leaves, the largest kernel first."""
    from toftrack.detector.proposals_numba import compile_crops
    from toftrack.refinement.seen_points_numba import nearest_of_labels, smooth_points
    from toftrack.render.numba.bands import evidence_images
    from toftrack.tracking.confidence_numba import count_out_of_sight, seen_around

    model.backend.make_scorer(model.configured.shape)
    compile_crops()
    pixel, hand = np.ones((1, 1), np.float32), np.ones((1, 1), bool)
    smooth_points(pixel, hand, (0, 0), np.eye(3, dtype=np.float32), 1.0, 1.0)
    nearest_of_labels(np.ones((1, 1), np.int32), hand, (0, 0))
    evidence_images(pixel, hand, hand, None, 1.0)
    joint = np.ones((1, 3), np.float32)
    count_out_of_sight(joint, pixel, np.eye(3))
    seen_around(joint, 1.0, 1.0, pixel, np.eye(3))


def _load(model: FilterModel) -> None:
    """The networks, and what the second process compiled."""
    if isinstance(model, TrackerModel):
        nothing = np.zeros((72, 88), np.float32)
        k = np.array([[110.0, 0, 44], [0, 110.0, 36], [0, 0, 1]])
        model.detector.detect(nothing, k, np.array([[0.0, 0.0, 0.5]]), model.configured.shape.side)


def _helper(config: DictConfig) -> BaseProcess | None:
    """The second process; None where there is nothing to do for it, or no core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    numba = config.renderer in ("auto", "numba") and compute_device(config.compute).type == "cpu"
    # A process that ends with another one may have none of its own.
    alone = getattr(sys, "frozen", False) or multiprocessing.current_process().daemon
    if (cores or 1) < 2 or not numba or alone:
        return None
    from numba.core.registry import cpu_target

    from toftrack.compute.compiling import must_be_compiled
    from toftrack.refinement.gauss_newton_numba import refine_hands

    if not must_be_compiled(refine_hands):
        return None
    _log.info("compiling kernels (once on a machine, about 10 s)")
    cpu_target.target_context.refresh()  # what numba loads at its first compilation, for both
    # A copy of this process has imported everything already; elsewhere libraries forbid copies.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    helper: BaseProcess = context.Process(target=_compile_beside, daemon=True)  # type: ignore
    with warnings.catch_warnings():
        # Of threads, which are not in the copy: it computes on one, and ends without tidying up.
        warnings.simplefilter("ignore", DeprecationWarning)
        helper.start()
    return helper


def _compile_beside() -> None:
    """What the second process does. Whatever it cannot compile, the first one will."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_DFL)
    logging.disable()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in (1, 2):
        os.dup2(nowhere, standard)
    with small_operations():
        compile_poses()


def compile_poses() -> None:
    """The kernels that pose a single hand, the largest one first."""
    from toftrack.detector.proposals_numba import compile_decoding
    from toftrack.hand.openxr_numba import openxr_hand_compiled
    from toftrack.refinement.gauss_newton_numba import CompiledRefiner

    shape = default_hand_shape()
    CompiledRefiner(shape)
    compile_decoding()
    joints = forward_kinematics(torch.zeros(1, 27), shape).joints_m
    openxr_hand_compiled(joints[0].numpy(), np.zeros(27), openxr_rig(shape))
