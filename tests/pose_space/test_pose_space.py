"""Pose spaces of every kind, the training poses, and model files."""

import json
import math
from functools import cache
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from helpers.tracking import configuration

from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES
from toftrack.pose_space.base import PoseSpace, clamped_share
from toftrack.pose_space.data.pose_data import GESTURES, PoseData, basic_pose, synthetic_data
from toftrack.pose_space.files import (
    KINDS,
    fit_pose_space,
    load_pose_space,
    make_pose_space,
    save_pose_space,
)
from toftrack.pose_space.kernel import barycentric_weights

LOW, HIGH = torch.tensor(ANGLE_LIMITS).unbind(1)
ANGLES = synthetic_data().angles_rad.float()
of_every_kind = pytest.mark.parametrize("kind", KINDS)


@cache
def fitted(kind: str, dims: int = 4) -> PoseSpace:
    return fit_pose_space(kind, dims)


def test_there_are_79_different_training_poses_within_the_joint_limits() -> None:
    poses = synthetic_data()
    assert poses.angles_rad.shape == (79, 21) and len(poses) == 79
    assert (ANGLES >= LOW - 1e-6).all() and (ANGLES <= HIGH + 1e-6).all()
    assert len(poses.angles_rad.unique(dim=0)) == 79


def test_the_basic_poses_are_what_their_names_say() -> None:
    flexion = [i for i, name in enumerate(ANGLE_NAMES) if "pip_flexion" in name]
    bent = {gesture: (basic_pose(gesture)[flexion] > 1.0).tolist() for gesture in GESTURES}
    assert bent == {"palm": [False] * 4, "fist": [True] * 4, "gun": [False, True, True, True]}


def test_four_components_explain_what_they_explain_in_the_paper() -> None:
    ratios = 100 * fitted("pca").explained_variance_ratio.cumsum(0)
    assert float(ratios[3]) == pytest.approx(97.5, abs=0.5)
    assert float(ratios[-1]) == pytest.approx(100.0, abs=1e-3)


def test_all_components_reproduce_every_training_pose() -> None:
    space = fitted("pca", 21)
    torch.testing.assert_close(space.decode(space.encode(ANGLES)), ANGLES, atol=1e-5, rtol=0)


def test_encoding_what_was_decoded_gives_the_latent_back_where_no_joint_limit_interferes() -> None:
    space = fitted("pca")
    latent = 0.5 * (space.training_latents - space.training_latents.mean(0))
    torch.testing.assert_close(space.encode(space.decode(latent)), latent, atol=1e-5, rtol=0)


@of_every_kind
def test_a_config_makes_its_space(kind: str) -> None:
    config = configuration(f"pose_space={kind}", "pose_space.dims=3")
    space = hydra.utils.instantiate(config.pose_space)
    assert (space.kind, space.dims) == (kind, 3)
    assert space.training_latents.shape == (79, 3)
    torch.testing.assert_close(space.lower, space.training_latents.amin(0))
    torch.testing.assert_close(space.upper, space.training_latents.amax(0))


@of_every_kind
@pytest.mark.parametrize(("dims", "degrees"), [(4, 3.0), (8, 2.5)])
def test_training_poses_come_back(kind: str, dims: int, degrees: float) -> None:
    space = fitted(kind, dims)
    residual = space.decode(space.encode(ANGLES)) - ANGLES
    assert math.degrees(float(residual.square().mean().sqrt())) < degrees
    off = (space.encode(ANGLES) - space.training_latents) / (space.upper - space.lower)
    assert float(off[:, :4].abs().max()) < 1e-2


@of_every_kind
def test_anything_decodes_to_finite_angles_within_the_joint_limits(kind: str) -> None:
    latent = 30 * torch.randn(500, 4, generator=torch.Generator().manual_seed(0))
    latent[0] = 1e4
    decoded = fitted(kind).decode(latent)
    assert decoded.isfinite().all()
    assert (decoded >= LOW).all() and (decoded <= HIGH).all()


@of_every_kind
def test_most_of_the_box_needs_no_joint_limit(kind: str) -> None:
    space = fitted(kind)
    unit = torch.rand(1000, 4, generator=torch.Generator().manual_seed(0))
    assert 0.0 < clamped_share(space, space.lower + unit * (space.upper - space.lower)) < 0.1


@of_every_kind
def test_decoding_is_smooth_from_particle_to_particle(kind: str) -> None:
    space = fitted(kind)
    step = 1e-3 * (space.upper - space.lower)
    moved = space.decode(space.training_latents + step) - space.decode(space.training_latents)
    assert math.degrees(float(moved.abs().max())) < 3.0


@of_every_kind
def test_rows_do_not_depend_on_the_batch_they_are_in(kind: str) -> None:
    space = fitted(kind)
    some, every = (space.decode(z) for z in (space.training_latents[5:9], space.training_latents))
    torch.testing.assert_close(some, every[5:9], atol=1e-4, rtol=0)
    torch.testing.assert_close(
        space.encode(ANGLES[5:6]), space.encode(ANGLES)[5:6], atol=1e-4, rtol=1e-4
    )


@of_every_kind
def test_a_model_file_of_any_kind_gives_the_same_space_and_says_its_sources(
    kind: str, tmp_path: Path
) -> None:
    space, data = fitted(kind), synthetic_data()
    save_pose_space(space, tmp_path / "model.npz", data.sources)
    loaded = load_pose_space(tmp_path / "model.npz")
    assert type(loaded) is type(space)
    latent = space.training_latents
    assert torch.equal(loaded.decode(latent), space.decode(latent))
    assert torch.equal(loaded.encode(ANGLES), space.encode(ANGLES))
    header = json.loads(str(np.load(tmp_path / "model.npz")["header"]))
    assert header["sources"] == list(data.sources)


