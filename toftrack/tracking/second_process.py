"""A second process that follows the second one of two hands while this one follows the first.

Most of a frame is many small operations, between which Python's lock is held, so that threads would
wait for each other. A hand's part of a frame is a function of what it is given (step.HandTask), so
it is sent there, and the answer is what this process would have computed.

What is sent between the two, through a socket with a key of their own, are pickles; nothing else
may send any. What the other process has already is named in them instead of sent: the hands that
were made for a shape, and those parts of a hand that came with the message before.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import pickle
import secrets
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Client, Connection, Listener
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from toftrack.compute.quality import Quality
from toftrack.compute.spans import Spans
from toftrack.compute.threads import at_most, small_operations, threads
from toftrack.tracking.model import FilterModel, FittedHand, TrackerModel
from toftrack.tracking.reporting import Concluded
from toftrack.tracking.state import HandState
from toftrack.tracking.step import HandTask, follow_hand
from toftrack.tracking.tracker import HandsTracker

_log = logging.getLogger(__name__)
_LONGEST_S = 10.0
"""So long is waited for an answer."""
_PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    "from toftrack.api import build_model\n"
    "from toftrack.tracking.second_process import main; main(build_model)"
)
"""Ctrl-C ends the first process, and with it this one."""
Build = Callable[[DictConfig], FilterModel]


class SecondProcess:
    """The process, as the first one has it. It begins when it is first needed, and ends with this
    object or with the first process.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        """config: of a tracker (conf/config.yaml), as JSON can say it."""
        self._config = config
        self._began: _Began | None = None
        self._failed = self._busy = False

    def begin(self, quality: Quality, task: HandTask) -> Callable[[], Concluded | None] | None:
        """Begin a hand's part of a frame there; what is returned waits for it, and says None where
        the process has ended meanwhile.

        Returns None itself where the process is not ready yet, or there is no core for it.
        """
        if self._failed or threads() < 2:
            return None
        if self._began is not None and self._began.of_process != os.getpid():
            return None  # this process was forked from the one that began it
        if self._busy:  # a frame that failed here has left its answer unread
            self.close()
        if self._began is None:
            self._start()
        began = self._began
        if began is None or began.connection is None:
            if began is not None and began.process.poll() is not None:
                self._give_up("it did not start")
            return None
        self._busy = True
        try:
            began.connection.send_bytes(_pickled((quality, task), began.common))
        except Exception as error:
            self._give_up(_words(error))
            return None
        began.common = _asked(task)
        return partial(self._answer, began.connection)

    def close(self) -> None:
        """End the process; it begins anew when it is needed again."""
        if self._began is not None:
            self._began.end()
        self._began, self._busy = None, False

    def _start(self) -> None:
        if not sys.executable or getattr(sys, "frozen", False):
            self._give_up("this program is not run by a Python that could be started again")
            return
        try:
            self._began = _Began(self._config)
        except OSError as error:
            self._give_up(_words(error))
            return
        weakref.finalize(self, self._began.end)

    def _answer(self, connection: Connection) -> Concluded | None:
        try:
            if not connection.poll(_LONGEST_S):
                self._give_up(f"no answer came within {_LONGEST_S:g} s")
                return None
            assert self._began is not None
            found: Concluded | str = _unpickled(connection.recv_bytes(), self._began.common)
        except Exception as error:
            self._give_up(_words(error))
            return None
        self._busy = False
        if isinstance(found, str):
            self._give_up(found)
            return None
        self._began.common = _parts(found[1])
        return found

    def _give_up(self, why: str) -> None:
        self.close()
        self._failed = True
        _log.warning("both hands are followed by one process, which is slower: %s", why)


