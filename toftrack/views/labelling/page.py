"""The labelling page: shows frames, takes clicks, and has every one of them written at once.

The page opens a websocket to `/labels` and sends JSON, always with the token that stands behind the
`#` of the printed address, and with one of:

| message | answer |
| --- | --- |
| `"about": true` | `{"about": ...}`: recording, joints, gestures, side, frames with their labels |
| `"frame": number` | `{"frame": number, ...}`, how to show it, and its depth: uint16 millimetres |
| `"point": [number, joint, point]` | `{"saved": how many frames have a visible tip}` |
| `"gesture": [number, name]`, `"side": side` | likewise |

What is refused, or cannot be written, is answered with `{"failed": why}`.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any

from toftrack.errors import ToftrackError
from toftrack.evaluation.labelling import LABELLED, LabelFile, LabelFrame
from toftrack.output.web.server import Client, WebServer, request_of

_MOST_WAITING = 16
"""Messages to a page that does not read them."""


class LabelPage:
    """The page, served on this machine from construction until `close`.

    From now on only the server's thread changes `labels`. The frames are shown in their order; port
    0 is any free one. Raises ToftrackError: the port is taken or not allowed.
    """

    def __init__(
        self, labels: LabelFile, frames: Sequence[LabelFrame], gestures: Sequence[str], port: int
    ) -> None:
        self.labels, self.gestures = labels, gestures
        self.frames = {frame.number: frame for frame in frames}
        self.token = secrets.token_urlsafe(12)
        self._server = WebServer(
            *("", "127.0.0.1", port, "toftrack.views.labelling", {"/": "page.html"}, "/labels"),
            lambda: _Visitor(self),
        )
        self.address = f"{self._server.url}#{self.token}"

    def close(self) -> None:
        """End the page and its thread; a second call does nothing."""
        self._server.close()

    def about(self) -> dict[str, Any]:
        """What the page begins with."""
        content = self.labels.content
        return {
            "recording": content.get("recording", ""),
            "output": str(self.labels.path),
            "side": content["side"],
            "joints": LABELLED,
            "gestures": self.gestures,
            "frames": [self._labels_of(number) for number in self.frames],
        }

    def _labels_of(self, number: int) -> dict[str, Any]:
        frame = self.labels.frames[str(number)]
        points = {name: point for name, point in frame["points"].items() if name in LABELLED}
        return {"number": number, "points": points, "gesture": frame.get("gesture")}


def _picture(frame: LabelFrame) -> dict[str, Any]:
    """How a frame is shown; its depth follows."""
    height, width = frame.depth_mm.shape
    estimate = frame.estimate_px
    return {
        "frame": frame.number,
        "size": [width, height],
        "centre": frame.centre_px,
        "reach": frame.reach_px,
        "near": frame.near_mm,
        "far": frame.far_mm,
        "estimate": None if estimate is None else estimate.round(1).tolist(),
    }


class _Visitor(Client):
    def __init__(self, page: LabelPage) -> None:
        super().__init__(_MOST_WAITING)
        self._page = page

    def receive(self, message: str | bytes) -> None:
        content, allowed = request_of(message, self._page.token)
        try:
            if not allowed:
                raise ValueError("open the whole address that toftrack label printed")
            self._answer(content)
        except (ValueError, ToftrackError) as error:
            self.tell({"failed": str(error)})

    def _answer(self, content: dict[str, Any]) -> None:
        """Do what a message asks for; ValueError for what cannot be meant, ToftrackError where it
        cannot be written.
        """
        page, labels = self._page, self._page.labels
        match content:
            case {"about": _}:
                self.tell({"about": page.about()})
                return
            case {"frame": int(number)} if number in page.frames:
                frame = page.frames[number]
                self.tell(_picture(frame), frame.depth_mm.tobytes())
                return
            case {"frame": _}:
                raise ValueError("there is no such frame here")
            case {"side": side}:
                labels.set_side(side)
            case {"point": [number, joint, point]}:
                labels.set_point(number, joint, point)
            case {"gesture": [number, name]}:
                labels.set_gesture(number, name)
            case _:
                raise ValueError("the message is none that this server knows")
        self.tell({"saved": labels.labelled()})
