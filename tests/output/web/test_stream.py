"""`stream=websocket`: who gets the lines, who does not, and what must not hold up the tracker."""

import http.client
import json
import logging
import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import pytest
from helpers.browsing import PATIENCE_S, eventually, ours
from helpers.hands import hand_estimate, lost_hand
from helpers.settings import part
from websockets.sync import client

from toftrack.errors import ToftrackError
from toftrack.output.lines import json_line
from toftrack.output.web.server import MOST_HALF_OPEN
from toftrack.output.web.stream import WebSocketStream


def websocket_stream(**changes: Any) -> WebSocketStream:
    return part("stream=websocket", "stream", **{"port": 0, **changes})


@pytest.fixture
def stream() -> Iterator[WebSocketStream]:
    with websocket_stream() as opened:
        yield opened


def listening(stream: WebSocketStream, **headers: str) -> Any:
    """A client that is no browser, or says that it is a page of some origin."""
    url = f"ws{stream.url.removeprefix('http')}stream"
    before = set(stream._server.clients)
    opened = client.connect(url, additional_headers=headers, compression=None)
    eventually(lambda: stream._server.clients - before)
    return opened


def index_of(one: Any) -> int:
    return json.loads(one.recv(PATIENCE_S))["index"]


def answer(stream: WebSocketStream, path: str, **headers: str) -> tuple[int, dict, str]:
    url = urlsplit(stream.url)
    connection = http.client.HTTPConnection(url.hostname, url.port, timeout=PATIENCE_S)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=headers)
    got = connection.getresponse()
    found = got.status, dict(got.headers), got.read().decode()
    connection.close()
    return found


def test_every_client_gets_every_line_as_in_track_jsonl(stream: WebSocketStream) -> None:
    with listening(stream) as first, listening(stream) as second:
        for index in range(20):
            estimate = hand_estimate(index) if index % 3 else lost_hand(index)
            stream.send((estimate,))
            for one in (first, second):
                assert one.recv(PATIENCE_S) == json_line((estimate,))


def half_open(stream: WebSocketStream, count: int, words: bytes = b"") -> list[socket.socket]:
    """Connections that never finish their request."""
    url = urlsplit(stream.url)
    opened = []
    for number in range(count):
        if number % 20 == 0:  # what the system has no room for yet would wait for a second
            time.sleep(0.02)
        opened.append(socket.create_connection((url.hostname, url.port), PATIENCE_S))
        opened[-1].sendall(words)
    return opened


def ended(one: socket.socket) -> bool:
    """Whether the other side has closed a connection."""
    one.setblocking(False)
    try:
        return one.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def test_connections_that_ask_nothing_are_few_and_keep_nobody_out(
    stream: WebSocketStream,
) -> None:
    with ExitStack() as stack, listening(stream) as before:
        count = MOST_HALF_OPEN // 2 + 10
        opened = [stack.enter_context(one) for one in half_open(stream, count)]
        begun = half_open(stream, count, b"GET /stream HTTP/1.1\r\nHost: 127")
        opened += [stack.enter_context(one) for one in begun]
        eventually(lambda: sum(map(ended, opened)) >= 2 * count - MOST_HALF_OPEN)
        with listening(stream) as after:
            stream.send((hand_estimate(1),))
            for one in (before, after):
                assert index_of(one) == 1
            assert answer(stream, "/")[0] == 200
        assert len(stream._server._open) <= MOST_HALF_OPEN + 2
        eventually(lambda: all(map(ended, opened)))  # they have seconds to ask
        eventually(lambda: len(stream._server._open) == 1)


def listen(mute: socket.socket, stream: WebSocketStream) -> None:
    """Make a client of a socket that is never read."""
    url = urlsplit(stream.url)
    mute.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    mute.connect((url.hostname, url.port))
    mute.sendall(
        f"GET /stream HTTP/1.1\r\nHost: {url.netloc}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
    )
    eventually(lambda: stream._server.clients)


