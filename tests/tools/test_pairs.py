"""The pages of pairs; a drawn recording stands for a real one, too."""

import sys
from pathlib import Path

import cv2
import pytest
from helpers.tracking import ROOT

sys.path.insert(0, str(Path(__file__).parent))
import pairs


def test_pages_are_made_but_of_real_images_none_in_the_repository(tmp_path: Path) -> None:
    drawn = str(ROOT / "tests" / "data" / "guards" / "still_face.npz")
    given = [drawn, "--properties", str(tmp_path / "p.png"), "--real", drawn, "--out"]
    pairs.main([*given, str(tmp_path)])
    for name in ("p.png", "pairs_still_face.png"):
        assert min(cv2.imread(str(tmp_path / name)).shape[:2]) > 300
    with pytest.raises(SystemExit):
        pairs.main([*given, str(ROOT / "docs")])
