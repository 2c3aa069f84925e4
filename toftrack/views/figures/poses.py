"""Figures of a pose space: training poses, traversals and extreme corners (paper, fig. 4)."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.data.training_poses import GESTURES, basic_pose
from toftrack.render.closed_form import render_range_images
from toftrack.views.overlay import range_grey

_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Okabe and Ito's colours, which colour-blind people can tell apart; BGR.
BASIC_BGR = {"palm": (178, 114, 0), "fist": (0, 94, 213), "gun": (115, 158, 0)}
WORDS = {"gun": "pointing"}
"""What pictures call a basic pose, where it is not its name in the training poses."""
_NEAR_DEGREES = 15.0
"""A pose is coloured as the gesture that it is within this root mean square distance of."""
_BETWEEN, _THUMB = (150, 150, 150), (167, 121, 204)
_TEXT = (40, 40, 40)


def pose_picture(angles: Tensor, size: int = 200, shape: HandShape | None = None) -> np.ndarray:
    """Range image of an upright hand, nearer is darker: (21,) rad to (size, size) uint8."""
    shape = shape or default_hand_shape()
    state = torch.cat((torch.tensor([0.0, 0.085, 0.5, -0.25, -0.3, 0.0]), angles.float().cpu()))
    both = hand_surface(shape).pose(forward_kinematics(state[None], shape))
    hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
    focal = 2.0 * size
    k = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return range_grey(render_range_images(hand, k, size, size)[0].numpy())


def poses_figure(space: PoseSpace, width: int = 1000, height: int = 720) -> np.ndarray:
    """Training poses in the first two coordinates, the gestures marked (fig. 4, left); BGR."""
    picture = np.full((height, width, 3), 255, np.uint8)
    points = np.degrees(space.training_latents[:, :2].cpu().numpy())
    if points.shape[1] == 1:
        points = np.column_stack((points, np.zeros(len(points))))
    low, high = points.min(0), points.max(0)
    margin, span = 90, np.maximum(high - low, 1e-6)

    def place(point: np.ndarray) -> tuple[int, int]:
        x, y = (point - low) / span
        return (
            int(margin + x * (width - 2 * margin)),
            int(height - margin - y * (height - 2 * margin)),
        )

    corner_low, corner_high = place(low), place(high)
    cv2.rectangle(picture, corner_low, corner_high, (210, 210, 210), 1)
    for label, point in zip(space.training_labels, points, strict=True):
        colour = _THUMB if "+" in label else _BETWEEN
        if label not in BASIC_BGR:
            cv2.circle(picture, place(point), 5, colour, -1, cv2.LINE_AA)
    for label, point in zip(space.training_labels, points, strict=True):
        if label not in BASIC_BGR:
            continue
        u, v = place(point)
        index = space.training_labels.index(label)
        thumb = pose_picture(space.decode(space.training_latents[index : index + 1])[0], 110)
        left, top = np.clip((u - 55, v - 130), 0, (width - 110, height - 110))
        patch = picture[top : top + 110, left : left + 110]
        np.minimum(patch, thumb[..., None], out=patch)
        cv2.circle(picture, (u, v), 9, BASIC_BGR[label], -1, cv2.LINE_AA)
        cv2.putText(picture, label, (u + 14, v + 6), _FONT, 0.7, BASIC_BGR[label], 2, cv2.LINE_AA)
    for text, x, y in (
        ("component 1 (degrees)", width // 2 - 110, height - 30),
        (f"{low[0]:.0f}", corner_low[0] - 20, height - 60),
        (f"{high[0]:.0f}", corner_high[0] - 20, height - 60),
        ("component 2", 10, margin - 50),
        (f"{high[1]:.0f}", 30, corner_high[1] + 8),
        (f"{low[1]:.0f}", 30, corner_low[1] + 8),
    ):
        cv2.putText(picture, text, (x, y), _FONT, 0.6, _TEXT, 1, cv2.LINE_AA)
    for row, (text, colour) in enumerate(
        (("transformation", _BETWEEN), ("thumb configuration", _THUMB))
    ):
        y = height - 150 + 26 * row
        cv2.circle(picture, (120, y - 5), 6, colour, -1, cv2.LINE_AA)
        cv2.putText(picture, text, (135, y), _FONT, 0.6, _TEXT, 1, cv2.LINE_AA)
    return picture


def manifold_figure(space: PoseSpace, size: int = 460) -> np.ndarray:
    """Training poses in pairs of coordinates (1-2, 1-3, 2-3), coloured by the nearest gesture, grey
    where none is near; poses of other sources than the synthetic ones, too. BGR.
    """
    latents = space.training_latents
    nearest = nearest_gestures(space.decode(latents))
    points = latents.cpu().numpy()
    pairs = [(i, j) for i, j in ((0, 1), (0, 2), (1, 2)) if j < space.dims] or [(0, 0)]
    panels = []
    for i, j in pairs:
        panel = np.full((size, size, 3), 255, np.uint8)
        cv2.rectangle(panel, (30, 30), (size - 30, size - 30), (210, 210, 210), 1)
        xy = points[:, (i, j)]
        span = np.maximum(xy.max(0) - xy.min(0), 1e-9)
        spots = 30 + (xy - xy.min(0)) / span * (size - 60)
        for (u, v), gesture in sorted(
            zip(spots, nearest, strict=True), key=lambda item: item[1] is not None
        ):
            colour = _BETWEEN if gesture is None else BASIC_BGR[gesture]
            cv2.circle(panel, (int(u), int(size - v)), 4, colour, -1, cv2.LINE_AA)
        _write_limits(panel, xy.min(0), xy.max(0), f"{j + 1} against {i + 1}")
        panels.append(panel)
    x = 34
    for name, colour in (*BASIC_BGR.items(), ("other", _BETWEEN)):
        cv2.circle(panels[0], (x, 16), 5, colour, -1, cv2.LINE_AA)
        word = WORDS.get(name, name)
        cv2.putText(panels[0], word, (x + 9, 21), _FONT, 0.5, _TEXT, 1, cv2.LINE_AA)
        x += 80
    return np.hstack(panels)


def _write_limits(panel: np.ndarray, low: np.ndarray, high: np.ndarray, name: str) -> None:
    """Both coordinates' values at the ends of a manifold's panel, and the panel's name between."""
    bottom, right = panel.shape[0] - 10, panel.shape[1] - 30

    def write(text: str, x: int, y: int, aligned: float = 0.0, size: float = 0.5) -> None:
        width = cv2.getTextSize(text, _FONT, size, 1)[0][0]
        at = (x - round(aligned * width), y)
        cv2.putText(panel, text, at, _FONT, size, _TEXT, 1, cv2.LINE_AA)

    write(name, panel.shape[1] // 2, bottom, 0.5)
    write(f"{low[0]:.2g}", 30, bottom, size=0.42)
    write(f"{high[0]:.2g}", right, bottom, 1.0, size=0.42)
    write(f"{high[1]:.2g}", 34, 45, size=0.42)
    write(f"{low[1]:.2g}", 34, panel.shape[0] - 36, size=0.42)


def nearest_gestures(angles: Tensor) -> list[str | None]:
    """The gesture nearest to each pose, (N, 21) rad; None where all are far."""
    basic = torch.stack([basic_pose(gesture) for gesture in GESTURES]).to(angles)
    distance = (angles[:, None] - basic).square().mean(-1).sqrt()
    least, which = distance.min(1)
    near = torch.rad2deg(least) < _NEAR_DEGREES
    return [GESTURES[w] if n else None for w, n in zip(which.tolist(), near.tolist(), strict=True)]


def traversals_figure(space: PoseSpace, steps: int = 7, size: int = 150) -> np.ndarray:
    """A row of range images a coordinate, from its lower to its upper bound through the training
    pose nearest to the middle of all, the other coordinates as there; BGR.
    """
    latents = space.training_latents
    span = (space.upper - space.lower).clamp(min=1e-9)
    centre = latents[((latents - latents.mean(0)) / span).square().sum(1).argmin()]
    rows = []
    for d in range(space.dims):
        path = centre.repeat(steps, 1)
        path[:, d] = torch.linspace(0, 1, steps).to(path) * span[d] + space.lower[d]
        tiles = [pose_picture(angles, size) for angles in space.decode(path)]
        rows.append(_captioned(np.hstack(tiles), f"coordinate {d + 1}, lowest to highest"))
    return cv2.cvtColor(np.vstack(rows), cv2.COLOR_GRAY2BGR)


def corners_figure(space: PoseSpace, size: int = 220) -> np.ndarray:
    """Range images at the extremes of every coordinate, the others at their middle, and at the
    corners where all are at their maximum or minimum (fig. 4, middle and right); BGR.
    """
    middle = (space.lower + space.upper) / 2
    columns = [("all at maximum", space.upper, "all at minimum", space.lower)]
    for d in range(space.dims):
        top, bottom = middle.clone(), middle.clone()
        top[d], bottom[d] = space.upper[d], space.lower[d]
        columns.append((f"{d + 1} at maximum", top, f"{d + 1} at minimum", bottom))
    tiles = []
    for name_top, top, name_bottom, bottom in columns:
        pair = [
            _captioned(pose_picture(space.decode(latent[None])[0], size), name)
            for name, latent in ((name_top, top), (name_bottom, bottom))
        ]
        tiles.append(np.vstack(pair))
    return cv2.cvtColor(np.hstack(tiles), cv2.COLOR_GRAY2BGR)


def _captioned(picture: np.ndarray, text: str) -> np.ndarray:
    caption = np.full((32, picture.shape[1]), 255, np.uint8)
    cv2.putText(caption, text, (10, 22), _FONT, 0.55, 40, 1, cv2.LINE_AA)
    return np.vstack((caption, picture))
