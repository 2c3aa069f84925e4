"""Poses that people show: of the frequencies that are written down, and as people make them."""

import torch
from helpers.detection import dice

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.pose_space.base import clamp_to_joint_limits
from toftrack.training import shown_poses as poses

N = 400
NAMES = [shown.name for shown in poses.SHOWN]


def joints(name: str) -> torch.Tensor:
    """(N, 21, 3) of default hands that show something, metres."""
    rows = torch.full((N,), NAMES.index(name))
    angles = clamp_to_joint_limits(poses.shown_only(N, dice(), rows))
    state = torch.cat((torch.zeros(N, 6), angles), 1)
    return forward_kinematics(state, default_hand_shape()).joints_m


def test_poses_are_within_the_limits_and_the_same_again_from_a_seed() -> None:
    angles = poses.shown_poses(N, dice())
    low, high = torch.tensor(ANGLE_LIMITS).unbind(1)
    assert angles.shape == (N, 21) and angles.isfinite().all()
    assert (angles >= low).all() and (angles <= high).all()
    assert torch.equal(angles, poses.shown_poses(N, dice()))
    assert not torch.equal(angles, poses.shown_poses(N, dice(1)))


def test_the_tips_of_a_fist_lie_on_the_palm_also_over_knuckles_that_are_hardly_bent() -> None:
    """Palms are 13 mm and tips 7 mm thick on that side of the bones, of a hand of 190 mm."""
    bent = clamp_to_joint_limits(
        poses.shown_only(N, dice(), torch.full((N,), NAMES.index("fist")))
    )[:, 6::4].rad2deg()
    flat = bent.mean(1) < 55
    assert 0.2 < float(flat.float().mean()) < 0.5
    above = -1e3 * joints("fist")[:, 8::4, 2]
    for some in (flat, ~flat):
        assert 15 < float(above[some].quantile(0.1)) and float(above[some].quantile(0.9)) < 36
    hooks = -1e3 * joints("hook")[:, 8::4, 2]
    assert float(hooks.median()) > 40


def test_fingers_of_a_flat_hand_touch_and_those_of_a_palm_do_not() -> None:
    def gaps(name: str) -> torch.Tensor:
        """(N, 3) mm between the middle joints of neighbouring fingers, across the hand."""
        across = joints(name)[:, 7::4, 0]
        return 1e3 * across.diff(dim=1).abs().flatten()

    assert 13 < float(gaps("flat").median()) < 21
    assert float(gaps("palm").median()) > 1.25 * float(gaps("flat").median())


def test_a_thumb_that_is_up_points_away_from_the_fist() -> None:
    away = {
        name: float((joints(name)[:, 4] - joints(name)[:, 6]).norm(dim=1).median())
        for name in ("thumb up", "fist")
    }
    assert away["thumb up"] > 0.07 and away["fist"] < 0.05


def test_single_fingers_stand_alone() -> None:
    for name, up in (("point", 0), ("little", 3), ("middle", 1)):
        points = joints(name)
        reach = (points[:, 8::4] - points[:, 5::4]).norm(dim=2)
        assert (reach.argmax(1) == up).float().mean() > 0.97, name


def test_the_thumb_pinches_with_every_finger() -> None:
    pairs = poses.touching_pairs()
    assert min(len(thumbs) for thumbs, _ in pairs) > 20
    flat = torch.zeros(N, 21)
    pinched = poses.pinched(flat, dice())
    state = torch.cat((torch.zeros(N, 6), pinched), 1)
    tips = forward_kinematics(state, default_hand_shape()).joints_m[:, 4::4]
    gaps = (tips[:, 1:] - tips[:, :1]).norm(dim=2)
    assert float(gaps.amin(1).max()) < 0.0201
    share = torch.bincount(gaps.argmin(1), minlength=4) / N
    assert (share > 0.15).all(), "each finger about as often"
