"""The compiled renderer's parts, each by itself against the one reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from toftrack.compute.compiling import entry_point
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.render.closed_form import project
from toftrack.render.numba import hand, missed
from toftrack.render.numba.hand import LANES, TERMS
from toftrack.render.numba.kernel import pack_evidence
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.numba.vector import BLOCK, WORDS
from toftrack.render.scoring import dilate_disc, disc_square, disc_steps
from toftrack.render.torch_scorer import Outlines, outlines

pytestmark = pytest.mark.usefixtures("one_thread")

# Of the compiled table; the inverse of the squared half height stands in row IY.
ROWS = {
    "x": hand.X,
    "y": hand.Y,
    "u": hand.U,
    "high": hand.HY,
    "shear": hand.XY,
    "dx": hand.DX,
    "slope_y": hand.UY,
    "slope_x": hand.UX,
    "du": hand.DU,
}
WIDTH, HEIGHT = 176, 144
K = torch.tensor([[170.0, 0.0, 88.2], [0.0, 175.0, 71.8], [0.0, 0.0, 1.0]])


@entry_point
def _pose_and_project(
    states, slots, base, lengths, mirror, index, surface, k, size, frames, valid, out, boxes
):
    x = np.empty(27 * LANES, np.float32)
    hand.pose_hands(states, 0, slots, base, lengths, mirror, x, frames, valid)
    hand.project_hands(frames, index, surface, k, size[0], size[1], out, boxes)


@entry_point
def _count_missed(model, words, rows, reach, steps, wanted, buffer):
    return missed.count_missed(model, words, rows, reach, steps, wanted, buffer)


def states(seed: int) -> Tensor:
    """(LANES, 27) in any pose: in front of the camera, beside the image, at it and behind it."""
    g = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(ANGLE_LIMITS).T
    rows = torch.randn(LANES, 27, generator=g)
    rows[:, :3] *= torch.tensor([0.3, 0.3, 0.0])
    rows[:, 2] = torch.linspace(-0.5, 1.2, LANES)
    rows[:, 6:] = low + (high - low) * torch.rand(LANES, 21, generator=g)
    return rows


def compiled(side: str, rows: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frames (16, 12, LANES), valid, the table (E + 1, TERMS, LANES) and boxes (4, LANES)."""
    scorer = NumbaScorer(default_hand_shape(side=side))
    frames, valid = np.empty((16, 12 * LANES), np.float32), np.empty(LANES, np.uint8)
    out = np.empty((len(scorer._hand[4]), TERMS * LANES), np.float32)
    k = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
    size, boxes = np.array([WIDTH, HEIGHT], np.float32), np.empty(4 * LANES, np.float32)
    _pose_and_project(rows.numpy(), *scorer._hand, k, size, frames, valid, out, boxes)
    table = out.reshape(-1, TERMS, LANES)
    return frames.reshape(16, 12, LANES), valid, table, boxes.reshape(4, LANES)


@pytest.mark.parametrize("side", ["right", "left"])
def test_frames_are_those_of_the_skeleton(side: str) -> None:
    rows = states(0)
    frames, valid, _, _ = compiled(side, rows)
    pose = forward_kinematics(rows.double(), default_hand_shape(side=side).to(torch.float64))
    assert valid.all()
    rotations = frames[:, :9].reshape(16, 3, 3, LANES).transpose(3, 0, 1, 2)
    np.testing.assert_allclose(rotations, pose.frames.numpy(), atol=1e-5)
    origins = frames[:, 9:].transpose(2, 0, 1)
    np.testing.assert_allclose(origins, pose.origins_m.numpy(), atol=1e-5)  # 0.01 mm


def test_states_that_are_no_numbers_are_not_valid() -> None:
    rows = states(1)
    rows[0, 0], rows[1, 5], rows[2, 26], rows[3, 4] = math.nan, math.inf, -math.inf, 1e30
    frames, valid, table, _ = compiled("right", rows[: LANES - 2])
    assert valid.tolist() == [0] * 4 + [1] * (LANES - 6) + [0] * 2, "nor those past the end"
    assert np.isfinite(frames).all()
    # What is not valid is drawn nowhere, whatever stands in its lane: its hand is at the camera.
    assert (table[:, hand.HY, :4] < 0).any(0).all()


def of_reference(side: str, rows: Tensor) -> Outlines:
    shape = default_hand_shape(side=side)
    ellipsoids = (
        hand_surface(shape)
        .to(torch.float64)
        .pose(forward_kinematics(rows.double(), shape.to(torch.float64)))
    )
    return outlines(ellipsoids, K.double())


@pytest.mark.parametrize("side", ["right", "left"])
def test_ellipsoids_on_the_screen_are_those_of_the_reference(side: str) -> None:
    rows = states(2)
    table = compiled(side, rows)[2]
    reference = of_reference(side, rows)
    high = reference.high.numpy()
    # An ellipsoid just at the nearest depth may be drawn or not.
    drawn = high > 0
    assert (drawn == (table[:, hand.HY].T > 0)).mean() > 0.995
    assert drawn.any() and not drawn[:4].any(), "those behind the camera are not drawn"
    far = (rows[:, 2] > 0.35).numpy()[:, None] & drawn & (table[:, hand.HY].T > 0)
    tolerances = dict(x=0.01, y=0.01, high=0.01, u=1e-4)  # pixels, 1/m
    for name, row in ROWS.items():
        found, expected = table[:, row].T[far], getattr(reference, name).numpy()[far]
        atol = tolerances.get(name, 1e-3 * np.abs(expected).max())
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=atol, err_msg=name)
    inverse = table[:, hand.IY].T[far]
    np.testing.assert_allclose(inverse, high[far] ** -2.0, rtol=1e-3)


