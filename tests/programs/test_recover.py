"""`toftrack recover` on a folder of a stranger: nothing elsewhere changes, nothing becomes less."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.hands import hand_estimate
from omegaconf import OmegaConf

from toftrack.errors import ToftrackError
from toftrack.files.json_text import read_json
from toftrack.frames.estimate import Estimate
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.files import LINES
from toftrack.output.results import RealTime, ResultWriter, read_results
from toftrack.programs import export
from toftrack.programs.command_line import FailedJobs
from toftrack.programs.recover import main, recover
from toftrack.views.video import VideoFile

MADE = ("track.npz", "summary.json", "overlay.mp4", LINES)
PRECIOUS = b"precious " * 99


def write(folder: Path, numbers: list[int], hands: int = 1) -> None:
    folder.mkdir(exist_ok=True)
    default_hand_shape(0.18).save(folder / "hand_shape.json")
    default_hand_shape(0.18).save(folder / "hand_shape_2.json")
    facts = {"pose_space": {"dims": 4}, "config": {"hands": hands}}
    with ResultWriter(folder, facts, JOINT_NAMES) as writer:
        for number in numbers:
            one: Estimate = hand_estimate(number)
            writer.append((one,) * hands)
        writer.realtime = RealTime(25.0, tracked=len(numbers))
    video = VideoFile(folder / "overlay.mp4", 2, (32, 32))
    for _ in range(4):
        video.add(np.zeros((32, 32, 3), np.uint8))
    video.close()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    write(tmp_path / "run", [0, 1, 4, 5])
    return tmp_path / "run"


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("way", [os.symlink, os.link], ids=["link", "second name"])
def test_nothing_elsewhere_is_changed(
    way: Callable[[Path, Path], None], name: str, run: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(PRECIOUS)
    (run / name).unlink()
    way(elsewhere, run / name)
    try:
        main([str(run)])
    except ToftrackError as error:
        assert str(run / name) in str(error) or "nothing was changed" in str(error)
    else:  # a file that becomes new is another one
        assert way is os.link and name == "summary.json"
    assert elsewhere.read_bytes() == PRECIOUS


@pytest.mark.parametrize("name", ["track.npz", LINES])
def test_a_pipe_is_not_waited_for(name: str, run: Path) -> None:
    (run / name).unlink()
    os.mkfifo(run / name)
    with pytest.raises(ToftrackError, match="pipe"):
        recover(run)


def test_less_than_there_is_is_only_made_when_asked(run: Path) -> None:
    content = b"notes of mine, without an end"
    (run / LINES).write_bytes(content)
    with pytest.raises(ToftrackError, match=r"6 frames, but track.jsonl only 0; .*--replace"):
        main([str(run)])
    assert len(read_results(run / "track.npz")["lost"]) == 6
    assert (run / LINES).read_bytes() == content
    main([str(run), "--replace"])
    assert len(read_results(run / "track.npz")["lost"]) == 0
    assert (run / LINES).read_bytes() == content


def test_a_file_in_the_place_of_the_results_is_only_replaced_when_asked(run: Path) -> None:
    (run / "track.npz").write_bytes(PRECIOUS)
    with pytest.raises(ToftrackError, match="damaged or not a run's.*--replace"):
        recover(run)
    assert (run / "track.npz").read_bytes() == PRECIOUS
    assert recover(run, replace=True)["frames"] == 6


@pytest.mark.parametrize("content", [PRECIOUS, bytes.fromhex("000000106674797000000001") * 3])
def test_what_is_no_video_of_ours_is_not_cut(content: bytes, run: Path) -> None:
    (run / "overlay.mp4").write_bytes(content)
    recover(run)
    assert (run / "overlay.mp4").read_bytes() == content


def test_a_video_of_which_no_second_was_whole_goes(run: Path) -> None:
    """As of a run that was killed in its first second: it would play nothing."""
    whole = (run / "overlay.mp4").read_bytes()
    for size in (0, whole.index(b"moof") - 4, whole.index(b"mdat")):
        (run / "overlay.mp4").write_bytes(whole[:size])
        recover(run)
        assert not (run / "overlay.mp4").exists(), size


def test_what_the_lines_do_not_tell_stays_in_the_summary(run: Path) -> None:
    before = read_json(run / "summary.json")
    assert before["realtime"]["tracked_frames"] == 4
    recover(run)
    assert read_json(run / "summary.json") == before


@pytest.mark.parametrize("hands", [1, 2])
def test_dropped_frames_are_reported_alike_by_lines_results_and_exports(
    hands: int, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    write(run, [0, 1, 4, 5], hands)
    before = read_results(run / "track.npz")
    (run / "track.npz").unlink()
    recover(run)
    after = read_results(run / "track.npz")
    for name, values in before.items():
        np.testing.assert_array_equal(values, after[name], err_msg=name)
    (table,) = export.export(run, "csv")
    header, *rows = (line.split(",") for line in table.read_text().splitlines())
    column = header.index("dropped")
    assert [row[column] for row in rows[::hands]] == ["0", "0", "1", "1", "0", "0"]
    assert rows[2 * hands][header.index("state_name")] == "dropped"


@pytest.mark.parametrize("name", ["track.npz", "summary.json", LINES])
def test_a_new_run_lets_nothing_go_that_is_no_runs(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(PRECIOUS)
    with pytest.raises(ToftrackError, match=f"{name}.*no run.json.*hydra.run.dir"):
        ResultWriter(tmp_path, {}, JOINT_NAMES)
    assert (tmp_path / name).read_bytes() == PRECIOUS


def test_a_new_run_lets_all_of_an_earlier_one_go_and_says_so(run: Path, caplog) -> None:
    mine = ("hand.csv", "hand_shape_anna.json")
    for name in ("overlay.mp4", "overlay.png", "hand_shape_3.json", *mine):
        (run / name).write_bytes(PRECIOUS)
    with ResultWriter(run, {}, JOINT_NAMES):
        assert {path.name for path in run.iterdir() if path.read_bytes() == PRECIOUS} == set(mine)
        assert not (run / "hand_shape_2.json").exists()
    assert "earlier run" in caplog.text and str(run) in caplog.text


def test_a_file_of_a_run_in_the_place_of_its_folder_is_reported(run: Path) -> None:
    with pytest.raises(ToftrackError, match="not the output folder of a run.*give a folder"):
        recover(run / LINES)


@pytest.mark.parametrize("name", ["track.log", ".hydra/config.yaml", ".hydra"])
def test_hydra_writes_through_no_link(name: str, run: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "config.yaml").write_bytes(PRECIOUS)
    path = run / name
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(elsewhere if name == ".hydra" else elsewhere / "config.yaml")
    FailedJobs().on_run_start(OmegaConf.create({"hydra": {"run": {"dir": str(run)}}}))
    assert not path.is_symlink() and (elsewhere / "config.yaml").read_bytes() == PRECIOUS
