"""What the networks are trained for."""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.images import Crops, WideImages
from toftrack.detector.network import Found, Proposed
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics

_ANCHOR_RAD = 0.35
_POSED = 3
"""Hypotheses of each crop whose pose is trained: those with the nearest anchors."""
_ANGLE_M = 0.012
_SIZE_M = 0.03
_SEEN = 0.15
_BARELY_SEEN = 0.04


def hypothesis_joints(
    rotation: Tensor, angles: Tensor, log_size: Tensor, pivot_m: Tensor
) -> Tensor:
    """(N, 21, 3) joints of mean hands in given poses, see Proposed; each (N, ...)."""
    n = len(angles)
    state = torch.cat((angles.new_zeros(n, 6), angles), 1)
    joints = forward_kinematics(state, default_hand_shape()).joints_m
    about = (joints - joints.new_tensor(PIVOT_M)) * log_size.exp()[:, None, None]
    return about @ rotation.mT + pivot_m[:, None]


@dataclass(frozen=True)
class PoseLosses:
    """Sums to the loss; hypothesis_mm, keypoints_mm: mean errors of the likeliest hypothesis and of
    the keypoints.
    """

    total: Tensor
    hypothesis_mm: float
    keypoints_mm: float
    within_20: float
    side: float
    present: float


def pose_losses(p: Proposed, crops: Crops, anchors: Tensor) -> PoseLosses:
    """See PoseLosses. Poses and joints of right hands count; side, parts and presence of all."""
    use = (crops.present & crops.right).nonzero()[:, 0]
    truth = crops.joints_m[use]
    angle = roma.rotmat_geodesic_distance(
        anchors.expand(len(use), -1, 3, 3), crops.rotation[use][:, None].expand(-1, 24, 3, 3)
    )
    target = torch.softmax(-0.5 * (angle / _ANCHOR_RAD).square(), 1)
    weight, rows = target.topk(_POSED, 1)
    weight = weight / weight.sum(1, keepdim=True)
    flat = (use[:, None].expand(-1, _POSED), rows)
    parts = (p.rotation[flat], p.angles[flat], p.log_size[flat], p.pivot_m[flat])
    joints = hypothesis_joints(*(part.flatten(0, 1) for part in parts))
    joints = joints.unflatten(0, (len(use), _POSED))
    distance = (joints - truth[:, None]).norm(dim=-1)  # (U, P, 21)
    bent = (p.angles[flat] - crops.angles[use][:, None]).abs().mean(2)
    size = (p.log_size[flat] - crops.log_size[use][:, None]).abs()
    turned = (p.rotation[flat] - crops.rotation[use][:, None]).abs().mean((2, 3))
    pose = distance.mean(2) + _ANGLE_M * bent + _SIZE_M * size + 0.01 * turned
    expected = p.error_m[flat]
    error = distance.mean(2).detach() / expected + expected.log()
    loss = 50.0 * (weight * pose).sum(1).mean() + 0.2 * (weight * error).sum(1).mean()
    loss = loss - 0.5 * (target * p.log_probability[use]).sum(1).mean()

    miss = (p.joints_m[use] - truth).norm(dim=-1)
    sigma = p.sigma_m[use]
    loss = loss + 0.4 * (miss / sigma + 2.0 * sigma.log()).mean() + 20.0 * miss.mean()
    loss = loss + 0.5 * F.cross_entropy(p.parts.float(), crops.parts, ignore_index=-1)
    presence = F.binary_cross_entropy_with_logits(p.present, crops.present.float())
    there = crops.present
    side = F.binary_cross_entropy_with_logits(p.right[there], crops.right[there].float())
    loss = loss + 0.5 * presence + side
    with torch.no_grad():
        first = p.log_probability[use].argmax(1)
        at = (use, first)
        likeliest = hypothesis_joints(p.rotation[at], p.angles[at], p.log_size[at], p.pivot_m[at])
        off = (likeliest - truth).norm(dim=-1).mean(1)
        right = (p.right[there] > 0) == crops.right[there]
        found = (p.present > 0) == crops.present
    return PoseLosses(
        loss,
        1e3 * float(off.mean()),
        1e3 * float(miss.detach().mean()),
        float((off < 0.02).float().mean()),
        float(right.float().mean()),
        float(found.float().mean()),
    )


def finder_loss(found: Found, images: WideImages) -> Tensor:
    """Focal loss of the heat (Law and Deng, "CornerNet", ECCV 2018), L1 of places and depths."""
    n, height, width = found.heat.shape
    v = torch.arange(height)[:, None]
    u = torch.arange(width)
    target = torch.zeros(n, height, width)
    ignored = torch.zeros(n, height, width, dtype=torch.bool)
    places = found.heat.new_zeros(())
    for hand in range(2):
        column, row = images.cell[:, hand].unbind(1)
        seen = images.seen[:, hand]
        du, dv = u - column[:, None, None], v - row[:, None, None]
        bump = torch.exp(-0.5 * (du.square() + dv.square()) / 0.7**2)
        bump = torch.where((bump >= bump.amax((1, 2), keepdim=True)) & (bump > 0.3), 1.0, bump)
        bump = torch.where((seen > _SEEN)[:, None, None], bump, torch.zeros(()))
        target = torch.maximum(target, bump)
        barely = (seen > _BARELY_SEEN) & (seen <= _SEEN)
        ignored |= (du.square() + dv.square() < 9) & barely[:, None, None]
        at = ((du.abs() < 1.5) & (dv.abs() < 1.5) & (seen > _SEEN)[:, None, None]).nonzero()
        if len(at):
            b, r, c = at.unbind(1)
            here = (b, r, c)
            places = (
                places
                + (
                    (found.column[here] - (column[b] - c)).abs()
                    + (found.row[here] - (row[b] - r)).abs()
                    + 10 * (found.log_depth[here] - images.depth_m[b, hand].log()).abs()
                ).sum()
            )
    positive = target == 1
    p = found.heat.sigmoid()
    log_p, log_q = F.logsigmoid(found.heat), F.logsigmoid(-found.heat)
    gain = torch.where(positive, (1 - p).square() * log_p, (1 - target) ** 4 * p.square() * log_q)
    gain = torch.where(ignored & ~positive, torch.zeros(()), gain)
    count = positive.sum().clamp(min=1)
    return (-gain.sum() + 0.1 * places) / count
