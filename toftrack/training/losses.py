"""What the networks are trained for."""

from __future__ import annotations

import functools

import roma
import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.transfer import on_device, table
from toftrack.detector.network import ANCHORS, Found, Proposed
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.training.images import Crops, WideImages

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
    joints = forward_kinematics(state, _mean_hand(angles.device)).joints_m
    middle = table(PIVOT_M, joints.dtype, joints.device)
    about = (joints - middle) * log_size.exp()[:, None, None]
    return about @ rotation.mT + pivot_m[:, None]


@functools.cache
def _mean_hand(device: torch.device) -> HandShape:
    return default_hand_shape().to(device)


def pose_losses(p: Proposed, crops: Crops, anchors: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss and what is reported, all () tensors on the network's device. Poses and joints of
    right hands count, the side of all hands, and parts and presence of all crops.

    What does not count has a weight of 0, so that all sizes are the same in each step: a CUDA
    device is told once what to do, see descent.
    """
    there, right = crops.present.float(), crops.right.float()
    counting = _shares(there * right)
    angle = roma.rotmat_geodesic_distance(
        anchors.expand(len(there), -1, 3, 3), crops.rotation[:, None].expand(-1, ANCHORS, 3, 3)
    )
    target = torch.softmax(-0.5 * (angle / _ANCHOR_RAD).square(), 1)
    weight, rows = target.topk(_POSED, 1)
    weight = weight / weight.sum(1, keepdim=True)
    rotation, angles, log_size, pivot, expected = (
        _rows(part, rows) for part in (p.rotation, p.angles, p.log_size, p.pivot_m, p.error_m)
    )
    poses = (part.flatten(0, 1) for part in (rotation, angles, log_size, pivot))
    joints = hypothesis_joints(*poses).unflatten(0, (len(there), _POSED))
    distance = (joints - crops.joints_m[:, None]).norm(dim=-1)  # (N, P, 21)
    bent = (angles - crops.angles[:, None]).abs().mean(2)
    size = (log_size - crops.log_size[:, None]).abs()
    turned = (rotation - crops.rotation[:, None]).abs().mean((2, 3))
    pose = distance.mean(2) + _ANGLE_M * bent + _SIZE_M * size + 0.01 * turned
    error = distance.mean(2).detach() / expected + expected.log()
    chosen = (target * p.log_probability).sum(1)
    each = 50.0 * (weight * pose).sum(1) + 0.2 * (weight * error).sum(1) - 0.5 * chosen
    miss = (p.joints_m - crops.joints_m).norm(dim=-1)
    unsure = (miss / p.sigma_m + 2.0 * p.sigma_m.log()).mean(1)
    each = each + 0.4 * unsure + 20.0 * miss.mean(1)
    loss = (counting * each).sum()

    loss = loss + 0.5 * F.cross_entropy(p.parts.float(), crops.parts, ignore_index=-1)
    presence = F.binary_cross_entropy_with_logits(p.present, there)
    sides = F.binary_cross_entropy_with_logits(p.right, right, reduction="none")
    loss = loss + 0.5 * presence + (_shares(there) * sides).sum()
    with torch.no_grad():
        first = p.log_probability.argmax(1, keepdim=True)
        likeliest = hypothesis_joints(
            *(_rows(part, first)[:, 0] for part in (p.rotation, p.angles, p.log_size, p.pivot_m))
        )
        off = (likeliest - crops.joints_m).norm(dim=-1).mean(1)
        right_side = ((p.right > 0) == crops.right).float()
        return loss, {
            "joints_mm": 1e3 * (counting * off).sum(),
            "keypoints_mm": 1e3 * (counting * miss.mean(1)).sum(),
            "within_20_mm": (counting * (off < 0.02)).sum(),
            "side": (_shares(there) * right_side).sum(),
            "present": ((p.present > 0) == crops.present).float().mean(),
        }


def _shares(weights: Tensor) -> Tensor:
    """Weights (N,) divided by their sum."""
    return weights / weights.sum().clamp(min=1e-6)


def _rows(each: Tensor, rows: Tensor) -> Tensor:
    """Of hypotheses (N, 24, ...) those of `rows` (N, P)."""
    index = rows.reshape(*rows.shape, *(1 for _ in each.shape[2:]))
    return each.gather(1, index.expand(*rows.shape, *each.shape[2:]))


def finder_loss(found: Found, images: WideImages) -> Tensor:
    """Focal loss of the heat (Law and Deng, "CornerNet", ECCV 2018), L1 of places and depths.

    images: on the CPU, where the targets are made; found: on the network's device.
    """
    n, height, width = found.heat.shape
    device = found.heat.device
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
            true = torch.stack((column[b] - c, row[b] - r, images.depth_m[b, hand].log()))
            across, down, log_depth = on_device(true, device).unbind(0)
            here = on_device(at, device).unbind(1)
            beside = (found.column[here] - across).abs() + (found.row[here] - down).abs()
            places = places + (beside + 10 * (found.log_depth[here] - log_depth).abs()).sum()
    count = int((target == 1).sum().clamp(min=1))
    target, ignored = on_device(target, device), on_device(ignored, device)
    positive = target == 1
    p = found.heat.sigmoid()
    log_p, log_q = F.logsigmoid(found.heat), F.logsigmoid(-found.heat)
    gain = torch.where(positive, (1 - p).square() * log_p, (1 - target) ** 4 * p.square() * log_q)
    gain = gain.masked_fill(ignored & ~positive, 0.0)
    return (-gain.sum() + 0.1 * places) / count
