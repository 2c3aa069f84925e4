"""Whose pixels are: what the pose network says of a hand's pixels, and of those in front of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.detector.hand_detector import Detection
from toftrack.detector.parts import FOREARM_PART, THING_PART
from toftrack.render.segmentation import Observation

_LEAST_PARTS = 4
"""Parts of a crop, of 9 mm, that a thing in the hand has at least."""
_MOSTLY, _UNKNOWN = 0.5, 255
"""Of a surface in front of the hand, so much must be its arm where the network sees it; and the
class of what it does not see."""


def without_things(observation: Observation, detection: Detection) -> Observation:
    """The same without the pixels of a thing in the hand, as the pose network tells them.

    Else the best pose is one whose fingers explain the thing.
    """
    kind = detection.parts.kind
    if observation.empty or np.count_nonzero(kind == THING_PART) < _LEAST_PARTS:
        return observation
    thing = _pixels_of(observation.hand, observation, detection, THING_PART)
    return replace(observation, hand=observation.hand & ~thing, thing=thing)


def with_own_arm(observation: Observation, detection: Detection) -> Observation:
    """The same with what the pose network calls the hand's forearm told from what hides it.

    Who wears the camera has the arm nearer to it than the hand, which it does not hide as what
    passes in front does. A surface in front is the arm when the network says so of most of it.
    """
    occluder = observation.occluder.cpu().numpy()
    count, surface = cv2.connectedComponents(occluder.astype(np.uint8), connectivity=4)
    row, column = np.nonzero(occluder)
    kind = detection.parts.at(_points_of(row, column, observation), outside=_UNKNOWN)
    of = surface[row, column]
    known = np.bincount(of[kind != _UNKNOWN], minlength=count)
    mine = np.bincount(of[kind == FOREARM_PART], minlength=count)
    arm = torch.from_numpy((mine > _MOSTLY * known)[surface] & occluder).to(observation.hand.device)
    return replace(observation, hand=observation.hand | arm, occluder=observation.occluder & ~arm)


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
