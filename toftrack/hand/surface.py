"""The hand's surface: ellipsoids on the bones and in the palm (paper, section 2.2, equations 2
and 3).

Each phalanx is one ellipsoid along its bone, and a small one fills the waist at a finger's first
knuckle; the palm is a fan of flat ones over the metacarpals with the muscle pads of the thumb and
of the little finger. Joints lie nearer to the back of a finger than to its pad, so the flesh is set
towards the palm.

Half-breadths follow ANSUR II (see hand/shape.py). All the rest was fitted to the depth images of
six of twelve body meshes and of another hand's mesh, begun at an adult's proportions and held near
to them, and judged on the others and on real hands: docs/lab/surface.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape
from toftrack.hand.skeleton import HandPose

# Everything in millimetres is for a hand of 190 mm, and scaled from there.

# Half-breadth of the fingers at the middle of each bone.
BONE_RADII_MM = (
    (16.0, 10.0, 9.0),
    (10.2, 8.9, 7.7),
    (10.3, 9.1, 7.8),
    (9.8, 8.6, 7.4),
    (8.6, 7.6, 6.6),
)

# Of the three bones of the thumb and of the other fingers, in parts of the bone's half-breadth:
# half-depth; how far the flesh's middle lies from the axis towards the palm; by how much it goes
# past the bone's proximal and distal end. The last bone's ends exactly at the finger's tip.
_THUMB_BONES = ((1.06, 0.21, 0.57, 0.4), (0.82, 0.21, 0.5, 0.54), (0.87, 0.26, 0.67, 0.0))
_FINGER_BONES = ((0.96, 0.24, 0.74, 0.41), (0.78, 0.21, 0.51, 0.5), (0.76, 0.1, 0.65, 0.0))
_BONES = np.array([_THUMB_BONES, *[_FINGER_BONES] * 4]).transpose(2, 0, 1)  # (4, 5, 3)
# What fills the waist at the distal end of a finger's first bone: its half-breadth, in parts of the
# mean of the bones on either side; in parts of that its half-length, half-depth and how far it lies
# towards the palm.
_KNUCKLES = np.array([(0.91, 0.99, 0.92, 0.17), *[(0.83, 0.64, 0.91, 0.35)] * 4]).T  # (4, 5)

_WRIST_ROOT = 5
# The palm's flat ellipsoids: where each starts and ends, from the root of a finger (0 thumb .. 4
# little) or from the wrist; half-breadth, half-depth, and by how much it goes past its ends.
_PALM = (
    # Metacarpals, from the carpus to the knuckles; the flesh lies in front of the bones.
    (_WRIST_ROOT, (10.5, -3.4, -7.0), 1, (3.0, -1.2, -3.9), 14.8, 17.0, 6.7),
    (_WRIST_ROOT, (1.8, -3.8, -5.1), 2, (-1.2, -0.6, -2.3), 14.1, 18.2, 6.6),
    (_WRIST_ROOT, (-6.2, -1.9, -10.7), 3, (-2.7, 1.8, -2.2), 13.9, 18.1, 6.3),
    (_WRIST_ROOT, (-13.2, -3.0, -7.6), 4, (-0.5, -2.7, -4.1), 13.8, 15.9, 6.1),
    # Carpus, thenar, hypothenar, the web between thumb and index finger, and the pad of the
    # knuckles across the palm.
    (_WRIST_ROOT, (-16.5, -6.6, -1.5), _WRIST_ROOT, (15.5, -6.6, -2.4), 21.5, 19.7, 12.4),
    (_WRIST_ROOT, (4.2, -18.8, -14.8), 0, (2.7, -15.9, -10.9), 21.8, 14.9, 6.5),
    (_WRIST_ROOT, (-20.7, -11.5, -8.5), 4, (4.6, 7.7, -5.0), 12.9, 14.3, 7.1),
    (0, (0.8, -0.2, -3.9), 1, (-1.9, 11.7, -8.8), 18.6, 12.1, 7.9),
    (4, (5.3, -2.6, -3.3), 1, (-2.8, -2.1, -9.1), 13.1, 8.2, 12.2),
)
_STARTS, _STARTS_MM, _ENDS, _ENDS_MM, *_PAD_SIZES_MM = map(np.array, zip(*_PALM, strict=True))
# Across the forearm below the hand, and wide enough for a bent wrist.
_WRIST_MM = (0.0, 45.0, 0.0)
_WRIST_AXES_MM = (50.0, 45.0, 45.0)

_KEPT = 8
"""Shapes whose surface is kept: scorer, refiner and OpenXR's joints each want it."""
_BONE_FRAMES = [1 + 3 * finger + bone for finger in range(5) for bone in (0, 1, 2, 0)]


