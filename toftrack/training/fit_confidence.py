"""Fit the tracker's confidence on rendered sequences, whose hands and sensors are none that it is
judged on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.archives import write_archive
from toftrack.errors import ToftrackError
from toftrack.hand.regions import REGION_90, joint_axes
from toftrack.safe_files import write_whole
from toftrack.tracking.confidence import FEATURES, JOINT_FEATURES, ConfidenceModel, JointConfidence
from toftrack.tracking.model import TrackerModel
from toftrack.training.joint_fit import JointRows, fitted_joint_belief
from toftrack.training.sequences import Sequence, random_sequence, read_sequence, write_sequence
from toftrack.training.shapes import shape_bank
from toftrack.views.figures import chart
from toftrack.views.pictures import write_picture

RIGHT_M = 0.04
"""An estimate is right when every joint is within this."""
_SHRINK = 100.0
"""Prior precision of the weights of features in standard deviations, in frames."""
_HELD_OUT = 5
"""Every so manieth sequence is kept to check the fit."""


@dataclass(frozen=True, eq=False)
class Observed:
    """What the tracker's estimates of T frames were formed from, and how right they were.

    features: (T, S).  right: (T,) every joint is within 40 mm.  whole: (T,) they are on average.
    joints: of each joint.  sequence: (T,) numbers of the sequences.
    """

    features: np.ndarray
    right: np.ndarray
    whole: np.ndarray
    joints: JointRows
    sequence: np.ndarray

    def of(self, rows: np.ndarray) -> Observed:
        """Some of the frames."""
        joints = self.joints.of(rows)
        here = self.features[rows], self.right[rows], self.whole[rows]
        return Observed(*here, joints, self.sequence[rows])


def fit_confidence(asked: argparse.Namespace) -> None:
    """Render, track, fit, report; asked: the arguments of fit-confidence."""
    asked.output.mkdir(parents=True, exist_ok=True)
    count, sequences = _sequences(asked)
    parts = [
        observed(sequence, asked.overrides, asked.seed + number, number)
        for number, sequence in enumerate(
            tqdm(sequences, total=count, unit=" sequences", file=sys.stderr)
        )
    ]
    seen = _together([part for part in parts if part is not None])
    kept = seen.sequence % _HELD_OUT == 0
    log_odds, summary = _fitted_frames(seen, seen.right, kept)
    summary["whole"] = _fitted_frames(seen, seen.whole, kept)[1]
    settings = _settings(asked.overrides)
    seen = with_doubt(seen, log_odds, settings.memory)
    belief, more = _fitted_joints(seen, kept)
    summary |= more
    write_whole(asked.output / "summary.json", json.dumps(summary, indent=1) + "\n")
    fitted = {
        part: {name: of[name] for name in ("intercept", "weights")}
        for part, of in (("every_joint", summary), ("whole", summary["whole"]))
    }
    # Scale and odds of the joints are not fitted on rendered sequences: they stay.
    joints = replace(belief, scale=settings.joints.scale, odds=settings.joints.odds)
    content = json.dumps(fitted | {"joints": asdict(joints)}, indent=1)
    write_whole(asked.output / "confidence.json", content + "\n")
    picture = reliability_figure(expit(log_odds[kept]), seen.right[kept])
    write_picture(asked.output / "reliability.png", picture)
    arrays = {name: getattr(seen, name) for name in ("features", "right", "whole", "sequence")}
    arrays |= {f"joint_{name}": values for name, values in seen.joints._asdict().items()}
    write_archive(asked.output / "features.npz", arrays)
    print(
        f"{summary['frames']} frames, {100 * summary['right']:.0f} % right; held out: log loss"
        f" {summary['held_out_log_loss']:.3f}; 90 % regions hold"
        f" {summary['held_out_joints_in_90_pct_region']} % of the joints\n"
        f"lost.fitted={asked.output / 'confidence.json'}"
    )


def _sequences(asked: argparse.Namespace) -> tuple[int, Iterator[Sequence]]:
    """How many sequences, and one after the other."""
    folder: Path | None = asked.sequences_from
    files = [] if folder is None else sorted(folder.glob("*.npz"))
    if files:
        return len(files), (read_sequence(file) for file in files)
    generator = torch.Generator().manual_seed(asked.seed)
    bank = shape_bank(400, generator)

    def rendered() -> Iterator[Sequence]:
        for number in range(asked.sequences):
            sequence = random_sequence(asked.frames, bank, generator)
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                write_sequence(folder / f"{number:04d}.npz", sequence)
            yield sequence

    return asked.sequences, rendered()


def _fitted_frames(
    seen: Observed, y: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, dict[str, Any]]:
    """Log odds (T,) of y (T,), the model, and figures about the kept frames."""
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


def _settings(overrides: list[str]) -> ConfidenceModel:
    model = make_tracker(*overrides).model
    if not isinstance(model, TrackerModel):
        raise ToftrackError("fit-confidence fits lost=calibrated; leave experiment=paper out")
    return model.lost


def with_doubt(seen: Observed, log_odds: np.ndarray, memory: float) -> Observed:
    """The same with the joints' feature `doubt` as newly fitted log odds (T,) of frames make it.

    As the tracker does, it smooths them within each track.
    """
    smooth = log_odds.copy()
    begins = seen.features[:, FEATURES.index("young")] == 1
    for row in range(1, len(smooth)):
        if not begins[row] and seen.sequence[row] == seen.sequence[row - 1]:
            smooth[row] = memory * smooth[row - 1] + (1 - memory) * log_odds[row]
    features = seen.joints.features.copy()
    features[..., JOINT_FEATURES.index("doubt")] = np.logaddexp(0, -smooth)[:, None]
    return replace(seen, joints=seen.joints._replace(features=features))


def _fitted_joints(seen: Observed, kept: np.ndarray) -> tuple[JointConfidence, dict[str, Any]]:
    """What was fitted, and figures about joints in kept frames."""
    belief = fitted_joint_belief(seen.joints.of(~kept))
    check = seen.joints.of(kept)
    reported = [belief.judge(features) for features in check.features]
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
        rows.append((info.features.values(), near.all(), whole, *of_joints))
    if not rows:
        return None
    features, right, whole, *joint_rows = map(np.array, zip(*rows, strict=True))
    return Observed(features, right, whole, JointRows(*joint_rows), np.full(len(rows), number))


def _together(parts: list[Observed]) -> Observed:
    joints = zip(*(part.joints for part in parts), strict=True)
    features, right, whole, sequence = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("features", "right", "whole", "sequence")
    )
    return Observed(features, right, whole, JointRows(*map(np.concatenate, joints)), sequence)


_BINS = 10
_FEWEST = 10


def reliability_figure(said: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Observed against said probability of frames that were held out, BGR.

    said: (N,) probabilities.  right: (N,) whether the estimates were right.
    """
    figure = chart.new_figure(700, 460)
    axes = figure.subplots()
    chart.label(axes, "said (points: tenths of the range, mean of each)", "right")
    axes.plot((0, 1), (0, 1), color=chart.GREY, linewidth=1)
    axes.plot(*_binned(said, right), "o-", color=chart.BLUE, label=f"held out ({len(said)})")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    figure.legend(loc="outside right upper", frameon=False)
    picture = chart.picture_of(figure)
    return chart.titled(picture, "Reliability of the confidence", "On the line is calibrated.")


def _binned(said: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean said and observed probability of the bins that hold enough frames."""
    index = np.minimum((said * _BINS).astype(int), _BINS - 1)
    rows = [index == number for number in range(_BINS)]
    rows = [row for row in rows if row.sum() >= _FEWEST]
    return np.array([said[r].mean() for r in rows]), np.array([right[r].mean() for r in rows])
