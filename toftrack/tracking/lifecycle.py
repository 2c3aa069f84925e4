"""Where tracks begin and end: `open_hand` before a frame is compared, `close` after, and
`reconcile` where there are two hands. Besides, a comparison of sides (comparing.py) and a pose at
another place (step.py) begin one, and the hand that is watched may become the first one.

| in a frame | the track |
| --- | --- |
| no track, and a hand is detected | begins |
| no track, and none is | stays away |
| nothing in the image can be a hand | ends |
| doubted, and a hand is detected elsewhere | ends, and one begins there in this frame |
| the other side has become the likelier one | ends, and one of that side begins in this frame |
| a pose at another place is better | ends, and one begins with it (select.py) |
| doubtful for longer than `lost.patience` | ends |
| two tracks on one hand for a while | the less sure one ends |
| a second hand that was never believed | ends after a while; not the one that is asked for |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.detector.hand_detector import NO_DETECTION, Detection, doubt_m, merit
from toftrack.frames import DepthImage
from toftrack.render.segmentation import Observation
from toftrack.tracking.candidates import HandFrame, image_term
from toftrack.tracking.comparing import begun, compared, comparison_due, observed_shape
from toftrack.tracking.confidence import ConfidenceFeatures, ConfidenceModel
from toftrack.tracking.detect import (
    RARE_S,
    detect,
    detection_due,
    expected_of,
    is_elsewhere,
    search,
    search_due,
    start_detection,
)
from toftrack.tracking.filter import Found, drawn_to, predicted_depths, velocity_after
from toftrack.tracking.handedness import OTHER_SIDE
from toftrack.tracking.hands import (
    Neighbour,
    OtherHand,
    PlacedHand,
    exchanged,
    in_wrong_slot,
    known_side,
    on_one_hand,
    pixels_of,
    sureness,
    without,
)
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.seeking import detect_again, search_is_over
from toftrack.tracking.state import HandState, LastSeen, Track, TrackerState
from toftrack.tracking.watching import OTHER_HAND, WATCHED_TRIED_S

_HIDDEN = 0.3
"""Share of the joints behind something from which on a hand is hidden."""
_OUT_OF_VIEW = 0.4
"""Share of the joints outside of the image from which on a hand is out of view."""
_WHOLE_HAND = 0.9
"""A new hand that is right as a whole with this probability is believed, whatever its confidence:
of one that holds a thing, or lies beside another one, a joint is often far off."""
_PATIENT = 10
"""Times as long is waited for a hand that is hidden: each of its frames counts so much less."""
_TRIED_S, _AGAIN_S = 0.5, 0.5
"""A second track ends when it was not believed for so long, and is searched for so much later."""
_ONE_FRAMES = 4
"""Two tracks that were believed may be on one hand for so many frames."""


@dataclass(frozen=True, eq=False)
class Absence:
    """A slot without a hand in a frame.  observation: what was segmented."""

    slot: int
    hand: HandState
    observation: Observation
    track: None = None


@dataclass(frozen=True, eq=False)
class Status:
    """What is thought of a frame's estimate.

    state_name, lost: as Estimate has them.  ends: the track does not go on.
    confidence: probability that every joint is within 40 mm; NaN where nothing says.
    log_odds: the same, smoothed over time.  whole_odds: likewise of the mean joint error.
    doubtful: as Track has it, with this frame.
    """

    state_name: str
    lost: bool
    ends: bool = False
    confidence: float = math.nan
    log_odds: float = 0.0
    whole_odds: float = 0.0
    doubtful: Duration = Duration()


def open_hand(
    slot: int,
    hand: HandState,
    others: tuple[OtherHand, ...],
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
) -> HandFrame | Absence:
    """A slot's hand as it goes into a frame: detected, its side compared, segmented, begun.

    Where a track is believed, or the other hand's is, the detector runs beside the filter, of both
    sides where they are to be compared (compared_beside); else everything depends on it, and waits.
    """
    alone, track, mirrored = without(image, others), hand.track, None
    if track is not None and goes_on(hand, others, dt_s):
        due = comparison_due(hand, model, dt_s)
        asked = due or detection_due(track, model.detector.settings, dt_s)
        pending = start_detection(hand, track, alone, model, dt_s) if asked else _nothing
        if due:
            other = replace(hand, side=OTHER_SIDE[hand.side])
            mirrored = start_detection(other, track, alone, model, dt_s)
        hand = replace(hand, handedness=hand.handedness.waited(dt_s))
        detection = NO_DETECTION
    else:
        hand, detection = _detected(hand, others, alone, model, dt_s)
        hand, detection = compared(hand, detection, others, alone, model, dt_s)
        hand = observed_shape(hand, detection, model)
        pending, track = _nothing, hand.track
    fitted = model.hand(hand.side, hand.shape)
    expected = None if detection.empty else expected_of(detection)
    if track is not None:
        expected = predicted_depths(track, dt_s, fitted, model)
    observation = model.segmentation(image.depth_m, image.k, expected, pixels_of(others))
    if observation.empty or expected is None:
        hand = observed_shape(hand, pending(), model)
        return Absence(slot, replace(hand, track=None), observation)
    if track is None:
        track = begun(hand, detection, observation, others, model)
    return HandFrame(
        slot,
        hand,
        track,
        fitted,
        observation,
        expected.nearest_m,
        detection,
        pending,
        others,
        image_term(observation, fitted, model),
        model,
        mirrored,
    )


def goes_on(hand: HandState, others: Sequence[OtherHand | Neighbour], dt_s: float) -> bool:
    """Whether a hand's track goes on in a frame, or waits for the detector: where frames are rare,
    or it is doubted and nothing else is sure, or something was found elsewhere.
    """
    if hand.track is None or dt_s > RARE_S:
        return False
    sure = any(other.certain for other in others)
    return not hand.track.doubted or (sure and not search_is_over(hand))


def _nothing() -> Detection:
    return NO_DETECTION


def _detected(
    hand: HandState,
    others: Sequence[OtherHand],
    image: DepthImage,
    model: TrackerModel,
    dt_s: float,
) -> tuple[HandState, Detection]:
    """The hand with the track that it goes on with, and what the detector says of it.

    A track that is doubted gives way to a hand that is detected elsewhere.
    """
    track, best = hand.track, NO_DETECTION
    if hand.seeking is not None and hand.seeking.over:
        best = detect_again(hand, hand.seeking, image, others, model)
        hand = replace(hand, seeking=None)
    elif search_due(hand, model, dt_s):
        best = search(hand, image, others, model)
        hand = replace(hand, searched_s=0.0)
    if track is None:
        return hand, best
    if not detection_due(track, model.detector.settings, dt_s):
        return hand, NO_DETECTION
    elsewhere = is_elsewhere(best, hand, track, model, dt_s)
    there = detect(hand, track, image, model, dt_s)
    gone = elsewhere and (track.doubted or merit(best, best.heat) > merit(there, best.heat))
    if gone and not _stays_watched(hand, others):
        return _left_behind(hand, model), best
    # The prediction of a track that is wrong may show the network what keeps it wrong.
    surer = not (best.empty or elsewhere) and doubt_m(best) < doubt_m(there)
    return hand, best if surer else there


def _stays_watched(hand: HandState, others: Sequence[OtherHand]) -> bool:
    """Whether a hand is watched while the first one is away, which it is that is seen elsewhere."""
    return hand.watched and not any(other.believed for other in others)


def _left_behind(hand: HandState, model: TrackerModel) -> HandState:
    """The hand before a track of it begins elsewhere; what was watched may be another hand now."""
    if not hand.watched:
        return replace(hand, track=None)
    handedness = hand.handedness.left(model.configured.handedness)
    return replace(hand, track=None, beside=False, handedness=handedness)


def close(
    frame: HandFrame, found: Found, features: ConfidenceFeatures, dt_s: float
) -> tuple[Status, Track, LastSeen]:
    """What is thought of a frame's estimate, the track as of the frame, and the hand last seen."""
    model, track = frame.model, frame.track
    whose = frame.hand.handedness
    new = model.lost.believe
    seems = whose.seems(frame.hand.side) if whose.given else 1.0
    # Of two hands that are asked for, the one that is followed says which one comes.
    partner = any(other.believed and not other.watched for other in frame.others)
    if partner and frame.slot:
        new = model.lost.second
    elif any(other.believed for other in frame.others):
        new = max(new, model.lost.second)
    side = whose.probability(frame.hand.side)
    status = judge(track, features, dt_s, side, new / max(seems, 1e-3), model.lost)
    if seems < OTHER_HAND and status.confidence >= model.lost.confidence:
        status = replace(status, lost=True, state_name="other hand")
    # Without refinement the particles stay where they are.
    followed = drawn_to(found, model) if model.refinement.iterations else found.filtered
    track = replace(
        track,
        particles=followed.particles,
        weights=followed.weights,
        mean=followed.mean,
        velocity=velocity_after(track, followed.mean, dt_s, model),
        pose=found.pose,
        trend=found.trend,
        age=track.age.extended(dt_s),
        doubtful=status.doubtful,
        log_odds=status.log_odds,
        whole_odds=status.whole_odds,
        surest=max(track.surest, status.log_odds),
        doubted=status.lost,
        believed=track.believed or not status.lost,
        unseen_s=track.unseen_s + dt_s if frame.detection.empty else 0.0,
        features=features,
        nearest_m=frame.expected_m if frame.hidden else 0.0,
    )
    now = LastSeen(track.mean, 0.0, track.surest)
    seen = frame.hand.seen if status.lost else now
    return status, track, seen


