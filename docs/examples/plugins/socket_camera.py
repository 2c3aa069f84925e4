"""A device of one's own: depth images that another program, or another machine, sends by TCP.

    python docs/examples/plugins/socket_camera.py RECORDING     # the camera: serves a recording
    toftrack track --config-dir docs/examples/plugins device=socket

The camera sends a line of JSON, {"width", "height", "K", "unit_m", "fps"}, and then of each frame
the time, a float64 in seconds, and the depth, width x height uint16; both little endian. Whoever
can send is believed, so listen to machines that you trust.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from toftrack import BaseDevice, Camera, Frame, ToftrackError
from toftrack.devices.replay import Replay

_MOST_PIXELS = 4096 * 4096
_LONGEST_LINE = 10_000
_REMEDY = "start what sends the images, and check device.host and device.port"


class SocketCamera(BaseDevice):
    """The newest image whenever the tracker asks; those that came between are dropped.

    timeout_s: so long without an image, and the camera counts as gone.
    camera_file: a calibrated camera instead of the one that is sent.
    """

    def __init__(
        self, host: str, port: int, timeout_s: float, camera_file: str | None = None
    ) -> None:
        super().__init__(None, live=True)  # what is not known before `open`
        self._address, self._timeout_s = (host, port), timeout_s
        self._where, self._camera_file = f"{host} port {port}", camera_file
        self.description |= {"device": "socket", "where": self._where}

    def open(self) -> None:
        """Connect, when all else is ready: images that come before are lost."""
        try:
            self._socket = socket.create_connection(self._address, self._timeout_s)
        except OSError as error:
            raise ToftrackError(f"no camera at {self._where} ({error}); {_REMEDY}") from error
        self._images = self._socket.makefile("rb")
        try:
            about = json.loads(self._images.readline(_LONGEST_LINE))
            width, height = int(about["width"]), int(about["height"])
            self._unit_m, self.fps = float(about["unit_m"]), float(about["fps"])
            if not 0 < width * height <= _MOST_PIXELS or not (self._unit_m > 0 and self.fps > 0):
                raise ValueError("its numbers are not possible")
            self.camera = Camera(np.array(about["K"], float), width, height)
        except (ValueError, TypeError, KeyError, OSError) as error:
            self._socket.close()
            raise ToftrackError(
                f"what {self._where} sends begins with no line that describes it ({error!r});"
                f" {_REMEDY}"
            ) from error
        self._socket.settimeout(None)  # from here on it is the iteration that waits no longer
        if self._camera_file is not None:
            self.camera = Camera.load_for(self._camera_file, width, height, self._where)

    def close(self) -> None:
        """Hang up; the sender may end, or serve the next one."""
        self._socket.close()

    def __iter__(self) -> Iterator[Frame]:
        came, newest = threading.Condition(), list[tuple[int, bytes]]()
        ended = threading.Event()

        def receive() -> None:
            size = 8 + 2 * self.camera.width * self.camera.height
            count = 0
            try:
                while len(data := _exactly(self._images, size)) == size:
                    with came:
                        self.dropped += len(newest)
                        newest[:] = [(count, data)]
                        came.notify()
                    count += 1
            finally:
                with came:
                    ended.set()
                    came.notify()

        threading.Thread(target=receive, daemon=True).start()
        while True:
            with came:
                if not came.wait_for(lambda: newest or ended.is_set(), self._timeout_s):
                    raise ToftrackError(
                        f"{self._where} sent nothing for {self._timeout_s} s; {_REMEDY}"
                    )
                if not newest:
                    return
                index, data = newest.pop()
            yield self._frame(index, data)

    def _frame(self, index: int, data: bytes) -> Frame:
        shape = self.camera.height, self.camera.width
        steps = np.frombuffer(data, "<u2", offset=8).reshape(shape)
        depth_m = steps * np.float32(self._unit_m)
        return Frame(index, float(np.frombuffer(data, "<f8", 1)[0]), depth_m, None, radial=False)


def _exactly(images: BinaryIO, size: int) -> bytes:
    """So many bytes, or fewer where they end."""
    try:
        return images.read(size)
    except (OSError, ValueError):  # hung up, by either side
        return b""


def serve(recording: str, port: int = 5006, unit_m: float = 0.001) -> None:
    """Stand in for a camera: send a recording to whoever comes first, at its own pace."""
    with Replay(recording) as device:
        camera = device.camera
        about = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
        with socket.create_server(("127.0.0.1", port)) as server:
            connection, _ = server.accept()
        with connection:
            about |= {"unit_m": unit_m, "fps": device.fps}
            connection.sendall(json.dumps(about).encode() + b"\n")
            for frame in device:
                depth_m = camera.rectify(frame.depth, frame.radial)
                steps = np.rint(depth_m.clip(0, 65000 * unit_m) / unit_m).astype("<u2")
                connection.sendall(np.float64(frame.timestamp_s).tobytes() + steps.tobytes())
                time.sleep(1 / device.fps)


if __name__ == "__main__":
    serve(sys.argv[1])
