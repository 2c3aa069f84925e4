"""Tracked frames of one hand, as views get them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.estimate import Estimate
from toftrack.frames import Frame
from toftrack.hand.shape import HandShape
from toftrack.tracking.state import StepInfo
from toftrack.views.base import TrackedFrame, TrackedHand


def one_hand(
    frame: Frame,
    depth_m: np.ndarray,
    camera: Camera,
    estimate: Estimate,
    shape: HandShape,
    insight: StepInfo | None = None,
) -> TrackedFrame:
    """A moment with one slot."""
    return TrackedFrame(frame, depth_m, camera, (TrackedHand(estimate, shape, insight),))


def with_hand(moment: TrackedFrame, **changes: Any) -> TrackedFrame:
    """The moment with changes of its first hand, and no other one."""
    return replace(moment, hands=(replace(moment.hands[0], **changes),))
