"""Labels in the making: which frames, and a file that is whole after every click."""

import json
from pathlib import Path

import numpy as np
import pytest

from toftrack.configuration.compose import configuration
from toftrack.devices.replay import Replay, Sample
from toftrack.errors import ToftrackError
from toftrack.evaluation.image_labels import Points, read_labels
from toftrack.evaluation.labelling import LabelFile, chosen_frames, label_frames, track
from toftrack.programs.label import ending

ABSENT = [None, None, "absent"]


def opened(path: Path, **changes: object) -> LabelFile:
    usual = {"recording": "a.npz", "size": (176, 144), "count": 100, "side": "left"}
    return LabelFile(path / "labels.json", **(usual | changes))


def test_frames_are_spaced_evenly_and_those_that_are_there_stay() -> None:
    assert chosen_frames(100, 4) == [12, 37, 62, 87]
    assert chosen_frames(3, 20) == [0, 1, 2]
    assert chosen_frames(101, 3, given=[50]) == [0, 50, 100]
    assert chosen_frames(100, 2, given=[1, 2, 3]) == [1, 2, 3]


def test_the_least_confident_frames_are_taken_apart_from_each_other() -> None:
    confidence = np.ones(100)
    confidence[[20, 21, 22, 70, 5]] = 0.1, 0.0, 0.1, 0.2, 0.5
    assert chosen_frames(100, 2, confidence=confidence) == [21, 70]
    assert chosen_frames(100, 2, given=[65], confidence=confidence) == [21, 65]
    assert chosen_frames(4, 9, confidence=np.zeros(4)) == [0, 1, 2, 3]


def test_every_change_is_in_the_file_and_the_benchmark_reads_it(tmp_path) -> None:
    labels = opened(tmp_path)
    labels.begin([3, 12])
    labels.set_point(12, "index_tip", [10.123, 20, "visible"])
    labels.set_point(12, "wrist", [30, 40, "guessed"])
    labels.set_point(12, "thumb_tip", ABSENT)
    labels.set_gesture(12, "palm")
    read = read_labels(labels.path)
    assert isinstance(read, Points) and (read.size, read.side) == ((176, 144), "left")
    assert read.frames == {3: {}, 12: {8: (10.12, 20.0)}}
    content = json.loads(labels.path.read_text())["frames"]["12"]
    assert content["gesture"] == "palm" and content["points"]["wrist"] == [30, 40, "guessed"]
    assert labels.labelled() == 1
    labels.set_point(12, "index_tip", None)
    labels.set_gesture(12, None)
    assert labels.labelled() == 0 and "gesture" not in labels.frames["12"]
    assert ending(labels, Path("a.npz"), ()).endswith(
        "0 of 2 frames are labelled; the same command continues"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["labels.json"]


def test_what_cannot_be_written_is_told_of(tmp_path) -> None:
    """In a folder that is not there; and a file with what JSON has not."""
    opened(tmp_path).begin([3])
    path = tmp_path / "labels.json"
    path.write_text(path.read_text().replace('"frames"', '"mine": NaN, "frames"'))
    for folder in (tmp_path / "gone", tmp_path):
        with pytest.raises(ToftrackError, match="cannot be written .*; give another --output"):
            opened(folder).begin([4])


def test_a_file_is_continued_with_all_that_is_in_it(tmp_path) -> None:
    first = opened(tmp_path)
    first.begin([3, 12])
    first.set_point(3, "index_tip", [1, 2, "visible"])
    content = json.loads(first.path.read_text())
    content["frames"]["3"]["facing"] = content["by"] = "somebody"
    first.path.write_text(json.dumps(content))
    again = opened(tmp_path, side=None)
    again.begin([3, 7])
    assert again.numbers() == [3, 7, 12] and again.content["side"] == "left"
    content["frames"]["7"] = {"points": {}}
    assert json.loads(again.path.read_text()) == content


def test_nothing_is_written_before_the_side_is_known(tmp_path) -> None:
    labels = opened(tmp_path, side=None)
    labels.begin([1])
    with pytest.raises(ValueError, match="right or a left"):
        labels.set_point(1, "wrist", ABSENT)
    with pytest.raises(ValueError, match="right or left"):
        labels.set_side("both")
    assert not labels.path.exists()
    labels.set_side("right")
    assert opened(tmp_path, side="right").numbers() == [1]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"side": "right"}, "of a left hand"),
        ({"size": (320, 240)}, "of another recording than 'a.npz'"),
        ({"count": 12}, "of another recording"),
        ({"recording": "b.npz"}, "of another recording than 'b.npz'"),
    ],
)
def test_labels_of_something_else_are_not_continued(tmp_path, changes, why) -> None:
    opened(tmp_path).begin([12])
    before = (tmp_path / "labels.json").read_bytes()
    with pytest.raises(ToftrackError, match=f"are {why}.*; give another --output"):
        opened(tmp_path, **changes)
    assert (tmp_path / "labels.json").read_bytes() == before


