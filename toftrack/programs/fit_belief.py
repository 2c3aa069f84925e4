"""Fit the tracker's belief on rendered sequences, whose hands and sensors are none that it is
judged on:

python -m toftrack.programs.fit_belief
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from tqdm import tqdm

from toftrack.api import make_tracker
from toftrack.programs import command_line
from toftrack.relocation.sequences import Sequence, random_sequence
from toftrack.relocation.shapes import shape_bank
from toftrack.tracking.signs import SIGNS

RIGHT_M = 0.04
"""An estimate is right when every joint is within this."""
_SHRINK = 100.0
"""Prior precision of the weights of signs in standard deviations, in frames."""
_HELD_OUT = 5
"""Every so manieth sequence is kept to check the fit."""


def read_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        prog="python -m toftrack.programs.fit_belief",
        description="Fit lost=calibrated: prints the intercept and weights for its configuration.",
    )
    parser.add_argument("overrides", nargs="*", help="of the tracker, as for track.py")
    parser.add_argument("--sequences", type=int, default=150, help="how many are rendered (150)")
    parser.add_argument("--frames", type=int, default=50, help="of each (50)")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (1)")
    parser.add_argument("--output", type=Path, default=Path("belief"), help="folder (belief)")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Render, track, fit, report."""
    import cv2

    from toftrack.views.figures.reliability import reliability_figure

    asked = read_arguments(arguments)
    asked.output.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(asked.seed)
    bank = shape_bank(400, generator)
    signs: list[list[float]] = []
    right: list[bool] = []
    numbers: list[int] = []
    for number in tqdm(range(asked.sequences), unit=" sequences", file=sys.stderr):
        sequence = random_sequence(asked.frames, bank, generator)
        rows, labels = observed(sequence, asked.overrides, asked.seed + number)
        signs += rows
        right += labels
        numbers += [number] * len(rows)
    x, y, which = np.array(signs), np.array(right), np.array(numbers)
    kept = which % _HELD_OUT == 0
    intercept, weights = fitted_weights(x[~kept], y[~kept])
    p = 1 / (1 + np.exp(-(intercept + x[kept] @ weights)))
    log_loss = -np.mean(np.log(np.where(y[kept], p, 1 - p).clip(1e-9)))
    fitted = {name: round(float(w), 3) for name, w in zip(SIGNS, weights, strict=True)}
    summary = {
        "frames": len(y),
        "right": round(float(y.mean()), 3),
        "held_out_log_loss": round(float(log_loss), 4),
        "held_out_wrong": round(float(((p > 0.5) != y[kept]).mean()), 4),
        "intercept": round(intercept, 3),
        "weights": fitted,
    }
    (asked.output / "belief.json").write_text(json.dumps(summary, indent=1) + "\n")
    picture = reliability_figure({"held out": (p, y[kept])})
    cv2.imwrite(str(asked.output / "reliability.png"), picture)
    np.savez_compressed(asked.output / "signs.npz", signs=x, right=y, sequence=which)
    print(f"intercept: {summary['intercept']}\nweights:")
    print("\n".join(f"  {name}: {value}" for name, value in fitted.items()))
    print(f"{len(y)} frames, {100 * y.mean():.0f} % right; held out: log loss {log_loss:.3f}")
    print(f"results: {asked.output}")


def fitted_weights(signs: np.ndarray, right: np.ndarray) -> tuple[float, np.ndarray]:
    """Intercept and weights (S,) of a logistic model of signs (N, S) and what was right (N,).

    Only the score may speak for an estimate and all other signs against it: signs that go together
    would otherwise get weights of both kinds, which hold for rendered hands only.
    """
    mean, spread = signs.mean(0), signs.std(0) + 1e-9
    z, y = (signs - mean) / spread, right.astype(float)

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        odds = z @ parameters[1:] + parameters[0]
        off = 1 / (1 + np.exp(-odds)) - y
        slope = np.concatenate(([off.sum()], z.T @ off + _SHRINK * parameters[1:]))
        square = 0.5 * _SHRINK * np.square(parameters[1:]).sum()
        return float((np.logaddexp(0, odds) - y * odds).sum() + square), slope

    bounds = [(None, None)] + [(0, None) if name == "log_score" else (None, 0) for name in SIGNS]
    start = np.zeros(len(SIGNS) + 1)
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x
    weights = found[1:] / spread
    return float(found[0] - (weights * mean).sum()), weights


def observed(
    sequence: Sequence, overrides: list[str], seed: int
) -> tuple[list[list[float]], list[bool]]:
    """The signs of every estimate of a sequence, and whether it was right."""
    tracker = make_tracker(f"hand.side={sequence.side}", f"seed={seed}", *overrides)
    rows, labels = [], []
    for index, depth in enumerate(sequence.depth_m):
        estimate = tracker.step(depth, sequence.k, index, index / 25)
        info = tracker.info
        if info is None or info.signs is None:
            continue
        error = np.linalg.norm(estimate.joints_m - sequence.joints_m[index], axis=1)
        rows.append(info.signs.values())
        labels.append(bool(error.max() < RIGHT_M and sequence.visible[index]))
    return rows, labels


if __name__ == "__main__":
    sys.exit(command_line.run(main))
