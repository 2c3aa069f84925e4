"""How long frames and starts take, with programs in turn, so that a machine's load affects all.

Every program has a process of its own and sees the packaged recording forwards and backwards, one
program after another, as often as --rounds says. With --peer-python, MediaPipe Hands is among them
twice: looking for two hands, as where its accuracy is compared, and looking for one. --two-hands
names recordings with truth in which two hands are tracked, and also one of them alone. --starts
runs the command line on three frames, each time without any compiled kernels, and then with them.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch

from toftrack.api import make_device, make_hands_tracker
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.evaluation.peer import Peer
from toftrack.evaluation.results import processor
from toftrack.evaluation.speed import enlarged

FIRST = "one hand, side given"
"""The program whose times the others' are compared with."""
SIZES = ((640, 480), (1280, 720))
"""Columns and rows of larger images."""
PEER_HANDS = {"MediaPipe, two hands": 2, "MediaPipe, one hand": 1}
_UNDERWAY = 10
"""Frames of a recording before its tracks are under way."""
_START = ("device=sample", "hand.side=right", "device.stop=3", "stream=stdout")


@dataclass(frozen=True)
class Program:
    """What is timed.  overrides: of the tracker.  recording: with truth; None = the packaged one.
    size: (columns, rows) that its images are enlarged to.  hands: that must be believed in a frame
    that counts.
    """

    name: str
    overrides: tuple[str, ...] = ()
    recording: str | None = None
    size: tuple[int, int] | None = None
    hands: int = 0


@dataclass
class Times:
    """Milliseconds of one program's frames, a list for each round."""

    name: str
    rounds: list[list[float]] = field(default_factory=list)

    @property
    def medians(self) -> list[float]:
        """Of each round."""
        return [float(np.median(times)) for times in self.rounds]

    @property
    def tails(self) -> list[float]:
        """The 90th percentile over the median, of each round."""
        return [float(np.percentile(times, 90) / np.median(times)) for times in self.rounds]

    def over(self, other: Times) -> list[float]:
        """Its medians over another's, round by round."""
        return [a / b for a, b in zip(self.medians, other.medians, strict=True)]


def programs(two_hands: Sequence[str] = ()) -> list[Program]:
    """All that is timed by default, and both hands of recordings beside one of them."""
    found = [
        Program(FIRST, ("hand.side=right",)),
        Program("side found out", ("hand.side=auto",)),
        Program("hands=2, one in view", ("hands=2",)),
        *(Program(f"{w}x{h}", ("hand.side=right",), size=(w, h)) for w, h in SIZES),
        Program("experiment=paper", ("experiment=paper",)),
    ]
    for path in two_hands:
        name = Path(path).stem
        with Replay(path) as device:
            if device.truth is None:
                raise ToftrackError(f"{path} has no truth; give a recording that has")
            side = device.truth.side
        found.append(Program(f"{name}, one hand", (f"hand.side={side}",), str(path), hands=1))
        found.append(Program(f"{name}, both", (f"hand.side={side}", "hands=2"), str(path), hands=2))
    return found


Runner = Callable[[], list[float]]
"""Times a program once; milliseconds of its frames. Raises ToftrackError."""


def _in_process(pool: ProcessPoolExecutor, program: Program) -> list[float]:
    """Times a program in a process of its own, that of the pool."""
    try:
        return pool.submit(_round, program).result()
    except BrokenProcessPool:
        raise ToftrackError(f"the process that timed {program.name!r} has ended") from None
    except ToftrackError as error:
        raise ToftrackError(f"{program.name}: {error}") from None


def _round(program: Program) -> list[float]:
    """What is asked of the process."""
    return runner(program)()


@functools.cache
def runner(program: Program) -> Runner:
    """Times a program in this process."""
    tracker = make_hands_tracker(*program.overrides, "device=sample")
    device = make_device("device=sample") if program.recording is None else None
    with device or Replay(str(program.recording)) as source:
        camera, images = source.camera, [(frame.depth, frame.radial) for frame in source]
    if program.size is not None:
        camera, images = enlarged(camera, images, program.size)
    order = list(range(len(images)))
    if program.recording is None:
        order += order[-2:0:-1]

    numbers = count()

    def once() -> list[float]:
        found = []
        if program.recording is not None:
            tracker.restart()
        for seen, index in enumerate(order):
            number = next(numbers)
            began = time.perf_counter()
            estimates = tracker.step(
                camera.rectify(*images[index]), camera.K, number, 0.04 * number
            )
            took = 1e3 * (time.perf_counter() - began)
            believed = sum(not estimate.lost for estimate in estimates)
            if program.recording is None or (seen >= _UNDERWAY and believed >= program.hands):
                found.append(took)
        if not found:
            raise ToftrackError(f"none of its frames has {program.hands} hands")
        return found

    return once


@contextmanager
def _peer(hands: int, python: str) -> Iterator[Runner]:
    """MediaPipe, which times itself, in its process."""
    with make_device("device=sample") as device:
        camera, frames = device.camera, list(device)
    images = [(camera.rectify(f.depth, f.radial), np.asarray(f.amplitude)) for f in frames]
    images += images[-2:0:-1]
    with closing(Peer(python)) as peer:
        peer.begin(camera, "right", hands)
        yield lambda: [1e3 * peer.step(*image).compute_s for image in images]


