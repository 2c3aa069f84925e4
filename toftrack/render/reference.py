"""The reference of every renderer and scoring back end, slow and plain on purpose: whole range
images of ellipsoids, counted as the definitions say.

The paper steps along each ray to the zero crossing of the quadric (section 2.2, equation 4), as
`step_range_images` does for tests and benchmarks. There is a closed form: for a ray X = p / u with
p = (x, y, 1) in normalised image coordinates and u the *inverse* depth, and an ellipsoid
{c + F u : |u| <= 1} with W = F^-1, s = W c and g = s's - 1, the two crossings are

    u = l.p +- sqrt(p' Q p),   l = W's / g,   Q = W'(s s' / g^2 - I / g) W

so the nearest surface is the largest u, a miss is p'Qp < 0, and p'Qp = 0 is the paper's projected
conic.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface, parted
from toftrack.render.scoring import NEAREST_M, Counts, Evidence, compare, dilate_disc


def pixel_rays(k: Tensor, height: int, width: int) -> Tensor:
    """(H, W, 3) rays (x, y, 1) through the pixel centres, which lie at integer (u, v)."""
    v, u = torch.meshgrid(
        torch.arange(height, device=k.device, dtype=k.dtype),
        torch.arange(width, device=k.device, dtype=k.dtype),
        indexing="ij",
    )
    return torch.stack(((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)), -1)


def render_range_images(ellipsoids: Ellipsoids, k: Tensor, height: int, width: int) -> Tensor:
    """Range images of N hands: Z along the optical axis in metres, 0 where there is no surface.

    ellipsoids: N x E (leave the wrist's out).  k: (3, 3) intrinsics, same dtype and device.
    Returns (N, H, W).
    """
    centres, axes = ellipsoids
    # Columns of F are orthogonal, so its inverse is its transpose over the squared lengths.
    whiten = axes.mT / axes.square().sum(-2)[..., None]
    s = (whiten @ centres[..., None]).squeeze(-1)
    g = s.square().sum(-1) - 1.0
    nearest = centres[..., 2] - axes[..., 2, :].norm(dim=-1)
    visible = nearest > NEAREST_M
    g = torch.where(visible, g, 1.0)
    linear = (whiten.mT @ s[..., None]).squeeze(-1) / g[..., None]
    q = linear[..., None] * linear[..., None, :] - (whiten.mT @ whiten) / g[..., None, None]
    p = pixel_rays(k, height, width).view(-1, 3)
    # p'Qp from the six different entries of Q.
    x, y, _ = p.unbind(-1)
    monomials = torch.stack((x * x, 2 * x * y, 2 * x, y * y, 2 * y, torch.ones_like(x)))
    entries = torch.stack(
        (q[..., 0, 0], q[..., 0, 1], q[..., 0, 2], q[..., 1, 1], q[..., 1, 2], q[..., 2, 2]), -1
    )
    discriminant = entries @ monomials  # (N, E, P)
    hit = (discriminant >= 0) & visible[..., None]
    largest = torch.where(hit, linear @ p.T + discriminant.clamp(min=0).sqrt(), 0.0).amax(1)
    u = largest.view(-1, height, width)
    return torch.where(u > 0, 1.0 / u, 0.0)


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
