"""The table of a public data set: cases done by hand."""

import json

import numpy as np
import pytest

from toftrack.evaluation.public import labelled_figures, totals

JOINTS = (0, 5, 8, 20)
"""Two of them are fingertips."""
TRUE = np.tile(np.array([0.0, 0.0, 0.5]), (4, len(JOINTS), 1))


def estimates() -> tuple[np.ndarray, np.ndarray]:
    """Four frames: right, a tip 60 mm off, none, all joints 50 mm off; the first is flagged."""
    joints = TRUE.copy()
    joints[1, 2, 0] += 0.06
    joints[2] = np.nan
    joints[3, :, 1] += 0.05
    return joints, np.array([True, False, False, False])


def test_figures_of_four_frames() -> None:
    figures = labelled_figures(*estimates(), TRUE, JOINTS)
    assert figures["frames"] == 4
    assert figures["missing_pct"] == 25
    assert figures["mean_mm"] == pytest.approx((0 + 15 + 50) / 3)
    assert figures["fingertip_mm"] == pytest.approx((0 + 30 + 50) / 3)
    assert figures["within_pct"] == 25  # the first, though it is flagged
    assert figures["usable_pct"] == 0
    assert figures["partly_pct"] == figures["false_alarm_pct"] == 25
    assert figures["silent_pct"] == 25


def test_a_track_without_any_estimate_has_no_errors() -> None:
    nothing = np.full_like(TRUE, np.nan)
    figures = labelled_figures(nothing, np.ones(4, bool), TRUE, JOINTS)
    assert (figures["missing_pct"], figures["within_pct"]) == (100, 0)
    assert figures["mean_mm"] is figures["median_mm"] is figures["fingertip_mm"] is None
    json.dumps(totals({"a": figures}), allow_nan=False)


def test_the_total_is_the_mean_over_sequences() -> None:
    some = labelled_figures(*estimates(), TRUE, JOINTS)
    good = labelled_figures(TRUE[:3], np.zeros(3, bool), TRUE[:3], JOINTS)
    total = totals({"some": some, "good": good})
    assert (total["sequences"], total["frames"], total["never_right"]) == (2, 7, 1)
    assert total["usable_pct"] == 50
    assert total["usable_90"] == [0, 100]
    assert total["mean_mm"] == pytest.approx(some["mean_mm"] / 2)
