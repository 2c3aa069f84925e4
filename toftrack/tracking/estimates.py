"""What a step tells of a frame: its estimate, or that there is no hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.compute.transfer import on_device, on_host
from toftrack.estimate import Estimate, lost_estimate, no_estimate
from toftrack.frames import DepthImage
from toftrack.gestures.recognition import tell_gesture
from toftrack.hand.shape import HandShape
from toftrack.render.segmentation import Observation
from toftrack.tracking import particle_filter
from toftrack.tracking.conventions import in_all_conventions
from toftrack.tracking.following import Found
from toftrack.tracking.handedness_estimate import probability
from toftrack.tracking.joint_confidence import propagated_sigma
from toftrack.tracking.life_cycle import Status
from toftrack.tracking.model import FilterModel, ObservedFrame
from toftrack.tracking.spans import Spans
from toftrack.tracking.state import StepInfo, TrackerState


def estimate_of(
    image: DepthImage, found: Found, score: float, belief: Status, frame: ObservedFrame
) -> Estimate:
    """What is told of a frame, but for its joints' deviations and what `emitted` adds."""
    model, mean, particles = frame.model, found.mean, found.particles
    mean = on_device(mean, model.device)
    tangents = model.backend.motions.difference(particles, mean)
    tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
    covariance, effective = on_host(
        particle_filter.covariance(tangents, found.weights),
        particle_filter.effective_sample_size(found.weights),
    )
    return Estimate(
        index=image.index,
        timestamp_s=image.timestamp_s,
        state_name=belief.state_name,
        lost=belief.lost,
        confidence=belief.confidence,
        outside_rad=found.off_rad,
        joints_m=_host(frame.hand.refiner.joints(found.pose)[0]),
        state=_host(found.pose[0]),
        latent=_host(model.space.encode(found.pose[:, 6:])[0]),
        score=score,
        covariance=_host(covariance + torch.diag(model.model_variance)),
        effective_sample_size=float(effective),
        compute_s=math.nan,
    )


def particles_sigma(joints_m: np.ndarray, found: Found, frame: ObservedFrame) -> np.ndarray:
    """(21, 3) standard deviations of joints by the particles alone, as joint_sigma_m has them."""
    model = frame.model
    motions = model.backend.motions

    def joints_of(tangents: Tensor) -> Tensor:
        moved = motions.compose(found.refined.repeat(len(tangents), 1), tangents)
        return frame.hand.refiner.joints(model.decode(moved, found.offset))

    around = motions.difference(found.particles, on_device(found.mean, model.device))
    (covariance,) = on_host(particle_filter.covariance(around, found.weights))
    return propagated_sigma(joints_m, covariance + torch.diag(model.model_variance), joints_of)


def emitted(
    state: TrackerState,
    image: DepthImage,
    estimate: Estimate,
    shape: HandShape,
    dt_s: float,
    model: FilterModel,
    spans: Spans,
) -> tuple[TrackerState, Estimate]:
    """The estimate with its gesture, its side, its time and other programs' conventions; and the
    state with what is kept of them.

    shape: the hand of the estimate.
    """
    gesture, estimate = tell_gesture(
        model.gestures, state.gesture, estimate, model.space, dt_s / FRAME_S
    )
    estimate = _sided(estimate, state, spans)
    size_px = image.depth_m.shape[1], image.depth_m.shape[0]
    estimate = in_all_conventions(estimate, shape, image.k, size_px)
    last = state.last
    # While there is no hand, the last estimate that was believed is told, if one was.
    kept = last if estimate.lost and last is not None and not last.lost else estimate
    return replace(state, gesture=gesture, last=kept), estimate


def no_hand(
    state: TrackerState,
    image: DepthImage,
    observation: Observation,
    model: FilterModel,
    spans: Spans,
) -> tuple[TrackerState, StepInfo, Estimate]:
    """Nothing in the frame can be a hand: the last estimate stands, and is lost; a track waits."""
    index, timestamp_s, last = image.index, image.timestamp_s, state.last
    if last is None:
        estimate = no_estimate(index, timestamp_s, "lost", model.space.dims, math.nan)
    else:
        estimate = lost_estimate(last, index, timestamp_s, math.nan)
    gesture, estimate = tell_gesture(model.gestures, None, estimate, model.space)
    none = torch.zeros(0, 6 + model.space.dims, device=model.device)
    info = StepInfo(observation, none, none[:, 0], spans.seconds())
    return replace(state, gesture=gesture), info, _sided(estimate, state, spans)


def _sided(estimate: Estimate, state: TrackerState, spans: Spans) -> Estimate:
    return replace(
        estimate,
        side=state.side,
        side_probability=probability(state.sides, state.side),
        compute_s=spans.total(),
    )


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(np.float32)
