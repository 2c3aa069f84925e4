"""Records the frames of any device into an `.npz`, beside whatever else is done with them."""

from __future__ import annotations

import json
import math
import os
import queue
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import check_replaceable
from toftrack.frames.camera import Camera
from toftrack.frames.frame import LEAP_S, Frame, could_be_metres, wrong_unit
from toftrack.recordings.unfinished import (
    IMAGE_TYPES,
    SUFFIX,
    Facts,
    UnfinishedRecording,
    compressed,
    finish,
)

_WAITING = 32
"""Frames at most that are not written yet, 1.8 MB each at 640 x 480."""
_WAITING_BYTES = 2**28
"""So much of them at most, or two: of 12 million pixels 32 would take 2.4 GB."""
_SPARE_BYTES = 2**27
"""So much of the disk is left to others: a recording must not end the run that it is of."""
_GIGABYTE = 1e9
_STRANGE = 10
"""So many frames at the beginning, none of which can be in metres, are in another unit."""


class Source(Protocol):
    """Whose frames are recorded: a device, of which this is read when the first frame came."""

    camera: Camera
    fps: float
    description: dict[str, Any]
    metadata: dict[str, Any]


class Recorder:
    """Writes frames in a thread of its own, until `close`.

    They grow in `FILE.npz.part`, of which `FILE.npz` is made when the recorder is closed or takes
    no more; after a kill `toftrack recover FILE.npz` makes it. A recorder that cannot go on says
    so, keeps what there is, and raises nothing.

    limit_gb: 1e9 bytes of the file, after which no more frames are taken.  overwrite: replace an
    existing file.  tell: called with `ended`, in the recorder's thread, as soon as that is so.
    Raises ToftrackError: the file exists, or cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        source: Source,
        limit_gb: float,
        overwrite: bool = False,
        tell: Callable[[str], object] = lambda sentence: None,
    ) -> None:
        self.path = Path(path).expanduser()
        self.frames = 0
        """Frames in the recording."""
        self.missed = 0
        """Frames that came faster than they could be written."""
        self.ended: str | None = None
        """Why it took no more frames, a sentence; None: it went on to the end."""
        self.failed = False
        """It ended because of an error; what there is, is as `ended` says."""
        self._part = self.path.with_name(self.path.name + SUFFIX)
        self._source, self._limit_gb, self._overwrite = source, limit_gb, overwrite
        self._tell = tell
        self._facts: Facts | None = None
        self._clock, self._strange, self._made = _Clock(), 0, False
        self._file = self._open()
        self._queue: queue.Queue[Frame | None] = queue.Queue(_WAITING)
        self._second = ThreadPoolExecutor(1, "toftrack-amplitude")
        self._thread = threading.Thread(target=self._run, name="toftrack-recorder", daemon=True)
        self._thread.start()

    def put(self, frame: Frame, wait: bool) -> None:
        """Record a frame.  wait: where too many wait to be written, wait, too, or leave it out."""
        if self.ended is not None:
            return
        # Copies: whose memory the images are in, may use it again.
        amplitude = None if frame.amplitude is None else np.array(frame.amplitude)
        kept = replace(frame, depth=np.array(frame.depth), amplitude=amplitude)
        size = kept.depth.nbytes + (0 if amplitude is None else amplitude.nbytes)
        self._queue.maxsize = max(2, min(_WAITING, _WAITING_BYTES // max(1, size)))
        try:
            self._queue.put(kept, block=wait)
        except queue.Full:
            self.missed += 1

    def close(self) -> None:
        """Write what waits, and finish the file."""
        self._queue.put(None)
        self._thread.join()
        self._second.shutdown()

    def words(self) -> str:
        """What became of it, once it is closed; "" where there is none."""
        missed = f", {self.missed} more came too fast" if self.missed else ""
        return f"{self.path}: {self.frames} frames{missed}" if self._made else ""

    def _open(self) -> UnfinishedRecording:
        if self.path.suffix.lower() != ".npz":
            raise ToftrackError(f"a recording of frames is an .npz, not '{self.path}'")
        if not self._overwrite:
            for path in (self.path, self._part):
                if os.path.lexists(path):
                    rest = f"`toftrack recover {path}` finishes it, or " * (path == self._part)
                    raise ToftrackError(
                        f"the file '{path}' exists already; {rest}choose another name, or "
                        "let toftrack record replace it with --overwrite"
                    )
        what = f"the recording '{self.path}' cannot be written"
        with reported_errors(what, "choose another place"):
            check_replaceable(self.path)  # before a long recording that could not end there
            return UnfinishedRecording(self._part, self._overwrite)

    def _run(self) -> None:
        while (frame := self._queue.get()) is not None:
            if self.ended is None:
                self._take(frame)
        if self.ended is None:
            self._end("", failed=False)

    def _take(self, frame: Frame) -> None:
        try:
            self._write(frame)
            free = shutil.disk_usage(self.path.parent).free - self._file.bytes  # of the `.npz`, too
        except Exception as error:  # of whatever kind, nobody is to wait for this thread
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            self._end(reason, failed=True)
        else:
            if self._file.bytes >= self._limit_gb * _GIGABYTE:
                self._end(f"it reached its limit, {self._limit_gb:g} GB", failed=False)
            elif free <= _SPARE_BYTES:
                self._end("the disk is nearly full", failed=False)

    def _write(self, frame: Frame) -> None:
        first, facts = self._facts is None, self._facts or self._facts_of(frame)
        camera = facts.camera
        if frame.depth.shape != (camera.height, camera.width) or frame.radial != facts.radial:
            raise ToftrackError(
                f"frame {frame.index} is another kind of image than those before, of "
                f"{'x'.join(map(str, frame.depth.shape[::-1]))} pixels"
            )
        second = None
        if facts.amplitude:  # black where a frame lacks it
            amplitude = np.zeros_like(frame.depth) if frame.amplitude is None else frame.amplitude
            if amplitude.shape != frame.depth.shape:
                raise ToftrackError(f"the amplitude of frame {frame.index} has another size")
            words = np.clip(amplitude, 0, 0xFFFF).astype(IMAGE_TYPES[1]).tobytes()
            try:
                second = words, self._second.submit(compressed, words).result
            except RuntimeError:  # the program has come to its end, with frames that still wait
                second = words, partial(compressed, words)
        depth = frame.depth.astype(IMAGE_TYPES[0], copy=False).tobytes()
        images = [depth, compressed(depth)]
        if second is not None:
            images += [second[0], second[1]()]
        if first:
            self._file.begin(facts)
            self._facts = facts
        self._check_unit(frame)
        self._file.append(frame.index, self._clock.at(frame.timestamp_s, facts.fps), images)
        self.frames = self._file.frames

    def _check_unit(self, frame: Frame) -> None:
        """After half a minute it would be too late: nobody reads a recording in another unit."""
        if frame.depth.dtype.kind in "iu":
            raise wrong_unit(f"the depth of frame {frame.index}", frame.depth)
        if self._strange >= _STRANGE:
            return
        fitting = could_be_metres(frame.depth)
        if fitting:
            self._strange = _STRANGE
        elif fitting is False:
            self._strange += 1
            if self._strange == _STRANGE:
                raise wrong_unit(f"the depth of the first {_STRANGE} frames", frame.depth)

    def _facts_of(self, frame: Frame) -> Facts:
        # As a device's facts may be given away: no serial number, no folders, nor their files, of
        # which there are as many as frames.
        device = {
            key: Path(value).name if isinstance(value, str | Path) else value
            for key, value in self._source.description.items()
            if "serial" not in key.lower() and key != "files"
        }
        about = {"toftrack": version("toftrack"), "device": device}
        metadata = {**self._source.metadata, "recorded": about}
        return Facts(
            self._source.camera,
            frame.radial,
            frame.amplitude is not None,
            self._source.fps,
            json.loads(json.dumps(metadata, default=str)),
        )

    def _end(self, why: str, failed: bool) -> None:
        """Finish the file; no more frames are taken."""
        self._file.close()
        try:
            if self.frames and not os.path.lexists(self._part):
                gone = f"'{self._part}' was removed or renamed while the recording grew"
                raise ToftrackError(f"the recording '{self.path}' was not made: {gone}")
            if self.frames:
                finish(self._part, self.path, self._overwrite)
                self._made = True
                reported = f"the recording '{self.path}' ends after {self.frames} frames: {why}"
            else:
                self._part.unlink(missing_ok=True)
                reported = f"the recording '{self.path}' was not made: {why}"
        except (OSError, ToftrackError) as error:
            failed, reported = True, str(error)
        self.failed = failed
        if why or failed:
            self.ended = reported
            self._tell(reported)


class _Clock:
    """Times that neither go back nor leap: where a camera counts anew, they go on a frame after the
    one before. Leaps one after the other are times in another unit, which stay as they are: who
    reads them is told which it is."""

    def __init__(self) -> None:
        self._offset_s, self._latest_s, self._leapt = 0.0, -math.inf, False

    def at(self, time_s: float, fps: float) -> float:
        """The time of the next frame."""
        shifted_s = time_s + self._offset_s
        begun = math.isfinite(self._latest_s)
        leapt_before, self._leapt = self._leapt, begun and shifted_s - self._latest_s >= LEAP_S
        wrong = shifted_s < self._latest_s or (self._leapt and not leapt_before)
        if wrong or not math.isfinite(shifted_s):
            before_s = self._latest_s if begun else 0.0
            shifted_s = before_s + 1 / fps
            if math.isfinite(time_s):
                self._offset_s = shifted_s - time_s
        self._latest_s = shifted_s
        return shifted_s
