"""Images that were labelled by eye: cases done by hand."""

import json

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation.image_labels import Points, Stills, point_rows, read_labels, still_row
from toftrack.evaluation.measures import FLAG_COUNTS

K = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
ALL_OK = np.ones((3, 21), bool)
SIZED = {"image_size": [1, 2], "side": "left"}
STILL = SIZED | {"images": [3], "called": {"3": []}, "shown_frames": 1}


def labels(tmp_path, content) -> Points | Stills:
    file = tmp_path / "labels.json"
    file.write_text(json.dumps(content))
    return read_labels(file)


def points(tmp_path, frames) -> Points:
    content = {"image_size": [100, 80], "side": "left", "frames": frames}
    found = labels(tmp_path, content)
    assert isinstance(found, Points)
    return found


def test_tips_are_compared_across_5_mm_inside_of_the_finger(tmp_path) -> None:
    joints = np.full((3, 21, 3), [0.0, 0.0, 0.5])
    joints[:, 7] = [0.03, 0, 0.5]  # the joint before the index tip lies 30 mm to the right
    places = {"index_tip": [51, 40, "visible"], "wrist": [0, 0, "visible"]}
    far = {"index_tip": [60, 40, "visible"], "little_tip": [0, 0, "guessed"]}
    seen = points(tmp_path, {"0": {"points": places}, "2": {"points": far}})
    rows = point_rows(seen, joints, np.array([False, False, True]), ALL_OK, K)
    assert rows[0]["tips_mm"] == [0] and rows[0]["tips_20_pct"] == 100
    assert rows[2]["tips_mm"] == [45] and rows[2]["tips_40_pct"] == 0
    assert (rows[2]["flagged_pct"], rows[2]["wrong_pct"]) == (100, 0)
    unflagged = point_rows(seen, joints, np.zeros(3, bool), ALL_OK, K)
    assert unflagged[2]["wrong_pct"] == unflagged[2]["wrong_no_flag_pct"] == 100
    doubted = point_rows(seen, joints, np.zeros(3, bool), ~ALL_OK, K)[2]
    assert (doubted["wrong_pct"], doubted["wrong_no_flag_pct"]) == (100, 0)
    assert [doubted[name] for name in FLAG_COUNTS] == [1, 1, 0, 0]


def test_what_is_nowhere_or_behind_the_camera_is_infinitely_far_off(tmp_path) -> None:
    joints = np.full((2, 21, 3), -1.0)
    joints[1] = np.nan
    frame = {"points": {"thumb_tip": [50, 40, "visible"]}}
    seen = points(tmp_path, {"0": frame, "1": frame})
    rows = point_rows(seen, joints, np.zeros(2, bool), ALL_OK, K)
    assert [row["tips_mm"] for row in rows.values()] == [[None], [None]]
    assert all(row["wrong_pct"] == 100 for row in rows.values())


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ({"index_tpi": [50, 40, "visible"]}, "there is no joint 'index_tpi'"),
        ({"index_tip": [5000, 40, "visible"]}, "the pixel 5000, 40 of a visible index_tip is not"),
    ],
)
def test_a_point_that_cannot_be_is_named(point, words: str, tmp_path) -> None:
    with pytest.raises(ToftrackError, match=words):
        points(tmp_path, {"0": {"points": point}})


def test_labels_beyond_the_recordings_end_are_refused(tmp_path) -> None:
    seen = points(tmp_path, {"7": {"points": {"thumb_tip": [50, 40, "visible"]}}})
    with pytest.raises(ToftrackError, match="of frame 7, but the recording has 2 frames"):
        point_rows(seen, np.zeros((2, 21, 3)), np.zeros(2, bool), ALL_OK, K)


def test_a_still_may_have_several_names_and_other_is_no_wrong_one(tmp_path) -> None:
    called = {"1": ["palm"], "6": ["other", ""]}
    found = labels(tmp_path, STILL | {"images": [1, 6], "called": called})
    assert isinstance(found, Stills) and found.images == ("1", "6")
    palm, horns = (found.called[image] for image in found.images)
    assert still_row("palm", False, palm)["named_pct"] == 100
    assert list(still_row("other", False, palm).values()) == [100, 0, 0]
    assert still_row("fist", False, palm)["wrong_name_pct"] == 100
    assert set(still_row("", True, horns).values()) == {0}
    assert still_row("other", False, horns)["named_pct"] == 100
    assert still_row("three", False, horns)["wrong_name_pct"] == 100


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        SIZED | {"side": "up", "frames": {}},
        SIZED | {"frames": {"0": {"points": {"nose": [1, 2, "x"]}}}},
        STILL | {"called": {}},
        STILL | {"shown_frames": 1e9},
        SIZED | {"image_size": [float("inf"), 2], "frames": {}},
        SIZED | {"frames": {"05": {"points": {"wrist": [0, 0, "visible"]}}}},
        SIZED | {"frames": {"5": {"points": {"wrist": [0, float("nan"), "guessed"]}}}},
    ],
)
def test_labels_of_neither_kind_are_reported_in_one_sentence(tmp_path, content) -> None:
    with pytest.raises(ToftrackError, match="labels '.*' are neither of points nor of stills"):
        labels(tmp_path, content)
