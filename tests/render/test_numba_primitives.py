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
from toftrack.render.disc import disc_steps
from toftrack.render.numba import hand, kernel, vector
from toftrack.render.numba.hand import LANES, TERMS
from toftrack.render.numba.kernel import pack_evidence
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.numba.vector import WORDS
from toftrack.render.reference import dilate_disc
from toftrack.render.torch_scorer import Outlines, outlines

pytestmark = pytest.mark.usefixtures("one_thread")

# In the order of the compiled table; the inverse of the squared half height stands in row IY.
ROWS = (hand.X, hand.Y, hand.U, hand.HY, hand.HX, hand.XY, hand.DX, hand.UY, hand.UX, hand.DU)
K = torch.tensor([[170.0, 0.0, 88.2], [0.0, 175.0, 71.8], [0.0, 0.0, 1.0]])

_cached = entry_point(__file__, *(module.__file__ for module in (hand, kernel, vector)))


@_cached
def _pose_and_project(states, slots, base, lengths, mirror, index, surface, k, frames, valid, out):
    x = np.empty(27 * LANES, np.float32)
    sines, cosines = np.empty((2, 25 * LANES), np.float32)
    hand.pose_hands(states, 0, slots, base, lengths, mirror, x, sines, cosines, frames, valid)
    hand.project_hands(frames, index, surface, k[0], k[1], k[2], k[3], out)


@_cached
def _count_missed(model, words, rows, reach, steps, wanted, buffer):
    return kernel.count_missed(model, words, rows, reach, steps, wanted, buffer)


def states(seed: int) -> Tensor:
    """(LANES, 27) in any pose: in front of the camera, beside the image, at it and behind it."""
    g = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(ANGLE_LIMITS).T
    rows = torch.randn(LANES, 27, generator=g)
    rows[:, :3] *= torch.tensor([0.3, 0.3, 0.0])
    rows[:, 2] = torch.linspace(-0.5, 1.2, LANES)
    rows[:, 6:] = low + (high - low) * torch.rand(LANES, 21, generator=g)
    return rows


def compiled(side: str, rows: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames (16, 12, LANES), which are valid, and the table (E + 1, TERMS, LANES)."""
    scorer = NumbaScorer(default_hand_shape(side=side))
    slots, base, lengths, mirror, index, surface = scorer._hand
    frames, valid = np.empty((16, 12 * LANES), np.float32), np.empty(LANES, np.uint8)
    out = np.empty((len(index), TERMS * LANES), np.float32)
    k = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
    _pose_and_project(
        rows.numpy(), slots, base, lengths, mirror, index, surface, k, frames, valid, out
    )
    return frames.reshape(16, 12, LANES), valid, out.reshape(-1, TERMS, LANES)


@pytest.mark.parametrize("side", ["right", "left"])
def test_frames_are_those_of_the_skeleton(side: str) -> None:
    rows = states(0)
    frames, valid, _ = compiled(side, rows)
    pose = forward_kinematics(rows.double(), default_hand_shape(side=side).to(torch.float64))
    assert valid.all()
    turns = frames[:, :9].reshape(16, 3, 3, LANES).transpose(3, 0, 1, 2)
    np.testing.assert_allclose(turns, pose.frames.numpy(), atol=1e-5)
    origins = frames[:, 9:].transpose(2, 0, 1)
    np.testing.assert_allclose(origins, pose.origins_m.numpy(), atol=1e-5)  # 0.01 mm


def test_states_that_are_no_numbers_are_not_valid() -> None:
    rows = states(1)
    rows[0, 0], rows[1, 5], rows[2, 26], rows[3, 4] = math.nan, math.inf, -math.inf, 1e30
    frames, valid, table = compiled("right", rows[: LANES - 2])
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
    tolerances = dict(x=0.01, y=0.01, high=0.01, wide=0.01, u=1e-4)  # pixels, 1/m
    for name, row in zip(Outlines._fields, ROWS, strict=True):
        found, expected = table[:, row].T[far], getattr(reference, name).numpy()[far]
        atol = tolerances.get(name, 1e-3 * np.abs(expected).max())
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=atol, err_msg=name)
    inverse = table[:, hand.IY].T[far]
    np.testing.assert_allclose(inverse, high[far] ** -2.0, rtol=1e-3)


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
    words, steps = -(-width // 64), disc_steps(radius_px, *size)
    reach = int(steps[:, 1].max())
    for density in (0.0, 0.003, 0.3):
        mask, wanted = g.random(size) < density, g.random(size) < 0.5
        mask[g.integers(height), g.integers(width)] |= density > 0
        model = np.zeros((words + 2, height + 2 * reach + WORDS), np.uint64)
        model[1:-1, reach : reach + height] = bits_of(mask, words)
        rows = np.zeros((words, height + WORDS), np.uint64)
        rows[:, :height] = bits_of(wanted & ~mask, words)
        buffer = np.empty(2 * (words + 2) * WORDS, np.uint64)
        found = _count_missed(model, words, height, reach, steps, rows, buffer)
        near = dilate_disc(torch.from_numpy(mask[None]), radius_px)[0].numpy()
        assert found == (near & wanted & ~mask).sum()


@pytest.mark.parametrize("size", [(1, 1), (7, 64), (5, 131)])
def test_evidence_is_packed_with_nothing_beyond_its_edge(size: tuple[int, int]) -> None:
    g = np.random.default_rng(0)
    height, width = size
    images = g.random((3, *size), np.float32)
    mask = g.random(size) < 0.5
    packed, bits = pack_evidence(*images, mask)
    np.testing.assert_array_equal(packed[:, :, :width], images)
    low, high, occluder = packed[:, :, width:]
    assert (low == np.inf).all() and (high == -np.inf).all() and (occluder == np.inf).all()
    np.testing.assert_array_equal(bits, bits_of(mask, len(bits)))
