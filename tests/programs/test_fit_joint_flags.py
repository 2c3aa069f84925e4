"""Choosing which joints are ok: on one half, and shown on the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toftrack.benchmark.runs import Source
from toftrack.errors import ToftrackError
from toftrack.programs.fit_joint_flags import Tips, chosen, curve, is_shown, lines, rates


def tips(count: int = 4000, seed: int = 0) -> Tips:
    """Wrong where it is doubted or covered, with the whole estimate's doubt saying nothing."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(count, 3))
    columns[:, 2] = np.abs(columns[:, 2])
    odds = 2 * columns[:, 0] - 3 * columns[:, 2] + 2
    wrong = rng.random(count) > 1 / (1 + np.exp(-odds))
    return Tips(columns, wrong, rng.random(count) < 0.5)


def test_the_weights_are_found_and_the_share_of_right_ones_is_kept() -> None:
    here, there = tips().half(False), tips().half(True)
    flags = chosen(here, right_pct=5)
    assert flags.behind == pytest.approx(1.5, abs=0.35) and flags.whole < 0.15
    assert rates(here, flags)["right_flagged_pct"] == pytest.approx(5, abs=0.3)
    other = rates(there, flags)
    assert other["right_flagged_pct"] == pytest.approx(5, abs=2)
    assert other["wrong_flagged_pct"] > 30
    shares = [wrong for _, wrong in curve(there, flags)]
    assert shares == sorted(shares) and shares[0] < shares[-1]
    report = {"joint_ok": vars(flags), "chosen_on": other, "shown_on": other, "curve": []}
    assert f"  least: {flags.least:g}" in lines(report)


def test_what_speaks_for_covered_joints_is_not_learned() -> None:
    odd = tips()
    flags = chosen(replace(odd, columns=odd.columns * (1, 1, -1)), right_pct=5)
    assert flags.behind == 0


def test_without_a_wrong_tip_nothing_can_be_chosen() -> None:
    with pytest.raises(ToftrackError, match="no fingertip of the half"):
        chosen(replace(tips(), wrong=np.zeros(4000, bool)), 4)


def test_every_second_recording_of_a_folder_is_shown() -> None:
    found = [Source(Path(name), name, 9) for name in ("a/1", "a/2", "b/1", "a/3", "b/2")]
    assert [is_shown(one, found) for one in found] == [False, True, False, False, True]
