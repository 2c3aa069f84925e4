"""A pose with other fingers takes over when it was better for long enough, and not by chance."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers.configured import refinement

from toftrack.compute.pace import FRAME_S
from toftrack.tracking.select import Alternatives, select
from toftrack.tracking.state import Contender, Track

CFG = refinement(swap_gain=0.05, drift=0.01)


class MarkedJoints:
    """Joints that only the first angle moves, a metre a radian."""

    def joints(self, states: torch.Tensor) -> torch.Tensor:
        return states[:, 6, None, None].expand(-1, 21, 3)


def frame():
    model = SimpleNamespace(refinement=CFG)
    return SimpleNamespace(model=model, hand=SimpleNamespace(refiner=MarkedJoints()))


def pose(mark: float) -> torch.Tensor:
    state = torch.zeros(1, 27)
    state[0, 6] = mark
    return state


def some(marks_and_scores: dict[float, float]) -> Alternatives:
    poses = torch.cat([pose(0.0)[:0], *(pose(mark) for mark in marks_and_scores)])
    return Alternatives(poses, torch.tensor(list(marks_and_scores.values())))


def track(**changes: object) -> Track:
    none = torch.zeros(0)
    return replace(Track(none, none, none, none, none, pose(0.0), age_s=1.0), **changes)


def after(frames: int, others: dict[float, float], **changes: object) -> tuple[float, Track]:
    """The mark of the pose that stands after so many frames, each with such others."""
    now = track(**changes)
    for _ in range(frames):
        found = Alternatives(now.pose, torch.tensor([0.0]))
        stands, contender = select(found, some(others), now, FRAME_S, frame())
        now = replace(now, pose=stands, contender=contender)
    return float(now.pose[0, 6]), now


def test_much_the_same_pose_that_is_better_is_taken_at_once() -> None:
    assert after(1, {0.01: 0.001})[0] == pytest.approx(0.01)
    assert after(1, {0.01: -0.001})[0] == 0


def test_other_fingers_that_are_clearly_better_are_taken_at_once() -> None:
    assert after(1, {0.2: CFG.swap_gain + CFG.drift + 0.01})[0] == pytest.approx(0.2)


def test_other_fingers_that_are_a_little_better_must_stay_so() -> None:
    gain = CFG.drift + CFG.swap_gain / 3 + 0.001
    for frames, mark in ((1, 0.0), (2, 0.0), (3, 0.2)):
        assert after(frames, {0.2: gain})[0] == pytest.approx(mark)
    assert after(2, {0.2: gain})[1].contender is not None


def test_after_a_pause_a_frame_speaks_for_those_that_were_dropped() -> None:
    gain = CFG.drift + CFG.swap_gain / 3 + 0.001
    for dt_s, mark in ((1.4 * FRAME_S, 0.0), (4 * FRAME_S, 0.2)):
        now = track()
        found = Alternatives(now.pose, torch.tensor([0.0]))
        stands, _ = select(found, some({0.2: gain}), now, dt_s, frame())
        assert float(stands[0, 6]) == pytest.approx(mark)


def test_a_tie_changes_nothing_however_long() -> None:
    stands, now = after(50, {0.2: CFG.drift})
    assert stands == 0 and now.contender is None


def test_a_lead_is_the_contenders_own() -> None:
    gain = CFG.drift + 0.6 * CFG.swap_gain
    _, led = after(1, {0.2: gain})
    assert led.contender is not None
    assert after(1, {-0.2: gain}, contender=led.contender)[0] == 0
    assert after(1, {0.2: gain}, contender=led.contender)[0] == pytest.approx(0.2)


def test_a_contender_with_a_lead_does_not_take_over_in_a_frame_that_speaks_against_it() -> None:
    predicted = Contender(pose(0.2), 10 * CFG.swap_gain)
    assert after(1, {0.2: -0.001}, contender=predicted)[0] == 0


def test_a_track_that_is_not_believed_is_corrected_sooner() -> None:
    gain = CFG.drift + 0.5 * CFG.swap_gain
    assert after(1, {0.2: gain}, log_odds=3.0)[0] == 0
    assert after(1, {0.2: gain}, log_odds=-3.0)[0] == pytest.approx(0.2)
    assert after(1, {0.2: CFG.drift + 1e-4}, age_s=0.0)[0] == pytest.approx(0.2), "just begun"


def test_nothing_beside_the_found_pose_changes_nothing() -> None:
    assert after(3, {})[0] == 0
