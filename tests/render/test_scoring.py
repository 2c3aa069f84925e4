"""Every back end against the reference, and the reference against other ways to the same figure."""

import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from toftrack.compute.compiling import entry_point
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface, parted
from toftrack.render.numba import kernel
from toftrack.render.numba.vector import WORDS
from toftrack.render.reference import ReferenceScorer, render_range_images, step_range_images
from toftrack.render.scoring import Counts, Evidence, dilate_disc, disc_square, disc_steps
from toftrack.render.torch_scorer import rendered_depths
from toftrack.tracking.backend import choose_backend, make_scorer

BACK_ENDS = ("torch", "numba")
CPU = torch.device("cpu")
SIZES = ((48, 64), (144, 176), (240, 320))
FOCAL = {48: 60.0, 144: 170.0, 240: 280.0, 480: 560.0}
SHAPE = default_hand_shape()
SHAPES = {
    "default": {},
    "small and thin": {"hand_length_m": 0.14, "thickness": 0.7},
    "left and thick": {"hand_length_m": 0.21, "thickness": 1.4, "side": "left"},
}


def random_states(n: int, distance: tuple[float, float], seed: int) -> torch.Tensor:
    """(N, 27): anywhere in front of the camera and partly beside the image, any pose."""
    g = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(ANGLE_LIMITS).T
    z = distance[0] + (distance[1] - distance[0]) * torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * 0.9 * z[:, None]
    turn = torch.randn(n, 3, generator=g)
    angles = low + (high - low) * torch.rand(n, 21, generator=g)
    return torch.cat((xy, z[:, None], turn, angles), 1)


def intrinsics(height: int, width: int, focal: float) -> torch.Tensor:
    return torch.tensor(
        [[focal, 0, width / 2 - 0.3], [0, 1.03 * focal, height / 2 + 0.2], [0, 0, 1]]
    )


def random_evidence(
    shape: HandShape, height: int, width: int, radius_px: float, distance: float, seed: int
) -> Evidence:
    """A band around a hand of the given distance, with holes, occluders and ignored pixels."""
    g = torch.Generator().manual_seed(seed)
    k = intrinsics(height, width, FOCAL.get(height, 1.2 * height))
    state = torch.zeros(1, 27)
    state[0, 1:3] = torch.tensor([0.08, distance])
    posed = hand_surface(shape).pose(forward_kinematics(state, shape))
    depth = render_range_images(posed, k, height, width)[0]
    hand = (depth > 0) & (torch.rand(height, width, generator=g) > 0.1)
    hand |= torch.rand(height, width, generator=g) > 0.95
    depth = torch.where(hand & (depth <= 0), distance, depth)
    never = torch.full_like(depth, math.inf)
    band = 0.01 + 0.05 * torch.rand(height, width, generator=g)
    low = torch.where(hand, 1 / (depth + band), never)
    high = torch.where(hand, 1 / (depth - band).clamp(min=1e-3), -never)
    what = torch.rand(height, width, generator=g)
    occluder = torch.where(what < 0.3, 1 / (distance * (0.8 + 0.4 * what)), 0.0)
    occluder = torch.where(what > 0.9, never, occluder)
    return Evidence(low, high, occluder, hand, k, radius_px)


def check(found: Counts, expected: Counts) -> None:
    """float32 ties: pixels on an outline or on the edge of a band may fall to either side.

    Counts within max(3 pixels, 0.5 %) a particle; the residual within 1 % and 1 for each such
    pixel, which has up to 1.
    """
    for name in ("correct", "false", "missed"):
        a, b = getattr(found, name), getattr(expected, name)
        assert a.shape == b.shape and a.dtype == torch.float32
        worst = ((a - b).abs() - (0.005 * b).clamp(min=3.0)).max()
        assert worst <= 0, f"{name}: {a} is not {b}"
    off = (found.residual - expected.residual).abs()
    assert (off <= 0.01 * expected.residual + 3.0).all()


@pytest.fixture(scope="module", params=BACK_ENDS)
def back_end(request):
    return request.param


NEIGHBOURHOODS = (((0.25, 0.4), 40.0), ((0.4, 0.7), 11.6), ((0.7, 1.2), 0.0))


