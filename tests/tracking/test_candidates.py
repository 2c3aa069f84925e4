"""A frame's hypotheses: what is proposed for each hand, refined, scored, and selected."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    bent,
    hand_at,
    image_of,
    right_hand_model,
    state_of,
    track_of,
    view_of,
)
from helpers.settings import refinement

from toftrack.compute.pace import FRAME_S
from toftrack.detector.crops import crop_rotation
from toftrack.detector.detection import Detection
from toftrack.detector.network import PARTS
from toftrack.detector.parts import (
    ALL_HAND,
    BACKGROUND_PART,
    FOREARM_PART,
    HAND_PART,
    THING_PART,
    Parts,
)
from toftrack.hand.shape import default_hand_shape
from toftrack.refinement.shape_fit import first_shape, with_network_length
from toftrack.render.segmentation import Observation
from toftrack.tracking.candidates import (
    _MARGIN,
    Hypotheses,
    View,
    best_start,
    hypotheses_of,
    propose,
    select,
    with_own_arm,
    with_parts,
    without_things,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import SideEvidence
from toftrack.tracking.step import step


def model_with(**settings: float) -> TrackerModel:
    """The tracker of a right hand with some settings of the detector."""
    return replace(right_hand_model(), detector=FixedDetector(**settings))


def viewed(x: float, seed: int = 0) -> View:
    """A hand that the track has with other fingers than the image and the detector."""
    truth = bent(hand_at(x), seed, 0.4)
    track = track_of(hand_at(x), log_odds=0.0)
    return view_of(image_of(truth), track, detection_of(truth), model=model_with())


def mean_of(view: View) -> torch.Tensor:
    """(1, 27) the filter's estimate, which is the track's here."""
    return view.model.decode(view.track.cloud.mean)


def proposed(view: View) -> Hypotheses:
    return propose(view, mean_of(view))


def test_refined_hypotheses_explain_the_image_better_than_the_track_did() -> None:
    view = viewed(0.0)
    table = proposed(view)
    # The last frame's fingers and the filter's; the detector's, bent to the keypoints.
    assert table.detected.tolist() == [False, False, True]
    torch.testing.assert_close(table.log_posterior, view.log_posterior(table.pose))
    before = float(view.log_posterior(view.track.pose))
    assert float(table.log_posterior[0]) > before
    assert float(table.log_posterior.max()) > before + 0.1


def test_a_pose_that_explains_nothing_once_refined_stays_where_it_was_proposed(monkeypatch) -> None:
    view = viewed(0.0)
    mean = mean_of(view)
    far = mean.clone()
    far[:, 2] += 0.5
    assert bool(view.log_posterior(far).isneginf())
    monkeypatch.setattr(View, "refine", lambda _, poses: far.repeat(len(poses), 1))
    table = propose(view, mean)
    standing = torch.from_numpy(~table.detected)
    torch.testing.assert_close(table.pose[standing, :3], mean[:, :3].repeat(2, 1))
    assert bool(table.log_posterior[standing].isneginf().all())


def test_without_refinement_the_filter_alone_proposes() -> None:
    view = viewed(0.0)
    plain = replace(view, model=replace(view.model, refinement=refinement(iterations=0)))
    table = proposed(plain)
    assert len(table.pose) == 1 and torch.equal(table.pose, mean_of(view))


def test_the_best_start_is_the_best_of_all_detected_poses() -> None:
    truth = bent(hand_at(), 1, 0.4)
    detection = detection_of(torch.cat((bent(hand_at(), 2, 0.8), truth, hand_at())))
    detection = replace(detection, keypoints=detection_of(truth).keypoints)
    view = view_of(image_of(truth), track_of(hand_at()), detection)
    posterior, joints = view.log_posterior, view.fitted.refiner.joints
    pose, value = best_start(view)
    assert value == pytest.approx(float(posterior(pose)), abs=1e-5)
    as_they_are = hypotheses_of(detection, view.fitted, view.model.detector.settings.hypotheses)
    assert value >= float(posterior(as_they_are).max()) - 1e-5
    assert float((joints(pose) - joints(truth)).norm(dim=-1).mean()) < 0.005


@pytest.mark.parametrize(
    ("sigma_m", "weight", "expected_m"),
    [(0.005, 1.0, 0.02), (0.03, 1.0, 0.03), (0.03, 0.5, 0.06), (0.03, 0.0, 3e4)],
)
def test_keypoints_are_trusted_no_more_than_is_set_and_their_weight_divides_the_deviations(
    sigma_m: float, weight: float, expected_m: float
) -> None:
    detection, track = detection_of(hand_at()), track_of(hand_at())
    keypoints = replace(detection.keypoints, sigma_m=torch.full((21,), sigma_m))
    model = model_with(keypoint_m=0.02, keypoint_weight=weight)
    view = view_of(image_of(), track, replace(detection, keypoints=keypoints), model=model)
    assert view.keypoints.sigma_m.tolist() == pytest.approx([expected_m] * 21)


@pytest.mark.parametrize("count", [0, 1, 8])
def test_only_likely_hypotheses_are_candidates_and_at_least_one(count: int) -> None:
    small = with_network_length(first_shape(), 0.15, default_hand_shape())
    hand = right_hand_model().hand("right", small)
    detection = detection_of(torch.cat([hand_at(0.01 * i) for i in range(6)]))
    likely = int((detection.log_probability > math.log(0.03)).sum())
    states = hypotheses_of(detection, hand, count)
    assert len(states) == max(1, min(count, likely)) < 6
    assert torch.equal(states, detection.states(hand.ratio)[: len(states)]) and hand.ratio < 0.9


HALF_A_THING = np.full((PARTS, PARTS), HAND_PART, np.uint8)
HALF_A_THING[: PARTS // 2] = THING_PART
DETECTION = detection_of(hand_at())
CENTRE = DETECTION.keypoints.points_m[9].double().numpy()
"""Of a crop about the hand's middle finger."""


