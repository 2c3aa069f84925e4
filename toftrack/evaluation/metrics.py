"""Joint errors of a track, and when it finds the hand again: the metrics of summary.json.

Errors are distances per joint, in millimetres, over the frames in which the truth says that the
hand is visible and its pose in the pose space, from frame `SKIPPED` on. Frames flagged lost count
like any other, so that flagging cannot improve an error. Frames without an estimate count as
failures: they are left out of means and quantiles, reported as `missing_pct`, and never count as
good.

Re-acquisition is the number of frames from an event to the first of `RIGHT_FRAMES` consecutive
frames (fewer at the end of the recording) that are not flagged lost and have a mean joint error
below `RIGHT_MM`; None when that does not happen before the hand is gone again, or at all. Events:

- `return`: the hand becomes visible again;
- `entered`: after a return, the visible fraction first reaches 0.9;
- `unoccluded`: the visible fraction is back at 0.9 after a dip below 0.7, visible all the while;
- `in_space`: the pose enters the pose space again.

Lost detection calls a frame lost, in truth, when the hand is not visible or not in the pose space.
The tolerant figures leave out the frames within `TOLERANCE` frames of a change of that truth; the
strict ones do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.evaluation.statistics import figure, share_pct
from toftrack.evaluation.trust import OK_MM, RIGHT_FRAMES, RIGHT_MM, TIPS, judged, runs, until
from toftrack.frames import Truth

SKIPPED = 5
TOLERANCE = 3
_BACK_IN_VIEW = 0.9
_COVERED = 0.7


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
    clear = counted & ~_near_change(present)
    for suffix, rows in (("", clear), ("_strict", counted)):
        said, gone = flagged[rows], ~present[rows]
        metrics[f"lost_precision{suffix}"] = figure(gone[said])
        metrics[f"lost_recall{suffix}"] = figure(said[gone])
    found = runs(of.said & (of.mean_mm < RIGHT_MM), RIGHT_FRAMES, cut=True)
    metrics["reacquisition"] = [
        {"event": event, "frame": frame, "delay": _delay(found, present, frame)}
        for event, frame in _events(truth)
    ]
    return metrics


def _near_change(present: np.ndarray) -> np.ndarray:
    """(T,) bool: at most `TOLERANCE` frames lie between the frame and a change of `present`."""
    near = np.zeros(len(present), bool)
    for change in np.flatnonzero(np.diff(present)) + 1:  # first frame of the new value
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