def test_a_client_that_never_reads_stops_nothing_and_its_oldest_lines_go(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    estimate = hand_estimate(0)
    with socket.socket() as mute, websocket_stream(waiting=3) as stream:
        listen(mute, stream)
        for index in range(700):
            stream.send((replace(estimate, index=index),))
    words = caplog.text.split()
    sent, dropped = (int(words[words.index(word) - 1]) for word in ("estimates", "dropped"))
    assert sent + dropped >= 699 and dropped > 100  # one may have been on its way


def test_a_client_that_pings_and_never_reads_is_cut_off(stream: WebSocketStream) -> None:
    pings = (b"\x89\xfd" + bytes(4 + 125)) * 8000  # 1 MiB
    with socket.socket() as mute:
        listen(mute, stream)
        with pytest.raises(ConnectionError):
            for _ in range(50):  # the system keeps some, too
                mute.sendall(pings)
    eventually(lambda: not stream._server.clients)


def test_served_at_all_addresses_the_printed_one_can_be_opened() -> None:
    with websocket_stream(host="0.0.0.0") as stream:
        assert stream.url.startswith("http://127.0.0.1:") and answer(stream, "/")[0] == 200


def test_a_host_that_can_be_no_name_is_one_sentence_and_leaves_no_thread() -> None:
    with pytest.raises(ToftrackError, match=r"nothing can be served at stream.host=a\.\.b"):
        websocket_stream(host="a..b").__enter__()
    assert ours() == []


@pytest.mark.parametrize(
    "headers, words",
    [
        ({"Origin": "http://evil.example"}, '"stream.origins=[http://evil.example]"'),
        ({"Origin": "null"}, "a page of no address"),
        ({"Origin": "http://a]';reboot"}, "a page of no address"),
        ({"Origin": "https://127.0.0.1"}, '"stream.origins=[https://127.0.0.1]"'),
        ({"Host": "127.0.0.1.evil.example"}, "localhost only"),
    ],
)
def test_pages_of_other_sites_may_not_listen_which_the_log_says_once(
    stream: WebSocketStream, headers: dict, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade"}
    for _ in range(2):
        status, _, reported = answer(stream, "/stream", **headers, **upgrade)
        assert status == 403 and not stream._server.clients and words in reported
    named = "Host" not in headers  # else anybody may have called
    assert [one.getMessage() for one in caplog.records] == [reported.strip()] * named


def test_its_own_pages_and_those_that_are_named_may_listen(capsys: pytest.CaptureFixture) -> None:
    with websocket_stream(origins=["http://127.0.0.1:3000"]) as stream:
        assert "from the first frame on" in capsys.readouterr().err
        own = f"http://{urlsplit(stream.url).netloc}"
        for origin in (own, "http://127.0.0.1:3000"):
            with listening(stream, Origin=origin) as one:
                stream.send((hand_estimate(4),))
                assert index_of(one) == 4


def test_the_pages_come_with_all_that_they_need(stream: WebSocketStream) -> None:
    for path, words in (("/", "in 3-D"), ("/point?seed=1", "point and pinch")):
        status, headers, page = answer(stream, path)
        assert status == 200 and words in page
        assert headers["Content-Type"].startswith("text/html")
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert set(re.findall(r"src=\"([^\"]+)\"", page)) == {"/feed.js"}
        assert not re.search(r"https?://|@import|url\(", page)
    assert answer(stream, "/feed.js")[1]["Content-Type"].startswith("text/javascript")


def test_the_last_lines_arrive_and_then_everything_ends() -> None:
    with ExitStack() as clients:
        with websocket_stream() as stream:
            one = clients.enter_context(listening(stream))
            for index in range(10):
                stream.send((hand_estimate(index),))
        found = [json.loads(message)["index"] for message in one]
    assert found == list(range(10))
    assert ours() == []
