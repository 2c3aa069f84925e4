"""Quality follows the time that frames take under a budget, and never changes without one."""

import itertools
import math
from collections.abc import Callable, Iterable
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.tracking import configuration, make_tracker, sample

from toftrack.api import build_hands_tracker
from toftrack.compute import quality
from toftrack.compute.quality import LEVELS, REDUCED, Pace, Timekeeper, pace_within
from toftrack.compute.threads import at_most, threads
from toftrack.errors import ToftrackError
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking.tracker import Tracker

BUDGET_S = 0.033
EVERYTHING = len(LEVELS) - 1


def levels(pace: Pace, took_s: Iterable[float]) -> list[int]:
    """The level after each frame."""
    found = []
    for seconds in took_s:
        pace = pace.after(seconds)
        found.append(pace.level)
    return found


@pytest.fixture
def set_clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], float]], None]:
    """Give Timekeepers another clock."""
    return lambda clock: monkeypatch.setattr(quality, "time", SimpleNamespace(perf_counter=clock))


def slow(step_s: float) -> Callable[[], float]:
    """A clock that goes on by so much each time that it is asked."""
    return itertools.count(100.0, step_s).__next__


def test_quality_falls_while_frames_are_late_and_rises_when_they_are_not() -> None:
    found = levels(Pace(BUDGET_S), [0.05] * 40)
    assert found[0] == 0 and found[-1] == EVERYTHING
    assert found == sorted(found)
    back = levels(Pace(BUDGET_S, level=EVERYTHING), [0.01] * 400)
    assert back[-1] == 0 and back == sorted(back, reverse=True)


def test_what_is_far_too_slow_passes_over_a_level() -> None:
    assert 1 not in levels(Pace(BUDGET_S), [0.2] * 40)


@pytest.mark.parametrize(
    ("pace", "took_s"),
    [
        *((Pace(BUDGET_S, level), [0.8 * BUDGET_S] * 200) for level in range(len(LEVELS))),
        (Pace(BUDGET_S), [0.6 * BUDGET_S] * 20 + [1.0] + [0.6 * BUDGET_S] * 20),
        (Pace(), [0.001, 5.0, 60.0] * 20),
    ],
    ids=[*(f"level {level} fits" for level in range(len(LEVELS))), "one late", "no budget"],
)
def test_what_fits_changes_nothing(pace: Pace, took_s: list[float]) -> None:
    assert set(levels(pace, took_s)) == {pace.level}


def test_what_was_too_much_is_tried_ever_later() -> None:
    """On a machine on which only the least quality fits."""
    pace, tried = Pace(BUDGET_S, EVERYTHING), []
    for number in range(1500):
        level = pace.level
        pace = pace.after(0.01 if level == EVERYTHING else 0.06)
        if pace.level < level:
            tried.append(number)
    pauses = np.diff(tried)
    assert len(pauses) > 2 and (pauses[1:] > 1.5 * pauses[:-1]).all()


@pytest.mark.parametrize("budget_ms", [0, -3, "fast", math.nan])
def test_a_budget_that_is_none_is_refused(budget_ms: object) -> None:
    with pytest.raises(ToftrackError, match=r"tracker\.budget_ms=.* is not possible"):
        pace_within(budget_ms)  # type: ignore[arg-type]


def test_what_is_done_after_the_step_counts_and_waiting_does_not(set_clock) -> None:
    now = [0.0]
    set_clock(lambda: now[0])
    time = Timekeeper(Pace(BUDGET_S))
    for _ in range(30):
        time.begin()
        now[0] += 0.02
        assert time.took_s() == pytest.approx(0.02)
        now[0] += 0.03  # a picture is drawn
        assert time.took_s() == pytest.approx(0.05)
        now[0] += 10.0  # the next frame is waited for
    assert time.pace.level == EVERYTHING
    assert 0 < time.reduced < 30


def test_a_frame_is_timed_from_when_its_raw_image_was_there(set_clock) -> None:
    set_clock(lambda: 50.0)
    time = Timekeeper(Pace())
    time.begin(began_s=49.5)
    assert time.took_s() == pytest.approx(0.5)


def test_each_level_leaves_out_more() -> None:
    model = make_tracker("hand.side=right").model
    for level in LEVELS[:REDUCED]:
        assert model.at_quality(level) is model
    before = model
    for level in LEVELS[REDUCED:]:
        less = model.at_quality(level)
        assert less.detector.settings.every > before.detector.settings.every
        assert less.detector.settings.search > before.detector.settings.search
        assert less.filter == model.filter
        assert less.hand("right", first_shape()) is model.hand("right", first_shape())
        before = less
    rarely = make_tracker("hand.side=right", "detector.every=9").model
    assert all(rarely.at_quality(level).detector.settings.every == 9 for level in LEVELS)


def test_less_quality_may_be_one_thread() -> None:
    many = threads()
    with at_most(1):
        assert threads() == 1
    with at_most(None):
        assert threads() == many


def test_a_recording_is_tracked_alike_however_slow_the_machine_is(set_clock) -> None:
    scene, found = sample(), []
    for step_s in (0.001, 3.0):
        usual = make_tracker("hand.side=right")
        set_clock(slow(step_s))
        tracker = Tracker(usual.model)
        estimates = [tracker.step(scene.depth_m[i], scene.k, i, i / 25) for i in range(5)]
        assert tracker.time.reduced == 0
        assert estimates[-1].compute_s >= step_s
        found.append(np.stack([estimate.joints_m for estimate in estimates]))
    assert np.array_equal(*found)


@pytest.mark.parametrize("hands", [1, 2])
def test_a_slow_machine_still_tracks_with_less_quality(hands: int, set_clock) -> None:
    usual = build_hands_tracker(configuration(f"hands={hands}", "tracker.budget_ms=33"))
    set_clock(slow(0.06))
    scene = sample()
    for i in range(12):
        first, *_ = usual.step(scene.depth_m[i], scene.k, i, i / 25)
    assert usual.time.pace.reduced and usual.time.reduced > 0
    error_mm = 1e3 * np.linalg.norm(first.joints_m - scene.joints_m[11], axis=1).mean()
    assert not first.lost and error_mm < 20


def test_preparing_changes_nothing() -> None:
    scene, found = sample(), []
    for prepared in (False, True):
        tracker = build_hands_tracker(configuration())
        if prepared:
            before = tracker.state
            tracker.prepare()
            assert tracker.state is before and tracker.infos == (None,)
        found.append(tracker.step(scene.depth_m[0], scene.k, 0, 0.0)[0].joints_m)
    assert np.array_equal(*found)
