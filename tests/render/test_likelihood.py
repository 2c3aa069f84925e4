"""The F-measure of correct, false and missed pixels, against its definition pixel by pixel."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from helpers import settings
from helpers.settings import nearest_surface
from helpers.tracking import sample

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface, parted
from toftrack.render.likelihood import FMeasure
from toftrack.render.reference import ReferenceScorer, render_range_images
from toftrack.render.scoring import Counts
from toftrack.render.segmentation import Observation

HEIGHT, WIDTH = 36, 48
K = torch.tensor([[50.0, 0.0, 23.4], [0.0, 52.0, 17.8], [0.0, 0.0, 1.0]])
DISTANCE_M = 0.5
SHAPE = default_hand_shape()


def f_measure(**changes: object) -> FMeasure:
    """The configured one, but as the paper has it: a pixel is correct or not, no coverage."""
    return settings.f_measure(**{"residual_weight": 0.0, "coverage": 0.0} | changes)


def hand_states(n: int, seed: int) -> torch.Tensor:
    """(n, 27) hands near the middle of the image, somewhat bent and turned."""
    g = torch.Generator().manual_seed(seed)
    states = torch.zeros(n, 27)
    states[:, 1], states[:, 2] = 0.09, DISTANCE_M
    states[:, :3] += 0.01 * torch.randn(n, 3, generator=g)
    states[:, 3:6] = 0.5 * torch.randn(n, 3, generator=g)
    states[:, 6:] = 0.3 * torch.rand(n, 21, generator=g)
    return states


def surfaces(state: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """One hand's depth, (H, W) with 0 where there is none, and the wrist's silhouette."""
    shape = SHAPE.to(torch.float64)
    both = parted(hand_surface(shape).pose(forward_kinematics(state[None].double(), shape)))
    hand, wrist = (render_range_images(part, K.double(), HEIGHT, WIDTH)[0] for part in both)
    return hand.numpy(), wrist.numpy() > 0


def scene_of(state: torch.Tensor, seed: int) -> Observation:
    """An observation of a hand that is noisy, has holes, a false part and an occluder."""
    rng = np.random.default_rng(seed)
    depth = surfaces(state)[0] + rng.normal(0, 0.012, (HEIGHT, WIDTH))
    depth[depth < 0.2] = 1.4
    depth[rng.random(depth.shape) < 0.05] = 0.0
    depth[8:14, 5:12] = 0.55
    occluder = np.zeros(depth.shape, bool)
    occluder[15:20, 20:40] = True
    depth[occluder] = 0.3
    hand = (depth > 0) & (depth < 0.7) & ~occluder
    nearest = float(depth[hand].min())
    as_tensor = (torch.from_numpy(a) for a in (depth.astype(np.float32), hand, occluder))
    return Observation(*as_tensor, K, nearest)


def counted_by_definition(state: torch.Tensor, seen: Observation, head: FMeasure) -> list[float]:
    """Correct, false, missed and residual of one hand, as the paper defines them."""
    depth, wrist = surfaces(state)
    silhouette = depth > 0
    away = cv2.distanceTransform((~silhouette).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    radius = head.neighbourhood_m * float(K[0, 0]) / seen.nearest_m
    z, hand = seen.depth_m.double().numpy(), seen.hand.numpy()
    correct = silhouette & hand & (np.abs(depth - z) <= head.tolerance_m)
    false = silhouette & ~correct & ~seen.occluder.numpy()
    missed = ~silhouette & hand & ~wrist & (away <= radius)
    near, far = (1 / (z[correct] + off) for off in (-head.tolerance_m, head.tolerance_m))
    residual = np.square((1 / depth[correct] - (near + far) / 2) / ((near - far) / 2))
    return [*(pixels.sum() for pixels in (correct, false, missed)), residual.sum()]


def test_counts_agree_with_their_definition() -> None:
    states = hand_states(5, 1)
    head = f_measure(neighbourhood_m=0.03)
    seen = scene_of(states[0], 2)
    counts = ReferenceScorer(SHAPE)(states, head.evidence(seen))
    expected = torch.tensor([counted_by_definition(state, seen, head) for state in states])
    assert (expected[:, :3].amax(0) > 20).all(), "all kinds of pixels occur"
    # Two pixels a hand may lie on an outline or at the edge of the tolerance in single precision.
    assert (torch.stack(counts, 1) - expected).abs().max() <= 2


def test_the_neighbourhood_grows_with_the_focal_length_and_falls_with_the_distance() -> None:
    seen = scene_of(hand_states(1, 0)[0], 0)
    head = f_measure(neighbourhood_m=0.025)
    radius = head.evidence(seen).radius_px
    assert radius == pytest.approx(0.025 * 50 / seen.nearest_m)
    larger = replace(seen, k=torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ K)
    assert head.evidence(larger).radius_px == pytest.approx(2 * radius)
    farther = replace(seen, nearest_m=3 * seen.nearest_m)
    assert head.evidence(farther).radius_px == pytest.approx(radius / 3)


def counts(correct: float, false: float, missed: float, residual: float = 0.0) -> Counts:
    return Counts(*(torch.tensor([value]) for value in (correct, false, missed, residual)))


@pytest.mark.parametrize("beta", [0.5, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("naming", ["printed", "standard"])
def test_the_score_is_the_f_measure_of_the_two_rates(naming: str, beta: float) -> None:
    correct, false, missed = 70.0, 20.0, 45.0
    with_missed, with_false = correct / (correct + missed), correct / (correct + false)
    # The paper prints precision = c / (c + missed); usually that is the recall.
    names = (with_missed, with_false) if naming == "printed" else (with_false, with_missed)
    precision, recall = names
    expected = (1 + beta**2) * precision * recall / (beta**2 * precision + recall)
    head = f_measure(beta=beta, naming=naming)
    assert float(head.score(counts(correct, false, missed))) == pytest.approx(expected)


def test_the_score_lies_between_none_and_all() -> None:
    for naming in ("printed", "standard"):
        head = f_measure(naming=naming, residual_weight=1.0)
        assert float(head.score(counts(50, 0, 0))) == 1
        assert float(head.score(counts(0, 50, 50))) == 0
        assert float(head.score(counts(0, 0, 0))) == 0
        assert 0 <= float(head.score(counts(50, 3, 4, residual=50))) < 1e-6


@pytest.mark.parametrize("coverage", [0.0, 0.2, 1.0])
def test_nothing_correct_is_impossible_and_not_undefined(coverage: float) -> None:
    assert float(f_measure(coverage=coverage).log_score(counts(0, 50, 50))) == -math.inf


def test_a_correct_pixel_counts_less_the_farther_off_it_is() -> None:
    frame = sample().cut(0)
    seen = nearest_surface()(frame.depth_m[0], frame.k)
    state = torch.zeros(1, 27)
    state[:, :3] = torch.from_numpy(frame.joints_m[0, 0])
    strict, paper = f_measure(residual_weight=1.0), f_measure(residual_weight=0.0)
    found = ReferenceScorer(SHAPE)(state, strict.evidence(seen))
    assert float(paper.score(found)) > float(strict.score(found)) > 0
    # Of as many correct pixels, the nearer ones are better.
    by_residual = [float(strict.score(counts(100, 10, 10, r))) for r in (0, 25, 50, 100)]
    assert by_residual == sorted(by_residual, reverse=True)
    assert by_residual[0] == pytest.approx(float(paper.score(counts(100, 10, 10))))
    # What is lost from the correct pixels does not turn up as a gain elsewhere.
    assert by_residual[2] == pytest.approx(float(paper.score(counts(50, 60, 10))))


def test_coverage_prefers_the_hypothesis_that_explains_more_of_the_image() -> None:
    few, many = counts(20, 1, 1), counts(400, 40, 40)
    without, with_it = f_measure(), f_measure(coverage=0.5)
    assert without.log_score(few) > without.log_score(many)
    assert with_it.log_score(few) < with_it.log_score(many)
    gain = with_it.log_score(many) - without.log_score(many)
    assert float(gain) == pytest.approx(0.5 * math.log(400), rel=1e-5)
    # A search may ask for another weight; the score that is reported never has it.
    torch.testing.assert_close(without.log_score(few, 0.5), with_it.log_score(few))
    torch.testing.assert_close(without.score(many), with_it.score(many))
