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
from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
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


class _Bone(NamedTuple):
    """The flesh of a bone, all in parts of its half-breadth.

    depth: half-depth.  palmward: how far the middle lies from the bone's axis towards the palm.
    before, beyond: by how much it goes past the bone's proximal and distal end.
    """

    depth: float
    palmward: float
    before: float
    beyond: float


class _Knuckle(NamedTuple):
    """Fills the waist at the distal end of a finger's first bone.

    breadth: of the mean half-breadth of the bones on either side.
    along, depth, palmward: in parts of its own half-breadth.
    """

    breadth: float
    along: float
    depth: float
    palmward: float


class _Pad(NamedTuple):
    """A flat ellipsoid in the palm, in millimetres.

    start, end: each from the root of a finger (0 thumb .. 4 little) or, None, from the wrist.
    wide, deep: half-axes across.  beyond: by how much it goes past its ends.
    """

    start_root: int | None
    start: tuple[float, float, float]
    end_root: int | None
    end: tuple[float, float, float]
    wide: float
    deep: float
    beyond: float


_THUMB_BONES = (
    _Bone(depth=1.06, palmward=0.21, before=0.57, beyond=0.4),
    _Bone(depth=0.82, palmward=0.21, before=0.5, beyond=0.54),
    _Bone(depth=0.87, palmward=0.26, before=0.67, beyond=0.0),
)
_FINGER_BONES = (
    _Bone(depth=0.96, palmward=0.24, before=0.74, beyond=0.41),
    _Bone(depth=0.78, palmward=0.21, before=0.51, beyond=0.5),
    _Bone(depth=0.76, palmward=0.1, before=0.65, beyond=0.0),
)
"""The last one ends exactly at the finger's tip."""
_THUMB_KNUCKLE = _Knuckle(breadth=0.91, along=0.99, depth=0.92, palmward=0.17)
_FINGER_KNUCKLE = _Knuckle(breadth=0.83, along=0.64, depth=0.91, palmward=0.35)

_PALM = (
    # Metacarpals, from the carpus to the knuckles; the flesh lies in front of the bones.
    _Pad(None, (10.5, -3.4, -7.0), 1, (3.0, -1.2, -3.9), 14.8, 17.0, 6.7),
    _Pad(None, (1.8, -3.8, -5.1), 2, (-1.2, -0.6, -2.3), 14.1, 18.2, 6.6),
    _Pad(None, (-6.2, -1.9, -10.7), 3, (-2.7, 1.8, -2.2), 13.9, 18.1, 6.3),
    _Pad(None, (-13.2, -3.0, -7.6), 4, (-0.5, -2.7, -4.1), 13.8, 15.9, 6.1),
    # Carpus, thenar, hypothenar, the web between thumb and index finger, and the pad of the
    # knuckles across the palm.
    _Pad(None, (-16.5, -6.6, -1.5), None, (15.5, -6.6, -2.4), 21.5, 19.7, 12.4),
    _Pad(None, (4.2, -18.8, -14.8), 0, (2.7, -15.9, -10.9), 21.8, 14.9, 6.5),
    _Pad(None, (-20.7, -11.5, -8.5), 4, (4.6, 7.7, -5.0), 12.9, 14.3, 7.1),
    _Pad(0, (0.8, -0.2, -3.9), 1, (-1.9, 11.7, -8.8), 18.6, 12.1, 7.9),
    _Pad(4, (5.3, -2.6, -3.3), 1, (-2.8, -2.1, -9.1), 13.1, 8.2, 12.2),
)
# Across the forearm below the hand, and wide enough for a bent wrist.
_WRIST_MM = (0.0, 45.0, 0.0)
_WRIST_AXES_MM = (50.0, 45.0, 45.0)

_REFERENCE_LENGTH_M = 0.190


class Ellipsoids(NamedTuple):
    """N hands of E ellipsoids {c + F u : |u| <= 1} in the camera frame.

    centres_m: (N, E, 3).
    axes_m: (N, E, 3, 3), F: orthogonal columns, the semi-axes as vectors (the square root of the
        paper's R V R').
    """

    centres_m: Tensor
    axes_m: Tensor