def parts_of(kind: np.ndarray) -> Parts:
    """(PARTS, PARTS) of that crop."""
    return Parts(kind, crop_rotation(CENTRE), CENTRE, False)


def seen_with(parts: np.ndarray) -> tuple[Observation, Observation]:
    """A hand's image as it is, and without what is said to be a thing."""
    observation = view_of(image_of(hand_at()), track_of(hand_at()), DETECTION).observation
    return observation, without_things(observation, parts_of(parts))


def test_a_thing_in_the_hand_is_neither_hand_nor_background() -> None:
    whole, rest = seen_with(HALF_A_THING)
    assert rest.thing is not None
    assert torch.equal(rest.hand | rest.thing, whole.hand) and not (rest.hand & rest.thing).any()
    middle = float(whole.k[1, 1]) * CENTRE[1] / CENTRE[2] + float(whole.k[1, 2])
    rows = rest.thing.nonzero()[:, 0], rest.hand.nonzero()[:, 0]
    assert rows[0].max() < middle + 2 and rows[1].min() > middle - 2
    # A finger that is behind it, or not, is neither false nor missed.
    likelihood, fitted = model_with().likelihood, model_with().hand("right", first_shape())
    poses = torch.cat((hand_at(), bent(hand_at(), 3, 0.8)))
    counts = fitted.scorer(poses, likelihood.evidence(rest))
    before = fitted.scorer(poses, likelihood.evidence(whole))
    assert (counts.correct < before.correct).all() and (counts.missed <= before.missed).all()
    assert counts.missed[1] + counts.false[1] < before.missed[1] + before.false[1]


def test_what_was_a_thing_at_the_last_look_is_left_out_until_the_next() -> None:
    _, rest = seen_with(HALF_A_THING)
    view = view_of(image_of(hand_at()), track_of(hand_at(), parts=parts_of(HALF_A_THING)))
    seen = with_parts(view).observation
    assert rest.thing is not None and seen.thing is not None
    assert torch.equal(seen.hand, rest.hand) and torch.equal(seen.thing, rest.thing)
    plain = view_of(image_of(hand_at()), track_of(hand_at()))
    assert with_parts(plain) is plain


def test_a_frame_that_the_network_does_not_look_at_is_told_apart_by_its_last_look() -> None:
    known = {"parts": parts_of(HALF_A_THING), "evidence": SideEvidence(age_s=0.0)}
    image = replace(image_of(hand_at()), timestamp_s=FRAME_S)
    weights = []
    for changes in (known, known | {"parts": ALL_HAND}):
        _, (info,), _ = step(state_of(track_of(hand_at(), **changes)), image, model_with(every=3))
        assert info is not None and info.detection is None
        assert (info.observation.thing is None) == (changes["parts"] is ALL_HAND)
        weights.append(info.weights)
    assert not torch.equal(*weights), "the filter goes by it as well"