def timed(which: Sequence[Program], rounds: int, peer_python: str | None = None) -> list[Times]:
    """Milliseconds of frames, each program's in turn with the others'. Raises ToftrackError."""
    spawn = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        runners: list[tuple[Times, Runner]] = []
        for program in which:
            pool = stack.enter_context(ProcessPoolExecutor(1, spawn))
            runners.append((Times(program.name), functools.partial(_in_process, pool, program)))
        for name, hands in PEER_HANDS.items() if peer_python is not None else ():
            runners.append((Times(name), stack.enter_context(_peer(hands, str(peer_python)))))
        for _, once in runners:
            once()  # compiles, and sees everything once
        for _ in range(rounds):
            for times, once in runners:
                times.rounds.append(once())
    return [times for times, _ in runners]


def starts(times: int) -> list[dict[str, float]]:
    """Runs of the command line on three frames without compiled kernels, each followed by one with
    them (`kernels`), seconds: `first_s` until its first estimate, `wall_s` until its end, `user_s`
    and `system_s` of the processors. Raises ToftrackError."""
    found = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            found += [_start(folder) | {"kernels": kernels} for kernels in (False, True)]
    return found


def _start(folder: str) -> dict[str, float]:
    command = [sys.executable, "-m", "toftrack", "track", *_START, f"hydra.run.dir={folder}/run"]
    before = os.times()
    began = time.perf_counter()
    env = os.environ | {"NUMBA_CACHE_DIR": folder}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=env
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        first = time.perf_counter() - began
        process.stdout.read()
    wall = time.perf_counter() - began
    if process.returncode or not line:
        raise ToftrackError(f"{' '.join(command)} ended with status {process.returncode}")
    after = os.times()
    return {
        "first_s": first,
        "wall_s": wall,
        "user_s": after.children_user - before.children_user,
        "system_s": after.children_system - before.children_system,
    }


def show(found: Sequence[Times], begun: Sequence[Mapping[str, float]]) -> str:
    """As tables of text: the median of the rounds, and in brackets the least and the largest."""
    lines = []
    if found:
        named = {times.name: times for times in found}
        compared = {"side given": FIRST} | {name: name for name in PEER_HANDS}
        over = [(title, named[name]) for title, name in compared.items() if name in named]
        head = f"{'ms':<28}{'least':>7}{'median':>20}{'90th / median':>20}"
        lines.append(head + "".join(f"{'over ' + name:>28}" for name, _ in over))
        for times in found:
            line = f"{times.name:<28}{min(map(min, times.rounds)):>7.1f}"
            line += f"{_spread(times.medians, 1):>20}{_spread(times.tails, 2):>20}"
            line += "".join(f"{_spread(times.over(other), 2):>28}" for _, other in over)
            lines.append(line)
        for both in (times for times in found if times.name.endswith(", both")):
            one = named[both.name.removesuffix("both") + "one hand"]
            tails = zip(both.tails, both.medians, one.medians, strict=True)
            slow = [tail * median / alone for tail, median, alone in tails]
            lines.append(
                f"{both.name} over one hand: median {_spread(both.over(one), 2)}, its 90th"
                f" percentile over that median {_spread(slow, 2)}"
            )
    for kernels in (False, True):
        some = [start for start in begun if start["kernels"] == kernels]
        if some:
            names = ("first_s", "wall_s", "user_s", "system_s")
            first, wall, user, system = (_spread([one[n] for one in some], 1) for n in names)
            lines.append(
                f"three frames {'with' if kernels else 'without'} kernels, s: first estimate"
                f" {first}, end {wall}, processors {user} and of the system {system}"
            )
    return "\n".join(lines)


def _spread(values: Sequence[float], digits: int) -> str:
    """The median (least, largest)."""
    middle = float(np.median(values))
    return f"{middle:.{digits}f} ({min(values):.{digits}f}, {max(values):.{digits}f})"


def measure(
    rounds: int,
    begins: int,
    cores: int | None,
    two_hands: Sequence[str],
    peer_python: str | None,
) -> dict[str, Any]:
    """Time everything and print it, the machine first; returns what --json writes.

    rounds: of all programs.  begins: of the command line.  cores: as many as all may use; None: all
    that there are.  two_hands: recordings with truth.  peer_python: MediaPipe's; None: without it.
    Raises ToftrackError: a recording or an environment cannot be used.
    """
    if cores is not None:
        _use(cores)
    about = {
        "processor": processor(),
        "cores": cores or os.cpu_count(),
        "torch": torch.__version__,
    }
    print(f"{about['processor']}, {about['cores']} cores, torch {about['torch']}", flush=True)
    begun = starts(begins)
    found = timed(programs(two_hands), rounds, peer_python) if rounds else []
    print(show(found, begun))
    return {"machine": about, "frames": [asdict(times) for times in found], "starts": begun}


def _use(cores: int) -> None:
    """Let this process and those it starts use only so many cores."""
    if not hasattr(os, "sched_setaffinity"):
        raise ToftrackError("--cores cannot be set on this system; leave it out")
    allowed = sorted(os.sched_getaffinity(0))
    if cores > len(allowed):
        raise ToftrackError(f"--cores {cores}: only {len(allowed)} can be used here")
    os.sched_setaffinity(0, allowed[:cores])