@pytest.mark.parametrize("text", ["", "[]", '{"frames": 3}', '{"side": "left", "frames": {}}'])
def test_a_file_that_is_none_of_labels_is_one_sentence(tmp_path, text) -> None:
    (tmp_path / "labels.json").write_text(text)
    with pytest.raises(ToftrackError, match="labels '.*labels.json'"):
        opened(tmp_path)


@pytest.mark.parametrize(
    "given",
    [
        (9, "wrist", [1, 2, "visible"]),
        ([3], "wrist", [1, 2, "visible"]),
        (3, "nose", [1, 2, "visible"]),
        (3, ["wrist"], [1, 2, "visible"]),
        (3, "wrist", [1, 2]),
        (3, "wrist", [1, 2, "seen"]),
        (3, "wrist", [1, 2, "absent"]),
        (3, "wrist", [None, None, "visible"]),
        (3, "wrist", [True, 2, "visible"]),
        (3, "wrist", [176, 2, "visible"]),
        (3, "wrist", [float("nan"), 2, "visible"]),
        (3, "wrist", {"u": 1}),
    ],
)
def test_what_is_no_point_is_refused(tmp_path, given) -> None:
    labels = opened(tmp_path)
    labels.begin([3])
    with pytest.raises(ValueError):
        labels.set_point(*given)
    assert labels.frames == {"3": {"points": {}}}


def test_frames_are_shown_about_the_hand_with_what_the_tracker_says() -> None:
    device, config = Sample(stop=8), configuration("filter.particles=100", "hand.side=right")
    known = track(device, config)
    assert known.confidence.shape == (8,) and known.confidence[-1] > 0.5
    assert sum(part.nbytes for part in known) < 8 * 300  # an hour has 100 000 frames
    frames = label_frames(device, config, [0, 7], known)
    assert [frame.number for frame in frames] == [0, 7]
    last = frames[-1]
    assert last.depth_mm.shape == (144, 176) and last.depth_mm.dtype == np.uint16
    truth = device.camera.K @ device.truth.joints_m[7].T
    truth = (truth[:2] / truth[2]).T
    assert np.abs(last.estimate_px - truth).max() < 8
    (bare,) = label_frames(device, config, [7])
    assert bare.estimate_px is None
    for frame in (bare, last):
        assert np.abs(truth - frame.centre_px).max() < frame.reach_px < 110
        depth_mm = 1e3 * device.truth.joints_m[7, :, 2]
        assert (
            frame.near_mm < depth_mm.min() and depth_mm.max() < frame.far_mm < frame.near_mm + 300
        )


def test_without_a_hand_the_whole_image_is_shown(tmp_path) -> None:
    depth = np.full((2, 144, 176), 2.0, np.float32)
    np.savez(tmp_path / "wall.npz", depth_m=depth, K=Sample().camera.K)
    with Replay(tmp_path / "wall.npz") as device:
        config = configuration("filter.particles=100")
        (frame,) = label_frames(device, config, [1])
        assert frame.centre_px == (87.5, 71.5) and frame.reach_px == 88
        # A frame in which nobody finds a hand comes last.
        assert track(device, config).confidence.tolist() == [1, 1]
