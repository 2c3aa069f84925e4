"""Results of two hands: a line a frame, an axis of slots, and what is said of each."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate, no_estimate
from toftrack.evaluation.metrics import evaluate
from toftrack.evaluation.trust import judged, trust
from toftrack.frames import Truth
from toftrack.hand.shape import default_hand_shape
from toftrack.output.advice import Watch
from toftrack.output.lines import FRAME_FIELDS, HAND_FIELDS, LINE_FIELDS, json_line
from toftrack.output.results import ResultWriter, read_results
from toftrack.output.smoothing import OneEuro, smooth
from toftrack.output.summary import metrics_table
from toftrack.programs.recover import recover

NAMES = tuple(f"joint_{i}" for i in range(21))
FRAMES = 12
TWO = {"config": {"hands": 2}}


def vacant(index: int) -> Estimate:
    return no_estimate(index, index / 25, "searching", 4, 0.01)


def hand(index: int, slot: int, **changes: Any) -> Estimate:
    rng = np.random.default_rng([index, slot])
    return replace(
        vacant(index),
        state_name="tracking",
        lost=False,
        joints_m=rng.normal(size=(21, 3)).astype(np.float32),
        state=rng.normal(size=27).astype(np.float32),
        latent=rng.normal(size=4).astype(np.float32),
        covariance=rng.normal(size=(10, 10)).astype(np.float32),
        joint_sigma_m=np.full((21, 3), 0.01, np.float32),
        score=0.5 + slot / 4,
        confidence=0.9,
        side=("left", "right")[slot],
        side_probability=0.75,
        gesture=("palm", "fist")[slot],
        **changes,
    )


def frames() -> list[tuple[Estimate, Estimate]]:
    """Both hands; the second one is not there in frames 0 to 2, and doubted in frame 5."""
    return [
        (hand(i, 0), vacant(i) if i < 3 else replace(hand(i, 1), lost=i == 5))
        for i in range(FRAMES)
    ]


def truth() -> Truth:
    """Both hands 10 mm off in each coordinate, the second one's visible from frame 3 on."""
    there, yes = np.arange(FRAMES) >= 3, np.ones(FRAMES, bool)
    joints = [np.stack([hand(i, slot).joints_m + 0.01 for i in range(FRAMES)]) for slot in (0, 1)]
    return Truth(joints[1], there, yes, other=Truth(joints[0], yes, yes))


def write(
    folder: Path, estimates: list[tuple[Estimate, ...]], known: Truth | None = None
) -> dict[str, Any]:
    with ResultWriter(folder, TWO, NAMES, known) as writer:
        for both in estimates:
            writer.append(both)
    assert writer.summary is not None
    return writer.summary


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "track.jsonl").read_text().splitlines()]


def test_a_line_lists_the_hands_that_are_there_each_with_slot_and_side(tmp_path: Path) -> None:
    write(tmp_path, frames())
    lines = lines_of(tmp_path)
    assert all(tuple(line) == ("index", "timestamp_s", "compute_s", "hands") for line in lines)
    assert set(FRAME_FIELDS) | set(HAND_FIELDS) == set(LINE_FIELDS)
    sides = [[(one["slot"], one["side"]) for one in line["hands"]] for line in lines]
    assert sides[0] == [(0, "left")] and sides[3] == [(0, "left"), (1, "right")]
    assert set(lines[3]["hands"][1]) == {"slot", *HAND_FIELDS}
    assert lines[5]["hands"][1]["lost"] is True, "a doubted hand is listed"
    assert json.loads(json_line((vacant(7), vacant(7))))["hands"] == []
    some = json.loads(json_line((vacant(3), hand(3, 1)), ("index", "lost", "gesture")))
    reported = {"slot": 1, "side": "right", "lost": False, "gesture": "fist"}
    assert some == {"index": 3, "hands": [reported]}


def test_arrays_have_an_axis_of_slots_and_nothing_where_there_is_no_hand(tmp_path: Path) -> None:
    done = frames()
    write(tmp_path, done)
    content = read_results(tmp_path / "track.npz")
    for name in FRAME_FIELDS:
        assert content[name].shape == (FRAMES,), name
    for name in HAND_FIELDS:
        assert content[name].shape[:2] == (FRAMES, 2), name
        for row, slot in ((0, 0), (5, 1), (11, 1)):
            one = np.asarray(getattr(done[row][slot], name), content[name].dtype)
            np.testing.assert_array_equal(content[name][row, slot], one, name)
        empty = content[name][0, 1]
        if empty.dtype.kind == "f":
            assert np.isnan(empty).all(), name
        elif empty.dtype.kind == "U":
            assert empty == "", name
    assert content["joints_m"].shape == (FRAMES, 2, 21, 3)
    assert content["lost"][:3, 1].all() and not content["lost"][:3, 0].any()
    assert not content["pinching"][0, 1]


