"""Pages and a websocket on one port: what `view=browser` and `stream=websocket` are served by.

The server answers only those who call it by an address or as localhost, and opens websockets to
its own pages, to pages of origins that are named, and to programs that are no browsers; so no
other web site can reach it under a name of its own. Connections that have not asked for anything
yet are few and have seconds to ask: when there are too many, the oldest has to go.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import ipaddress
import json
import logging
import math
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from importlib import resources
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from toftrack.errors import ToftrackError
from toftrack.files.json_text import parse_json

_log = logging.getLogger(__name__)
# The terminal belongs to the tracker; a client that breaks off is no error.
_quiet_log = logging.getLogger(f"{__name__}.clients")
_quiet_log.setLevel(logging.CRITICAL)

_FIXED_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'unsafe-inline'; "
    "style-src 'self' 'unsafe-inline'; img-src data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Connection": "close",
}
_KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
MOST_CLIENTS = 32
MOST_HALF_OPEN = 32
"""Connections that are no clients yet, or were answered and not closed."""
_HANDSHAKE_S = 3.0
"""How long a request may take to arrive."""
_BACKLOG = 32
"""Connections that the system keeps, and that are accepted at a time."""
_MOST_RECEIVED_BYTES = 4096
"""In a message of a client; who sends a longer one is cut off."""
_MOST_UNREAD_BYTES = 2**16
"""Of answers to pings, which nothing else bounds; who sends more and does not read is cut off."""
_REPORTED_EVERY_S = 60.0
_MOST_ORIGINS = 20
"""That the log tells of."""
_CLOSING_S = 1.0
"""How long the messages that still wait at the end have to leave."""
_PAUSE_S = 0.01
_LOOK_S = 0.25
"""A wait of the main thread in one piece, which Ctrl-C does not end on Windows."""
_OPENED_AT = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""For all addresses at once, which no browser opens on Windows, that of this machine."""
ANY_PORT = " (0 = any free one)"
"""What is said of a port that cannot be meant."""


def wait(event: threading.Event, seconds: float = math.inf) -> None:
    """Wait for an event, so long at most; Ctrl-C ends it everywhere."""
    end_s = time.monotonic() + seconds
    while not event.is_set() and (left_s := end_s - time.monotonic()) > 0:
        event.wait(min(left_s, _LOOK_S))


class Client:
    """What one websocket is sent and says; of the server's thread alone.

    most_waiting: messages that wait at a time. At the end they have a second to leave.
    """

    def __init__(self, most_waiting: int) -> None:
        self._most_waiting = most_waiting
        self._messages: deque[str | bytes] = deque()
        self.news = asyncio.Event()
        """That `take` has something."""

    def tell(self, facts: dict[str, Any], *more: bytes) -> None:
        """Send facts and what follows, unless too much waits already."""
        if len(self._messages) < self._most_waiting:
            self._messages += (json.dumps(facts, allow_nan=False), *more)
            self.news.set()

    def take(self) -> str | bytes | None:
        """The next message to send; None where there is none."""
        return self._messages.popleft() if self._messages else None

    def receive(self, message: str | bytes) -> None:
        """Look at what was sent by the other side; here nobody does."""

    def __len__(self) -> int:
        return len(self._messages)


def request_of(message: str | bytes, token: str) -> tuple[dict[str, Any], bool]:
    """The object that a page sent, {} for anything else, and whether it has the token."""
    try:
        content = parse_json(message)
    except ValueError:
        content = None
    content = content if isinstance(content, dict) else {}
    given = str(content.get("token")).encode("utf-8", "replace")
    return content, secrets.compare_digest(given, token.encode())


