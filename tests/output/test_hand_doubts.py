"""A hand of a length that hands do not have speaks against the focal length."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.programs import QUICK
from helpers.tracking import ROOT

from toftrack.frames.estimate import no_estimate
from toftrack.hand.shape import Fitted, HandShape, default_hand_shape
from toftrack.hand.shape_space import COMPONENTS
from toftrack.output.advice import RunFacts, lost_frame, tracked_frame
from toftrack.output.summary import apparent_doubt, length_doubt
from toftrack.programs.main import main

K = np.array([[300.0, 0, 88], [0, 300, 72], [0, 0, 1]])


def hand(length_m: float, sigma: float = 0.024) -> HandShape:
    mean, covariance = (0.0,) * len(COMPONENTS), np.eye(len(COMPONENTS)) * sigma**2
    fitted = Fitted(COMPONENTS, mean, tuple(map(tuple, covariance)), 3.0, False)
    return dataclasses.replace(default_hand_shape(length_m), fitted=fitted)


def test_a_fitted_hand_that_is_hardly_anybody_s_is_reported() -> None:
    assert "fx = 214.7 instead of 300" in length_doubt(hand(0.136), K)
    assert "fx = 363.2 instead of 300" in length_doubt(hand(0.230), K)


def test_hands_of_people_and_unsure_fits_are_not_doubted() -> None:
    unsure, given = hand(0.13, sigma=0.12), default_hand_shape(0.1)
    for shape in (*map(hand, (0.140, 0.145, 0.19, 0.215)), unsure, given):
        assert length_doubt(shape, K) == ""


def test_how_long_a_lost_hand_seemed_counts_where_most_was_lost_and_it_was_seen_often() -> None:
    detection = SimpleNamespace(present=0.95, length_m=0.226)
    about = {"observation": SimpleNamespace(hand=np.ones(9)), "features": None}
    depth, lost = np.ones((6, 8), np.float32), no_estimate(0, 0.0, "searching", 4, 0.01)
    seen, unseen = (
        lost_frame(lost, depth, SimpleNamespace(detection=found, **about), 2.0)
        for found in (detection, SimpleNamespace(present=0.85, length_m=0.3))
    )

    def mean(often: int, seldom: int, tracked: int) -> float | None:
        facts = RunFacts()
        for frame in [seen] * often + [unseen] * seldom:
            facts.add(frame)
        for _ in range(tracked):
            facts.add(tracked_frame(None))
        return facts.mean_apparent_m()

    assert mean(20, 10, 5) == pytest.approx(0.226)
    assert mean(20, 10, 30) is None and mean(9, 0, 0) is None and mean(11, 69, 0) is None
    assert "looks 226 mm long" in apparent_doubt(0.226, K)
    assert apparent_doubt(0.209, K) == apparent_doubt(0.145, K) == ""


def tracked(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[dict, str]:
    run = folder / "run"
    given = [*words, "hand.side=right", "view=none", f"hydra.run.dir={run}", *QUICK]
    assert main(["track", *given]) == 0
    captured = capsys.readouterr()
    summary = json.loads((run / "summary.json").read_text())
    summary["file"] = json.loads((run / "hand_shape.json").read_text())
    return summary, captured.err + captured.out


def test_a_focal_length_that_makes_the_hand_small_is_reported_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(ROOT / "toftrack" / "data" / "sample.npz")
    words = [path, "device.intrinsics=[340,340,88,72]", "device.stop=24"]
    summary, said = tracked(tmp_path, capsys, *words)
    (doubt,) = summary["doubts"]
    assert "as only small children's hands are" in doubt and f"note: {doubt}" in said
    assert summary["hand"]["fitted"] and summary["file"]["fitted"]["poses"] > 0
    assert ", fitted" in said


def test_fitted_is_not_said_of_a_hand_that_was_never_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wall.npz"
    depth = np.random.default_rng(0).uniform(1.5, 1.52, (3, 144, 176)).astype(np.float32)
    np.savez(path, depth_m=depth, K=K, timestamp_s=[0.0, 33, 66])
    summary, said = tracked(tmp_path, capsys, str(path))
    assert not summary["hand"]["fitted"] and summary["file"]["fitted"] is None
    assert "190 mm long\n" in said and ", fitted" not in said
    (doubt,) = summary["doubts"]
    assert "milliseconds" in doubt
    again = tmp_path / "run" / "summary.json"
    again.unlink()
    assert main(["recover", str(again.parent)]) == 0
    assert json.loads(again.read_text())["doubts"] == [doubt]
