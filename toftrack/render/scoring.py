"""Counting correct, false and missed pixels of hypotheses: what every back end offers.

A back end is a callable from hand states to Counts. What counts as correct is decided once a frame
by the likelihood and handed over as Evidence: images of inverse depth to compare with, so that a
back end knows geometry and pixels but no policy.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.transfer import on_device

NEAREST_M = 0.02
"""Ellipsoids that come nearer to the camera's centre plane than this are not drawn: inside or
behind the camera the closed form has no meaning."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a frame says of every pixel, in inverse depth u = 1/Z (1/m); all on one device.

    low, high: (H, W) float32: a model surface with low <= u <= high is correct there; low > high
        where no model surface can be (background).
    occluder: (H, W) float32: a model surface with u below this is hidden behind something that is
        not the hand, and counts as nothing; 0 where there is no such thing, inf to ignore a pixel.
    hand: (H, W) bool: pixels that the model ought to cover, missed when it is only near them.
    k: (3, 3) float32 intrinsics.
    radius_px: how far from the silhouette a hand pixel is missed (Euclidean, pixels).
    """

    low: Tensor
    high: Tensor
    occluder: Tensor
    hand: Tensor
    k: Tensor
    radius_px: float

    def to(self, device: torch.device) -> Evidence:
        """The same on a device, from the CPU."""
        if device.type == "cpu":
            return self
        given = self.low, self.high, self.occluder, self.hand, self.k
        low, high, occluder, hand, k = (on_device(image, device) for image in given)
        return Evidence(low, high, occluder, hand, k, self.radius_px)

    def cropped(self, left: int, top: int, right: int, bottom: int) -> Evidence:
        """The part [top, bottom) x [left, right) with intrinsics to match."""
        k = self.k.clone()
        k[0, 2] -= left
        k[1, 2] -= top
        rows, columns = slice(top, bottom), slice(left, right)
        images = (self.low, self.high, self.occluder, self.hand)
        low, high, occluder, hand = (image[rows, columns].contiguous() for image in images)
        return Evidence(low, high, occluder, hand, k, self.radius_px)


class Counts(NamedTuple):
    """Pixels of hypotheses, each (N,) or (B, N) float32 (paper, section 2.3, "Observation").

    correct: model pixels whose surface lies within the evidence's band.
    false: model pixels that do not, unless hidden.
    missed: hand pixels within `radius_px` of the model's silhouette, outside of it and of the
        projected wrist ellipsoid.
    residual: sum over the correct pixels of the squared distance from the band's middle in units of
        its half-width (0 .. 1 a pixel).
    """

    correct: Tensor
    false: Tensor
    missed: Tensor
    residual: Tensor


class Scorer(Protocol):
    """A back end made for one hand shape."""

    name: str

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        """states: (N, 27) on the evidence's device. Pixels outside the image count as nothing."""


ScoreRows = Callable[[Sequence[Scorer], Tensor, Sequence[Evidence]], Counts]
"""See score_rows."""


def score_rows(scorers: Sequence[Scorer], states: Tensor, evidences: Sequence[Evidence]) -> Counts:
    """Counts (B, N) of states (B, N, 27) of B hands, each with its own scorer and evidence."""
    rows = [score(*row) for score, *row in zip(scorers, states, evidences, strict=True)]
    return Counts(*map(torch.stack, zip(*rows, strict=True)))


def disc_square(radius_px: float, height: int, width: int) -> int:
    """The largest squared distance, in pixels, within a disc on an image.

    Discs of radii with the same square are the same, so that few differ as a hand moves.
    """
    radius = min(max(float(radius_px), 0.0), math.hypot(height, width))
    return math.floor(radius**2)


@functools.lru_cache(maxsize=256)
def disc_steps(square: int, height: int, width: int) -> np.ndarray:
    """How to build a disc from its longest row to its shortest; square: see disc_square.

    A disc is a horizontal run for each row offset dy. Each step widens all that came before by a
    pixel to both sides or not (Horner's scheme), and adds the silhouette at row offsets -+ dy.

    Returns (S, 2) int64: a pixel wider or not, and the row offset to add or 0; it is kept, so
    do not write to it.
    """
    offsets = range(min(math.isqrt(square), height) + 1)
    halves = [min(math.isqrt(square - dy**2), width) for dy in offsets] + [0]
    steps = [(0, 0)]
    for dy in range(1, len(halves)):
        grow = halves[dy - 1] - halves[dy]
        steps += [(1, 0)] * max(grow - 1, 0)
        steps.append((min(grow, 1), dy if dy < len(halves) - 1 else 0))
    return np.array(steps, np.int64)


def dilate_disc(mask: Tensor, radius_px: float) -> Tensor:
    """(N, H, W) bool: pixels within a Euclidean distance of the mask, by `disc_steps`."""
    size = mask.shape[1:]
    out = mask.clone()
    for grow, dy in disc_steps(disc_square(radius_px, *size), *size).tolist():
        if grow:
            wider = out.clone()
            wider[..., 1:] |= out[..., :-1]
            wider[..., :-1] |= out[..., 1:]
            out = wider
        if dy:
            out[:, dy:] |= mask[:, :-dy]
            out[:, :-dy] |= mask[:, dy:]
    return out


def compare(u: Tensor, evidence: Evidence) -> tuple[Tensor, Tensor, Tensor]:
    """Correct and false pixels and the residual's image of inverse depths (N, H, W), 0 = none."""
    model = u > 0
    correct = model & (u >= evidence.low) & (u <= evidence.high)
    false = model & ~correct & (u >= evidence.occluder)
    middle, half = (evidence.low + evidence.high) / 2, (evidence.high - evidence.low) / 2
    return correct, false, torch.where(correct, ((u - middle) / half).square(), 0.0)
