"""Orbbec's SDK itself plays a recording; skipped where the SDK cannot be loaded."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.orbbec_bag import write_orbbec_bag
from helpers.settings import orbbec
from helpers.tracking import ROOT
from helpers.videos import RATIONAL

from toftrack.devices.orbbec.device import load_sdk
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

CAMERA = Camera(np.array([[252.0, 0, 165], [0, 253, 150], [0, 0, 1]]), 320, 288, RATIONAL)
COUNT = 10


@pytest.fixture(scope="module", autouse=True)
def _sdk() -> None:
    try:
        load_sdk()
    except ToftrackError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """(2, COUNT, 288, 320) uint16: depth and infrared."""
    return np.random.default_rng(0).integers(1, 9000, (2, COUNT, 288, 320)).astype(np.uint16)


@pytest.fixture(scope="module")
def recording(images: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_orbbec_bag(tmp_path_factory.mktemp("orbbec") / "a.bag", *images, CAMERA)


def test_a_recording_gives_what_the_sdk_recorded(recording: Path, images: np.ndarray) -> None:
    device = orbbec(bag=recording, keep="every")
    np.testing.assert_allclose(device.camera.K, CAMERA.K)
    np.testing.assert_allclose(device.camera.distortion, CAMERA.distortion, rtol=1e-6)
    assert device.fps == 30
    assert device.description["serial"] == "CL8042"
    frames = list(device)
    assert frames and frames[0].index == 0
    # On a busy machine the SDK may begin with a later frame than the recording's first.
    missed = round(30 * (frames[0].timestamp_s - 1))
    for frame in frames:
        number = missed + frame.index
        np.testing.assert_allclose(frame.depth, images[0, number] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude, images[1, number])
        assert frame.timestamp_s == pytest.approx(1 + number / 30, abs=1e-5)


def test_what_is_no_recording_is_reported(tmp_path: Path, recording: Path) -> None:
    for content in (b"", b"nonsense" * 50, recording.read_bytes()[:9000]):
        (tmp_path / "a.bag").write_bytes(content)
        with pytest.raises(ToftrackError, match="a.bag' is not a recording of an Orbbec camera"):
            orbbec(bag=tmp_path / "a.bag")


def test_as_a_bag_of_ros_it_is_refused_with_whose_it_is(recording: Path) -> None:
    with pytest.raises(ToftrackError, match="device=orbbec device.bag="):
        Replay(recording)


def test_the_sdk_leaves_standard_output_and_the_folder_alone(tmp_path: Path) -> None:
    code = (
        "from toftrack.devices.orbbec.device import load_sdk; load_sdk().Context(); print('mine')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": ":".join([str(ROOT), *filter(None, sys.path)])},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "mine\n")
    assert not list(tmp_path.iterdir())
