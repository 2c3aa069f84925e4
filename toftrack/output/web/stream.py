"""`stream=websocket`: lines of JSON for web pages, and two pages to open, on one port.

| request | answer |
| --- | --- |
| `GET /` | a page that draws the hand in 3-D |
| `GET /point` | a page to point at targets and to pinch them |
| `GET /feed.js`, `GET /page.css` | what both pages read the stream with, and how they look |
| a websocket to `/stream` | a text message a frame, each as a line of track.jsonl |

What clients send is read and thrown away; who may listen, server.py says.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Self

from toftrack.errors import check_number
from toftrack.frames.estimate import Estimate
from toftrack.output.lines import json_line
from toftrack.output.stream import Stream, known_fields
from toftrack.output.web.server import ANY_PORT, Client, WebServer

STREAM = "/stream"
_PAGES = {"/": "hand.html", "/point": "point.html", "/feed.js": "feed.js", "/page.css": "page.css"}


class WebSocketStream(Stream):
    """A message a line to every client, and the pages, from a thread of its own within the `with`.

    A client that is too slow loses its oldest lines; where there is none nothing is made. The
    settings: conf/stream/websocket.yaml; `live` is for the devices alone, which follow it. Raises
    ToftrackError for an unknown field or an impossible number; by `with`, as WebServer.
    """

    def __init__(
        self,
        host: str,
        port: int,
        fields: Sequence[str] | None,
        waiting: int,
        origins: Sequence[str],
        live: bool,
    ) -> None:
        self._fields = known_fields(fields)
        check_number("stream.port", port, 0, 65535, whole=True, remedy=ANY_PORT)
        check_number("stream.waiting", waiting, 1, whole=True)
        self._host, self._port, self._waiting = str(host), port, waiting
        self._origins = (origins,) if isinstance(origins, str) else tuple(origins)

    def __enter__(self) -> Self:
        self._server = WebServer(
            *("stream", self._host, self._port, "toftrack.output.web", _PAGES, STREAM),
            lambda: _Listener(self, self._waiting),
            self._origins,
        )
        self.url = self._server.url
        """Of the first page, within the `with`."""
        print(
            f"the hand in 3-D: {self.url}, point and pinch: {self.url}point, for programs: "
            f"ws{self.url[4:-1]}{STREAM} (lines come from the first frame on; before it, a first "
            "run compiles for up to a minute)",
            file=sys.stderr,
            flush=True,
        )
        return self

    def send(self, estimates: Sequence[Estimate]) -> None:
        """Leave a line for every client; returns at once."""
        if self._server.clients:
            self._server.call(self._offer, json_line(estimates, self._fields))

    def __exit__(self, *exception: Any) -> None:
        left = self._server.close()  # until then its thread counts, too
        self.dropped += left
        self.report(f"to clients of {self.url}", "a client was too slow")

    def _offer(self, line: str) -> None:
        for client in self._server.clients:
            client.offer(line)


class _Listener(Client):
    def __init__(self, stream: WebSocketStream, waiting: int) -> None:
        super().__init__(waiting)
        self._stream = stream

    def offer(self, line: str) -> None:
        """Keep a line, in place of the oldest where there are too many."""
        if len(self) == self._most_waiting:
            self._messages.popleft()
            self._stream.dropped += 1
        self._messages.append(line)
        self.news.set()

    def take(self) -> str | bytes | None:
        self._stream.sent += bool(self)
        return super().take()
