"""A gesture of the user's from frames in which the hand holds it."""

from __future__ import annotations

import math

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.gestures import features
from toftrack.gestures.files import NamedPose
from toftrack.hand.skeleton import FINGERS

_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_FEWEST_FRAMES = 5


def learned_pose(
    name: str, angles_rad: np.ndarray, believed: np.ndarray, steady_rad: float
) -> NamedPose:
    """The median of the joint angles over the believed frames, and how much they vary.

    Medians and median deviations, so that a few frames with a wrong finger do no harm.

    angles_rad: (T, 21) of the frames.  believed: (T,) bool, those whose estimate is to be used.
    steady_rad: the most that a finger's total flexion may vary, standard deviation.

    Raises ToftrackError when fewer than half of the frames are believed, or the hand moves.
    """
    count, every = int(believed.sum()), len(believed)
    if count < max(_FEWEST_FRAMES, every / 2):
        raise ToftrackError(
            f"the hand was followed in only {count} of the {every} frames (at least half of them"
            f" and {_FEWEST_FRAMES} are needed); give a part of the recording in which track.py"
            " follows it, and say whose hand it is, hand.side=left or right"
        )
    seen = angles_rad[believed].astype(np.float64)
    flexion = _deviation(seen @ features.SUMS[features.FLEXION].T)
    worst = int(flexion.argmax())
    if flexion[worst] > steady_rad:
        raise ToftrackError(
            f"the hand holds no one pose there: the {FINGERS[1 + worst]} finger bends and"
            f" stretches by {math.degrees(flexion[worst]):.0f} degrees (standard deviation); give"
            " a part of the recording in which it is held still"
        )
    return NamedPose(name, np.median(seen, axis=0), _deviation(seen))


def _deviation(values: np.ndarray) -> np.ndarray:
    """Robust standard deviation of each column, (T, k) to (k,)."""
    return _NORMAL_MAD * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
