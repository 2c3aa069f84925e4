"""Videos that play in browsers, and that are good up to the last second however a run ends.

H.264 in an MP4 of fragments: each second is written as a whole, with what is needed to play it, so
that there is nothing to be finished at the end. The wheels of OpenCV have no H.264; Chromium does
not play their MPEG-4, and their VP8 takes 38 ms a frame where this takes 3.
"""

from __future__ import annotations

import io
import math
import os
from contextlib import AbstractContextManager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.safe_files import open_in_place, open_new

_OPTIONS = {"preset": "ultrafast", "tune": "zerolatency", "crf": "23"}
"""3 ms and 10 kB for 1056 x 468 pixels; no frame is held back."""
_FRAGMENTS = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}


class VideoFile:
    """A video, .mp4, that grows frame by frame.

    fps: from 1 to 120, 25 where it is not finite.  size: width and height, px, both even.

    Raises ToftrackError, as do all methods, where the file cannot be written.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        import av  # takes a while

        self._path, self._new_frame = path, av.VideoFrame.from_ndarray
        # Two decimals, so that the clock's steps are whole numbers of modest size.
        rate = min(max(round(float(fps), 2), 1.0), 120.0) if math.isfinite(fps) else 25.0
        with writing(path):
            self._disk = open_new(path, replace=True)
        try:
            with writing(path, OSError, ValueError):
                self._file: Any = av.open(self._disk, "w", format="mp4", options=_FRAGMENTS)
                self._stream: Any = self._file.add_stream(
                    "libx264", rate=Fraction(rate).limit_denominator(100), options=_OPTIONS
                )
        except ToftrackError:
            self._disk.close()
            raise
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.gop_size = max(1, round(rate))
        # The tracker's kernels need the other cores, and one is fast enough.
        self._stream.codec_context.thread_count = 1

    def add(self, picture: np.ndarray) -> None:
        """Append a (height, width, 3) uint8 BGR picture."""
        self._write(self._new_frame(np.ascontiguousarray(picture), format="bgr24"))

    def close(self) -> None:
        """Write the last second."""
        try:
            self._write(None)
        finally:
            try:
                with writing(self._path):
                    self._file.close()
                    self._disk.flush()
            finally:
                # Not every failure to write is told by the library.
                with suppress(OSError):
                    _cut(self._disk)
                with suppress(OSError):  # what could not be written waits still
                    self._disk.close()

    def _write(self, frame: Any) -> None:
        with writing(self._path):
            self._file.mux(self._stream.encode(frame))
            self._disk.flush()


def cut_to_whole(path: Path) -> None:
    """Take from a video's end the second that was not written as a whole, where there is one.

    Players stop there with an error. Without any whole second the file goes. What is no video of
    ours stays as it is. Raises OSError.
    """
    with open_in_place(path, make=False) as file:
        _cut(file)
        empty = not os.fstat(file.fileno()).st_size
    if empty:
        path.unlink()


def _cut(file: BinaryIO | io.FileIO) -> None:
    size, position = os.fstat(file.fileno()).st_size, 0
    kinds: list[bytes] = []
    whole = 0
    file.seek(0)
    while len(header := file.read(8)) == 8:  # an MP4 is a row of boxes: length, then kind
        length, kind = int.from_bytes(header[:4], "big"), header[4:]
        if length < 8 or position + length > size:
            break
        position += length
        kinds.append(kind)
        # A moof describes the box of pictures that follows; without any there is nothing to play.
        if kind != b"moof" and b"mdat" in kinds:
            whole = position
        file.seek(position)
    # Others begin otherwise, and have boxes whose length stands elsewhere.
    if kinds[:2] == [b"ftyp", b"moov"] and whole < size:
        file.truncate(whole)


def writing(path: Path, *kinds: type[Exception]) -> AbstractContextManager[None]:
    """Errors of these kinds, by default the system's, become a sentence on a file of a view."""
    remedy = "check the folder and the free space, or choose view=none"
    return reported_errors(f"'{path}' cannot be written", remedy, *kinds)
