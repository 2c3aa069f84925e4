"""What is measured beside usable and silently wrong frames: cases done by hand, and the errors of
summary.json against a second implementation, frame by frame."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation.measures import (
    FLAG_COUNTS,
    POSE_GESTURES,
    Estimates,
    coverage,
    evaluate,
    measured,
)
from toftrack.frames.frame import Truth
from toftrack.recordings.npz import read_recording


def truth(frames: int = 6, **fields: Any) -> Truth:
    """A hand whose joints are 20 mm apart, at rest."""
    joints = np.zeros((frames, 21, 3))
    joints[:, :, 0] = 0.02 * np.arange(21)
    joints[:, :, 2] = 0.5
    yes = np.ones(frames, bool)
    return Truth(**({"joints_m": joints, "visible": yes, "in_space": yes} | fields))


def estimates(true: Truth, **fields: Any) -> Estimates:
    """The truth itself, never lost."""
    lost = np.zeros(len(true), bool)
    return Estimates(**({"joints_m": true.joints_m.copy(), "lost": lost} | fields))


def test_a_fingertip_at_another_finger_is_a_swap_and_one_between_two_is_none() -> None:
    true = truth()
    found = estimates(true, lost=np.array([False] * 5 + [True]))
    found.joints_m[0, 8] = true.joints_m[0, 12]
    found.joints_m[1, 8] = 0.55 * true.joints_m[1, 12] + 0.45 * true.joints_m[1, 8]  # 8 mm nearer
    found.joints_m[2, 8] = np.nan
    found.joints_m[5, 8] = true.joints_m[5, 12]  # is flagged lost
    assert measured(found, true).first.figures["swap_pct"] == pytest.approx(100 / 6)


def test_flags_count_for_visible_fingertips_in_frames_that_are_not_lost() -> None:
    visible = np.ones((6, 21), bool)
    visible[2, 8] = False
    true = truth(joint_visible=visible)
    ok = np.ones((6, 21), bool)
    ok[0, 8] = ok[:2, 12] = ok[:, 7] = False  # 7 is no tip
    found = estimates(true, lost=np.array([False] * 5 + [True]), joint_ok=ok)
    found.joints_m[[0, 1, 2, 5], 8, 1] += 0.05
    figures = measured(found, true).first.figures
    assert [figures[name] for name in FLAG_COUNTS] == [2, 1, 5 * 5 - 3, 2]
    unseen = estimates(truth(), joint_ok=ok)
    assert not set(FLAG_COUNTS) & set(measured(unseen, truth()).first.figures)


def test_jitter_is_the_movement_beyond_the_true_one_while_the_hand_rests() -> None:
    true = truth(still=np.array([False, True, True, True, True, False]))
    true.joints_m[3:, :, 0] += 0.001
    found = estimates(true)
    found.joints_m[:, :, 1] += np.array([0.9, 0, 0.002, 0.002, 0, 0.9])[:, None]
    figures = measured(found, true).first.figures
    assert figures["jitter_mm"] == pytest.approx((2 + 0 + 2) / 3)
    lost = replace(found, lost=np.array([False, False, True, False, False, False]))
    assert measured(lost, true).first.figures["jitter_mm"] == pytest.approx(2)
    assert measured(estimates(truth()), truth()).first.figures["jitter_mm"] is None


def test_means_over_usable_frames_leave_the_others_out() -> None:
    true = truth()
    found = estimates(true)
    found.joints_m[:3, :, 1] += 0.01
    found.joints_m[0, 4, 1] += 0.05  # usable no more
    figures = measured(found, true).first.figures
    assert figures["usable_mean_mm"] == pytest.approx(10 * 2 / 5)
    assert figures["usable_tip_mm"] == pytest.approx(10 * 2 / 5)
    assert figures["tip_mm"] == pytest.approx((3 * 5 * 10 + 50) / 30)


def test_gestures_count_where_the_pose_has_a_name() -> None:
    poses = np.array(["point", "point", "transition", "hook", "spread", "palm"])
    named = np.array(["pointing", "palm", "palm", "other", "palm", "palm"])
    true = truth(pose_name=poses)
    lost = np.array([False] * 5 + [True])
    figures = measured(estimates(true, gesture=named, lost=lost), true).first.figures
    assert figures["gesture_pct"] == 100 * 3 / 5
    assert {"palm", "fist", "pointing", "other"} <= set(POSE_GESTURES.values())


def test_the_side_counts_at_the_end_after_ten_frames_and_where_it_is_certain() -> None:
    true = truth(20, side="left")
    side = np.array([""] * 4 + ["right"] * 10 + ["left"] * 6)
    sure = np.array([np.nan] * 4 + [0.95, 0.92] + [0.6] * 8 + [0.99] * 6)
    figures = measured(estimates(true, side=side, side_probability=sure), true).first.figures
    assert figures["side_right_end"] is True and figures["side_right_soon"] is True
    assert figures["side_wrong_certain_pct"] == 100 * 2 / 20
    late = np.array([""] * 5 + ["right"] * 15)
    figures = measured(estimates(true, side=late), true).first.figures
    assert figures["side_right_end"] is False and figures["side_right_soon"] is False
    assert "side_right_end" not in measured(estimates(true), true).first.figures  # it was told


def test_of_two_slots_each_hand_has_its_own() -> None:
    other = truth()
    other.joints_m[:, :, 1] += 0.3
    true = replace(truth(), other=other)
    joints = np.stack((other.joints_m, true.joints_m), 1)
    found = measured(Estimates(joints, np.zeros((6, 2), bool)), true)
    assert found.slots == (1, 0) and found.ghost_pct is None and found.second is not None
    assert found.first.trust.usable_pct == found.second.trust.usable_pct == 100
    more = np.concatenate((joints, joints[:, :1]), 1)
    ghost = measured(
        Estimates(more, np.array([[False, False, False]] * 3 + [[False, False, True]] * 3)), true
    )
    assert ghost.slots == (1, 0) and ghost.ghost_pct == 50 and ghost.second is not None
    alone = measured(Estimates(joints, np.zeros((6, 2), bool)), truth())
    assert alone.second is None and alone.ghost_pct == 100


def test_poses_sides_and_rests_are_read_from_a_recording(tmp_path) -> None:
    file = tmp_path / "a.npz"
    arrays = {
        "depth_m": np.full((4, 8, 8), 0.5, np.float32),
        "K": np.array([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]),
        "joints_m": np.full((4, 21, 3), 0.5),
        "joints2_m": np.full((4, 21, 3), 0.6),
        "pose_name": np.array(["palm", "palm", "transition", "fist"]),
    }
    about = {"handedness": "left", "side2": "right", "still": [[1, 2], "odd", [3]]}
    np.savez(file, metadata=json.dumps(about), **arrays)
    found = read_recording(file).truth
    assert found is not None and found.other is not None
    assert (found.side, found.other.side) == ("left", "right")
    assert found.still is not None and found.still.tolist() == [False, True, True, False]
    assert found.pose_name is not None and found[1:].pose_name.tolist()[-1] == "fist"
    np.savez(file, **(arrays | {"pose_name": np.arange(4)}))
    with pytest.raises(ToftrackError, match="'pose_name' must be text"):
        read_recording(file)


def regions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joints that are 10 mm off; standard deviations; which are hidden: 4 frames."""
    joints = np.random.default_rng(0).normal(0, 0.05, (4, 21, 3)) + (0, 0, 0.5)
    return joints, np.full(joints.shape, 0.01), np.zeros((4, 21), bool)