def test_without_a_thing_all_stays_as_it_is() -> None:
    parts = np.full((PARTS, PARTS), HAND_PART, np.uint8)
    whole, rest = seen_with(parts)
    assert rest is whole
    parts[0, :3] = THING_PART
    assert seen_with(parts)[1].thing is None, "too little for a thing"


def behind(gap_m: float, kind: int = BACKGROUND_PART) -> tuple[Observation, Detection]:
    """A hand whose lower half is behind a surface, which the network says is `kind`; and what it
    says of the hand.
    """
    seen = view_of(image_of(hand_at()), track_of(hand_at()), DETECTION).observation
    before = torch.zeros_like(seen.hand)
    before[int(seen.hand.nonzero()[:, 0].float().mean()) :] = True
    depth = torch.where(before, float(CENTRE[2]) - gap_m, seen.depth_m)
    hidden = replace(seen, depth_m=depth, occluder=before, hand=seen.hand & ~before)
    return hidden, replace(DETECTION, parts=parts_of(np.full((PARTS, PARTS), kind, np.uint8)))


@pytest.mark.parametrize("kind", [FOREARM_PART, BACKGROUND_PART, HAND_PART, THING_PART])
def test_the_own_arm_alone_hides_nothing_of_the_hand_that_it_is_before(kind: int) -> None:
    observation, detection = behind(0.06, kind)
    known = with_own_arm(observation, detection)
    own = kind == FOREARM_PART
    assert bool(known.occluder.any()) is not own
    assert torch.equal(known.hand, observation.hand | (observation.occluder & own))


def test_a_hand_that_is_mostly_covered_is_held_where_it_was() -> None:
    view = viewed(0.0)
    seen = view.observation
    near, everything = torch.full_like(seen.depth_m, 0.3), torch.ones_like(seen.occluder)
    table = proposed(replace(view, observation=replace(seen, depth_m=near, occluder=everything)))
    assert torch.equal(table.pose, view.track.pose)
    assert len(proposed(view).pose) == 3


def chosen(*rows: tuple[float, float, bool, float], hidden: bool = False) -> tuple[int, bool]:
    """The row, and whether the hand moves, of hypotheses with a place and a finger, both in metres;
    whether it is the detector's; and its log posterior.
    """
    place, finger, detected, value = (torch.tensor(column) for column in zip(*rows, strict=True))
    joints = place[:, None, None].repeat(1, 21, 3) / math.sqrt(3)
    joints[:, 5:9] += finger[:, None, None] / math.sqrt(3)
    poses = torch.arange(len(rows))[:, None] * torch.ones(27)
    pose, moved = select(Hypotheses(poses, detected.numpy(), value), joints, hidden)
    return int(pose[0, 0]), moved


@pytest.mark.parametrize(
    ("place", "detected", "gain", "hidden", "taken", "moved"),
    [
        (0.0, False, 1e-4, False, True, False),
        (0.0, False, -1e-4, False, False, False),
        (0.0, True, _MARGIN + 1e-3, False, True, False),
        (0.0, True, _MARGIN - 1e-3, False, False, False),
        (0.05, True, _MARGIN + 1e-3, False, True, True),
        (0.05, False, 1.0, False, True, False),
        (0.0, True, _MARGIN + 1e-3, True, True, False),
        (0.05, True, 1.9, True, False, False),
        (0.05, True, 2.1, True, True, True),
    ],
)
def test_the_detector_needs_a_margin_and_alone_moves_a_hand(
    place: float, detected: bool, gain: float, hidden: bool, taken: bool, moved: bool
) -> None:
    """Where something hides the hand, a pose elsewhere needs a large lead."""
    others = [(0.0, 0.0, False, 0.0), (0.0, 0.0, False, -0.5), (0.1, 0.0, True, -9.0)]
    found = chosen((place, 0.06, detected, gain), *others, hidden=hidden)
    assert found == (0 if taken else 1, moved)


def test_where_no_pose_explains_anything_the_last_frame_s_fingers_stay() -> None:
    assert chosen((0.0, 0.0, False, -math.inf), (0.0, 0.06, True, -math.inf)) == (0, False)
