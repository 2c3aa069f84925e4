"""The SR3000 from the command line: `python track.py device=sr3000`, with a virtual camera."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.settings import (
    sr3000,
    sr3000_emulator,
    usb_settings,
)

ROOT = Path(__file__).parents[2]
EMULATED = ("device=sr3000", "device.transport=emulated", "view=none")


def track(folder: Path, *overrides: str, **changes: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "track.py", *overrides, f"hydra.run.dir={folder}"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, **changes)


def test_without_a_camera_the_user_is_told_at_once(tmp_path: Path) -> None:
    done = track(tmp_path, "device=sr3000", "device.usb.ids=[dead:0001,dead:0002]")
    assert done.returncode == 1
    assert done.stderr.startswith("error: no SR3000")
    assert done.stderr.count("\n") == 1
    for words in ("dead:0001, dead:0002", "libmesasr", "emulated"):
        assert words in done.stderr


def test_tracks_through_faults_and_an_unplugged_cable(tmp_path: Path) -> None:
    faults = "device.emulated.faults=[unplug_during@6,short@9,zeros@12,timeout@14]"
    done = track(
        tmp_path,
        *EMULATED,
        "device.keep=every",
        faults,
        "device.stop=24",
        "device.usb.timeout_ms=99",
    )
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "track.npz") as result:
        assert len(result["joints_m"]) == 24
        assert result["lost"][12]  # the frame without a reading
        assert not result["lost"][-3:].any()
    assert "22 delivered" in done.stdout + done.stderr


def test_ctrl_c_keeps_what_was_done(tmp_path: Path) -> None:
    command = [sys.executable, "track.py", *EMULATED, "device.emulated.loop=true"]
    process = subprocess.Popen(
        [*command, f"hydra.run.dir={tmp_path}"], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    lines, deadline = tmp_path / "track.jsonl", time.monotonic() + 200
    while not (lines.exists() and lines.stat().st_size) and time.monotonic() < deadline:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert (tmp_path / "track.npz").exists()


def memory_mb() -> float:
    """What the process has in memory; the kernel counts in pages."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.parametrize("keep", ["newest", "every"])
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
def test_soak(keep: str) -> None:
    """10 000 frames at 50 frames/s with a fault every 50: nothing is lost, nothing grows."""
    device = sr3000(
        transport="emulated",
        keep=keep,
        stop=10_000,
        usb=usb_settings(timeout_ms=200),
        emulated=sr3000_emulator(fps=50.0, loop=True, fault_every=50, replug_s=0.1),
    )
    last, begin, most = -1, None, 0.0
    with device:
        for count, frame in enumerate(device):
            assert frame.index > last
            last = frame.index
            if count == 500:
                begin = memory_mb()
            if count > 500 and count % 500 == 0:
                most = max(most, memory_mb())
            if count % 97 == 0:
                time.sleep(0.1)
    counts = device.counts
    assert counts.delivered + counts.dropped == counts.received == device.emulator.served
    assert counts.delivered > 9000
    assert most - begin < 10
    assert device.emulator.open_handles == set()
    assert device.emulator.misuse == []
    assert threading.active_count() == 1
