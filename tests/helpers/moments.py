"""Tracked frames of one hand, as views get them."""

from dataclasses import replace
from typing import Any

import numpy as np

from toftrack.devices.base import Device
from toftrack.tracking.tracker import Tracker
from toftrack.views.base import TrackedFrame, TrackedHand


def tracked(device: Device, tracker: Tracker) -> list[TrackedFrame]:
    """A device's frames, as they are tracked."""
    kept = []
    for frame in device:
        depth, shape = device.camera.rectify(frame.depth, frame.radial), tracker.shape
        estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
        hand = TrackedHand(estimate, shape, tracker.hands.insights[0])
        kept.append(TrackedFrame(frame, depth, device.camera, (hand,)))
    return kept


def two_hands(moment: TrackedFrame, shift_m: float = 0.15, **changes: Any) -> TrackedFrame:
    """The moment with a second hand of the other side beside the first one, and with changes; both
    sides as if they were told.
    """
    first = with_hand(moment, estimate=replace(moment.estimates[0], side_probability=1.0)).hands[0]
    move = np.array([shift_m, 0, 0], np.float32)
    state = first.estimate.state.copy()
    state[:3] += move
    side = "left" if first.shape.side == "right" else "right"
    reported = {"joints_m": first.estimate.joints_m + move, "state": state, "side": side}
    estimate = replace(first.estimate, **reported | changes)
    return replace(moment, hands=(first, TrackedHand(estimate, first.shape.of_side(side), None)))


def with_hand(moment: TrackedFrame, **changes: Any) -> TrackedFrame:
    """The moment with changes of its first hand, and no other one."""
    return replace(moment, hands=(replace(moment.hands[0], **changes),))
