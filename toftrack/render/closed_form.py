"""Range images of ellipsoids in the closed form: the plain torch reference of every renderer.

The paper steps along each ray to the zero crossing of the quadric (section 2.2, equation 4). For a
ray X = p / u with p = (x, y, 1) in normalised image coordinates and u the *inverse* depth, and an
ellipsoid {c + F u : |u| <= 1} with W = F^-1, s = W c and g = s's - 1, the two crossings are

    u = l.p +- sqrt(p' Q p),   l = W's / g,   Q = W'(s s' / g^2 - I / g) W

so the nearest surface is the largest u, a miss is p'Qp < 0, and p'Qp = 0 is the paper's projected
conic.
"""

from __future__ import annotations

import torch
from torch import Tensor

from toftrack.hand.surface import Ellipsoids

_NEAREST_M = 0.02
"""Ellipsoids that come nearer to the camera's centre plane than this are not drawn: inside or
behind the camera the closed form has no meaning."""


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
    visible = nearest > _NEAREST_M
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