@pytest.mark.parametrize("a", range(3))
@pytest.mark.parametrize("b", range(3))
def test_agrees_with_reference(a: int, b: int) -> None:
    """Every size with every distance, with every shape, and every distance with every shape."""
    size, (distance, radius_px), kind = SIZES[a], NEIGHBOURHOODS[b], list(SHAPES)[(a + b) % 3]
    shape = default_hand_shape(**SHAPES[kind])
    seed = len(kind) + size[0] + int(radius_px)
    n = 3 if size[0] > 200 else 8
    middle = sum(distance) / 2
    evidence = random_evidence(shape, *size, radius_px, middle, seed)
    states = random_states(n, distance, seed)
    states[0, :3], states[0, 3:] = torch.tensor([0.01, 0.08, middle]), 0.05
    expected = ReferenceScorer(shape)(states, evidence)
    assert sum(expected.correct) > 0 and sum(expected.false) > 0
    for name in BACK_ENDS:
        check(make_scorer(name, shape, CPU)(states, evidence), expected)


def test_threads_share_the_particles():
    """The same counts from one thread, from several, and from calls at the same time."""
    evidence = random_evidence(SHAPE, 48, 64, 5.0, 0.4, 6)
    states = random_states(300, (0.3, 0.5), 6)
    scorer = make_scorer("numba", SHAPE, CPU)
    alone = scorer(states, evidence)
    torch.set_num_threads(4)
    with ThreadPoolExecutor(3) as pool:
        calls = [pool.submit(scorer, states, evidence) for _ in range(12)]
    for call in calls:
        assert all(torch.equal(a, b) for a, b in zip(call.result(), alone, strict=True))


def test_several_hands_at_once_count_as_each_alone(back_end):
    """Of different shapes and images, as two hands in a frame are."""
    shapes = [default_hand_shape(**SHAPES[kind]) for kind in ("default", "left and thick")]
    back = choose_backend(back_end, CPU)
    scorers = [back.make_scorer(shape) for shape in shapes]
    seen = [random_evidence(shape, 48, 64, 5.0, 0.4, 7 + i) for i, shape in enumerate(shapes)]
    states = torch.stack([random_states(20, (0.3, 0.5), 7 + i) for i in range(2)])
    together = back.score_rows(scorers, states, seen)
    for row, scorer in enumerate(scorers):
        for one, alone in zip(together, scorer(states[row], seen[row]), strict=True):
            torch.testing.assert_close(one[row], alone, atol=0, rtol=0)


def test_hands_outside_and_behind_and_at_the_camera(back_end):
    evidence = random_evidence(SHAPE, 144, 176, 20.0, 0.4, 1)
    states = torch.zeros(10, 27)
    states[:, 2] = 0.4
    for i, offset in enumerate(([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1])):
        states[i, :3] += torch.tensor(offset)
    states[5, :3] = torch.tensor([0.0, 0.0, 0.03])  # around the camera
    states[6, :3] = torch.tensor([0.19, 0.0, 0.4])  # across the right edge
    states[7, :3] = torch.tensor([-0.19, 0.1, 0.4])
    states[8, :3] = torch.tensor([0.0, 0.25, 0.4])
    states[9, :3] = torch.tensor([0.0, 0.06, 0.1])  # larger than the image
    found = make_scorer(back_end, SHAPE, CPU)(states, evidence)
    check(found, ReferenceScorer(SHAPE)(states, evidence))
    assert all((field[:5] == 0).all() for field in found)
    assert (found.false[6:] > 0).all()


def test_states_that_are_not_finite_count_nothing(back_end):
    evidence = random_evidence(SHAPE, 48, 64, 5.0, 0.4, 2)
    states = torch.zeros(20, 27)
    states[:, 1:3] = torch.tensor([0.08, 0.4])
    good = ReferenceScorer(SHAPE)(states, evidence)
    for i, j in enumerate((0, 2, 4, 6, 26)):
        states[2 * i, j] = (math.nan, math.inf, -math.inf)[i % 3]
    states[11, 2], states[12, 0], states[13, 3], states[14, 8] = 1e30, 1e30, 1e8, -1e7
    found = make_scorer(back_end, SHAPE, CPU)(states, evidence)
    for field, expected in zip(found, good, strict=True):
        assert field.isfinite().all()
        assert (field[0:10:2] == 0).all()
        assert (field[1:10:2] - expected[0]).abs().max() <= 3
    assert (found.correct[11:13] == 0).all()


