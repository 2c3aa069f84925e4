"""Evaluation: against a second implementation, frame by frame, and against cases done by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from toftrack.evaluation.measures import evaluate
from toftrack.frames import Truth


def random_case(seed: int) -> tuple[np.ndarray, np.ndarray, Truth]:
    """Estimates, lost flags and truth with gaps, occlusions, failures and other poses."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(20, 80))

    def blocks(probability: float) -> np.ndarray:
        changes = rng.random(count) < probability
        return (np.cumsum(changes) % 2).astype(bool)

    visible, in_space = ~blocks(0.08), ~blocks(0.05)
    fraction = np.where(visible, rng.choice([0.5, 0.8, 0.95, 1.0], count), 0.0)
    truth = Truth(
        joints_m=rng.normal(0, 0.1, (count, 21, 3)) + (0, 0, 0.6),
        visible=visible,
        in_space=in_space,
        visible_fraction=fraction if seed % 3 else None,
        joint_visible=rng.random((count, 21)) < 0.8 if seed % 2 else None,
    )
    size = rng.choice([0.005, 0.02, 0.05], (count, 1, 1))
    joints = truth.joints_m + rng.normal(0, 1, (count, 21, 3)) * size / 2
    joints[rng.random(count) < 0.1] = np.nan
    joints[rng.random(count) < 0.03, 5, 2] = np.inf
    lost = (~visible) ^ (rng.random(count) < 0.2)
    return joints, lost, truth


def by_loops(joints: np.ndarray, lost: np.ndarray, truth: Truth) -> dict[str, Any]:
    """The definitions, spelled out a frame and a joint at a time."""
    count = len(truth.joints_m)
    errors: dict[int, list[float]] = {}
    aligned: dict[int, list[float]] = {}
    for t in range(count):
        if not np.isfinite(joints[t]).all():
            continue
        shift = joints[t, 0] - truth.joints_m[t, 0]
        errors[t], aligned[t] = [], []
        for j in range(21):
            away = joints[t, j] - truth.joints_m[t, j]
            errors[t].append(1000 * math.sqrt(sum(away**2)))
            if j > 0:
                aligned[t].append(1000 * math.sqrt(sum((away - shift) ** 2)))
    present = [bool(truth.visible[t] and truth.in_space[t]) for t in range(count)]
    used = [t for t in range(5, count) if present[t]]
    there = [t for t in used if t in errors]

    def mean(values: list[float]) -> float | None:
        return sum(values) / len(values) if values else None

    def of(frames: list[int], rows: Any) -> list[float]:
        return [errors[t][j] for t in frames for j in rows]

    def in_view(t: int, j: int) -> bool:
        return truth.joint_visible is None or bool(truth.joint_visible[t, j])

    every = of(there, range(21))
    result = {
        "frames": len(used),
        "missing_pct": 100 * (len(used) - len(there)) / max(1, len(used)),
        "mean_mm": mean(every),
        "median_mm": float(np.median(every)) if every else None,
        "p90_mm": float(np.percentile(every, 90)) if every else None,
        "fingertip_mm": mean(of(there, (4, 8, 12, 16, 20))),
        "wrist_aligned_mm": mean([e for t in there for e in aligned[t]]),
        "visible_joints_mm": mean(
            [errors[t][j] for t in there for j in range(21) if in_view(t, j)]
        ),
        "frames_max_below_40mm_pct": 100
        * sum(max(errors[t]) < 40 for t in there)
        / max(1, len(used)),
        "mean_not_lost_mm": mean(of([t for t in there if not lost[t]], range(21))),
    }

    def tracked(t: int) -> bool:
        return t in errors and sum(errors[t]) / 21 < 25 and not lost[t]

    def delay(start: int) -> int | None:
        for t in range(start, count):
            if not present[t]:
                return None
            if all(tracked(s) for s in range(t, min(t + 3, count))):
                return t - start
        return None

    fraction = truth.visible_fraction
    fraction = truth.visible.astype(float) if fraction is None else fraction
    events = []
    for t in range(1, count):
        if truth.visible[t] and not truth.visible[t - 1]:
            events.append(("return", t))
            first = next((s for s in range(t, count) if fraction[s] >= 0.9), None)
            if first is not None:
                events.append(("entered", first))
        if truth.in_space[t] and not truth.in_space[t - 1]:
            events.append(("in_space", t))
    since = 0  # first frame after the hand was last in full view
    for t in range(count):
        if fraction[t] >= 0.9:
            before = range(since, t)
            if any(fraction[s] < 0.7 for s in before) and all(truth.visible[s] for s in before):
                events.append(("unoccluded", t))
            if any(fraction[s] < 0.7 for s in before):
                since = t + 1
    result["reacquisition"] = sorted((frame, event, delay(frame)) for event, frame in events)
    return result


def lost_by_loops(
    lost: np.ndarray, truth: Truth, tolerance: int
) -> tuple[float | None, float | None]:
    count = len(lost)
    absent = [not (truth.visible[t] and truth.in_space[t]) for t in range(count)]
    hits = flagged = positive = 0
    for t in range(5, count):
        # A change lies between two frames, half a frame from each.
        if any(
            absent[c] != absent[c - 1] and abs(t - (c - 0.5)) <= tolerance for c in range(1, count)
        ):
            continue
        hits += bool(lost[t] and absent[t])
        flagged += bool(lost[t])
        positive += bool(absent[t])
    return hits / flagged if flagged else None, hits / positive if positive else None


@pytest.mark.parametrize("seed", range(15))
def test_agrees_with_a_second_implementation(seed: int) -> None:
    joints, lost, truth = random_case(seed)
    found = evaluate(joints, lost, truth)
    expected = by_loops(joints, lost, truth)
    events = sorted((e["frame"], e["event"], e["delay"]) for e in found.pop("reacquisition"))
    assert events == expected.pop("reacquisition")
    for tolerance, suffix in ((3, ""), (-1, "_strict")):
        pair = lost_by_loops(lost, truth, tolerance)
        expected[f"lost_precision{suffix}"], expected[f"lost_recall{suffix}"] = pair
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == (None if value is None else pytest.approx(value, rel=1e-9)), name


def still_hand(count: int, **flags: Any) -> Truth:
    ones = np.ones(count, bool)
    joints = np.random.default_rng(0).normal(0, 0.1, (1, 21, 3)).repeat(count, axis=0)
    return Truth(**({"joints_m": joints, "visible": ones, "in_space": ones} | flags))


def test_flagging_cannot_improve_the_error() -> None:
    truth = still_hand(20)
    joints = truth.joints_m.copy()
    joints[10:] += 0.1
    honest = evaluate(joints, np.zeros(20, bool), truth)
    flagged = evaluate(joints, np.arange(20) >= 10, truth)
    assert flagged["mean_mm"] == honest["mean_mm"]
    assert flagged["frames_max_below_40mm_pct"] == honest["frames_max_below_40mm_pct"]
    assert flagged["mean_not_lost_mm"] == pytest.approx(0)
