"""The paper's tracker, whole: a rough start, segmentation, the particle filter, its mean.

Gudmundsson et al., "Model-based hand gesture tracking in ToF image sequences", AMDO 2010. No
networks, no refinement, no fitting of the hand, no way back. docs/paper.md says what differs from
print.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.pace import Spans
from toftrack.compute.particle_filter import Spread, covariance
from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.threads import small_operations
from toftrack.compute.transfer import on_device, on_host
from toftrack.errors import ToftrackError, check_number
from toftrack.frames.frame import DepthImage
from toftrack.hand.regions import joint_axes
from toftrack.render.segmentation import Observation
from toftrack.tracking.confidence import Status
from toftrack.tracking.filter import predict, run_filter, update_velocity
from toftrack.tracking.model import FilterModel, FittedHand
from toftrack.tracking.posterior import ImageTerm
from toftrack.tracking.report import StepResult, finish_estimate, make_estimate, report_absence
from toftrack.tracking.state import ParticleSet, StepInfo, Track, TrackerState, changed

_WIDEST_PALM_M, _HALF_PALM_M = 0.06, 0.012
"""Half the breadth of the broadest palm with the ball of the thumb, and half its thickness."""
_DEPTH_M, _DEPTH_EDGE_M = 0.12, 0.04
"""How far behind the nearest surface a palm typically lies at most; between neighbouring pixels of
one surface there is less than the latter."""


@dataclass(frozen=True)
class RoughStart:
    """The paper's rough manual positioning: an open palm, put by hand or where the nearest blob is.

    pose: wrist translation (3, m) and rotation vector (3, rad); None takes the position from the
        image and points the fingers up with the palm towards the camera.
    position_m, rotation_rad: standard deviations of the particles about it.
    """

    pose: tuple[float, ...] | None
    position_m: float
    rotation_rad: float

    def __post_init__(self) -> None:
        if self.pose is not None and len(self.pose) != 6:
            raise ToftrackError(
                f"start.pose has {len(self.pose)} numbers; give six: translation in metres and"
                " rotation vector in radians"
            )
        for number, value in enumerate(self.pose or ()):
            check_number(f"start.pose[{number}]", value)
        for name in ("position_m", "rotation_rad"):
            check_number(f"start.{name}", getattr(self, name), 0)

    def __call__(
        self, observation: Observation, model: FilterModel, generator: torch.Generator
    ) -> Track:
        """A track at the rough start; the observation must not be empty."""
        space, n = model.space, model.filter.particles
        reference = torch.zeros(1, 6 + space.dims)
        rows = [label == "palm" for label in space.training_labels]
        reference[0, 6:] = space.training_latents[rows.index(True) if True in rows else 0]
        if self.pose is None:
            centre = torch.from_numpy(palm_centre(observation))
            reference[0, :3] = centre - reference.new_tensor(PIVOT_M)
        else:
            reference[0, :6] = torch.tensor(self.pose)
        spread = Spread(self.position_m, self.position_m, self.rotation_rad, 0.0)
        noise = torch.randn(n, 6 + space.dims, generator=generator)
        tangents = noise * spread.sigmas(space.lower, space.upper)
        particles = model.backend.motions.compose(reference, tangents)
        there = on_device(particles, model.device)
        weights = there.new_full((n,), 1.0 / n, dtype=torch.float64)
        mean, still = particles[:1], particles.new_zeros(6 + space.dims)
        cloud, side = ParticleSet(there, weights, mean), model.configured.shape.side
        return Track(cloud, still, model.decode(mean), side=side)


def palm_centre(observation: Observation) -> np.ndarray:
    """(3,) float32 m, roughly the middle of the palm of an observation on the CPU.

    It is the centre of the widest and nearest disc that is inscribed in the silhouette cut along
    its depth edges, so that a hand in front of the body stands by itself, and no wider than a palm,
    so that it does not lie on the body.
    """
    hand, depth = observation.hand.numpy(), observation.depth_m.numpy()
    k, kernel = observation.k.numpy(), np.ones((3, 3), np.uint8)
    far = np.where(hand, depth, depth.max()).astype(np.float32)
    smooth = hand & (cv2.dilate(far, kernel) - cv2.erode(far, kernel) < _DEPTH_EDGE_M)
    inside = smooth if smooth.any() else hand
    # The border of the image counts as the silhouette's edge, or an arm that leaves the picture
    # would be widest there.
    focal = float(k[0, 0])
    margin = 1 + math.ceil(_WIDEST_PALM_M * focal / max(observation.nearest_m, 0.1))
    silhouette = np.pad(inside.astype(np.uint8), margin)
    depths = np.pad(depth, margin, mode="edge")
    nearness = np.exp(-(depths - observation.nearest_m) / _DEPTH_M)
    distance = cv2.distanceTransform(silhouette, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    peaks = distance >= cv2.dilate(distance, np.ones((5, 5), np.uint8)) - 0.5
    radius_m = distance * depths / focal
    usable = (silhouette > 0) & peaks & (radius_m < _WIDEST_PALM_M)
    weights = np.where(usable, radius_m**3 * nearness, 0.0)
    if not weights.any():
        weights = silhouette.astype(np.float64)
    row, column = np.divmod(int(weights.argmax()), weights.shape[1])
    v, u = row - margin, column - margin
    # Noise and flying pixels: the median of a neighbourhood, wherever it is mostly hand.
    median = cv2.medianBlur(np.where(hand, depth, 0).astype(np.float32), 5)[v, u]
    z = (median if median > 0 else depth[v, u]) + _HALF_PALM_M
    return np.array(((u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z), np.float32)


@dataclass(frozen=True)
class ScoreThreshold:
    """A frame whose estimate scores less than `score`, 0 .. 1, is lost; tracking goes on."""

    score: float

    def __post_init__(self) -> None:
        check_number("lost.score", self.score, 0, 1)

    def judge(self, track: Track, score: float) -> Status:
        """The status of an estimate with a score."""
        if score < self.score:
            return Status("recovering", True)
        return Status("tracking" if track.age.begun else "initialising", False)


@dataclass(frozen=True, eq=False)
class PaperModel(FilterModel):
    """The parts of the paper's tracker."""

    start: RoughStart
    lost: ScoreThreshold


