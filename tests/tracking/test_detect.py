"""The networks' part in a frame: where is looked, when a track gives way, and to whom."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.tracking import make_tracker
from toftrack.tracking.prior import LastSeen
from toftrack.tracking.refining import Refined, challenged

from toftrack.compute.pace import FRAME_S
from toftrack.detector.hand_detector import SAME_PLACE_M
from toftrack.frames import DepthImage
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking.detect import detect, expected_of, hypotheses, keypoints_of, track_of
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import Track, TrackerState
from toftrack.tracking.step import _hand_reported

pytestmark = pytest.mark.usefixtures("one_thread")

K = np.array([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])
IMAGE = DepthImage(np.full((144, 176), 0.9, np.float32), K, 0, 0.0)


@cache
def plain_model() -> TrackerModel:
    return make_tracker("hand.shape=default", "hand.side=right", "filter.particles=20").model


def model_with(reported: FixedDetector) -> TrackerModel:
    return replace(plain_model(), detector=reported)


def hand_at(x: float, z: float = 0.5) -> torch.Tensor:
    """(1, 27) an open palm."""
    state = torch.zeros(1, 27)
    state[0, :3] = torch.tensor([x, 0.08, z])
    return state


def track_at(x: float, **changes: object) -> Track:
    return replace(track_of(hand_at(x), plain_model()), age_s=1.0, **changes)


def state_of(track: Track | None, seen: LastSeen | None = None) -> TrackerState:
    return replace(plain_model().first_state(0), track=track, seen=seen)


def middle(track: Track) -> np.ndarray:
    """(3,) of the palm."""
    return detection_of(track.pose).centre_m.numpy()


def test_without_a_track_the_best_place_of_all_is_taken() -> None:
    hands = [detection_of(hand_at(0.1)), detection_of(hand_at(-0.1))]
    reported = FixedDetector(hands)
    track, detection = detect(state_of(None), FRAME_S, IMAGE, model_with(reported))
    assert track is None and detection is hands[0] and reported.compared == []


def test_without_a_hand_there_is_none() -> None:
    reported = FixedDetector()
    assert detect(state_of(None), FRAME_S, IMAGE, model_with(reported)) == (None, None)


def test_a_believed_track_is_looked_at_and_nothing_is_searched() -> None:
    reported = FixedDetector([detection_of(hand_at(0.3))])
    track = track_at(0.05)
    kept, detection = detect(state_of(track), FRAME_S, IMAGE, model_with(reported))
    assert kept is track and detection is not None and reported.likely is None
    assert len(reported.compared) == 1
    assert reported.compared[0] == pytest.approx(middle(track)[None], abs=0.01)


def test_a_moving_track_is_looked_at_where_it_will_be() -> None:
    reported = FixedDetector()
    track = track_at(0.0)
    velocity = torch.zeros_like(track.velocity)
    velocity[0] = 0.8
    detect(state_of(replace(track, velocity=velocity)), FRAME_S, IMAGE, model_with(reported))
    moved = reported.compared[0][0, 0] - middle(track)[0]
    assert 0.2 * 0.8 * FRAME_S < moved <= 0.8 * FRAME_S


def test_a_hand_at_the_lens_is_looked_at_all_the_same() -> None:
    reported = FixedDetector()
    close = replace(track_of(hand_at(0.0, z=0.01), plain_model()), age_s=1.0)
    detect(state_of(close), FRAME_S, IMAGE, model_with(reported))
    assert reported.compared[0][0, 2] >= 0.1


def test_a_doubted_track_gives_way_to_a_hand_found_elsewhere() -> None:
    elsewhere = detection_of(hand_at(SAME_PLACE_M + 0.05))
    reported = FixedDetector([elsewhere])
    doubted = track_at(0.0, doubted=True)
    track, detection = detect(state_of(doubted), FRAME_S, IMAGE, model_with(reported))
    assert track is None and detection is elsewhere


def test_a_doubted_track_stays_where_the_hand_is_found_there_or_nowhere() -> None:
    doubted = track_at(0.0, doubted=True)
    for found in ([detection_of(hand_at(0.5 * SAME_PLACE_M))], []):
        reported = FixedDetector(found)
        track, detection = detect(state_of(doubted), FRAME_S, IMAGE, model_with(reported))
        assert track is doubted and detection is not None and len(reported.compared) == 1


def likely_after(age_s: float | None) -> FixedDetector:
    """Searched so long after a hand was last believed in the middle."""
    reported = FixedDetector()
    seen = None if age_s is None else LastSeen(track_at(0.0).mean, age_s)
    detect(state_of(None, seen), FRAME_S, IMAGE, model_with(reported))
    assert reported.likely is not None
    return reported


def test_a_hand_has_not_jumped_since_it_was_seen() -> None:
    here = middle(track_at(0.0))
    aside = here + np.array([0.3, 0.0, 0.0])
    at_once, later = (likely_after(age_s).likely for age_s in (0.04, 0.8))
    assert at_once(here) == pytest.approx(0, abs=0.01) and at_once(aside) < -1
    assert at_once(aside) < later(aside) < 0, "it may have moved on meanwhile"
    assert at_once(here + 0.02) > at_once(here + 0.05) > at_once(aside)


@pytest.mark.parametrize("age_s", [None, 60.0])
def test_a_hand_never_seen_or_long_ago_may_be_anywhere(age_s: float | None) -> None:
    likely = likely_after(age_s).likely
    assert likely(np.array([0.5, 0.0, 0.5])) == likely(np.array([0.0, 0.0, 1.0])) == 0


def considered(
    track: Track, rival: torch.Tensor | None, frames: int, hidden: bool = False, **settings
):
    """The track and pose after so many frames with such a rival."""
    model = model_with(FixedDetector(**settings))
    frame = SimpleNamespace(model=model, hidden=hidden, detection=object())
    own = track.pose
    for _ in range(frames):
        track, pose, _ = challenged(track, Refined(own, None, rival), FRAME_S, frame)
    return track, pose


def test_a_rival_takes_over_only_after_a_while() -> None:
    track, rival = track_at(0.0), hand_at(0.04)
    for frames in (1, 2):
        kept, pose = considered(track, rival, frames, rival_frames=3)
        assert torch.equal(pose, track.pose) and kept.particles is track.particles
        assert kept.challenged_s > 0
    new, pose = considered(track, rival, 3, rival_frames=3)
    assert torch.equal(pose, rival) and torch.equal(new.pose, rival)
    assert new.age_s == new.challenged_s == 0
    assert len(new.particles) == len(track.particles)


def test_a_rival_that_is_gone_for_a_frame_begins_anew() -> None:
    track, rival = track_at(0.0), hand_at(0.04)
    for _ in range(4):
        track, _ = considered(track, rival, 2, rival_frames=3)
        track, pose = considered(track, None, 1)
        assert torch.equal(pose, track.pose) and track.challenged_s == 0


def test_no_rival_takes_over_while_something_hides_the_hand() -> None:
    track, rival = track_at(0.0), hand_at(0.04)
    kept, pose = considered(track, rival, 20, hidden=True, rival_frames=1)
    assert torch.equal(pose, track.pose) and kept.challenged_s == 0


def test_a_track_that_has_just_begun_gives_way_at_once() -> None:
    begun, rival = replace(track_at(0.0), age_s=0.0), hand_at(0.04)
    assert torch.equal(considered(begun, rival, 1, rival_frames=5)[1], rival)


def test_the_networks_say_the_length_that_a_track_begins_with() -> None:
    model = make_tracker("filter.particles=20").model
    first = model.first_state(0)
    said = detection_of(hand_at(0.0), log_size=math.log(0.8))
    belief = _hand_reported(first, None, said, model)
    assert model.hand("right", belief).shape.hand_length_m == pytest.approx(0.152, rel=1e-3)
    # A track goes on as it began, and a hand that is not fitted stays as it is.
    followed = _hand_reported(first, track_at(0.0), said, model)
    assert model.hand("right", followed) is model.hand("right", first.size)
    fixed = replace(model, adapt=replace(model.adapt, fixed=True))
    assert _hand_reported(first, None, said, fixed).applied == first.size.applied


def test_what_is_expected_of_a_hand_that_is_not_tracked_yet() -> None:
    detection = detection_of(hand_at(0.1))
    expected = expected_of(detection)
    z = detection.joints_m[0, :, 2]
    assert (expected.nearest_m, expected.farthest_m) == (float(z.min()), float(z.max()))
    assert expected.centre_m == pytest.approx(tuple(detection.centre_m.tolist()))


def test_landmarks_are_trusted_no_more_than_is_set() -> None:
    model = model_with(FixedDetector(keypoint_m=0.02, keypoint_sigmas=2.0))
    detection = detection_of(hand_at(0.0))
    assert (keypoints_of(detection, model).sigma_m == 0.02).all()
    unsure = replace(detection.keypoints, sigma_m=torch.full((21,), 0.03))
    assert keypoints_of(replace(detection, keypoints=unsure), model).sigma_m == pytest.approx(0.06)


def test_only_likely_hypotheses_compete_and_at_least_one() -> None:
    model = plain_model()
    hand = model.hand("right", first_shape())
    detection = detection_of(torch.cat([hand_at(0.01 * i) for i in range(6)]))
    states, log_probability = hypotheses(detection, hand, 4)
    assert 1 <= len(states) == len(log_probability) < 4, "the third has a chance of 2 %"
    assert len(hypotheses(detection, hand, 1)[0]) == 1
    assert len(hypotheses(detection, hand, 0)[0]) == 1
    assert states[0, :3] == pytest.approx(hand_at(0.0)[0, :3], abs=1e-4)
