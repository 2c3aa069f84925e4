"""Kinematics, shape and surface of the hand."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.tracking import code_of

from toftrack.errors import ToftrackError
from toftrack.hand.shape import Fitted, HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.hand.surface import hand_surface


def random_states(n: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    limits = torch.tensor(ANGLE_LIMITS, dtype=torch.float64)
    unit = torch.rand(n, 21, generator=generator, dtype=torch.float64)
    angles = limits[:, 0] + unit * (limits[:, 1] - limits[:, 0])
    pose = torch.randn(n, 6, generator=generator, dtype=torch.float64)
    return torch.cat((pose, angles), 1).to(dtype)


@pytest.mark.parametrize("side", ["right", "left"])
def test_kinematics_agree_with_those_that_the_page_shows(side: str, tmp_path: Path) -> None:
    """A second implementation, which reads the file of the hand."""
    page: dict[str, Any] = {}
    exec(code_of("formats.md", "kinematics"), page)
    shape, states = default_hand_shape(side=side), random_states(20)
    shape.save(tmp_path / "hand_shape.json")
    sizes = json.loads((tmp_path / "hand_shape.json").read_text())
    each = [page["joints_of"](state.numpy(), side, sizes) for state in states]
    expected = torch.from_numpy(np.stack(each))
    joints = forward_kinematics(states, shape.to(torch.float64)).joints_m
    torch.testing.assert_close(joints, expected, atol=1e-9, rtol=0)
    single = forward_kinematics(states.float(), shape).joints_m
    torch.testing.assert_close(single.double(), expected, atol=3e-6, rtol=0)


def test_scaling_the_shape_scales_joints_and_ellipsoids() -> None:
    shape = default_hand_shape().to(torch.float64)
    states = random_states(3)
    states[:, :3] = 0
    sizes = {"base_m": 1.2 * shape.base_m, "bone_lengths_m": 1.2 * shape.bone_lengths_m}
    small, large = (
        hand_surface(s).pose(forward_kinematics(states, s))
        for s in (shape, dataclasses.replace(shape, **sizes))
    )
    torch.testing.assert_close(large.centres_m, 1.2 * small.centres_m)
    torch.testing.assert_close(large.axes_m, 1.2 * small.axes_m)


def test_thickness_changes_the_fingers_breadth_but_no_joint() -> None:
    shape = default_hand_shape()
    thick = dataclasses.replace(shape, thickness=1.2)
    breadth = [hand_surface(s).axes_m[0, 0, 0] for s in (shape, thick)]
    torch.testing.assert_close(breadth[1], 1.2 * breadth[0])
    states = random_states(2, dtype=torch.float32)
    torch.testing.assert_close(
        forward_kinematics(states, shape).joints_m, forward_kinematics(states, thick).joints_m
    )


def test_a_shape_file_round_trips_and_says_how_the_shape_was_fitted(tmp_path) -> None:
    path = tmp_path / "shape.json"
    fitted = Fitted(("length", "thumb"), (-0.1, 0.02), ((4e-4, 1e-5), (1e-5, 9e-4)), 7.5, True)
    shape = dataclasses.replace(default_hand_shape(0.18, "left"), thickness=1.1, fitted=fitted)
    shape.save(path)
    loaded = HandShape.load(path).of_side("left")
    torch.testing.assert_close(loaded.base_m, shape.base_m)
    torch.testing.assert_close(loaded.bone_lengths_m, shape.bone_lengths_m)
    torch.testing.assert_close(loaded.base_frames, shape.base_frames)
    assert (loaded.side, loaded.thickness, loaded.fitted) == ("left", 1.1, fitted)
    content = json.loads(path.read_text())
    assert content["fitted"]["sigma"] == pytest.approx({"length": 0.02, "thumb": 0.03})
    for damage in ({"components": 3}, {"poses": "many"}, {"covariance": [[1]]}):
        path.write_text(json.dumps({**content, "fitted": {**content["fitted"], **damage}}))
        with pytest.raises(ToftrackError, match="damaged"):
            HandShape.load(path)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (None, "cannot be read"),
        ("{", "cannot be read"),
        ("[]", "not a hand shape"),
        ('{"format": "toftrack-hand-shape", "version": 9}', "version 9"),
        ('{"format": "toftrack-hand-shape", "version": 2}', "damaged"),
    ],
)
def test_a_bad_shape_file_is_one_clear_error(tmp_path, content, part) -> None:
    path = tmp_path / "shape.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ToftrackError, match=part):
        HandShape.load(path)


def test_an_unknown_side_or_an_impossible_length_is_refused() -> None:
    with pytest.raises(ToftrackError, match="hand.side"):
        default_hand_shape(side="both")
    with pytest.raises(ToftrackError, match="metres"):
        default_hand_shape(190.0)


def test_the_fingers_of_the_mean_hand_point_and_bend_as_they_do() -> None:
    """Directions and axes of flexion at rest, to half a degree: thumb to little finger."""
    frames = default_hand_shape().base_frames
    axes = torch.tensor(
        [
            [0.465, 0.628, -0.624],
            [0.997, 0.052, 0.052],
            [0.998, -0.070, 0.0],
            [0.974, -0.207, -0.087],
            [0.931, -0.321, -0.174],
        ]
    )
    directions = torch.tensor(
        [
            [0.649, -0.721, -0.242],
            [0.052, -0.999, 0.0],
            [-0.070, -0.998, 0.0],
            [-0.208, -0.978, 0.0],
            [-0.326, -0.946, 0.0],
        ]
    )
    assert (frames[:, :, 0] - axes).norm(dim=1).max() < 0.01
    assert (-frames[:, :, 1] - directions).norm(dim=1).max() < 0.01


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("thickness", -1.0),
        ("thickness", math.nan),
        ("bone_lengths_m", -0.03),
        ("bone_lengths_m", 1e6),
        ("base_m", math.inf),
        ("base_frames", 0.5),
    ],
)
def test_numbers_that_make_no_hand_are_refused(key: str, value: float, tmp_path: Path) -> None:
    default_hand_shape().save(tmp_path / "hand.json")
    content = json.loads((tmp_path / "hand.json").read_text())
    place: Any = content
    at: Any = key
    while isinstance(place[at], list):
        place, at = place[at], 0
    place[at] = value
    (tmp_path / "hand.json").write_text(json.dumps(content))
    with pytest.raises(ToftrackError, match="hand.json is a damaged hand shape file .its numbers"):
        HandShape.load(tmp_path / "hand.json")
