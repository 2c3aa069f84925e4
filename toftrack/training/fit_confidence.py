"""Fit the tracker's confidence on rendered sequences, whose hands and sensors are none that it is
judged on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.errors import ToftrackError
from toftrack.files.json_text import write_json
from toftrack.hand.regions import REGION_90, joint_axes
from toftrack.tracking.confidence import (
    FEATURES,
    JOINT_FEATURES,
    KIND_OF_JOINT,
    KINDS,
    JointConfidence,
)
from toftrack.tracking.model import TrackerModel
from toftrack.training.sequences import Sequence, random_sequence
from toftrack.training.shapes import shape_bank
from toftrack.views.figures import chart
from toftrack.views.pictures import write_picture

RIGHT_M = 0.04
"""An estimate is right when every joint is within this."""
_SHRINK = 100.0
"""Prior precision of the weights of features in standard deviations, in frames."""
_HELD_OUT = 5
"""Every so manieth sequence is kept to check the fit."""
_TAILS = 4.0
"""Degrees of freedom of the Student t that errors are taken for: wrong fingers are no outliers of a
Gaussian."""
_SHRINK_JOINTS = 1e-3
"""Prior precision of the weights of features in standard deviations, per joint."""
_SHRINK_QUANTILE = 0.1
"""The same of what the quantile changes. It is that strong because tails belong to few sequences,
those with wrong tracks: weaker, regions of good frames get too small, and of doubtful too large."""
_INSIDE = 0.9
_SOFT = 0.05
"""Width of the kink of the quantile's loss, log scale."""


class Observed(NamedTuple):
    """What the tracker's estimates of T frames were formed from, and how right they were.

    features: (T, S).  right: (T,) every joint is within 40 mm.  whole: (T,) they are on average.
    joint_features: (T, 21, S) of each joint.  error_cm: (T, 21, 3) along joint_axes.
    near: (T, 21) the hand is there, and the joint within 40 mm.
    counted: (T,) the hand is there and the estimate not flagged lost.
    sequence: (T,) numbers of the sequences.
    """

    features: np.ndarray
    right: np.ndarray
    whole: np.ndarray
    joint_features: np.ndarray
    error_cm: np.ndarray
    near: np.ndarray
    counted: np.ndarray
    sequence: np.ndarray

    def of(self, rows: np.ndarray) -> Observed:
        """Some of them."""
        return Observed(*(values[rows] for values in self))


def fit_confidence(asked: argparse.Namespace) -> None:
    """Render, track, fit, report; asked: the arguments of fit-confidence."""
    model = make_tracker(*asked.overrides).model
    if not isinstance(model, TrackerModel):
        raise ToftrackError("fit-confidence fits lost=calibrated; leave experiment=paper out")
    asked.output.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(asked.seed)
    bank = shape_bank(400, generator)
    found = []
    for number in tqdm(range(asked.sequences), unit=" sequences", file=sys.stderr):
        sequence = random_sequence(asked.frames, bank, generator)
        part = observed(sequence, asked.overrides, asked.seed + number, number)
        if part is not None:
            found.append(part)
    if len({int(part.sequence[0]) % _HELD_OUT == 0 for part in found}) < 2:
        raise ToftrackError(
            f"of {asked.sequences} sequences the tracker saw a hand in {len(found)}, too few to fit"
            " and to check the fit; give more --sequences (200) or --frames (50)"
        )
    seen = Observed(*map(np.concatenate, zip(*found, strict=True)))
    kept = seen.sequence % _HELD_OUT == 0
    log_odds, summary = _fitted_frames(seen, seen.right, kept)
    summary["whole"] = _fitted_frames(seen, seen.whole, kept)[1]
    seen = with_doubt(seen, log_odds, model.lost.memory)
    belief, more = _fitted_joints(seen, kept)
    summary |= more
    write_json(asked.output / "summary.json", summary)
    fitted = {
        part: {name: of[name] for name in ("intercept", "weights")}
        for part, of in (("every_joint", summary), ("whole", summary["whole"]))
    }
    write_json(asked.output / "confidence.json", fitted | {"joints": asdict(belief)})
    picture = reliability_figure(expit(log_odds[kept]), seen.right[kept])
    write_picture(asked.output / "reliability.png", picture)
    print(
        f"{summary['frames']} frames, {100 * summary['right']:.0f} % right; held out: log loss"
        f" {summary['held_out_log_loss']:.3f}; 90 % regions hold"
        f" {summary['held_out_joints_in_90_pct_region']} % of the joints\n"
        f"lost.fitted={asked.output / 'confidence.json'}"
    )


def _fitted_frames(
    seen: Observed, y: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, dict[str, Any]]:
    """Log odds (T,) of y (T,), the model, and figures, those held out of the kept frames."""
    x = seen.features
    intercept, weights = fitted_weights(x[~kept], y[~kept])
    log_odds = intercept + x @ weights
    p = expit(log_odds[kept])
    log_loss = -np.mean(np.log(np.where(y[kept], p, 1 - p).clip(1e-9)))
    fitted = {name: round(float(w), 3) for name, w in zip(FEATURES, weights, strict=True)}
    summary = {
        "frames": len(y),
        "right": round(float(y.mean()), 3),
        "held_out_log_loss": round(float(log_loss), 4),
        "held_out_wrong": round(float(((p > 0.5) != y[kept]).mean()), 4),
        "intercept": round(intercept, 3),
        "weights": fitted,
    }
    return log_odds, summary


