"""Record what an SR3000 sends: `toftrack record OUT.srs`, until Ctrl-C.

The camera's settings are those of conf/device/sr3000.yaml, changed as for `track.py`:
`toftrack record OUT.srs device.transport=emulated`.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from toftrack.configuration.compose import configuration_folder
from toftrack.devices.sr3000.device import Sr3000
from toftrack.errors import ToftrackError
from toftrack.programs.endings import ENDINGS, EndedError
from toftrack.recordings.sr_frame import REGISTERS
from toftrack.recordings.srs import SrsWriter
from toftrack.recordings.srs_facts import SrsFacts, SrsInit

_ONLY = (
    "only the SR3000 is recorded, which needs no device=; other recordings are converted with "
    "python -m toftrack.convert"
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and record. Raises ToftrackError, and EndedError at the end of an
    interrupted recording, whose frames are all in the file."""
    parser = argparse.ArgumentParser(prog="toftrack record", description=__doc__)
    parser.add_argument("out", metavar="OUT.srs", help="the new recording")
    parser.add_argument("--frames", type=int, help="stop after so many (default: at Ctrl-C)")
    parser.add_argument("--seconds", type=float, help="stop after so long")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument(
        "--conf", default=configuration_folder(), help="folder of the configuration"
    )
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="device.KEY=VALUE", help="settings"
    )
    # Intermixed: options may stand between the settings.
    options = parser.parse_intermixed_args(arguments)
    if Path(options.out).suffix.lower() != ".srs":
        raise ToftrackError(
            f"a camera is recorded to .srs, not to '{options.out}'; convert that afterwards with "
            "python -m toftrack.convert"
        )
    for name in ("frames", "seconds"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise ToftrackError(f"--{name} must be above 0, not {value}")
    device: Sr3000 = hydra.utils.instantiate(_compose(options.conf, options.overrides).device)
    with device:
        interrupted = record(
            device, options.out, options.frames, options.seconds, options.overwrite
        )
    if interrupted is not None:
        raise EndedError(interrupted)


def record(
    device: Sr3000,
    path: str | Path,
    frames: int | None = None,
    seconds: float | None = None,
    overwrite: bool = False,
) -> int | None:
    """Write every frame of an opened camera to a `.srs` file.

    SIGINT, SIGTERM and SIGHUP end the recording after the frames that were received until then.

    Args:
        device: of keep=every, or what comes too fast is dropped.
        path: the file.
        frames: stop after so many; None = go on.
        seconds: stop after so long; None = go on.
        overwrite: replace an existing file.

    Returns:
        The number of the signal that ended it; None: none did.

    Raises:
        ToftrackError: the file cannot be written, or the camera was given up; the frames until then
            are in the file.
    """
    facts = device.description
    init = SrsInit(
        product_id=int(facts.get("usb_id", "0:74").partition(":")[2], 16),
        serial_number=_digits(facts.get("serial")),
    )
    registers = bytearray(REGISTERS)
    for address, value in device.register_writes():
        registers[address] = value
    about = SrsFacts(device.exposure.range_m, device.camera, device.fps, device.metadata)
    with (
        SrsWriter(path, init, bytes(registers), about, overwrite) as writer,
        _Signals(device) as signals,
        tqdm(total=frames, unit=" frames", file=sys.stderr, mininterval=0.5) as bar,
    ):
        began = time.monotonic()
        for capture in device.captures():
            writer.append(capture.data, capture.timestamp_s)
            bar.update()
            if frames is not None and writer.frames >= frames:
                break
            if seconds is not None and time.monotonic() - began >= seconds:
                device.request_stop()
    print(f"{path}: {writer.frames} frames ({device.counts})")
    return signals.came


class _Signals:
    """While entered, signals ask the camera to stop; `came` tells which one did."""

    def __init__(self, device: Sr3000) -> None:
        self.came: int | None = None
        self._device = device
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _Signals:
        if threading.current_thread() is threading.main_thread():
            for number in ENDINGS:
                if signal.getsignal(number) != signal.SIG_IGN:  # as by nohup
                    self._before[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.came is not None:  # impatience: the second one interrupts at once
            raise EndedError(number)
        self.came = number
        self._device.request_stop()


def _compose(conf: str | Path, overrides: Sequence[str]) -> DictConfig:
    folder = Path(conf).expanduser().resolve()
    if not (folder / "config.yaml").is_file():
        raise ToftrackError(
            f"there is no configuration in '{folder}'; give toftrack's conf folder with --conf"
        )
    if any(override.startswith("device=") for override in overrides):
        raise ToftrackError(_ONLY)
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        return hydra.compose("config", ["device=sr3000", "device.keep=every", *overrides])


def _digits(serial: str | None) -> int:
    return int(serial) & 0xFFFFFFFF if serial is not None and str(serial).isdecimal() else 0
