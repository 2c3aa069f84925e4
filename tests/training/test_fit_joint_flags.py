"""Choosing which joints are ok: on one half, and shown on the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.training.fit_joint_flags import Tips, chosen, is_shown, rates, report


def tips(count: int = 4000, seed: int = 0) -> Tips:
    """As often wrong as their confidence says."""
    rng = np.random.default_rng(seed)
    sure = rng.beta(8, 1, count)
    return Tips(sure, rng.random(count) > sure, rng.random(count) < 0.5)


def test_the_share_of_right_tips_that_are_flagged_is_kept_on_the_other_half() -> None:
    here, there = tips().half(False), tips().half(True)
    least = chosen(here, right_pct=5)
    assert rates(here, least)["right_flagged_pct"] == pytest.approx(5, abs=0.1)
    other = rates(there, least)
    assert other["right_flagged_pct"] == pytest.approx(5, abs=2)
    assert other["wrong_flagged_pct"] > 15 and other["wrong"] == there.wrong.sum()
    joint_ok, _, shown = report(tips(), True, right_pct=5).splitlines()
    assert joint_ok == f"joint_ok: {least:g}"
    assert f"{other['wrong_flagged_pct']} % of {other['wrong']} wrong tips flagged" in shown
    assert f"of {here.wrong.sum()} wrong" in report(tips(), False, 5).splitlines()[2]


def test_without_a_right_tip_nothing_can_be_chosen() -> None:
    with pytest.raises(ToftrackError, match="no fingertip of the half"):
        chosen(replace(tips(), wrong=np.ones(4000, bool)), 4)


def test_every_second_recording_of_a_folder_is_shown() -> None:
    found = [Path(name) for name in ("a/1", "a/2", "b/1", "a/3", "b/2")]
    assert [is_shown(one, found) for one in found] == [False, True, False, False, True]
