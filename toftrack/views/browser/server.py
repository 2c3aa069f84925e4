"""The server behind `view=browser`: one page, its pictures on request, and its commands.

| request | answer |
| --- | --- |
| `GET /` | the page |
| `GET /moment?run=R&after=N` | waits until there is news after version N of run R: 200 with the \
newest picture (JPEG), 204 when only the facts are new or nothing is; the facts are JSON in the \
header `X-Moment` |
| `POST /command` | `{"command": "restart"}`, and the token in the header `X-Token`; 204 when it \
was taken |

Pictures are asked for one by one rather than pushed: who is slow gets the newest one and skips the
others, and a browser's six connections to a server are enough for any number of tabs.

The server answers only those who call it by an address or as localhost, so that no other web site
can reach it under a name of its own, and takes commands only from its own page. They need a token
that nothing but the printed address carries: other users of the machine may watch, no more. It
stands after `#`, which a browser keeps to itself.
"""

from __future__ import annotations

import json
import logging
import math
import os
import secrets
import socket
import socketserver
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from toftrack.json_text import parse_json
from toftrack.output.web.visitors import called_by_a_known_name, refused
from toftrack.views.base import COMMANDS

_log = logging.getLogger(__name__)

_WAIT_S = 1.0
"""The longest that a request for news is kept waiting."""
_PATIENCE_S = 5.0
"""After so long without a whole request, or without reading an answer, a visitor is cut off."""
_MOST_CONNECTIONS = 64
"""Who waits for news or is answered; further ones push out who asks nothing."""
_MOST_COMMAND_BYTES = 1000
_BREATH_S = 0.1
_CLOSING_S = 1.0
"""How long answers may take that are under way when the server closes."""
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


@dataclass(frozen=True)
class News:
    """What a visitor is told."""

    version: int
    """Counts upwards; to be given back as `after`."""
    jpeg: bytes | None
    """The newest picture, if it is newer than `after`."""
    facts: dict[str, Any]
    """JSON-able."""


class Source(Protocol):
    """What is served. Called from several threads at once."""

    def after(self, version: int, wait_s: float) -> News:
        """What is newer than a version; waits for it, but no longer than `wait_s`."""

    def ask(self, command: str) -> None:
        """Take a visitor's command, one of COMMANDS."""


class BrowserServer:
    """Serves from its own threads, from construction until `close`.

    Args:
        source: what to serve.
        host: name or address of the network interface.
        port: 0 = any free one.

    Raises:
        ToftrackError: the port is taken or not allowed, or there is no such host here.
    """

    def __init__(self, source: Source, host: str, port: int) -> None:
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self._server = _Server(source, host, family, address)
        except OSError as error:
            raise refused("view", host, port, error) from error
        at, free = map(str, self._server.server_address[:2])
        self.url = f"http://[{at}]:{free}/" if ":" in at else f"http://{at}:{free}/"
        self.token = self._server.token
        """What commands must carry."""
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="browser-server", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Finish the answers under way and end every thread; a second call does nothing."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
        # Who waits for the next request sees the end of the connection, who sends goes on.
        self._server.hang_up(socket.SHUT_RD)
        if not self._server.all_gone(_CLOSING_S):
            self._server.hang_up(socket.SHUT_RDWR)
            self._server.all_gone(_CLOSING_S)


@dataclass
class _Visit:
    """A connection, and until when its next request must have arrived; inf while it is answered."""

    connection: socket.socket
    until_s: float


