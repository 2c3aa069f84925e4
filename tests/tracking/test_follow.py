"""What becomes of tracks after a frame: moved, judged, ended, and each hand followed once."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    EMPTY,
    hand_at,
    image_of,
    right_hand_model,
    scene_of,
    state_of,
    track_of,
    view_of,
)
from helpers.settings import confidence_model

from toftrack.compute.pace import FRAME_S, Duration, Spans
from toftrack.detector.network import PARTS
from toftrack.detector.parts import HAND_PART, Parts
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.tracking.association import keep_tracks
from toftrack.tracking.candidates import View
from toftrack.tracking.confidence import LogOdds
from toftrack.tracking.report import TrackResult
from toftrack.tracking.state import ParticleSet, Track
from toftrack.tracking.step import filter_tracks, miss_track, step, update_track

HERE, THERE = hand_at(0.0), hand_at(SAME_PLACE_M + 0.05)
IMAGE = image_of(HERE, THERE)


def filtered(view: View, **changes: Any) -> ParticleSet:
    """The particles of the only track, which the slot shows."""
    state = replace(state_of(view.track), **changes)
    scene = scene_of(view.track, image=IMAGE, model=view.model)
    return filter_tracks([view], state, scene, 0, Spans())[view.track.cloud]


def test_what_is_drawn_for_a_hand_does_not_depend_on_others() -> None:
    views = [view_of(IMAGE, replace(track_of(at), number=n)) for n, at in enumerate((HERE, THERE))]
    tracks = [view.track for view in views]
    state, scene = state_of(*tracks, hands=2), scene_of(*tracks, image=IMAGE)

    def drawn(some: list[View]) -> list[ParticleSet]:
        return list(filter_tracks(some, state, scene, 3, Spans()).values())

    both, (alone,) = drawn(views), drawn(views[1:])
    torch.testing.assert_close(both[1].particles, alone.particles, atol=0, rtol=0)
    torch.testing.assert_close(both[1].weights, alone.weights, atol=0, rtol=0)


def followed(track: Track, odds: float, at: torch.Tensor = HERE) -> TrackResult:
    """After a frame in which the network sees the hand somewhere, with these log odds."""
    plain = confidence_model(memory=0.0, whole=0.0)
    plain = replace(plain, log_odds=LogOdds(odds, {}), whole_odds=LogOdds(0.0, {}))
    model = replace(right_hand_model(), lost=plain)
    view = view_of(IMAGE, track, detection_of(at), model=model)
    scene = scene_of(track, image=IMAGE, model=model)
    return update_track(view, filtered(view), scene, Spans())


@pytest.mark.parametrize(("odds", "lost"), [(2.0, False), (-4.0, True)])
@pytest.mark.parametrize("confirmed", [False, True])
def test_a_track_is_confirmed_once_and_not_believed_while_it_is_lost(
    odds: float, lost: bool, confirmed: bool
) -> None:
    after = followed(track_of(HERE, confirmed=confirmed), odds)
    assert after.status.lost == lost and after.track.reliable == (not lost)
    assert after.track.confirmed == (confirmed or not lost)
    assert after.track.believed_s == pytest.approx(FRAME_S * lost)
    assert after.track.age.seconds == pytest.approx(1.0 + FRAME_S)


def test_the_particles_follow_the_pose_that_was_found() -> None:
    after = followed(track_of(hand_at(-0.01)), 2.0).track
    assert after.pose[0, :3].numpy() == pytest.approx(HERE[0, :3].numpy(), abs=0.003)
    assert float(after.cloud.mean[0, 0]) == pytest.approx(float(after.pose[0, 0]), abs=1e-4)
    assert float(after.cloud.particles[:, 0].mean()) == pytest.approx(0.0, abs=0.01)
    assert after.velocity[0] > 0


def test_a_pose_of_another_place_begins_the_track_anew_there() -> None:
    wrong = track_of(hand_at(0.2), doubtful=Duration(0.1), trend=torch.ones(27))
    after = followed(wrong, 2.0, at=THERE).track
    assert after.pose[0, 0] == pytest.approx(float(THERE[0, 0]), abs=0.01)
    assert after.age == Duration(FRAME_S) and after.number == wrong.number
    assert not after.velocity.any() and after.trend.isnan().all()


def test_it_is_kept_what_was_asked_and_what_hides_the_hand() -> None:
    track = track_of(HERE, asked_s=0.1, nearest_m=0.3)
    scene = scene_of(track, image=IMAGE)
    plain, seen = view_of(IMAGE, track), view_of(IMAGE, track, detection_of(HERE))
    hand = plain.observation.hand
    before = torch.zeros_like(hand)
    before[int(hand.nonzero()[:, 0].float().mean()) :] = True
    part = replace(plain.observation, occluder=hand & before, hand=hand & ~before)
    hidden = replace(plain, observation=part)
    views = plain, seen, hidden
    after = [update_track(view, filtered(view), scene, Spans()).track for view in views]
    assert [one.asked_s for one in after[:2]] == pytest.approx([0.1, 0.0])
    assert [one.nearest_m for one in after] == pytest.approx([0.0, 0.0, hidden.expected_m])


def test_the_particles_of_a_hand_that_nobody_asked_for_are_only_moved_on() -> None:
    track = track_of(HERE)
    track = replace(track, velocity=torch.full_like(track.velocity, 0.1))
    view = view_of(IMAGE, track)
    shown, other = filtered(view), filtered(view, slots=())
    assert shown.particles.std(0).any() and not other.particles.std(0).any()
    assert float(other.particles[:, 0].mean()) == pytest.approx(float(other.mean[0, 0]))
    torch.testing.assert_close(other.weights, track.cloud.weights)
    assert 0.0 < float(other.mean[0, 0]) < 0.1 * FRAME_S
    doubtful = replace(view, track=replace(track, confirmed=False))
    assert filtered(doubtful, slots=()).particles.std(0).any()


@pytest.mark.parametrize(
    ("odds", "asked_s", "rests"),
    [(3.0, 0.0, True), (3.0, 0.04, True), (3.0, 0.08, False), (0.0, 0.0, False)],
)
def test_a_sure_hand_that_nobody_asked_for_is_looked_at_in_every_third_frame(
    odds: float, asked_s: float, rests: bool
) -> None:
    other = replace(track_of(THERE), log_odds=odds, asked_s=asked_s)
    state = state_of(track_of(HERE), other)
    after, _, _ = step(state, replace(IMAGE, timestamp_s=FRAME_S), right_hand_model())
    assert after.tracks[0].asked_s == 0
    moved = next(track for track in after.tracks if track.number == 1)
    assert (moved.asked_s > asked_s) == rests
    assert moved.age.seconds == pytest.approx(other.age.seconds + FRAME_S)
    torch.testing.assert_close(moved.pose[:, :3], THERE[:, :3], atol=0.01, rtol=0.0)


def test_particles_are_filtered_before_a_detection_is_waited_for(monkeypatch) -> None:
    order: list[str] = []
    model, start = right_hand_model(), FixedDetector.start
    score = type(model.likelihood).log_score

    def noted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args: (order.append(name), function(*args))[1]

    def waits(*args: Any) -> Callable[..., Any]:
        return noted("waited", start(*args))

    monkeypatch.setattr(FixedDetector, "start", waits)
    monkeypatch.setattr(type(model.likelihood), "log_score", noted("scored", score))
    step(state_of(track_of(HERE)), replace(IMAGE, timestamp_s=FRAME_S), model)
    assert order.index("waited") == model.filter.passes


FIST = HERE.clone()
FIST[0, 2] += 0.015
for finger in range(12, 27, 4):
    FIST[0, finger : finger + 3] = 1.3
SURE, LESS_SURE = track_of(HERE, log_odds=4.0), track_of(HERE, log_odds=3.0)
NEW = {"confirmed": False, "age": Duration(FRAME_S)}
LONG_DOUBTED = {"doubtful": Duration(1.0)}
WAITING = track_of(THERE, confirmed=False, age=Duration(0.6))


@pytest.mark.parametrize(
    ("tracks", "left"),
    [
        ((SURE, LESS_SURE), [0]),
        ((LESS_SURE, SURE), [1]),
        ((SURE, track_of(HERE, log_odds=9.0, **NEW)), [0]),
        ((track_of(HERE, log_odds=1.0, **NEW), track_of(HERE, log_odds=9.0, **NEW)), [1]),
        ((SURE, track_of(FIST, log_odds=3.0)), [0]),
        ((SURE, LESS_SURE, track_of(HERE, log_odds=5.0)), [2]),
        ((SURE, track_of(hand_at(0.05), log_odds=3.0)), [0, 1]),
        ((SURE, track_of(THERE, **NEW)), [0, 1]),
        ((track_of(HERE, **LONG_DOUBTED), track_of(THERE, **LONG_DOUBTED, **NEW)), []),
        ((track_of(HERE, log_odds=9.0, **LONG_DOUBTED), LESS_SURE), [1]),
        ((SURE, WAITING), [0]),
        ((WAITING,), [0]),
        ((WAITING, track_of(HERE, confirmed=False)), [0, 1]),
    ],
    ids=[
        "the surer one",
        "whichever row it is in",
        "one that was never confirmed ends",
        "of two that were not, the less sure one",
        "of two in one palm with other fingers, too",
        "of three one is left",
        "two that lie beside each other go on",
        "and two that are apart",
        "what nobody sees ends, whether it was a hand or not",
        "and takes nobody with it",
        "a tentative one ends beside a confirmed one",
        "but not alone",
        "nor beside a tentative one",
    ],
)
def test_of_tracks_on_one_hand_the_surest_goes_on_and_none_that_is_doubted_for_long(
    tracks: tuple[Track, ...], left: list[int]
) -> None:
    numbered = [replace(track, number=at) for at, track in enumerate(tracks)]
    state = keep_tracks(state_of(), numbered, right_hand_model())
    assert [track.number for track in state.tracks] == left


def test_time_goes_on_with_the_images_and_not_where_a_clock_goes_back() -> None:
    state = replace(state_of(timestamp_s=1.0), searched_s=0.2)
    state = replace(state, slots=(replace(state.slots[0], away_s=0.1),))
    for now_s, passed in ((1.5, 0.5), (0.2, 0.0), (float("nan"), 0.0)):
        later = state.at(replace(IMAGE, index=7, timestamp_s=now_s))
        assert later.searched_s == pytest.approx(0.2 + passed) and later.next_index == 8
        assert later.slots[0].away_s == pytest.approx(0.1 + passed)


def test_what_hides_a_hand_is_not_expected_to_be_it() -> None:
    plain, behind = track_of(HERE), track_of(HERE, nearest_m=0.55)
    scene = scene_of(plain, behind, image=IMAGE)
    free, hidden = (hand.expected.nearest_m for hand in scene.hands)
    assert free < 0.5 and hidden == pytest.approx(0.55, abs=0.01)


def test_a_hand_that_a_frame_does_not_show_is_not_reliable_any_more() -> None:
    scene = scene_of(track_of(HERE, likely=Duration(FRAME_S)), image=EMPTY)
    after = miss_track(scene, 0)
    assert not after.likely.begun and after.doubtful.begun
    assert after.believed_s == pytest.approx(FRAME_S)


def test_hands_at_one_place_draw_different_particles() -> None:
    views = [view_of(IMAGE, replace(track_of(HERE), number=number)) for number in (0, 1)]
    tracks = [view.track for view in views]
    scene = scene_of(*tracks, image=IMAGE)
    first, second = filter_tracks(views, state_of(*tracks, hands=2), scene, 3, Spans()).values()
    assert not torch.equal(first.particles, second.particles)


def test_a_search_whose_places_wait_for_the_next_frame_is_a_search() -> None:
    image = replace(IMAGE, timestamp_s=FRAME_S)
    after, _, _ = step(state_of(track_of(HERE)), image, right_hand_model())
    assert after.searched_s == 0.0


def test_what_the_network_said_of_pixels_holds_where_it_does_not_look() -> None:
    parts = Parts(np.full((PARTS, PARTS), HAND_PART, np.uint8), np.eye(3), np.ones(3), False)
    track = track_of(HERE, parts=parts)
    view, scene = view_of(IMAGE, track), scene_of(track, image=IMAGE)
    particles = filter_tracks([view], state_of(track), scene, 0, Spans())[track.cloud]
    assert update_track(view, particles, scene, Spans()).track.parts is parts
