"""Faults put into the tracker on purpose, to see which guard notices them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from toftrack.hand import shape
from toftrack.tracking import confidence

INDEX = 1
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Break:
    """One fault.  overrides: of the configuration.  patched: entered before the tracker is made,
    for what no setting can do.  k_scale: times the camera's matrix.  other_side: a wrong one given.
    """

    about: str
    overrides: tuple[str, ...] = ()
    patched: Callable[[], AbstractContextManager[object]] = nullcontext
    k_scale: float = 1.0
    other_side: bool = False


@contextmanager
def _turned_index(degrees: float) -> Iterator[None]:
    """The index finger bends about another axis, turned about the finger's own direction."""
    rows = list(shape._REST_DEGREES)
    abduction, elevation, roll = rows[INDEX]
    rows[INDEX] = (abduction, elevation, roll + degrees)
    with patch.object(shape, "_REST_DEGREES", tuple(rows)):
        yield


_judge = confidence.JointConfidence.judge


def _doubled(
    model: confidence.JointConfidence, features: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    sigma, near = _judge(model, features)
    return 2 * sigma, near


BREAKS = {
    "keypoints off": Break(
        "the networks' keypoints neither judge nor pull a pose",
        ("posterior.keypoints=0", "detector.keypoint_weight=0"),
    ),
    "finger's axis": Break(
        "the index finger bends about an axis turned by 5 degrees",
        patched=lambda: _turned_index(5.0),
    ),
    "sigma doubled": Break(
        "all joints' standard deviations twice as large",
        patched=lambda: patch.object(confidence.JointConfidence, "judge", _doubled),
    ),
    "other side": Break("the other hand's side is given", other_side=True),
    "K scaled": Break("the camera's matrix times 1.1", k_scale=1.1),
}
