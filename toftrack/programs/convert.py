"""Convert a recording: `toftrack convert IN OUT`.

IN and OUT are each a `.srs` (the SR3000's stream), a `.npz` (toftrack's recording) or a folder of
16-bit PNG images with a camera file; the kind follows from the name. IN may also be a ROS bag
(`.bag`, `.mcap`, `.db3`, a folder), an Azure Kinect's `.mkv`, a lossless grey video of 16 bits
(FFV1), a `.zip` of images, or a stack: `.npy`, `.tif`, `.h5`, `.mat`. Bare images do not say their
lens: give `--intrinsics FX FY CX CY` (pixels) or `--camera FILE`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from tqdm import tqdm

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import whole_file
from toftrack.programs.command_line import note, plain_parser
from toftrack.recordings.bare import MILLIMETRE, NOTHING_GIVEN, Given
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.image_folder import write_image_folder
from toftrack.recordings.npz import write_recording
from toftrack.recordings.sr_frame import (
    DEFAULT_MODULATION_MHZ,
    REGISTERS,
    encode_frame,
    unambiguous_range_m,
)
from toftrack.recordings.srs import SrsFacts, SrsInit, SrsRecording, srs_frame, srs_head
from toftrack.recordings.store import open_recording


def main(arguments: Sequence[str]) -> None:
    """Parse the command line and convert. Raises ToftrackError."""
    parser = plain_parser("toftrack convert", __doc__)
    add = parser.add_argument
    add("source", metavar="IN", help="the recording to read")
    add("target", metavar="OUT", help=".srs, .npz, or a folder")
    add("--camera", help="camera file instead of the recording's own camera")
    about = "MHz of the SR3000: gives the range of a .srs, of IN (if it states none) or of OUT"
    add("--modulation", type=int, default=DEFAULT_MODULATION_MHZ, help=about)
    metres, about = " metres", "metres of one step of the PNG images to write"
    parser.add_number("--unit", 0, 0.99, remedy=metres, help=about)
    add("--overwrite", action="store_true", help="replace an existing file")
    add("--topic", help="topic of the depth images in a ROS bag that has several")
    names = ("FX", "FY", "CX", "CY")
    about = "pixels: a lens without distortion, instead of the recording's own"
    add("--intrinsics", type=float, nargs=4, metavar=names, help=about)
    add("--source-unit", type=float, help="metres of one step of IN's whole numbers (0.001)")
    add("--fps", type=float, help="frames per second of images without times (25)")
    add("--dataset", help="name of the depth stack in a .h5 or .mat that has several")
    options = parser.parse_args(arguments)
    given = Given(
        *(options.intrinsics, options.source_unit, options.fps, options.dataset),
        *(options.camera, options.topic, options.modulation),
    )
    count = convert(options.source, options.target, given, options.unit, options.overwrite)
    print(f"{options.target}: {count} frames")


def convert(
    source: str | Path,
    target: str | Path,
    given: Given = NOTHING_GIVEN,
    unit_m: float | None = None,
    overwrite: bool = False,
) -> int:
    """Convert a recording, frame by frame; returns the number of frames.

    Between `.srs` and a folder the distance words are kept exactly; into `.npz` they become float32
    metres, exactly enough to come back. From Z into `.srs` they are rounded to 1 / 65535 of the
    range, and into a folder to `unit_m`.

    Raises ToftrackError: the source cannot be read, the target not be written, or it exists.
    """
    target = Path(target).expanduser()
    kind = target.suffix.lower()
    if kind not in (".srs", ".npz", "") and not target.is_dir():
        raise ToftrackError(
            f"'{target}' is neither .srs nor .npz, nor a folder's name; give one of them"
        )
    if target.exists() and Path(source).expanduser().resolve() == target.resolve():
        raise ToftrackError(f"'{target}' cannot be converted into itself; choose another name")
    if kind in (".srs", ".npz") and os.path.lexists(target) and not overwrite:
        raise ToftrackError(
            f"the file '{target}' exists already; choose another name or give --overwrite"
        )
    with closing(open_recording(source, given)) as store:
        if store.truth is not None and kind != ".npz":
            note("the ground truth has no place in the new format and is left out")
        if damage := store.damage:
            note(f"{source}: {damage}; the frames before are converted")
        if store.left_out:
            note(f"{source}: {store.left_out}")
        with tqdm(total=len(store), unit=" frames", file=sys.stderr, disable=None) as bar:
            if kind == ".npz":
                write_recording(target, store, bar.update)
            elif kind == ".srs":
                _to_srs(store, target, unambiguous_range_m(given.modulation_mhz), bar)
            else:
                own_m = MILLIMETRE
                if isinstance(store, SrsRecording):  # the camera's own words, as they are
                    own_m = store.range_m / np.iinfo(np.uint16).max
                write_image_folder(target, store, unit_m or own_m, bar.update)
        return len(store)


def _to_srs(store: FrameStore, target: Path, range_m: float, bar: tqdm) -> None:
    init, registers = SrsInit(), bytes(REGISTERS)
    if isinstance(store, SrsRecording):
        init, registers, range_m = store.init, store.registers, store.range_m
    facts = SrsFacts(range_m, store.camera, store.fps, store.metadata)
    what = f"the recording '{target}' cannot be written"
    with reported_errors(what, "choose another place"), whole_file(target) as stream:
        stream.write(srs_head(init, registers, facts))
        for index, time_s in enumerate(store.timestamp_s):
            if isinstance(store, SrsRecording):
                data = store.raw(index)
            else:
                depth, amplitude = store.image(index)
                radial = store.camera.to_radial(depth, store.radial)
                data = encode_frame(radial, amplitude, range_m)
            stream.write(srs_frame(data, float(time_s)))
            bar.update()
