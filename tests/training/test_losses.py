"""What the networks are trained for: nothing is lost by the truth, and a little training helps."""

import pytest
import roma
import torch
from helpers.detection import dice, small_bank

from toftrack.detector.network import (
    PARTS,
    SEGMENTS,
    STRIDE,
    Finder,
    Found,
    PoseNet,
    Proposed,
    cube_rotations,
)
from toftrack.training.dice import Dice
from toftrack.training.hands import random_rotations
from toftrack.training.images import WIDE_SIZE, Crops, WideImages, crop_images, wide_images
from toftrack.training.losses import finder_loss, hypothesis_joints, pose_losses
from toftrack.training.shown_poses import shown_poses

N = 6


def truth() -> Crops:
    """Mean hands of several sizes, all right ones that are there."""
    generator = torch.Generator().manual_seed(0)
    rotation = random_rotations(N, dice())
    angles = shown_poses(N, Dice(generator))
    log_size = 0.1 * torch.randn(N, generator=generator)
    pivot = 0.02 * torch.randn(N, 3, generator=generator)
    yes = torch.ones(N, dtype=torch.bool)
    return Crops(
        image=torch.zeros(N, 3, 64, 64),
        parts=torch.randint(SEGMENTS, (N, PARTS, PARTS), generator=generator),
        present=yes,
        right=yes,
        pivot_m=pivot,
        rotation=rotation,
        angles=angles,
        log_size=log_size,
        joints_m=hypothesis_joints(rotation, angles, log_size, pivot),
    )


def perfect(crops: Crops) -> Proposed:
    """The answer of a network that knows; all hypotheses are the truth."""

    def each(value: torch.Tensor) -> torch.Tensor:
        return value[:, None].expand(-1, 24, *value.shape[1:]).clone()

    angle = roma.rotmat_geodesic_distance(
        each(crops.rotation), cube_rotations().expand(N, -1, 3, 3)
    )
    sign = torch.ones(N) * 20
    return Proposed(
        rotation=each(crops.rotation),
        angles=each(crops.angles),
        log_size=each(crops.log_size),
        pivot_m=each(crops.pivot_m),
        log_probability=torch.log_softmax(-0.5 * (angle / 0.35).square(), 1),
        error_m=torch.full((N, 24), 0.003),
        joints_m=crops.joints_m.clone(),
        sigma_m=torch.full((N, 21), 0.001),
        right=torch.where(crops.right, sign, -sign),
        present=torch.where(crops.present, sign, -sign),
        parts=20.0 * torch.nn.functional.one_hot(crops.parts, SEGMENTS).permute(0, 3, 1, 2),
    )


def test_the_truth_has_no_error() -> None:
    crops = truth()
    _, reported = pose_losses(perfect(crops), crops, cube_rotations())
    assert reported["joints_mm"] < 0.01 and reported["keypoints_mm"] < 0.01
    assert all(reported[name] == 1 for name in ("within_20_mm", "side", "present"))


@pytest.mark.parametrize(
    "name", ["rotation", "angles", "log_size", "pivot_m", "joints_m", "right", "present", "parts"]
)
def test_whatever_is_wrong_costs(name: str) -> None:
    crops = truth()
    right = perfect(crops)
    value = getattr(right, name)
    if name == "rotation":
        wrong = value @ roma.rotvec_to_rotmat(torch.tensor([0.3, 0.0, 0.0]))
    elif name in ("right", "present", "parts"):
        wrong = -value
    else:
        wrong = value + 0.05
    before = pose_losses(right, crops, cube_rotations())[0]
    after = pose_losses(right._replace(**{name: wrong}), crops, cube_rotations())[0]
    assert float(after) > float(before) + 0.01


def test_the_poses_of_left_and_absent_hands_are_not_trained() -> None:
    crops = truth()
    left = torch.zeros(N, dtype=torch.bool)
    left[2:4] = True
    crops = crops._replace(right=~left)
    right = perfect(crops)
    moved = right.pivot_m.clone()
    moved[left] += 0.1
    anchors = cube_rotations()
    one = pose_losses(right, crops, anchors)[0]
    two = pose_losses(right._replace(pivot_m=moved), crops, anchors)[0]
    assert float(one) == pytest.approx(float(two))


def found_at(images: WideImages) -> Found:
    """What a finder says that knows."""
    n = len(images.depth_m)
    h, w = WIDE_SIZE[0] // STRIDE, WIDE_SIZE[1] // STRIDE
    v, u = torch.arange(h)[:, None], torch.arange(w)
    heat = torch.full((n, h, w), -12.0)
    column, row, depth = (torch.zeros(n, h, w) for _ in range(3))
    for i in range(n):
        for hand in range(2):
            x, y = images.cell[i, hand]
            if images.seen[i, hand] <= 0.15:
                continue
            bump = torch.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 0.7**2)
            p = torch.where(bump >= bump.max(), 1.0, bump).clamp(1e-5, 1 - 1e-5)
            heat[i] = torch.maximum(heat[i], p.logit())
            near = ((u - x).abs() < 1.5) & ((v - y).abs() < 1.5)
            column[i] = torch.where(near, x - u, column[i])
            row[i] = torch.where(near, y - v, row[i])
            depth[i] = torch.where(near, images.depth_m[i, hand].log(), depth[i])
    return Found(heat, column, row, depth)


def test_a_finder_that_knows_loses_little() -> None:
    images = wide_images(8, small_bank(), torch.Generator().manual_seed(5))
    images = images._replace(seen=images.seen * torch.tensor([1.0, 0.0]))  # one hand in each
    known = found_at(images)
    blind = known._replace(heat=torch.full_like(known.heat, -5.0))
    wrong = known._replace(log_depth=known.log_depth + 0.5)
    costs = [float(finder_loss(found, images)) for found in (known, blind, wrong)]
    assert costs[0] < 0.3 and costs[1] > costs[0] + 1 and costs[2] > costs[0] + 0.2


def test_a_finder_learns_from_images_without_any_hand() -> None:
    images = wide_images(4, small_bank(), torch.Generator().manual_seed(5))
    images = images._replace(seen=torch.zeros_like(images.seen))
    quiet = found_at(images)
    loud = quiet._replace(heat=torch.zeros_like(quiet.heat))
    assert float(finder_loss(quiet, images)) < 0.01 < float(finder_loss(loud, images))


@pytest.mark.parametrize("kind", ["pose", "finder"])
def test_the_loss_falls_within_a_few_steps(kind: str) -> None:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    if kind == "pose":
        network, batch = PoseNet(4), crop_images(16, small_bank(), generator)
    else:
        network, batch = Finder(8), wide_images(16, small_bank(), generator)
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), 3e-3)
    course = []
    for _ in range(30):
        said = network(batch.image)
        if kind == "pose":
            loss = pose_losses(said, batch, network.anchors)[0]
        else:
            loss = finder_loss(said, batch)
        optimiser.zero_grad()
        loss.backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())
        optimiser.step()
        course.append(float(loss))
    assert max(course[-5:]) < min(course[:2])
