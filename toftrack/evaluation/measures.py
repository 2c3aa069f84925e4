"""All that is measured of a track of one recording, from estimates and truth alone.

A track is plain arrays, so that what any method found is measured alike. A figure is None where
there is nothing that it could be about. Beside the figures of trust.py, `measured` says of each
hand, over the frames in which it is visible:

- `usable_mean_mm`, `usable_tip_mm`: mean error of joints and of fingertips in usable frames.
- `tip_mm`: mean error of the fingertips in frames that are not flagged lost, as `mean_mm`.
- `swap_pct`: frames, not flagged lost, in which a fingertip is taken for another finger's: it lies
  nearer to another finger's true tip than to its own, by more than 10 mm.
- `jitter_mm`: mean movement of a joint from a frame to the next while the hand rests, beyond the
  true one; frames flagged lost say nothing.
- `gesture_pct`: frames of a pose that has a name (`POSE_GESTURES`) in which the gesture is called
  so; a frame flagged lost calls nothing.
- `tips_wrong`, `tips_right`: visible fingertips in frames that are not flagged lost, more than
  40 mm off and at most; `tips_wrong_flagged`, `tips_right_flagged`: those of them that `joint_ok`
  flags. Numbers, and none where the truth does not say which joints are visible.
- `in_region_90_pct`, `hidden_in_region_90_pct`: joints, lost or not, that lie in their 90 % region,
  of all that have one and of those that are out of sight; `without_region_pct`: that have none.
- `side_right_end`, `side_right_soon`: whether the last frame in which a side is named, and the
  tenth after the first one, names the right one.
- `side_wrong_certain_pct`: frames in which the wrong side is named with a probability above 0.9.

`evaluate` has the errors of summary.json: over the frames in which the hand is visible and its pose
in the pose space, from frame `SKIPPED` on. Frames flagged lost count like any other, so that
flagging cannot improve an error. Frames without an estimate are failures: `missing_pct`, left out
of means and quantiles, never good. Its other figures:

- Lost detection: a frame is lost, in truth, when the hand is not visible. The tolerant figures
  leave out the frames within `TOLERANCE` frames of a change of that; the strict ones do not.
- Re-acquisition: frames from an event to the first of `RIGHT_FRAMES` consecutive ones (fewer at the
  end) that are not flagged lost and have a mean error below `RIGHT_MM`; None when that does not
  happen before the hand is gone again. Events: `return`, the hand becomes visible again; `entered`,
  after a return, the visible fraction first reaches 0.9; `unoccluded`, it is back at 0.9 after a
  dip below 0.7, visible all the while; `in_space`, the pose enters the pose space again.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from toftrack.evaluation.statistics import figure, share_pct
from toftrack.evaluation.trust import (
    OK_MM,
    RIGHT_MM,
    TIPS,
    Judged,
    Trust,
    judged,
    slots_of_hands,
    steady,
    trust,
    until,
)
from toftrack.frames.frame import Truth
from toftrack.hand.regions import in_region_90

SKIPPED = 5
TOLERANCE = 3
_BACK_IN_VIEW = 0.9
_COVERED = 0.7
SWAP_MM = 10.0
CERTAIN = 0.9
SOON_FRAMES = 10
FLAG_COUNTS = ("tips_wrong", "tips_wrong_flagged", "tips_right", "tips_right_flagged")
REGION_FIGURES = ("in_region_90_pct", "hidden_in_region_90_pct", "without_region_pct")
POSE_GESTURES = {
    "palm": "palm",
    "spread": "palm",
    "flat": "palm",
    "fist": "fist",
    "point": "pointing",
    "point_thumb": "pointing_thumb",
    "thumb_up": "thumb_up",
    "victory": "victory",
    "three": "three",
    "four": "four",
    "ok": "ok",
    "relaxed": "relaxed",
    "hook": "other",
}
"""Which gesture a recording's pose is; what is not here has no name."""


@dataclass(frozen=True, eq=False)
class Estimates:
    """What a method says of the T frames of a recording, of one hand or of slots.

    With slots every array has an axis of slots after T. None: it says nothing of it.
    joints_m: (T, 21, 3) metres, camera frame; not finite where there is none.  lost: (T,) bool.
    joint_sigma_m: (T, 21, 3), see hand/regions.py.  joint_ok: (T, 21) bool.  gesture: (T,) text.
    side: (T,) 'right' or 'left' as it was detected, '' for neither; None where it was given.
    side_probability: (T,).
    """

    joints_m: np.ndarray
    lost: np.ndarray
    joint_sigma_m: np.ndarray | None = None
    joint_ok: np.ndarray | None = None
    gesture: np.ndarray | None = None
    side: np.ndarray | None = None
    side_probability: np.ndarray | None = None

    def slot(self, number: int) -> Estimates:
        """Of one slot."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        return Estimates(**{n: a[:, number] for n, a in arrays.items() if a is not None})


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured of one hand.  figures: see the head of this module; JSON-able, unrounded.
    named: (T,) bool, frames whose pose has a name.  called: those of them that are called so.
    """

    trust: Trust
    frames: Judged
    figures: dict[str, Any]
    named: np.ndarray
    called: np.ndarray


