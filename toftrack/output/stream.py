"""Estimates for other programs: as each frame is done, a line of JSON as in track.jsonl.

Sending never waits for who reads: the tracker keeps its pace, and what a reader is too slow for is
dropped, counted, and reported at the end.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Self

from toftrack.errors import ToftrackError, check_choice, check_number, reported_errors
from toftrack.frames.estimate import Estimate
from toftrack.output.lines import LINE_FIELDS, json_line

_log = logging.getLogger(__name__)

_STDOUT, _STDERR = 1, 2
_DATAGRAM = 2**16
"""Bytes of the longest one."""
_GRACE_S, _PAUSE_S = 1.0, 0.01
"""How long the lines that still wait at the end have to leave; between attempts."""


class ReaderGoneError(Exception):
    """Whoever read the stream has closed it: there is nobody left to track for."""


class Stream:
    """Where estimates are sent, within a `with`; stream=none is this one, which sends nothing."""

    sent = dropped = 0
    """Estimates, over all who read."""

    def send(self, estimates: Sequence[Estimate]) -> None:
        """Send a frame's, one a slot, without ever waiting for who reads it; ReaderGoneError when
        nobody does.
        """

    def report(self, where: str, reason: str) -> None:
        """Log how many estimates were sent at the end of a stream, and why some were not."""
        why = f" ({reason})" if self.dropped else ""
        _log.info("stream: %d estimates sent %s, %d dropped%s", self.sent, where, self.dropped, why)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None: ...


class StdoutStream(Stream):
    """Lines to standard output, which is theirs alone within the `with`.

    Whatever else this process prints, its libraries included, goes to standard error meanwhile.

    A reader that falls behind fills the operating system's pipe first (64 KiB on Linux, about 7
    lines). Then `waiting` lines wait for the next call of `send`, and when there are more, the
    oldest of them is dropped, so that the reader gets the newest. If it still does not read at the
    end, its last line may be cut short. The settings: conf/stream/stdout.yaml.

    Raises ToftrackError for an unknown field or number; by `with`, when standard output is closed.
    """

    def __init__(self, fields: Sequence[str] | None, waiting: int) -> None:
        self._fields = known_fields(fields)
        check_number("stream.waiting", waiting, 1, whole=True)
        if not hasattr(select, "PIPE_BUF"):
            raise ToftrackError(
                "stream=stdout needs pipes that say whether they are full, which this operating "
                "system lacks; use stream=udp"
            )
        self._lines: deque[bytes] = deque(maxlen=waiting)
        self._rest = b""

    def __enter__(self) -> Self:
        with reported_errors(
            "standard output cannot be used", "with stream=stdout, give it a pipe or a file"
        ):
            if sys.stdout is None:
                raise OSError(errno.EBADF, "it is closed")
            sys.stdout.flush()
            self._descriptor = self._stdout = os.dup(_STDOUT)
        if os.isatty(_STDOUT):  # whose room nothing tells
            with suppress(OSError):  # it has no name here
                flags = os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK
                self._descriptor = os.open(os.ttyname(_STDOUT), flags)
        os.dup2(_STDERR, _STDOUT)
        return self

    def send(self, estimates: Sequence[Estimate]) -> None:
        """Write the lines that wait and this one, as far as the reader has room for them.

        Raises ReaderGoneError when the reader has closed the pipe or the disk is full.
        """
        self.dropped += len(self._lines) == self._lines.maxlen
        self._lines.append((json_line(estimates, self._fields) + "\n").encode())
        try:
            self._write(until=0.0)
        except OSError as error:
            self._lines.clear()
            self._rest = b""
            raise ReaderGoneError(
                f"standard output takes no more lines ({error.strerror})"
            ) from None

    def __exit__(self, *exception: Any) -> None:
        with suppress(OSError):  # nobody reads the last lines
            self._write(until=time.monotonic() + _GRACE_S)
        sys.stdout.flush()
        os.dup2(self._stdout, _STDOUT)
        for descriptor in {self._stdout, self._descriptor}:
            os.close(descriptor)
        self.dropped += len(self._lines) + bool(self._rest)
        self.report("to standard output", "the reader was too slow")

    def _write(self, until: float) -> None:
        """Write what waits; give up when there is no room for more, at that time at the latest."""
        while self._rest or self._lines:
            if not self._rest:
                self._rest = self._lines.popleft()
            patience = max(0.0, until - time.monotonic())
            _, writable, _ = select.select((), (self._descriptor,), (), patience)
            if not writable:
                return
            # So much is sure to fit in; the pipe's own non-blocking mode would be that of all the
            # programs that share it.
            try:
                count = os.write(self._descriptor, self._rest[: select.PIPE_BUF])
            except BlockingIOError:  # of a terminal
                if not patience:
                    return
                count = 0
                time.sleep(_PAUSE_S)
            self._rest = self._rest[count:]
            self.sent += not self._rest


class UdpStream(Stream):
    """A datagram a line to one address, whether anybody listens there or not.

    The settings: conf/stream/udp.yaml. Raises ToftrackError for an unknown field, a host that
    cannot be found, or an impossible port.
    """

    def __init__(self, host: str, port: int, fields: Sequence[str] | None) -> None:
        self._fields = known_fields(fields)
        check_number("stream.port", port, 1, 65535, whole=True)
        what = f"stream.host={host} cannot be found"
        advice = "give the name or address of the machine that listens"
        with reported_errors(what, advice, OSError, UnicodeError):
            found = socket.getaddrinfo(str(host), port, type=socket.SOCK_DGRAM)
        # Most receivers listen at IPv4 only, while localhost is often ::1 first.
        best = min(found, key=lambda one: one[0] != socket.AF_INET)
        self._kind, self._address = best[:3], best[4]
        self._reason = ""

    def __enter__(self) -> Self:
        self._socket = socket.socket(*self._kind)
        self._socket.setblocking(False)
        room = socket.SOL_SOCKET, socket.SO_SNDBUF
        if self._socket.getsockopt(*room) < _DATAGRAM:  # as of macOS, which sends no longer ones
            self._socket.setsockopt(*room, _DATAGRAM)
        return self

    def send(self, estimates: Sequence[Estimate]) -> None:
        """Send a datagram; one that the system does not take at once is dropped."""
        try:
            self._socket.sendto(self.datagram(estimates), self._address)
        except OSError as error:  # its buffer is full, or there is no network just now
            self.dropped += 1
            if error.errno == errno.EMSGSIZE and not self._reason:
                _log.warning("a frame is too long for a datagram; give fewer stream.fields")
            self._reason = error.strerror or str(error)
        else:
            self.sent += 1

    def datagram(self, estimates: Sequence[Estimate]) -> bytes:
        """What is sent."""
        return (json_line(estimates, self._fields) + "\n").encode()

    def __exit__(self, *exception: Any) -> None:
        self._socket.close()
        self.report("to {} port {}".format(*self._address), self._reason)


def known_fields(fields: Sequence[str] | None) -> tuple[str, ...]:
    """The fields that a setting names, of lines.LINE_FIELDS; ToftrackError for an unknown one."""
    if fields is None:
        return LINE_FIELDS
    one = isinstance(fields, str) or not isinstance(fields, Sequence)
    names: tuple[Any, ...] = (fields,) if one else tuple(fields)
    if not names:
        some = ", ".join(LINE_FIELDS)
        raise ToftrackError(f"stream.fields is empty; give some of {some}, or null for all")
    for name in names:
        check_choice("stream.fields", name, LINE_FIELDS, ", or null for all")
    return names
