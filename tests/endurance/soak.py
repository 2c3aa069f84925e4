"""A long live run under observation: does anything grow?

    python tests/endurance/soak.py --minutes 20
    python tests/endurance/soak.py --stream websocket hands=2 device.emulated.source=/FILE.npz

The tracker follows an emulated SR3000 at the camera's pace, in a process of its own. Each 50th
request to the camera goes wrong, in all ways in turn; a visitor watches the page and comes anew
after every 100 pictures; a listener takes the datagrams, or the websocket's messages, where it
sends as well and comes anew after every 500 lines. The status is 1 if memory, threads or file
handles are more in the last quarter than in the first one, or if the run failed. Needs /proc, that
is Linux.
"""

import argparse
import json
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

_T = TypeVar("_T")
ROOT = Path(__file__).parents[2]
OVERRIDES = (
    "device=sr3000",
    "device.transport=emulated",
    "device.emulated.loop=true",
    "device.emulated.fault_every=50",
    "view=browser",
    "view.port=0",
)
STREAMS = ("udp", "websocket")
_PICTURES_A_VISIT = 100
_LINES_A_VISIT = 500
_STARTING_S = 180.0
"""Kernels may have to be compiled first."""
_WARM_FRAMES = 100
"""Caches and pools are filled by then; the observation begins."""
_SHUTDOWN_S = 120.0
_MOST_MEMORY = 0.05
"""Of the first quarter's memory, by which the allocator's moods may raise it."""
_MOST_COUNT = 1
"""Threads and handles that may be more: a visitor comes and goes."""


class Sample(NamedTuple):
    """The process at a moment; its resident memory."""

    memory_mb: float
    threads: int
    handles: int


class Observation(NamedTuple):
    """What was seen of a run from its hundredth frame on.

    lines: that arrived by datagrams, or by the websocket.
    status: with which the program ended, 143 as it should be; None: it did not end.
    """

    samples: list[Sample]
    lines: int
    pictures: int
    visits: int
    status: int | None


