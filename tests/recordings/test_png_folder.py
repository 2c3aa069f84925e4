"""A folder of images: its camera, given by a file or on the command line; PNG images of others."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.tracking import ROOT

from toftrack.api import make_device
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.output.run_folder import read_run
from toftrack.programs.main import main
from toftrack.recordings.bare import BareFacts
from toftrack.recordings.png import decoded_png
from toftrack.recordings.png_folder import read_png_folder

LENS = "device.intrinsics=[201,202,87,71]"
K = [[201, 0, 87], [0, 202, 71], [0, 0, 1]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames of the sample, without a camera."""
    made = tmp_path / "images"
    made.mkdir()
    with make_device("device=sample", "device.stop=2") as sample:
        for frame in sample:
            cv2.imwrite(str(made / f"{frame.index}.png"), (1000 * frame.depth).astype(np.uint16))
    return made


def test_the_camera_file_that_the_page_shows_is_read(folder: Path) -> None:
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"<!-- test: camera.json -->\n```json\n(.*?)```", page, re.DOTALL)
    (folder / "camera.json").write_text(example)
    read = read_png_folder(folder)
    np.testing.assert_array_equal(read.camera.K, [[200, 0, 88], [0, 200, 72], [0, 0, 1]])
    assert (read.camera.width, read.camera.height) == (176, 144)
    assert (read.unit_m, read.fps, read.radial) == (0.001, 25, False)


def test_a_folder_is_tracked_with_the_lens_that_the_command_line_tells(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["view=none", "hand.side=right", f"hydra.run.dir={tmp_path / 'run'}"]
    assert main(["track", str(folder), *words]) == 1
    assert "device.intrinsics=[FX,FY,CX,CY]" in capsys.readouterr().err
    assert main(["track", str(folder), LENS, "device.fps=50", *words]) == 0
    run = read_run(tmp_path / "run")
    np.testing.assert_array_equal(run.results["metadata"]["camera"]["K"], K)
    np.testing.assert_allclose(run.results["timestamp_s"], [0, 0.02])
    footage = run.footage()
    assert footage is not None, "figures are drawn with the same lens"
    np.testing.assert_array_equal(footage.camera.K, K)


def test_the_lens_of_any_recording_can_be_given(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    depth = np.random.default_rng(0).uniform(0.4, 2, (2, 144, 176)).astype(np.float32)
    np.savez(path, depth_m=depth, K=np.array(K) * 2 - np.diag([0, 0, 1]), distortion=[0.1, 0, 0, 0])
    camera = Replay(path, intrinsics=[201, 202, 87, 71]).camera
    np.testing.assert_array_equal(camera.K, K)
    assert not camera.distortion.any()
    np.save(tmp_path / "b.npy", depth)
    with make_device("device=replay", f"device.path={tmp_path / 'b.npy'}", LENS) as device:
        np.testing.assert_array_equal(device.camera.K, K)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("[200,200,88]", "intrinsics must be four numbers of pixels"),
        ("[-1,200,88,72]", r"fx, fy \(above 0\)"),
        ("200", "intrinsics must be four numbers of pixels.*but are 200"),
        ("[1,1,88,72]", "cannot be that of images of 176x144 pixels"),
    ],
)
def test_lenses_that_are_none_are_reported(given: str, words: str, folder: Path) -> None:
    with pytest.raises(ToftrackError, match=words) as caught:
        make_device("device=folder", f"device.path={folder}", f"device.intrinsics={given}")
    assert "\n" not in str(caught.value)


def test_a_lens_is_reported_once(folder: Path) -> None:
    read_png_folder(folder, bare=BareFacts([201, 202, 87, 71])).camera.save(folder / "mine.json")
    words = ["device=folder", f"device.path={folder}", f"camera.file={folder / 'mine.json'}"]
    with make_device(*words) as device:
        np.testing.assert_array_equal(device.camera.K, K)
    with pytest.raises(ToftrackError, match="both tell the lens; leave one out"):
        make_device(*words, LENS)


IMAGE = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
CONTENT = cv2.imencode(".png", IMAGE)[1].tobytes()


def test_a_whole_image_is_decoded() -> None:
    assert (decoded_png(CONTENT) == IMAGE).all()


@pytest.mark.parametrize("length", [0, 8, 20, len(CONTENT) // 2, len(CONTENT) - 1])
def test_an_image_that_was_cut_off_is_none(length: int) -> None:
    assert decoded_png(CONTENT[:length]) is None


def test_a_chunk_that_claims_gigabytes_is_not_handed_to_the_decoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    at = CONTENT.index(b"IDAT") - 4
    assert decoded_png(CONTENT[:at] + struct.pack(">I", 2**31 - 1) + CONTENT[at + 4 :]) is None
    huge = CONTENT[:16] + struct.pack(">II", 50_000, 50_000) + CONTENT[24:]
    assert decoded_png(huge) is None
