"""Label a recording by eye and measure the tracker on it: `toftrack label FILE`.

Opens a page that shows evenly spaced frames and asks for a click on each fingertip, each knuckle
and the wrist, and for gesture and side. Every click is saved at once. Ctrl-C ends; the same command
continues later. `toftrack benchmark accuracy FILE --labels labels.json` measures on the labels.

FILE is any recording, as for `toftrack track`. --least-sure tracks it first and shows the frames in
which the tracker is least sure: these tell where it errs, not how often.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import webbrowser
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig

from toftrack.configuration.compose import configuration, one_sentence
from toftrack.devices.base import Device
from toftrack.errors import ToftrackError
from toftrack.evaluation.labelling import LabelFile, chosen_frames, label_frames, track
from toftrack.evaluation.results import checked_targets
from toftrack.gestures.recognition import Gestures
from toftrack.output.web.server import ANY_PORT, wait
from toftrack.programs import shutdown
from toftrack.programs.applications import with_recording
from toftrack.programs.command_line import note, plain_parser, typed
from toftrack.views.labelling.page import LabelPage

_FRAMES = 20
_OF_CONVERT = {
    "device.intrinsics": "--intrinsics",
    "device.unit_m": "--source-unit",
    "device.fps": "--fps",
    "device.dataset": "--dataset",
    "device.topic": "--topic",
    "device.modulation_mhz": "--modulation",
    "camera.file": "--camera",
}
"""Overrides that say how a recording is to be understood, as options of `toftrack convert`."""


def main(arguments: Sequence[str]) -> None:
    """Parse the command line and serve the page until Ctrl-C. Raises ToftrackError."""
    parser = plain_parser("toftrack label", __doc__)
    add, number = parser.add_argument, parser.add_number
    about = "the recording, and KEY=VALUE settings for it, as for toftrack track"
    add("words", nargs="*", default=[], metavar="FILE", help=about)
    about = f"how many to label ({_FRAMES}, or those in the output)"
    number("--frames", 1, whole=True, help=about)
    add("--least-sure", action="store_true", help="show the frames where the tracker is least sure")
    add("--output", default="labels.json", help="the file to write (labels.json)")
    add("--side", choices=("right", "left"), help="which hand it is; the page asks, too")
    about = "port of the page (any free one)"
    number("--port", 0, 65535, whole=True, remedy=ANY_PORT, default=0, help=about)
    add("--no-browser", action="store_true", help="only print the address")
    options = parser.parse_intermixed_args(arguments)
    words = with_recording(options.words)
    side = [] if options.side is None else [f"hand.side={options.side}"]
    config = configuration(*side, *words)
    path = config.device.get("path")
    if path is None:
        raise ToftrackError("which recording is to be labelled? Give the name of its file")
    with one_sentence():
        device: Device = instantiate(config.device)
    with device, closing(_page(device, config, Path(path), options)) as page:
        print(f"label at: {page.address} (Ctrl-C ends)", file=sys.stderr, flush=True)
        if not options.no_browser:
            webbrowser.open(page.address)
        try:
            wait(threading.Event())
        except KeyboardInterrupt as end:  # which is how it ends
            if shutdown.exit_status(end) != 128 + signal.SIGINT:
                raise
        finally:
            page.close()  # and with it all changes of the labels
            shutdown.say(ending(page.labels, Path(path), words), sys.stdout)


def _page(device: Device, config: DictConfig, path: Path, options: argparse.Namespace) -> LabelPage:
    """The page, with the frames that were chosen."""
    camera, count = device.camera, device.frames
    if not count:
        raise ToftrackError("only a recording that ends can be labelled; leave out device.repeat")
    target = Path(options.output).expanduser()
    checked_targets(target)
    labels = LabelFile(target, path.name, (camera.width, camera.height), count, options.side)
    if device.truth is not None:
        note(f"'{path}' holds truth; the benchmark measures by that, not by labels")
    known = track(device, config) if options.least_sure else None
    given = labels.numbers()
    numbers = chosen_frames(
        len(known.confidence) if known else count,
        options.frames or (len(given) or _FRAMES),
        given,
        known.confidence if known else None,
    )
    frames = label_frames(device, config, numbers, known)
    labels.begin([frame.number for frame in frames])
    with one_sentence():
        gestures: Gestures | None = instantiate(config.gestures)
    return LabelPage(labels, frames, gestures.names if gestures else (), options.port)


def ending(labels: LabelFile, path: Path, words: Sequence[str]) -> str:
    """Where the labels are, and how to measure with them."""
    if not labels.path.exists():
        return "nothing was labelled"
    given = dict(word.split("=", 1) for word in words if "=" in word)
    options = [
        word
        for key, option in _OF_CONVERT.items()
        if key in given
        for word in (option, *given[key].strip("[]").replace(",", " ").split())
    ]
    lines = [f"{labels.path}: {labels.labelled()} of {len(labels.frames)} frames are labelled"]
    if not labels.labelled():
        return f"{lines[0]}; the same command continues"
    measured = path
    if options or path.suffix.lower() != ".npz":
        measured = Path(f"{path.stem or path.name}_to_measure.npz")
        command = ["toftrack", "convert", str(path), str(measured), *options]
        lines.append(f"make an .npz of it: {typed(command)}")
    command = ["toftrack", "benchmark", "accuracy", str(measured), "--labels", str(labels.path)]
    lines.append(f"measure the tracker: {typed(command)}")
    return "\n".join(lines)
