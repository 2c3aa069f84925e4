"""What is measured beside usable and silently wrong frames: cases done by hand."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation.measures import (
    FLAG_COUNTS,
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
    joints = truth(4).joints_m
    return joints, np.full(joints.shape, 0.01), np.zeros((4, 21), bool)


def truth_beside(joints: np.ndarray, hidden: np.ndarray | None, seen: int = 4) -> Truth:
    shown, visible = None if hidden is None else ~hidden, np.arange(4) < seen
    return truth(4, joints_m=joints + (0.01, 0, 0), visible=visible, joint_visible=shown)


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
    joints, sigma, hidden = regions()
    sigma[0], joints[1] = np.nan, np.nan
    found = coverage(joints, sigma, truth_beside(joints, None))
    assert list(found.values()) == [100.0, None, 50.0]
    nobody = coverage(joints, sigma, truth_beside(joints, hidden, seen=0))
    assert set(nobody.values()) == {None}


def test_the_errors_of_a_run_are_those_reckoned_by_hand() -> None:
    """10 mm off along x; in frame 7 the index fingertip, which nobody sees, by 90 mm more."""
    frame = np.arange(60)
    fraction = np.ones(60)
    fraction[[20, 21, 22, 40, 45, 46, 47, 48]] = 0.5, 0.8, 0.95, 0.8, 0.5, 0.6, 0.8, 0.9
    away, strange = (frame >= 10) & (frame < 20), (frame >= 30) & (frame < 33)
    fraction[away] = 0
    unseen = np.ones((60, 21), bool)
    unseen[:, 8] = False
    true = truth(
        60, visible=~away, in_space=~strange, visible_fraction=fraction, joint_visible=unseen
    )
    joints = true.joints_m + (0.01, 0, 0)
    joints[3] += 1  # the first five frames do not count
    joints[6, 5, 2] = np.inf
    joints[7, 8, 0] += 0.09
    found = evaluate(joints, (frame > 10) & (frame < 22) | np.isin(frame, (2, 50)), true)
    assert found.pop("reacquisition") == [
        {"event": "return", "frame": 20, "delay": 2},
        {"event": "entered", "frame": 22, "delay": 0},
        {"event": "in_space", "frame": 33, "delay": 0},
        {"event": "unoccluded", "frame": 48, "delay": 3},  # not two frames before a lost one
    ]
    assert found == pytest.approx(
        {
            "frames": 5 + 10 + 27,
            "missing_pct": 100 / 42,
            "mean_mm": 10 + 90 / 21 / 41,
            "median_mm": 10,
            "p90_mm": 10,
            "fingertip_mm": 10 + 90 / 5 / 41,
            "wrist_aligned_mm": 90 / 20 / 41,
            "visible_joints_mm": 10,
            "frames_max_below_40mm_pct": 100 * 40 / 42,
            "mean_not_lost_mm": 10 + 90 / 21 / 38,
            "lost_precision": 4 / 5,  # but for three frames on either side of a change
            "lost_recall": 1,
            "lost_precision_strict": 9 / 12,
            "lost_recall_strict": 9 / 10,
        }
    )


def test_what_goes_again_first_has_no_delay_and_what_does_not_count_no_error() -> None:
    visible = np.array([True, False, True, True, False, False, True, True])
    true = truth(8, visible=visible, visible_fraction=np.array([1, 0, 0.8, 0.8, 0, 0, 0.8, 0.8]))
    found = evaluate(true.joints_m, np.arange(8) < 6, true)
    assert found["reacquisition"] == [
        {"event": "return", "frame": 2, "delay": None},
        {"event": "return", "frame": 6, "delay": 0},  # as long as there are frames
    ]
    none = evaluate(true.joints_m[:4], visible[:4], true[:4])
    assert (none["frames"], none["missing_pct"], none["frames_max_below_40mm_pct"]) == (0, 0, 0)
    assert none["mean_mm"] is none["p90_mm"] is none["lost_precision"] is None
