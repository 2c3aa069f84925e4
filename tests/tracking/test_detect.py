"""When and where the networks are asked, and as which hands."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import any_hand_model, hand_at, image_of, scene_of, state_of, track_of

from toftrack.compute.pace import FRAME_S
from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.crops import crop_rotation
from toftrack.detector.detection import Detection
from toftrack.detector.network import PARTS
from toftrack.detector.parts import FOREARM_PART, Parts
from toftrack.detector.proposals import Places
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.refinement.shape_fit import first_shape, with_network_length
from toftrack.tracking.association import SideDetection
from toftrack.tracking.detect import (
    PendingDetections,
    finish_detection,
    held_out_first,
    start_detection,
)
from toftrack.tracking.scene import Scene
from toftrack.tracking.state import SideEvidence, Track
from toftrack.tracking.step import step

HERE, THERE = hand_at(0.0), hand_at(0.3)
IMAGE = image_of(HERE, THERE)
SURE = SideEvidence(6.0, comparisons=9, age_s=0.0)


def known(pose: torch.Tensor = HERE, **changes: object) -> Track:
    """Of which side it is was found out."""
    return track_of(pose, any_hand_model(), **({"evidence": SURE} | changes))


LOST = known(believed_s=0.2)


def looked(
    *tracks: Track, found: Sequence[Detection] = (), dt_s: float = FRAME_S, **changes: object
) -> tuple[FixedDetector, list[SideDetection], PendingDetections]:
    """What a detector was asked in a frame of tracks, what it has seen, and what was begun."""
    detector = changes.pop("detector", None) or FixedDetector(found)
    model = replace(any_hand_model(), detector=detector)
    state = state_of(*tracks, model=model, **changes)
    scene = Scene(state.tracks, IMAGE, dt_s, model)
    pending = start_detection(scene, state)
    return detector, finish_detection(pending, scene, state), pending


def at(detection: Detection) -> np.ndarray:
    return detection.centre_m.numpy()


def places_of(*found: Detection) -> Places:
    return Places(np.array([at(one) for one in found]), np.ones(len(found)))


FOUND = [detection_of(HERE), detection_of(THERE)]


# At the tracks' places.


def test_each_track_is_looked_at_where_it_will_be_as_a_hand_of_its_side() -> None:
    detector, seen, _ = looked(known(), known(THERE, side="left", asked_s=2 * FRAME_S))
    assert [(one.side, one.row) for one in seen] == [("right", 0), ("left", 1)]
    for one, pose in zip(seen, (HERE, THERE), strict=True):
        assert at(one.detection) == pytest.approx(at(detection_of(pose)), abs=0.01)
        assert one.mirrored is None
    assert detector.sides == ["right", "left"]


def test_both_sides_are_looked_at_while_it_is_not_known_which_one_it_is() -> None:
    detector, (seen,), _ = looked(known(evidence=SideEvidence()))
    assert seen.mirrored is not None and detector.sides == ["right", "left"]


@pytest.mark.parametrize(
    ("changes", "asked_s", "due"),
    [
        ({}, 0.0, False),
        ({}, FRAME_S, False),
        ({}, 2 * FRAME_S, True),
        ({"log_odds": 0.0}, 0.0, True),
        ({"believed_s": FRAME_S}, 0.0, True),
        ({"confirmed": False}, 0.0, True),
        ({"evidence": SideEvidence()}, 0.0, True),
    ],
    ids=["sure", "sure, later", "in time", "unsure", "lost", "tentative", "of which side?"],
)
def test_the_pose_network_is_asked_about_a_sure_hand_only_every_few_frames(
    changes: dict[str, object], asked_s: float, due: bool
) -> None:
    track = known(asked_s=asked_s, **changes)
    for every, expected in ((3, due), (1, True)):
        detector, *_ = looked(track, detector=FixedDetector(every=every))
        assert bool(detector.sides) == expected
    detector, *_ = looked(track, detector=FixedDetector(every=1), dt_s=1 / 90)
    assert detector.sides, "in every frame, however often they come"


@pytest.mark.parametrize("factor", [0.7, 1.2])
def test_it_is_asked_about_the_middle_of_a_palm_of_that_size(factor: float) -> None:
    length_m, first = factor * DEFAULT_HAND_LENGTH_M, default_hand_shape()
    small = with_network_length(first_shape(), length_m, first)
    detector, *_ = looked(known(shape=small))
    joints = any_hand_model().hand("right", small).refiner.joints(HERE)[0].numpy()
    along = (joints[9] - joints[0]) / np.linalg.norm(joints[9] - joints[0])
    off = detector.centres_m[0][0] - joints[0]
    assert off @ along == pytest.approx(factor * -PIVOT_M[1], abs=0.01)


def test_it_is_asked_about_a_hand_at_the_lens_all_the_same() -> None:
    detector, *_ = looked(known(hand_at(z=0.01)))
    assert detector.centres_m[0][0, 2] >= 0.1


# Elsewhere.


def elsewhere(seen: Sequence[SideDetection]) -> list[tuple[str, float]]:
    """Sides and places of what is seen where no track is."""
    return [(one.side, round(float(one.detection.centre_m[0]), 2)) for one in seen if one.row < 0]


@pytest.mark.parametrize(
    ("told", "sides"), [(None, ["right", "left"]), ("right", ["right"]), ("left", ["left"])]
)
def test_while_no_hand_is_followed_any_is_looked_for_of_the_told_side_if_one_was_told(
    told: str | None, sides: list[str]
) -> None:
    detector, seen, _ = looked(found=FOUND, told=told)
    assert detector.looked == sides and len(seen) == 2 * len(sides)
    both, *_ = looked(found=FOUND, told=told, hands=2)
    assert both.looked == ["right", "left"], "of two hands each"


@pytest.mark.parametrize(
    ("tracks", "dt_s", "at_once"),
    [
        ((known(),), FRAME_S, False),
        ((known(), known(THERE, side="left")), FRAME_S, False),
        ((), FRAME_S, True),
        ((LOST,), FRAME_S, True),
        ((known(), known(THERE, confirmed=False)), FRAME_S, True),
        ((known(),), 0.2, True),
    ],
    ids=["one", "both", "none", "lost", "one of two tentative", "rare frames"],
)
def test_what_the_finder_sees_is_looked_at_at_once_but_a_frame_later_while_all_hands_are_sure(
    tracks: tuple[Track, ...], dt_s: float, at_once: bool
) -> None:
    third = [detection_of(hand_at(-0.3))]
    detector, seen, asked = looked(*tracks, found=third, dt_s=dt_s)
    assert detector.known == [len(tracks)]
    assert bool(elsewhere(seen)) == at_once
    assert len(asked.for_next_frame().centre_m) == (not at_once)


def test_what_the_finder_saw_a_frame_ago_is_looked_at() -> None:
    _, _, asked = looked(known(), found=FOUND)
    places = asked.for_next_frame()
    again, seen, asked = looked(known(), found=FOUND, searched_s=FRAME_S, places=places)
    assert not asked.finder_asked and not len(asked.for_next_frame().centre_m)
    assert elsewhere(seen) == [("left", 0.3)] and again.looked == ["left"], "the other hand"


@pytest.mark.parametrize(
    ("tracks", "hands", "sides"),
    [
        ([LOST], 1, {"right"}),
        ([known(confirmed=False)], 1, {"right"}),
        ([known(), known(THERE, side="left")], 2, set()),
        ([known(), known(THERE, side="left", believed_s=0.2)], 2, {"left"}),
        ([known()], 4, {"right", "left"}),
        ([known(), known(THERE, side="left")], 4, {"right", "left"}),
    ],
    ids=["lost", "tentative", "both there", "one of two lost", "of four", "two of four"],
)
def test_a_hand_is_looked_for_that_is_missing(
    tracks: list[Track], hands: int, sides: set[str]
) -> None:
    third = [detection_of(hand_at(-0.3))]
    detector, *_ = looked(*tracks, found=third, places=places_of(*third), hands=hands)
    assert set(detector.looked) == sides


@pytest.mark.parametrize(
    ("hands", "dt_s", "whole"), [(1, FRAME_S, True), (4, FRAME_S, False), (4, 0.2, True)]
)
def test_of_more_than_two_hands_the_finder_sees_what_no_track_explains(
    hands: int, dt_s: float, whole: bool
) -> None:
    detector, *_ = looked(known(), known(THERE, believed_s=0.2), hands=hands, dt_s=dt_s)
    mine = image_of(HERE).depth_m < 1.0
    assert ((detector.images[0] < 1.0)[mine] == whole).all()
    np.testing.assert_array_equal(detector.images[0][~mine], IMAGE.depth_m[~mine])


def test_what_is_a_reliable_track_s_is_looked_at_as_a_hand_of_neither_side() -> None:
    _, seen, _ = looked(known(), found=FOUND, places=places_of(*FOUND), hands=4)
    assert set(elsewhere(seen)) == {("right", 0.3), ("left", 0.3)}


def test_where_frames_are_rare_hands_are_looked_for_where_the_tracks_are_as_well() -> None:
    _, seen, _ = looked(known(), found=FOUND, dt_s=0.2)
    assert {("right", 0.0), ("right", 0.3)} < set(elsewhere(seen))


@pytest.mark.parametrize(
    ("tracks", "times"), [((), 1), ((LOST,), 1), ((known(),), 2)], ids=["none", "lost", "sure"]
)
@pytest.mark.parametrize("search", [1, 5])
def test_the_finder_is_asked_every_so_many_frames_and_half_as_often_while_all_hands_are_sure(
    tracks: tuple[Track, ...], times: int, search: int
) -> None:
    every = search * times
    for frames, due in ((every - 1, every == 1), (every, True)):
        detector = FixedDetector(search=search)
        looked(*tracks, detector=detector, searched_s=frames * FRAME_S)
        assert bool(detector.images) == due


# On the arm of a hand that is seen.


def moved(x: float, y: float) -> torch.Tensor:
    """(1, 27) an open palm there."""
    state = HERE.clone()
    state[0, :2] += torch.tensor([x, y])
    return state


DOWN_THE_ARM, BESIDE, ACROSS = moved(0.0, 0.16), moved(0.12, 0.16), moved(0.16, 0.09)
BELOW = moved(0.0, 0.55)
EVERYTHING = {DOWN_THE_ARM, BESIDE, ACROSS, BELOW}


@pytest.mark.parametrize(
    ("place", "begins"),
    [(DOWN_THE_ARM, False), (BESIDE, True), (moved(0.0, -0.18), True)],
    ids=["on the arm", "beside it", "beyond the fingers"],
)
def test_on_the_arm_of_a_hand_that_is_seen_no_track_begins(
    place: torch.Tensor, begins: bool
) -> None:
    found = [detection_of(place, side="left")]
    model = replace(any_hand_model(), detector=FixedDetector(found, every=1))
    state, image = state_of(known(), model=model), image_of(HERE, place)
    for frame in (1, 2):  # it is seen in the first one
        state, *_ = step(state, replace(image, timestamp_s=frame * FRAME_S), model)
        assert len(state.tracks) == (2 if begins and frame == 2 else 1)


def left_of(
    seen: Detection | None, dt_s: float = FRAME_S, reliable: bool = True
) -> set[torch.Tensor]:
    """Of hands about the one that the pose network sees, those that are none of its arm."""
    others = {pose: detection_of(pose, side="left") for pose in EVERYTHING}
    model = replace(any_hand_model(), detector=FixedDetector(list(others.values())))
    depth = IMAGE.depth_m.copy()
    depth[105:112, 90:150] = 0.5  # a forearm to the right
    track = replace(known(), confirmed=reliable)
    state = state_of(track, model=model, places=places_of(*others.values()))
    scene = scene_of(*state.tracks, image=replace(IMAGE, depth_m=depth), model=model)
    at_tracks = [] if seen is None else [lambda: SideDetection(seen, "right", 0)]
    found = finish_detection(PendingDetections(at_tracks), replace(scene, dt_s=dt_s), state)
    return {pose for pose, one in others.items() if any(one is each.detection for each in found)}


def test_the_arm_is_where_the_network_sees_it_or_the_fingers_do_not_point() -> None:
    seen = FOUND[0]
    assert left_of(seen) == {BESIDE, ACROSS, BELOW}, "as long as an arm"
    kind = np.zeros((PARTS, PARTS), np.uint8)
    kind[:, PARTS * 3 // 4 :] = FOREARM_PART
    wrist = seen.keypoints.points_m[0].double().numpy()
    parts = Parts(kind, crop_rotation(wrist), wrist, False)
    assert left_of(replace(seen, parts=parts)) == {DOWN_THE_ARM, BESIDE, BELOW}


def test_what_nobody_looks_at_has_its_predicted_arm_and_what_is_hardly_a_hand_none() -> None:
    assert left_of(None) == {BESIDE, ACROSS, BELOW}
    assert left_of(replace(FOUND[0], present=1e-4)) == EVERYTHING
    assert left_of(FOUND[0], dt_s=0.2) == EVERYTHING, "it was seen long ago"


def test_what_may_itself_be_an_arm_takes_no_better_hand_for_its_own() -> None:
    """An elbow that was found while something hid the hand keeps it from being found again."""
    seen = replace(FOUND[0], present=0.9)
    assert left_of(seen, reliable=True) == {BESIDE, ACROSS, BELOW}
    assert left_of(seen, reliable=False) == EVERYTHING


# Which one is meant.


def order(*detections: Detection) -> list[Detection]:
    return [
        one.detection for one in held_out_first([SideDetection(one, "right") for one in detections])
    ]


def test_where_nobody_said_which_hand_is_meant_it_is_the_one_that_is_held_out() -> None:
    far, near = detection_of(hand_at(0.1, z=0.7)), detection_of(hand_at(-0.1, z=0.4))
    assert order() == [] and order(far, near) == [near, far]
    less_sure = replace(near, error_m=1.9 * near.error_m)
    assert order(far, less_sure)[0] is less_sure, "both are seen well"
    unsure = replace(near, error_m=2.5 * near.error_m)
    assert order(far, unsure)[0] is far, "not seen as well"


@pytest.mark.parametrize("told", [None, "right", "left"])
def test_the_hand_that_is_held_out_comes_first_unless_a_side_was_said(told: str | None) -> None:
    far = detection_of(hand_at(0.1, z=0.7))
    near = detection_of(hand_at(-0.1, z=0.4), side="left")
    detector = FixedDetector(of_side={"right": [far], "left": [near]})
    seen = looked(detector=detector, told=told)[1]
    assert seen[0].detection is (far if told == "right" else near)
    assert len(seen) == (2 if told is None else 1)
