"""Your own gestures: `toftrack gesture add NAME RECORDING --from 2.0 --to 3.0`.

`add` tracks that part of a recording, takes the pose that the hand holds there, and writes it into
a file of gestures, which `gestures.file=FILE` gives to the tracker. `list` names those that are
known and those in the file; `remove` takes a gesture out of it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from hydra.utils import instantiate
from tqdm import tqdm

from toftrack.api import build_tracker
from toftrack.configuration.compose import configuration, one_sentence
from toftrack.errors import ToftrackError
from toftrack.gestures.definitions import OTHER, SETS
from toftrack.gestures.files import NamedPose, learned_pose, read_poses, save_poses
from toftrack.gestures.recognition import FLEXION_RAD, Gestures, gestures_with
from toftrack.programs.command_line import plain_parser
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.store import open_source

_FILE = "gestures.json"
_LEAD_S = 1.0
"""So long before the part that is asked for the tracking begins, to have found the hand by then."""


def main(arguments: Sequence[str]) -> None:
    """Parse the command line and do what it says. Raises ToftrackError."""
    usage = "%(prog)s add NAME RECORDING --from S --to S [OVERRIDE ...] | list | remove NAME"
    parser = plain_parser("toftrack gesture", __doc__, usage)
    option = parser.add_argument
    option("command", choices=("add", "list", "remove"))
    about = "its name; the recording that shows it (or sample); settings, as hand.side=left"
    option("words", nargs="*", default=[], metavar="NAME RECORDING OVERRIDE", help=about)
    option("--from", dest="begin", type=float, metavar="S", help="where it begins, s")
    option("--to", dest="end", type=float, metavar="S", help="where it ends, s")
    option("--file", default=_FILE, help=f"the file of gestures ({_FILE})")
    option("--replace", action="store_true", help="replace a gesture of that name")
    options = parser.parse_intermixed_args(arguments)
    path = Path(options.file).expanduser()
    if path.suffix.lower() != ".json":
        raise ToftrackError(f"--file {path} is no .json, the only kind that can be written")
    poses = read_poses(path) if path.exists() else []
    words = options.words
    if options.command == "list" and not words:
        _list(path, poses)
    elif options.command == "remove" and len(words) == 1:
        _remove(path, poses, words[0])
    elif options.command == "add" and len(words) >= 2:
        _add(path, poses, options)
    else:
        raise ToftrackError(
            f"'{' '.join((options.command, *words))}' has too few or too many words; give"
            " add NAME RECORDING --from 2.0 --to 3.0, list, or remove NAME"
        )


def _add(path: Path, poses: Sequence[NamedPose], options: argparse.Namespace) -> None:
    """Learn a gesture from a part of a recording and write it into the file, beside the poses that
    are in it.

    Raises ToftrackError when the recording cannot be read, the name is taken, the hand was not
    followed or moved in that part, or the gesture looks like another.
    """
    if options.begin is None or options.end is None:
        raise ToftrackError("say which part of the recording shows it: --from 2.0 --to 3.0")
    name, recording, *overrides = options.words
    with one_sentence():
        config = configuration(*overrides)
        gestures: Gestures | None = instantiate(config.gestures)
    if gestures is None:
        raise ToftrackError("gestures=none knows no gesture; leave it out")
    known: str = config.gestures.known
    names = [*(pose.name for pose in poses), *(d.name for d in SETS[known])]
    _check_name(name, names, options.replace)
    with_it = [pose for pose in poses if pose.name != name]
    with closing(open_source(recording)) as frames:
        angles, believed = _track(frames, recording, options.begin, options.end, overrides)
    pose = learned_pose(name, angles, believed, FLEXION_RAD)
    with_it.append(pose)
    gestures_with(known, with_it, gestures.settings, str(path))
    save_poses(path, with_it)
    print(f"{path}: {name}, from {int(believed.sum())} of {len(believed)} frames")
    print(f"use it: toftrack track gestures.file={path}")


def _track(
    frames: FrameStore, recording: str, begin_s: float, end_s: float, overrides: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles, (T, 21) rad, and which frames are believed, (T,), of a part of a recording, in
    seconds from its first frame.
    """
    times = np.asarray(frames.timestamp_s) - frames.timestamp_s[0]
    rows = np.flatnonzero((times >= begin_s) & (times <= end_s))
    if not 0 <= begin_s < end_s <= times[-1] + 1 / frames.fps or not len(rows):
        raise ToftrackError(
            f"--from {begin_s:g} --to {end_s:g} is no part of '{recording}', which lasts"
            f" {times[-1]:.2f} s; give seconds from its beginning, with --to after --from"
        )
    with one_sentence():
        tracker = build_tracker(configuration("gestures=none", *overrides))
    first = int(np.searchsorted(times, begin_s - _LEAD_S))
    angles, believed = [], []
    for row in tqdm(range(first, rows[-1] + 1), unit=" frames", file=sys.stderr, disable=None):
        depth_m = frames.camera.rectify(frames.image(row)[0], frames.radial)
        estimate = tracker.step(depth_m, frames.camera.K, row, float(times[row]))
        if row >= rows[0]:
            angles.append(estimate.state[6:])
            believed.append(not estimate.lost)
    return np.array(angles), np.array(believed)


def _check_name(name: str, taken: Sequence[str], replace: bool) -> None:
    if not name.strip() or name != name.strip() or not name.isprintable():
        raise ToftrackError(f"{name!r} is no name for a gesture; give a word, as 'peace'")
    if name == OTHER:
        raise ToftrackError(f"'{OTHER}' means none of the gestures; give another name")
    if name in taken and not replace:
        raise ToftrackError(
            f"there is a gesture '{name}' already; give another name, or --replace to replace it"
        )


def _list(path: Path, poses: Sequence[NamedPose]) -> None:
    """A name a line, those that are known without the file first."""
    names = [pose.name for pose in poses]
    known = (definition.name for definition in SETS[configuration().gestures.known])
    for name in dict.fromkeys(known):
        if name not in (OTHER, *names):  # one of yours takes its place
            print(name)
    for name in dict.fromkeys(names):
        count = names.count(name)
        print(f"{name} ({'' if count == 1 else f'{count} poses, '}yours, {path})")
    if not names:
        print(f"no gesture of yours in {path}", file=sys.stderr)


def _remove(path: Path, poses: Sequence[NamedPose], name: str) -> None:
    left = [pose for pose in poses if pose.name != name]
    if len(left) == len(poses):
        known = ", ".join(dict.fromkeys(pose.name for pose in poses)) or "none"
        raise ToftrackError(f"there is no gesture '{name}' in {path}; there is: {known}")
    if left:
        save_poses(path, left)
    else:  # a file that names no pose is none of gestures
        path.unlink()
    print(f"{path}: {name} removed")
