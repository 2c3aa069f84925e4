"""What to try when most of a run was lost: a few facts about its lost frames, and what they mean.

The facts are gathered while tracking, mostly from lost frames, so that a good run pays little.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from toftrack.frames.estimate import STATES, Estimate, is_vacant
from toftrack.frames.frame import NO_HAND_M
from toftrack.tracking.state import StepInfo

_INSPECTED_PX = 5000
"""So many pixels of an image are enough to say how far things are."""
_HARDLY = 0.01
"""A share of pixels that is none."""
_MOST = 0.5
_FEWEST_DETECTIONS, _DETECTIONS, _PRESENT = 10, 0.25, 0.9
"""Lost frames that must say how long the hand looked: so many, and such a share. So sure must the
networks be that there is one."""
_FEWEST_PX = 150
"""Fewer pixels show no fingers."""
_TOO_NEAR_M = 0.22
"""Cameras measure badly there, and a hand does not fit into the image."""
_NO_CAMERA_M = 0.1
"""No depth camera sees only what is nearer."""
_STRETCH = 60
"""So many frames are what is recent: long enough that advice does not flicker."""
_FEWEST_FRAMES = 20
"""Of a run that is shorter."""


@dataclass
class RunFacts:
    """What is known of a run, or of one frame of it: of those that were lost; nearly all their
    readings lie between two distances.
    """

    counts: Counter[str] = field(default_factory=Counter)
    """Frames of each kind, see tracked_frame and lost_frame."""
    states: Counter[str] = field(default_factory=Counter)
    """Lost frames by state name."""
    read: float = 0.0
    """Sum of the shares of pixels with a reading."""
    apparent_m: float = 0.0
    """Sum of how long the hand seemed, from wrist to middle fingertip, where anybody says."""
    nearest_m: float = math.inf
    farthest_m: float = -math.inf

    def add(self, more: RunFacts) -> None:
        """More frames."""
        self.counts.update(more.counts)
        self.states.update(more.states)
        self.read += more.read
        self.apparent_m += more.apparent_m
        # Without readings both are NaN, which min and max pass over in this order.
        self.nearest_m = min(self.nearest_m, more.nearest_m)
        self.farthest_m = max(self.farthest_m, more.farthest_m)

    def mean_apparent_m(self) -> float | None:
        """How long the hand looked, where most of a run was lost and enough was seen to say so."""
        count, lost = self.counts["detections"], self.counts["lost"]
        mostly_lost = lost > _MOST * self.counts["frames"]
        often_seen = count >= max(_FEWEST_DETECTIONS, _DETECTIONS * lost)
        return self.apparent_m / count if mostly_lost and often_seen else None


def tracked_frame(insight: StepInfo | None) -> RunFacts:
    """The facts of a frame that was not lost."""
    other = _other_side(insight)
    judged = other is not None
    return RunFacts(Counter(frames=1, tracked_judged=judged, tracked_other_side=other is True))


def lost_frame(
    estimate: Estimate, depth_m: np.ndarray, insight: StepInfo | None, reach_m: float
) -> RunFacts:
    """The facts of a lost frame; depth_m (H, W) metres, beyond reach_m nothing is a hand."""
    step = max(1, round(math.sqrt(depth_m.size / _INSPECTED_PX)))
    few = depth_m[::step, ::step]
    readings = few[np.isfinite(few) & (few > 0)]
    nearest, farthest = np.percentile(readings, (2, 98)) if len(readings) else (np.nan, np.nan)
    read = len(readings) / few.size
    within = float(np.count_nonzero(readings <= reach_m)) / few.size
    hand_px = 0 if insight is None else int(insight.observation.hand.sum())
    other = _other_side(insight)
    detection = None if insight is None else insight.detection
    apparent_m = 0.0
    if detection is not None and detection.present >= _PRESENT:
        apparent_m = detection.length_m
    counts = Counter(
        frames=1,
        lost=1,
        out_of_reach=within < _HARDLY <= read,
        too_near=bool(nearest < _TOO_NEAR_M),
        with_hand=hand_px > 0,
        small=0 < hand_px < _FEWEST_PX,
        judged=other is not None,
        other_side=other is True,
        detections=apparent_m > 0,
    )
    states = Counter([estimate.state_name])
    return RunFacts(counts, states, read, apparent_m, float(nearest), float(farthest))


def _other_side(insight: StepInfo | None) -> bool | None:
    """Whether it looks rather like the other hand; None where nobody says."""
    features = None if insight is None else insight.features
    # Minus the log of the probability that it is this side.
    return None if features is None else features.other_side > math.log(2)


class Watch:
    """Gathers the facts of a run, of each slot apart, and in `recent` those of the newest whole
    stretch of frames, for who watches a run; beyond reach_m nothing is a hand.
    """

    def __init__(self, reach_m: float, slots: int = 1) -> None:
        self.reach_m = reach_m
        self.facts, self.recent, self._stretch = (_nothing(slots) for _ in range(3))
        self._seen = 0

    def see(
        self,
        estimates: Sequence[Estimate],
        depth_m: np.ndarray,
        insights: Sequence[StepInfo | None],
    ) -> None:
        """Take one frame, see lost_frame. A slot without a hand misses none where there is another,
        and where there is no hand at all, the first slot misses it.
        """
        vacant = [is_vacant(estimate) for estimate in estimates]
        for slot, (estimate, insight) in enumerate(zip(estimates, insights, strict=True)):
            if vacant[slot] and (slot > 0 or not all(vacant)):
                continue
            if estimate.lost:
                frame = lost_frame(estimate, depth_m, insight, self.reach_m)
            else:
                frame = tracked_frame(insight)
            self.facts[slot].add(frame)
            self._stretch[slot].add(frame)
        self._seen += 1
        if _FEWEST_FRAMES <= self._seen < _STRETCH:
            self.recent = self._stretch
        elif self._seen % _STRETCH == 0:
            self.recent, self._stretch = self._stretch, _nothing(len(estimates))

    def apparent_m(self) -> tuple[float | None, ...]:
        """Of RunFacts.mean_apparent_m, for each slot."""
        return tuple(facts.mean_apparent_m() for facts in self.facts)

    def advice(self, side: str | None, recent: bool = False) -> tuple[str, ...]:
        """Of the function of that name, for each slot; of the run, or of what is recent."""
        every = self.recent if recent else self.facts
        return tuple(
            f"Slot {slot}: {sentence}" if len(every) > 1 else sentence
            for slot, facts in enumerate(every)
            for sentence in advice(facts, side, self.reach_m)
        )


def _nothing(slots: int) -> tuple[RunFacts, ...]:
    return tuple(RunFacts() for _ in range(slots))


def advice(facts: RunFacts, side: str | None, reach_m: float) -> tuple[str, ...]:
    """At most three sentences: what was seen and what to try; none for a run that went well.

    side: of the hand that was looked for; None where either was.
    """
    counts = facts.counts
    if counts["lost"] <= _MOST * counts["frames"]:
        # A hand of the wrong side may be followed all the same, facing the wrong way.
        if side is not None and counts["tracked_other_side"] > _MOST * counts["tracked_judged"]:
            return (
                f"In {counts['tracked_other_side']} of {counts['frames']} frames it looked like "
                f"the other hand: {_if_it_is_the_other(side)}.",
            )
        return ()
    return (_seen(facts), *_remedies(facts, side, reach_m)[:2])


def _seen(facts: RunFacts) -> str:
    by_number = facts.states.most_common()
    why = ", ".join(f"{STATES.get(name, name)}: {count}" for name, count in by_number)
    lost = facts.counts["lost"]
    read = facts.read / lost
    range_m = f", from {facts.nearest_m:.2f} to {facts.farthest_m:.2f} m" if read > 0 else ""
    return (
        f"{lost} of {facts.counts['frames']} frames were lost ({why}), in which "
        f"{100 * read:.0f} % of the pixels had readings{range_m}."
    )


def _remedies(facts: RunFacts, side: str | None, reach_m: float) -> list[str]:
    """What to try, the most telling first."""
    counts = facts.counts

    def mostly(what: str, of: str = "lost") -> bool:
        return counts[what] > _MOST * counts[of]

    if facts.read < _HARDLY * counts["lost"]:
        return [
            "There was hardly anything to see: check that the lens is free, that depth_m is not "
            "empty, and that its readings are not all invalid."
        ]
    if facts.farthest_m < _NO_CAMERA_M or facts.nearest_m > NO_HAND_M:
        return ["No hand is tracked at that distance: check the unit, depth_m must be in metres."]
    found = []
    if mostly("out_of_reach"):
        found.append(
            f"Nothing was within segmentation.max_distance_m={reach_m:g}: hold the hand nearer, "
            "or raise it; if the hand was nearer, the unit is wrong (an .npz is in metres; of "
            "other recordings device.unit_m says it)."
        )
    if mostly("too_near"):
        found.append(
            f"Something was nearer than {_TOO_NEAR_M:g} m: keep the hand 0.3 to 1 m away, and "
            "nothing in front of it."
        )
    if side is not None and counts["judged"] and mostly("other_side", "judged"):
        found.append(f"It looked like the other hand: {_if_it_is_the_other(side)}.")
    if counts["with_hand"] and mostly("small", "with_hand"):
        found.append(
            f"What was taken for the hand had fewer than {_FEWEST_PX} pixels: hold the hand "
            "nearer, or let the camera give larger images."
        )
    if counts["frames"] < 3 and facts.states["searching"]:
        found.append(
            "A hand that is not sure at once is reported in its third frame; for single images "
            "give lost.believe_frames=1."
        )
    if not found:
        which = "a bare hand" if side is None else f"a {side} hand (hand.side)"
        found.append(
            f"If a hand was in view, look at the picture (view=video or browser): it must be "
            f"{which}, upright and not mirrored (x right, y down), with nothing else nearer to "
            "the camera; the depth_m of a recording has the order frames, rows, columns."
        )
    return found


def _if_it_is_the_other(side: str) -> str:
    other = "left" if side == "right" else "right"
    return (
        f"give hand.side={other}; or, if it is a {side} one, correct the image, which is "
        "mirrored or has its rows and columns exchanged"
    )
