"""Which hand it is: what comparisons say, what is known besides, and when a track changes."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.detection import FixedDetector, detection_of
from helpers.rendered import any_hand_model, hand_at, image_of, track_of, view_of
from helpers.tracking import errors_mm, first, follow, make_tracker

from toftrack.compute.pace import FRAME_S
from toftrack.detector.detection import NO_DETECTION
from toftrack.errors import ToftrackError
from toftrack.frames.frame import DepthImage
from toftrack.tracking.sides import (
    body_log_odds,
    changes_side,
    compare_sides,
    comparison_due,
    side_log_odds,
)
from toftrack.tracking.state import OTHER_SIDE, SideEvidence, Track

SMALL = ("filter.particles=80",)
ARM = np.array([-0.1, 0.0, 0.5]), np.array([0.0, 0.8, 0.6])
"""Of a hand that is held out to the camera."""


def known(fits: float = 0.0, side: str = "right", **changes: object) -> Track:
    """A track with evidence for a right hand."""
    names = {"body", "comparisons", "age_s"}
    evidence = {name: changes.pop(name) for name in names & set(changes)}
    return track_of(hand_at(), side=side, evidence=SideEvidence(fits, **evidence), **changes)


def odds_of(track: Track, others: Sequence[Track], told: str | None) -> float:
    """Beside other tracks, which get numbers of their own."""
    return side_log_odds(
        track, [replace(one, number=1 + at) for at, one in enumerate(others)], told
    )


def test_two_hands_are_of_different_sides_the_more_surely_the_surer_the_other_one_is() -> None:
    odds = [odds_of(known(), [known(fits)], None) for fits in (-4.0, 0.0, 1.0, 4.0)]
    assert odds == sorted(odds, reverse=True)
    assert odds[1] == pytest.approx(0.0) and odds[0] == pytest.approx(-odds[3])
    assert -3.0 < odds[3] < -1.0


def test_a_partner_that_is_hardly_a_hand_says_little_and_what_the_user_said_counts() -> None:
    ghost, partner = known(6.0, log_odds=-2.0), known(6.0, log_odds=3.0)
    said = [odds_of(known(), [one], "right") for one in (ghost, partner)]
    assert said[0] > 1.0 > -1.0 > said[1]


def test_a_hand_that_is_seen_alone_is_rather_of_the_side_that_the_user_said() -> None:
    right, none, left = (odds_of(known(), [], told) for told in ("right", None, "left"))
    assert right == pytest.approx(-left) and right > 1 and none == pytest.approx(0.0)
    for others in ([known()], [known(), known()]):
        beside = odds_of(known(), others, "left")
        assert beside == pytest.approx(0.0, abs=0.02), "not beside another"
    assert odds_of(known(-6.0), [], "right") < 0, "but what is seen may say otherwise"


def test_the_place_of_the_body_counts_beside_what_the_user_said() -> None:
    for told in (None, "right", "left"):
        here, without = (odds_of(known(body=body), [], told) for body in (0.5, 0.0))
        assert here == pytest.approx(without + 0.5)


@pytest.mark.parametrize(
    ("track", "due"),
    [
        (known(), True),
        (known(age_s=FRAME_S), False),
        (known(age_s=0.2), True),
        (known(4.0, comparisons=9, age_s=0.2), False),
        (known(4.0, comparisons=1, age_s=0.2), True),
        (known(4.0, comparisons=9), True),
        (known(age_s=1.0, log_odds=-3.0), False),
        (known(age_s=1.0, log_odds=-3.0, confirmed=False), True),
    ],
    ids=["never", "just", "later", "sure", "new", "sure, never", "hardly a hand", "not believed"],
)
def test_sides_are_compared_now_and_then_and_seldom_when_they_are_sure(
    track: Track, due: bool
) -> None:
    assert comparison_due(track) == due


def compared(side: str, image_side: str, **evidence: float) -> SideEvidence:
    """After a comparison of a track of one side in the image of a hand of one side."""
    model = replace(any_hand_model(), detector=FixedDetector())
    image, here = image_of(hand_at(), side=image_side), hand_at()
    track = known(side=side, **evidence)
    view = view_of(image, track, detection_of(here, side=side), model=model)
    return compare_sides(view, detection_of(here, side=OTHER_SIDE[side]), image, ARM)


@pytest.mark.parametrize("image_side", ["right", "left"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_side_that_explains_the_image_better_gains(side: str, image_side: str) -> None:
    after = compared(side, image_side)
    assert (after.fits if image_side == "right" else -after.fits) > 0.5
    assert after.comparisons == 1 and after.age_s == 0


def test_the_evidence_is_summed_up_and_bounded() -> None:
    one = compared("right", "right")
    more = compared("right", "right", fits=0.8, comparisons=1)
    assert more.fits == pytest.approx(0.8 + one.fits, abs=0.01) and more.comparisons == 2
    most = compared("right", "right", fits=1e3).fits
    assert most == pytest.approx(-compared("right", "left", fits=-1e3).fits) and most < 10


def test_without_a_hand_that_is_surely_there_nothing_is_learned() -> None:
    track = known(0.7)
    unsure = replace(detection_of(hand_at()), present=0.3)
    for detection in (unsure, NO_DETECTION):
        view = view_of(image_of(hand_at()), track, detection, model=any_hand_model())
        assert compare_sides(view, unsure, image_of(), ARM) == track.evidence


def by_body(
    body_m: float, columns: slice, along: tuple[float, float, float] = (0, 0.8, 0.6)
) -> float:
    """Log odds of a right hand by a body at some columns."""
    k = np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])
    depth = np.zeros((144, 176), np.float32)
    depth[40:, columns] = body_m
    return body_log_odds(DepthImage(depth, k, 0, 0.0), (ARM[0], np.array(along)))


def test_a_body_is_seen_beside_the_arm_only_where_it_is_large_and_near_enough() -> None:
    assert 1 < by_body(0.8, slice(60, 150)) < 4, "to the right of the elbow"
    assert by_body(0.8, slice(0, 20)) < -0.5, "to the left of it"
    assert by_body(3.0, slice(60, 150)) == 0.0, "a wall far behind"
    assert by_body(0.8, slice(60, 62)) == 0.0, "a pole"


def test_the_elbow_tells_whose_arm_it_is_but_the_hand_where_it_comes_from_the_camera() -> None:
    """A hand in front of the other side of the body is the elbow's all the same."""
    body = slice(10, 90)  # about the hand
    assert by_body(0.8, body, (-0.8, 0.0, 0.6)) > 1 and by_body(0.8, body, (0.8, 0.0, 0.6)) < -1
    worn = [by_body(0.8, slice(60, 150), (x, 0.5, -0.3)) for x in (-0.8, 0.8)]
    assert worn[0] == worn[1] and 0 < worn[0] <= 1


