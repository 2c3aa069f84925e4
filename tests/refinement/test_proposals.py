"""Poses to try beside the one that was found."""

from __future__ import annotations

import torch

from toftrack.hand.skeleton import ANGLE_NAMES, FINGERS
from toftrack.refinement.proposals import exchange_fingers


def test_every_finger_of_every_pose_is_tried_once() -> None:
    state = torch.arange(27.0)[None]
    poses = 100.0 + torch.arange(2 * 21.0).view(2, 21)
    tried = exchange_fingers(state, poses)
    assert tried.shape == (2 * len(FINGERS), 27)
    assert torch.equal(tried[:, :6], state[:, :6].expand(10, 6))
    taken = []
    for row in tried:
        changed = (row[6:] != state[0, 6:]).nonzero()[:, 0].tolist()
        fingers = {ANGLE_NAMES[angle].split("_")[0] for angle in changed}
        assert len(fingers) == 1, "one finger at a time"
        source = [i for i, pose in enumerate(poses) if torch.equal(row[6:][changed], pose[changed])]
        finger = fingers.pop()
        assert changed == [i for i, name in enumerate(ANGLE_NAMES) if name.startswith(finger)]
        taken += [(source[0], finger)]
    assert sorted(taken) == sorted((pose, finger) for pose in range(2) for finger in FINGERS)


def test_nothing_is_exchanged_with_no_pose() -> None:
    assert exchange_fingers(torch.zeros(1, 27), torch.zeros(0, 21)).shape == (0, 27)