class _Server(ThreadingHTTPServer):
    daemon_threads = True  # a program that fails without closing must end nevertheless
    request_queue_size = 32  # the usual 5 keeps a browser with two tabs waiting for a second
    allow_reuse_address = os.name == "posix"  # elsewhere it would let two trackers share a port

    def __init__(self, source: Source, host: str, family: int, address: tuple) -> None:
        self.address_family = family
        self.source, self.host = source, host
        self.run = secrets.token_hex(4)
        self.token = secrets.token_urlsafe(12)
        self.page = (resources.files("toftrack.views.browser") / "page.html").read_bytes()
        self._visits: dict[threading.Thread, _Visit] = {}
        self._lock = threading.Lock()
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        # HTTPServer's asks a name server for this machine's name, which can take seconds.
        socketserver.TCPServer.server_bind(self)
        at, port = self.server_address[:2]
        self.server_name, self.server_port = str(at), port

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError:  # there are no descriptors: the connection still waits, and would at once
            time.sleep(_BREATH_S)
            raise

    def verify_request(self, request: Any, client_address: Any) -> bool:
        with self._lock:
            if len(self._visits) < _MOST_CONNECTIONS:
                return True
            first = min(self._visits.values(), key=lambda visit: visit.until_s)
            idle = first.until_s < math.inf
            if idle:
                first.until_s = math.inf  # its thread ends soon
                _hang_up(first.connection, socket.SHUT_RDWR)
            return idle and len(self._visits) < 2 * _MOST_CONNECTIONS

    def process_request(self, request: Any, client_address: Any) -> None:
        thread = threading.Thread(
            target=self._talk, args=(request, client_address), name="browser-visitor", daemon=True
        )
        with self._lock:
            self._visits[thread] = _Visit(request, time.monotonic() + _PATIENCE_S)
        thread.start()

    def service_actions(self) -> None:
        """Between connections: hang up on who sends a request bit by bit."""
        now_s = time.monotonic()
        with self._lock:
            for visit in self._visits.values():
                if now_s > visit.until_s:
                    _hang_up(visit.connection, socket.SHUT_RDWR)

    def expect(self, within_s: float) -> None:
        """This thread's visitor has so long for a request; inf = it has arrived."""
        with self._lock:
            self._visits[threading.current_thread()].until_s = time.monotonic() + within_s

    def _talk(self, request: socket.socket, client_address: Any) -> None:
        try:
            self.process_request_thread(request, client_address)
        finally:
            with self._lock:
                del self._visits[threading.current_thread()]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A visitor who leaves in the middle of an answer is no error."""
        _log.debug("a visitor's connection ended", exc_info=True)

    def hang_up(self, how: int) -> None:
        with self._lock:
            for visit in self._visits.values():
                _hang_up(visit.connection, how)

    def all_gone(self, within_s: float) -> bool:
        deadline = time.monotonic() + within_s
        with self._lock:
            threads = list(self._visits)
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        return not any(thread.is_alive() for thread in threads)


def _hang_up(connection: socket.socket, how: int) -> None:
    with suppress(OSError):  # gone already
        connection.shutdown(how)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"  # keeps the connection from one picture to the next
    server_version, sys_version = "toftrack", ""
    timeout = _PATIENCE_S
    wbufsize = -1
    disable_nagle_algorithm = True
    server: _Server

    def handle_one_request(self) -> None:
        self.server.expect(_PATIENCE_S)
        super().handle_one_request()

    def do_GET(self) -> None:  # noqa: N802
        self.server.expect(math.inf)
        url = urlsplit(self.path)
        if not self._called_by_a_known_name():
            return
        if url.path == "/":
            self._answer(200, self.server.page, "text/html; charset=utf-8")
        elif url.path == "/moment":
            self._moment(parse_qs(url.query))
        else:
            self._refuse(404, f"there is no {url.path} here; the page is at /")

    def do_POST(self) -> None:  # noqa: N802
        body = self._body()
        self.server.expect(math.inf)
        if body is None or not self._called_by_a_known_name():
            return
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"http://{self.headers.get('Host')}":
            self._refuse(403, "commands are taken from this server's own page only")
        elif not self._carries_the_token():
            self._refuse(403, "commands need the whole address that the tracker printed")
        elif self.headers.get_content_type() != "application/json":
            # Only this type makes a browser ask first when another site wants to send something.
            self._refuse(415, "a command is sent as application/json")
        elif urlsplit(self.path).path != "/command":
            self._refuse(404, "commands go to /command")
        else:
            self._command(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal belongs to the tracker."""

    def _moment(self, query: dict[str, list[str]]) -> None:
        text = query.get("after", ["0"])[0]
        if not (text.isascii() and text.isdigit() and len(text) < 16):
            self._refuse(400, "'after' is the version that was told last, a whole number")
            return
        known = query.get("run", [""])[0] == self.server.run  # else it counts another run's
        news = self.server.source.after(int(text) if known else 0, _WAIT_S)
        facts = {"run": self.server.run, "version": news.version} | news.facts
        headers = {"X-Moment": json.dumps(facts, allow_nan=False)}
        if news.jpeg is None:
            self._answer(204, headers=headers)
        else:
            self._answer(200, news.jpeg, "image/jpeg", headers)

    def _command(self, body: bytes) -> None:
        try:
            content = parse_json(body)
        except ValueError:
            content = None
        command = content.get("command") if isinstance(content, dict) else None
        if command not in COMMANDS:
            self._refuse(400, f'a command is {{"command": C}} with C one of {", ".join(COMMANDS)}')
            return
        self.server.source.ask(command)
        self._answer(204)

    def _body(self) -> bytes | None:
        """The body of the request; None when it was refused."""
        text = self.headers.get("Content-Length", "")
        if not (text.isascii() and text.isdigit() and int(text) <= _MOST_COMMAND_BYTES):
            self.close_connection = True  # what follows is not a request
            self._refuse(413, f"a command has a Content-Length of at most {_MOST_COMMAND_BYTES}")
            return None
        return self.rfile.read(int(text))

    def _carries_the_token(self) -> bool:
        given = self.headers.get("X-Token", "")
        return secrets.compare_digest(given.encode(), self.server.token.encode())

    def _called_by_a_known_name(self) -> bool:
        known = called_by_a_known_name(self.headers.get("Host", ""), self.server.host)
        if not known:
            self._refuse(403, "this server answers to its address and to localhost only")
        return known

    def _refuse(self, status: int, sentence: str) -> None:
        self._answer(status, f"{sentence}\n".encode(), "text/plain; charset=utf-8")

    def _answer(
        self,
        status: int,
        body: bytes = b"",
        kind: str | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        self.send_response(status)
        fixed = {
            "Cache-Control": "no-store",
            "Content-Security-Policy": _POLICY,
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
        }
        if kind is not None:
            fixed |= {"Content-Type": kind, "Content-Length": str(len(body))}
        if self.close_connection:
            fixed["Connection"] = "close"
        for name, value in (fixed | (headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
