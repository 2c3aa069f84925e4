"""What is said when most of a run was lost."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from toftrack.frames.estimate import no_estimate
from toftrack.output.advice import RunFacts, Watch, advice, lost_frame, tracked_frame

REACH_M = 1.05
LOST = no_estimate(0, 0.0, "searching", 4, 0.01)


def insight(hand_px: int = 900, other_side: bool = False) -> Any:
    """What the tracker saw, as far as anybody asks."""
    observation = SimpleNamespace(hand=np.ones(hand_px))
    features = SimpleNamespace(other_side=2.0 if other_side else 0.0)
    return SimpleNamespace(observation=observation, detection=None, features=features)


def facts(
    nearest_m: float = 0.5, farthest_m: float = 2.0, lost: int = 60, tracked: int = 40, **seen: Any
) -> RunFacts:
    """Of a run whose lost frames saw something between two distances."""
    whole, depth = RunFacts(), np.linspace(nearest_m, farthest_m, 40)[:, None].repeat(30, 1)
    for _ in range(lost):
        whole.add(lost_frame(LOST, depth, insight(**seen), REACH_M))
    for _ in range(tracked):
        whole.add(tracked_frame(None))
    return whole


def test_nothing_is_said_of_runs_that_went_well() -> None:
    assert advice(RunFacts(), "right", REACH_M) == ()
    assert advice(facts(lost=50, tracked=50), "right", REACH_M) == ()


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({"nearest_m": 0.0, "farthest_m": 0.0}, "the lens"),
        ({"nearest_m": 0.0005, "farthest_m": 0.002}, "in metres"),
        ({"nearest_m": 1.5}, "hold the hand nearer"),
        ({"nearest_m": 0.15}, "keep the hand 0.3 to 1 m away"),
        ({"other_side": True}, "give hand.side=left"),
        ({"hand_px": 40}, "fewer than 150 pixels"),
        ({"lost": 1, "tracked": 0}, "lost.believe_frames=1"),
        ({}, "must be a right hand (hand.side), upright and not mirrored"),
    ],
)
def test_each_cause_has_its_remedy(changes: dict, remedy: str) -> None:
    whole = facts(**changes)
    seen, first, *more = advice(whole, "right", REACH_M)
    assert remedy in first and not more
    assert seen.startswith("{lost} of {frames} frames".format(**whole.counts))


def test_a_hand_of_the_other_side_that_is_followed_is_reported() -> None:
    followed = RunFacts()
    for i in range(10):
        followed.add(tracked_frame(insight(other_side=i < 6)))
    (reported,) = advice(followed, "left", REACH_M)
    assert "In 6 of 10 frames" in reported and "give hand.side=right" in reported
    for _ in range(2):
        followed.add(tracked_frame(insight()))
    assert advice(followed, "left", REACH_M) == ()


def test_a_frames_facts_are_read_off_its_image() -> None:
    depth = np.zeros((240, 320), np.float32)
    depth[:, 80:] = np.linspace(0.5, 2.5, 240, dtype=np.float32)
    depth[0, 0] = np.nan
    seen = lost_frame(LOST, depth, None, REACH_M)
    assert seen.read == pytest.approx(0.75, abs=0.02)
    assert (seen.nearest_m, seen.farthest_m) == pytest.approx((0.54, 2.46), abs=0.02)
    assert not any(seen.counts[name] for name in ("out_of_reach", "with_hand", "judged"))
    assert lost_frame(LOST, depth, None, 0.4).counts["out_of_reach"]
    watch = Watch(REACH_M)
    watch.see((LOST,), np.zeros_like(depth), (None,))
    watch.see((replace(LOST, lost=False),), depth, (None,))
    assert watch.facts[0].counts["lost"] == 1 and watch.advice("right") == ()
    watch.see((LOST,), np.zeros_like(depth), (None,))
    assert "0 % of the pixels had readings." in watch.advice("right")[0]


def test_advice_to_who_watches_is_of_what_is_recent() -> None:
    nothing = np.zeros((6, 8), np.float32)
    watch = Watch(REACH_M)
    for count in range(1, 61):
        watch.see((LOST,), nothing, (None,))
        assert bool(watch.advice(None, recent=True)) == (count >= 20), "not of the first frames"
    for _ in range(60):
        assert watch.advice(None, recent=True)[0].startswith("60 of 60 frames were lost")
        watch.see((replace(LOST, lost=False),), nothing, (None,))
    assert watch.advice(None, recent=True) == ()
    assert watch.facts[0].counts["lost"] == 60, "the run's are all"


def test_a_slot_counts_only_where_it_had_a_hand() -> None:
    depth = np.full((30, 40), 0.5, np.float32)
    tracked = replace(LOST, lost=False, state=np.zeros(27, np.float32))
    watch = Watch(1.2, slots=2)
    nothing = (None, None)
    for _ in range(4):
        watch.see((tracked, LOST), depth, nothing)
    assert watch.advice(None) == () and watch.facts[1].counts["frames"] == 0
    for _ in range(6):
        watch.see((LOST, LOST), depth, nothing)
        watch.see((tracked, replace(tracked, lost=True)), depth, nothing)
    assert [watch.facts[0].counts[name] for name in ("lost", "frames")] == [6, 16]
    reported = watch.advice(None)
    assert reported and all(sentence.startswith("Slot 1: ") for sentence in reported)
    assert not any("hand.side" in sentence for sentence in reported)


def test_where_no_hand_is_only_the_first_slot_lost_one() -> None:
    watch = Watch(REACH_M, slots=2)
    watch.see((LOST, LOST), np.zeros((30, 40), np.float32), (None, None))
    assert [one.counts["lost"] for one in watch.facts] == [1, 0]
