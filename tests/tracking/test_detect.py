"""When and where the networks are asked, and as which hands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    WALL_M,
    any_hand_model,
    hand_at,
    image_of,
    state_of,
    track_of,
)

from toftrack.compute.pace import FRAME_S
from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.hand_detector import Detection
from toftrack.detector.proposals import Places
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.refinement.shape_fit import first_shape, with_network_length
from toftrack.tracking.association import Seen
from toftrack.tracking.detect import detected, held_out_first
from toftrack.tracking.scene import Scene
from toftrack.tracking.state import SideEvidence, Track, TrackerState

pytestmark = pytest.mark.usefixtures("one_thread")

HERE, THERE = hand_at(0.0), hand_at(0.3)
IMAGE = image_of(HERE, THERE)
SURE = SideEvidence(6.0, comparisons=9, age_s=0.0)


def known(pose: torch.Tensor = HERE, **changes: object) -> Track:
    """Of which side it is was found out."""
    return track_of(pose, any_hand_model(), **({"evidence": SURE} | changes))


def asked(
    *tracks: Track, found: Sequence[Detection] = (), dt_s: float = FRAME_S, **changes: object
) -> tuple[FixedDetector, list[Seen], TrackerState, Callable[[], Places] | None]:
    """What a detector was asked in a frame of tracks, and what it has seen."""
    detector = changes.pop("detector", None) or FixedDetector(found)
    model = replace(any_hand_model(), detector=detector)
    state = state_of(*tracks, model=model, **changes)
    return detector, *detected(Scene.of(state.tracks, IMAGE, dt_s, model), state)


def at(detection: Detection) -> np.ndarray:
    return detection.centre_m.numpy()


FOUND = [detection_of(HERE), detection_of(THERE)]


# At the tracks' places.


def test_each_track_is_looked_at_where_it_will_be_as_a_hand_of_its_side() -> None:
    detector, seen, _, _ = asked(known(), known(THERE, side="left"))
    assert [(one.side, one.row) for one in seen] == [("right", 0), ("left", 1)]
    for one, pose in zip(seen, (HERE, THERE), strict=True):
        assert at(one.detection) == pytest.approx(at(detection_of(pose)), abs=0.01)
        assert one.mirrored is None
    assert detector.sides == ["right", "left"]


def test_both_sides_are_looked_at_while_it_is_not_known_which_one_it_is() -> None:
    detector, (seen,), _, _ = asked(known(evidence=SideEvidence()))
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
        detector, *_ = asked(track, detector=FixedDetector(every=every))
        assert bool(detector.sides) == expected


@pytest.mark.parametrize("factor", [0.7, 1.2])
def test_it_is_asked_about_the_middle_of_a_palm_of_that_size(factor: float) -> None:
    length_m, first = factor * DEFAULT_HAND_LENGTH_M, default_hand_shape()
    small = with_network_length(first_shape(), length_m, any_hand_model().fit, first)
    detector, *_ = asked(known(shape=small))
    joints = any_hand_model().hand("right", small).refiner.joints(HERE)[0].numpy()
    along = (joints[9] - joints[0]) / np.linalg.norm(joints[9] - joints[0])
    off = detector.centres_m[0][0] - joints[0]
    assert off @ along == pytest.approx(factor * -PIVOT_M[1], abs=0.01)


def test_it_is_asked_about_a_hand_at_the_lens_all_the_same() -> None:
    detector, *_ = asked(known(hand_at(z=0.01)))
    assert detector.centres_m[0][0, 2] >= 0.1


# Elsewhere.


def elsewhere(seen: Sequence[Seen]) -> list[tuple[str, float]]:
    """Sides and places of what is seen where no track is."""
    return [(one.side, round(float(one.detection.centre_m[0]), 2)) for one in seen if one.row < 0]


def test_while_no_hand_is_followed_any_is_looked_for_of_the_told_side_if_one_was_told() -> None:
    for told, sides in ((None, ["right", "left"]), ("right", ["right"]), ("left", ["left"])):
        detector, seen, state, finding = asked(found=FOUND, told=told)
        assert detector.looked == sides and finding is None and len(seen) == 2 * len(sides)
        assert state.found_s == 0 and len(detector.images) == 1


def test_beside_sure_hands_what_the_finder_sees_is_looked_at_a_frame_later() -> None:
    detector, seen, state, finding = asked(known(), found=FOUND, found_s=9.0)
    assert elsewhere(seen) == [] and not len(state.places.centre_m) and finding is not None
    again, seen, _, _ = asked(known(), found=FOUND, found_s=0.0, places=finding())
    assert elsewhere(seen) == [("left", 0.3)] and again.looked == ["left"], "the other hand"


@pytest.mark.parametrize(
    ("tracks", "looked"),
    [
        ([known(believed_s=0.2)], {"right", "left"}),
        ([known(confirmed=False)], {"right"}),
        ([known(), known(THERE, side="left")], set()),
        ([known(), known(THERE, side="left", believed_s=0.2)], {"left"}),
    ],
    ids=["lost", "tentative", "both there", "one of two lost"],
)
def test_a_hand_is_looked_for_that_is_missing(tracks: list[Track], looked: set[str]) -> None:
    third = [detection_of(hand_at(-0.3))]
    places = Places(np.array([at(one) for one in third]), np.ones(1))
    detector, *_ = asked(*tracks, found=third, places=places)
    assert set(detector.looked) == looked


def test_what_is_a_track_s_or_was_no_hand_a_moment_ago_is_not_looked_at() -> None:
    for refused, expected in ((np.zeros((0, 4)), [("left", 0.3)]), (at(FOUND[1]), [])):
        refused = np.append(refused, 0.2)[None] if refused.ndim == 1 else refused
        places = Places(np.array([at(one) for one in FOUND]), np.ones(2))
        _, seen, *_ = asked(known(), found=FOUND, places=places, refused=refused)
        assert elsewhere(seen) == expected


def test_where_frames_are_rare_hands_are_looked_for_everywhere_at_once() -> None:
    detector, seen, _, finding = asked(known(), found=FOUND, dt_s=0.2)
    assert (
        finding is None and ("right", 0.0) in elsewhere(seen) and ("right", 0.3) in elsewhere(seen)
    )
    assert detector.images[0].min() < WALL_M


@pytest.mark.parametrize(("every", "frames", "due"), [(1, 0, True), (5, 4, False), (5, 5, True)])
def test_the_finder_is_asked_every_so_many_frames(every: int, frames: int, due: bool) -> None:
    for tracks in ((), (known(believed_s=0.2),)):
        detector, *_ = asked(
            *tracks, detector=FixedDetector(search=every), found_s=frames * FRAME_S
        )
        assert bool(detector.images) == due


# Which one is meant.


def order(*detections: Detection) -> list[Detection]:
    return [one.detection for one in held_out_first([Seen(one, "right") for one in detections])]


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
    seen = asked(detector=detector, told=told)[1]
    assert seen[0].detection is (far if told == "right" else near)
    assert len(seen) == (2 if told is None else 1)
