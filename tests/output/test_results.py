"""Results: the promised files with the promised content, also for a run that ended early, and of
several hands.
"""

import json
import math
import shutil
import tracemalloc
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hands import hand_estimate

import toftrack
from toftrack.errors import ToftrackError
from toftrack.evaluation.measures import coverage, evaluate
from toftrack.evaluation.trust import judged, trust
from toftrack.files import archives
from toftrack.frames.estimate import Estimate, no_estimate
from toftrack.frames.frame import Truth
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output import records
from toftrack.output.lines import (
    FRAME_FIELDS,
    HAND_FIELDS,
    KINDS,
    LINE_FIELDS,
    json_line,
    read_lines,
)
from toftrack.output.results import ResultWriter, read_results, read_run_facts
from toftrack.output.summary import metrics_table
from toftrack.programs.recover import recover

NAMES = tuple(f"joint_{i}" for i in range(21))


def estimate(index: int, **changes: Any) -> Estimate:
    rng = np.random.default_rng(index)
    usual = {
        "latent": rng.normal(size=4).astype(np.float32),
        "covariance": rng.normal(size=(10, 10)).astype(np.float32),
        "joint_sigma_m": np.full((21, 3), 0.01, np.float32),
        "side": "left",
        "lost": index % 4 == 3,
        "score": 0.5 + index / 100,
        "compute_s": 0.01 * (1 + index),
    }
    return hand_estimate(index, **usual | changes)


def write(
    folder: Path,
    estimates: Sequence[Estimate | tuple[Estimate, ...]],
    truth: Truth | None = None,
    **config: Any,
) -> dict[str, Any]:
    """The summary of a run that did these frames."""
    metadata = {"seed": 1} | ({"config": config} if config else {})
    with ResultWriter(folder, metadata, NAMES, truth) as writer:
        for one in estimates:
            writer.append(one if isinstance(one, tuple) else (one,))
    assert writer.summary is not None
    return writer.summary


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "track.jsonl").read_text().splitlines()]


def truth_of(estimates: list[Estimate], frames: int) -> Truth:
    joints = np.zeros((frames, 21, 3), np.float32)
    for one in estimates:
        joints[one.index] = one.joints_m + np.float32(0.01)
    return Truth(joints, np.ones(frames, bool), np.ones(frames, bool))


def test_track_npz_has_the_promised_keys_shapes_and_types(tmp_path: Path) -> None:
    write(tmp_path, [estimate(i) for i in range(6)])
    promised: dict[tuple[str, tuple[int, ...]], str] = {
        ("f4", (21, 3)): "joints_m joint_sigma_m landmarks",
        ("f4", (21,)): "joint_confidence",
        ("f4", (27,)): "state",
        ("f4", (4,)): "latent",
        ("f4", (10, 10)): "covariance",
        ("f4", (3,)): "pointing_origin_m pointing_direction",
        ("f4", (26, 3)): "openxr_position_m",
        ("f4", (26, 4)): "openxr_orientation",
        ("f4", (26,)): "openxr_radius_m",
        ("f4", ()): "score effective_sample_size gesture_probability pinch confidence outside_rad "
        "side_probability compute_s",
        ("f8", ()): "timestamp_s",
        ("i8", ()): "index",
        ("?", ()): "lost pinching dropped",
        ("?", (21,)): "joint_ok",
        ("U", ()): "gesture state_name side",
    }
    names = {"joint_names", "openxr_joint_names", "angle_names"}
    parents = {"joint_parents", "openxr_joint_parents"}
    with np.load(tmp_path / "track.npz", allow_pickle=False) as archive:
        every = {name for words in promised.values() for name in words.split()}
        assert set(archive.files) == every | names | parents | {"readme", "metadata"}
        for (kind, shape), words in promised.items():
            for name in words.split():
                assert archive[name].shape == (6, *shape), name
                found = archive[name].dtype
                assert found.kind == "U" if kind == "U" else found == np.dtype(kind), name
        assert archive["joint_names"].tolist() == list(NAMES)
        assert json.loads(archive["metadata"].item()) == {"seed": 1}