class Ellipsoids(NamedTuple):
    """N hands of E ellipsoids {c + F u : |u| <= 1} in the camera frame.

    centres_m: (N, E, 3).
    axes_m: (N, E, 3, 3), F: orthogonal columns, the semi-axes as vectors (the square root of the
        paper's R V R').
    """

    centres_m: Tensor
    axes_m: Tensor


def parted(both: Ellipsoids) -> tuple[Ellipsoids, Ellipsoids]:
    """The hand's own ellipsoids, and the wrist's."""
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    return hand, Ellipsoids(both.centres_m[:, -1:], both.axes_m[:, -1:])


@dataclass(frozen=True, eq=False)
class HandSurface:
    """Ellipsoids attached to the 16 frames of a HandPose; the last one is the wrist's.

    The wrist ellipsoid is not part of the hand: it covers the arm where the neighbourhood of the
    silhouette is examined (paper, section 2.3).

    frame_index: (E + 1,) which frame each ellipsoid moves with (0 hand, 1..15 bones), int64.
    centres_m: (E + 1, 3) in that frame.
    axes_m: (E + 1, 3, 3) semi-axes as columns in that frame.
    """

    frame_index: Tensor
    centres_m: Tensor
    axes_m: Tensor

    def pose(self, pose: HandPose) -> Ellipsoids:
        """Ellipsoids of N posed hands, the wrist's last: (N, E + 1)."""
        frames = pose.frames[:, self.frame_index]
        centres = (frames @ self.centres_m[..., None]).squeeze(-1)
        return Ellipsoids(pose.origins_m[:, self.frame_index] + centres, frames @ self.axes_m)


@lru_cache(maxsize=_KEPT)
def hand_surface(shape: HandShape) -> HandSurface:
    """Flesh out a skeleton of the given sizes; on the shape's device and of its dtype."""
    # In numpy, all bones at once: torch's operations on a few numbers take milliseconds together.
    base, lengths = shape.base_m.cpu().numpy(), shape.bone_lengths_m.cpu().numpy()
    unit = shape.hand_length_m / DEFAULT_HAND_LENGTH_M / 1000
    thick = unit * shape.thickness
    wrist = np.array([_WRIST_MM]) * unit, np.diag(_WRIST_AXES_MM)[None] * thick
    bones = _bones(lengths, np.array(BONE_RADII_MM, base.dtype) * thick)
    each = zip(bones, _pads(base, unit, thick), wrist, strict=True)
    centres, axes = (np.concatenate(parts).astype(base.dtype) for parts in each)
    frames = [*_BONE_FRAMES, *[0] * (len(_PALM) + 1)]
    device = shape.base_m.device
    return HandSurface(
        torch.tensor(frames, device=device),
        torch.from_numpy(centres).to(device),
        torch.from_numpy(axes).to(device),
    )


def _bones(lengths: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (20, 3) and axes (20, 3, 3) of the fingers' ellipsoids, in their bones' frames.

    lengths, radii: (5, 3) of the bones and their half-breadths, m.
    """
    depth, palmward, before, beyond = _BONES  # (5, 3) each
    start, end = -before * radii, lengths + beyond * radii
    none = np.zeros((5, 1))
    breadth = _KNUCKLES[0] * radii[:, :2].mean(1)
    across = np.concatenate((radii, breadth[:, None]), 1)
    along = np.concatenate(((end - start) / 2, (_KNUCKLES[1] * breadth)[:, None]), 1)
    deep = np.concatenate((depth * radii, (_KNUCKLES[2] * breadth)[:, None]), 1)
    axes = np.stack((across, along, deep), -1)[..., None] * np.eye(3)
    y = np.concatenate((-(start + end) / 2, -lengths[:, :1]), 1)
    z = -np.concatenate((palmward * radii, (_KNUCKLES[3] * breadth)[:, None]), 1)
    centres = np.stack((np.broadcast_to(none, y.shape), y, z), -1)
    return centres.reshape(-1, 3), axes.reshape(-1, 3, 3)


def _pads(base: np.ndarray, unit: float, thick: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres (P, 3) and axes (P, 3, 3) of the palm's pads in the hand frame.

    base: (5, 3) the fingers' roots.  unit, thick: metres of a millimetre.
    """
    roots = np.concatenate((base, np.zeros((1, 3))))  # the last one is the wrist
    start, end = unit * _STARTS_MM + roots[_STARTS], unit * _ENDS_MM + roots[_ENDS]
    way = end - start
    length = np.sqrt(np.square(way).sum(1, keepdims=True))
    x, y, z = (way / length).T
    # Across a pad, the hand's z axis as nearly as it can be.
    level = np.hypot(x, y)
    out = np.stack((x * z, y * z, -np.square(level)), 1) / level[:, None]
    side = np.stack((-y, x, np.zeros_like(x)), 1) / level[:, None]
    wide, deep, beyond = thick * np.array(_PAD_SIZES_MM)[..., None]
    axes = side * wide, way / length * (length / 2 + beyond), out * deep
    return (start + end) / 2, np.stack(axes, 2)
