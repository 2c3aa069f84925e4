"""`view=browser`: visitors who ask for nothing, or take for ever to ask."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from urllib.request import urlopen

import pytest
from helpers.browsing import PATIENCE_S, eventually, made, ours, raw

from toftrack.views.browser import server
from toftrack.views.browser.view import BrowserView


@pytest.fixture
def view() -> Iterator[BrowserView]:
    view = made()
    yield view
    view.close()


@pytest.mark.parametrize("words", [b"", b"GET / HTTP/1.1\r\nHost: local"])
def test_connections_that_ask_nothing_are_few_and_keep_nobody_out(view, words: bytes) -> None:
    with ExitStack() as opened:
        for number in range(3 * server._MOST_CONNECTIONS):
            if number % 20 == 0:  # what the system has no room for yet would wait for a second
                time.sleep(0.02)
            opened.enter_context(raw(view)).sendall(words)
        assert urlopen(view.url, timeout=PATIENCE_S).status == 200
        assert len(ours()) <= 2 * server._MOST_CONNECTIONS + 4  # who is cut off needs a moment
        eventually(lambda: len(ours()) <= server._MOST_CONNECTIONS + 4)
        view.close()
        assert ours() == []


def test_who_sends_a_request_bit_by_bit_is_cut_off(view, monkeypatch) -> None:
    monkeypatch.setattr(server, "_PATIENCE_S", 0.3)
    with raw(view) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\nX: ")
        with pytest.raises(OSError):  # it is closed
            for _ in range(100 * PATIENCE_S):
                slow.sendall(b"x")
                time.sleep(0.01)
    eventually(lambda: "browser-visitor" not in ours())
