"""Pose spaces: training poses, PCA, model files."""

import json

import numpy as np
import pytest
import torch

from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES
from toftrack.pose_space.data.pose_data import PoseData
from toftrack.pose_space.data.training_poses import GESTURES, basic_pose, synthetic_training_poses
from toftrack.pose_space.files import (
    fit_pose_space,
    load_pose_space,
    make_pose_space,
    save_pose_space,
)
from toftrack.pose_space.pca import fit_pca

LIMITS = torch.tensor(ANGLE_LIMITS)


def test_there_are_79_training_poses_within_the_joint_limits() -> None:
    poses = synthetic_training_poses()
    assert poses.angles_rad.shape == (79, 21)
    assert len(poses.labels) == 79
    assert (poses.angles_rad >= LIMITS[:, 0] - 1e-9).all()
    assert (poses.angles_rad <= LIMITS[:, 1] + 1e-9).all()
    assert len(poses.angles_rad.unique(dim=0)) == 79


def test_the_basic_poses_are_what_their_names_say() -> None:
    flexion = [i for i, name in enumerate(ANGLE_NAMES) if "pip_flexion" in name]
    bent = {gesture: basic_pose(gesture)[flexion] > 1.0 for gesture in GESTURES}
    assert bent["palm"].tolist() == [False] * 4
    assert bent["fist"].tolist() == [True] * 4
    assert bent["gun"].tolist() == [False, True, True, True]


def test_four_components_explain_what_they_explain_in_the_paper() -> None:
    ratios = 100 * fit_pose_space("pca", 4).explained_variance_ratio.cumsum(0)
    assert float(ratios[3]) == pytest.approx(97.5, abs=0.5)
    assert float(ratios[-1]) == pytest.approx(100.0, abs=1e-3)


def test_all_components_reproduce_every_training_pose() -> None:
    poses = synthetic_training_poses()
    space = fit_pca(poses.angles_rad, poses.labels, 21)
    angles = poses.angles_rad.float()
    torch.testing.assert_close(space.decode(space.encode(angles)), angles, atol=1e-5, rtol=0)


def test_encoding_what_was_decoded_gives_the_latent_back_where_no_joint_limit_interferes() -> None:
    space = fit_pose_space("pca", 4)
    latent = 0.5 * (space.training_latents - space.training_latents.mean(0))
    torch.testing.assert_close(space.encode(space.decode(latent)), latent, atol=1e-5, rtol=0)


def test_the_bounds_are_the_extremes_of_the_training_poses() -> None:
    space = fit_pose_space("pca", 4)
    latents = space.encode(synthetic_training_poses().angles_rad.float())
    torch.testing.assert_close(space.lower, latents.amin(0), atol=1e-5, rtol=0)
    torch.testing.assert_close(space.upper, latents.amax(0), atol=1e-5, rtol=0)


def rewrite(path, **changes) -> None:
    """Change parts of a model file; None leaves an array out."""
    with np.load(path) as archive:
        content = {name: archive[name] for name in archive.files}
    header = json.loads(str(content["header"])) | changes.pop("header", {})
    content |= {"header": np.array(json.dumps(header))} | changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"header": {"version": 99}}, "version 99"),
        ({"header": {"format": "other"}}, "not a pose-space file"),
        ({"header": {"kind": "hologram"}}, "unknown kind 'hologram'; known: isomap"),
        ({"header": {"angle_names": ["a", "b"]}}, "other joint angles"),
        ({"mean": None}, "no array 'mean'"),
        ({"lower": np.full(4, 9, np.float32)}, "bounds or labels do not fit"),
        ({"header": {"training_labels": ["palm"]}}, "bounds or labels do not fit"),
        ({"upper": np.full(21, 9, np.float32)}, "of another size"),
        ({"mean": np.full(21, np.nan, np.float32)}, "damaged"),
        ({"components": np.zeros((4, 20), np.float32)}, "damaged"),
        ({"mean": np.array([{}], dtype=object)}, "'mean' holds pickled objects"),
    ],
)
def test_a_bad_model_file_is_one_clear_error(tmp_path, changes, part) -> None:
    path = tmp_path / "model.npz"
    save_pose_space(fit_pose_space("pca", 4), path)
    rewrite(path, **changes)
    with pytest.raises(ToftrackError, match=part) as error:
        load_pose_space(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_missing_or_no_archive_is_one_clear_error(tmp_path) -> None:
    with pytest.raises(ToftrackError, match="no pose-space file"):
        load_pose_space(tmp_path / "nothing.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ToftrackError, match="not a pose-space file .it is no .npz") as error:
        load_pose_space(tmp_path / "text.npz")
    assert "pickle" not in str(error.value)
    whole = tmp_path / "whole.npz"
    save_pose_space(fit_pose_space("pca", 4), whole)
    content = bytearray(whole.read_bytes())
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(ToftrackError, match="not a pose-space file .it is no .npz archive, or cut"):
        load_pose_space(tmp_path / "cut.npz")
    content[200:300] = bytes(100)
    (tmp_path / "scratched.npz").write_bytes(content)
    with pytest.raises(ToftrackError, match="is damaged"):
        load_pose_space(tmp_path / "scratched.npz")


def test_a_model_of_another_size_than_configured_is_refused(tmp_path) -> None:
    save_pose_space(fit_pose_space("pca", 3), tmp_path / "model.npz")
    with pytest.raises(ToftrackError, match="pose_space.dims=3"):
        make_pose_space("pca", 4, str(tmp_path / "model.npz"))


@pytest.mark.parametrize("kind", ["pca", "kernel_pca", "lle", "isomap"])
def test_poses_that_are_all_the_same_make_no_space(kind: str) -> None:
    same = PoseData(basic_pose("palm").repeat(30, 1), ("a",) * 30, torch.zeros(30), ({},))
    with pytest.raises(ToftrackError, match="30 training poses are all the same"):
        fit_pose_space(kind, 4, same)


@pytest.mark.parametrize("dims", [0, 22])
def test_impossible_dimensions_are_refused(dims: int) -> None:
    with pytest.raises(ToftrackError, match="pose_space.dims"):
        fit_pose_space("pca", dims)
