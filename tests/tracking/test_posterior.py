"""The terms of the posterior, each against plain arithmetic, and what they add up to."""

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from helpers.detection import detection_of
from helpers.rendered import bent, hand_at, image_of, right_hand_model, track_of, view_of
from helpers.settings import posterior_weights

from toftrack.hand.overlap import RADII_MM
from toftrack.tracking.candidates import View
from toftrack.tracking.posterior import PosteriorWeights

TRUTH = hand_at()
NONE = dict.fromkeys((field.name for field in fields(PosteriorWeights)), 0.0)


def poses(count: int = 24) -> torch.Tensor:
    """(N, 27) hands about the one in the image, some far off, turned or with fingers crossed."""
    draw = torch.Generator().manual_seed(3)
    states = TRUTH.repeat(count, 1) + 0.01 * torch.randn(count, 27, generator=draw)
    states[:, 3:6] += torch.linspace(0, 3.0, count)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    states[:, 6:] += 0.4 * torch.randn(count, 21, generator=draw)
    return states


def other_hand(x: float = 0.03) -> torch.Tensor:
    """(21, 3) joints of another hand that is partly in this one."""
    return detection_of(hand_at(x)).joints_m[0]


def view(*others: torch.Tensor) -> View:
    return view_of(image_of(TRUTH), track_of(TRUTH), detection_of(bent(TRUTH, 1)), others)


def weighed(seen: View, coverage: float | None = None, **weights: float) -> np.ndarray:
    """(N,) log posteriors, only with the terms that are weighted here."""
    used = posterior_weights(**(NONE | weights))
    return replace(seen, coverage=coverage, weights=used).log_posterior(poses()).numpy()


def added(seen: View, **weights: float) -> np.ndarray:
    """(N,) what the terms add to the image's."""
    return weighed(seen, **weights) - weighed(seen)


def joints_of(seen: View) -> np.ndarray:
    return seen.fitted.refiner.joints(poses()).double().numpy()


@pytest.mark.parametrize("coverage", [0.0, 0.7, None])
def test_the_image_says_its_likelihood(coverage: float | None) -> None:
    seen, likelihood = view(), right_hand_model().likelihood
    counts = seen.fitted.scorer(poses(), seen.image.evidence)
    expected = likelihood.log_score(counts, coverage)
    np.testing.assert_allclose(weighed(seen, coverage), expected, rtol=1e-5)
    assert seen.image.score(poses()[:1]) == pytest.approx(float(likelihood.score(counts)[0]))
    assert np.ptp(expected.numpy()) > 1, "the poses differ"


def test_keypoints_cost_their_robust_squared_deviation() -> None:
    """Geman-McClure: x^2 / (1 + x^2 / 9), x in standard deviations."""
    seen = view()
    keypoints = seen.keypoints
    points, sigma = keypoints.points_m.double().numpy(), keypoints.sigma_m.double().numpy()
    squared = (np.linalg.norm(joints_of(seen) - points, axis=-1) / sigma) ** 2
    expected = -0.4 * (squared / (1 + squared / 9)).mean(1)
    found = added(seen, keypoints=0.4)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
    assert found.min() > -0.4 * 9 and found.max() < 0


def overlap_of(fingers: np.ndarray) -> float:
    """How much the fingers (5, 4, 3) of a hand of the mean size are in one another."""
    total, steps = 0.0, np.diff(fingers, axis=1)
    straight = np.linalg.norm(steps.sum(1), axis=1) / np.linalg.norm(steps, axis=2).sum(1)
    straight = np.clip((straight - 0.7) / 0.2, 0, 1)
    points = [[*f[1:], (f[1] + f[2]) / 2, (f[2] + f[3]) / 2] for f in fingers]
    for a, b in itertools.combinations(range(5), 2):
        strict = max(straight[a], straight[b]) if a > 0 else 0.0  # the thumb crosses the others
        touch_m = (0.6 + 0.4 * strict) / 1e3
        for p, radius in zip(points[a], RADII_MM[a], strict=True):
            its = zip(points[b], RADII_MM[b], strict=True)
            depth = max(1 - np.linalg.norm(p - q) / (touch_m * (radius + r)) for q, r in its)
            total += (1 + 3 * strict) * max(0.0, depth) ** 2
    return total


def test_fingers_in_one_another_cost_their_overlap() -> None:
    seen = view()
    overlap = [overlap_of(hand[1:].reshape(5, 4, 3)) for hand in joints_of(seen)]
    assert max(overlap) > 0.1
    found = added(seen, overlap=0.5)
    np.testing.assert_allclose(found, -0.5 * np.array(overlap), rtol=1e-3, atol=1e-4)


def test_another_hand_costs_the_joints_that_lie_in_it() -> None:
    other = other_hand()
    seen, expected = view(other), []
    for hand in joints_of(seen):
        gaps = [min(np.linalg.norm(mine - its) for its in other.double().numpy()) for mine in hand]
        expected.append(-3.0 * sum(max(0.0, 1 - gap / 0.018) for gap in gaps) / 21)
    assert min(expected) < -0.1
    np.testing.assert_allclose(added(seen, other_hand=3.0), expected, rtol=1e-3, atol=1e-4)


def test_terms_and_other_hands_add_up() -> None:
    every, one, two = {"keypoints": 0.4, "overlap": 0.5}, other_hand(0.03), other_hand(-0.03)
    each = [added(view(), **{name: weight}) for name, weight in every.items()]
    each += [added(view(other), other_hand=3.0) for other in (one, two)]
    both = added(view(one, two), other_hand=3.0, **every)
    np.testing.assert_allclose(both, sum(each), rtol=1e-4, atol=1e-4)


def test_without_a_detection_keypoints_say_nothing() -> None:
    blind = view_of(image_of(TRUTH), track_of(TRUTH))
    assert not added(blind, keypoints=0.4).any()
