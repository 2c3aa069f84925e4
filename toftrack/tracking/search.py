"""Where the first hypotheses come from: a pose given by hand, the nearest blob, or a search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.backend import Motions
from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.rotations import (
    rotvec_composition,
    rotvec_geodesic_distance,
    rotvec_to_rotmat,
)
from toftrack.errors import ToftrackError
from toftrack.pose_space.base import PoseSpace
from toftrack.render.segmentation import Observation
from toftrack.tracking.forearm import arm_sight, forearm_conflict
from toftrack.tracking.palm_places import arm_exits, palm_centres
from toftrack.tracking.particle_filter import Spread, diffuse

_TURN_RAD = 0.3
"""Standard deviation of how far a hand has turned since it was lost."""

LogScores = Callable[[Tensor, float], Tensor]
"""(N, 6 + d) hypotheses and the weight of coverage to (N,) log scores of the current frame."""

Improve = Callable[[Tensor], Tensor]
"""(N, 6 + d) hypotheses to (N, 6 + d) brought onto the seen points, as far as the space allows."""


Prior = Callable[[Tensor], Tensor]
"""(N, 6 + d) hypotheses to (N,), added to their log scores."""


@dataclass(frozen=True)
class LastSeen:
    """The hand as it was last believed.

    particle: (1, 6 + d).  age_s: how long ago.
    """

    particle: Tensor
    age_s: float


@dataclass(frozen=True, eq=False)
class Sought:
    """What a start gets to see of a frame that is not empty, and of the hand that is sought in it.

    last: the hand as it was last believed, if it ever was.
    """

    observation: Observation
    space: PoseSpace
    motions: Motions
    log_scores: LogScores
    improve: Improve
    last: LastSeen | None


class Start(Protocol):
    """Makes the first particles."""

    def __call__(self, sought: Sought, n: int, generator: torch.Generator) -> Tensor:
        """(n, 6 + d) particles on the pose space's device."""

    def prior(self, observation: Observation, last: LastSeen | None) -> Prior:
        """What speaks for and against a start besides the score of the image."""


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

    def __call__(self, sought: Sought, n: int, generator: torch.Generator) -> Tensor:
        """See Start; nothing is scored."""
        space, device = sought.space, sought.space.lower.device
        reference = torch.zeros(1, 6 + space.dims, device=device)
        rows = [label == "palm" for label in space.training_labels]
        reference[0, 6:] = space.training_latents[rows.index(True) if True in rows else 0]
        if self.pose is not None:
            reference[0, :6] = torch.tensor(self.pose, device=device)
        else:
            centre = torch.from_numpy(palm_centres(sought.observation, 1, generator)[0]).to(device)
            reference[0, :3] = centre - reference.new_tensor(PIVOT_M)
        spread = Spread(self.position_m, self.position_m, self.rotation_rad, 0.0)
        noise = torch.randn(n, 6 + space.dims, generator=generator, device=device)
        return sought.motions.compose(reference, noise * spread.sigmas(space.lower, space.upper))

    def prior(self, observation: Observation, last: LastSeen | None) -> Prior:
        """See Start; nothing is known."""
        return lambda particles: particles.new_zeros(len(particles))