def judge(
    track: Track,
    features: ConfidenceFeatures,
    dt_s: float,
    side: float,
    new: float,
    model: ConfidenceModel,
) -> Status:
    """What is thought of an estimate, dt_s after the last, and whether its track goes on.

    side: probability that it is of the right side; of the other one every finger is wrong.
    new: confidence that a track needs which was not believed yet.
    """
    kept = model.memory ** (dt_s / FRAME_S) if track.age.begun else 0.0
    smooth = kept * track.log_odds + (1 - kept) * model.log_odds(features)
    whole = kept * track.whole_odds + (1 - kept) * model.whole_odds(features)
    confidence = _probability(smooth)
    # What was dropped between two frames was not doubtful: a frame counts twice FRAME_S at most.
    passed = min(dt_s, 2 * FRAME_S) if track.doubtful.begun else FRAME_S
    # What was never believed may be no hand, and may hide behind anything.
    waits = track.believed and features.hidden > _HIDDEN
    doubtful = Duration(track.doubtful.seconds + passed / (_PATIENT if waits else 1))
    doubtful = doubtful if confidence < model.give_up else Duration()
    ends = model.patience > 0 and doubtful.begun and doubtful.reached(model.patience)
    # Whether it is a hand at all does not depend on whose it is, nor on where all its joints are.
    probable = _probability(whole)
    believed = track.believed or confidence >= new or probable >= _WHOLE_HAND
    lost = not believed or side * confidence < model.confidence or probable < model.whole
    name = _state_name(features) if lost else "tracking"
    return Status(name, lost, ends, side * confidence, smooth, whole, doubtful)


