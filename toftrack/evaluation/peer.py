"""MediaPipe Hands beside the tracker: what it says of the same frames, and how long it takes.

Its requirements contradict ours, so it runs in an environment of its own and is spoken to over
pipes: see peer_mediapipe.py for its configuration, and docs/accuracy.md for how to make it.
"""

from __future__ import annotations

import atexit
import functools
import json
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames.camera import Camera

PEER = "mediapipe"
SCRIPT = Path(__file__).with_name("peer_mediapipe.py")
MAKE_ENVIRONMENT = (
    'make one with: python3 -m venv peer && peer/bin/pip install mediapipe==0.10.21 "numpy<2"'
)
_ANSWER = np.dtype(
    [("joints_m", "f8", (21, 3)), ("seconds", "f8"), ("sure", "f8"), ("right", "f8")]
)


class Peer:
    """The peer's process, to be closed; `begin` a recording, then `step` through its frames."""

    def __init__(self, python: str | Path) -> None:
        """Start it with its environment's Python. Raises ToftrackError: that lacks MediaPipe."""
        self.python = str(python)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  a pipe that nobody reads fills up
        # Isolated: the modules beside the script are not its own.
        command = [self.python, "-I", str(SCRIPT)]
        remedy = f"give the Python of an environment with {PEER}; {MAKE_ENVIRONMENT}"
        with reported_errors(f"--peer-python {python} cannot be run", remedy):
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to, self._from = self._process.stdin, self._process.stdout
        self.versions = self._greeting()

    def close(self) -> None:
        """End the process."""
        for pipe in (self._to, self._from):
            with suppress(OSError):  # it ended first
                pipe.close()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def begin(self, camera: Camera, side: str = "", hands: int = 2) -> None:
        """A new recording. side: whose hand is meant, "" for any.  hands: looked for at most."""
        size, k = (camera.height, camera.width), camera.K.ravel().tolist()
        facts = {"size": size, "k": k, "side": side, "hands": hands}
        self._send(json.dumps({"begin": facts}).encode() + b"\n")

    def step(self, depth_m: np.ndarray, amplitude: np.ndarray) -> SimpleNamespace:
        """What it says of a frame: (H, W) metres, 0 = no reading, and (H, W) uint16. The fields are
        those of an Estimate; joints_m and side_probability are NaN where it sees no hand. Raises
        ToftrackError when its process has ended."""
        self._send(b'{"frame": true}\n')
        self._send(np.ascontiguousarray(amplitude, np.uint16).tobytes())
        self._send(np.ascontiguousarray(depth_m, np.float32).tobytes())
        answer = self._from.read(_ANSWER.itemsize)
        if len(answer) != _ANSWER.itemsize:
            raise self._ended()
        row = np.frombuffer(answer, _ANSWER)[0]
        lost = not bool(np.isfinite(row["joints_m"]).all())
        side = "" if lost else ("right" if row["right"] else "left")
        return SimpleNamespace(
            joints_m=row["joints_m"].astype(np.float32),
            lost=lost,
            side=side,
            side_probability=float(row["sure"]),
            compute_s=float(row["seconds"]),
        )

    def _greeting(self) -> Mapping[str, Any]:
        line = self._from.readline()
        try:
            reported = json.loads(line)
        except ValueError:
            reported = {"error": self._last_words()}
        if "ready" in reported:
            versions: Mapping[str, Any] = reported["ready"]
            return versions
        self.close()
        raise ToftrackError(
            f"the environment of --peer-python {self.python} has no usable {PEER} "
            f"({reported.get('error')}); {MAKE_ENVIRONMENT}"
        )

    def _send(self, data: bytes) -> None:
        try:
            self._to.write(data)
            self._to.flush()
        except OSError:
            raise self._ended() from None

    def _ended(self) -> ToftrackError:
        return ToftrackError(f"{PEER} ended in the middle of a recording ({self._last_words()})")

    def _last_words(self) -> str:
        """The last line of what it wrote to standard error."""
        self._process.poll()
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


@functools.lru_cache(maxsize=1)
def peer_process(python: str) -> Peer:
    """This process's peer; started once, since that takes seconds."""
    peer = Peer(python)
    atexit.register(peer.close)
    return peer
