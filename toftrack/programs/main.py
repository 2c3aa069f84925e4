"""The command `toftrack`: which program does what. Only the one that is asked for is loaded."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import toftrack
from toftrack.configuration import configuration_folder
from toftrack.programs.shutdown import say

_COMMANDS = {
    "track": "follow a hand",
    "train": "learn a space of poses",
    "record": "record a camera",
    "convert": "convert a recording",
    "calibrate": "calibrate a camera with a chequerboard",
    "evaluate": "measure against a public data set",
    "label": "label a recording by clicks, to measure on it",
    "gesture": "make gestures of your own",
    "figures": "draw pictures of a finished run",
    "report": "gather the jobs of a sweep",
    "benchmark": "measure speed and accuracy",
    "export": "write a run for Blender, or as a table",
    "recover": "finish a run or a recording that was killed",
}
"""Each is the function `main` of the module of its name, but for those that Hydra runs."""
_HELP = ("-h", "--help")
_VERSION = "--version"

_EXAMPLES = """
  toftrack track                              the recording that comes with toftrack
  toftrack track FILE hand.side=left          a recording of your own, of a left hand
  toftrack track device=realsense view=browser    a camera, live in the browser
"""

_OVERVIEW = f"""toftrack follows a human hand in the depth images of a camera or a recording.
{_EXAMPLES}
commands (toftrack COMMAND --help says more):
{{commands}}"""

_TRACK = f"""toftrack track follows a hand and writes joints, state and gesture of every frame.
{_EXAMPLES}
FILE is .npz, .srs, a folder of 16-bit PNG images, a ROS bag, an Azure Kinect's .mkv, or another
kind in docs/formats.md. The results go into outputs/DATE/TIME/, or where hydra.run.dir=DIR says;
Ctrl-C ends a run and keeps what was done.
"""

_TRAIN = """toftrack train learns the space of hand poses that the tracker searches.

  toftrack train                              from the poses of the paper
  toftrack train pose_space=lle pose_space.dims=5     of another kind and size
  toftrack train data=run data.path=RUN       from the poses of a run, outputs/DATE/TIME

The model goes into the folder that is named at the end, or where hydra.run.dir=DIR says; use it
with toftrack track pose_space=KIND pose_space.file=FILE.
"""

_SETTINGS = """All other words are settings: KEY=VALUE, or GROUP=CHOICE from

{groups}

  toftrack {name} --cfg job                    all settings, composed
  toftrack {name} -m KEY=A,B,C                 a sweep: one run after another
  toftrack {name} --hydra-help                 further options

The files in {folder} list all settings and say what each does."""

_LONG_HELP = {"track": _TRACK, "train": _TRAIN}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default this process's; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] == ["help"]:
        given = [*given[1:], "--help"]
    if not given or given[0] in _HELP:
        width = max(map(len, _COMMANDS))
        lines = [f"  {name:<{width}}  {about}" for name, about in _COMMANDS.items()]
        say(_OVERVIEW.format(commands="\n".join(lines)), sys.stdout)
        return 0
    if given[0] == "-sc" and (line := os.environ.get("COMP_LINE")):  # a shell completes this
        given = [*line.split()[1:2], *given]
        if line.count(" ") < 2:
            say(" ".join(_COMMANDS), sys.stdout)
        if line.count(" ") < 2 or given[0] not in _LONG_HELP:  # of others the shell offers files
            return 0
    name, rest = given[0], given[1:]
    if name == _VERSION or (name in _COMMANDS and _VERSION in rest):
        say(f"toftrack {toftrack.__version__}", sys.stdout)
        return 0
    if name not in _COMMANDS:
        print(f"error: {_unknown(name)}", file=sys.stderr)
        return 1
    if name in _LONG_HELP and any(word in _HELP for word in rest):
        say(long_help(name), sys.stdout)
        return 0
    gc.set_threshold(20_000)  # loading and compiling leave little to collect
    atexit.register(gc.freeze)  # nor need the process's end look through all that is loaded
    from toftrack.programs.command_line import run

    return run(lambda: _program(name)(rest))


def long_help(name: str) -> str:
    """What `toftrack track --help` prints."""
    folder = configuration_folder()
    names = {"data", "pose_space"}
    if name == "track":
        names = {path.parent.name for path in folder.glob("*/*.yaml")} - {"data"}
    groups = []
    for group in sorted(names):
        choices = sorted(path.stem for path in (folder / group).glob("*.yaml"))
        groups.append(f"  {group:<14}{', '.join(choices)}")
    settings = _SETTINGS.format(name=name, groups="\n".join(groups), folder=folder)
    return f"{_LONG_HELP[name]}\n{settings}"


def _program(name: str) -> Callable[[Sequence[str]], object]:
    hydras = name in _LONG_HELP
    module = importlib.import_module(f"toftrack.programs.{'applications' if hydras else name}")
    function: Callable[[Sequence[str]], object] = getattr(module, name if hydras else "main")
    return function


def _unknown(word: str) -> str:
    import difflib

    names = ", ".join(_COMMANDS)
    if "=" in word or Path(word).suffix or Path(word).exists():
        return f"there is no command '{word}'; did you mean toftrack track {word}?"
    if near := difflib.get_close_matches(word, [*_COMMANDS, *_HELP, _VERSION], n=1):
        return f"there is no command '{word}'; did you mean toftrack {near[0]}?"
    return f"there is no command '{word}'; give one of {names}"