def test_of_who_sits_below_the_camera_the_right_elbow_is_to_the_right() -> None:
    body = slice(45, 115)  # nearer than the hand
    assert by_body(0.36, body, (0.8, 0.5, -0.3)) > 1 and by_body(0.36, body, (-0.8, 0.5, -0.3)) < -1
    assert by_body(0.36, body, (0.8, 0.5, 0.3)) == 0.0, "what is before who faces the camera"


@pytest.mark.parametrize(
    ("log_odds", "told", "changes"),
    [
        (1.0, None, False),
        (-0.1, None, False),
        (-1.0, None, True),
        (-1.0, "right", False),
        (-3.0, "right", True),
        (math.inf, None, False),
    ],
)
def test_a_track_changes_its_side_when_the_other_one_is_surely_likelier(
    log_odds: float, told: str | None, changes: bool
) -> None:
    assert changes_side(known(), log_odds, told) == changes
    assert changes_side(known(side="left"), -log_odds, told) == changes


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_side_of_a_hand_and_of_its_mirror_image_is_found_out(side: str) -> None:
    scene = first(12) if side == "right" else first(12).mirrored()
    estimates = follow(scene, *SMALL)
    assert estimates[-1].side == side
    assert 0.6 < estimates[-1].side_probability < 1.0
    assert errors_mm(estimates, scene)[-1] < 15.0


def test_a_wrong_side_is_changed_once_and_the_fingers_with_it() -> None:
    scene, tracker = first(12), make_tracker(*SMALL)
    estimates = []
    for i, depth in enumerate(scene.depth_m):
        estimates.append(tracker.step(depth, scene.k, i, i / 25))
        if i == 0:
            # Told that it is a left hand, and nearly sure of it.
            wrong = replace(tracker.track, side="left", evidence=SideEvidence(fits=-1.0))
            tracker.state = replace(tracker.state, tracks=(wrong,))
    sides = [estimate.side for estimate in estimates[1:]]
    changed = sides.index("right")
    assert set(sides[changed:]) == {"right"}, "it is changed once"
    assert errors_mm(estimates, scene)[1 + changed] < 20.0, "the fingers are renamed in that frame"


def test_a_hand_of_the_other_side_than_was_said_is_never_reported_as_that_hand() -> None:
    assert all(estimate.lost for estimate in follow(first(12), "hand.side=left", *SMALL))
    given = follow(first(3), "hand.side=right", *SMALL)
    assert {(one.side, one.side_probability) for one in given} == {("right", 1.0)}


def test_a_restart_may_say_a_side_or_have_it_detected() -> None:
    scene, tracker = first(4), make_tracker("hand.side=left", *SMALL)
    said = []
    for i, side in enumerate(("auto", None, "right", None)):
        tracker.restart(side)
        said.append(tracker.step(scene.depth_m[i], scene.k, i, i / 25).side_probability)
    assert max(said[:2]) < 1.0 and said[2:] == [1.0, 1.0], "it stays so"
    assert tracker.shape.side == "right"
    with pytest.raises(ToftrackError, match="hand.side=middle"):
        tracker.restart("middle")
