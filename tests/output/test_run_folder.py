"""A finished run is read, or what is wrong with it is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.hands import hand_estimate

import toftrack
from toftrack.frames.camera import Camera
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.results import ResultWriter


def test_a_run_tells_its_arrays_times_camera_and_summary(tmp_path: Path) -> None:
    camera = Camera(np.array([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]]), 160, 120)
    with ResultWriter(tmp_path, {"camera": camera.to_dict()}, JOINT_NAMES) as writer:
        for index in range(3):
            writer.append((hand_estimate(index),))
    default_hand_shape().save(tmp_path / "hand_shape.json")
    run = toftrack.read_run(tmp_path)
    assert run.arrays["joints_m"].shape == (3, 21, 3) and run.timestamp_s.shape == (3,)
    assert all(isinstance(array, np.ndarray) for array in run.arrays.values())
    assert run.arrays["angle_names"].tolist() == list(toftrack.ANGLE_NAMES)
    assert "radians" in str(run.arrays["readme"])
    assert run.summary["frames"] == len(run) == 3
    assert (run.camera.width, run.camera.height) == (160, 120)
    np.testing.assert_array_equal(run.camera.K, camera.K)
    assert run.estimate(2).index == 2
