"""Recorded motion as poses to learn from: inverse kinematics, reading, repeated clips."""

from __future__ import annotations

import math
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, forward_kinematics
from toftrack.pose_space.data.leap import leap_data
from toftrack.pose_space.inverse_kinematics import fit_angles, joint_jacobian, shape_of_joints

CONF = str(Path(__file__).parents[2] / "conf")
LIMITS = torch.tensor(ANGLE_LIMITS, dtype=torch.float64)


def random_angles(count: int, seed: int = 0, part: float = 0.6) -> torch.Tensor:
    """Poses in the inner part of the joint limits, (count, 21) float64."""
    unit = torch.rand(count, 21, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return LIMITS.mean(1) + part * (unit - 0.5) * (LIMITS[:, 1] - LIMITS[:, 0])


def joints_of(angles: torch.Tensor, scale: float = 1.0, seed: int = 0) -> torch.Tensor:
    """(T, 5, 4, 3) metres of hands anywhere in space."""
    generator = torch.Generator().manual_seed(seed)
    placed = torch.randn(len(angles), 6, generator=generator, dtype=torch.float64)
    shape = default_hand_shape().to(torch.float64).scaled(scale)
    joints = forward_kinematics(torch.cat((placed, angles), 1), shape).joints_m[:, 1:]
    return joints.unflatten(1, (5, 4))


def test_inverse_kinematics_finds_the_angles_that_the_joints_were_made_from() -> None:
    angles = random_angles(30)
    fit = fit_angles(joints_of(angles), default_hand_shape(), iterations=40, prior=1e-9)
    assert float(fit.error_m.max()) < 1e-5
    assert math.degrees(float((fit.angles_rad - angles).abs().max())) < 0.1


def test_inverse_kinematics_stays_within_the_joint_limits() -> None:
    angles = random_angles(20, part=1.5)
    fit = fit_angles(joints_of(angles), default_hand_shape())
    assert (fit.angles_rad >= LIMITS[:, 0] - 1e-9).all()
    assert (fit.angles_rad <= LIMITS[:, 1] + 1e-9).all()
    assert float(fit.error_m.mean()) < 0.01


def test_the_jacobian_of_the_joints_agrees_with_differences() -> None:
    shape = default_hand_shape().to(torch.float64)
    state = torch.cat((torch.zeros(3, 6, dtype=torch.float64), random_angles(3)), 1)
    jacobian = joint_jacobian(forward_kinematics(state, shape), shape)
    step = 1e-6
    for column in range(27):
        moved = [state.clone(), state.clone()]
        moved[0][:, column] += step
        moved[1][:, column] -= step
        high, low = (forward_kinematics(s, shape).joints_m[:, 1:].flatten(1) for s in moved)
        torch.testing.assert_close(
            jacobian[..., column], (high - low) / (2 * step), atol=1e-8, rtol=0
        )


def test_a_recorded_hand_gives_its_own_bones() -> None:
    shape = shape_of_joints(joints_of(random_angles(10), scale=0.9), default_hand_shape())
    expected = default_hand_shape().scaled(0.9)
    torch.testing.assert_close(shape.bone_lengths_m, expected.bone_lengths_m, atol=1e-6, rtol=0)
    torch.testing.assert_close(shape.base_m, expected.base_m, atol=1e-5, rtol=0)


@pytest.mark.parametrize("bad", ["shape", "nan"])
def test_joints_that_are_none_are_refused(bad: str) -> None:
    joints = torch.zeros(3, 20, 3) if bad == "shape" else torch.full((3, 5, 4, 3), torch.nan)
    with pytest.raises(ToftrackError):
        fit_angles(joints, default_hand_shape())


def motion(frames: int, seed: int) -> torch.Tensor:
    """A smooth movement between random poses, (frames, 21)."""
    ends = random_angles(2, seed)
    return torch.lerp(ends[0], ends[1], torch.linspace(0, 1, frames).double()[:, None])


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Two right-handed clips, the first again at half rate, and a left-handed clip."""
    first, second, third = (
        joints_of(motion(40, 1), seed=1),
        joints_of(motion(30, 2), 1.1, seed=2),
        joints_of(motion(20, 3), 0.9, seed=3) * torch.tensor([-1.0, 1.0, 1.0]),
    )
    clips = [first[::2], first, second, third]
    path = tmp_path / "joints.npz"
    np.savez(
        path,
        joints_mm=torch.cat(clips).numpy().astype(np.float32) * 1e3,
        is_left=np.repeat([False, False, False, True], [20, 40, 30, 20]),
        seq_name=np.array(["a-half.json.lz", "a.json.lz", "b.json.lz", "c.json.lz"]),
        seq_len=np.array([20, 40, 30, 20]),
    )
    return path


def test_recorded_motion_becomes_joint_angles(recorded: Path) -> None:
    data = leap_data(str(recorded), poses=None, worst_fit_mm=10.0)
    assert list(dict.fromkeys(data.labels)) == ["a", "b", "c"]
    assert data.clips.tolist() == [0] * 40 + [1] * 30 + [2] * 20
    source = data.sources[0]
    assert source["file"] == "joints.npz" and source["clips"] == ["a", "b", "c"]
    assert source["fit_mean_mm"] < 1.0
    expected = torch.cat((motion(40, 1), motion(30, 2), motion(20, 3)))
    # The palm's direction is a convention: all abductions may be off by the same turn.
    flexions = [i for i, name in enumerate(ANGLE_NAMES) if "flexion" in name and i > 4]
    off = (data.angles_rad - expected)[:, flexions]
    assert math.degrees(float(off.square().mean().sqrt())) < 6.0
    assert "1 repeat another" in data.notes[0] and "20 of 110" in data.notes[0]


def test_a_recording_is_thinned_to_poses_that_cover_it(recorded: Path) -> None:
    data = leap_data(str(recorded), poses=12, worst_fit_mm=10.0)
    assert len(data) == 12
    assert set(data.labels) == {"a", "b", "c"}


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"joints_mm": None}, "joints_mm"),
        ({"seq_len": np.array([1, 2, 3, 4])}, "10 frames together"),
        ({"joints_mm": np.zeros((110, 5, 3, 3), np.float32)}, "not a file of recorded joints"),
        ({"joints_mm": np.full((110, 5, 4, 3), np.nan, np.float32)}, "NaN"),
        ({"seq_name": np.array([{}] * 4, dtype=object)}, "not a readable"),
    ],
)
def test_a_bad_recording_is_one_clear_error(recorded: Path, changes: dict, part: str) -> None:
    with np.load(recorded) as archive:
        content = {name: archive[name] for name in archive.files} | changes
    np.savez(recorded, **{name: value for name, value in content.items() if value is not None})
    with pytest.raises(ToftrackError, match=part) as error:
        leap_data(str(recorded), None, 10.0)
    assert str(recorded) in str(error.value)


def test_sources_are_mixed_by_the_configuration(recorded: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.npz"
    np.savez(mine, angles=random_angles(6).numpy(), units=np.array("radians"))
    more = ["+data@data.parts.mine=file", f"data.parts.mine.path={mine}", "data.poses=30"]
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose(
            "train_pose_space", ["data=mixture", f"data.parts.leap.path={recorded}", *more]
        )
    data = hydra.utils.instantiate(config.data)
    assert [source["data"] for source in data.sources] == ["synthetic", "leap", "file"]
    assert len(data) == 30 + 30 + 6
