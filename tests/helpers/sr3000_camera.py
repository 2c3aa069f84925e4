"""What the tests of the SR3000 share: a virtual camera, and a look at what it was left with."""

from __future__ import annotations

from typing import Any

from helpers.settings import (
    persistence_settings,
    sr3000,
    sr3000_emulator,
    usb_settings,
)

from toftrack.devices.sr3000.device import Sr3000
from toftrack.devices.sr3000.faults import EmulatorSettings
from toftrack.recordings.sr_frame import unambiguous_range_m

FAST = {"fps": 1000.0, "replug_s": 0.02, "late_s": 0.06}
STEP_M = unambiguous_range_m(20) / 0xFFFF


def camera(*faults: str, keep: str = "every", **changes: Any) -> Sr3000:
    """A virtual camera that is fast, and whose driver is impatient."""
    settings = {"faults": faults} | FAST
    settings |= {k: changes.pop(k) for k in list(changes) if k in EmulatorSettings.__annotations__}
    persistence = {"first_frame_s": 0.6, "give_up_s": 0.6, "backoff_s": 0.01} | changes.pop(
        "persistence", {}
    )
    usb_ = {"timeout_ms": 40, "drain_ms": 3, "tail_check_ms": 1} | changes.pop("usb", {})
    return sr3000(
        transport="emulated",
        keep=keep,
        emulated=sr3000_emulator(**settings),
        persistence=persistence_settings(**persistence),
        usb=usb_settings(**usb_),
        **changes,
    )


def read(device: Sr3000, count: int | None = None) -> list[Any]:
    """The frames of a virtual camera that is then closed, with a look at what was left behind."""
    frames = []
    with device:
        for frame in device:
            frames.append(frame)
            if len(frames) == count:
                break
    assert device.emulator.misuse == []
    assert device.emulator.open_handles == set()
    return frames
