"""`toftrack gesture`: gestures of one's own from a recording, and their file."""

from pathlib import Path

import numpy as np
import pytest
from helpers.settings import gestures

from toftrack.errors import ToftrackError
from toftrack.gestures.features import features_of_angles
from toftrack.gestures.files import NamedPose, read_poses, save_poses
from toftrack.pose_space.data.pose_data import basic_pose
from toftrack.programs import gesture
from toftrack.programs.gesture import main

PART = ("--from", "0.2", "--to", "0.44")


def rock() -> np.ndarray:
    """Index and little finger straight, the others curled."""
    angles = basic_pose("fist").numpy()
    angles[5:9] = angles[17:21] = 0.0
    return angles


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def shows(monkeypatch: pytest.MonkeyPatch):
    """Lets the recording show a pose."""

    def show(angles: np.ndarray, believed: int = 10) -> None:
        seen = angles + np.random.default_rng(0).normal(0, 0.02, (10, 21))
        monkeypatch.setattr(gesture, "_track", lambda *given: (seen, np.arange(10) < believed))

    return show


def test_what_a_recording_shows_is_learned_and_known_again() -> None:
    main(["add", "palm", "sample", *PART, "--replace"])
    (pose,) = read_poses("gestures.json")
    flat = basic_pose("palm").numpy()
    assert pose.name == "palm"
    assert np.abs(pose.angles_rad[5:] - flat[5:]).max() < np.radians(25)
    mine = gestures("gestures.json")
    chances = mine.probabilities(features_of_angles(flat), 1.0, np.nan)
    assert mine.names[chances.argmax()] == "palm"


def test_gestures_are_added_listed_replaced_and_removed(shows, capsys) -> None:
    shows(rock())
    main(["add", "rock", "sample", *PART])
    odd = basic_pose("palm").numpy()
    odd[9:13] = basic_pose("fist").numpy()[9:13]
    shows(odd)
    main(["add", "odd", "sample", *PART, "hand.side=right"])
    capsys.readouterr()
    main(["list"])
    *known, rock_line, odd_line = capsys.readouterr().out.splitlines()
    assert {"palm", "fist", "thumb_up"} <= set(known)
    assert (rock_line, odd_line) == ("rock (yours, gestures.json)", "odd (yours, gestures.json)")
    with pytest.raises(ToftrackError, match="there is a gesture 'odd' already"):
        main(["add", "odd", "sample", *PART])
    main(["add", "odd", "sample", *PART, "--replace"])
    main(["remove", "rock"])
    assert [pose.name for pose in read_poses("gestures.json")] == ["odd"]
    main(["remove", "odd"])
    assert not Path("gestures.json").exists(), "a file without poses is none"


def test_what_cannot_be_distinguished_or_was_not_followed_is_refused(shows, here: Path) -> None:
    shows(basic_pose("fist").numpy())
    with pytest.raises(ToftrackError, match="'fist' and 'mine' are too much alike"):
        main(["add", "mine", "sample", *PART])
    shows(rock(), believed=3)
    with pytest.raises(ToftrackError, match="followed in only 3 of the 10 frames"):
        main(["add", "rock", "sample", *PART])
    assert not list(here.iterdir()), "nothing is left behind"


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("add", "rock", "sample", "--from", "3", "--to", "9"), "which lasts 3.96 s"),
        (("add", "other", "sample", *PART), "give another name"),
        (("add", "rock", "sample", *PART, "gestures=none"), "gestures=none knows no gesture"),
        (("remove", "rock"), "there is: mine"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_a_command_that_cannot_be_done_is_reported(words: tuple[str, ...], reported: str) -> None:
    save_poses("gestures.json", [NamedPose("mine", rock())])
    with pytest.raises(ToftrackError, match=reported):
        main(words)
