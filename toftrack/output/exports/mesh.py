"""A hand's surface as triangles that follow its joints: the ellipsoids of hand/surface.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull

from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import FINGERS, forward_kinematics
from toftrack.hand.surface import hand_surface

_POINTS = 146
"""Of an ellipsoid."""
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
    """A unit ball's points (P, 3), evenly spread on a spiral, and triangles (F, 3)."""
    z = np.linspace(1, -1, _POINTS)
    turn = np.pi * (3 - 5**0.5) * np.arange(_POINTS)
    radius = np.sqrt(1 - z**2)
    points = np.stack((radius * np.cos(turn), radius * np.sin(turn), z), -1)
    faces = ConvexHull(points).simplices
    inwards = np.linalg.det(points[faces]) < 0
    return points, np.where(inwards[:, None], faces[:, ::-1], faces)
