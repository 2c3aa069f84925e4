"""The hand's surface: ellipsoids on the bones and in the palm (paper, section 2.2, equations 2
and 3).

Each phalanx is one ellipsoid along its bone, each knuckle a small one that fills the waist between
two of them, and the palm is a fan of flat ones over the metacarpals with the muscle pads of the
thumb and of the little finger. Half-breadths follow ANSUR II (see hand/shape.py); depth over
breadth of a finger is about 0.9, the palm's thickness at the third metacarpal about 28 mm
(Garrett, "The adult human hand", Human Factors 13(2), 1971).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import HandPose

# Half-breadth of the fingers at the middle of each bone, millimetres for a hand of 190 mm.
BONE_RADII_MM = (
    (12.5, 10.0, 9.0),
    (10.2, 8.9, 7.7),
    (10.3, 9.1, 7.8),
    (9.8, 8.6, 7.4),
    (8.6, 7.6, 6.6),
)
_DEPTH_OVER_BREADTH = 0.92
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


def _between(
    start: Tensor, end: Tensor, breadth: float, depth: float, overlap: float
) -> tuple[Tensor, Tensor]:
    """A flat ellipsoid from `start` to `end` in the palm: centre and axes in the hand frame."""
    along = end - start
    length = along.norm()
    y = along / length
    z = torch.linalg.cross(torch.linalg.cross(y, along.new_tensor([0.0, 0.0, 1.0])), y)
    z = -z / z.norm()
    x = torch.linalg.cross(y, z)
    return (start + end) / 2, torch.stack((x * breadth, y * (length / 2 + overlap), z * depth), 1)


def hand_surface(shape: HandShape) -> HandSurface:
    """Flesh out a skeleton of the given sizes; on the shape's device and of its dtype."""
    base, bones = shape.base_m, shape.bone_lengths_m
    mm = shape.hand_length_m / _REFERENCE_LENGTH_M / 1000 * shape.thickness
    radii = base.new_tensor(BONE_RADII_MM) * mm
    depths = radii * _DEPTH_OVER_BREADTH
    frame_index: list[int] = []
    centres: list[Tensor] = []
    axes: list[Tensor] = []

    def attach(frame: int, centre: Tensor, semi_axes: Tensor) -> None:
        frame_index.append(frame)
        centres.append(centre)
        axes.append(semi_axes if semi_axes.dim() == 2 else torch.diag(semi_axes))

    def bone_point(down: Tensor) -> Tensor:
        return torch.stack((torch.zeros_like(down), -down, torch.zeros_like(down)))

    for finger in range(5):
        for bone in range(3):
            length, frame = bones[finger, bone], 1 + 3 * finger + bone
            breadth, depth = radii[finger, bone], depths[finger, bone]
            if bone == 2:
                # The last ellipsoid ends exactly at the tip and reaches back over the joint.
                back = 0.55 * breadth
                attach(
                    frame,
                    bone_point((length - back) / 2),
                    torch.stack((breadth, (length + back) / 2, depth)),
                )
                continue
            over = 0.50 * breadth
            attach(
                frame,
                bone_point(length / 2),
                torch.stack((breadth, length / 2 + over, depth)),
            )
            # Knuckle at the distal joint: fills the waist between this ellipsoid and the next.
            knuckle = 0.94 * (radii[finger, bone] + radii[finger, bone + 1]) / 2
            attach(
                frame,
                bone_point(length),
                torch.stack((knuckle, knuckle, knuckle * _DEPTH_OVER_BREADTH)),
            )

    def palm(*point_mm: float) -> Tensor:
        return base.new_tensor(point_mm) * (shape.hand_length_m / _REFERENCE_LENGTH_M / 1000)

    # Metacarpals, from the carpus to the knuckles; the flesh of the palm lies in front of the
    # bones.
    for finger, (start_x, wide, deep) in enumerate(
        ((9.0, 13.0, 15.0), (2.0, 13.0, 16.0), (-6.0, 12.5, 15.5), (-13.0, 11.5, 14.5)), start=1
    ):
        start, end = palm(start_x, -4.0, -8.0), base[finger] + palm(0.0, 0.0, -3.0)
        attach(0, *_between(start, end, wide * mm, deep * mm, 0.5 * wide * mm))
    # Carpus, thenar and hypothenar pads, the web between thumb and index finger, and the pad of the
    # knuckles across the palm.
    attach(0, *_between(palm(-15, -4, -2), palm(13, -4, -2), 18 * mm, 16 * mm, 11 * mm))
    attach(0, *_between(palm(8, -20, -16), base[0] + palm(4, -14, -7), 16 * mm, 15 * mm, 6 * mm))
    attach(0, *_between(palm(-20, -12, -9), base[4] + palm(4, 8, -5), 12 * mm, 14 * mm, 7 * mm))
    attach(
        0, *_between(base[0] + palm(0, 0, -2), base[1] + palm(-3, 10, -9), 17 * mm, 12 * mm, 8 * mm)
    )
    attach(
        0,
        *_between(base[4] + palm(4, -6, -4), base[1] + palm(-4, -4, -6), 15 * mm, 10 * mm, 12 * mm),
    )
    # The wrist ellipsoid, across the forearm below the hand and wide enough for a bent wrist.
    attach(0, palm(0, 45, 0), torch.stack([base.new_tensor(v) * mm for v in (50, 45, 45)]))
    return HandSurface(
        torch.tensor(frame_index, device=base.device), torch.stack(centres), torch.stack(axes)
    )