def with_doubt(seen: Observed, log_odds: np.ndarray, memory: float) -> Observed:
    """The same with the joints' feature `doubt` as newly fitted log odds (T,) of frames make it.

    As the tracker does, it smooths them within each track.
    """
    smooth = log_odds.copy()
    begins = seen.features[:, FEATURES.index("young")] == 1
    for row in range(1, len(smooth)):
        if not begins[row] and seen.sequence[row] == seen.sequence[row - 1]:
            smooth[row] = memory * smooth[row - 1] + (1 - memory) * log_odds[row]
    features = seen.joint_features.copy()
    features[..., JOINT_FEATURES.index("doubt")] = np.logaddexp(0, -smooth)[:, None]
    return seen._replace(joint_features=features)


def _fitted_joints(seen: Observed, kept: np.ndarray) -> tuple[JointConfidence, dict[str, Any]]:
    """What was fitted, and figures about joints in kept frames."""
    belief = fitted_joint_belief(seen.of(~kept))
    check = seen.of(kept)
    reported = [belief.judge(features) for features in check.joint_features]
    sigma, near = np.stack([one[0] for one in reported]), np.stack([one[1] for one in reported])
    off = np.sqrt(np.square(check.error_cm / (100 * sigma)).sum(2))[check.counted]
    right = np.where(check.near, near, 1 - near)
    summary = {
        "held_out_joints_in_90_pct_region": round(100 * float((off <= REGION_90).mean()), 1),
        "held_out_joints_near": round(float(check.near.mean()), 3),
        "held_out_joints_said_near": round(float(near.mean()), 3),
        "held_out_joints_log_loss": round(-float(np.log(right.clip(1e-9)).mean()), 4),
    }
    return belief, summary


def fitted_joint_belief(seen: Observed) -> JointConfidence:
    """The confidence that suits the frames best.

    Standard deviations are those of Student's t, which says how errors differ; then all three of a
    joint are changed alike, so that the 90 % regions hold what they should under any features.
    Features only ever make a joint less sure: those that go together would otherwise get weights of
    both kinds, which hold for rendered hands only.
    """
    used = seen.of(seen.counted)
    design, unit = _design(used.joint_features)
    error = used.error_cm.reshape(-1, 3)
    sigma = _fit_spread(design, error)
    off = np.sqrt(np.square(error * np.exp(-design @ sigma)).sum(1))
    sigma += _fit_quantile(design, np.log(np.maximum(off, 1e-3) / REGION_90), sigma.min(1))[:, None]
    every, every_unit = _design(seen.joint_features)
    odds = _fit_odds(every, seen.near.reshape(-1))
    table = np.column_stack((_plain(sigma, unit), _plain(odds[:, None], every_unit)))
    lines = [[round(float(value), 3) + 0.0 for value in row] for row in table]
    return JointConfidence(
        kinds=dict(zip(KINDS, lines, strict=False)),
        weights=dict(zip(JOINT_FEATURES, lines[len(KINDS) :], strict=True)),
    )


