"""What the tracker is told by the networks: glances, their states, and searches."""

import math
from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from helpers.detection import small_networks
from helpers.settings import detector_settings
from helpers.tracking import sample

from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.detection import Detection, doubted_sigma_m
from toftrack.detector.hand_detector import HandDetector
from toftrack.detector.proposals import Places
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics


def detector(**changes: float) -> HandDetector:
    return HandDetector(*small_networks(), detector_settings(**changes))


def detection(side: str = "right", frame: int = 0) -> Detection:
    scene = sample().cut(frame)
    return detector().detect(scene.depth_m[0], scene.k, scene.joints_m[0, [9]], side)[0]


@pytest.mark.parametrize("side", ["right", "left"])
def test_states_are_the_hypotheses_as_a_hand_has_them(side: str) -> None:
    seen = detection(side)
    for row in (0, 7, 11):
        ratio = float(seen.log_size[row].exp())
        shape = default_hand_shape(DEFAULT_HAND_LENGTH_M * ratio, side)
        joints = forward_kinematics(seen.states(ratio)[row : row + 1], shape).joints_m[0]
        assert float((joints - seen.joints_m[row]).norm(dim=1).max()) < 1e-3


@pytest.mark.parametrize("ratio", [0.8, 1.0, 1.3])
def test_the_middle_of_the_palm_stays_whatever_the_size(ratio: float) -> None:
    seen = detection()
    states = seen.states(ratio)
    assert states.shape == (len(seen.pivot_m), 27)
    turned = roma.rotvec_to_rotmat(states[:, 3:6]) @ (torch.tensor(PIVOT_M) * ratio)
    assert torch.allclose(states[:, :3] + turned, seen.pivot_m, atol=1e-6)
    assert torch.equal(states[:, 6:], seen.angles)
    assert torch.equal(seen.states(ratio, 3), states[:3])


def test_a_hand_s_length_is_the_mean_of_the_hypotheses() -> None:
    seen = detection()
    weights = seen.log_probability.exp()
    length = 0.19 * math.exp(float((weights * seen.log_size).sum() / weights.sum()))
    assert seen.length_m == pytest.approx(length, rel=1e-4)


def test_without_a_place_nothing_is_detected() -> None:
    assert detector().detect(sample().depth_m[0], sample().k, np.zeros((0, 3)), "right") == []


def found_at(*centres: tuple[float, float, float]) -> Places:
    """What a finder may have said; each place with a lower probability."""
    chances = 0.9 * 0.8 ** np.arange(len(centres))
    return Places(np.array(centres, np.float32).reshape(-1, 3), chances.astype(np.float32))


def looked(
    monkeypatch: pytest.MonkeyPatch, places: Places, **changes: float
) -> tuple[list[Detection], list[np.ndarray]]:
    """The hands at places, and where the pose network looked."""
    inspected: list[np.ndarray] = []
    plain, scene = HandDetector.detect, sample()

    def detect(self, depth_m, k, centres_m, *given):
        inspected.append(np.array(centres_m))
        return plain(self, depth_m, k, centres_m, *given)

    monkeypatch.setattr(HandDetector, "detect", detect)
    return detector(**changes).look(scene.depth_m[0], scene.k, places, "right"), inspected


def test_hands_are_detected_twice_at_the_places_that_were_found(monkeypatch) -> None:
    centres = [(0, 0, 0.4), (0.2, 0, 0.5), (0, -0.2, 0.5)]
    detections, inspected = looked(monkeypatch, found_at(*centres), merit=-1e6)
    assert len(inspected) == 2 and len(detections) == 3
    assert inspected[0] == pytest.approx(np.array(centres))
    away = np.linalg.norm(inspected[1][:, None] - inspected[0], axis=-1).min(1)
    assert (away > 0).all(), "about the palms that the first one found"


def test_the_place_comes_first_of_which_most_speaks_for_a_hand(monkeypatch) -> None:
    places = found_at((0, 0, 0.4), (0.2, 0, 0.5))
    hands, _ = looked(monkeypatch, places, merit=-1e6)
    assert {round(one.heat, 2) for one in hands} == {0.9, 0.72}
    merits = [one.merit for one in hands]
    assert merits == sorted(merits, reverse=True) and len(hands) == 2
    between = sum(merits) / 2
    assert len(looked(monkeypatch, places, merit=between)[0]) == 1, "the other may be none"
    assert looked(monkeypatch, found_at())[0] == []


def test_merit_rises_with_all_that_speaks_for_a_hand() -> None:
    seen = detection()
    merits = [replace(seen, heat=heat).merit for heat in (0.9, 0.3, 0.0)]
    assert merits == sorted(merits, reverse=True) and len(set(merits)) == 3
    for better in (
        {"present": min(1.0, 2 * seen.present)},
        {"right_side": min(1.0, 2 * seen.right_side)},
        {"error_m": seen.error_m / 2},
    ):
        assert replace(seen, **better).merit > seen.merit
    assert math.isfinite(replace(seen, heat=0.0, present=0.0, right_side=0.0).merit)


@pytest.mark.parametrize("known", [0, 3])
def test_hands_that_are_known_take_no_place_from_those_that_are_not(known: int) -> None:
    search = detector(places=2, least=0.0).start_search
    assert len(search(sample().depth_m[0], sample().k, known)().centre_m) == 2 + known


def test_keypoints_of_fingers_in_one_another_are_doubted() -> None:
    points = forward_kinematics(torch.zeros(1, 27), default_hand_shape()).joints_m[0]
    apart = doubted_sigma_m(points, torch.full((21,), 0.003), 0.19)
    together = points.clone()
    together[9:13] = points[5:9]
    found = doubted_sigma_m(together, torch.full((21,), 0.003), 0.19)
    assert float(apart.max()) < 0.01
    for first in (5, 9):
        assert bool((found[first + 1 : first + 4] > 0.05).all()) and float(found[first]) < 0.01