class _Began:
    """A process that was begun.

    connection: to it, as soon as it is ready.  of_process: the number of the one that began it; a
    process that was forked from that one must not use it.  common: what both have of the last
    message.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self.connection: Connection | None = None
        self.of_process = os.getpid()
        self.common: Sequence[object] = ()
        key = secrets.token_bytes(32)
        self._listener = Listener(authkey=key)
        # It finds what this process finds, and does not look into the working directory first.
        path = os.pathsep.join(map(os.path.abspath, sys.path))
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": path},
            )
        except OSError:
            self._listener.close()
            raise
        try:
            assert self.process.stdin is not None
            line = json.dumps({"address": self._listener.address, "key": key.hex()})
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.close()
        except OSError:
            self.end()
            raise
        threading.Thread(target=self._meet, args=(config,), daemon=True).start()

    def _meet(self, config: dict[str, Any]) -> None:
        with contextlib.suppress(OSError, EOFError):
            connection: Connection = self._listener.accept()
            connection.send_bytes(json.dumps(config).encode())
            connection.recv_bytes()
            self.connection = connection

    def end(self) -> None:
        """End it; in a forked process nothing happens to it."""
        if os.getpid() != self.of_process:
            return
        if self.connection is not None:
            self.connection.close()
        self.process.kill()
        self.process.wait()
        self._listener.close()


class _Pickler(pickle.Pickler):
    """Tensors as arrays, which is twenty times as fast as torch's own way, and names for what both
    processes have.
    """

    def __init__(self, stream: io.BytesIO, common: Sequence[object]) -> None:
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        # None, and what else there is only one of, is named by itself.
        self._numbers = {id(one): number for number, one in enumerate(common) if one is not None}

    def reducer_override(self, value: Any) -> Any:
        number = self._numbers.get(id(value))
        if number is not None:
            return _common_one, (number,)
        if type(value) is Tensor:
            return torch.from_numpy, (value.numpy(),)
        if type(value) is torch.Generator:
            return _generator_of, (value.get_state(),)
        if type(value) is FittedHand:
            return _fitted_hand_of, (value.shape.side, value.applied)
        return NotImplemented


_here = threading.local()
"""What a message may name, while a thread reads it: `common` and `model`, see _unpickled."""


def _common_one(number: int) -> object:
    return _here.common[number]


def _fitted_hand_of(side: str, applied: tuple[float, ...]) -> FittedHand:
    model: TrackerModel = _here.model
    return model.made_hand(side, applied)


def _generator_of(state: Tensor) -> torch.Generator:
    generator = torch.Generator()
    generator.set_state(state)
    return generator


def _pickled(value: Any, common: Sequence[object] = ()) -> memoryview:
    stream = io.BytesIO()
    _Pickler(stream, common).dump(value)
    return stream.getbuffer()


def _unpickled(
    message: bytes, common: Sequence[object] = (), model: TrackerModel | None = None
) -> Any:
    """common: as the sender had it when this was sent.  model: of the hands that it names."""
    _here.common, _here.model = common, model
    try:
        return pickle.loads(message)
    finally:
        _here.common, _here.model = (), None


def _parts(hand: HandState) -> tuple[object, ...]:
    """What often stays as it is from one message to the next."""
    seen, tried = hand.seen, hand.tried
    whole = hand.track, hand.shape, hand.gesture, hand.last, hand.seeking, hand.handedness
    return *whole, seen.particle, tried.particle


def _asked(task: HandTask) -> tuple[object, ...]:
    """What both processes have after a task was sent."""
    return task.image.depth_m, *_parts(task.hand)


def main(build: Build) -> None:
    """What the second process does, until the first one closes the connection.

    build: makes a model of a configuration.
    """
    said = json.loads(sys.stdin.readline())
    with contextlib.suppress(OSError, EOFError):  # the first one has ended
        with Client(said["address"], authkey=bytes.fromhex(said["key"])) as connection:
            model = _prepared(build, json.loads(connection.recv_bytes()))
            connection.send_bytes(b"ready")
            common: tuple[object, ...] = ()
            while True:
                quality, task = _unpickled(connection.recv_bytes(), common, model)
                found = _followed(model, quality, task)
                connection.send_bytes(_pickled(found, _asked(task)))
                common = () if isinstance(found, str) else _parts(found[1])


@small_operations()
def _prepared(build: Build, config: dict[str, Any]) -> TrackerModel:
    """The model, with all that the first frame would have to wait for."""
    model = build(OmegaConf.create(config))
    assert isinstance(model, TrackerModel)
    HandsTracker(model).prepare()
    return model


@small_operations()
def _followed(model: TrackerModel, quality: Quality, task: HandTask) -> Concluded | str:
    try:
        with at_most(1):
            return follow_hand(task, model.at_quality(quality), Spans())
    except Exception as error:
        return _words(error)


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
