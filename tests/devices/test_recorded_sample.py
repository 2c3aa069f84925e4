"""The sample, as other cameras' programs would have recorded it, is tracked as well as itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.bags import recording, write_bag
from helpers.tracking import errors_mm, make_tracker, sample
from helpers.videos import RATIONAL, calibration, seen_through, write_kinect

from toftrack.camera import Camera
from toftrack.devices.base import Device
from toftrack.devices.replay import Bag, Replay, Sample

FRAMES = 30


def error_mm(device: Device) -> float:
    """The mean joint error over the first frames of the sample, as a device delivers them."""
    tracker, estimates = make_tracker(), []
    for frame in device:
        depth = device.camera.rectify(frame.depth, frame.radial)
        camera = device.camera.K
        estimates.append(tracker.step(depth, camera, frame.index, frame.timestamp_s))
    assert len(estimates) == FRAMES
    return float(errors_mm(estimates, sample()).mean())


@pytest.fixture(scope="module")
def straight_mm(one_thread: None) -> float:
    return error_mm(Sample(stop=FRAMES))


def test_as_a_ros_bag_in_millimetres(tmp_path: Path, straight_mm: float) -> None:
    frames = [frame.depth for frame in Sample(stop=FRAMES)]
    bag = write_bag(tmp_path, "bag", recording(frames, Sample().camera))
    # Rounded depth leads to other poses of the same quality; a wrong unit or frame, to none.
    assert error_mm(Bag(bag)) == pytest.approx(straight_mm, abs=0.6)


def test_as_a_kinects_recording_through_a_rational_lens(tmp_path: Path, straight_mm: float) -> None:
    pinhole = Sample().camera
    # Twice as many pixels, less those that a Kinect's narrow image has not.
    K = pinhole.K.copy()
    K[:2] *= 2
    K[:2, 2] += (0.5 - 16, 0.5)
    camera = Camera(K, 320, 288, np.array(RATIONAL))
    words = [
        np.rint(1000 * seen_through(camera, frame.depth, pinhole)).astype(np.uint16)
        for frame in Sample(stop=FRAMES)
    ]
    about = calibration(K, 512, (96, 90))
    path = write_kinect(tmp_path / "hand.mkv", np.stack(words), about=about)
    assert error_mm(Replay(path)) == pytest.approx(straight_mm, abs=1.0)