def test_boxes_hold_all_ellipsoids_within_the_image() -> None:
    rows = states(2)
    _, _, table, boxes = compiled("right", rows)
    reference = of_reference("right", rows)
    for i in range(LANES):
        drawn = table[:-1, hand.HY, i] > 0
        for axis, size in ((0, WIDTH), (1, HEIGHT)):
            middle = (reference.x, reference.y)[axis][i, :-1].numpy()[drawn]
            half = (reference.wide, reference.high)[axis][i, :-1].numpy()[drawn]
            first = np.clip(np.ceil(middle - half), 0, size).min(initial=size)
            end = np.clip(np.floor(middle + half) + 1, 0, size).max(initial=0)
            if first < end:
                # An outline that just touches a pixel may take it in or not.
                np.testing.assert_allclose(boxes[[axis, axis + 2], i], [first, end], atol=1)
            else:
                assert not boxes[axis, i] < boxes[axis + 2, i]


def test_outlines_are_those_of_the_dual_conics() -> None:
    rows = states(3).double()
    shape = default_hand_shape().to(torch.float64)
    ellipsoids = hand_surface(shape).pose(forward_kinematics(rows, shape))
    conics, found = project(ellipsoids), outlines(ellipsoids, K.double())
    assert torch.equal(conics.visible, found.high > 0)
    dual = conics.dual / conics.dual[..., 2:, 2:]
    for axis, middle, half in ((0, found.x, found.wide), (1, found.y, found.high)):
        mean = dual[..., axis, 2]
        spread = (mean.square() - dual[..., axis, axis]).clamp(min=0).sqrt()
        expected = K[axis, axis] * mean + K[axis, 2], K[axis, axis] * spread
        seen = conics.visible
        torch.testing.assert_close(middle[seen], expected[0][seen], atol=1e-3, rtol=1e-5)
        torch.testing.assert_close(half[seen], expected[1][seen], atol=1e-3, rtol=1e-4)


def bits_of(mask: np.ndarray, words: int) -> np.ndarray:
    """(H, W) bool to (words, H) words of 64 pixels, the first in the lowest bit."""
    padded = np.zeros((len(mask), 64 * words), np.uint64)
    padded[:, : mask.shape[1]] = mask
    powers = np.uint64(1) << np.arange(64, dtype=np.uint64)
    return (padded.reshape(len(mask), words, 64) * powers).sum(-1, dtype=np.uint64).T


@pytest.mark.parametrize("radius_px", [0.0, 1.0, 2.5, 10.5, 40.0, 90.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 130), (33, 64), (48, 131), (20, 200)])
def test_the_compiled_dilation_is_the_disc_s(radius_px: float, size: tuple[int, int]) -> None:
    g = np.random.default_rng(int(radius_px) + size[1])
    height, width = size
    words, steps = -(-width // 64), disc_steps(disc_square(radius_px, *size), *size)
    reach = int(steps[:, 1].max())
    for density in (0.0, 0.003, 0.3):
        mask, wanted = g.random(size) < density, g.random(size) < 0.5
        mask[g.integers(height), g.integers(width)] |= density > 0
        model = np.zeros((words + 2, height + 2 * reach + WORDS), np.uint64)
        model[1:-1, reach : reach + height] = bits_of(mask, words)
        rows = np.zeros((words, height + WORDS), np.uint64)
        rows[:, :height] = bits_of(wanted & ~mask, words)
        buffer = np.empty((2, (words + 2) * WORDS), np.uint64)
        found = _count_missed(model, words, height, reach, steps, rows, buffer)
        near = dilate_disc(torch.from_numpy(mask[None]), radius_px)[0].numpy()
        assert found == (near & wanted & ~mask).sum()


@pytest.mark.parametrize("size", [(1, 1), (7, 64), (5, 131)])
def test_evidence_is_packed_with_nothing_beyond_its_edge(size: tuple[int, int]) -> None:
    g = np.random.default_rng(0)
    height, width = size
    low, occluder = g.random((2, *size), np.float32) + 1
    mask = g.random(size) < 0.5
    high = np.where(mask, low + np.float32(0.5), -np.inf).astype(np.float32)
    low = np.where(mask, low, np.inf).astype(np.float32)
    packed, bits = pack_evidence(low, high, occluder, mask)
    middle, scale, hidden = packed.reshape(height, -1, 3, BLOCK).transpose(2, 0, 1, 3)
    middle, scale, hidden = (image.reshape(height, -1) for image in (middle, scale, hidden))
    assert middle.shape[1] >= width + BLOCK - 1, "a block may begin at the last pixel"
    for edge, where in ((low, -1), (high, 1)):
        off = (edge - middle[:, :width])[mask] * scale[:, :width][mask]
        np.testing.assert_allclose(off, where, rtol=1e-5)
    nowhere = np.ones(middle.shape, bool)
    nowhere[:, :width] = ~mask
    assert (scale[nowhere] == np.inf).all(), "no depth is within a band without width"
    np.testing.assert_array_equal(hidden[:, :width], occluder)
    assert (hidden[:, width:] == np.inf).all()
    np.testing.assert_array_equal(bits[:, :height], bits_of(mask, len(bits)))
    assert not bits[:, height:].any()
