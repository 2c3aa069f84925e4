"""Two hands at once: each in its slot, neither taken for the other."""

import numpy as np
import pytest
from helpers.tracking import Scene, configuration, sample

from toftrack.api import build_hands_tracker
from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate
from toftrack.tracking.tracker import HandsTracker


def beside_its_mirror(scene: Scene, shift_px: int) -> Scene:
    """A right hand's recording and its mirror image, moved so far to the right as by a shear along
    the depth; joints_m is (2, T, 21, 3), the right hand's first.
    """
    other = scene.mirrored()
    joints, moved = other.joints_m.copy(), np.zeros_like(other.depth_m)
    columns = round(scene.k[0, 2] - other.k[0, 2]) + shift_px
    moved[:, :, columns:] = other.depth_m[:, :, :-columns]
    joints[..., 0] += (other.k[0, 2] - scene.k[0, 2] + columns) / scene.k[0, 0] * joints[..., 2]
    nearer = (scene.depth_m > 0) & ((moved == 0) | (scene.depth_m < moved))
    merged = np.where(nearer, scene.depth_m, moved).astype(np.float32)
    return Scene(merged, scene.k, np.stack((scene.joints_m, joints)))


SMALL = ("filter.particles=80",)
ROWS = range(14, 34)
"""Frames of the sample with the hand to the left of the image's middle."""


def tracker_of(*overrides: str) -> HandsTracker:
    return build_hands_tracker(configuration(*SMALL, *overrides))


def errors_mm(reported: list[tuple[Estimate, ...]], scene: Scene) -> np.ndarray:
    """(T, 2) errors of the right hand and of the left one, in whichever slot; NaN where lost."""
    errors = np.full((len(reported), 2), np.nan)
    for t, estimates in enumerate(reported):
        for estimate in estimates:
            hand = ("right", "left").index(estimate.side) if estimate.side else 0
            if not estimate.lost:
                off = np.linalg.norm(estimate.joints_m - scene.joints_m[hand, t], axis=1)
                errors[t, hand] = 1e3 * off.mean()
    return errors


@pytest.fixture(scope="module")
def apart() -> Scene:
    return beside_its_mirror(sample().cut(*ROWS), 30)


@pytest.fixture(scope="module")
def found(apart: Scene) -> list[tuple[Estimate, ...]]:
    tracker = tracker_of("hands=2")
    return [tracker.step(depth, apart.k, i, i / 25) for i, depth in enumerate(apart.depth_m)]


def test_both_hands_are_followed(apart: Scene, found: list[tuple[Estimate, ...]]) -> None:
    late = errors_mm(found, apart)[8:]
    assert np.isfinite(late).mean(0).min() > 0.8, "neither is lost"
    assert np.nanmedian(late) < 15.0
    assert sorted(estimate.side for estimate in found[-1]) == ["left", "right"]


def test_a_hand_keeps_its_slot(apart: Scene, found: list[tuple[Estimate, ...]]) -> None:
    places = np.array([[e.joints_m[0, 0] for e in estimates] for estimates in found[4:]])
    order = np.sign(places[:, 0] - places[:, 1])
    assert len(set(order[np.isfinite(order)])) == 1


def test_one_hand_is_not_seen_twice() -> None:
    tracker, scene = tracker_of("hands=2"), sample()
    reported = [tracker.step(scene.depth_m[i], scene.k, i, i / 25) for i in range(0, 60, 3)]
    assert all(second.lost and second.side == "" for _, second in reported)
    assert all(np.isfinite(first.joints_m).all() for first, _ in reported)


def test_a_given_side_is_that_of_the_first_slot_and_the_other_one_is_of_the_other(
    apart: Scene,
) -> None:
    tracker = tracker_of("hands=2", "hand.side=left")
    for i in range(10):
        first, second = tracker.step(apart.depth_m[i], apart.k, i, i / 25)
        assert first.side in ("left", "") and second.side in ("right", "")
    assert first.side == "left" and second.side == "right"
    assert first.joints_m[0, 0] > second.joints_m[0, 0], "each on its own hand"
    tracker.restart("right")
    assert tracker.state.tracks == () and tracker.state.next_index == 10
    assert [(slot.side, slot.track) for slot in tracker.states] == [("right", -1), ("left", -1)]


def test_other_numbers_of_hands_and_two_without_networks_are_refused() -> None:
    for hands in (0, 9, 1.5):
        with pytest.raises(ToftrackError, match="hands"):
            HandsTracker(tracker_of().model, 0, hands)  # type: ignore[arg-type]
    with pytest.raises(ToftrackError, match="hands=2 .*leave experiment=paper out"):
        tracker_of("hands=2", "experiment=paper")


def test_the_other_hand_is_not_taken_for_one_that_has_left(apart: Scene) -> None:
    tracker, mine = tracker_of("hand.side=right"), sample().cut(*ROWS).depth_m
    alone = np.where(apart.depth_m == mine, np.float32(1.5), apart.depth_m)
    depths = [*apart.depth_m[:8], *alone[8:]]
    found = [tracker.step(depth, apart.k, i, i / 25)[0] for i, depth in enumerate(depths)]
    off = [
        np.linalg.norm(found[i].joints_m - apart.joints_m[0, i], axis=1).mean() for i in range(8)
    ]
    assert not any(one.lost for one in found[3:8]) and max(off[3:8]) < 0.03
    assert all(one.lost for one in found[12:])
