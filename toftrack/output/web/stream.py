"""`stream=websocket`: lines of JSON for web pages, and two pages to open, on one port.

| request | answer |
| --- | --- |
| `GET /` | a page that draws the hand in 3-D |
| `GET /point` | a page to point at targets and to pinch them |
| `GET /feed.js` | what both pages read the stream with |
| a websocket to `/stream` | a text message a frame, each as a line of track.jsonl |

The server answers only those who call it by an address or as localhost, and opens websockets to
its own pages, to pages of the origins that the configuration names, and to programs that are no
browsers; so no other web site can listen. What clients send is read and thrown away. Connections
that have not asked for anything yet are few and have seconds to ask: when there are too many, the
oldest has to go.
"""

from __future__ import annotations

import asyncio
import logging
import math
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from importlib import resources
from types import SimpleNamespace
from typing import Any, Self

from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate
from toftrack.output.lines import json_line
from toftrack.output.stream import known_fields, report_dropped
from toftrack.output.web.visitors import called_by_a_known_name, refused

_log = logging.getLogger(__name__)

STREAM = "/stream"
_PAGES = {
    "/": ("hand.html", "text/html; charset=utf-8"),
    "/point": ("point.html", "text/html; charset=utf-8"),
    "/feed.js": ("feed.js", "text/javascript; charset=utf-8"),
}
_FIXED_HEADERS = (
    ("Cache-Control", "no-store"),
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline'; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
)
_MOST_CLIENTS = 32
MOST_HALF_OPEN = 32
"""Connections that are no clients yet, or were answered and not closed."""
_HANDSHAKE_S = 3.0
"""How long a request may take to arrive."""
_BACKLOG = 32
"""Connections that the system keeps, and that are accepted at a time."""
_MOST_SENT_BYTES = 4096
"""In a message of a client, which nobody looks at; who sends a longer one is cut off."""
_REPORTED_EVERY_S = 60.0
_CLOSING_S = 1.0
"""How long the lines that still wait at the end have to leave."""
_PAUSE_S = 0.01


