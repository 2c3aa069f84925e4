"""Measuring the pose network on single frames: the figures are those of its errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tracking import sample

from toftrack.detector.weights import DEFAULT_FILE
from toftrack.errors import ToftrackError
from toftrack.programs import measure_detector as program
from toftrack.programs.redrawn_hands import fitted_hands, redrawn
from toftrack.render.model_image import model_range_image

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLE = DEFAULT_FILE.parent / "sample.npz"


def test_figures_are_those_of_the_errors() -> None:
    error = np.full((4, 21), 0.010)
    error[0] = 0.020
    error[1, 8] = 0.050
    names = np.array(["a", "a", "b", "b"])
    tables = program.Misses(error, names, np.array(["fist", "palm", "palm", "palm"])).tables()
    assert tables["all"]["all"]["frames"] == 4
    assert tables["all"]["all"]["within_40_mm"] == 75
    assert tables["pose"]["fist"]["mean_mm"] == 20 and tables["pose"]["palm"]["frames"] == 3
    assert tables["recording"]["a"]["within_40_mm"] == 50


def test_weights_are_compared_on_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = ["--weights", str(DEFAULT_FILE), "--json", str(tmp_path / "figures.json")]
    copy = tmp_path / "copy.npz"
    copy.write_bytes(DEFAULT_FILE.read_bytes())
    program.main([str(SAMPLE), "--every", "40", "--weights", str(copy), *again[:2]])
    program.main([str(SAMPLE), "--every", "20", *again])
    assert "weights 2" in capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())[str(DEFAULT_FILE)]
    whole = figures["all"]["all"]
    assert whole["frames"] > 2 and whole["mean_mm"] < 20 and whole["within_40_mm"] > 60
    assert list(figures["recording"]) == ["sample"]


def test_the_same_frames_are_measured_with_the_hand_redrawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "figures.json"
    program.main([str(SAMPLE), "--every", "40", "--redrawn", "--json", str(path)])
    assert "redrawn" in capsys.readouterr().out
    (first, second) = (table["all"]["all"] for table in json.loads(path.read_text()).values())
    assert first["frames"] == second["frames"]
    assert first["mean_mm"] != second["mean_mm"] < 20


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_redrawn_hand_is_in_the_place_of_the_recorded_one_and_all_else_stays(side: str) -> None:
    scene = sample().cut(40)
    depth, joints, k = scene.depth_m[0].copy(), scene.joints_m, scene.k.copy()
    if side == "left":
        depth, joints = depth[:, ::-1].copy(), joints * [-1.0, 1.0, 1.0]
        k[0, 2] = depth.shape[1] - 1 - k[0, 2]
    hands = fitted_hands(joints, side)
    assert np.linalg.norm(hands.joints_m - joints, axis=2)[:, 1:].mean() < 0.003
    u, v = (k @ joints[0, 8])[:2] / joints[0, 8, 2]
    in_front = np.s_[int(v) - 2 : int(v) + 2, int(u) - 2 : int(u) + 2]
    depth[in_front] = 0.2
    given = hands.states[0], hands.shape
    image, again = (redrawn(depth, k, *given, torch.Generator().manual_seed(3)) for _ in range(2))
    assert np.array_equal(image, again)
    drawn = model_range_image(given[0].numpy(), hands.shape, k, *depth.shape)
    assert (image[in_front] == np.float32(0.2)).all()
    shown = (drawn > 0) & (image > 0) & (image > 0.25)
    assert shown.sum() > 0.9 * (drawn > 0).sum()
    noise = np.abs(image - drawn)[shown]
    assert np.median(noise) < 0.006 and np.median(np.abs(depth - drawn)[shown]) > 0
    changed = image != depth
    rows, columns = np.nonzero(changed)
    corners = (k @ joints[0].T)[:2] / joints[0, :, 2]
    margin = 0.05 * k[0, 0] / joints[0, :, 2].min()
    for at, low, high in (
        (columns, *np.sort(corners[0])[[0, -1]]),
        (rows, *np.sort(corners[1])[[0, -1]]),
    ):
        assert low - margin < at.min() and at.max() < high + margin


def test_what_cannot_be_measured_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="there are no recordings"):
        program.main([str(tmp_path)])
    with pytest.raises(ToftrackError, match="every"):
        program.main([str(SAMPLE), "--every", "0"])
    with np.load(SAMPLE) as content:
        arrays = {key: content[key] for key in ("depth_m", "K", "fps") if key in content}
    np.savez(tmp_path / "bare.npz", **arrays)
    with pytest.raises(ToftrackError, match=r"bare.npz has no true joints"):
        program.main([str(tmp_path / "bare.npz")])