def grown(samples: Sequence[Sample]) -> list[str]:
    """What is larger in the last quarter of the time than in the first one, by the medians."""
    quarter = max(1, len(samples) // 4)
    first, last = (np.median(part, 0) for part in (samples[:quarter], samples[-quarter:]))
    limits = first * (1 + _MOST_MEMORY, 1, 1) + (0, _MOST_COUNT, _MOST_COUNT)
    return [name for name, more in zip(Sample._fields, last > limits, strict=True) if more]


def soak(minutes: float, folder: Path, stream: str, overrides: Sequence[str]) -> Observation:
    """Run the tracker in a folder, with overrides besides OVERRIDES, and observe it for so long.

    stream: one of STREAMS.
    """
    ended, words = threading.Event(), folder / "err.txt"
    arrivals: list[int] = []
    pictures: list[int] = []
    visits: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(0.5)
        port = listener.getsockname()[1] if stream == "udp" else 0
        asked = [*overrides, f"stream={stream}", f"stream.port={port}"]

        def converse(connection: ClientConnection) -> None:
            arrivals.append(json.loads(connection.recv(10.0))["index"])
            connection.send("thank you")

        def watch(connection: ClientConnection) -> None:
            """Ask for one picture after the other, as the page does."""
            connection.send('{"command": "picture"}')
            while isinstance(connection.recv(10.0), str):
                pass  # facts
            pictures.append(1)

        with _program(folder, asked) as program, ThreadPoolExecutor(2) as threads:
            try:
                if stream == "udp":
                    threads.submit(_listen, listener, arrivals, ended)
                else:
                    address = _until(lambda: _found(r"for programs: (ws://\S+)", words), program)
                    threads.submit(_visit, address, _LINES_A_VISIT, converse, [], ended)
                url = _until(lambda: _found(r"live view: http(://[^#]+)#", words), program)
                threads.submit(_visit, f"ws{url}live", _PICTURES_A_VISIT, watch, visits, ended)
                _until(lambda: len(arrivals) > _WARM_FRAMES, program)
                samples = _samples(program, 60 * minutes, arrivals)
                status = _ended(program)
            finally:
                ended.set()
    return Observation(samples, len(arrivals), len(pictures), len(visits), status)


def _ended(program: subprocess.Popen) -> int | None:
    """The status; of a program that does not end, err.txt tells then where it is.

    Not by Ctrl-C, which shells let programs in the background ignore.
    """
    program.terminate()
    try:
        return program.wait(_SHUTDOWN_S)
    except subprocess.TimeoutExpired:
        program.send_signal(signal.SIGABRT)
        program.wait()
        return None


@contextmanager
def _program(folder: Path, asked: Sequence[str]) -> Iterator[subprocess.Popen]:
    tracker = [sys.executable, "-X", "faulthandler", str(ROOT / "track.py")]
    command = [*tracker, *OVERRIDES, *asked]
    with open(folder / "err.txt", "wb") as words:
        program = subprocess.Popen(
            [*command, "hydra.run.dir=run"], cwd=folder, stdout=words, stderr=words
        )
        try:
            yield program
        finally:
            program.kill()
            program.wait()


def _until(reported: Callable[[], _T], program: subprocess.Popen) -> _T:
    deadline = time.monotonic() + _STARTING_S
    while not (value := reported()):
        if program.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError("the tracker did not start; see err.txt in its folder")
        time.sleep(0.1)
    return value


def _found(pattern: str, words: Path) -> str:
    found = re.search(pattern, words.read_text())
    return found[1] if found else ""


def _samples(program: subprocess.Popen, seconds: float, arrivals: list[int]) -> list[Sample]:
    samples, began = [], time.monotonic()
    every_s = min(10.0, seconds / 16)
    for number in range(int(seconds / every_s) + 1):
        time.sleep(max(0.0, began + number * every_s - time.monotonic()))
        if program.poll() is not None:
            raise RuntimeError(f"the tracker ended with status {program.returncode}")
        samples.append(sample := _sample(program.pid))
        print(f"{number * every_s:6.0f} s  {sample}  {len(arrivals)} frames", flush=True)
    return samples


def _sample(process: int) -> Sample:
    folder = Path(f"/proc/{process}")
    status = (folder / "status").read_text()
    kilobytes, threads = (
        int(re.search(rf"^{name}:\s+(\d+)", status, re.M)[1]) for name in ("VmRSS", "Threads")
    )
    return Sample(kilobytes / 1024, threads, len(list((folder / "fd").iterdir())))


def _listen(listener: socket.socket, arrivals: list[int], ended: threading.Event) -> None:
    while not ended.is_set():
        try:
            datagram = listener.recv(65536)
        except TimeoutError:
            continue
        arrivals.append(json.loads(datagram)["index"])


def _visit(
    address: str,
    times: int,
    exchange: Callable[[ClientConnection], None],
    visits: list[str],
    ended: threading.Event,
) -> None:
    """Exchange messages with a websocket, and come anew after so many times."""
    while not ended.is_set():
        visits.append(address)
        try:
            with connect(address) as connection:
                for _ in range(times):
                    exchange(connection)
                    if ended.is_set():
                        break
        except (OSError, TimeoutError, WebSocketException):
            ended.wait(0.2)  # the program ends, or is busy


def main() -> int:
    parser = argparse.ArgumentParser(description="Does anything grow in a long live run?")
    parser.add_argument("--minutes", type=float, default=20.0, help="how long; 20 if not given")
    parser.add_argument("--stream", choices=STREAMS, default=STREAMS[0], help="udp if not given")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="of the tracker")
    given = parser.parse_intermixed_args()
    with tempfile.TemporaryDirectory() as folder:
        observation = soak(given.minutes, Path(folder), given.stream, given.overrides)
        words = (Path(folder) / "err.txt").read_text()
    seen = f"{observation.pictures} pictures were seen in {observation.visits} visits"
    print(f"{observation.lines} lines came, {seen}")
    print(*re.findall(r"sr3000: frames: .*", words)[-1:])
    problems = [f"{name} grew" for name in grown(observation.samples)]
    if observation.status != 143:
        problems.append(f"the tracker ended with status {observation.status}\n{words[-5000:]}")
    print("; ".join(problems) or "nothing grew")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