class WebSocketStream:
    """A message a line to every client, and the pages, from a thread of its own within the `with`.

    A client that is too slow loses its oldest lines. Where there is no client nothing is made.

    Args:
        host: name or address of the network interface.
        port: 0 = any free one.
        fields: what to send of each estimate, of lines.LINE_FIELDS; None for all.
        waiting: lines kept for a client that falls behind, at least 1.
        origins: of pages of other servers that may listen, as "http://localhost:3000".
        live: nothing to the stream; the devices' `realtime` follows it in the configuration.

    Raises:
        ToftrackError: websockets is not installed, an unknown field, an impossible number; by
            `with`, when the port is taken or not allowed, or there is no such host here.
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
        if not isinstance(port, int) or not 0 <= port <= 65535:
            raise ToftrackError(f"stream.port={port!r} is no port; give a number from 0 to 65535")
        if not isinstance(waiting, int) or waiting < 1:
            raise ToftrackError(f"stream.waiting={waiting!r} is no number of lines; give 1 or more")
        self._host, self._port, self._waiting = str(host), port, waiting
        self._origins = (origins,) if isinstance(origins, str) else tuple(origins)
        self._websockets = _websockets()
        self._files = {path: _page(name) for path, (name, _) in _PAGES.items()}
        self._clients: set[_Client] = set()
        self._open: dict[Any, None] = {}
        """Every connection, the oldest first."""
        self._half_open: dict[Any, None] = {}
        self._reported_s = -math.inf
        self._sent = self._dropped = 0
        self.url = ""
        """Of the first page, within the `with`."""

    def __enter__(self) -> Self:
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._trouble)
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="websocket-server", daemon=True
        )
        self._thread.start()
        try:
            self._server = self._run(self._serve())
        except OSError as error:
            self._end_thread()
            raise refused("stream", self._host, self._port, error) from error
        at, port = self._server.sockets[0].getsockname()[:2]
        self.url = f"http://[{at}]:{port}/" if ":" in at else f"http://{at}:{port}/"
        print(
            f"the hand in 3-D: {self.url}, point and pinch: {self.url}point, for programs: "
            f"ws{self.url[4:-1]}{STREAM}",
            file=sys.stderr,
            flush=True,
        )
        return self

    def send(self, estimates: Sequence[Estimate]) -> None:
        """Leave a line for every client; returns at once."""
        if self._clients:
            self._loop.call_soon_threadsafe(self._offer, json_line(estimates, self._fields))

    def __exit__(self, *exception: Any) -> None:
        self._run(self._close())
        self._end_thread()
        report_dropped(
            self._sent, f"to clients of {self.url}", self._dropped, "a client was too slow"
        )

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> Any:
        return await self._websockets.serve(
            self._talk,
            self._host,
            self._port,
            create_connection=self._connection,
            process_request=self._answer,
            open_timeout=_HANDSHAKE_S,
            backlog=_BACKLOG,
            compression=None,  # of short messages to near clients it would only take time
            max_size=_MOST_SENT_BYTES,
            close_timeout=_CLOSING_S,
            server_header="toftrack",
            logger=_quiet_log(),
        )

    async def _close(self) -> None:
        deadline = self._loop.time() + _CLOSING_S
        while any(client.lines for client in self._clients) and self._loop.time() < deadline:
            await asyncio.sleep(_PAUSE_S)
        self._dropped += sum(len(client.lines) for client in self._clients)
        for connection in list(self._half_open):
            connection.transport.abort()
        self._server.close()
        try:
            await asyncio.wait_for(self._server.wait_closed(), _CLOSING_S)
        except TimeoutError:
            # Who does not read does not say goodbye either.
            for connection in list(self._open):
                connection.transport.abort()
            await self._server.wait_closed()

    def _connection(self, *arguments: Any, **settings: Any) -> Any:
        """A connection that this stream counts."""
        return self._websockets.Connection(self, *arguments, **settings)

    def opened(self, connection: Any) -> None:
        """Count a connection; too many that are no clients push out the oldest of them."""
        self._open[connection] = self._half_open[connection] = None
        if len(self._half_open) > MOST_HALF_OPEN:
            oldest = next(iter(self._half_open))
            del self._half_open[oldest]
            oldest.transport.abort()

    def closed(self, connection: Any) -> None:
        """Count a connection no more."""
        self._open.pop(connection, None)
        self._half_open.pop(connection, None)

    def _trouble(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What the event loop complains of, as that there are no descriptors any more."""
        if loop.time() >= self._reported_s + _REPORTED_EVERY_S:
            self._reported_s = loop.time()
            reason = context.get("exception") or "unknown reason"
            _log.warning("stream=websocket: %s (%s)", context.get("message"), reason)

    def _offer(self, line: str) -> None:
        for client in self._clients:
            self._dropped += len(client.lines) == client.lines.maxlen
            client.lines.append(line)
            client.news.set()

    async def _talk(self, connection: Any) -> None:
        """Send what there is to one client until it leaves."""
        client = _Client(self._waiting)
        self._clients.add(client)
        self._half_open.pop(connection, None)
        gone = asyncio.ensure_future(self._ignore(connection))
        try:
            while not gone.done():
                news = asyncio.ensure_future(client.news.wait())
                await asyncio.wait((news, gone), return_when=asyncio.FIRST_COMPLETED)
                news.cancel()
                client.news.clear()
                while client.lines and not gone.done():
                    await connection.send(client.lines.popleft())
                    self._sent += 1
        except self._websockets.ConnectionClosed:
            pass
        finally:
            gone.cancel()
            self._clients.discard(client)

    async def _ignore(self, connection: Any) -> None:
        """Read what a client sends until it leaves: unread messages would hold up its pongs."""
        with suppress(self._websockets.ConnectionClosed):
            async for _ in connection:
                pass

    def _answer(self, connection: Any, request: Any) -> Any:
        """The answer to a request; None lets a websocket be opened."""
        headers = request.headers
        if not called_by_a_known_name(headers.get("Host", ""), self._host):
            return self._text(403, "this server answers to its address and to localhost only")
        path = request.path.partition("?")[0]
        if path == STREAM:
            return self._refusal(headers)
        if path in _PAGES:
            return self._response(200, self._files[path], _PAGES[path][1])
        return self._text(404, f"there is no {path} here; the pages are at / and /point")

    def _refusal(self, headers: Any) -> Any:
        """Of who must not listen."""
        origin = headers.get("Origin")
        if origin not in (None, f"http://{headers.get('Host')}", *self._origins):
            return self._text(
                403, "this page may not listen; name its origin in stream.origins=[ORIGIN]"
            )
        if headers.get("Upgrade", "").lower() != "websocket":
            return self._text(426, f"{STREAM} is for websockets")
        if len(self._clients) >= _MOST_CLIENTS:
            return self._text(503, "too many clients listen already")
        return None

    def _text(self, status: int, sentence: str) -> Any:
        return self._response(status, f"{sentence}\n".encode(), "text/plain; charset=utf-8")

    def _response(self, status: int, body: bytes, kind: str) -> Any:
        headers = self._websockets.Headers(
            (
                *_FIXED_HEADERS,
                ("Content-Type", kind),
                ("Content-Length", str(len(body))),
                ("Connection", "close"),
            )
        )
        return self._websockets.Response(status, "", headers, body)


class _Client:
    """Lines that wait for one client."""

    def __init__(self, waiting: int) -> None:
        self.lines: deque[str] = deque(maxlen=waiting)
        self.news = asyncio.Event()


def _page(name: str) -> bytes:
    return (resources.files("toftrack.output.web") / name).read_bytes()


def _quiet_log() -> logging.Logger:
    """The terminal belongs to the tracker; a client that breaks off is no error."""
    log = logging.getLogger(f"{__name__}.clients")
    log.setLevel(logging.CRITICAL)
    return log


def _websockets() -> SimpleNamespace:
    """What is used of the package; ToftrackError when it is not installed."""
    try:
        from websockets.asyncio.server import ServerConnection, serve
        from websockets.datastructures import Headers
        from websockets.exceptions import ConnectionClosed
        from websockets.http11 import Response
    except ImportError:
        raise ToftrackError(
            "stream=websocket needs websockets, which is not installed: pip install "
            "'toftrack[web]', in a checkout pip install -e '.[web]'"
        ) from None

    class Connection(ServerConnection):
        """Tells its stream from when on it takes a descriptor, and until when."""

        def __init__(self, stream: WebSocketStream, *arguments: Any, **settings: Any) -> None:
            super().__init__(*arguments, **settings)
            self._stream = stream

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._stream.opened(self)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._stream.closed(self)

    return SimpleNamespace(
        serve=serve,
        Connection=Connection,
        Headers=Headers,
        ConnectionClosed=ConnectionClosed,
        Response=Response,
    )
