"""The relocaliser as the tracker uses it: where hands are, and what they look like there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toftrack.checks import check_number
from toftrack.compute.rigid import pivot_offset
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M
from toftrack.refinement.gauss_newton import Landmarks
from toftrack.relocation.network import Finder, PoseNet
from toftrack.relocation.proposals import Look, find_hands
from toftrack.relocation.proposals_numba import look, looking
from toftrack.relocation.weights import load_weights

SAME_PLACE_M = 0.06
"""Places that lie closer together are one."""
_AGAIN = 2.0
"""Places whose merit is so much lower than the best are not looked at again."""
_CLEAR_M = 0.010
"""Expected error that counts as much as a factor e in probability."""


@dataclass(frozen=True)
class RelocationSettings:
    """How the networks' word is used; see conf/relocation/network.yaml for what each does."""

    places: int
    least: float
    merit: float
    hypotheses: int
    rivals: int
    every: int
    search: int
    sure: float
    prior: float
    rival_m: float
    rival_gain: float
    rival_frames: int
    votes: float
    landmark_m: float
    landmark_sigmas: float
    landmark_weight: float

    def __post_init__(self) -> None:
        for name in ("places", "hypotheses"):
            check_number(f"relocation.{name}", getattr(self, name), 1, whole=True)
        check_number("relocation.rivals", self.rivals, 0, whole=True)
        for name in ("every", "search"):
            check_number(f"relocation.{name}", getattr(self, name), 1, whole=True)
        check_number("relocation.sure", self.sure, 0.5, 0.999)
        check_number("relocation.rival_frames", self.rival_frames, 1, whole=True)
        check_number("relocation.least", self.least, 0, 1)
        check_number("relocation.merit", self.merit)
        for name in ("prior", "rival_gain", "votes", "landmark_weight"):
            check_number(f"relocation.{name}", getattr(self, name), 0)
        for name in ("rival_m", "landmark_m", "landmark_sigmas"):
            check_number(f"relocation.{name}", getattr(self, name), 0, above=True)


@dataclass(frozen=True, eq=False)
class Glance:
    """What the pose network says of the hand at one place, likeliest hypothesis first.

    pivot_m, rotvec, angles: (H, 3), (H, 3), (H, 21).  joints_m: (H, 21, 3) of a hand of that size.
    log_size: (H,) of the hand's length in units of the mean adult's.
    log_probability, error_m: (H,).
    landmarks: the joints by the cells' votes.
    present, right_side: probabilities that there is a hand, and that it is of the side looked for.
    """

    pivot_m: Tensor
    rotvec: Tensor
    angles: Tensor
    joints_m: Tensor
    log_size: Tensor
    log_probability: Tensor
    error_m: Tensor
    landmarks: Landmarks
    present: float
    right_side: float

    def states(self, ratio: float) -> Tensor:
        """(H, 27) as states of a hand whose length is `ratio` mean adult's: same palm's middle."""
        states = np.zeros((len(self.rotvec), 27), np.float32)
        states[:, 3:6], states[:, 6:] = self.rotvec.numpy(), self.angles.numpy()
        states[:, :3] = self.pivot_m.numpy() - np.float32(ratio) * pivot_offset(states[:, 3:6])
        return torch.from_numpy(states)

    @property
    def length_m(self) -> float:
        """The hand's length, the mean of the hypotheses'."""
        weights = self.log_probability.softmax(0)
        return DEFAULT_HAND_LENGTH_M * float((weights * self.log_size).sum().exp())

    @property
    def centre_m(self) -> Tensor:
        """(3,) middle of the palm of the likeliest hypothesis."""
        return self.pivot_m[0]

    def first(self, count: int) -> Glance:
        """With only so many hypotheses."""
        kept = slice(None, count)
        return Glance(
            self.pivot_m[kept],
            self.rotvec[kept],
            self.angles[kept],
            self.joints_m[kept],
            self.log_size[kept],
            self.log_probability[kept],
            self.error_m[kept],
            self.landmarks,
            self.present,
            self.right_side,
        )