def _probability(log_odds: float) -> float:
    return 1 / (1 + math.exp(-min(max(log_odds, -30.0), 30.0)))


def _state_name(features: ConfidenceFeatures) -> str:
    """Why an estimate is not to be used."""
    if features.unseen > _OUT_OF_VIEW:
        return "out of view"
    return "hidden" if features.hidden > _HIDDEN else "searching"


def reconcile(
    before: TrackerState,
    after: TrackerState,
    place: Callable[[HandState, Track], PlacedHand],
    dt_s: float,
) -> tuple[TrackerState, bool]:
    """Two hands after a frame: none is followed twice, and each is in its slot.

    before: as of the frame's beginning.  place: where a hand was found.
    Returns the state, and whether the slots were exchanged.
    """
    hands = list(after.hands)
    second_s = after.second_s
    places = [place(hand, hand.track) for hand in hands if hand.track is not None]
    one = len(places) == 2 and on_one_hand(*places)
    merged = before.merged.extended(dt_s) if one else Duration()
    sure = all(hand.believed for hand in before.hands)
    if merged.begun and (merged.reached(_ONE_FRAMES) or not sure):
        worse = min((0, 1), key=lambda slot: sureness(hands[slot]))
        hands[worse] = replace(hands[worse], track=None)
        merged = Duration()
    for slot, hand in enumerate(hands):
        track = hand.track
        if track is None or track.believed or not hands[1 - slot].believed:
            continue
        if after.watched and not slot:
            continue  # the hand that is asked for: a better one is searched for meanwhile
        if track.age.seconds > (WATCHED_TRIED_S if after.watched else _TRIED_S):
            second_s = 0.0 if known_side(hand) else -_AGAIN_S
            hands[slot] = replace(hand, track=None, tried=LastSeen(track.mean, 0.0))
    wrong = not after.watched and in_wrong_slot(before.hands, hands)
    hands = exchanged(before.hands, hands) if wrong else hands
    return replace(after, hands=tuple(hands), second_s=second_s, merged=merged), wrong