def test_no_particles_and_one(back_end):
    evidence = random_evidence(SHAPE, 48, 64, 5.0, 0.4, 3)
    scorer = make_scorer(back_end, SHAPE, CPU)
    assert all(field.shape == (0,) for field in scorer(torch.zeros(0, 27), evidence))
    states = random_states(40, (0.3, 0.5), 3)
    whole = scorer(states, evidence)
    for i in (0, 17, 39):
        one = scorer(states[i : i + 1], evidence)
        assert all(
            torch.allclose(a, b[i : i + 1], atol=1e-3) for a, b in zip(one, whole, strict=True)
        )


def test_a_crop_counts_as_the_whole(back_end):
    evidence = random_evidence(SHAPE, 240, 320, 12.0, 0.5, 4)
    states = torch.zeros(20, 27)
    states[:, 1:3] = torch.tensor([0.08, 0.5])
    states += 0.02 * torch.randn(20, 27, generator=torch.Generator().manual_seed(4))
    scorer = make_scorer(back_end, SHAPE, CPU)
    check(scorer(states, evidence.cropped(31, 7, 301, 236)), scorer(states, evidence))


@pytest.mark.parametrize("size", [(1, 1), (1, 130), (70, 1), (9, 65)])
def test_images_of_a_pixel_s_width(back_end, size):
    evidence = random_evidence(SHAPE, *size, 3.0, 0.4, 8)
    states = random_states(12, (0.15, 0.5), 8)
    states[:6, :3], states[:6, 3:] = torch.tensor([0.0, 0.05, 0.3]), 0.1
    states[1, 2], states[2, 4] = -0.3, math.nan
    expected = ReferenceScorer(SHAPE)(states.nan_to_num(), evidence)
    found = make_scorer(back_end, SHAPE, CPU)(states, evidence)
    keep = [i for i in range(12) if i != 2]
    check(Counts(*(f[keep] for f in found)), Counts(*(f[keep] for f in expected)))
    assert all(field[2] == 0 for field in found)
    assert sum(expected.correct) + sum(expected.false) > 0


# Many more columns than a word of bits has, hardly more, and one; a dilation that reaches across
# two words, and none; left hands; hands across the edges and behind the camera.
INTERPRETED = [(16, 150, 8.0, "right"), (17, 65, 3.0, "left"), (1, 1, 0.0, "right")]


def triton_agrees() -> None:
    from toftrack.render.triton.scorer import TritonScorer

    for *size, radius_px, side in INTERPRETED:
        shape = default_hand_shape(side=side)
        evidence = random_evidence(shape, *size, radius_px, 0.4, 1)
        states = random_states(6, (0.3, 0.5), 1)
        states[:3, :3] = torch.tensor([0.0, 0.08, 0.4])
        states[:3, 3:] *= 0.1
        aside = 0.4 * size[1] / size[0] / 3
        states[1, 0], states[2, 0] = -aside, aside
        states[4, 2], states[5, 7] = -0.4, math.nan
        found = TritonScorer(shape)(states, evidence)
        assert all(field[5] == 0 for field in found)
        expected = ReferenceScorer(shape)(states[:5], evidence)
        check(Counts(*(f[:5] for f in found)), expected)


def test_triton_agrees_as_far_as_its_interpreter_goes():
    """The CUDA kernels, interpreted on the CPU in a process of its own."""
    pytest.importorskip("triton", reason="triton is not installed")
    code = "import sys; sys.path.insert(0, 'tests/render')\n"
    code += "from test_scoring import triton_agrees\ntriton_agrees()"
    env = {**os.environ, "TRITON_INTERPRET": "1"}
    run = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("name", ["torch", "triton"])