def test_a_reader_without_this_package_can_draw_the_hand_into_the_image(tmp_path: Path) -> None:
    camera = {"K": [[200.0, 0, 87.5], [0, 210.0, 71.5], [0, 0, 1]], "width": 176, "height": 144}
    with ResultWriter(tmp_path, {"camera": camera}, JOINT_NAMES) as writer:
        writer.append((hand_estimate(3),))
    default_hand_shape().save(tmp_path / "hand_shape.json")
    with np.load(tmp_path / "track.npz", allow_pickle=False) as archive:
        run = dict(archive)
    assert all(word in str(run["readme"]) for word in ("Metres", "x right, y down", "u = K"))
    pairs = zip(run["joint_parents"], run["joint_names"], strict=True)
    bones = [(run["joint_names"][p], n) for p, n in pairs]
    assert ("wrist", "ring_mcp") in bones and ("ring_dip", "ring_tip") in bones
    assert run["openxr_joint_parents"][run["openxr_joint_names"] == "index_tip"] == 9
    x, y, z = run["joints_m"][0].T
    k = run["K"]
    pixels = np.stack((k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]), 1)
    parts = (pixels + 0.5) / run["image_size_px"]
    assert np.allclose(parts[:, 0], run["landmarks"][0, :, 0], atol=1e-5)
    again = toftrack.read_run(tmp_path)
    assert set(again.arrays) == set(run) - {"metadata", "joint_names"}
    assert again.arrays["angle_names"].tolist() == list(toftrack.ANGLE_NAMES)
    assert again.summary["frames"] == len(again) == len(again.timestamp_s) == 1
    assert (again.camera.width, again.camera.height) == (176, 144)
    np.testing.assert_array_equal(again.camera.K, k)
    assert again.estimate(0).index == 3


def test_each_line_is_on_disk_when_its_frame_is_done(tmp_path: Path) -> None:
    writer = ResultWriter(tmp_path, {}, NAMES, None)
    for i in range(3):
        writer.append((estimate(i),))
        lines = (tmp_path / "track.jsonl").read_text().splitlines()
        assert [json.loads(line)["index"] for line in lines] == list(range(i + 1))
    assert not (tmp_path / "track.npz").exists()
    writer.close()


def test_frames_without_estimate_are_null_in_lines_and_nan_in_arrays(tmp_path: Path) -> None:
    write(tmp_path, [no_estimate(0, 0.0, "initialising", 4, 0.01), estimate(1)])

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    text = (tmp_path / "track.jsonl").read_text()
    first, second = (json.loads(line, parse_constant=refuse) for line in text.splitlines())
    assert first["joints_m"][0] == [None] * 3 and first["gesture_probability"] is None
    assert first["lost"] is True and second["joints_m"][0][0] is not None
    content = read_results(tmp_path / "track.npz")
    assert np.isnan(content["joints_m"][0]).all() and np.isfinite(content["joints_m"][1]).all()
    json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)


def test_summary_counts_and_averages(tmp_path: Path) -> None:
    written = write(tmp_path, [estimate(i) for i in range(5)])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary == written and "metrics" not in summary
    assert (summary["frames"], summary["lost_frames"]) == (5, 1)
    figures = [summary[name] for name in ("mean_ms", "median_ms", "fps", "mean_score")]
    assert figures == pytest.approx([30, 30, 100 / 3, 0.52])


def test_summary_has_the_metrics_of_the_frames_done(tmp_path: Path) -> None:
    estimates = [estimate(i) for i in range(12)]
    truth = truth_of(estimates, frames=20)  # the run was interrupted after 12 of 20
    summary = write(tmp_path, estimates, truth)
    joints = np.array([one.joints_m for one in estimates])
    lost = np.array([one.lost for one in estimates])
    now = truth[:12]
    headline = asdict(trust(judged(joints, lost, now)))
    regions = coverage(joints, np.full(joints.shape, 0.01), now)
    expected = {"trust": headline, "coverage": regions} | evaluate(joints, lost, now)
    further = summary["metrics"]["further"]
    assert further["swap_pct"] == 0 and further["tip_mm"] == pytest.approx(10 * math.sqrt(3))
    assert summary["metrics"] == expected | {"further": further}
    assert summary["metrics"]["trust"]["usable_pct"] == 75  # one in four is flagged
    assert summary["metrics"]["mean_mm"] == pytest.approx(10 * math.sqrt(3), rel=1e-4)
    assert "75.0 % of the 12 visible frames" in metrics_table(summary).splitlines()[0]


