"""Runs that are ended at random moments: whatever was done until then is there, or is recovered."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from toftrack.output.run_folder import read_run
from toftrack.programs.recover import recover
from toftrack.recordings.npz import read_recording
from toftrack.recordings.unfinished import recover_recording

pytestmark = pytest.mark.endurance

KILLS = 100
RACES = 25
LATEST_S = 4.0
"""After the first frame."""
PATIENCE_S = 300
SIGNALS = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}
"""And the statuses with which runs end."""
PORTS = "view.port=0", "stream.port=0"
SHOWN = (
    ("view=video", "stream=none"),
    ("view=video", "stream=udp"),
    ("view=browser", "view.port=0", "view.wait_s=0", "view.linger_s=0", "stream=udp"),
    ("view=browser", "view.wait_s=0", "view.linger_s=0", "stream=websocket", *PORTS),
)
TRACK = (sys.executable, "-m", "toftrack", "track", "device=sample")


@pytest.mark.parametrize("seed", range(KILLS))
def test_what_a_run_had_done_is_there_or_is_recovered(seed: int, tmp_path: Path) -> None:
    chance, hands = random.Random(seed), (1, 2, 4)[seed % 3]
    number = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT)[seed % 4]
    run, kept = tmp_path / "run", tmp_path / "kept.npz"
    name = f"device.name={'right_hand' if hands == 1 else 'two_hands'}"
    what = (f"hands={hands}", name, f"record={kept}", f"hydra.run.dir={run}")
    lines = run / "track.jsonl"
    with open(tmp_path / "said", "wb") as said:
        command = [*TRACK, *what, *chance.choice(SHOWN)]
        process = subprocess.Popen(command, stdout=said, stderr=said)
    try:
        give_up_s = time.monotonic() + PATIENCE_S
        while not (lines.exists() and lines.stat().st_size):
            assert process.poll() is None, (tmp_path / "said").read_text()
            assert time.monotonic() < give_up_s
            time.sleep(0.05)
        time.sleep(chance.uniform(0, LATEST_S))
        process.send_signal(number)
        status = process.wait(PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    # Killed where all is done, and only Python itself still ends.
    assert status in (0, SIGNALS[number], -number)
    assert "Traceback" not in (tmp_path / "said").read_text()
    whole = lines.read_bytes().count(b"\n")  # also where the run came to its end
    if number == signal.SIGKILL:
        recover(run)
        if kept.with_name("kept.npz.part").exists():
            recover_recording(kept)
    results = read_run(run)
    assert len(results.shapes) == hands
    assert (~results.arrays["dropped"]).sum() == whole > 0
    assert len(list(map(json.loads, lines.read_text().splitlines()))) == whole
    assert json.loads((run / "summary.json").read_text())["frames"] == len(results)
    if number != signal.SIGKILL or kept.exists():
        recorded = len(read_recording(kept))
        assert recorded == whole if number != signal.SIGKILL else recorded > 0
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("race", range(RACES))
def test_of_two_runs_that_begin_at_once_one_has_the_folder(race: int, tmp_path: Path) -> None:
    """The other one may fail for a reason of its own; it takes nothing away."""
    run = tmp_path / "new" / "run"
    base = [*TRACK, "device.stop=3", "view=none", f"hydra.run.dir={run}"]
    both = ["seed=1", "hand.shape=gone.json" if race % 2 else "seed=2"]
    two = [subprocess.Popen([*base, word], stderr=subprocess.PIPE, text=True) for word in both]
    said = [process.communicate(timeout=PATIENCE_S)[1] for process in two]
    for process, word, words in zip(two, both, said, strict=True):
        if process.returncode == 0:
            assert word in (run / ".hydra" / "overrides.yaml").read_text()
            assert len(read_run(run)) == 3 and (run / "track.log").exists()
        else:
            assert "another run is writing into" in words or "gone.json" in words
    assert race % 2 or 0 in [process.returncode for process in two]
