"""A frame's evidence in one pass over its pixels; likelihood.py says what it means."""

from __future__ import annotations

import numpy as np

from toftrack.compute.compiling import entry_point

_ONE, _LEAST_M = np.float32(1), np.float32(1e-3)


def evidence_images(
    depth_m: np.ndarray,
    hand: np.ndarray,
    occluder: np.ndarray,
    other: np.ndarray | None,
    tolerance_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Low, high and occluder of Evidence, (H, W) float32; see FMeasure.evidence.

    depth_m: (H, W).  hand, occluder, other: (H, W) bool; None where no other hand is known.
    """
    low, high, front = (np.empty(depth_m.shape, np.float32) for _ in range(3))
    given = (np.ascontiguousarray(one) for one in (depth_m, hand, occluder))
    none = np.zeros((0, 0), bool)
    fill_bands(
        *given,
        none if other is None else np.ascontiguousarray(other),
        np.float32(tolerance_m),
        low,
        high,
        front,
    )
    return low, high, front


@entry_point
def fill_bands(depth, hand, occluder, other, tolerance, low, high, front):
    """low, high, front: (H, W), written."""
    known = len(other) > 0
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            low[row, column], high[row, column] = np.float32(np.inf), np.float32(-np.inf)
            if hand[row, column]:
                low[row, column] = _ONE / (z + tolerance)
                high[row, column] = _ONE / max(z - tolerance, _LEAST_M)
            hidden = np.float32(0)
            if known and other[row, column] and z > 0:
                hidden = _ONE / z
            front[row, column] = np.float32(np.inf) if occluder[row, column] else hidden
