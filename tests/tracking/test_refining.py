"""When the networks' poses are heard, and when other fingers are tried."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from toftrack.compute.pace import FRAME_S
from toftrack.tracking.refining import rotations
from toftrack.tracking.state import Track


def track(frames: int, **changes: object) -> Track:
    none = torch.zeros(0)
    believed = Track(none, none, none, none, none, torch.zeros(1, 27), log_odds=5.0)
    return replace(believed, age_s=frames * FRAME_S, **changes)


def test_a_believed_hand_is_tried_in_turn() -> None:
    found = [rotations(track(frames), 0.9) for frames in range(1, 7)]
    assert found == [(False, True), (True, False)] * 3


@pytest.mark.parametrize(
    "changes", [{"log_odds": 0.0}, {"log_odds": None}, {"challenged_s": FRAME_S}]
)
def test_a_hand_that_is_doubted_or_challenged_is_tried_in_both_ways(changes: dict) -> None:
    assert all(rotations(track(frames, **changes), 0.9) == (True, True) for frames in range(1, 5))


def test_nothing_is_left_out_where_that_is_asked_for() -> None:
    assert all(rotations(track(frames), 1.0) == (True, True) for frames in range(1, 5))