def test_truth_is_found_by_the_frames_numbers(tmp_path: Path) -> None:
    done = [estimate(i) for i in range(3, 15) if i != 7]  # 0 to 2 were faulty, 7 came too late
    truth = truth_of([estimate(i) for i in range(20)], 20)[1:]
    summary = write(tmp_path, done, truth)
    assert truth.first == 1 and summary["frames"] == 12
    errors = np.full(12, 10 * math.sqrt(3))
    stale = 1e3 * np.linalg.norm(done[3].joints_m - truth.joints_m[6], axis=1).mean()
    assert summary["metrics"]["mean_mm"] == pytest.approx(errors[5:].mean(), rel=1e-3)
    assert summary["metrics"]["trust"]["mean_all_mm"] == pytest.approx(errors.mean(), rel=1e-3)
    asked = write(tmp_path, done, truth, count_dropped=True)
    errors[4] = min(stale, 1e3)
    assert asked["metrics"]["trust"]["mean_all_mm"] == pytest.approx(errors.mean(), rel=1e-3)


def test_frames_beyond_the_truth_are_not_judged(tmp_path: Path) -> None:
    summary = write(tmp_path / "a", [estimate(i) for i in range(9)], truth_of([], 4))
    assert summary["metrics"]["trust"]["frames"] == 4
    summary = write(tmp_path / "b", [estimate(i) for i in range(9, 12)], truth_of([], 4))
    assert "metrics" not in summary


def test_run_json_is_there_from_the_start(tmp_path: Path) -> None:
    with ResultWriter(tmp_path, {"seed": 1}, NAMES, truth_of([], 5)):
        facts = read_run_facts(tmp_path)
    assert facts["metadata"] == {"seed": 1} and facts["joint_names"] == list(NAMES)
    assert facts["truth"] is True and facts["working_folder"]
    with pytest.raises(ToftrackError, match="has no run.json"):
        read_run_facts(tmp_path / "nowhere")


def test_a_second_run_into_a_folder_is_refused_while_the_first_lives(tmp_path: Path) -> None:
    with ResultWriter(tmp_path, {}, NAMES) as first:
        first.append((estimate(0),))
        with pytest.raises(ToftrackError, match="another run is writing.*hydra.run.dir"):
            ResultWriter(tmp_path, {}, NAMES)
        with pytest.raises(ToftrackError, match="another run is writing"):
            recover(tmp_path)
        first.append((estimate(1),))
    assert len(read_results(tmp_path / "track.npz")["lost"]) == 2
    with ResultWriter(tmp_path, {}, NAMES):
        assert not (tmp_path / "track.npz").exists(), "it would be that of the first run"
    assert (tmp_path / "track.jsonl").read_text() == ""


def test_a_disk_that_fills_keeps_what_was_whole(tmp_path: Path, files_of_at_most) -> None:
    with pytest.raises(ToftrackError, match="File too large.*the 3 frames.*make room.*recover"):
        with ResultWriter(tmp_path, {}, NAMES) as writer:
            for i in range(3):
                writer.append((estimate(i),))
            with files_of_at_most((tmp_path / "track.jsonl").stat().st_size + 1000):
                writer.append((estimate(3),))
    assert (tmp_path / "track.jsonl").read_text().count("\n") == 3
    assert len(read_results(tmp_path / "track.npz")["lost"]) == 3


def test_a_folder_that_is_removed_or_renamed_is_reported(tmp_path: Path) -> None:
    """Removed, at the next frame: a live run has no end by itself."""
    gone = "'.*/run' was removed or renamed.*recover.* the 1 frames"
    with pytest.raises(ToftrackError, match=gone), ResultWriter(tmp_path / "run", {}, NAMES) as one:
        one.append((estimate(0),))
        shutil.rmtree(one.folder)
        one.append((estimate(1),))
    with pytest.raises(ToftrackError, match=gone), ResultWriter(tmp_path / "run", {}, NAMES) as one:
        one.append((estimate(0),))
        one.folder.rename(tmp_path / "now")
    assert recover(tmp_path / "now")["frames"] == 1


def test_memory_does_not_grow_with_the_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "_PIECE", 16)  # frames that are held at once

    def peak(frames: int) -> int:
        tracemalloc.start()
        with ResultWriter(tmp_path / str(frames), {}, NAMES) as writer:
            for i in range(frames):
                writer.append((replace(one, index=i),))
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    one = estimate(0)
    few, many = peak(50), peak(110)
    assert many - few < 60 * 200  # a frame's numbers alone are 1100 bytes