def test_frames_without_any_hand_are_whole_rows(tmp_path: Path) -> None:
    """Also where no frame has one: the shapes are as ever."""
    write(tmp_path / "never", [(vacant(i), vacant(i)) for i in range(3)])
    write(tmp_path / "none", [])
    for name, rows in (("never", 3), ("none", 0)):
        content = read_results(tmp_path / name / "track.npz")
        assert content["covariance"].shape == (rows, 2, 10, 10)
        assert content["lost"].all() and np.isnan(content["score"]).all()
    summary = json.loads((tmp_path / "never" / "summary.json").read_text())
    assert (summary["lost_frames"], summary["mean_score"]) == (3, None)
    assert "3, 3 of them lost" in metrics_table(summary)


def test_dropped_frames_repeat_both_hands(tmp_path: Path) -> None:
    write(tmp_path, [both for both in frames() if both[0].index not in (2, 7)])
    content = read_results(tmp_path / "track.npz")
    assert content["metadata"]["held_frames"] == [2, 7]
    assert np.flatnonzero(content["dropped"]).tolist() == [2, 7]
    there = content["state_name"] != ""  # a slot without a hand says nothing
    assert ((content["state_name"] == "dropped") == content["dropped"][:, None] & there).all()
    assert there[2].tolist() == [True, False]
    np.testing.assert_array_equal(content["joints_m"][7], content["joints_m"][6])
    assert content["lost"][2].tolist() == [False, True]


def test_the_summary_speaks_of_each_slot(tmp_path: Path) -> None:
    for slot, name in enumerate(("hand_shape.json", "hand_shape_2.json")):
        default_hand_shape(0.17 + slot / 100).of_side(("left", "right")[slot]).save(tmp_path / name)
    summary = write(tmp_path, frames())
    assert (summary["frames"], summary["lost_frames"]) == (FRAMES, 0)
    first, second = summary["slots"]
    assert (first["frames"], second["frames"]) == (FRAMES, FRAMES - 3)
    assert (first["lost_frames"], second["lost_frames"]) == (0, 1)
    assert (first["mean_score"], second["mean_score"]) == pytest.approx((0.5, 0.75))
    assert [one["hand"]["side"] for one in (first, second)] == ["left", "right"]
    assert second["hand"]["length_mm"] == pytest.approx(180)
    assert "slot 1" in metrics_table(summary)


def test_each_true_hand_is_measured_in_the_slot_that_followed_it(tmp_path: Path) -> None:
    known = truth()
    metrics = write(tmp_path, frames(), known)["metrics"]
    content = read_results(tmp_path / "track.npz")
    assert (metrics["slot"], metrics["second"]["slot"]) == (1, 0)
    for found, one in ((metrics, known), (metrics["second"], known.other)):
        assert one is not None
        joints, lost = content["joints_m"][:, found["slot"]], content["lost"][:, found["slot"]]
        assert found["trust"] == asdict(trust(judged(joints, lost, one)))
        figures = evaluate(joints, lost, one)
        assert {name: found[name] for name in figures} == figures
        assert found["coverage"]["in_region_90_pct"] == 100
    assert metrics["trust"]["usable_pct"] == pytest.approx(100 * 8 / 9)
    table = metrics_table(json.loads((tmp_path / "summary.json").read_text()))
    assert "the other hand" in table and table.count("usable") == 2


def test_a_second_hand_that_nobody_has_is_reported(tmp_path: Path) -> None:
    summary = write(tmp_path, frames(), replace(truth(), other=None))
    assert summary["metrics"]["slot"] == 1 and "second" not in summary["metrics"]
    assert summary["metrics"]["ghost_pct"] == 100
    assert "another hand, where is none" in metrics_table(summary)


def test_a_slot_that_there_is_not_is_a_damaged_line(tmp_path: Path) -> None:
    write(tmp_path, frames())
    path = tmp_path / "track.jsonl"
    path.write_text(path.read_text().replace('"slot":1', '"slot":7'))
    with pytest.raises(ToftrackError, match="not a line of a run"):
        recover(tmp_path)


def test_a_slot_that_becomes_vacant_is_smoothed_anew() -> None:
    settings = OneEuro(1.0, 0.0, 0.0, 0.0, 1.0, results=False)
    shape, state, moved = default_hand_shape(), None, []
    steps = [hand(0, 0), hand(1, 0), vacant(2), hand(3, 0)]
    for one in steps:
        state, calm = smooth(settings, state, one, shape)
        moved.append(not np.array_equal(calm.state, one.state, equal_nan=True))
    assert moved == [False, True, False, False]


def test_advice_counts_a_slot_only_where_it_had_a_hand() -> None:
    depth = np.full((30, 40), 0.5, np.float32)
    watch = Watch(1.2, slots=2)
    nothing = (None, None)
    for i in range(4):
        watch.see((hand(i, 0), vacant(i)), depth, nothing)
    assert watch.advice(None) == () and watch.facts[1].counts["frames"] == 0
    for i in range(6):
        watch.see((vacant(i), vacant(i)), depth, nothing)
        watch.see((hand(i, 0), replace(hand(i, 1), lost=True)), depth, nothing)
    assert [watch.facts[0].counts[name] for name in ("lost", "frames")] == [6, 16]
    reported = watch.advice(None)
    assert reported and all(sentence.startswith("Slot 1: ") for sentence in reported)
    assert not any("hand.side" in sentence for sentence in reported)
