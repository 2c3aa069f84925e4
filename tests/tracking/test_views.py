"""Tracks as they go into a frame: continued, begun, begun anew, changed to the other side."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    EMPTY,
    any_hand_model,
    bent,
    hand_at,
    image_of,
    scene_of,
    state_of,
    track_of,
)

from toftrack.compute.pace import Duration
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.frames.frame import DepthImage
from toftrack.hand.shape import default_hand_shape
from toftrack.refinement.shape_fit import ShapeEstimate, first_shape, with_network_length
from toftrack.tracking.association import SideDetection
from toftrack.tracking.candidates import View
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.sides import changes_side, side_log_odds
from toftrack.tracking.state import SideEvidence, Slot, Track
from toftrack.tracking.views import (
    begin_track,
    continue_track,
    known_shape,
    make_view,
    max_new_tracks,
    update_shape,
)

ELSEWHERE = SAME_PLACE_M + 0.05
HERE, THERE = hand_at(0.0), hand_at(ELSEWHERE)
BOTH = image_of(HERE, THERE)


def model() -> TrackerModel:
    return replace(any_hand_model(), detector=FixedDetector())


def seen(pose: torch.Tensor, side: str = "right", row: int = -1) -> SideDetection:
    return SideDetection(detection_of(pose, side=side), side, row)


def off_m(view: View, pose: torch.Tensor) -> float:
    """How far the joints of a view's track are from a pose's, on average."""
    joints = view.fitted.refiner.joints
    return float((joints(view.track.pose) - joints(pose)).norm(dim=-1).mean())


def gone_on(
    found: SideDetection,
    image: DepthImage = BOTH,
    told: str | None = None,
    **changes: object,
) -> View | None:
    track = track_of(HERE, number=3, **changes)
    scene = scene_of(track, image=image, model=model())
    return continue_track(scene, 0, make_view(scene, 0, scene.hands[0].track), found, told)


@pytest.mark.parametrize("found", [seen(HERE, row=0), seen(hand_at(0.02)), seen(HERE)])
def test_a_track_goes_on_where_it_is_predicted(found: SideDetection) -> None:
    view = gone_on(found)
    assert view is not None and view.track.age == Duration(1.0)
    assert view.detection is found.detection
    torch.testing.assert_close(view.track.pose, HERE)


def test_a_track_that_was_seen_elsewhere_begins_anew_there_and_is_the_same_hand() -> None:
    view = gone_on(seen(bent(THERE, 2, 0.01)), log_odds=1.0)
    assert view is not None and not view.track.age.begun
    assert off_m(view, THERE) < 0.01
    assert view.track.number == 3 and view.track.confirmed
    assert bool((view.track.cloud.particles[:, 0] > 0.9 * ELSEWHERE).all())


@pytest.mark.parametrize("believed_s", [0.0, 0.04])
def test_a_track_elsewhere_is_tentative_unless_it_was_believed_until_then(
    believed_s: float,
) -> None:
    view = gone_on(seen(THERE), confirmed=True, believed_s=believed_s)
    assert view is not None and view.track.confirmed == (believed_s == 0)


@pytest.mark.parametrize("found", [seen(HERE, row=0), seen(THERE)])
def test_a_track_does_not_go_on_where_nothing_can_be_its_hand(found: SideDetection) -> None:
    assert gone_on(found, EMPTY) is None


def test_the_time_since_a_comparison_and_since_the_last_look_goes_on() -> None:
    track = track_of(HERE, asked_s=0.1, evidence=SideEvidence(1.0, age_s=0.3))
    scene = scene_of(track, image=BOTH, model=model())
    view = make_view(scene, 0, scene.hands[0].track)
    assert view is not None and view.detection.empty
    assert view.track.evidence.age_s == pytest.approx(0.34)
    assert view.track.asked_s == pytest.approx(0.14)


def of_both(side: str = "right") -> SideDetection:
    """What is seen at the track's place, as a hand of either side."""
    other = detection_of(HERE, side="left" if side == "right" else "right")
    return replace(seen(HERE, side, 0), mirrored=other)


@pytest.mark.parametrize(
    ("image_side", "fits", "told", "side"),
    [
        ("right", 0.0, None, "right"),
        ("left", 0.0, None, "left"),
        ("left", 6.0, None, "right"),
        ("left", 0.0, "right", "right"),
        ("left", -4.0, "right", "left"),
    ],
    ids=["as it was", "likelier now", "sure for long", "told otherwise", "but surely not"],
)
def test_a_track_changes_to_the_side_that_is_likelier(
    image_side: str, fits: float, told: str | None, side: str
) -> None:
    image, evidence = image_of(HERE, side=image_side), SideEvidence(fits)
    view = gone_on(of_both(), image, told, evidence=evidence)
    assert view is not None
    track = view.track
    assert track.side == view.fitted.shape.side == side
    assert (track.evidence.fits > fits) == (image_side == "right") and track.evidence.comparisons
    changed = side != "right"
    assert track.age.begun != changed and track.number == 3
    assert changed or not changes_side(track, side_log_odds(track, [], told), told)


