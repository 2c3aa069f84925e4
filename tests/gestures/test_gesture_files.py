"""A user's gestures: files, how they go with the others, and learning one from frames."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.settings import gestures, part
from helpers.shown_gestures import fingers, label_of, pose

from toftrack.errors import ToftrackError
from toftrack.gestures.files import NamedPose, learned_pose, read_poses, save_poses
from toftrack.hand.skeleton import ANGLE_NAMES

PAPER = part("gestures=paper", "gestures")
ROCK = {name: 0.0 for name in ANGLE_NAMES if name.startswith(("index", "little"))} | {
    f"{finger}_{joint}_flexion": value
    for finger in ("middle", "ring")
    for joint, value in (("mcp", 90.0), ("pip", 102.0), ("dip", 50.0))
}


def write_json(folder: Path, poses: object, units: str | None = "degrees") -> Path:
    path = folder / "mine.json"
    path.write_text(json.dumps({"poses": poses} | ({"units": units} if units else {})))
    return path


def write_csv(folder: Path, text: str) -> Path:
    path = folder / "mine.csv"
    path.write_text(text)
    return path


def test_a_json_file_names_further_gestures(tmp_path: Path) -> None:
    path = write_json(tmp_path, [{"name": "rock", "angles": ROCK}])
    mine = part("gestures=paper", "gestures", file=str(path))
    assert mine.names == ("palm", "fist", "pointing", "rock", "other")
    # Such a pose lies off the pose space, which must not speak against it.
    assert label_of(fingers(1, 2), mine, off=0.4) == "rock"
    assert label_of(fingers(1, 2)) == "other"
    assert label_of(fingers(1, 2), gestures(str(path))) == "rock"
    for basic, label in (("palm", "palm"), ("fist", "fist"), ("gun", "pointing")):
        assert label_of(pose(basic), mine) == label


def test_a_gesture_that_says_more_is_preferred_where_it_holds(tmp_path: Path) -> None:
    thumbs_up = np.degrees(pose("fist", "up")).tolist()
    path = write_json(tmp_path, [{"name": "good", "angles": thumbs_up}])
    mine = part("gestures=paper", "gestures", file=str(path))
    assert label_of(pose("fist", "up"), mine) == "good"
    assert label_of(pose("fist"), mine) == "fist"
    with pytest.raises(ToftrackError, match="'thumb_up' and 'good' are too much alike"):
        gestures(str(path))


def test_poses_of_one_name_are_one_gesture_and_a_basic_name_is_replaced(tmp_path: Path) -> None:
    half = {name: 45.0 for name in ANGLE_NAMES if name.endswith(("mcp_flexion", "pip_flexion"))}
    poses = [
        {"name": "fist", "angles": np.degrees(pose("fist")).tolist()},
        {"name": "fist", "angles": half},
    ]
    mine = gestures(str(write_json(tmp_path, poses[:1])), known="paper")
    assert mine.names == ("palm", "pointing", "fist", "other")
    half |= {name: 20.0 for name in ANGLE_NAMES if name.endswith("dip_flexion")}
    both = gestures(str(write_json(tmp_path, poses)), known="paper")
    assert both.names == mine.names
    loose = np.zeros(21)
    loose[[ANGLE_NAMES.index(name) for name in half]] = np.radians(list(half.values()))
    assert label_of(loose, both) == "fist"
    assert label_of(pose("fist"), both) == "fist"
    assert label_of(loose, PAPER) == "other"


def test_a_csv_file_reads_as_the_json_file(tmp_path: Path) -> None:
    names, values = list(ROCK), [math.radians(value) for value in ROCK.values()]
    text = f"# units: radians\nname,{','.join(names)},thumb_ip_flexion\n"
    text += f"rock,{','.join(map(str, values))},\n"
    from_csv = read_poses(write_csv(tmp_path, text))
    from_json = read_poses(write_json(tmp_path, [{"name": "rock", "angles": ROCK}]))
    assert [one.name for one in from_csv] == ["rock"]
    np.testing.assert_allclose(from_csv[0].angles_rad, from_json[0].angles_rad)
    assert np.isnan(from_csv[0].angles_rad).sum() == 7, "thumb, and two abductions"


def test_poses_are_read_as_they_were_saved(tmp_path: Path) -> None:
    spread = np.zeros(21)
    spread[7] = 0.1
    saved = [NamedPose("rock", fingers(1, 2), spread), NamedPose("any thumb", fingers(0, 2))]
    saved[1].angles_rad[:5] = math.nan
    save_poses(tmp_path / "mine.json", saved)
    for one, other in zip(read_poses(tmp_path / "mine.json"), saved, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.angles_rad, other.angles_rad, atol=1e-3)
        np.testing.assert_allclose(one.spread_rad, other.spread_rad, atol=1e-3)
    with pytest.raises(ToftrackError, match="cannot be written"):
        save_poses(tmp_path / "none" / "mine.json", saved)


@pytest.mark.parametrize(
    ("poses", "units", "words"),
    [
        ([{"name": "v", "angles": ROCK}], None, "does not say its units"),
        ([{"name": "v", "angles": ROCK}], "radians", "if they are degrees"),
        ([{"angles": ROCK}], "degrees", "pose 1 has no name"),
        ([{"name": "v", "angles": {"index_flexion": 9}}], "degrees", "unknown angle"),
        ([{"name": "other", "angles": ROCK}], "degrees", "none of the gestures"),
        ([{"name": "v", "angles": ROCK, "spread": [-1] * 21}], "degrees", "a spread below 0"),
    ],
)
def test_bad_json_is_reported_in_one_sentence(
    tmp_path: Path, poses: object, units: str | None, words: str
) -> None:
    path = write_json(tmp_path, poses, units)
    with pytest.raises(ToftrackError) as caught:
        gestures(str(path))
    assert words in str(caught.value) and "mine.json" in str(caught.value)


def test_a_bad_csv_and_a_file_that_is_none_are_reported(tmp_path: Path) -> None:
    for text, words in (
        ("# units: degrees\nindex_mcp_flexion\n80\n", "no column 'name'"),
        ("# units: degrees\nname,index_mcp_flexion\nv\n", "1 values for 2 columns"),
    ):
        with pytest.raises(ToftrackError, match=words):
            gestures(str(write_csv(tmp_path, text)))
    (tmp_path / "broken.json").write_text("{")
    for name in ("none.json", "broken.json"):
        with pytest.raises(ToftrackError, match="cannot be read as a file of gestures"):
            gestures(str(tmp_path / name))
    with pytest.raises(ToftrackError, match="neither .json nor .csv"):
        gestures(str(tmp_path / "poses.txt"))


STEADY = math.radians(25)
POSE = np.linspace(0.0, 1.5, 21)


def shown(frames: int = 20, tremor: float = 0.03) -> np.ndarray:
    return POSE + np.random.default_rng(0).normal(0, tremor, (frames, 21))


def test_the_pose_is_the_middle_of_the_frames_and_its_spread_their_tremor() -> None:
    pose = learned_pose("mine", shown(200), np.ones(200, bool), STEADY)
    assert pose.name == "mine"
    assert pose.angles_rad == pytest.approx(POSE, abs=0.01)
    assert pose.spread_rad == pytest.approx(np.full(21, 0.03), rel=0.4)


def test_wrong_and_disbelieved_frames_do_no_harm() -> None:
    angles, believed = shown(), np.ones(20, bool)
    angles[:3, 6:9] += 1.5
    angles[3:8], believed[3:8] = math.nan, False
    pose = learned_pose("mine", angles, believed, STEADY)
    assert pose.angles_rad == pytest.approx(POSE, abs=0.06)


@pytest.mark.parametrize(("frames", "believed"), [(20, 9), (4, 4)])
def test_a_hand_that_was_hardly_followed_is_refused(frames: int, believed: int) -> None:
    with pytest.raises(ToftrackError, match=f"in only {believed} of the {frames} frames"):
        learned_pose("mine", shown(frames), np.arange(frames) < believed, STEADY)


def test_a_hand_that_moves_its_fingers_is_refused() -> None:
    angles = shown()
    angles[:, 14] += np.linspace(0, 2, 20)
    with pytest.raises(ToftrackError, match="the ring finger bends and stretches"):
        learned_pose("mine", angles, np.ones(20, bool), STEADY)
