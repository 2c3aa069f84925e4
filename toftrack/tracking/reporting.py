"""What is reported of a frame: the estimate of a hand, of one that is away, of an empty slot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toftrack.compute import particle_filter
from toftrack.compute.pace import FRAME_S
from toftrack.compute.transfer import on_device, on_host
from toftrack.estimate import Estimate, lost_estimate, no_estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import tell_gesture
from toftrack.hand.conventions import in_all_conventions
from toftrack.hand.shape import HandShape
from toftrack.tracking.filter import Found
from toftrack.tracking.lifecycle import Absence, Status
from toftrack.tracking.model import FilterModel, FittedHand
from toftrack.tracking.state import HandState, StepInfo

Concluded = tuple[int, HandState, StepInfo, Estimate]
"""A slot and its hand after a frame."""


def estimate_of(
    image: DepthImage,
    found: Found,
    score: float,
    status: Status,
    fitted: FittedHand,
    model: FilterModel,
) -> Estimate:
    """The estimate of a frame, but for its joints' deviations and what `emitted` adds."""
    particles, motions = found.filtered.particles, model.backend.motions
    mean = on_device(found.filtered.mean, model.device)
    tangents = motions.difference(particles, mean)
    tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
    covariance, effective = on_host(
        particle_filter.covariance(tangents, found.filtered.weights),
        particle_filter.effective_sample_size(found.filtered.weights),
    )
    return Estimate(
        index=image.index,
        timestamp_s=image.timestamp_s,
        state_name=status.state_name,
        lost=status.lost,
        confidence=status.confidence,
        outside_rad=found.off_rad,
        joints_m=_host(fitted.refiner.joints(found.pose)[0]),
        state=_host(found.pose[0]),
        latent=_host(model.space.encode(found.pose[:, 6:])[0]),
        score=score,
        covariance=_host(covariance + torch.diag(model.model_variance)),
        effective_sample_size=float(effective),
        compute_s=math.nan,
    )


def emitted(
    hand: HandState,
    image: DepthImage,
    estimate: Estimate,
    shape: HandShape,
    dt_s: float,
    model: FilterModel,
) -> tuple[HandState, Estimate]:
    """The estimate with its gesture, its side and other programs' conventions; and the hand with
    what is kept of them.

    shape: the hand of the estimate.
    """
    gesture, estimate = tell_gesture(
        model.gestures, hand.gesture, estimate, model.space, dt_s / FRAME_S
    )
    size_px = image.depth_m.shape[1], image.depth_m.shape[0]
    estimate = in_all_conventions(_sided(estimate, hand), shape, image.k, size_px)
    # While there is no hand, the last estimate that was believed is reported, if one was.
    kept = hand.last if estimate.lost and not hand.last.lost else estimate
    return replace(hand, gesture=gesture, last=kept), estimate


def no_hand(absence: Absence, image: DepthImage, model: FilterModel) -> Concluded:
    """Nothing in the frame is surely a hand: the last estimate stands, and is lost."""
    hand = absence.hand
    estimate = lost_estimate(hand.last, image.index, image.timestamp_s, math.nan)
    gesture, estimate = tell_gesture(model.gestures, None, estimate, model.space)
    none = torch.zeros(0, 6 + model.space.dims, device=model.device)
    info = StepInfo(absence.observation, none, none[:, 0], {})
    return absence.slot, replace(hand, gesture=gesture), info, _sided(estimate, hand)


def unseen(hand: HandState, image: DepthImage, model: FilterModel) -> Estimate:
    """The estimate of the hand that is asked for, of a frame in which it is not."""
    estimate = lost_estimate(hand.last, image.index, image.timestamp_s, math.nan)
    return _sided(tell_gesture(model.gestures, None, estimate, model.space)[1], hand)


def vacant(image: DepthImage, model: FilterModel) -> Estimate:
    """The estimate of a slot without a hand."""
    return no_estimate(image.index, image.timestamp_s, "lost", model.space.dims, math.nan)


def _sided(estimate: Estimate, hand: HandState) -> Estimate:
    probability = hand.handedness.probability(hand.side)
    return replace(estimate, side=hand.side, side_probability=probability)


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(np.float32)
