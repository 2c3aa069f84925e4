"""The SR3000 from the command line: `python track.py device=sr3000`, with a virtual camera."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import programs
from helpers.programs import QUICK, interrupted_when
from helpers.settings import (
    sr3000,
    sr3000_emulator,
    usb_settings,
)

EMULATED = ("device=sr3000", "device.transport=emulated", "view=none")


def track(folder: Path, *overrides: str) -> tuple[int, str, str]:
    return programs.call(*overrides, "hydra.run.dir=out", folder=folder)


def test_tracks_through_faults_and_an_unplugged_cable(tmp_path: Path) -> None:
    faults = "device.emulated.faults=[unplug_during@6,short@9,zeros@12,timeout@14]"
    usual = ("device.keep=every", "device.stop=24", "device.usb.timeout_ms=99")
    status, out, err = track(tmp_path, *EMULATED, faults, *usual, *QUICK)
    assert status == 0, err
    with np.load(tmp_path / "out" / "track.npz") as result:
        assert len(result["joints_m"]) == 24
        assert result["lost"][12]  # the frame without a reading
        assert not result["lost"][-3:].any()
    assert "22 delivered" in out + err


def test_ctrl_c_keeps_what_was_done(tmp_path: Path) -> None:
    lines = tmp_path / "out" / "track.jsonl"
    with interrupted_when(lambda: lines.exists() and lines.stat().st_size):
        status, _, err = track(tmp_path, *EMULATED, "device.emulated.loop=true", *QUICK)
    assert status == 130
    assert "interrupted" in err and "Traceback" not in err
    assert (tmp_path / "out" / "track.npz").exists()


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