class WebServer:
    """Serves from a thread of its own, from construction until `close`.

    group: whose settings `host` and `port` (0 = any free one) are, for errors; "" where they are
    the options --host and --port.  pages: names of files in `package`, by the paths that they are
    served at.  path: where websockets are opened, each with a client by `new_client`.  origins: of
    pages of other servers that may open one, as "http://127.0.0.1:3000"; None where no setting of
    the group names any.

    Raises ToftrackError: the port is taken or not allowed, or there is no such host here.
    """

    def __init__(
        self,
        group: str,
        host: str,
        port: int,
        package: str,
        pages: Mapping[str, str],
        path: str,
        new_client: Callable[[], Client],
        origins: Collection[str] | None = None,
    ) -> None:
        self._group, self._host, self._path, self._origins = group, host, path, origins
        self._refused: set[str] = set()
        """Origins that the log has told of."""
        self._new_client = new_client
        folder = resources.files(package)
        self._pages = {
            at: ((folder / name).read_bytes(), _KINDS[name.rpartition(".")[2]])
            for at, name in pages.items()
        }
        self.clients: set[Any] = set()
        self._open: set[_Connection] = set()
        self._half_open: dict[_Connection, None] = {}
        """The oldest first."""
        self._reported_s = -math.inf
        # On Windows, too, whose own loop bounds no read, and may never count out who broke off.
        self._loop = asyncio.SelectorEventLoop()
        self._loop.set_exception_handler(self._trouble)
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="web-server", daemon=True
        )
        self._thread.start()
        try:
            self._server: Server = self.begin(self._serve(port)).result()
        except (OSError, ValueError) as error:  # a name that cannot be one
            self._end_thread()
            of_system = error if isinstance(error, OSError) else OSError(str(error))
            raise _refused(group, host, port, of_system) from error
        at, port = next(iter(self._server.sockets)).getsockname()[:2]
        at = _OPENED_AT.get(at, at)
        self.url = f"http://[{at}]:{port}/" if ":" in at else f"http://{at}:{port}/"
        """Of the first page."""

    def begin(self, work: Any) -> Any:
        """Run a coroutine in the server's thread; returns its concurrent.futures.Future."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call(self, function: Callable[..., object], *given: object) -> None:
        """Call a function in the server's thread, soon; not at all after `close`."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, *given)

    def close(self) -> int:
        """End the thread; returns how many messages did not leave. A second call does nothing."""
        if self._loop.is_closed():
            return 0
        left = self.begin(self._close()).result()
        self._end_thread()
        return left

    def _end_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self, port: int) -> Server:
        return await serve(
            self._talk,
            self._host,
            port,
            create_connection=functools.partial(_Connection, self),  # type: ignore[arg-type]
            process_request=self._answer,
            open_timeout=_HANDSHAKE_S,
            backlog=_BACKLOG,
            compression=None,  # of short messages and JPEGs to near clients it would only take time
            max_size=_MOST_RECEIVED_BYTES,
            close_timeout=_CLOSING_S,
            server_header="toftrack",
            logger=_quiet_log,
        )

    async def _close(self) -> int:
        deadline = self._loop.time() + _CLOSING_S
        while any(map(len, self.clients)) and self._loop.time() < deadline:
            await asyncio.sleep(_PAUSE_S)
        left = sum(map(len, self.clients))
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
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await self._loop.shutdown_default_executor()
        return left

    def opened(self, connection: _Connection) -> None:
        """Count a connection; too many that are no clients push out the oldest of them."""
        self._open.add(connection)
        self._half_open[connection] = None
        if len(self._half_open) > MOST_HALF_OPEN:
            oldest = next(iter(self._half_open))
            del self._half_open[oldest]
            oldest.transport.abort()

    def closed(self, connection: _Connection) -> None:
        """Count a connection no more."""
        self._open.discard(connection)
        self._half_open.pop(connection, None)

    def _trouble(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What the event loop complains of, as that there are no descriptors any more."""
        if loop.time() >= self._reported_s + _REPORTED_EVERY_S:
            self._reported_s = loop.time()
            reason = context.get("exception") or "unknown reason"
            _log.warning("the web server: %s (%s)", context.get("message"), reason)

    async def _talk(self, connection: ServerConnection) -> None:
        """Send what there is to one client, and read what it sends, until it leaves."""
        self._half_open.pop(connection, None)
        client = self._new_client()
        self.clients.add(client)
        sending = asyncio.ensure_future(_send(connection, client))
        try:
            with suppress(ConnectionClosed):
                # Unread messages would hold up a client's pongs.
                async for message in connection:
                    client.receive(message)
        finally:
            sending.cancel()
            self.clients.discard(client)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request; None lets a websocket be opened."""
        headers = request.headers
        if not self._is_called_by_name(headers.get("Host", "")):
            named = f"; another name of it is {self._group}.host=NAME" if self._group else ""
            return _text(403, f"this server answers to its address and to localhost only{named}")
        path = request.path.partition("?")[0]
        if path in self._pages:
            return _response(200, *self._pages[path])
        if path != self._path:
            return _text(404, f"there is no {path} here; pages are at {', '.join(self._pages)}")
        origin = headers.get("Origin")
        allowed = (f"http://{headers.get('Host')}", *(self._origins or ()))
        if origin is not None and origin not in allowed:
            return _text(403, self._refusal(origin))
        if headers.get("Upgrade", "").lower() != "websocket":
            return _text(426, f"{path} is for websockets")
        if len(self.clients) >= MOST_CLIENTS:
            return _text(503, "too many clients listen already")
        return None

    def _refusal(self, origin: str) -> str:
        """What is said to a page of another server, and once to whoever runs this one."""
        if not re.fullmatch(r"[\w-]+://[\w.:-]{1,100}", origin, re.ASCII):  # anybody writes it
            origin = "no address"
        if self._origins is None:
            remedy = f"only {self.url} may"
        elif origin == "no address":
            remedy = "serve it from one, as a page that is opened as a file has no origin"
        else:
            given = ",".join((*self._origins, origin))
            remedy = f'if it is yours, give "{self._group}.origins=[{given}]"'
        words = f"a page of {origin} may not listen: {remedy}"
        if origin not in self._refused and len(self._refused) < _MOST_ORIGINS:
            self._refused.add(origin)
            _log.warning("%s", words)
        return words

    def _is_called_by_name(self, host_header: str) -> bool:
        """Whether a request calls this machine by an address, as localhost, or as `host`."""
        name = ""
        try:
            name = urlsplit(f"//{host_header}").hostname or ""
            ipaddress.ip_address(name)
        except ValueError:  # no address, or no host at all
            return name in ("localhost", self._host.lower())
        return True


class _Connection(ServerConnection):
    """Tells its server from when on it takes a descriptor, and until when."""

    def __init__(self, owner: WebServer, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self._owner, self._unread_bytes = owner, 0

    def connection_made(self, transport: Any) -> None:
        # What is read at a time is parsed before others get a turn: thousands of messages.
        transport.max_size = _MOST_RECEIVED_BYTES
        super().connection_made(transport)
        self._owner.opened(self)

    def data_received(self, data: bytes) -> None:
        before = self.transport.get_write_buffer_size()
        super().data_received(data)
        answers = self.transport.get_write_buffer_size() - before
        self._unread_bytes = answers + (self._unread_bytes if before else 0)
        if self._unread_bytes > _MOST_UNREAD_BYTES:
            self.transport.abort()

    def send_data(self) -> None:
        # In one piece: asyncio warns of each one after the first to a client that is gone.
        pieces = self.protocol.data_to_send()
        if (data := b"".join(pieces)) and not self.transport.is_closing():
            self.transport.write(data)
        if b"" in pieces and self.transport.can_write_eof():
            with suppress(OSError, RuntimeError):
                self.transport.write_eof()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._owner.closed(self)


async def _send(connection: ServerConnection, client: Client) -> None:
    with suppress(ConnectionClosed):
        while await client.news.wait():
            client.news.clear()
            while (message := client.take()) is not None:
                await connection.send(message)


def _text(status: int, sentence: str) -> Response:
    return _response(status, f"{sentence}\n".encode(), "text/plain")


def _response(status: int, body: bytes, kind: str) -> Response:
    about = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))}
    return Response(status, "", Headers(_FIXED_HEADERS | about), body)


def _refused(group: str, host: str, port: int, error: OSError) -> ToftrackError:
    """What is said when a port cannot be listened at."""
    set_port, set_host = (f"{group}.port=", f"{group}.host=") if group else ("--port ", "--host ")
    if error.errno == errno.EADDRINUSE:
        return ToftrackError(
            f"port {port} of {host} is taken, perhaps by another tracker; end that one, or choose "
            f"another with {set_port}PORT{ANY_PORT}"
        )
    if error.errno == errno.EACCES:
        return ToftrackError(
            f"port {port} of {host} may not be used; choose another above 1023 with {set_port}PORT"
            f"{ANY_PORT}"
        )
    return ToftrackError(
        f"nothing can be served at {set_host}{host} ({error.strerror or error}); give an "
        "address of this machine, or leave it at 127.0.0.1"
    )
