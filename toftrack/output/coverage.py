"""How often the true joints lie in the regions where the tracker says that they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toftrack.frames import Truth
from toftrack.hand.regions import in_region_90


@dataclass(frozen=True)
class Coverage:
    """Joints of the frames in which the hand is visible, lost or not; None where there are none.

    in_region_90_pct: that lie in their 90 % region, of all that have one.
    hidden_in_region_90_pct: the same of those that are out of sight.
    without_region_pct: that have none, of all.
    """

    in_region_90_pct: float | None
    hidden_in_region_90_pct: float | None
    without_region_pct: float | None


def coverage(joints_m: np.ndarray, joint_sigma_m: np.ndarray, truth: Truth) -> Coverage:
    """The coverage of estimates (T, 21, 3) with standard deviations (T, 21, 3), see regions.py."""
    there = np.asarray(truth.visible, bool)[:, None] & np.ones(joints_m.shape[1], bool)
    known = np.isfinite(joints_m).all(-1) & np.isfinite(joint_sigma_m).all(-1)
    inside = in_region_90(joints_m, joint_sigma_m, truth.joints_m)
    hidden = there & False if truth.joint_visible is None else there & ~truth.joint_visible
    return Coverage(
        in_region_90_pct=_share_pct(inside, there & known),
        hidden_in_region_90_pct=_share_pct(inside, hidden & known),
        without_region_pct=_share_pct(~known, there),
    )


def _share_pct(part: np.ndarray, whole: np.ndarray) -> float | None:
    return 100.0 * float(part[whole].mean()) if whole.any() else None
