"""What a wheel and a source archive hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from helpers.tracking import ROOT


def test_no_recording_of_the_tests_is_distributed(tmp_path: Path) -> None:
    """The list that setuptools makes both archives from."""
    pytest.importorskip("setuptools", minversion="77")
    command = [sys.executable, "setup.py", "-q", "egg_info", "-e", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    listed = next(tmp_path.glob("*.egg-info")) / "SOURCES.txt"
    files = listed.read_text(encoding="utf-8").splitlines()
    assert "toftrack/data/sample.npz" in files and "conf/config.yaml" in files
    assert "toftrack/benchmark/peer_mediapipe.py" in files
    assert not [name for name in files if name.startswith(("tests/", "docs/"))]