@dataclass(frozen=True)
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

    def __len__(self) -> int:
        """The number of ellipsoids of the hand, the wrist's not counted."""
        return len(self.frame_index) - 1

    def to(self, *args: object, **kwargs: object) -> HandSurface:
        """The same surface on another device or of another floating dtype, as `torch.Tensor.to`."""
        return HandSurface(
            self.frame_index.to(self.centres_m.to(*args, **kwargs).device),
            self.centres_m.to(*args, **kwargs),
            self.axes_m.to(*args, **kwargs),
        )

    def pose(self, pose: HandPose) -> Ellipsoids:
        """Ellipsoids of N posed hands, the wrist's last: (N, E + 1)."""
        frames = pose.frames[:, self.frame_index]
        centres = (frames @ self.centres_m[..., None]).squeeze(-1)
        return Ellipsoids(pose.origins_m[:, self.frame_index] + centres, frames @ self.axes_m)


def hand_surface(shape: HandShape) -> HandSurface:
    """Flesh out a skeleton of the given sizes; on the shape's device and of its dtype."""
    base = shape.base_m
    unit = shape.hand_length_m / _REFERENCE_LENGTH_M / 1000
    thick = unit * shape.thickness
    radii = base.new_tensor(BONE_RADII_MM) * thick
    parts = [part for finger in range(5) for part in _finger(finger, shape, radii[finger])]
    parts += [(0, *_pad(pad, base, unit, thick)) for pad in _PALM]
    wrist = torch.diag(base.new_tensor(_WRIST_AXES_MM) * thick)
    parts.append((0, base.new_tensor(_WRIST_MM) * unit, wrist))
    frames, centres, axes = zip(*parts, strict=True)
    return HandSurface(
        torch.tensor(frames, device=base.device), torch.stack(centres), torch.stack(axes)
    )


def _finger(finger: int, shape: HandShape, radii: Tensor) -> list[tuple[int, Tensor, Tensor]]:
    """Frame, centre and axes of a finger's four ellipsoids; radii: (3,) its half-breadths, m."""
    bones, knuckle = (
        (_THUMB_BONES, _THUMB_KNUCKLE) if finger == 0 else (_FINGER_BONES, _FINGER_KNUCKLE)
    )
    parts = []
    for number, bone in enumerate(bones):
        breadth = radii[number]
        start = -bone.before * breadth
        end = shape.bone_lengths_m[finger, number] + bone.beyond * breadth
        centre = torch.stack((0 * start, -(start + end) / 2, -bone.palmward * breadth))
        axes = torch.stack((breadth, (end - start) / 2, bone.depth * breadth))
        parts.append((1 + 3 * finger + number, centre, torch.diag(axes)))
    breadth = knuckle.breadth * radii[:2].mean()
    length = shape.bone_lengths_m[finger, 0]
    centre = torch.stack((0 * length, -length, -knuckle.palmward * breadth))
    axes = breadth * radii.new_tensor((1.0, knuckle.along, knuckle.depth))
    return [*parts, (1 + 3 * finger, centre, torch.diag(axes))]


def _pad(pad: _Pad, base: Tensor, unit: float, thick: float) -> tuple[Tensor, Tensor]:
    """Centre and axes of a pad in the hand frame; unit, thick: metres of a millimetre."""

    def point(root: int | None, offset: tuple[float, float, float]) -> Tensor:
        shift = base.new_tensor(offset) * unit
        return shift if root is None else base[root] + shift

    start, end = point(pad.start_root, pad.start), point(pad.end_root, pad.end)
    along = end - start
    length = along.norm()
    y = along / length
    z = torch.linalg.cross(torch.linalg.cross(y, along.new_tensor([0.0, 0.0, 1.0])), y)
    z = -z / z.norm()
    x = torch.linalg.cross(y, z)
    axes = (x * pad.wide * thick, y * (length / 2 + pad.beyond * thick), z * pad.deep * thick)
    return (start + end) / 2, torch.stack(axes, 1)
