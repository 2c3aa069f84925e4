"""Range images of ellipsoids in the closed form: the plain torch reference of every renderer.

The paper steps along each ray to the zero crossing of the quadric (section 2.2, equation 4). For a
ray X = p / u with p = (x, y, 1) in normalised image coordinates and u the *inverse* depth, and an
ellipsoid {c + F u : |u| <= 1} with W = F^-1, s = W c and g = s's - 1, the two crossings are

    u = l.p +- sqrt(p' Q p),   l = W's / g,   Q = W'(s s' / g^2 - I / g) W

so the nearest surface is the largest u, a miss is p'Qp < 0, and p'Qp = 0 is the paper's projected
conic.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.surface import Ellipsoids

_NEAREST_M = 0.02
"""Ellipsoids that come nearer to the camera's centre plane than this are not drawn: inside or
behind the camera the closed form has no meaning."""
_CHUNK_BYTES = 64 << 20
"""Bound on the largest intermediate tensor: hands are rendered in chunks."""


class Conics(NamedTuple):
    """Closed-form coefficients of N x E ellipsoids in normalised image coordinates.

    linear: (N, E, 3), l.  quadratic: (N, E, 3, 3), Q.
    visible: (N, E) bool, false where the ellipsoid reaches the camera.
    """

    linear: Tensor
    quadratic: Tensor
    visible: Tensor


def project(ellipsoids: Ellipsoids) -> Conics:
    """Ellipsoids in the camera frame to their conics and inverse-depth coefficients."""
    centres, axes = ellipsoids
    # Columns of F are orthogonal, so its inverse is its transpose over the squared lengths.
    whiten = axes.mT / axes.square().sum(-2)[..., None]
    s = (whiten @ centres[..., None]).squeeze(-1)
    g = s.square().sum(-1) - 1.0
    nearest = centres[..., 2] - axes[..., 2, :].norm(dim=-1)
    visible = nearest > _NEAREST_M
    g = torch.where(visible, g, 1.0)
    ws = (whiten.mT @ s[..., None]).squeeze(-1)
    linear = ws / g[..., None]
    quadratic = linear[..., None] * linear[..., None, :] - (whiten.mT @ whiten) / g[..., None, None]
    return Conics(linear, quadratic, visible)


def inverse_depth(conics: Conics, rays: Tensor) -> Tensor:
    """Largest inverse depth along each ray over the ellipsoids, 0 where every one is missed.

    conics: N x E.  rays: (..., 3) with z = 1.  Returns (N, ...), 1/m.
    """
    p = rays.reshape(-1, 3)
    linear = conics.linear @ p.T  # (N, E, P)
    # p'Qp from the six different entries of Q.
    q = conics.quadratic
    x, y, _ = p.unbind(-1)
    monomials = torch.stack((x * x, 2 * x * y, 2 * x, y * y, 2 * y, torch.ones_like(x)))
    entries = torch.stack(
        (q[..., 0, 0], q[..., 0, 1], q[..., 0, 2], q[..., 1, 1], q[..., 1, 2], q[..., 2, 2]), -1
    )
    discriminant = entries @ monomials
    hit = (discriminant >= 0) & conics.visible[..., None]
    u = torch.where(hit, linear + discriminant.clamp(min=0).sqrt(), 0.0)
    return u.amax(1).view(-1, *rays.shape[:-1])


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
    conics = project(ellipsoids)
    rays = pixel_rays(k, height, width)
    n, e = conics.visible.shape
    step = max(1, _CHUNK_BYTES // max(1, e * height * width * rays.element_size()))
    images = [
        inverse_depth(Conics(*(t[i : i + step] for t in conics)), rays) for i in range(0, n, step)
    ]
    u = torch.cat(images) if images else rays.new_zeros(0, height, width)
    return torch.where(u > 0, 1.0 / u, 0.0)
