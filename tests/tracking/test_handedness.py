"""Which hand it is: detected, given, and changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tracking import Scene, errors_mm, follow, make_tracker, sample

from toftrack.frames import DepthImage
from toftrack.tracking.handedness import HandednessEstimate, HandednessSettings, body_offset_m

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES = 12
SMALL = ("filter.particles=80",)


def first(count: int = FRAMES) -> Scene:
    return sample().cut(*range(count))


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_side_of_a_hand_and_of_its_mirror_image_is_found_out(side: str) -> None:
    scene = first() if side == "right" else first().mirrored()
    estimates = follow(scene, *SMALL)
    assert estimates[-1].side == side
    assert 0.6 < estimates[-1].side_probability < 1.0
    assert errors_mm(estimates, scene)[-1] < 15.0


def test_a_given_side_is_certain_and_never_overruled() -> None:
    estimates = follow(first(), "hand.side=left", *SMALL)
    assert {estimate.side for estimate in estimates} == {"left"}
    assert {estimate.side_probability for estimate in estimates} == {1.0}


def test_a_wrong_side_is_changed_in_one_frame_and_the_fingers_with_it() -> None:
    scene, tracker = first(), make_tracker(*SMALL)
    estimates = []
    for i in range(4):
        # Told beforehand that it is a left hand, and nearly sure of it.
        if i == 0:
            wrong = HandednessEstimate(fits=-1.0)
            hand = replace(tracker.state.hands[0], side="left", handedness=wrong)
            tracker.state = replace(tracker.state, hands=(hand, *tracker.state.hands[1:]))
        estimates.append(tracker.step(scene.depth_m[i], scene.k, i, i / 25))
    for i in range(4, FRAMES):
        estimates.append(tracker.step(scene.depth_m[i], scene.k, i, i / 25))
    sides = [estimate.side for estimate in estimates]
    changed = sides.index("right")
    assert set(sides[changed:]) == {"right"}, "it is changed once"
    assert errors_mm(estimates, scene)[changed] < 20.0, "the fingers are renamed in that frame"


def test_a_side_that_is_reported_at_a_restart_stays_reported() -> None:
    scene, tracker = first(4), make_tracker(*SMALL)
    tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
    tracker.restart("left")
    for i in (1, 2):
        estimate = tracker.step(scene.depth_m[i], scene.k, i, i / 25)
        assert (estimate.side, estimate.side_probability) == ("left", 1.0)
        tracker.restart()


def test_a_restart_may_detect_the_side_of_a_hand_that_was_given() -> None:
    scene, tracker = first(2), make_tracker("hand.side=left", *SMALL)
    tracker.restart("auto")
    estimate = tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
    assert estimate.side_probability < 1.0
    tracker.restart()
    assert tracker.step(scene.depth_m[1], scene.k, 1, 0.04).side_probability < 1.0, "it stays so"


def test_the_evidence_of_comparisons_is_summed_up_and_bounded() -> None:
    fit, belief = (
        HandednessSettings(weight=1.0, largest=2.0, most=3.0, shoulder=0.0),
        HandednessEstimate(),
    )
    belief = belief.compared(0.5, 0.0, fit)
    assert belief.log_odds == pytest.approx(0.5)
    for _ in range(5):
        belief = belief.compared(100.0, 0.0, fit)
    assert belief.log_odds == pytest.approx(3.0)
    assert belief.probability("right") + belief.probability("left") == pytest.approx(1.0)
    assert HandednessEstimate(given=True).probability("left") == 1.0


def test_comparisons_of_a_mirror_image_say_the_opposite() -> None:
    fit, one, other = HandednessSettings(), HandednessEstimate(), HandednessEstimate()
    for gain, body_m in ((0.3, 0.1), (-0.1, 0.05), (0.4, -0.02)):
        one, other = one.compared(gain, body_m, fit), other.compared(-gain, -body_m, fit)
        assert one.log_odds == pytest.approx(-other.log_odds)


def test_when_the_hand_has_left_the_next_one_is_likely_but_not_surely_of_its_side() -> None:
    fit = HandednessSettings(kept=1.0)
    gone = HandednessEstimate(fits=5.0, shoulder=0.5, comparisons=9).left(fit)
    assert gone.log_odds == pytest.approx(1.0)


def test_two_hands_are_of_different_sides_the_more_surely_the_surer_one_of_them_is() -> None:
    fit, new = HandednessSettings(partner=2.0), HandednessEstimate()
    beside = [
        new.beside(HandednessEstimate(fits=fits), fit).log_odds for fits in (-4.0, 0.0, 1.0, 4.0)
    ]
    assert beside == sorted(beside, reverse=True)
    assert beside[1] == pytest.approx(0.0)
    assert -2.0 < beside[3] < -1.5


def test_of_two_hands_what_is_seen_of_both_says_which_is_of_the_given_side() -> None:
    fit = HandednessSettings(given=2.0, partner=2.0)
    given = HandednessEstimate(given=True, prior=2.0, fits=-0.3)
    assert given.alone(fit).seems("right") > 0.8
    seems = [given.beside(HandednessEstimate(fits=fits), fit).seems("right") for fits in (-2, 0, 2)]
    assert seems[0] > 0.8 > seems[1] > 0.5 > 0.2 > seems[2]
    mirrored = HandednessEstimate(given=True, prior=-2.0, fits=0.3)
    seems_left = mirrored.beside(HandednessEstimate(fits=-2.0), fit).seems("left")
    assert seems_left == pytest.approx(seems[2])
    assert given.beside(HandednessEstimate(fits=2.0), fit).alone(fit).seems("right") > 0.8


def test_of_two_hands_of_given_sides_either_speaks_for_the_other() -> None:
    fit = HandednessSettings(given=2.0, partner=2.0)
    left = HandednessEstimate(given=True, prior=-2.0, fits=-3.0)
    right = HandednessEstimate(given=True, prior=2.0, fits=-2.5)
    assert right.alone(fit).seems("right") < 0.4 < 0.8 < right.beside(left, fit).seems("right")
    exchanged = left.beside(replace(right, fits=-6.0), fit)
    assert exchanged.prior == -2.0 and exchanged.partner == 2.0


def test_a_body_is_seen_beside_the_hand_only_where_it_is_large_and_near_enough() -> None:
    k = np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])
    centre = np.array([-0.1, 0.0, 0.5])

    def place(body_m: float, columns: slice) -> float:
        depth = np.zeros((144, 176), np.float32)
        depth[40:, columns] = body_m
        return body_offset_m(DepthImage(depth, k, 0, 0.0), centre)

    assert place(0.8, slice(60, 150)) > 0.1, "to the right of the hand"
    assert place(0.8, slice(0, 20)) < 0.0, "to the left of it"
    assert place(3.0, slice(60, 150)) == 0.0, "a wall far behind"
    assert place(0.8, slice(60, 62)) == 0.0, "a pole"