@dataclass(frozen=True, eq=False)
class MeasuredRecording:
    """What was measured of a recording.  slots: of the hands; None where the track has no slots.
    ghost_pct: frames in which a slot without a hand says that it has one; None: no such slot.
    """

    first: Measured
    second: Measured | None = None
    ghost_pct: float | None = None
    slots: tuple[int, ...] | None = None


def measured(estimates: Estimates, truth: Truth) -> MeasuredRecording:
    """All measures of a track of one hand or of several slots. Raises ToftrackError when estimates
    and truth differ in shape."""
    if np.ndim(estimates.joints_m) == 3:
        return MeasuredRecording(_of_hand(estimates, truth))
    truths = [truth] if truth.other is None else [truth, truth.other]
    slots = slots_of_hands(estimates.joints_m, estimates.lost, truths)
    each = [_of_hand(estimates.slot(slot), one) for slot, one in zip(slots, truths, strict=True)]
    others = ~np.delete(np.asarray(estimates.lost, bool), slots, axis=1)
    ghosts = None
    if others.shape[1]:
        ghosts = share_pct(np.asarray(others.any(1)), np.ones(len(others), bool)) or 0.0
    return MeasuredRecording(each[0], each[1] if each[1:] else None, ghosts, slots)


def _of_hand(estimates: Estimates, truth: Truth) -> Measured:
    of = judged(estimates.joints_m, estimates.lost, truth)
    good = of.seen & of.said
    figures: dict[str, Any] = {
        "usable_mean_mm": figure(of.error_mm[of.usable]),
        "usable_tip_mm": figure(of.error_mm[of.usable][:, TIPS]),
        "tip_mm": figure(of.error_mm[good][:, TIPS]),
        "swap_pct": share_pct(good & _swapped(estimates.joints_m, truth.joints_m), of.seen),
        "jitter_mm": _jitter_mm(estimates.joints_m, truth, of.said),
    }
    if estimates.joint_sigma_m is not None:
        figures |= coverage(estimates.joints_m, estimates.joint_sigma_m, truth)
    if estimates.joint_ok is not None and truth.joint_visible is not None:
        visible = good[:, None] & truth.joint_visible[:, TIPS]
        flagged = ~np.asarray(estimates.joint_ok, bool)[:, TIPS]
        figures |= flag_counts(of.error_mm[:, TIPS][visible], flagged[visible])
    poses = np.full(len(of.seen), "") if truth.pose_name is None else truth.pose_name
    names = np.array([POSE_GESTURES.get(str(pose), "") for pose in poses], str)
    named, called = of.seen & (names != ""), of.seen & False
    if estimates.gesture is not None:
        called = named & of.said & (np.asarray(estimates.gesture, str) == names)
        figures["gesture_pct"] = share_pct(called, named)
    figures |= _side_figures(estimates, of, truth)
    return Measured(trust(of), of, figures, named, called)


def coverage(
    joints_m: np.ndarray, joint_sigma_m: np.ndarray, truth: Truth
) -> dict[str, float | None]:
    """The REGION_FIGURES of estimates (T, 21, 3) with standard deviations, see hand/regions.py."""
    there = np.asarray(truth.visible, bool)[:, None] & np.ones(joints_m.shape[1], bool)
    known = np.isfinite(joints_m).all(-1) & np.isfinite(joint_sigma_m).all(-1)
    inside = in_region_90(joints_m, joint_sigma_m, truth.joints_m)
    hidden = there & False if truth.joint_visible is None else there & ~truth.joint_visible
    pairs = (inside, there & known), (inside, hidden & known), (~known, there)
    means = (figure(part[of]) for part, of in pairs)
    shares = (None if mean is None else 100.0 * mean for mean in means)
    return dict(zip(REGION_FIGURES, shares, strict=True))


def flag_counts(off_mm: np.ndarray, flagged: np.ndarray) -> dict[str, int]:
    """What joint_ok says of visible fingertips with (N,) errors; see the head of this module."""
    wrong = np.asarray(off_mm) > OK_MM
    counted = (wrong, wrong & flagged, ~wrong, ~wrong & flagged)
    return {name: int(rows.sum()) for name, rows in zip(FLAG_COUNTS, counted, strict=True)}


def _swapped(joints_m: np.ndarray, true_m: np.ndarray) -> np.ndarray:
    """(T,) bool; false where there is no estimate."""
    tips, true = np.asarray(joints_m, np.float64)[:, TIPS], np.asarray(true_m)[:, TIPS]
    off = 1e3 * np.linalg.norm(tips[:, :, None] - true[:, None], axis=3)  # (T, found, true)
    own = np.diagonal(off, axis1=1, axis2=2)
    others = np.where(np.eye(len(TIPS), dtype=bool), np.inf, off).min(2)
    with np.errstate(invalid="ignore"):
        swapped: np.ndarray = (others < own - SWAP_MM).any(1)
    return swapped


