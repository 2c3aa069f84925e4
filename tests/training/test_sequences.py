"""Recordings of random scenes: the truth lies within what is rendered."""

import numpy as np
import torch
from helpers.detection import small_bank

from toftrack.training.sequences import CAMERAS, Sequence, random_sequence


def sequence(seed: int, frames: int = 4) -> Sequence:
    return random_sequence(frames, small_bank(), torch.Generator().manual_seed(seed))


def test_the_joints_lie_below_the_rendered_surface() -> None:
    depths, nothing_there = [], []
    for seed in range(8):
        seen = sequence(seed)
        height, width = seen.depth_m.shape[1:]
        for row in np.flatnonzero(seen.visible):
            depth, joints = seen.depth_m[row], seen.joints_m[row]
            u, v = np.rint((joints @ seen.k.T)[:, :2] / joints[:, 2:]).astype(int).T
            inside = (u >= 1) & (u < width - 1) & (v >= 1) & (v < height - 1)
            at = depth[v[inside], u[inside]]
            depths.extend((joints[inside, 2] - at)[at > 0])
            nothing_there.extend(at == 0)
    below = np.array(depths)
    # Joints are within the flesh, or hidden by a finger or a thing; on edges, pixels mix.
    assert (below > -0.02).mean() > 0.9
    assert (below < 0.03).mean() > 0.5
    assert np.mean(nothing_there) < 0.4


def test_a_sequence_is_complete() -> None:
    for seed in range(3):
        seen = sequence(seed)
        assert seen.depth_m.shape[0] == len(seen.joints_m) == len(seen.visible) == 4
        assert seen.depth_m.dtype == np.float32
        assert np.isfinite(seen.depth_m).all() and (seen.depth_m >= 0).all()
        assert seen.joints_m.shape == (4, 21, 3) and np.isfinite(seen.joints_m).all()
        assert seen.side in ("right", "left") and seen.visible.dtype == bool
        height, width = seen.depth_m.shape[1:]
        assert (width, height, seen.k[0, 0]) in CAMERAS


def test_a_seed_gives_the_same_recording() -> None:
    one, two, other = sequence(5, 2), sequence(5, 2), sequence(6, 2)
    assert np.array_equal(one.depth_m, two.depth_m) and np.array_equal(one.joints_m, two.joints_m)
    assert not np.array_equal(one.joints_m, other.joints_m)
