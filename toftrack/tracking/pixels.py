"""Whose pixels are: what the pose network says of a hand's pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toftrack.detector.hand_detector import Detection
from toftrack.detector.parts import THING_PART
from toftrack.render.segmentation import Observation

_LEAST_PARTS = 4
"""Parts of a crop, of 9 mm, that a thing in the hand has at least."""


def without_things(observation: Observation, detection: Detection) -> Observation:
    """The same without the pixels of a thing in the hand, as the pose network tells them.

    Else the best pose is one whose fingers explain the thing.
    """
    kind = detection.parts.kind
    if observation.empty or np.count_nonzero(kind == THING_PART) < _LEAST_PARTS:
        return observation
    thing = _pixels_of(observation.hand, observation, detection, THING_PART)
    return replace(observation, hand=observation.hand & ~thing, thing=thing)


def _pixels_of(
    among: Tensor, observation: Observation, detection: Detection, *kinds: int
) -> Tensor:
    """(H, W) bool: those pixels of a mask that the pose network says are of some classes."""
    row, column = np.nonzero(among.cpu().numpy())
    chosen = np.isin(detection.parts.at(_points_of(row, column, observation)), kinds)
    mask = np.zeros(among.shape, bool)
    mask[row[chosen], column[chosen]] = True
    return torch.from_numpy(mask).to(among.device)


def _points_of(row: np.ndarray, column: np.ndarray, observation: Observation) -> np.ndarray:
    """(P, 3) what is seen at pixels, camera frame."""
    k, z = observation.k.cpu().numpy(), observation.depth_m.cpu().numpy()[row, column]
    x, y = (column - k[0, 2]) / k[0, 0] * z, (row - k[1, 2]) / k[1, 1] * z
    return np.stack((x, y, z), 1)
