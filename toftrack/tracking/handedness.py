"""Whose hand it is: evidence for a right and for a left hand, summed up over looks.

The same look at the image is explained twice, by the networks' poses of a right hand and by those
of a left one, each brought onto the seen points; what is known of the better explanation (image,
forearm, fingers, votes) is compared. The networks' own word for a side is left out: on renders it
is better than this, on other persons' hands worse, for it has learned which poses are drawn.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from toftrack.detector.hand_detector import Detection
from toftrack.frames import DepthImage
from toftrack.tracking import shape_fit
from toftrack.tracking.detect import best_start, expected_of
from toftrack.tracking.handedness_estimate import OTHER_SIDE, comparison_due, probability
from toftrack.tracking.model import TrackerModel, observed
from toftrack.tracking.other_hand import OtherHand
from toftrack.tracking.shape_fit import first_shape
from toftrack.tracking.state import Track, TrackerState

_BEHIND_M = (0.12, 0.55)
"""The body lies so far behind a hand that is raised before it."""
_BODY_M2, _BODY_ROWS = 0.03, 72
"""Its least area that is seen, and rows of the image that it is looked for in."""
_GONE_S = 1.0
"""A hand that was believed so long ago may have made way for another one."""
_SWITCHED = 0.4
"""The side is changed when it has become less probable than this, so that it does not flicker."""
_LEAST_PRESENT = 0.5
"""Where a hand is less probable than this, nothing is said of its side."""


def sided(
    state: TrackerState,
    track: Track | None,
    detection: Detection | None,
    dt_s: float,
    image: DepthImage,
    model: TrackerModel,
    other_hand: OtherHand | None = None,
) -> tuple[TrackerState, Track | None, Detection | None]:
    """The state, the track and the look at the hand to go on with, after its side was judged.

    When the other side has become the likelier one, a track of it begins in this frame.
    """
    fit, belief = model.sides, state.sides
    if fit is None or belief is None:
        return state, track, detection
    due = comparison_due(belief, fit, track is not None, dt_s)
    if track is None and (state.seen is None or state.seen.age_s > _GONE_S):
        belief = belief.left(fit)  # what comes may be the other hand
    belief = replace(belief, undetected_time_s=belief.undetected_time_s + dt_s)
    if detection is None or not due or detection.present < _LEAST_PRESENT:
        return replace(state, sides=belief), track, detection
    side, other = state.side, OTHER_SIDE[state.side]
    centre = detection.centre_m.numpy()
    mirrored = model.detector.detect(image.depth_m, image.k, centre[None], other)[0]
    gain = _best_log_posterior(detection, side, state, track, image, model, other_hand)
    gain -= _best_log_posterior(mirrored, other, state, track, image, model, other_hand)
    gain = gain if side == "right" else -gain
    belief = belief.compared(gain, _body_m(image, centre), fit)
    if probability(belief, side) >= _SWITCHED:
        return replace(state, sides=belief), track, detection
    state = replace(state, side=other, sides=belief, size=first_shape(), gesture=None)
    return state, None, mirrored


def _body_m(image: DepthImage, centre_m: np.ndarray) -> float:
    """How far a body behind a hand is to the image's right of it; 0 where none is seen.

    Who faces the camera has the right hand to the image's left of the body, as a rule.
    """
    step = max(1, int(image.depth_m.shape[0] / _BODY_ROWS))
    depth = image.depth_m[::step, ::step]
    behind = (depth > centre_m[2] + _BEHIND_M[0]) & (depth < centre_m[2] + _BEHIND_M[1])
    columns, z = np.nonzero(behind)[1] * step, depth[behind]
    focal = float(image.k[0, 0])
    if np.square(z * step / focal).sum() < _BODY_M2:
        return 0.0
    return float(np.median((columns - image.k[0, 2]) / focal * z)) - float(centre_m[0])


def _best_log_posterior(
    detection: Detection,
    side: str,
    state: TrackerState,
    track: Track | None,
    image: DepthImage,
    model: TrackerModel,
    other: OtherHand | None,
) -> float:
    """The best of what is known of a side's poses, log scale; as low as it counts for none."""
    theirs = None if other is None else other.pixels
    observation = model.segmentation(image.depth_m, image.k, expected_of(detection), theirs)
    if observation.empty:
        return -math.inf
    size = state.size
    if track is None:
        size = shape_fit.with_network_length(size, detection.length_m, model.adapt, model.shape)
    hand = model.hand(side, size)
    return best_start(observed(observation, hand, model, detection, other=other))[1]
