"""Figures of a pose space: training poses, traversals and extreme corners (paper, fig. 4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import default_hand_shape
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.data.pose_data import basic_pose
from toftrack.render.model_image import model_range_image
from toftrack.views.figures import chart
from toftrack.views.overlay import range_grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FONT = cv2.FONT_HERSHEY_SIMPLEX
COLOURS = {"palm": chart.BLUE, "fist": chart.VERMILLION, "gun": chart.GREEN}
"""Of the basic poses."""
WORDS = {"gun": "pointing"}
"""What pictures call a basic pose, where it is not its name in the training poses."""
_NEAR_DEGREES = 15.0
"""A pose is coloured as the gesture that it is within this root mean square distance of."""


def pose_picture(angles: Tensor, size: int) -> np.ndarray:
    """Range image of an upright hand, nearer is darker: (21,) rad to (size, size) uint8."""
    state = torch.cat((torch.tensor([0.0, 0.085, 0.5, -0.25, -0.3, 0.0]), angles.float().cpu()))
    focal = 2.0 * size
    k = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return range_grey(model_range_image(state.numpy(), default_hand_shape(), k, size, size))


def poses_figure(space: PoseSpace) -> np.ndarray:
    """Training poses in the first two coordinates, the gestures marked (fig. 4, left); BGR."""
    figure = chart.new_figure(1000, 720)
    axes = figure.subplots()
    chart.label(axes, "component 1 (degrees)", "component 2 (degrees)")
    latents = space.training_latents[:, :2].rad2deg().cpu()
    points = torch.nn.functional.pad(latents, (0, 2 - latents.shape[1])).numpy()
    labels = np.array(space.training_labels)
    basic, thumb = np.isin(labels, list(COLOURS)), np.char.find(labels, "+") >= 0
    for among, name, colour in (
        (~basic & ~thumb, "transformation", chart.GREY),
        (~basic & thumb, "thumb configuration", chart.PURPLE),
    ):
        axes.scatter(*points[among].T, color=colour, label=name)
    for row in np.flatnonzero(basic):
        label, colour = labels[row], COLOURS[labels[row]]
        axes.scatter(*points[row], 80, color=colour)
        beside = {"textcoords": "offset points", "color": colour, "weight": "bold", "size": 12}
        axes.annotate(WORDS.get(label, label), points[row], (9, -4), **beside)
        hand = pose_picture(space.decode(space.training_latents[row : row + 1])[0], 110)
        chart.picture_above(axes, points[row], hand)
    axes.margins(0.1, 0.15)
    axes.legend(loc="lower left")
    return chart.picture_of(figure)


def manifold_figure(space: PoseSpace) -> np.ndarray:
    """Training poses in pairs of coordinates (1-2, 1-3, 2-3), coloured by the nearest gesture, grey
    where none is near; poses of other sources than the synthetic ones, too. BGR.
    """
    pairs = [(i, j) for i, j in ((0, 1), (0, 2), (1, 2)) if j < space.dims] or [(0, 0)]
    figure = chart.new_figure(440 * len(pairs), 460)
    points = space.training_latents.cpu().numpy()
    for (i, j), axes in zip(pairs, figure.subplots(1, len(pairs), squeeze=False)[0], strict=True):
        scatter_gestures(axes, space, points[:, (i, j)])
        chart.label(axes, f"coordinate {i + 1}", f"coordinate {j + 1}")
    names = axes.get_legend_handles_labels()
    figure.legend(*names, loc="outside upper left", ncols=4, frameon=False)
    return chart.picture_of(figure)


def scatter_gestures(axes: Axes, space: PoseSpace, points: np.ndarray) -> None:
    """The training poses at (N, 2) points of a plot, coloured by the nearest gesture, grey where
    all are far.
    """
    angles = space.decode(space.training_latents)
    basic = torch.stack([basic_pose(gesture) for gesture in COLOURS]).to(angles)
    least, which = (angles[:, None] - basic).square().mean(-1).sqrt().min(1)
    nearest = torch.where(torch.rad2deg(least) < _NEAR_DEGREES, which, -1).cpu().numpy()
    named = [(WORDS.get(gesture, gesture), colour) for gesture, colour in COLOURS.items()]
    for number, (name, colour) in enumerate([("other training poses", chart.GREY), *named], -1):
        axes.scatter(*points[nearest == number].T, 36, color=colour, alpha=0.6, label=name)


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
    rows = []
    for name, ends in (("maximum", space.upper), ("minimum", space.lower)):
        latents = {"all": ends}
        for d in range(space.dims):
            latents[str(d + 1)] = middle.clone()
            latents[str(d + 1)][d] = ends[d]
        tiles = [
            _captioned(pose_picture(space.decode(latent[None])[0], size), f"{which} at {name}")
            for which, latent in latents.items()
        ]
        rows.append(np.hstack(tiles))
    return cv2.cvtColor(np.vstack(rows), cv2.COLOR_GRAY2BGR)


def _captioned(picture: np.ndarray, text: str) -> np.ndarray:
    caption = np.full((32, picture.shape[1]), 255, np.uint8)
    cv2.putText(caption, text, (10, 22), _FONT, 0.55, 40, 1, cv2.LINE_AA)
    return np.vstack((caption, picture))
