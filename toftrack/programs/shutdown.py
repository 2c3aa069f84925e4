"""How a program ends when it is asked to: Ctrl-C, SIGTERM, or a terminal that is closed; on
Windows Ctrl-Break.

All of them raise EndedError in the main thread, as Ctrl-C raises KeyboardInterrupt. Only the first
one does: whoever is finishing files is left alone until somebody has asked once too often.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any, TextIO

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
SHUTDOWN_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""The signals that ask a program to end; Windows has no SIGHUP, and alone has SIGBREAK."""
_PATIENCE = 2
"""So many further requests are let pass while files are finished."""
_HINT = b"\nfinishing the files; asked %d times more, it ends at once\n"


class EndedError(KeyboardInterrupt):
    """Somebody asked the program to end.

    number: of the signal; the program's exit status is 128 more.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@dataclass
class _Requests:
    """What was asked since the program began."""

    count: int = 0
    first: int | None = None
    """Its signal."""
    waiting: int | None = None
    """A signal that takes effect when what must not be interrupted is done."""
    shields: int = 0


_requests = _Requests()


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Within it the signals go to a handler. A signal that is ignored, as by nohup, stays so."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in SHUTDOWN_SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


@contextmanager
def obeyed() -> Iterator[None]:
    """Within it the signals raise EndedError."""
    _requests.count, _requests.first, _requests.waiting = 0, None, None
    with handled(_request):
        yield


@contextmanager
def not_now() -> Iterator[None]:
    """What is within is not interrupted: a signal takes effect at its end."""
    _requests.shields += 1
    try:
        yield
    finally:
        _requests.shields -= 1
    if _requests.waiting is not None and not _requests.shields:
        number, _requests.waiting = _requests.waiting, None
        raise EndedError(number)


def exit_status(end: KeyboardInterrupt) -> int:
    """130 for Ctrl-C, 143 for SIGTERM, 129 for a terminal that was closed."""
    return 128 + (end.number if isinstance(end, EndedError) else signal.SIGINT)


def requested_status() -> int | None:
    """Likewise, where somebody has asked at all; None where nobody has."""
    return None if _requests.first is None else 128 + _requests.first


def say(text: str, stream: TextIO) -> bool:
    """Print a text, even where the terminal has been closed; whether somebody may read it."""
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError):
        forget_streams()
        return False
    return True


def forget_streams() -> None:
    """Standard output and error lead nowhere from now on where they cannot be written.

    Python would complain at its exit about what it could not write, with a status of its own.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None was closed from the start
        try:
            stream.flush()
        except (OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def _request(number: int, frame: FrameType | None) -> None:
    _requests.count += 1
    _requests.first = _requests.first or number
    at_once = _requests.count == 1 and not _requests.shields
    if at_once or _requests.count > 1 + _PATIENCE:
        raise EndedError(number)
    if _requests.count == 1:
        _requests.waiting = number
    elif number == signal.SIGINT:
        left = 2 + _PATIENCE - _requests.count
        with suppress(OSError):  # print is not for the middle of whatever goes on
            os.write(2, _HINT % left)