def began(new: Sequence[SideDetection], *tracks: Track, image: DepthImage = BOTH) -> list[View]:
    used = model()
    state = state_of(*tracks, model=used)
    scene = scene_of(*tracks, image=image, model=used)
    views = [begin_track(scene, one, 7 + at, state) for at, one in enumerate(new)]
    return [view for view in views if view is not None]


def test_a_hand_that_comes_back_keeps_the_shape_that_was_learned() -> None:
    used = model()
    state = state_of(model=used)
    learned = replace(state.slots[0].shape, poses=9.0)
    state = replace(state, slots=(replace(state.slots[0], side="right", shape=learned),))
    scene = scene_of(image=BOTH, model=used)
    view = begin_track(scene, SideDetection(detection_of(HERE), "right"), 7, state)
    assert view is not None and view.track.shape.poses == 9.0


def test_a_track_begins_tentatively_at_the_pose_that_explains_the_image() -> None:
    truth = bent(HERE, 1, 0.3)
    detection = detection_of(torch.cat((HERE, bent(HERE, 2, 0.8), truth)))
    detection = replace(detection, keypoints=detection_of(truth).keypoints)
    (view,) = began([SideDetection(detection, "right")], image=image_of(truth))
    assert off_m(view, truth) < 0.005
    assert not (view.track.confirmed or view.track.reliable or view.track.age.begun)


def test_where_nothing_can_be_a_hand_none_begins() -> None:
    assert began([seen(HERE)], image=EMPTY) == [] and began([]) == []


def test_a_track_begins_as_a_hand_of_the_likelier_side() -> None:
    for side in ("right", "left"):
        (view,) = began([seen(HERE, "right")], image=image_of(HERE, side=side))
        assert view.track.side == side == view.fitted.shape.side


@pytest.mark.parametrize(
    ("hands", "confirmed", "most"),
    [(1, 0, 2), (1, 1, 1), (2, 2, 1), (2, 3, 0), (4, 1, 3), (4, 4, 1)],
)
def test_as_many_tracks_are_tentative_as_hands_are_missing_or_one(
    hands: int, confirmed: int, most: int
) -> None:
    for tentative in range(most + 1):
        tracks = [track_of(HERE, confirmed=at < confirmed) for at in range(confirmed + tentative)]
        assert max_new_tracks(state_of(*tracks, hands=hands)) == most - tentative


def test_tracks_begin_each_at_its_place_and_with_its_number() -> None:
    places = [hand_at(x) for x in (-0.15, -0.05)]
    views = began([seen(pose) for pose in places], image=image_of(*places))
    assert [view.track.number for view in views] == [7, 8]
    assert all(off_m(view, pose) < 0.01 for view, pose in zip(views, places, strict=True))


def test_a_new_track_keeps_off_a_reliable_hand_s_pixels_and_joints() -> None:
    aside = hand_at(0.2)
    (view,) = began([seen(aside)], track_of(HERE), image=image_of(HERE, aside))
    assert len(view.others) == 1
    mine = view.observation.hand.numpy()
    assert mine.any() and not (mine & (image_of(HERE).depth_m < 1.0)).any()


SHORT = math.log(0.8)


def length_m(shape: ShapeEstimate) -> float:
    return any_hand_model().hand("right", shape).shape.hand_length_m


def test_a_track_begins_with_the_length_that_was_detected_and_keeps_it() -> None:
    short, new = detection_of(HERE, log_size=SHORT), track_of(HERE, age=Duration())
    assert length_m(update_shape(new, short, model()).shape) == pytest.approx(0.152, rel=1e-3)
    older = update_shape(track_of(HERE), short, model())
    assert older.shape.applied == first_shape().applied


def test_a_track_that_changes_its_side_takes_the_length_that_was_detected_anew() -> None:
    short = detection_of(HERE, log_size=SHORT, side="left")
    surely, image = SideEvidence(-6.0), image_of(HERE, side="left")
    fitted = replace(first_shape(), poses=9)  # to the hand of the other side
    view = gone_on(replace(of_both(), mirrored=short), image, evidence=surely, shape=fitted)
    assert view is not None and view.track.side == "left"
    assert view.fitted.shape.hand_length_m == pytest.approx(0.152, rel=1e-3)


def test_a_hand_that_is_back_has_the_shape_that_it_had() -> None:
    of_length = with_network_length(first_shape(), 0.15, default_hand_shape())
    state = state_of(track_of(HERE), hands=2)
    first, second = state.slots

    def known(side: str, *slots: Slot) -> float:
        return length_m(known_shape(side, replace(state, slots=slots)))

    gone = replace(second, shape=of_length)
    assert known("left", first, gone) == pytest.approx(0.15, rel=1e-3)
    assert known("right", first, gone) == pytest.approx(0.19, rel=1e-3), "of the other side"
    there = replace(first, shape=of_length)
    assert known("right", there, second) == pytest.approx(0.19, rel=1e-3), "it is still there"
