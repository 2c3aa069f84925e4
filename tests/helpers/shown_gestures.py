"""Poses and what they are called, as the tests of gestures share them."""

import numpy as np
from helpers.settings import gestures

from toftrack.gestures.features import features_of_angles
from toftrack.gestures.recognition import Gestures, update
from toftrack.pose_space.data.pose_data import basic_pose

SURE, ON = 0.9, 0.0
"""A good score, and no distance from the pose space."""
GESTURES = gestures()


def pose(name: str, thumb: str | None = None) -> np.ndarray:
    return basic_pose(name, thumb).numpy()


def fingers(*curled: int) -> np.ndarray:
    """(21,) rad: the palm with some fingers (0 = index .. 3 = little) as in the fist."""
    angles = pose("palm")
    for finger in curled:
        part = slice(5 + 4 * finger, 9 + 4 * finger)
        angles[part] = pose("fist")[part]
    return angles


def label_of(angles: np.ndarray, gestures: Gestures = GESTURES, off: float = ON) -> str:
    return update(None, features_of_angles(angles), SURE, off, gestures)[1]
