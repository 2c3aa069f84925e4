"""The poses that come with the package are those of hands."""

from __future__ import annotations

import torch

from toftrack.hand.skeleton import ANGLE_LIMITS
from toftrack.pose_space.data.natural_poses import drawn_poses, natural_poses, recorded_poses

LOW, HIGH = torch.tensor(ANGLE_LIMITS).unbind(1)


def test_the_recorded_poses_are_those_of_hands() -> None:
    recorded = recorded_poses()
    assert recorded.shape == (800, 21)
    # Recorded hands bend a little beyond what clinics tabulate.
    assert (recorded > LOW - 0.35).all() and (recorded < HIGH + 0.35).all()


def test_the_drawn_poses_are_within_the_limits_and_of_all_kinds() -> None:
    more = natural_poses()
    assert torch.equal(more[:800], recorded_poses())
    for angles in (drawn_poses(), more[800:]):
        assert (angles >= LOW).all() and (angles <= HIGH).all()
        # Fingers straight and curled, each of them.
        bent = angles[:, 5:].unflatten(1, (4, 4))[:, :, 1:].sum(2)
        for share in ((bent < 0.7).float().mean(0), (bent > 3.0).float().mean(0)):
            assert (share > 0.1).all() and (share < 0.8).all()
