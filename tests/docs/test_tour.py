"""The notebook runs as it stands, and keeps its outputs."""

import base64
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import programs
from helpers.tracking import ROOT

sys.path.insert(0, str(ROOT / "docs"))
from run_notebook import run_notebook

TOUR = ROOT / "docs" / "tour.ipynb"


def test_the_tour_runs_and_shows_a_hand_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With fewer frames, and its command in this process."""

    def here(command: list[str], **_: object) -> None:
        assert command[1:4] == ["-m", "toftrack", "track"]
        assert programs.call(*command[4:], folder=tmp_path)[0] == 0

    monkeypatch.setattr("subprocess.run", here)
    text = TOUR.read_text(encoding="utf-8")
    assert text.count("device.stop=30") == text.count('"image/jpeg": ') == 2
    assert len(text) < 400_000, "it is read on a web page"
    few = tmp_path / "tour.ipynb"
    few.write_text(text.replace("device.stop=30", "device.stop=6"), encoding="utf-8")
    done = run_notebook(few, tmp_path)
    outputs = [out for cell in done["cells"] for out in cell.get("outputs", ())]
    pictures = [out["data"]["image/jpeg"] for out in outputs if "data" in out]
    assert len(pictures) == 2
    for content in pictures:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)
        assert np.ptp(picture, axis=-1).max() > 100, "grey images have coloured skeletons"
    printed = "".join(line for out in outputs for line in out.get("text", ()))
    assert "6 frames, 0 of them lost" in printed and "joints (6, 21, 3)" in printed