def test_what_is_recovered_is_what_the_run_would_have_written(tmp_path: Path) -> None:
    odd = estimate(4, score=math.inf, gesture="", joints_m=np.full((21, 3), -np.inf))
    many = [no_estimate(0, 0.0, "searching", 4, 0.01), *(estimate(i) for i in range(1, 4)), odd]
    summary, before = write(tmp_path, many), read_results(tmp_path / "track.npz")
    assert before["joint_names"] == NAMES and before["metadata"] == {"seed": 1}
    for name in ("track.npz", "summary.json"):
        (tmp_path / name).unlink()
    told = summary | {"complete": False}  # nobody knows
    assert json.dumps(recover(tmp_path)) == json.dumps(told)  # NaN, too
    after = read_results(tmp_path / "track.npz")
    for name in KINDS:
        np.testing.assert_array_equal(after[name], before[name])


@pytest.mark.parametrize(
    ("number", "changes", "words"),
    [
        (1, None, "line 2 of"),
        (0, {"joints_m": [[0, 0, 0]]}, "shape"),
        (0, {"index": 10**19}, "shortly before"),
    ],
)
def test_a_line_that_is_damaged_is_named(
    tmp_path: Path, number: int, changes: dict[str, Any] | None, words: str
) -> None:
    write(tmp_path, [estimate(i) for i in range(4)])
    path = tmp_path / "track.jsonl"
    lines = path.read_text().splitlines()
    lines[number] = "{]" if changes is None else json.dumps(json.loads(lines[number]) | changes)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ToftrackError, match=words):
        recover(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"metadata": []},
        {"metadata": {"pose_space": {"dims": 10**9}}},
        {"metadata": {"camera": {"K": 1}}},
    ],
    ids=str,
)
def test_a_run_json_that_is_damaged_is_reported(tmp_path: Path, changes: dict[str, Any]) -> None:
    write(tmp_path, [estimate(i) for i in range(3)])
    path = tmp_path / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ToftrackError):
        recover(tmp_path)


@pytest.mark.parametrize("rest", [b'{"index":9,"jo', b"\0\0\0\0", b""])
def test_what_a_killed_run_left_unfinished_is_dropped(tmp_path: Path, rest: bytes) -> None:
    write(tmp_path, [estimate(i) for i in range(4)])
    lines = tmp_path / "track.jsonl"
    whole = lines.read_bytes()
    lines.write_bytes(whole + rest)
    (tmp_path / "track.npz").unlink()
    assert recover(tmp_path)["frames"] == 4
    assert lines.read_bytes() == whole
    assert len(read_results(tmp_path / "track.npz")["lost"]) == 4


def test_results_of_more_than_a_gigabyte_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, [estimate(i) for i in range(4)])
    monkeypatch.setattr(archives, "MOST_BYTES", 1000)
    assert len(read_results(tmp_path / "track.npz")["lost"]) == 4


def test_dropped_frames_repeat_the_newest_estimate(tmp_path: Path) -> None:
    done = [estimate(i) for i in (2, 3, 6, 7)]
    truth = Truth(np.zeros((6, 21, 3)), np.ones(6, bool), np.ones(6, bool))
    summary = write(tmp_path, done, truth)
    content = read_results(tmp_path / "track.npz")
    shown = [estimate(i) for i in (2, 3, 3, 3, 6, 7)]
    np.testing.assert_array_equal(content["joints_m"], np.array([one.joints_m for one in shown]))
    np.testing.assert_allclose(content["timestamp_s"], np.arange(2, 8) / 25)
    assert content["compute_s"][2:4].tolist() == [0, 0]
    assert np.flatnonzero(content["dropped"]).tolist() == [2, 3]
    assert content["state_name"].tolist() == ["tracking"] * 2 + ["dropped"] * 2 + ["tracking"] * 2
    assert content["lost"].tolist() == [one.lost for one in shown]
    # A dropped frame has no line: its number is missing.
    assert [line["index"] for line in read_lines(tmp_path / "track.jsonl")] == [2, 3, 6, 7]
    assert summary["frames"] == 6
    assert summary["mean_ms"] == pytest.approx(1e3 * np.mean([one.compute_s for one in done]))