def truth_beside(joints: np.ndarray, hidden: np.ndarray | None, seen: int = 4) -> Truth:
    off = np.zeros_like(joints)
    off[..., 0] = 0.01
    visible = np.arange(4) < seen
    return Truth(joints + off, visible, visible, None, None if hidden is None else ~hidden)


def test_regions_are_counted_in_visible_frames_and_of_hidden_joints() -> None:
    joints, sigma, hidden = regions()
    hidden[:, :3] = True
    sigma[0, 0] = sigma[1, 5] = 0.001
    sigma[3] = 0.001  # the hand is out of view
    found = coverage(joints, sigma, truth_beside(joints, hidden, seen=3))
    assert found["in_region_90_pct"] == pytest.approx(100 * (1 - 2 / 63))
    assert found["hidden_in_region_90_pct"] == pytest.approx(100 * (1 - 1 / 9))
    assert found["without_region_pct"] == 0


def test_joints_without_a_region_are_counted_apart() -> None:
    joints, sigma, _ = regions()
    sigma[0], joints[1] = np.nan, np.nan
    found = coverage(joints, sigma, truth_beside(joints, None))
    assert list(found.values()) == [100.0, None, 50.0]


def test_without_a_visible_hand_there_is_no_figure() -> None:
    joints, sigma, hidden = regions()
    assert set(coverage(joints, sigma, truth_beside(joints, hidden, seen=0)).values()) == {None}


