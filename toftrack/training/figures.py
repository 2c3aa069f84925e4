"""Pictures of the detector's training: what it sees, and how its error falls."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from toftrack.training.images import crop_images, wide_images
from toftrack.training.shapes import shape_bank
from toftrack.views.figures import chart

_CROPS, _COLUMNS, _SIDE = 48, 8, 128
_PALM, _OTHER = (178, 114, 0), (0, 94, 213)  # BGR
_PART_COLOURS = np.array(
    [[0, 0, 0], [0, 70, 0], [80, 0, 0], [0, 0, 90], [0, 80, 80], [60, 0, 60]], np.uint8
)
"""Of SEGMENTS, and of what lies outside of the image; BGR."""


def images_figure(seed: int) -> np.ndarray:
    """Crops with their parts in colour, and whole images with palms marked, BGR."""
    generator = torch.Generator().manual_seed(seed)
    bank = shape_bank(24, generator)
    crops, wides = crop_images(_CROPS, bank, generator), wide_images(8, bank, generator)
    tiles = []
    for image, parts in zip(crops.image.numpy(), crops.parts.numpy(), strict=True):
        tile = _grey(1 - (image[0] + 1) / 2, (_SIDE, _SIDE))
        colours = _PART_COLOURS[parts]  # -1 is the last
        tiles.append(cv2.add(tile, cv2.resize(colours, (_SIDE, _SIDE), interpolation=0)))
    crop_rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, _CROPS, _COLUMNS)]
    scale = 2 * _SIDE / wides.image.shape[-1]
    tiles = []
    for i, image in enumerate(wides.image.numpy()):
        tile = _grey(1 - image[0], (2 * _SIDE, round(scale * image.shape[1])))
        for hand, (cell, seen) in enumerate(zip(wides.cell[i], wides.seen[i], strict=True)):
            if float(seen) > 0.15:
                u, v = ((cell + 0.5) * 4 * scale).tolist()
                colour = _OTHER if hand else _PALM
                cv2.circle(tile, (round(u), round(v)), 7, colour, 2, cv2.LINE_AA)
        tiles.append(tile)
    wide_rows = [np.hstack(tiles[i : i + 4]) for i in (0, 4)]
    note = (
        "Above, crops: hand green, forearm blue, another hand red, things yellow, outside violet."
        " Below, whole images: a blue ring on a palm, a red one on another hand's."
    )
    return chart.titled(np.vstack(crop_rows + wide_rows), "Training images", note)


def _grey(nearness: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    image = (255 * nearness.clip(0, 1)).astype(np.uint8)
    return cv2.cvtColor(cv2.resize(image, size, interpolation=0), cv2.COLOR_GRAY2BGR)


def course_figure(course: list[dict[str, Any]]) -> np.ndarray:
    """Mean joint errors on fresh training images over their number, BGR."""
    figure = chart.new_figure(760, 420)
    axes = figure.subplots()
    chart.label(axes, "thousand images", "mean joint error, mm")
    images = [row["images"] / 1e3 for row in course]
    for key, name, colour in (
        ("joints_mm", "likeliest hypothesis", chart.VERMILLION),
        ("keypoints_mm", "keypoints", chart.BLUE),
    ):
        axes.plot(images, [row[key] for row in course], color=colour, label=name)
    chart.round_log_ticks(axes, "y")
    axes.set_xlim(left=0)
    axes.legend()
    picture = chart.picture_of(figure)
    return chart.titled(picture, "Training of the pose network", "On images never seen before.")