@small_operations()
def paper_step(state: TrackerState, image: DepthImage, model: PaperModel) -> StepResult:
    """The next state and its slot's report: segment, start without a track, filter, take the mean.

    It leaves `state` unchanged. In an image without a surface, the particles stay as they are.
    """
    spans, generator, dt_s = Spans(), state.random_generator(), state.elapsed_s(image)
    state = state.at(image)
    (slot,), track = state.slots, state.tracks[0] if state.tracks else None
    fitted, sure = model.hand(slot.side, slot.shape), 1.0 if state.told else 0.5
    with spans("segmentation and evidence"):
        expected = predict(track, dt_s, model).expected if track else None
        observation = model.segmentation(image.depth_m, image.k, expected)
        if observation.empty:
            slot, estimate = report_absence(slot, image, model, 1)
            estimate = estimate.updated(side=slot.side, side_probability=sure)
            none = torch.zeros(0, 6 + model.space.dims, device=model.device)
            info = StepInfo(observation, none, none[:, 0], spans.seconds())
            return changed(state, slots=(slot,)), (info,), (estimate,)
        likelihood = ImageTerm(model, observation, fitted.scorer)
    with spans("start"):
        track = track or model.start(observation, model, generator)
    with spans("filter: rest"):
        (filtered,) = run_filter([track], dt_s, [likelihood], model, [generator], spans)
        pose = model.decode(filtered.mean)
    score = likelihood.score(pose)
    status = model.lost.judge(track, score)
    estimate = make_estimate(image, filtered, pose, score, status, fitted, model)
    joints_m, particle = estimate.joints_m, model.encode(pose)
    hidden = bool(observation.occluder.any())
    track = changed(
        track,
        cloud=filtered,
        velocity=update_velocity(track, filtered.mean, dt_s, model),
        pose=pose,
        age=track.age.extended(dt_s),
        confirmed=track.confirmed or not status.lost,
        believed_s=track.believed_s + dt_s if status.lost else 0.0,
        nearest_m=expected.nearest_m if expected and hidden else 0.0,
    )
    ok = np.full(len(joints_m), not status.lost)  # of its joints nothing more is known
    estimate = estimate.updated(
        joint_sigma_m=lambda: _joint_sigma(joints_m, filtered, particle, fitted, model),
        joint_ok=ok,
        side=slot.side,
        side_probability=sure,
    )
    slot, estimate = finish_estimate(slot, image, estimate, fitted.shape, dt_s, model)
    info = StepInfo(observation, filtered.particles, filtered.weights, spans.seconds())
    slot = changed(slot, track=track.number)
    state = changed(state, generator=generator.get_state(), slots=(slot,), tracks=(track,))
    return state, (info,), (estimate,)


@small_operations()
def _joint_sigma(
    joints_m: np.ndarray,
    filtered: ParticleSet,
    particle: Tensor,
    fitted: FittedHand,
    model: FilterModel,
) -> np.ndarray:
    """(21, 3) m, standard deviations of joints (21, 3) of an estimate with a particle (1, 6 + d) by
    the particles and the hand model's own error.
    """
    motions = model.backend.motions

    def joints_of(tangents: Tensor) -> Tensor:
        moved = motions.compose(particle.repeat(len(tangents), 1), tangents)
        return fitted.refiner.joints(model.decode(moved))

    around = motions.difference(filtered.particles, on_device(filtered.mean, model.device))
    (spread,) = on_host(covariance(around, filtered.weights))
    return propagated_sigma(joints_m, spread + torch.diag(model.model_variance), joints_of)


def propagated_sigma(
    joints_m: np.ndarray, covariance: Tensor, joints_of: Callable[[Tensor], Tensor]
) -> np.ndarray:
    """(21, 3) m, deviations of joints (21, 3) along joint_axes by a covariance (6 + d, 6 + d) of
    tangents.  joints_of: joints (N, 21, 3) of the estimate moved by tangents (N, 6 + d).
    """
    size = len(covariance)
    # One step along each main axis and back; a covariance may be singular, so no Cholesky.
    values, vectors = torch.linalg.eigh(covariance.double())
    steps = (vectors * values.clamp(min=0).sqrt()).mT.to(covariance.dtype)
    moved = joints_of(torch.cat((steps, -steps))).double().numpy()
    half = 0.5 * (moved[:size] - moved[size:])
    along = np.einsum("jab,njb->nja", joint_axes(joints_m), half)
    sigma: np.ndarray = np.sqrt(np.square(along).sum(0)).astype(np.float32)
    return sigma