@pytest.mark.parametrize("size", SIZES)
def test_cuda_back_ends_agree_with_reference(name, size):
    shape, device = default_hand_shape(), torch.device("cuda")
    evidence = random_evidence(shape, *size, 11.6, 0.5, 1)
    states = random_states(50, (0.3, 0.8), 1)
    expected = ReferenceScorer(shape)(states, evidence)
    images = (evidence.low, evidence.high, evidence.occluder, evidence.hand, evidence.k)
    there = Evidence(*(image.to(device) for image in images), evidence.radius_px)
    found = make_scorer(name, shape, device)(states.to(device), there)
    assert all(field.device.type == "cuda" for field in found)
    check(Counts(*(field.cpu() for field in found)), expected)


# ---- the reference itself ---------------------------------------------------------


@pytest.mark.parametrize("radius_px", [0.0, 1.0, 2.5, 10.5, 40.0])
@pytest.mark.parametrize("size", [(48, 64), (33, 131)])
def test_dilation_is_the_distance_transform(radius_px, size):
    g = np.random.default_rng(int(radius_px))
    masks = g.random((4, *size)) > 0.995
    exact = np.stack(
        [
            cv2.distanceTransform((~m).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            for m in masks
        ]
    )
    expected = torch.from_numpy(exact <= radius_px + 1e-4)
    masks = torch.from_numpy(masks)
    assert torch.equal(dilate_disc(masks, radius_px), expected)


def _posed(n: int, seed: int, dtype: torch.dtype) -> Ellipsoids:
    states = random_states(n, (0.3, 0.8), seed)
    states[:, :2] *= 0.5
    shape = default_hand_shape().to(dtype)
    return parted(hand_surface(shape).pose(forward_kinematics(states.to(dtype), shape)))[0]


def test_depth_in_single_precision():
    k = intrinsics(144, 176, 170.0)
    single = render_range_images(_posed(8, 0, torch.float32), k, 144, 176)
    double = render_range_images(_posed(8, 0, torch.float64), k.double(), 144, 176)
    both = (single > 0) & (double > 0)
    assert ((single > 0) != (double > 0)).sum() <= 3 * 8
    off = (single.double() - double).abs()[both]
    # On an outline, inner or outer, the depth changes without bound within a pixel.
    assert off.quantile(0.999) < 2e-4


def test_closed_form_is_what_fine_steps_find():
    k = intrinsics(48, 64, 60.0).double()
    ellipsoids = _posed(3, 2, torch.float64)
    closed = render_range_images(ellipsoids, k, 48, 64)
    fine = step_range_images(ellipsoids, k, 48, 64, step_m=0.0005)
    both = (closed > 0) & (fine > 0)
    # Steps pass through what is thinner than a step along the ray.
    assert ((closed > 0) & (fine == 0)).sum() <= 0.03 * (closed > 0).sum()
    assert not ((fine > 0) & (closed == 0)).any()
    assert (closed - fine).abs()[both].median() < 2e-5
    coarse = step_range_images(ellipsoids, k, 48, 64)
    seen = (closed > 0) & (coarse > 0)
    assert (closed - coarse).abs()[seen].median() < 1e-3


def test_rendered_depths_are_those_of_the_closed_form() -> None:
    shape, states = default_hand_shape(), random_states(6, (0.3, 0.7), 5)
    states[0, 0], states[1, 2] = 9.0, -0.5  # beside the image, and behind the camera
    for shown in (states, states[:1]):
        evidence = random_evidence(shape, 48, 64, 4.0, 0.5, 6)
        posed, _ = parted(hand_surface(shape).pose(forward_kinematics(shown, shape)))
        found = rendered_depths(shown, shape, evidence)
        right = render_range_images(posed, evidence.k, 48, 64)
        assert found.shape == right.shape and ((found > 0) != (right > 0)).sum() <= 2
        both = (found > 0) & (right > 0)
        torch.testing.assert_close(found[both], right[both], atol=1e-3, rtol=0)


@entry_point
def _count_missed(model, words, rows, reach, steps, wanted, buffer):
    return kernel.count_missed(model, words, rows, reach, steps, wanted, buffer)


def bits_of(mask: np.ndarray, words: int) -> np.ndarray:
    """(H, W) bool to (words, H) words of 64 pixels, the first in the lowest bit."""
    padded = np.zeros((len(mask), 64 * words), bool)
    padded[:, : mask.shape[1]] = mask
    return np.packbits(padded, 1, "little").view("<u8").T


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