@dataclass(frozen=True)
class SearchStart:
    """Finds the hand anywhere in the blob: any orientation, palm or back, any training pose.

    Many hypotheses are scored at once; the best distinct ones become islands that are refined by
    a random local search of shrinking width. In every round as many hypotheses are scored, and half
    of the islands are given up (successive halving).

    hypotheses: in the first batch.  islands: how many are refined at first; a power of two.
    samples: hypotheses a round of refinement.
    improved: when so few islands are left, Gauss-Newton helps them on.
    coverage: as the likelihood's; among all poses it must be felt, or a hand that lies mostly
        outside of the image wins.
    position_m: spread about points of the blob.  tilt_rad: spread of the palm's tilt out of the
        image plane.
    arm_rad: spread of the forearm's direction about the way to where the blob leaves the image; a
        fifth of the hypotheses, and all where the blob does not touch the border, point anywhere.
    forearm: taken from the log score of a hand whose forearm cannot be, see forearm.py.
    memory: added to the log score of a hand that is turned as it was before it was lost ...
    memory_rad: ... with less the farther it has turned since (standard deviation) ...
    memory_s: ... and the longer ago it was (to 1/e). While that is less than two such times ago, a
        quarter of the hypotheses are turned and bent as then.
    """

    hypotheses: int
    islands: int
    coverage: float
    samples: int
    improved: int
    position_m: float
    tilt_rad: float
    arm_rad: float
    forearm: float
    memory: float
    memory_rad: float
    memory_s: float

    def __post_init__(self) -> None:
        for name, least in (("hypotheses", 1), ("islands", 1), ("samples", 1), ("improved", 0)):
            check_number(f"start.{name}", getattr(self, name), least, whole=True)
        for name in ("coverage", "position_m", "tilt_rad", "arm_rad", "forearm", "memory"):
            check_number(f"start.{name}", getattr(self, name), 0)
        for name in ("memory_rad", "memory_s"):
            check_number(f"start.{name}", getattr(self, name), 0, above=True)

    def __call__(self, sought: Sought, n: int, generator: torch.Generator) -> Tensor:
        """See Start."""
        space, log_scores = sought.space, sought.log_scores
        lower, upper = space.lower, space.upper

        def spread(particles: Tensor, sigmas: Tensor) -> Tensor:
            return diffuse(particles, sigmas, lower, upper, "reflect", sought.motions, generator)

        first = self._draw(sought.observation, space, sought.last, generator)
        scores = log_scores(first, self.coverage)
        best = first[scores.topk(min(self.islands, len(first))).indices]
        best_scores = scores.topk(len(best)).values
        sigmas = Spread(self.position_m, 0.015, 0.35, 0.15).sigmas(lower, upper)
        while True:
            each = max(1, self.samples // len(best))
            tried = spread(best.repeat_interleave(each, 0), sigmas)
            # Every island keeps what it had if nothing better was found.
            new_scores = log_scores(tried, self.coverage).view(-1, each)
            scores = torch.cat((best_scores[:, None], new_scores), 1)
            top, choice = scores.max(1)
            candidates = torch.cat((best[:, None], tried.view(len(best), each, -1)), 1)
            best = candidates[torch.arange(len(best), device=best.device), choice]
            keep = top.topk(max(1, len(best) // 2)).indices
            best, best_scores = best[keep], top[keep]
            if len(best) <= self.improved:
                better = sought.improve(best)
                new_scores = log_scores(better, self.coverage)
                wins = new_scores > best_scores
                best = torch.where(wins[:, None], better, best)
                best_scores = torch.maximum(best_scores, new_scores)
            if len(best) == 1:
                break
            sigmas = sigmas * 0.75
        return spread(best.expand(n, -1), 0.5 * sigmas)

    def prior(self, observation: Observation, last: LastSeen | None) -> Prior:
        """See Start: a hand hangs on an arm, and it does not turn round all at once."""
        sight = arm_sight(observation)

        def log_prior(particles: Tensor) -> Tensor:
            known = -self.forearm * forearm_conflict(particles, sight)
            if last is not None:
                before = last.particle[:, 3:6].expand(len(particles), -1)
                turned = rotvec_geodesic_distance(particles[:, 3:6], before)
                likeness = torch.exp(-0.5 * (turned / self.memory_rad).square())
                known = known + self.memory * math.exp(-last.age_s / self.memory_s) * likeness
            return known

        return log_prior

    def _draw(
        self,
        observation: Observation,
        space: PoseSpace,
        last: LastSeen | None,
        generator: torch.Generator,
    ) -> Tensor:
        m, device = self.hypotheses, space.lower.device

        def normal(*size: int) -> Tensor:
            return torch.randn(*size, generator=generator, device=device)

        def uniform() -> Tensor:
            return torch.rand(m, generator=generator, device=device)

        centre = torch.from_numpy(palm_centres(observation, m, generator)).to(device)
        in_plane = uniform() * 2 * math.pi
        exits = arm_exits(observation, m, generator)
        if exits is not None:
            way = torch.from_numpy(exits).to(device) - centre
            towards_arm = torch.atan2(-way[:, 0], way[:, 1]) + self.arm_rad * normal(m)
            in_plane = torch.where(uniform() < 0.8, towards_arm, in_plane)
        facing = (uniform() < 0.5) * math.pi
        tilt = normal(m, 2) * self.tilt_rad
        rotation = rotvec_composition(
            _about(in_plane, 2), _about(tilt[:, 0], 0), _about(tilt[:, 1] + facing, 1)
        )
        rows = torch.randint(len(space.training_latents), (m,), generator=generator, device=device)
        latent = space.training_latents[rows]
        if last is not None and last.age_s < 2 * self.memory_s:
            again = m // 4
            before = last.particle.expand(again, -1)
            turn = _TURN_RAD * normal(again, 3)
            rotation[:again] = rotvec_composition(turn, before[:, 3:6])
            latent[:again] = before[:, 6:]
        pivot = rotvec_to_rotmat(rotation) @ rotation.new_tensor(PIVOT_M)
        translation = centre + normal(m, 3) * self.position_m - pivot
        return torch.cat((translation, rotation, latent), 1)


def _about(angle: Tensor, axis: int) -> Tensor:
    vector = torch.zeros(len(angle), 3, device=angle.device)
    vector[:, axis] = angle
    return vector