@dataclass(frozen=True, eq=False)
class Relocaliser:
    """Both networks and how they are used; images are read, and answers given, on the CPU."""

    pose: PoseNet
    finder: Finder
    settings: RelocationSettings

    def to(self, device: torch.device) -> Relocaliser:
        """The same with the networks on a device, where they are moved."""
        return replace(self, pose=self.pose.to(device), finder=self.finder.to(device))

    def glance(
        self, depth_m: np.ndarray, k: np.ndarray, centres_m: np.ndarray, side: str
    ) -> list[Glance]:
        """What a hand of a side is like at each of C places (C, 3), in their order.

        depth_m: (H, W) rectified Z, 0 = no reading.  k: (3, 3).
        """
        if len(centres_m) == 0:
            return []
        seen = look(self.pose, depth_m, k, centres_m, side)
        return [_glance(seen, row) for row in range(len(seen.present))]

    def glancing(
        self, depth_m: np.ndarray, k: np.ndarray, centre_m: np.ndarray, side: str
    ) -> Callable[[], Glance]:
        """The same at one place (3,), begun beside whatever does not need it; see looking."""
        wait = looking(self.pose, depth_m, k, centre_m[None], side)
        return lambda: _glance(wait(), 0)

    def search(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        side: str,
        likely: Callable[[np.ndarray], float] = lambda centre_m: 0.0,
    ) -> list[Glance]:
        """Glances at all places where a hand may be, the best first; none where there is none.

        likely: what is known of places (3,) besides the image, log scale.

        The best places are looked at twice, the second time about the palm that was found: poses
        are the more exact the nearer the crop's centre is to the middle of the palm.
        """
        cfg = self.settings
        found = find_hands(self.finder, depth_m, k, cfg.places, cfg.least)
        # The finder knows sides only roughly: places of the other side may be this one's as well.
        other = "left" if side == "right" else "right"
        centres = np.concatenate((found[side].centre_m, found[other].centre_m))
        heat = np.concatenate((found[side].probability, 0.3 * found[other].probability))
        order = np.argsort(-heat, kind="stable")
        order = order[_apart(centres[order])][: cfg.places]
        centres, heat = centres[order], heat[order]
        glances = self.glance(depth_m, k, centres, side)

        def merits() -> np.ndarray:
            both = zip(glances, heat, strict=True)
            return np.array([merit(g, p) + likely(g.centre_m.numpy()) for g, p in both])

        first = merits()
        good = [row for row in range(len(first)) if first[row] > first.max() - _AGAIN]
        again = np.array([glances[row].centre_m.numpy() for row in good]).reshape(-1, 3)
        for row, glance in zip(good, self.glance(depth_m, k, again, side), strict=True):
            glances[row] = glance
        second = merits()
        order = np.argsort(-second, kind="stable")
        return [glances[row] for row in order if second[row] > cfg.merit]


def merit(glance: Glance, heat: float) -> float:
    """How much speaks for a hand of the side that is looked for at a place, log scale.

    heat: the finder's probability.
    """
    odds = math.log(max(heat, 1e-6)) + math.log(max(glance.present, 1e-6))
    odds += 0.5 * math.log(max(glance.right_side, 1e-3))
    unsure = float(glance.error_m[0]) + 0.5 * float(glance.landmarks.sigma_m.mean())
    return odds - unsure / _CLEAR_M


def _apart(centres_m: np.ndarray) -> list[int]:
    """Rows of the first of all places that are the same, in their order."""
    kept: list[int] = []
    for row, centre in enumerate(centres_m):
        if all(np.linalg.norm(centre - centres_m[other]) > SAME_PLACE_M for other in kept):
            kept.append(row)
    return kept


def _glance(seen: Look, row: int) -> Glance:
    return Glance(
        pivot_m=seen.pivot_m[row],
        rotvec=seen.rotvec[row],
        angles=seen.angles[row],
        joints_m=seen.joints_m[row],
        log_size=seen.log_size[row],
        log_probability=seen.log_probability[row],
        error_m=seen.error_m[row],
        landmarks=Landmarks(seen.votes_m[row], seen.sigma_m[row]),
        present=float(seen.present[row].sigmoid()),
        right_side=float(seen.right[row].sigmoid()),
    )


def make_relocaliser(weights: str | None = None, **settings: Any) -> Relocaliser:
    """The relocaliser of a configuration.

    weights: a file of train_relocaliser; None = the package's.
    Raises ToftrackError when they cannot be used.
    """
    pose, finder, _ = load_weights(weights)
    return Relocaliser(pose, finder, RelocationSettings(**settings))


def no_relocaliser() -> None:
    """relocation=none: the paper's tracker."""
