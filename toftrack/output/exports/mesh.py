"""A hand's surface as triangles that follow its joints: the ellipsoids of hand/surface.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import FINGERS, forward_kinematics
from toftrack.hand.surface import hand_surface

_RINGS, _SECTORS = 10, 16
_WORLD = np.array([1.0, -1.0, -1.0])
_JOINT_OF_FRAME = [
    OPENXR_JOINT_NAMES.index(name)
    for name in (
        "wrist",
        *(f"thumb_{bone}" for bone in ("metacarpal", "proximal", "distal")),
        *(f"{f}_{bone}" for f in FINGERS[1:] for bone in ("proximal", "intermediate", "distal")),
    )
]
"""Which joint moves as each of the 16 frames of a HandPose does."""


class HandMesh(NamedTuple):
    """A straight hand with its wrist at the origin, in the world of OpenXR.

    points_m: (V, 3).  normals: (V, 3).  joint: (V,) of OpenXR, which each point moves with.
    triangles: (F, 3) of points, anticlockwise seen from outside.
    """

    points_m: np.ndarray
    normals: np.ndarray
    joint: np.ndarray
    triangles: np.ndarray


def hand_mesh(shape: HandShape) -> HandMesh:
    """The mesh of a shape: an ellipsoid is a ball of its own, which moves with one joint."""
    shape = shape.to("cpu", torch.float64)
    surface = hand_surface(shape)
    rest = forward_kinematics(torch.zeros(1, 27, dtype=torch.float64), shape)
    flesh = surface.pose(rest)
    centres = _WORLD * flesh.centres_m[0, :-1].numpy()
    axes = _WORLD[:, None] * flesh.axes_m[0, :-1].numpy()  # (E, 3, 3)
    ball, faces = _ball()
    points = centres[:, None] + ball @ axes.swapaxes(1, 2)
    normals = ball @ np.linalg.inv(axes)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # Mirrored axes turn a ball inside out.
    turned = np.where((np.linalg.det(axes) < 0)[:, None, None], faces[:, ::-1], faces)
    triangles = turned + len(ball) * np.arange(len(axes))[:, None, None]
    frames = surface.frame_index[:-1].numpy()
    joint = np.repeat(np.array(_JOINT_OF_FRAME)[frames], len(ball))
    return HandMesh(points.reshape(-1, 3), normals.reshape(-1, 3), joint, triangles.reshape(-1, 3))


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """A unit ball's points (P, 3) and triangles (F, 3); its poles are single points."""
    up = np.pi * np.arange(1, _RINGS) / _RINGS
    round_ = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
    rings = np.stack(
        (
            np.outer(np.sin(up), np.cos(round_)),
            np.outer(np.sin(up), np.sin(round_)),
            np.outer(np.cos(up), np.ones(_SECTORS)),
        ),
        -1,
    ).reshape(-1, 3)
    points = np.concatenate(([[0, 0, 1.0]], rings, [[0, 0, -1.0]]))
    here = np.arange(_SECTORS)
    after, last = (here + 1) % _SECTORS, len(points) - 1
    faces = [np.stack((np.zeros_like(here), 1 + here, 1 + after), 1)]
    for ring in range(_RINGS - 2):
        a, b = 1 + ring * _SECTORS, 1 + (ring + 1) * _SECTORS
        faces.append(np.stack((a + here, b + here, b + after), 1))
        faces.append(np.stack((a + here, b + after, a + after), 1))
    bottom = last - _SECTORS
    faces.append(np.stack((np.full_like(here, last), bottom + after, bottom + here), 1))
    return points, np.concatenate(faces)
