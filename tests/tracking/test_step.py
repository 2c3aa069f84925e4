"""The step as a function of a state: replayed, interleaved, forgotten, and at other frame rates."""

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.tracking import Scene, errors_mm, make_tracker, sample

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate
from toftrack.tracking.tracker import Tracker

SMALL = ("filter.particles=80",)


def quick(*overrides: str) -> Tracker:
    return make_tracker(*SMALL, *overrides)


def tracked(
    tracker: Tracker, scene: Scene, rows: range, fps: float = 25.0, begin_s: float = 0.0
) -> list[Estimate]:
    """Frames of the recording, timed as by a camera of some rate."""
    return [tracker.step(scene.depth_m[i], scene.k, i, begin_s + i / fps) for i in rows]


def equal(one: object, two: object) -> bool:
    """Parts of a state, or estimates, to the last bit."""
    if isinstance(one, torch.Tensor | np.ndarray):
        one, two = np.asarray(one), np.asarray(two)
        return np.array_equal(one, two, equal_nan=one.dtype.names is None)
    if isinstance(one, tuple) and isinstance(two, tuple):
        return len(one) == len(two) and all(map(equal, one, two))
    if is_dataclass(one):
        names = [field.name for field in fields(one)]
        return all(equal(getattr(one, name), getattr(two, name)) for name in names)
    return one == two or (one != one and two != two)


def same(one: Estimate, two: Estimate) -> bool:
    """In everything but the time that it took."""
    return equal(one, replace(two, compute_s=one.compute_s))


def test_a_number_and_a_time_that_are_none_are_refused() -> None:
    tracker, scene = quick(), sample()
    given: list[tuple[Any, Any]] = [(index, 0.0) for index in ("a", math.nan, -1, 2.5)]
    given += [(0, time_s) for time_s in ("soon", 1j, [0.1], 10**400, math.nan, -math.inf)]
    for index, timestamp_s in given:
        with pytest.raises(ToftrackError, match="a whole number from 0 on and finite seconds"):
            tracker.step(scene.depth_m[0], scene.k, index, timestamp_s)


@pytest.mark.parametrize("kept", [0, 5])
@pytest.mark.parametrize("experiment", [(), ("experiment=paper",)], ids=["default", "paper"])
def test_a_recording_replayed_from_a_saved_state_gives_the_same_estimates(
    kept: int, experiment: tuple[str, ...]
) -> None:
    """Before the start, and after it."""
    tracker, scene = quick(*experiment), sample()
    tracked(tracker, scene, range(kept))
    state = tracker.state
    first = tracked(tracker, scene, range(kept, kept + 4))
    assert tracker.state is not state
    tracker.state = state
    again = tracked(tracker, scene, range(kept, kept + 4))
    assert all(map(same, first, again))
    other = quick(*experiment, "seed=5")
    other.state = state
    assert all(map(same, first, tracked(other, scene, range(kept, kept + 4))))


def test_the_number_of_threads_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The networks look beside the filter where there is another thread, and after it if not."""
    found = []
    for count in (1, 2):
        monkeypatch.setattr("toftrack.compute.threads.threads", lambda count=count: count)
        found.append(tracked(quick("hand.side=right"), sample(), range(8)))
    assert all(same(one, two) for one, two in zip(*found, strict=True))


def test_a_restart_forgets_all_but_the_random_numbers_and_the_count_of_frames() -> None:
    tracker, scene = quick(), sample()
    fresh = tracker.state
    tracked(tracker, scene, range(9))
    before = tracker.state
    slot = before.slots[0]
    assert before.track_of(slot) is not None and slot.away_s == 0 and slot.gesture is not None
    assert slot.shape.frames > 0 and np.isfinite(slot.last.joints_m).all()
    tracker.restart()
    after = tracker.state
    assert equal(replace(after, generator=fresh.generator, next_index=0), fresh)
    assert torch.equal(after.generator, before.generator) and after.next_index == 9
    assert tracker.hands.insights[0] is None
    empty = tracker.step(np.zeros_like(scene.depth_m[0]), scene.k)
    assert empty.index == 9 and np.isnan(empty.joints_m).all() and empty.gesture == ""


@pytest.mark.parametrize(
    ("every", "fps"), [(2, 25.0), (5, 25.0), (1, 50.0), (1, 12.5)], ids=lambda value: f"{value:g}"
)
def test_the_hand_is_followed_at_other_rates(every: int, fps: float) -> None:
    """Frames dropped, and the same movement twice as fast and half as fast."""
    scene = sample().cut(*range(0, 36, every))
    tracker = quick()
    found = tracked(tracker, scene, range(len(scene)), fps / every)
    assert not any(estimate.lost for estimate in found)
    assert errors_mm(found, scene)[4:].mean() < 12


def test_a_hand_that_has_gone_elsewhere_between_two_rare_frames_is_found() -> None:
    """At 5 frames a second, in either direction, and without a flag."""
    depth, scene, tracker = sample().depth_m, sample(), quick()
    aside = np.roll(depth, 60, axis=2)
    images = [depth[0], depth[1], aside[2], depth[3]]
    found = [tracker.step(image, scene.k, i, i / 5) for i, image in enumerate(images)]
    assert not any(estimate.lost for estimate in found)
    wrist_m = np.array([estimate.joints_m[0, 0] for estimate in found])
    moved_m = 60 / scene.k[0, 0] * found[2].joints_m[0, 2]
    assert np.allclose(wrist_m - wrist_m[0], [0, 0, moved_m, 0], atol=0.03), wrist_m


def test_a_movement_at_another_rate_has_the_same_speed() -> None:
    """Of the same hand, seen by a camera that takes half of the frames."""
    speeds = []
    for every in (1, 2):
        tracker = quick()
        for i in range(0, 25, every):
            tracked(tracker, sample(), range(i, i + 1))
        speeds.append(tracker.track.velocity[:3])
    assert float((speeds[0] - speeds[1]).norm()) < 0.05, speeds


@pytest.mark.parametrize("jump_s", [-100.0, 1e6])
def test_a_clock_that_jumps_does_not_lose_the_hand(jump_s: float) -> None:
    tracker, scene = quick(), sample()
    tracked(tracker, scene, range(8))
    found = tracked(tracker, scene, range(8, 12), begin_s=jump_s)
    assert not any(estimate.lost for estimate in found)
    assert errors_mm(found, scene.cut(*range(8, 12)))[-1] < 15
    assert tracker.track.cloud.particles.isfinite().all()
