"""Every kind of pose space: what they have in common, and their speed."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_LIMITS
from toftrack.pose_space import isomap, kernel_pca, lle
from toftrack.pose_space.base import PoseSpace, clamped_share
from toftrack.pose_space.data.pose_data import synthetic_data
from toftrack.pose_space.files import (
    fit_pose_space,
    load_pose_space,
    pose_space_kinds,
    save_pose_space,
)
from toftrack.pose_space.neighbours import barycentric_weights

CONF = str(Path(__file__).parents[2] / "conf")
KINDS = ("pca", "kernel_pca", "lle", "isomap")
CURVED = KINDS[1:]
LIMITS = torch.tensor(ANGLE_LIMITS)


@cache
def fitted(kind: str, dims: int = 4) -> PoseSpace:
    return fit_pose_space(kind, dims)


def angles() -> torch.Tensor:
    return synthetic_data().angles_rad.float()


def test_every_module_with_a_space_is_a_kind_and_has_a_config() -> None:
    assert set(pose_space_kinds()) == set(KINDS)
    configs = {path.stem for path in (Path(CONF) / "pose_space").glob("*.yaml")}
    assert configs == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_config_makes_its_space(kind: str) -> None:
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("config", [f"pose_space={kind}", "pose_space.dims=3"])
    space = hydra.utils.instantiate(config.pose_space)
    assert isinstance(space, PoseSpace)
    assert (space.kind, space.dims) == (kind, 3)
    assert space.lower.shape == space.upper.shape == (3,)
    assert space.training_latents.shape == (79, 3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("dims", "degrees"), [(4, 3.0), (8, 2.5)])
def test_training_poses_come_back(kind: str, dims: int, degrees: float) -> None:
    space = fitted(kind, dims)
    residual = space.decode(space.encode(angles())) - angles()
    assert math.degrees(float(residual.square().mean().sqrt())) < degrees


@pytest.mark.parametrize("kind", KINDS)
def test_training_poses_are_encoded_to_their_own_latents(kind: str) -> None:
    space = fitted(kind)
    off = (space.encode(angles()) - space.training_latents) / (space.upper - space.lower)
    assert float(off.abs().max()) < 1e-2


@pytest.mark.parametrize("kind", KINDS)
def test_anything_decodes_to_finite_angles_within_the_joint_limits(kind: str) -> None:
    space = fitted(kind)
    latent = 30 * torch.randn(500, 4, generator=torch.Generator().manual_seed(0))
    latent[0] = 1e4
    decoded = space.decode(latent)
    assert decoded.isfinite().all()
    assert (decoded >= LIMITS[:, 0]).all() and (decoded <= LIMITS[:, 1]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_most_of_the_box_needs_no_joint_limit(kind: str) -> None:
    space = fitted(kind)
    unit = torch.rand(1000, 4, generator=torch.Generator().manual_seed(0))
    share = clamped_share(space, space.lower + unit * (space.upper - space.lower))
    assert 0.0 < share < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_decoding_is_smooth_from_particle_to_particle(kind: str) -> None:
    space = fitted(kind)
    step = 1e-3 * (space.upper - space.lower)
    moved = space.decode(space.training_latents + step) - space.decode(space.training_latents)
    assert math.degrees(float(moved.abs().max())) < 3.0


@pytest.mark.parametrize("kind", KINDS)
def test_rows_do_not_depend_on_the_batch_they_are_in(kind: str) -> None:
    space = fitted(kind)
    some = space.training_latents[5:9]
    torch.testing.assert_close(
        space.decode(some), space.decode(space.training_latents)[5:9], atol=1e-4, rtol=0
    )
    torch.testing.assert_close(
        space.encode(angles()[5:6]), space.encode(angles())[5:6], atol=1e-4, rtol=1e-4
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_file_of_any_kind_gives_the_same_space_and_says_its_sources(
    kind: str, tmp_path: Path
) -> None:
    space, data = fitted(kind), synthetic_data()
    save_pose_space(space, tmp_path / "model.npz", data.sources)
    loaded = load_pose_space(tmp_path / "model.npz")
    assert type(loaded) is type(space)
    latent = space.training_latents
    assert torch.equal(loaded.decode(latent), space.decode(latent))
    assert torch.equal(loaded.encode(angles()), space.encode(angles()))
    header = json.loads(str(np.load(tmp_path / "model.npz")["header"]))
    assert header["sources"] == list(data.sources)


@pytest.mark.parametrize("kind", KINDS)
def test_double_precision_agrees_with_single(kind: str) -> None:
    space = fitted(kind)
    twice = space.to("cpu", torch.float64)
    latent = space.training_latents
    torch.testing.assert_close(
        twice.decode(latent.double()).float(), space.decode(latent), atol=5e-3, rtol=0
    )


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("kind", KINDS)
def test_the_gpu_decodes_and_encodes_as_the_cpu(kind: str) -> None:
    space = fitted(kind)
    there = space.to("cuda")
    latent = space.training_latents
    torch.testing.assert_close(
        there.decode(latent.cuda()).cpu(), space.decode(latent), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(
        there.encode(angles().cuda()).cpu(), space.encode(angles()), atol=1e-2, rtol=1e-2
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dims", [0, 78, 500])
def test_too_many_or_no_dimensions_are_one_clear_error(kind: str, dims: int) -> None:
    with pytest.raises(ToftrackError, match=f"pose_space.dims={dims}"):
        fit_pose_space(kind, dims)


@pytest.mark.parametrize("module", [lle, isomap])
@pytest.mark.parametrize("neighbours", [0, 4, 79])
def test_impossible_numbers_of_neighbours_are_refused(module, neighbours: int) -> None:
    data = synthetic_data()
    with pytest.raises(ToftrackError, match="neighbours"):
        module.fit(data.angles_rad, data.labels, 4, neighbours=neighbours)


def test_a_setting_of_another_kind_is_one_clear_error() -> None:
    with pytest.raises(ToftrackError, match="pose_space.neighbours is no setting of pca"):
        fit_pose_space("pca", 4, neighbours=8)
    with pytest.raises(ToftrackError, match="pose_space.gamma is no setting of lle, .* neighbours"):
        fit_pose_space("lle", 4, gamma=1.0)


def test_a_wide_kernel_makes_the_coordinates_of_pca() -> None:
    data = synthetic_data()
    wide = kernel_pca.fit(data.angles_rad, data.labels, 4, gamma=1e-4).training_latents
    flat = fitted("pca").training_latents
    sign = (wide * flat).sum(0).sign()
    torch.testing.assert_close(wide * sign, flat, atol=0.02, rtol=0)


def test_barycentric_weights_make_up_a_point_between_its_neighbours() -> None:
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [9.0, 9.0]])
    nearest, weights = barycentric_weights(torch.tensor([[0.25, 0.25]]), corners, 3)
    assert weights.sum().item() == pytest.approx(1.0)
    made = torch.einsum("nk,nkd->nd", weights, corners[nearest])
    torch.testing.assert_close(made, torch.tensor([[0.25, 0.25]]), atol=5e-3, rtol=0)