def random_case(seed: int) -> tuple[np.ndarray, np.ndarray, Truth]:
    """Estimates, lost flags and truth with gaps, occlusions, failures and other poses."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(20, 80))

    def blocks(probability: float) -> np.ndarray:
        changes = rng.random(count) < probability
        return (np.cumsum(changes) % 2).astype(bool)

    visible, in_space = ~blocks(0.08), ~blocks(0.05)
    fraction = np.where(visible, rng.choice([0.5, 0.8, 0.95, 1.0], count), 0.0)
    true = Truth(
        joints_m=rng.normal(0, 0.1, (count, 21, 3)) + (0, 0, 0.6),
        visible=visible,
        in_space=in_space,
        visible_fraction=fraction if seed % 3 else None,
        joint_visible=rng.random((count, 21)) < 0.8 if seed % 2 else None,
    )
    size = rng.choice([0.005, 0.02, 0.05], (count, 1, 1))
    joints = true.joints_m + rng.normal(0, 1, (count, 21, 3)) * size / 2
    joints[rng.random(count) < 0.1] = np.nan
    joints[rng.random(count) < 0.03, 5, 2] = np.inf
    lost = (~visible) ^ (rng.random(count) < 0.2)
    return joints, lost, true


def by_loops(joints: np.ndarray, lost: np.ndarray, true: Truth) -> dict[str, Any]:
    """The definitions, spelled out a frame and a joint at a time."""
    count = len(true.joints_m)
    errors: dict[int, list[float]] = {}
    aligned: dict[int, list[float]] = {}
    for t in range(count):
        if not np.isfinite(joints[t]).all():
            continue
        shift = joints[t, 0] - true.joints_m[t, 0]
        errors[t], aligned[t] = [], []
        for j in range(21):
            away = joints[t, j] - true.joints_m[t, j]
            errors[t].append(1000 * math.sqrt(sum(away**2)))
            if j > 0:
                aligned[t].append(1000 * math.sqrt(sum((away - shift) ** 2)))
    present = [bool(true.visible[t] and true.in_space[t]) for t in range(count)]
    used = [t for t in range(5, count) if present[t]]
    there = [t for t in used if t in errors]

    def mean(values: list[float]) -> float | None:
        return sum(values) / len(values) if values else None

    def of(frames: list[int], rows: Any) -> list[float]:
        return [errors[t][j] for t in frames for j in rows]

    def in_view(t: int, j: int) -> bool:
        return true.joint_visible is None or bool(true.joint_visible[t, j])

    every = of(there, range(21))
    result = {
        "frames": len(used),
        "missing_pct": 100 * (len(used) - len(there)) / max(1, len(used)),
        "mean_mm": mean(every),
        "median_mm": float(np.median(every)) if every else None,
        "p90_mm": float(np.percentile(every, 90)) if every else None,
        "fingertip_mm": mean(of(there, (4, 8, 12, 16, 20))),
        "wrist_aligned_mm": mean([e for t in there for e in aligned[t]]),
        "visible_joints_mm": mean(
            [errors[t][j] for t in there for j in range(21) if in_view(t, j)]
        ),
        "frames_max_below_40mm_pct": 100
        * sum(max(errors[t]) < 40 for t in there)
        / max(1, len(used)),
        "mean_not_lost_mm": mean(of([t for t in there if not lost[t]], range(21))),
    }

    def tracked(t: int) -> bool:
        return t in errors and sum(errors[t]) / 21 < 25 and not lost[t]

    def delay(start: int) -> int | None:
        for t in range(start, count):
            if not present[t]:
                return None
            if all(tracked(s) for s in range(t, min(t + 3, count))):
                return t - start
        return None

    fraction = true.visible_fraction
    fraction = true.visible.astype(float) if fraction is None else fraction
    events = []
    for t in range(1, count):
        if true.visible[t] and not true.visible[t - 1]:
            events.append(("return", t))
            first = next((s for s in range(t, count) if fraction[s] >= 0.9), None)
            if first is not None:
                events.append(("entered", first))
        if true.in_space[t] and not true.in_space[t - 1]:
            events.append(("in_space", t))
    since = 0  # first frame after the hand was last in full view
    for t in range(count):
        if fraction[t] >= 0.9:
            before = range(since, t)
            if any(fraction[s] < 0.7 for s in before) and all(true.visible[s] for s in before):
                events.append(("unoccluded", t))
            if any(fraction[s] < 0.7 for s in before):
                since = t + 1
    result["reacquisition"] = sorted((frame, event, delay(frame)) for event, frame in events)
    return result


def lost_by_loops(
    lost: np.ndarray, true: Truth, tolerance: int
) -> tuple[float | None, float | None]:
    count = len(lost)
    absent = [not (true.visible[t] and true.in_space[t]) for t in range(count)]
    hits = flagged = positive = 0
    for t in range(5, count):
        # A change lies between two frames, half a frame from each.
        if any(
            absent[c] != absent[c - 1] and abs(t - (c - 0.5)) <= tolerance for c in range(1, count)
        ):
            continue
        hits += bool(lost[t] and absent[t])
        flagged += bool(lost[t])
        positive += bool(absent[t])
    return hits / flagged if flagged else None, hits / positive if positive else None


@pytest.mark.parametrize("seed", range(15))
def test_agrees_with_a_second_implementation(seed: int) -> None:
    joints, lost, true = random_case(seed)
    found = evaluate(joints, lost, true)
    expected = by_loops(joints, lost, true)
    events = sorted((e["frame"], e["event"], e["delay"]) for e in found.pop("reacquisition"))
    assert events == expected.pop("reacquisition")
    for tolerance, suffix in ((3, ""), (-1, "_strict")):
        pair = lost_by_loops(lost, true, tolerance)
        expected[f"lost_precision{suffix}"], expected[f"lost_recall{suffix}"] = pair
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == (None if value is None else pytest.approx(value, rel=1e-9)), name


def test_flagging_cannot_improve_the_error() -> None:
    true = truth(20)
    joints = true.joints_m.copy()
    joints[10:] += 0.1
    honest = evaluate(joints, np.zeros(20, bool), true)
    flagged = evaluate(joints, np.arange(20) >= 10, true)
    assert flagged["mean_mm"] == honest["mean_mm"]
    assert flagged["frames_max_below_40mm_pct"] == honest["frames_max_below_40mm_pct"]
    assert flagged["mean_not_lost_mm"] == pytest.approx(0)