def _design(features: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """(N, K + S) kinds and features in standard deviations; the features' means and deviations."""
    flat = features.reshape(-1, features.shape[-1])
    mean, spread = flat.mean(0), flat.std(0) + 1e-9
    kinds = np.eye(len(KINDS))[np.tile(KIND_OF_JOINT, len(features))]
    return np.concatenate((kinds, (flat - mean) / spread), 1), (mean, spread)


def _plain(weights: np.ndarray, unit: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Weights (K + S, C) for features as they are."""
    kinds, features = weights[: len(KINDS)], weights[len(KINDS) :] / unit[1][:, None]
    return np.concatenate((kinds - unit[0] @ features, features))


def _fit_spread(design: np.ndarray, error: np.ndarray) -> np.ndarray:
    """(K + S, 3) of log standard deviations, by the likelihood of errors (N, 3)."""

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        log_sigma = design @ weights
        square = np.square(error * np.exp(-log_sigma))
        total = square.sum(1)
        value = log_sigma.sum(1) + (_TAILS + 3) / 2 * np.log1p(total / _TAILS)
        slope = 1 - (_TAILS + 3) * square / (_TAILS + total)[:, None]
        return float(value.mean()), design.T @ slope / len(error)

    return _minimised(loss, np.zeros((design.shape[1], 3)), _SHRINK_JOINTS)


def _fit_quantile(design: np.ndarray, log_off: np.ndarray, most_less: np.ndarray) -> np.ndarray:
    """(K + S,) to be added, so that log_off (N,) is below it in 90 %.

    most_less: (K + S,) weights of features go down by no more.
    """

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        above = log_off - design @ weights[:, 0]
        value = _INSIDE * above + _SOFT * np.logaddexp(0, -above / _SOFT)
        slope = _INSIDE - expit(-above / _SOFT)
        return float(value.mean()), -(design.T @ slope / len(log_off))[:, None]

    return _minimised(loss, -most_less[:, None], _SHRINK_QUANTILE)[:, 0]


def _fit_odds(design: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(K + S,) of the log odds that a joint is near."""

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds = -design @ weights[:, 0]
        value = np.logaddexp(0, odds) - near * odds
        return float(value.mean()), -(design.T @ (expit(odds) - near) / len(near))[:, None]

    return -_minimised(loss, np.zeros((design.shape[1], 1)), _SHRINK_JOINTS)[:, 0]


def _minimised(
    loss: Callable[[np.ndarray], tuple[float, np.ndarray]], least: np.ndarray, shrink: float
) -> np.ndarray:
    """Weights (K + S, C); those of features are shrunk, and at least `least`."""
    shape, features = least.shape, slice(len(KINDS), None)

    def shrunk(flat: np.ndarray) -> tuple[float, np.ndarray]:
        weights = flat.reshape(shape)
        value, slope = loss(weights)
        slope[features] += 2 * shrink * weights[features]
        return value + shrink * float(np.square(weights[features]).sum()), slope.ravel()

    lower = np.full(shape, -np.inf)
    lower[features] = least[features]
    bounds = [(low, None) for low in lower.ravel()]
    start = np.maximum(np.zeros(shape), lower).ravel()
    found = minimize(shrunk, start, jac=True, bounds=bounds, method="L-BFGS-B")
    weights: np.ndarray = found.x.reshape(shape)
    return weights


def fitted_weights(features: np.ndarray, right: np.ndarray) -> tuple[float, np.ndarray]:
    """Intercept and weights (S,) of a logistic model of features (N, S) and what was right (N,).

    Only the score may speak for an estimate and all other features against it: those that go
    together would otherwise get weights of both kinds, which hold for rendered hands only.
    """
    mean, spread = features.mean(0), features.std(0) + 1e-9
    z, y = (features - mean) / spread, right.astype(float)

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        odds = z @ parameters[1:] + parameters[0]
        off = 1 / (1 + np.exp(-odds)) - y
        slope = np.concatenate(([off.sum()], z.T @ off + _SHRINK * parameters[1:]))
        square = 0.5 * _SHRINK * np.square(parameters[1:]).sum()
        return float((np.logaddexp(0, odds) - y * odds).sum() + square), slope

    bounds = [(None, None)] + [(0, None) if name == "log_score" else (None, 0) for name in FEATURES]
    start = np.zeros(len(FEATURES) + 1)
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x
    weights = found[1:] / spread
    return float(found[0] - (weights * mean).sum()), weights


def observed(sequence: Sequence, overrides: list[str], seed: int, number: int) -> Observed | None:
    """What the tracker makes of a sequence; None where it never saw a hand."""
    tracker = make_tracker(f"hand.side={sequence.side}", f"seed={seed}", *overrides)
    rows = []
    for index, depth in enumerate(sequence.depth_m):
        estimate = tracker.step(depth, sequence.k, index, index / 25)
        info = tracker.info
        if info is None or info.features is None or info.joint_features is None:
            continue
        joints, there = estimate.joints_m.astype(np.float64), bool(sequence.visible[index])
        off = sequence.joints_m[index] - joints
        far = np.linalg.norm(off, axis=1)
        near = there & (far < RIGHT_M)
        whole = there & (far.mean() < RIGHT_M)
        error_cm = 100 * np.einsum("jab,jb->ja", joint_axes(joints), off)
        counted = there and not estimate.lost
        of_joints = (info.joint_features, error_cm, near, counted)
        rows.append((info.features.values(), near.all(), whole, *of_joints, number))
    return Observed(*map(np.array, zip(*rows, strict=True))) if rows else None


_BINS = 10
_FEWEST = 10


def reliability_figure(said: np.ndarray, right: np.ndarray, what: str = "held out") -> np.ndarray:
    """Observed against said probability, BGR.

    said: (N,) probabilities.  right: (N,) whether the estimates were right.  what: they are of.
    """
    figure = chart.new_figure(700, 460)
    axes = figure.subplots()
    chart.label(axes, "said (points: tenths of the range, mean of each)", "right")
    axes.plot((0, 1), (0, 1), color=chart.GREY, linewidth=1)
    index = np.minimum((said * _BINS).astype(int), _BINS - 1)
    bins = [index == number for number in range(_BINS)]
    bins = [rows for rows in bins if rows.sum() >= _FEWEST]
    means = [[values[rows].mean() for rows in bins] for values in (said, right)]
    axes.plot(*means, "o-", color=chart.BLUE, label=f"{what} ({len(said)})")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    figure.legend(loc="outside right upper", frameon=False)
    picture = chart.picture_of(figure)
    return chart.titled(picture, "Reliability of the confidence", "On the line is calibrated.")
