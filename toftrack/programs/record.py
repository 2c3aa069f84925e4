"""Record a camera: `toftrack record OUT.npz device=realsense`, until Ctrl-C.

Any device can be recorded to `.npz`, also one of your own; its settings are those of conf/device/,
changed as for `toftrack track`. An SR3000 can also be recorded to `.srs`, just as it sends its
images: `toftrack record OUT.srs device.transport=emulated`. If recording was killed or the disk was
full, `toftrack recover OUT.npz` makes the file from the frames that came until then.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import FrameType

from hydra.utils import instantiate
from omegaconf import DictConfig
from tqdm import tqdm

from toftrack.configuration import configuration_folder
from toftrack.configuration.compose import configuration, one_sentence, searched
from toftrack.devices.base import Device, frames_of
from toftrack.devices.sr3000.device import Sr3000
from toftrack.errors import ToftrackError
from toftrack.programs import shutdown
from toftrack.programs.command_line import plain_parser
from toftrack.programs.shutdown import EndedError
from toftrack.recordings.recorder import Recorder
from toftrack.recordings.sr_frame import REGISTERS
from toftrack.recordings.srs import SrsFacts, SrsInit, SrsWriter


def main(arguments: Sequence[str]) -> None:
    """Parse the command line and record. Raises ToftrackError, and EndedError at the end of an
    interrupted recording, whose frames are all in the file."""
    parser = plain_parser("toftrack record", __doc__)
    add, folder = parser.add_argument, configuration_folder()
    add("out", metavar="OUT", help="the new recording, .npz or .srs")
    about = "stop after this many (default: at Ctrl-C)"
    parser.add_number("--frames", 1, whole=True, help=about)
    parser.add_number("--seconds", 0, help="stop after this time")
    about = "stop at this size (default: 1, none with --frames or --seconds)"
    parser.add_number("--limit", 0, metavar="GB", help=about)
    add("--overwrite", action="store_true", help="replace an existing file")
    add("--conf", default=folder, help="folder of the configuration")
    add("--config-dir", help="folder of choices of your own")
    about = "device=KIND and its settings, device.KEY=VALUE"
    add("overrides", nargs="*", default=[], metavar="KEY=VALUE", help=about)
    # Intermixed: options may stand between the settings.
    options = parser.parse_intermixed_args(arguments)
    words = sorted([options.out, *options.overrides], key=lambda word: "=" in word)
    options.out, *options.overrides = words
    suffix = Path(options.out).suffix.lower()
    if suffix not in (".npz", ".srs"):
        raise ToftrackError(
            f"a camera is recorded to .npz, or an SR3000 to .srs, not to '{options.out}'; record "
            "to one of these, and convert it with toftrack convert"
        )
    config = _configuration(options, raw=suffix == ".srs")
    if options.limit is None:
        wanted = options.frames or options.seconds  # which a default must not cut short
        chosen = any("record_limit_gb=" in word for word in options.overrides)
        options.limit = math.inf if wanted and not chosen else config.record_limit_gb
    with one_sentence():
        device: Device = instantiate(config.device)
    if suffix == ".npz":
        recorder = Recorder(options.out, device, options.limit, options.overwrite)
        record_frames(device, recorder, options.frames, options.seconds)
        return
    assert isinstance(device, Sr3000)
    with device:
        _record_raw(device, options)


def record_frames(
    device: Device, recorder: Recorder, frames: int | None = None, seconds: float | None = None
) -> None:
    """Write the frames of any device, which is opened and closed here, and finish the file.

    It ends after so many frames or seconds, where they are given.

    Raises ToftrackError when the camera was given up, no frame came, or not all could be written,
    and KeyboardInterrupt when somebody ended it. What came until then is in the file.
    """
    try:
        with device, _progress(frames) as bar:
            began = time.monotonic()
            for count, frame in enumerate(frames_of(device), 1):
                with shutdown.not_now():
                    recorder.put(frame, wait=True)
                bar.update()
                late = seconds is not None and time.monotonic() - began >= seconds
                if recorder.ended is not None or count == frames or late:
                    break
    finally:
        with shutdown.not_now():
            recorder.close()
            if recorder.words():
                shutdown.say(recorder.words(), sys.stdout)
    if recorder.failed:
        raise ToftrackError(recorder.ended)
    if recorder.ended is not None:
        print(recorder.ended, file=sys.stderr)
    if not recorder.frames:
        raise ToftrackError("the device delivered no frame; nothing was recorded")


def _record_raw(device: Sr3000, options: argparse.Namespace) -> None:
    """Write every frame of an opened camera (keep=every) to a `.srs` file, until there are so many
    frames, seconds or gigabytes.

    Raises ToftrackError when the file cannot be written, or the camera was given up, and EndedError
    when a signal ended it; the frames that were received until then are in the file.
    """
    facts = device.description
    serial = str(facts.get("serial"))
    init = SrsInit(
        product_id=int(facts.get("usb_id", "0:74").partition(":")[2], 16),
        serial_number=int(serial) & 0xFFFFFFFF if serial.isdecimal() else 0,
    )
    registers = bytearray(REGISTERS)
    for address, value in device.register_writes():
        registers[address] = value
    came: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if came:  # impatience: the second one interrupts at once
            raise EndedError(number)
        came.append(number)
        device.request_stop()

    about = SrsFacts(device.exposure.range_m, device.camera, device.fps, device.metadata)
    with (
        closing(SrsWriter(options.out, init, bytes(registers), about, options.overwrite)) as writer,
        shutdown.handled(stop),
        _progress(options.frames) as bar,
    ):
        began = time.monotonic()
        for capture in device.captures():
            writer.append(capture.data, capture.timestamp_s)
            bar.update()
            if writer.frames == options.frames:
                break
            if writer.bytes >= 1e9 * options.limit:
                print(
                    f"the recording '{options.out}' ends after {writer.frames} frames: it reached "
                    f"its limit, {options.limit:g} GB",
                    file=sys.stderr,
                )
                break
            if options.seconds is not None and time.monotonic() - began >= options.seconds:
                device.request_stop()
    print(f"{options.out}: {writer.frames} frames ({device.counts})")
    if came:
        raise EndedError(came[0])


def _progress(frames: int | None) -> tqdm:
    return tqdm(total=frames, unit=" frames", file=sys.stderr, mininterval=0.5, disable=None)


def _configuration(options: argparse.Namespace, raw: bool) -> DictConfig:
    """As the command line says, with a device that gives all of its frames.

    raw: as the camera sends them, which only the SR3000 does.
    """
    overrides = list(options.overrides)
    if options.config_dir is not None:
        overrides.insert(0, searched(options.config_dir))
    chosen = next((word for word in overrides if word.startswith("device=")), None)
    if raw and chosen not in (None, "device=sr3000"):
        raise ToftrackError(f"only an SR3000 is recorded to .srs; record {chosen} to .npz")
    if raw and chosen is None:
        overrides.insert(0, "device=sr3000")
    elif chosen is None:
        kinds = sorted(path.stem for path in Path(options.conf, "device").glob("*.yaml"))
        raise ToftrackError(
            f"which camera is it? Give device={', '.join(kinds)}, or one of your own with "
            "--config-dir (docs/cameras.md)"
        )
    config = configuration(*overrides, config_dir=options.conf)
    if "keep" in config.device and not any(word.startswith("device.keep=") for word in overrides):
        config.device.keep = "every"
    return config
