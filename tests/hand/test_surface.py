"""Where the flesh lies about the bones."""

import math

import torch
from torch import Tensor

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface, parted

SHAPE = default_hand_shape().to(torch.float64)
SURFACE = hand_surface(SHAPE)


def bent_hands(n: int) -> Tensor:
    """Hands in any pose within the joint limits, at the origin."""
    low, high = torch.tensor(ANGLE_LIMITS, dtype=torch.float64).T
    part = torch.rand(n, 21, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.cat((torch.zeros(n, 6, dtype=torch.float64), low + part * (high - low)), 1)


def depth_inside(points: Tensor, flesh: Ellipsoids) -> Tensor:
    """(N, P, 3) to (N, P): 0 in the middle of the nearest ellipsoid, 1 on the surface."""
    whiten = flesh.axes_m.mT / flesh.axes_m.square().sum(-2)[..., None]
    offset = points[:, None] - flesh.centres_m[:, :, None]
    return torch.einsum("neij,nepj->nepi", whiten, offset).norm(dim=-1).amin(1)


def last_ellipsoid(finger: int) -> int:
    return int((SURFACE.frame_index == 3 + 3 * finger).nonzero()[0])


def test_the_last_ellipsoid_of_every_finger_ends_at_its_tip() -> None:
    pose = forward_kinematics(bent_hands(5), SHAPE)
    flesh = SURFACE.pose(pose)
    for finger in range(5):
        index, frame = last_ellipsoid(finger), pose.frames[:, 3 + 3 * finger]
        end = flesh.centres_m[:, index] - flesh.axes_m[:, index, :, 1]
        beyond = ((end - pose.joints_m[:, 4 + 4 * finger]) * frame[:, :, 1]).sum(1)
        torch.testing.assert_close(beyond, torch.zeros(5, dtype=torch.float64), atol=1e-9, rtol=0)


def test_bones_lie_within_the_flesh_however_the_fingers_bend() -> None:
    """No gap opens at a joint, though only the first has an ellipsoid of its own."""
    pose = forward_kinematics(bent_hands(200), SHAPE)
    flesh, _ = parted(SURFACE.pose(pose))
    ends = pose.joints_m[:, 1:].unflatten(1, (5, 4))
    for part in (0.0, 0.25, 0.5, 0.75):
        points = ends[:, :, :-1] + part * ends.diff(dim=2)
        assert depth_inside(points.flatten(1, 2), flesh).max() < 1


def test_there_is_more_flesh_on_the_palm_side_of_the_fingers() -> None:
    for index in range(len(SURFACE.frame_index) - 1):
        if SURFACE.frame_index[index] > 0:
            assert SURFACE.centres_m[index, 2] < 0
    # But the bone is not at the back's skin either: half a finger's thickness at most.
    thickest = SURFACE.axes_m[:-1, 2, 2].abs()
    assert (SURFACE.centres_m[:-1, 2].abs() < 0.5 * thickest)[SURFACE.frame_index[:-1] > 0].all()


def test_both_hands_have_the_same_flesh() -> None:
    """Only the skeleton is mirrored."""
    shape = default_hand_shape(side="left").to(torch.float64)
    torch.testing.assert_close(hand_surface(shape).axes_m, SURFACE.axes_m)


def test_a_palm_is_as_thick_and_a_finger_as_broad_as_people_have_them() -> None:
    """Garrett, "The adult human hand", Human Factors 13(2), 1971: 28 mm, index finger 18 to 21."""
    middle = forward_kinematics(torch.zeros(1, 27, dtype=torch.float64), SHAPE)
    flesh, _ = parted(SURFACE.pose(middle))
    z = torch.linspace(-0.05, 0.05, 401, dtype=torch.float64)
    column = torch.stack((0 * z, torch.full_like(z, -0.055), z), 1)[None]
    thick = 0.1 * float((depth_inside(column, flesh) < 1).double().mean())
    assert 0.022 < thick < 0.036
    broad = 2 * float(SURFACE.axes_m[int((SURFACE.frame_index == 5).nonzero()[0]), 0, 0])
    assert math.isclose(broad, 0.019, abs_tol=0.003)
