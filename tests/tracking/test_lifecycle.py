"""Where tracks begin, go on, end and change sides as a frame begins; see lifecycle.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import (
    EMPTY,
    any_hand_model,
    hand_at,
    image_of,
    right_hand_model,
    slot_of,
    track_of,
)

from toftrack.compute.pace import FRAME_S
from toftrack.detector.hand_detector import Detection
from toftrack.detector.proposals import SAME_PLACE_M
from toftrack.frames import DepthImage
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking.candidates import HandFrame
from toftrack.tracking.handedness import HandednessEstimate
from toftrack.tracking.hands import OtherHand
from toftrack.tracking.lifecycle import (
    Absence,
    open_hand,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.state import Track
from toftrack.tracking.step import waited_for

pytestmark = pytest.mark.usefixtures("one_thread")

ELSEWHERE = SAME_PLACE_M + 0.05
HERE, THERE = hand_at(0.0), hand_at(ELSEWHERE)


@cache
def tracks() -> dict[str, Track]:
    return {"believed": track_of(HERE), "doubted": track_of(HERE, doubted=True)}


@cache
def images() -> dict[str, DepthImage]:
    return {"both": image_of(HERE, THERE), "empty": EMPTY, "left": image_of(HERE, side="left")}


# In a frame: before it is compared.


@dataclass
class Opened:
    """What became of a slot in a frame.

    began, went_on, away: the track is a new one, or the same as before, or there is none.
    """

    result: HandFrame | Absence
    before: Track | None
    detector: FixedDetector

    @property
    def outcome(self) -> str:
        if isinstance(self.result, Absence):
            return "away" if self.result.hand.track is None else "absent with a track"
        if self.result.track is self.before:
            return "went on"
        return "changed" if self.result.track.age.begun else "began"

    @property
    def x(self) -> float:
        """Where the track is."""
        assert isinstance(self.result, HandFrame)
        return float(self.result.track.pose[0, 0])


def opened(
    track: Track | None,
    found: Sequence[Detection],
    image: str = "both",
    model: TrackerModel | None = None,
    others: tuple[OtherHand, ...] = (),
    **changes: object,
) -> Opened:
    detector = FixedDetector(found)
    model = replace(model or right_hand_model(), detector=detector)
    hand = slot_of(track, model, **changes)
    return Opened(open_hand(0, hand, others, images()[image], model, FRAME_S), track, detector)


FOUND_HERE, FOUND_THERE = detection_of(HERE), detection_of(THERE)


@pytest.mark.parametrize(
    ("track", "found", "image", "outcome", "x"),
    [
        (None, [FOUND_HERE], "both", "began", 0.0),
        (None, [FOUND_THERE, FOUND_HERE], "both", "began", ELSEWHERE),
        (None, [], "both", "away", None),
        (None, [], "empty", "away", None),
        (None, [FOUND_HERE], "empty", "away", None),
        ("believed", [], "empty", "away", None),
        ("doubted", [], "empty", "away", None),
        ("doubted", [FOUND_THERE], "empty", "away", None),
        ("doubted", [FOUND_THERE], "both", "began", ELSEWHERE),
        ("doubted", [FOUND_HERE], "both", "went on", 0.0),
        ("doubted", [], "both", "went on", 0.0),
        ("believed", [FOUND_THERE], "both", "went on", 0.0),
        ("believed", [], "both", "went on", 0.0),
    ],
    ids=[
        "begins where a hand is detected",
        "begins with the best",
        "stays away without a detection",
        "stays away in an empty image",
        "stays away where nothing can be a hand",
        "a believed one ends where nothing can be a hand",
        "a doubted one ends where nothing can be a hand",
        "and where a hand was detected elsewhere, too",
        "a doubted one gives way to a hand elsewhere",
        "a doubted one stays where it is detected",
        "a doubted one stays where nothing is detected",
        "a believed one does not give way",
        "a believed one needs no search",
    ],
)
def test_in_a_frame_a_track_begins_goes_on_or_ends(
    track: str | None,
    found: Sequence[Detection],
    image: str,
    outcome: str,
    x: float | None,
) -> None:
    after = opened(None if track is None else tracks()[track], found, image)
    assert after.outcome == outcome
    if x is not None:
        assert after.x == pytest.approx(x, abs=0.02)
    assert bool(after.detector.searched) == (track != "believed"), "the whole image"


def test_a_watched_hand_gives_way_to_one_elsewhere_only_while_the_first_one_is_followed() -> None:
    none, doubted = np.zeros((144, 176), bool), tracks()["doubted"]
    first = OtherHand(FOUND_HERE.joints_m[0] + 0.3, np.full(3, 0.3), True, False, none, none)
    known = HandednessEstimate(fits=-5.0)
    stayed, went = (
        opened(doubted, [FOUND_THERE], others=others, watched=True, beside=True, handedness=known)
        for others in ((), (first,))
    )
    assert stayed.outcome == "went on" and stayed.result.hand.beside
    assert went.outcome == "began" and went.x == pytest.approx(ELSEWHERE, abs=0.02)
    assert not went.result.hand.beside, "it may be another hand now"
    assert abs(went.result.hand.handedness.fits) < 2.0 < -stayed.result.hand.handedness.fits


def test_the_detector_runs_beside_the_filter_for_a_believed_hand_only() -> None:
    beside, before = opened(tracks()["believed"], []).result, opened(tracks()["doubted"], []).result
    assert isinstance(beside, HandFrame) and isinstance(before, HandFrame)
    assert beside.detection.empty and not beside.pending().empty
    assert before.pending().empty and not before.detection.empty


@pytest.mark.parametrize(("error_m", "taken"), [(0.005, True), (0.02, False)])
def test_of_a_doubted_hand_the_surer_detection_is_taken(error_m: float, taken: bool) -> None:
    found = replace(FOUND_HERE, error_m=torch.tensor([error_m]))  # 0.01 where it is predicted
    frame = opened(tracks()["doubted"], [found]).result
    assert isinstance(frame, HandFrame)
    assert (frame.detection is found) is taken


def test_a_track_begins_at_the_pose_that_explains_the_image() -> None:
    frame = opened(None, [FOUND_HERE]).result
    assert isinstance(frame, HandFrame)
    joints = frame.fitted.refiner.joints
    assert float((joints(frame.track.pose) - joints(HERE)).norm(dim=-1).mean()) < 0.005
    assert not (frame.track.believed or frame.track.doubted or frame.track.age.begun)


def test_a_track_begins_with_the_length_that_was_detected_and_keeps_it() -> None:
    short = detection_of(HERE, log_size=math.log(0.8))
    model = any_hand_model()
    given = HandednessEstimate(given=True)
    began = opened(None, [short], model=model, handedness=given).result
    assert isinstance(began, HandFrame)
    assert began.fitted.shape.hand_length_m == pytest.approx(0.152, rel=1e-3)
    for track in tracks().values():
        went_on = opened(track, [short], model=model, handedness=given).result
        assert isinstance(went_on, HandFrame)
        assert went_on.fitted.applied == first_shape().applied
    # A hand whose shape is given stays as it is.
    fixed = opened(None, [short]).result
    assert isinstance(fixed, HandFrame)
    assert fixed.fitted.applied == first_shape().applied


# In a frame: the side.

UNSURE = HandednessEstimate(age_s=10.0)


def compared(after: Opened, image: str) -> Opened:
    """After what ran beside the filter was waited for."""
    assert isinstance(after.result, HandFrame)
    return replace(after, result=waited_for(after.result, images()[image]))


@pytest.mark.parametrize("tracked", [False, True])
def test_a_hand_that_has_become_more_likely_of_the_other_side_begins_anew(tracked: bool) -> None:
    model = any_hand_model()
    track = track_of(HERE, model) if tracked else None
    found = [detection_of(HERE)]
    after = compared(opened(track, found, "left", model, handedness=UNSURE), "left")
    assert isinstance(after.result, HandFrame)
    hand = after.result.hand
    assert after.outcome == "began" and hand.side == "left"
    assert after.result.fitted.shape.side == "left"
    assert hand.gesture is None and hand.handedness.probability("left") > 0.6


@pytest.mark.parametrize("tracked", [False, True])
def test_a_hand_of_the_likelier_side_keeps_it(tracked: bool) -> None:
    model = any_hand_model()
    track = track_of(HERE, model) if tracked else None
    after = compared(opened(track, [detection_of(HERE)], "both", model, handedness=UNSURE), "both")
    assert after.result.hand.side == "right"
    assert after.result.hand.handedness.probability("right") > 0.6
    assert after.outcome == ("went on" if tracked else "began")


@pytest.mark.parametrize(
    "handedness",
    [
        HandednessEstimate(given=True, age_s=10.0),
        HandednessEstimate(fits=6.0, age_s=10.0),
        HandednessEstimate(age_s=0.0),
    ],
    ids=["given", "sure for long", "compared a frame ago"],
)
def test_a_side_is_not_changed_against_what_is_known(handedness: HandednessEstimate) -> None:
    model = any_hand_model()
    track = track_of(HERE, model)
    after = opened(track, [detection_of(HERE)], "left", model, handedness=handedness)
    assert after.result.hand.side == "right" and after.outcome == "went on"
