"""The reference of every scoring back end: whole range images, counted as the definitions say.

Slow and plain on purpose. `step_range_images` is the paper's own way of finding the surface
(section 2.2: stepping along the ray to the quadric's zero crossing), kept for tests and benchmarks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.render.closed_form import pixel_rays, render_range_images
from toftrack.render.model_image import parted
from toftrack.render.scoring import Counts, Evidence, compare, dilate_disc


def step_range_images(
    ellipsoids: Ellipsoids, k: Tensor, height: int, width: int, step_m: float = 0.005
) -> Tensor:
    """Range images by stepping along the rays, as the paper does; (N, H, W) metres, 0 = none.

    Each ray starts in front of the ellipsoid, at its centre's depth less its longest axis, walks
    in steps of `step_m` in Z to the first point inside and takes the crossing by linear
    interpolation of the quadric's value between the last two points.
    """
    rays = pixel_rays(k, height, width).view(-1, 3)
    centres, axes = ellipsoids
    whiten = axes.mT / axes.square().sum(-2)[..., None]
    reach = axes.square().sum(-2).amax(-1).sqrt()
    best = centres.new_full((centres.shape[0], rays.shape[0]), math.inf)
    for e in range(centres.shape[1]):
        direction = whiten[:, e] @ rays.T  # (N, 3, P)
        offset = whiten[:, e] @ centres[:, e, :, None]
        start = (centres[:, e, 2] - reach[:, e])[:, None]
        steps = int(math.ceil(float(2 * reach[:, e].max()) / step_m)) + 1
        previous = (direction * start[:, None] - offset).square().sum(1) - 1.0
        found = torch.zeros_like(previous, dtype=torch.bool)
        depth = torch.full_like(previous, math.inf)
        for i in range(1, steps + 1):
            z = start + i * step_m
            value = (direction * z[:, None] - offset).square().sum(1) - 1.0
            crossing = (value <= 0) & ~found
            part = previous / (previous - value)
            depth = torch.where(crossing, z - step_m + part * step_m, depth)
            found |= crossing
            previous = value
        best = torch.minimum(best, depth)
    return torch.where(best.isfinite(), best, 0.0).view(-1, height, width)


class PixelClasses(NamedTuple):
    """What each pixel of N range images is, (N, H, W) each (paper, fig. 3); see Counts.

    near: pixels within the evidence's radius of the silhouette, outside of it and of the wrist's:
        the neighbourhood, in which hand pixels are missed.
    """

    correct: Tensor
    false: Tensor
    missed: Tensor
    residual: Tensor
    near: Tensor


def classify_range_images(
    depth_m: Tensor, wrist: Tensor, reach: Tensor, evidence: Evidence
) -> PixelClasses:
    """Classes of the pixels of given range images.

    depth_m: (N, H, W), 0 = no surface.  wrist: (N, H, W) bool, the wrist ellipsoid's silhouette.
    reach: (N, H, W) bool, pixels within the evidence's radius of the surface.
    """
    model = depth_m > 0
    correct, false, residual = compare(torch.where(model, 1.0 / depth_m, 0.0), evidence)
    near = reach & ~model & ~wrist
    return PixelClasses(correct, false, evidence.hand & near, residual, near)


class ReferenceScorer:
    """Full images for every hypothesis, in chunks; what the fast back ends are checked against."""

    name = "reference"

    def __init__(self, shape: HandShape, chunk: int = 8, stepping: bool = False) -> None:
        """chunk: hypotheses rendered at once.  stepping: find surfaces as the paper does."""
        self.shape = shape
        self.surface = hand_surface(shape)
        self.chunk = chunk
        self.render = step_range_images if stepping else render_range_images

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        """See Scorer."""
        parts = [self._score(part, evidence) for part in states.split(self.chunk)]
        return Counts(*torch.cat(parts, 1)) if len(states) else Counts(*states.new_zeros(4, 0))

    def _score(self, states: Tensor, evidence: Evidence) -> Tensor:
        """(4, N) counts of one chunk."""
        hand, wrist = parted(self.surface.pose(forward_kinematics(states, self.shape)))
        view = evidence.k.to(states.dtype), *evidence.hand.shape
        depth_m = self.render(hand, *view)
        on_wrist = render_range_images(wrist, *view) > 0
        reach = dilate_disc(depth_m > 0, evidence.radius_px)
        *images, _ = classify_range_images(depth_m, on_wrist, reach, evidence)
        return torch.stack([image.flatten(1).sum(1).float() for image in images])
