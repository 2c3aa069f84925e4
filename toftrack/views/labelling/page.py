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

    def change(self, content: dict[str, Any]) -> None:
        """Do what a message asks for; ValueError for what cannot be meant, ToftrackError where it
        cannot be written.
        """
        if "side" in content:
            self.labels.set_side(content["side"])
            return
        for name, count, change in (
            ("point", 3, self.labels.set_point),
            ("gesture", 2, self.labels.set_gesture),
        ):
            given = content.get(name)
            if isinstance(given, list) and len(given) == count:
                change(*given)
                return
        raise ValueError("the message is none that this server knows")


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
        page = self._page
        if "about" in content:
            self.tell({"about": page.about()})
        elif "frame" in content:
            number = content["frame"]
            frame = page.frames.get(number) if isinstance(number, int) else None
            if frame is None:
                raise ValueError("there is no such frame here")
            self.tell(_picture(frame), frame.depth_mm.tobytes())
        else:
            page.change(content)
            self.tell({"saved": page.labels.labelled()})
