"""Runs that are killed at random moments: whatever was done until then can be recovered."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from toftrack.output.results import read_results
from toftrack.programs.recover import recover

pytestmark = pytest.mark.endurance

KILLS = 20
LATEST_S = 8.0
"""After the first frame."""
PATIENCE_S = 300


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_run_that_is_killed_is_recovered(seed: int, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "toftrack", "track", "device=sample", f"hydra.run.dir={run}"]
    lines = run / "track.jsonl"
    with open(tmp_path / "said", "wb") as said:
        process = subprocess.Popen(command, stdout=said, stderr=said)
    try:
        give_up_s = time.monotonic() + PATIENCE_S
        while not (lines.exists() and lines.stat().st_size):
            assert process.poll() is None, (tmp_path / "said").read_text()
            assert time.monotonic() < give_up_s
            time.sleep(0.05)
        time.sleep(random.Random(seed).uniform(0, LATEST_S))
    finally:
        process.kill()
        process.wait()
    whole = lines.read_bytes().count(b"\n")  # also where the run came to its end
    summary = recover(run)
    results = read_results(run / "track.npz")
    assert summary["frames"] == len(results["lost"]) == whole > 0
    assert json.loads((run / "summary.json").read_text())["frames"] == whole
    assert not list(run.glob("*.part"))
