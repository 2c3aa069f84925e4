"""Ctrl-C while a program still loads, and streams that are closed or find no room: imported before
everything else, by programs alone.

Within the first second nothing is written yet, and an exception would end in whatever is being
imported: so the process ends at once, with status 130. `programs.shutdown` takes over when the
program has begun. What comes before the first line of toftrack is Python's own. Once the program
is done Ctrl-C does nothing any more: its status is known.
"""

import atexit
import errno
import io
import os
import signal
import sys
from types import FrameType
from typing import Any


class _Log(io.FileIO):
    """Standard error: what finds no room, as in a file on a full disk, is left out, and ends
    nothing that goes on for weeks; that nobody reads on is an error once.
    """

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno == errno.EPIPE:  # files that are finished then may say something, too
                os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            if error.errno not in (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", None)):
                raise
            return memoryview(data).nbytes


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


for stream in (sys.stdin, sys.stdout, sys.stderr):
    if stream is None:  # closed: else the next file that is opened takes its descriptor
        os.open(os.devnull, os.O_RDWR)
if (own := sys.__stderr__) is not None and sys.stderr is own:
    buffer: Any = own.buffer  # with python -u there is none
    if isinstance(getattr(buffer, "raw", buffer), io.FileIO):  # Windows's console has its own kind
        log = _Log(own.fileno(), "w", closefd=False)
        room = io.BufferedWriter(log) if hasattr(buffer, "raw") else log
        sys.stderr = io.TextIOWrapper(room, own.encoding, own.errors, line_buffering=True)
for stream in (sys.stdout, sys.stderr):
    # A file's name may have what an encoding lacks; what is no text in it passes through UTF-8.
    if isinstance(stream, io.TextIOWrapper) and (
        stream.errors == "strict" or stream.encoding.lower() not in ("utf-8", "utf8")
    ):
        stream.reconfigure(errors="backslashreplace")
if sys.stderr is None:  # what is said there is for nobody, and must not come out elsewhere
    sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # until the end

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # it may be ignored, as by nohup
    signal.signal(signal.SIGINT, _end)
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