@of_every_kind
def test_double_precision_agrees_with_single(kind: str) -> None:
    space = fitted(kind)
    latent = space.training_latents
    twice = space.to("cpu", torch.float64).decode(latent.double())
    torch.testing.assert_close(twice.float(), space.decode(latent), atol=5e-3, rtol=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@of_every_kind
def test_the_gpu_decodes_and_encodes_as_the_cpu(kind: str) -> None:
    space = fitted(kind)
    there, latent = space.to("cuda"), space.training_latents
    torch.testing.assert_close(
        there.decode(latent.cuda()).cpu(), space.decode(latent), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(
        there.encode(ANGLES.cuda()).cpu(), space.encode(ANGLES), atol=1e-2, rtol=1e-2
    )


@of_every_kind
@pytest.mark.parametrize("dims", [0, 50, 78, 500])
def test_too_many_or_no_dimensions_are_one_clear_error(kind: str, dims: int) -> None:
    if (kind, dims) == ("kernel_pca", 50):  # the one kind that may have more than there are angles
        assert fit_pose_space(kind, dims).dims == dims
        return
    with pytest.raises(ToftrackError, match=f"pose_space.dims={dims}"):
        fit_pose_space(kind, dims)


@pytest.mark.parametrize(
    ("kind", "setting", "part"),
    [
        ("pca", {"neighbours": 8}, "pose_space.neighbours is no setting of pca"),
        ("lle", {"gamma": 1.0}, "pose_space.gamma is no setting of lle, .* neighbours"),
        ("kernel_pca", {"gamma": -1.0}, "pose_space.gamma=-1.0 is not possible; .* above 0"),
        *(
            (kind, {"neighbours": n}, f"={n} is not")
            for kind in ("lle", "isomap")
            for n in (0, 4, 79)
        ),
    ],
)
def test_impossible_settings_are_refused(kind: str, setting: dict, part: str) -> None:
    with pytest.raises(ToftrackError, match=part):
        fit_pose_space(kind, 4, **setting)


@of_every_kind
def test_poses_that_are_all_the_same_make_no_space(kind: str) -> None:
    same = PoseData(basic_pose("palm").repeat(30, 1), ("a",) * 30, torch.zeros(30), ({},))
    with pytest.raises(ToftrackError, match="30 training poses are all the same"):
        fit_pose_space(kind, 4, same)


def test_a_space_of_other_dimensions_than_asked_for_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pca = KINDS["pca"]
    plane = fit_pose_space("pca", 2)
    monkeypatch.setattr(pca, "fit", lambda *_: plane)
    with pytest.raises(ToftrackError, match="pca learned 2 dimensions instead of 3"):
        fit_pose_space("pca", 3)


def test_a_wide_kernel_makes_the_coordinates_of_pca() -> None:
    wide = fit_pose_space("kernel_pca", 4, gamma=1e-4).training_latents
    flat = fitted("pca").training_latents
    sign = (wide * flat).sum(0).sign()
    torch.testing.assert_close(wide * sign, flat, atol=0.02, rtol=0)


def test_barycentric_weights_make_up_a_point_between_its_neighbours() -> None:
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [9.0, 9.0]])
    nearest, weights = barycentric_weights(torch.tensor([[0.25, 0.25]]), corners, 3)
    assert weights.sum().item() == pytest.approx(1.0)
    made = torch.einsum("nk,nkd->nd", weights, corners[nearest])
    torch.testing.assert_close(made, torch.tensor([[0.25, 0.25]]), atol=5e-3, rtol=0)


def rewrite(path: Path, header: dict, **arrays: np.ndarray | None) -> None:
    """Change parts of a model file; None leaves an array out."""
    content = dict(np.load(path)) | arrays
    content["header"] = np.array(json.dumps(json.loads(str(content["header"])) | header))
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


@pytest.mark.parametrize(
    ("header", "arrays", "part"),
    [
        ({"version": 99}, {}, "version 99"),
        ({"format": "other"}, {}, "not a pose-space file"),
        ({"kind": "hologram"}, {}, "the pose space kind 'hologram' is unknown; known are"),
        ({"angle_names": ["a", "b"]}, {}, "other joint angles"),
        ({"training_labels": ["palm"]}, {}, "bounds or labels do not fit"),
        ({}, {"mean": None}, "no array 'mean'"),
        ({}, {"lower": np.full(4, 9, np.float32)}, "bounds or labels do not fit"),
        ({}, {"upper": np.full(21, 9, np.float32)}, "of another size"),
        ({}, {"mean": np.full(21, np.nan, np.float32)}, "damaged"),
        ({}, {"components": np.zeros((4, 20), np.float32)}, "damaged"),
        ({}, {"mean": np.array([{}], dtype=object)}, "'mean' holds pickled objects"),
    ],
)
def test_a_bad_model_file_is_one_clear_error(tmp_path, header, arrays, part) -> None:
    path = tmp_path / "model.npz"
    save_pose_space(fitted("pca"), path)
    rewrite(path, header, **arrays)
    with pytest.raises(ToftrackError, match=part) as error:
        load_pose_space(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_missing_or_no_archive_is_one_clear_error(tmp_path) -> None:
    with pytest.raises(ToftrackError, match="nothing.npz is not a pose-space .*toftrack train"):
        load_pose_space(tmp_path / "nothing.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ToftrackError, match="not a pose-space file .it is no .npz"):
        load_pose_space(tmp_path / "text.npz")


def test_a_model_of_another_size_than_configured_is_refused(tmp_path) -> None:
    save_pose_space(fitted("pca", 3), tmp_path / "model.npz")
    with pytest.raises(ToftrackError, match="3-dimensional.*pose_space.dims=3"):
        make_pose_space("pca", 4, str(tmp_path / "model.npz"))
