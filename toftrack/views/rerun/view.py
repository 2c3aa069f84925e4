"""`view=rerun`: all that the tracker sees and believes, into a file or a running viewer."""

from __future__ import annotations

import logging
import queue
import socket
import threading
from pathlib import Path
from urllib.parse import urlsplit

from toftrack.errors import ToftrackError, reported_errors
from toftrack.render.likelihood import FMeasure
from toftrack.safe_files import open_new
from toftrack.views.base import TrackedFrame, View
from toftrack.views.rerun.entities import Entities, blueprint, rr
from toftrack.views.video import writing

FILE_NAME = "track.rrd"

_log = logging.getLogger(__name__)
_QUEUED_FRAMES = 30
"""How many frames the tracker may be ahead of what is logged."""
_ANSWER_S = 5.0
"""How long a viewer may take to answer."""
_PORT = 9876
_ADDRESS = f"rerun+http://127.0.0.1:{_PORT}/proxy"
_RERUN_ERRORS = (OSError, RuntimeError, ValueError)


class RerunView(View):
    """Writes the file track.rrd, or shows in a viewer while tracking goes on.

    A thread of its own does the work, so that the tracker goes on at once. The file gets every
    frame; a viewer that does not keep up misses some, and never holds up the tracker. The settings:
    conf/view/rerun.yaml.

    Raises ToftrackError when the file cannot be written, there is no viewer, or for both connect
    and spawn.
    """

    def __init__(
        self,
        folder: str | Path,
        fps: float,
        frames: int | None = None,
        *,
        likelihood: FMeasure,
        connect: str | None = None,
        spawn: bool = False,
    ) -> None:
        if connect and spawn:
            raise ToftrackError("view.connect and view.spawn exclude each other; give one of them")
        self._path = None if connect or spawn else Path(folder) / FILE_NAME
        self._stream = rr.RecordingStream("toftrack")
        if self._path is None:
            if spawn:
                _start_viewer(self._stream)
            elif connect:
                _require_answer(connect)
            self._stream.connect_grpc(connect or _ADDRESS, default_blueprint=blueprint())
        else:
            with writing(self._path, *_RERUN_ERRORS):
                open_new(self._path, replace=True).close()  # the library follows links
                self._stream.save(self._path, default_blueprint=blueprint())
        self._entities = Entities(self._stream, likelihood)
        self._frames: queue.Queue[TrackedFrame | None] = queue.Queue(_QUEUED_FRAMES)
        self._left_out = 0
        self._failure: Exception | None = None
        # A daemon, because nothing frees a thread that waits for a viewer that is stuck.
        self._thread = threading.Thread(target=self._work, name="toftrack-rerun", daemon=True)
        self._thread.start()

    def show(self, tracked: TrackedFrame) -> None:
        """Hand one frame over; raises ToftrackError when one before it could not be logged."""
        self._raise_failure()
        if self._path is not None:
            self._frames.put(tracked)
            return
        try:
            self._frames.put_nowait(tracked)
        except queue.Full:
            self._left_out += 1

    def close(self) -> None:
        """Finish the file, or send the viewer what is left; ToftrackError when it cannot be done.

        A second call does nothing.
        """
        patience_s = None if self._path is not None else _ANSWER_S
        if self._thread.is_alive():
            try:
                self._frames.put(None, timeout=patience_s)
                self._thread.join(patience_s and 2 * patience_s)
            except queue.Full:
                pass  # the thread is stuck, as is seen below
        if self._left_out:
            _log.warning("view=rerun: the viewer was too slow for %d frames", self._left_out)
            self._left_out = 0
        if self._thread.is_alive():
            # What Rerun does when python ends would wait for the viewer, too.
            rr.unregister_shutdown()
            raise _viewer_gone("it takes nothing any more")
        self._raise_failure()

    def _work(self) -> None:
        """In the thread: log the frames that come, until None, then finish."""
        # After a failure, frames are still taken, so that nobody waits for room.
        for tracked in iter(self._frames.get, None):
            if self._failure is None:
                try:
                    self._entities.log(tracked)
                except Exception as error:
                    self._failure = error
        try:
            self._stream.flush(timeout_sec=_ANSWER_S)
            self._stream.disconnect()
        except Exception as error:
            self._failure = self._failure or error

    def _raise_failure(self) -> None:
        if self._failure is None:
            return
        if self._path is None and isinstance(self._failure, _RERUN_ERRORS):
            raise _viewer_gone(str(self._failure)) from self._failure
        with writing(self._path or Path(FILE_NAME), *_RERUN_ERRORS):
            raise self._failure


def _start_viewer(stream: rr.RecordingStream) -> None:
    """Start a viewer in a process of its own; ToftrackError when it does not answer."""
    try:
        stream.spawn(port=_PORT, connect=False)
        _require_answer(_ADDRESS)
    except (*_RERUN_ERRORS, ToftrackError) as error:
        raise ToftrackError(
            "view.spawn=true: no viewer could be started, is there a display? Leave it out, and "
            f"open {FILE_NAME} with `rerun` afterwards"
        ) from error


def _require_answer(address: str) -> None:
    """A connection is made in the background, and would be tried for ever."""
    advice = "start one with `rerun` and give the address that it names, or leave out view.connect"
    parts = urlsplit(address)
    try:
        host, port = parts.hostname, parts.port or _PORT
    except ValueError:  # of a port that is no number
        host, port = None, _PORT
    if not parts.scheme.startswith("rerun") or not host:
        raise ToftrackError(
            f"view.connect={address} is no address of a viewer, as {_ADDRESS}; {advice}"
        )
    with reported_errors(f"no viewer answers at {address}", advice):
        socket.create_connection((host, port), _ANSWER_S).close()


def _viewer_gone(reason: str) -> ToftrackError:
    return ToftrackError(
        f"the viewer is gone ({reason}): what it had not received is missing there, the result "
        "files are whole; start it again, or leave out view.connect and view.spawn"
    )
