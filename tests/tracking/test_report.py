"""Which hand is reported in which slot, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.rendered import EMPTY, any_hand_model, hand_at, scene_of, state_of, track_of, view_of

from toftrack.compute.pace import Spans
from toftrack.frames.estimate import Estimate
from toftrack.frames.frame import DepthImage
from toftrack.tracking.confidence import JOINT_FEATURES, Status
from toftrack.tracking.report import TrackResult, covariance_of, report
from toftrack.tracking.state import SideEvidence, Track, TrackerState

IMAGE = replace(EMPTY, index=5, timestamp_s=0.2)
SIDES = {"right": 5.0, "left": -5.0, "perhaps right": 0.3, "perhaps left": -0.3, "": 0.0}


def hand(number: int, side: str = "right", lost: bool = False, **changes: object) -> Track:
    """A track with evidence for a side."""
    usual = {
        "number": number,
        "side": side.removeprefix("perhaps ") or "right",
        "evidence": SideEvidence(SIDES[side], comparisons=9),
        "believed_s": 0.2 * lost,
        "log_odds": -1.0 if lost else 2.0,
    }
    return track_of(hand_at(0.1 * number), any_hand_model(), **(usual | changes))


def followed(track: Track) -> TrackResult:
    """Its pose is what was found; the wrist is where its number says."""
    model = any_hand_model()
    lost = not track.reliable
    status = Status("searching" if lost else "tracking", lost, confidence=0.9)
    return TrackResult(view_of(EMPTY, track, model=model), track, track.cloud, 0.8, status)


def before(hands: int = 1, told: str | None = None, **slot: object) -> TrackerState:
    """With changes of the first slot."""
    state = state_of(hands=hands, model=any_hand_model(), told=told)
    first = told or "right"
    sides = [first, "left" if first == "right" else "right"] * hands
    slots = [replace(one, side=side) for one, side in zip(state.slots, sides, strict=False)]
    return replace(state, slots=(replace(slots[0], **slot), *slots[1:]))


def reported(
    state: TrackerState, *tracks: Track, image: DepthImage = IMAGE
) -> tuple[TrackerState, tuple[Estimate, ...]]:
    each = [followed(track) for track in tracks]
    state = replace(state, tracks=tracks)
    scene = scene_of(*tracks, image=image, model=any_hand_model())
    state, infos, estimates = report(state, each, scene, Spans())
    assert [info is None for info in infos] == [slot.track < 0 for slot in state.slots]
    assert all(info is None or set(info.seconds) == {"rest"} for info in infos)
    return state, estimates


def numbers(state: TrackerState, *tracks: Track) -> list[int]:
    """Of the tracks in the slots; -1 = none."""
    return [slot.track for slot in reported(state, *tracks)[0].slots]


RIGHT, LEFT = hand(0, "right"), hand(1, "left")
POINTING, PALM = hand(0, log_odds=0.5), hand(1, "left", log_odds=2.5)
HERE = {"track": 1, "known": "right"}
"""Of the first slot: the second track was there before."""
CASES = {
    "of two hands the right one": (before(told="right"), [hand(0, "left"), hand(1)], [1]),
    "of two hands the left one": (before(told="left"), [hand(0, "left"), hand(1)], [0]),
    "the one that is likelier of the told side": (
        before(told="right"),
        [hand(0, "perhaps left"), hand(1, "perhaps right")],
        [1],
    ),
    "whichever was first": (before(), [hand(0, "left"), hand(1)], [0]),
    "whichever was first, too": (before(), [RIGHT, LEFT], [0]),
    "a believed one before a lost one": (before(), [hand(0, lost=True), hand(1)], [1]),
    "a lost one before one that was never believed": (
        before(),
        [hand(0, confirmed=False), hand(1, lost=True)],
        [1],
    ),
    # The one that is held out comes first, see detect.held_out_first.
    "the first one though another is seen better": (before(), [POINTING, PALM], [0]),
    "but not if it is probably wrong": (before(), [hand(0, log_odds=-0.5), PALM], [1]),
    "nor if the other one comes back": (before(known="left"), [POINTING, PALM], [1]),
    "one keeps the only slot": (before(1, **HERE), [hand(0), hand(1)], [1]),
    "one keeps the first of two slots": (before(2, **HERE), [hand(0), hand(1)], [1, 0]),
    "one keeps the first of four slots": (before(4, **HERE), [hand(0), hand(1)], [1, 0, -1, -1]),
    "one keeps the only slot while it is lost": (
        before(1, **HERE),
        [hand(0), hand(1, lost=True, log_odds=1.2)],
        [1],
    ),
    "one keeps the first of two slots while it is lost": (
        before(2, **HERE),
        [hand(0), hand(1, lost=True, log_odds=1.2)],
        [1, 0],
    ),
    # As when an elbow was taken for the hand while something hid it.
    "one that is much surer takes the only slot": (
        before(**HERE),
        [hand(0, log_odds=2.5), hand(1, log_odds=0.0)],
        [0],
    ),
    "one that is a little surer does not": (
        before(**HERE),
        [hand(0, log_odds=2.5), hand(1, log_odds=1.5)],
        [1],
    ),
    "of the other side than told into the second slot": (
        before(2, "right"),
        [hand(0, "left")],
        [-1, 0],
    ),
    "of the told side into the first": (before(2, "left"), [hand(0, "left")], [0, -1]),
    "of more hands than slots the first ones": (before(2), [RIGHT, LEFT, hand(2)], [0, 1]),
    # Where no side was said, a hand that comes may be the first one again.
    "one of the same side": (before(known="right", away_s=0.5), [hand(1)], [1]),
    "none of the other side": (before(known="right", away_s=0.5), [LEFT], [-1]),
    "one of the other side long after": (before(known="right", away_s=3.0), [LEFT], [1]),
}


@pytest.mark.parametrize(("state", "tracks", "expected"), CASES.values(), ids=CASES)
def test_tracks_come_into_slots(
    state: TrackerState, tracks: list[Track], expected: list[int]
) -> None:
    assert numbers(state, *tracks) == expected
    assert numbers(state, *tracks[::-1]) == expected, "in whichever row"


def test_the_first_hand_takes_the_only_slot_when_it_is_believed_later_than_another() -> None:
    """As the one held out, which is first, after a farther one that is seen better."""
    tentative = hand(0, confirmed=False)
    state, _ = reported(before(), tentative, LEFT)
    assert state.slots[0].track == 1 and state.slots[0].known is None
    assert numbers(state, tentative, LEFT) == [1]
    assert numbers(state, RIGHT, LEFT) == [0]
    alone, _ = reported(before(), LEFT)
    assert numbers(alone, RIGHT, LEFT) == [1], "of one that comes later it keeps the slot"


@pytest.mark.parametrize("told", ["right", "left"])
@pytest.mark.parametrize("first", ["right", "left"])
def test_of_two_slots_the_first_is_of_the_told_side(told: str, first: str) -> None:
    second = "left" if first == "right" else "right"
    state, estimates = reported(before(2, told), hand(0, first), hand(1, second))
    assert [slot.track for slot in state.slots] == ([0, 1] if first == told else [1, 0])
    assert [one.side for one in estimates] == [told, "left" if told == "right" else "right"]
    assert not any(one.lost for one in estimates)


def test_where_no_side_was_said_two_hands_come_in_their_order_and_back_into_their_slots() -> None:
    state, _ = reported(before(2), hand(0, "left"), hand(1, "right"))
    assert [slot.track for slot in state.slots] == [0, 1]
    state, _ = reported(state)
    assert [slot.track for slot in state.slots] == [-1, -1]
    assert [slot.side for slot in state.slots] == ["left", "right"]
    assert numbers(state, hand(2, "right")) == [-1, 2]
    assert numbers(state, hand(2, "right"), hand(3, "left")) == [3, 2]


def test_four_hands_of_any_sides_each_have_a_slot_and_keep_it() -> None:
    tracks = [hand(at, side) for at, side in enumerate(("right", "right", "left", "right"))]
    state, estimates = reported(before(4, "right"), *tracks)
    assert [slot.track for slot in state.slots] == [0, 1, 2, 3]
    assert len({float(one.joints_m[0, 0]) for one in estimates}) == 4
    state, _ = reported(state, tracks[0], tracks[2], tracks[3])
    assert [slot.track for slot in state.slots] == [0, -1, 2, 3]
    assert numbers(state, tracks[0], tracks[2], tracks[3], hand(4)) == [0, 4, 2, 3]


@pytest.mark.parametrize("hands", [1, 2, 4])
def test_a_hand_of_which_a_frame_shows_nothing_keeps_its_slot(hands: int) -> None:
    tracks = [hand(at, side) for at, side in enumerate(("right", "left", "right", "left"))][:hands]
    state, _ = reported(before(hands), *tracks)
    scene = scene_of(*tracks, image=IMAGE, model=any_hand_model())
    blank, _, estimates = report(state, [], scene, Spans())
    assert all(one.lost for one in estimates)
    assert [slot.track for slot in blank.slots] == [slot.track for slot in state.slots]
    gone, *_ = report(replace(state, tracks=()), [], scene, Spans())
    assert {slot.track for slot in gone.slots} == {-1}


def test_what_is_taken_for_a_hand_meanwhile_does_not_change_which_one_may_come_back() -> None:
    state, _ = reported(before(), hand(0, "left"))
    for side in ("left", "right"):  # what is no hand seems of one side and of the other
        state, _ = reported(state, hand(1, side, confirmed=False, lost=True))
    assert [slot.track for slot in state.slots] == [1]
    assert numbers(state, hand(2, "left")) == [2]


def test_a_hand_of_the_other_side_than_was_said_is_flagged() -> None:
    _, (estimate,) = reported(before(told="left"), hand(0, "right"))
    assert estimate.lost and estimate.state_name == "other hand" and not estimate.joint_ok.any()
    assert estimate.side == "right" and estimate.side_probability > 0.9
    _, (unsure,) = reported(before(told="right"), hand(0, ""))
    assert not unsure.lost and unsure.side_probability == 1.0


@pytest.mark.parametrize("side", ["right", "left", "perhaps right", "perhaps left"])
def test_where_no_side_was_said_a_wrong_one_makes_the_estimate_wrong(side: str) -> None:
    _, (estimate,) = reported(before(), hand(0, side))
    sure = 0.99 if "perhaps" not in side else 0.57
    assert estimate.side_probability == pytest.approx(sure, abs=0.01)
    assert estimate.confidence == pytest.approx(0.9 * estimate.side_probability)
    assert side.endswith(estimate.side) and not estimate.lost


def test_an_estimate_whose_side_makes_it_improbable_is_lost() -> None:
    one = followed(hand(0, "perhaps right"))
    doubtful = replace(one, status=replace(one.status, confidence=0.3))
    state = replace(before(), tracks=(one.track,))
    scene = scene_of(one.track, image=IMAGE, model=any_hand_model())
    _, _, (estimate,) = report(state, [doubtful], scene, Spans())
    assert estimate.lost and estimate.confidence < 0.2 and not estimate.joint_ok.any()


def test_the_only_hand_that_was_lost_is_reported_where_it_was_last_believed() -> None:
    state, (seen,) = reported(before(), hand(0))
    assert state.slots[0].away_s == 0
    for again in range(2):
        state, (estimate,) = reported(state, image=replace(IMAGE, index=6 + again))
        assert estimate.lost and estimate.state_name == "lost" and estimate.index == 6 + again
        assert estimate.score == 0 and state.slots[0].track == -1
        np.testing.assert_array_equal(estimate.joints_m, seen.joints_m)


def test_a_slot_of_several_without_a_hand_is_empty() -> None:
    state, _ = reported(before(2), hand(0, "right"), hand(1, "left"))
    state, (first, second) = reported(state, hand(0, "right"))
    assert not first.lost and first.joint_ok.any()
    assert second.lost and second.state_name == "lost"
    assert second.side == "" and np.isnan(second.joints_m).all()
    assert (second.index, second.timestamp_s) == (IMAGE.index, IMAGE.timestamp_s)
    assert state.slots[1].side == "left", "which hand it was is remembered"


def test_what_was_believed_last_stands_while_a_hand_is_lost() -> None:
    state, (seen,) = reported(before(), hand(0))
    state, _ = reported(state, hand(0, lost=True))
    assert not state.slots[0].last.lost
    np.testing.assert_array_equal(state.slots[0].last.joints_m, seen.joints_m)


def test_gestures_are_smoothed_over_a_hand_s_frames_and_not_from_one_hand_to_another() -> None:
    state, (palm,) = reported(before(), hand(0))
    fist = hand_at()
    fist[:, 18:27] = 1.3

    def gesture(state: TrackerState, number: int) -> np.ndarray:
        return reported(state, replace(hand(number), pose=fist))[0].slots[0].gesture.probabilities

    assert palm.gesture == "palm"
    np.testing.assert_allclose(gesture(state, 1), gesture(before(), 1), rtol=1e-5)
    assert np.abs(gesture(state, 0) - gesture(before(), 0)).max() > 0.1


@pytest.mark.parametrize(("number", "holds"), [(0, True), (1, False)])
def test_what_is_known_of_a_hand_s_joints_holds_and_not_of_another_hand_s(
    number: int, holds: bool
) -> None:
    features = np.full((21, len(JOINT_FEATURES)), 7.0)
    state, _ = reported(before(track=0, joint_features=features), hand(number))
    found = state.slots[0].joint_features
    assert (found[:, :3] == 7.0 * holds).all(), "the network was not asked"
    assert (found != 7.0).any()


def test_a_lost_hand_was_not_believed_now() -> None:
    state, _ = reported(before(track=0, away_s=3.0), hand(0, lost=True))
    assert state.slots[0].away_s == 3.0


def test_of_several_slots_one_that_a_frame_does_not_show_forgets_its_gesture() -> None:
    track = hand(0)
    state, _ = reported(before(2), track)
    state, _, _ = report(state, [], scene_of(track, image=EMPTY, model=any_hand_model()), Spans())
    assert state.slots[0].track == 0 and state.slots[0].gesture is None


def test_landmarks_of_a_lost_hand_are_of_the_image_that_is_there() -> None:
    state, (seen,) = reported(before(), hand(0))
    larger = replace(IMAGE, depth_m=np.zeros((288, 352), np.float32))
    _, (lost,) = reported(state, image=larger)
    assert not np.allclose(lost.landmarks[:, 0], seen.landmarks[:, 0])


def test_particles_that_turn_about_the_wrist_leave_its_place_certain() -> None:
    model, cloud = any_hand_model(), track_of(hand_at()).cloud
    particles = cloud.particles.clone()
    particles[:, 3] += torch.linspace(-0.3, 0.3, len(particles))
    covariance = covariance_of(replace(cloud, particles=particles), model)
    least = model.model_variance[:3].numpy()
    assert np.diag(covariance)[:3] == pytest.approx(least, rel=1e-3)
