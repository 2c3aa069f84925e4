"""Means, shares and intervals: None stands for a figure about nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

_DRAWS = 2000


class Interval(NamedTuple):
    """A mean over recordings with its 90 % bootstrap interval.

    Of few recordings it is too narrow: of normally distributed figures it holds the true mean in
    86 % of the cases with 12 of them, in 80 % with 5, 61 % with 3 and 54 % with 2; of skewed ones,
    as shares near 100 %, in some 5 less.
    """

    mean: float
    low: float
    high: float


def interval(values: Sequence[float]) -> Interval:
    """The mean over recordings, with the interval from resampling the recordings."""
    known = np.asarray(values, np.float64)
    rng = np.random.default_rng(0)
    low, high = np.percentile(rng.choice(known, (_DRAWS, len(known))).mean(1), (5, 95))
    return Interval(float(known.mean()), float(low), float(high))


def mean_of(values: Sequence[float | None]) -> float | None:
    """The mean of those that there are."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def figure(values: np.ndarray, of: Callable[[np.ndarray], Any] = np.mean) -> float | None:
    """The mean of an array, or what another function makes of it."""
    return float(of(values)) if values.size else None


def share_pct(part: np.ndarray, whole: np.ndarray) -> float | None:
    """How many of the rows of `whole`, (T,) bool, are in `part`, per cent."""
    return 100.0 * float((part & whole).sum()) / float(whole.sum()) if whole.any() else None


def rounded(value: Any) -> Any:
    """As it stands in files: floats with three digits, anything else as it is."""
    return round(value, 3) if isinstance(value, float) else value


def text_of(value: Any, digits: int = 1) -> str:
    """As it stands in tables."""
    return "-" if value is None else f"{value:.{digits}f}"