@pytest.mark.parametrize(
    "changes",
    [
        {"lost": np.array(False)},
        {"score": np.zeros((2, 3), np.float32)},
        {"metadata": np.array("[]")},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_arrays_that_do_not_fit_together_are_no_result(
    changes: dict[str, np.ndarray], tmp_path: Path
) -> None:
    write(tmp_path, [estimate(0), estimate(1)])
    path = tmp_path / "track.npz"
    with np.load(path) as content:
        arrays = dict(content)
    read_results(path)
    np.savez(path, **(arrays | changes))
    with pytest.raises(ToftrackError, match=r"is not a track\.npz, or it is damaged"):
        read_results(path)
    path.write_bytes(b"PK\x03\x04broken")
    with pytest.raises(ToftrackError, match=r"track\.npz"):
        read_results(path)
    with pytest.raises(ToftrackError, match="cannot be read"):
        read_results(tmp_path / "nowhere.npz")


FRAMES = 12


def vacant(index: int) -> Estimate:
    return no_estimate(index, index / 25, "searching", 4, 0.01)


def hand(index: int, slot: int) -> Estimate:
    of_slot = {"side": ("left", "right")[slot], "gesture": ("palm", "fist")[slot]}
    of_slot |= {"score": 0.5 + slot / 4, "side_probability": 0.75, "lost": False}
    return replace(estimate(index + 100 * slot, **of_slot), index=index, timestamp_s=index / 25)


def two_hands() -> list[tuple[Estimate, Estimate]]:
    """Both hands; the second one is not there in frames 0 to 2, and doubted in frame 5."""
    return [
        (hand(i, 0), vacant(i) if i < 3 else replace(hand(i, 1), lost=i == 5))
        for i in range(FRAMES)
    ]


def two_truths() -> Truth:
    """Both hands 10 mm off in each coordinate, the second one's visible from frame 3 on."""
    there, yes = np.arange(FRAMES) >= 3, np.ones(FRAMES, bool)
    joints = [np.stack([hand(i, slot).joints_m + 0.01 for i in range(FRAMES)]) for slot in (0, 1)]
    return Truth(joints[1], there, yes, other=Truth(joints[0], yes, yes))


def test_a_line_lists_the_hands_that_are_there_each_with_slot_and_side(tmp_path: Path) -> None:
    write(tmp_path, two_hands(), hands=2)
    lines = lines_of(tmp_path)
    assert all(tuple(line) == (*FRAME_FIELDS, "hands") for line in lines)
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
    done = two_hands()
    write(tmp_path, done, hands=2)
    content = read_results(tmp_path / "track.npz")
    for name in set(FRAME_FIELDS) & set(KINDS):
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


def test_each_true_hand_is_measured_in_the_slot_that_followed_it(tmp_path: Path) -> None:
    known = two_truths()
    metrics = write(tmp_path, two_hands(), known, hands=2)["metrics"]
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


def test_a_result_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    writer = ResultWriter(tmp_path, {}, NAMES, None)
    writer.append((estimate(0),))
    (tmp_path / "track.npz").mkdir()
    with pytest.raises(ToftrackError, match="cannot be written"):
        writer.close()
    assert (tmp_path / "track.jsonl").read_text().count("\n") == 1


def test_dropped_frames_repeat_both_hands(tmp_path: Path) -> None:
    write(tmp_path, [both for both in two_hands() if both[0].index not in (2, 7)], hands=2)
    content = read_results(tmp_path / "track.npz")
    assert np.flatnonzero(content["dropped"]).tolist() == [2, 7]
    there = content["state_name"] != ""  # a slot without a hand says nothing
    assert ((content["state_name"] == "dropped") == content["dropped"][:, None] & there).all()
    assert there[2].tolist() == [True, False]
    np.testing.assert_array_equal(content["joints_m"][7], content["joints_m"][6])
    assert content["lost"][2].tolist() == [False, True]


def test_the_summary_speaks_of_each_slot(tmp_path: Path) -> None:
    for slot, name in enumerate(("hand_shape.json", "hand_shape_2.json")):
        default_hand_shape(0.17 + slot / 100).of_side(("left", "right")[slot]).save(tmp_path / name)
    summary = write(tmp_path, two_hands(), hands=2)
    assert (summary["frames"], summary["lost_frames"]) == (FRAMES, 0)
    first, second = summary["slots"]
    assert (first["frames"], second["frames"]) == (FRAMES, FRAMES - 3)
    assert (first["lost_frames"], second["lost_frames"]) == (0, 1)
    assert (first["mean_score"], second["mean_score"]) == pytest.approx((0.5, 0.75))
    assert [one["hand"]["side"] for one in (first, second)] == ["left", "right"]
    assert second["hand"]["length_mm"] == pytest.approx(180)
    assert "slot 1" in metrics_table(summary)