def _jitter_mm(joints_m: np.ndarray, truth: Truth, said: np.ndarray) -> float | None:
    if truth.still is None:
        return None
    rests = truth.still & truth.visible & said
    pairs = rests[1:] & rests[:-1]
    moved = np.diff(np.asarray(joints_m, np.float64) - truth.joints_m, axis=0)[pairs]
    return figure(1e3 * np.linalg.norm(moved, axis=2))


def _side_figures(estimates: Estimates, of: Judged, truth: Truth) -> dict[str, Any]:
    """Nothing where the side was given, or nobody knows it."""
    if estimates.side is None or not truth.side:
        return {}
    side = np.asarray(estimates.side, str)
    named = np.flatnonzero((side != "") & of.seen)
    right = side == truth.side
    figures: dict[str, Any] = {
        "side_right_end": bool(right[named[-1]]) if len(named) else None,
        "side_right_soon": bool(right[named[SOON_FRAMES]]) if len(named) > SOON_FRAMES else None,
    }
    if estimates.side_probability is not None:
        with np.errstate(invalid="ignore"):
            certain = np.asarray(estimates.side_probability) > CERTAIN
        wrong = certain & (side != "") & ~right
        figures["side_wrong_certain_pct"] = share_pct(wrong & of.seen, of.seen)
    return figures


def evaluate(joints_m: np.ndarray, lost: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Metrics of T estimates, as of `judged` but of all 21 joints; unrounded; None for a figure
    about no frame at all. `reacquisition` is a list of {event, frame, delay}."""
    of, flagged = judged(joints_m, lost, truth), np.asarray(lost, bool)
    error = of.error_mm
    present = of.seen & truth.in_space
    counted = np.arange(len(present)) >= SKIPPED
    used = present & counted
    measured = used & of.there
    estimate, true = (
        np.asarray(joints, np.float64)[measured] for joints in (joints_m, truth.joints_m)
    )
    relative = (estimate - estimate[:, :1]) - (true - true[:, :1])
    aligned = 1e3 * np.linalg.norm(relative, axis=-1)
    in_sight = np.ones(error.shape, bool) if truth.joint_visible is None else truth.joint_visible
    metrics: dict[str, Any] = {
        "frames": int(used.sum()),
        "missing_pct": share_pct(~of.there, used) or 0.0,
        "mean_mm": figure(error[measured]),
        "median_mm": figure(error[measured], np.median),
        "p90_mm": figure(error[measured], lambda errors: np.percentile(errors, 90)),
        "fingertip_mm": figure(error[measured][:, TIPS].ravel()),
        "wrist_aligned_mm": figure(aligned[:, 1:].ravel()),  # without the wrist
        "visible_joints_mm": figure(error[measured[:, None] & in_sight]),
        f"frames_max_below_{OK_MM:g}mm_pct": share_pct(error.max(1) < OK_MM, used) or 0.0,
        "mean_not_lost_mm": figure(error[measured & ~flagged]),
    }
    clear = counted & ~_near_change(of.seen)
    for suffix, rows in (("", clear), ("_strict", counted)):
        said, gone = flagged[rows], ~of.seen[rows]
        metrics[f"lost_precision{suffix}"] = figure(gone[said])
        metrics[f"lost_recall{suffix}"] = figure(said[gone])
    found = steady(of.said & (of.mean_mm < RIGHT_MM), cut=True)
    metrics["reacquisition"] = [
        {"event": event, "frame": frame, "delay": _delay(found, present, frame)}
        for event, frame in _events(truth)
    ]
    return metrics


def _near_change(seen: np.ndarray) -> np.ndarray:
    """(T,) bool: at most `TOLERANCE` frames lie between the frame and a change of `seen`."""
    near = np.zeros(len(seen), bool)
    for change in np.flatnonzero(np.diff(seen)) + 1:  # first frame of the new value
        near[max(0, change - TOLERANCE) : change + TOLERANCE] = True
    return near


def _delay(found: np.ndarray, present: np.ndarray, frame: int) -> int | None:
    """Frames until the track is found, before the hand is gone."""
    gone = until(~present, frame)
    return until(found[: len(present) if gone is None else frame + gone], frame)


def _events(truth: Truth) -> list[tuple[str, int]]:
    """(event, frame) in the order of time; see the head of this module."""
    visible, in_space = truth.visible, truth.in_space
    fraction = truth.visible_fraction
    fraction = visible.astype(float) if fraction is None else np.asarray(fraction, float)
    in_full = fraction >= _BACK_IN_VIEW
    found: list[tuple[str, int]] = []
    covered = gone = False
    for t in range(len(visible)):
        returned = t > 0 and visible[t] and not visible[t - 1]
        if returned:
            found.append(("return", t))
            if in_full[t:].any():
                found.append(("entered", t + int(in_full[t:].argmax())))
        if t > 0 and in_space[t] and not in_space[t - 1]:
            found.append(("in_space", t))
        gone |= not visible[t]
        covered |= fraction[t] < _COVERED
        if covered and in_full[t]:
            if not gone:
                found.append(("unoccluded", t))
            covered = gone = False
    return sorted(found, key=lambda event: event[1])
