"""The fit of a JointConfidence to errors that are known; a part of fit-confidence."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from toftrack.hand.regions import REGION_90
from toftrack.tracking.confidence import JOINT_FEATURES, KIND_OF_JOINT, KINDS, JointConfidence

_TAILS = 4.0
"""Degrees of freedom of the Student t that errors are taken for: wrong fingers are no outliers of a
Gaussian."""
_SHRINK = 1e-3
"""Prior precision of the weights of features in standard deviations, per joint."""
_SHRINK_QUANTILE = 0.1
"""The same of what the quantile changes. It is that strong because tails belong to few sequences,
those with wrong tracks: weaker, regions of good frames get too small, and of doubtful too large."""
_INSIDE = 0.9
_SOFT = 0.05
"""Width of the kink of the quantile's loss, log scale."""


class JointRows(NamedTuple):
    """What T estimates said of their joints, and how it was.

    features: (T, 21, S).  error_cm: (T, 21, 3) along joint_axes.
    near: (T, 21) the hand is there, and the joint within 40 mm.
    counted: (T,) the hand is there and the estimate not flagged lost.
    """

    features: np.ndarray
    error_cm: np.ndarray
    near: np.ndarray
    counted: np.ndarray

    def of(self, rows: np.ndarray) -> JointRows:
        """Some of them."""
        return JointRows(*(values[rows] for values in self))


def fitted_joint_belief(rows: JointRows) -> JointConfidence:
    """The confidence that suits the rows best.

    Standard deviations are those of Student's t, which says how errors differ; then all three of a
    joint are changed alike, so that the 90 % regions hold what they should under any features.
    Features only ever make a joint less sure: those that go together would otherwise get weights of
    both kinds, which hold for rendered hands only.
    """
    used = rows.of(rows.counted)
    design, unit = _design(used.features)
    error = used.error_cm.reshape(-1, 3)
    sigma = _fit_spread(design, error)
    off = np.sqrt(np.square(error * np.exp(-design @ sigma)).sum(1))
    sigma += _fit_quantile(design, np.log(np.maximum(off, 1e-3) / REGION_90), sigma.min(1))[:, None]
    every, every_unit = _design(rows.features)
    odds = _fit_odds(every, rows.near.reshape(-1))
    table = np.column_stack((_plain(sigma, unit), _plain(odds[:, None], every_unit)))
    lines = [[round(float(value), 3) + 0.0 for value in row] for row in table]
    return JointConfidence(
        scale=1.0,
        odds=0.0,
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

    return _minimised(loss, np.zeros((design.shape[1], 3)), _SHRINK)


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

    return -_minimised(loss, np.zeros((design.shape[1], 1)), _SHRINK)[:, 0]


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
