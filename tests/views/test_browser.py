"""`view=browser`: the page, its pictures, its commands, and what must not disturb the tracker."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from helpers.browsing import (
    PATIENCE_S,
    eventually,
    get,
    made,
    moments,
    next_picture,
    ours,
    post,
    raw,
    shown_again_and_again,
)
from helpers.moments import two_hands, with_hand
from helpers.settings import browser_view

from toftrack.errors import ToftrackError
from toftrack.estimate import no_estimate, state_words
from toftrack.views.browser import view as browser
from toftrack.views.browser.view import BrowserView, LivePicture
from toftrack.views.overlay import CAPTION_PX, draw_tracked


@pytest.fixture
def view() -> Iterator[BrowserView]:
    view = made()
    yield view
    view.close()


def test_the_page_comes_with_all_that_it_needs(view) -> None:
    with urlopen(view.url, timeout=PATIENCE_S) as answer:
        page = answer.read().decode()
        assert answer.headers.get_content_type() == "text/html"
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert "Start again" in page and "Left hand" in page
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?:|@import|url\(", page)


def test_the_picture_is_the_overlay_of_the_newest_frame(view) -> None:
    first, second = moments()
    view.show(first)
    view.show(second)
    facts, body = next_picture(view, {})
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    panel = draw_tracked(second)[CAPTION_PX:]
    assert picture.shape == panel.shape
    assert np.abs(picture.astype(int) - panel).mean() < 3
    assert np.abs(picture.astype(int) - draw_tracked(first)[CAPTION_PX:]).mean() > 3
    estimate = second.estimates[0]
    assert (facts["phase"], facts["index"]) == ("live", estimate.index)
    assert facts["score"] == pytest.approx(estimate.score, abs=1e-3)
    assert (facts["state"], facts["lost"]) == (state_words(estimate), estimate.lost)
    assert facts["confidence"] == pytest.approx(estimate.confidence, abs=1e-3)
    assert facts["gesture"] == estimate.gesture and facts["side"] == "right"
    assert facts["pinch"] == pytest.approx(estimate.pinch, abs=1e-3)
    assert facts["pinching"] == estimate.pinching
    assert facts["ms"] == pytest.approx(1e3 * estimate.compute_s, abs=1e-3)


def test_pictures_follow_one_another_and_none_comes_twice(view) -> None:
    facts, bodies = {}, []
    for count in range(6):
        view.show(moments()[count % 2])
        facts, body = next_picture(view, facts)
        bodies.append(body)
    assert all(a != b for a, b in zip(bodies, bodies[1:], strict=False))
    assert get(view, f"moment?run={facts['run']}&after={facts['version']}")[1] == b""


def test_a_page_of_an_earlier_run_gets_this_runs_picture_at_once(view) -> None:
    view.show(moments()[0])
    assert next_picture(view, {"run": "another", "version": 10**9})[1]


def test_a_frame_without_a_hand_is_shown_as_lost(view) -> None:
    moment = moments()[0]
    view.show(with_hand(moment, estimate=no_estimate(7, 0.28, "lost", 4, 0.01), insight=None))
    facts, _ = next_picture(view, {})
    assert facts["lost"] and facts["index"] == 7 and facts["gesture_probability"] is None


def test_two_hands_are_distinguished_from_the_frame(view) -> None:
    moment = two_hands(moments()[1], lost=True, gesture="fist")
    view.show(moment)
    facts, _ = next_picture(view, {})
    assert [(one["side"], one["lost"], one["there"]) for one in facts["hands"]] == [
        *(("right", False, True), ("left", True, True)),
    ]
    assert facts["hands"][1]["gesture"] == "fist" and facts["hands"][0]["side_probability"] == 1
    assert facts["lost"] is False and facts["index"] == moment.estimates[0].index
    gone = no_estimate(7, 0.28, "searching", 4, 0.01)
    first, second = moment.hands
    view.show(replace(moment, hands=(replace(first, estimate=gone), second)))
    facts, _ = next_picture(view, facts)
    assert facts["lost"] and [one["there"] for one in facts["hands"]] == [False, True]


def test_before_the_first_frame_and_after_the_last_the_page_says_so(monkeypatch) -> None:
    moments()
    view = made(linger_s=PATIENCE_S)
    lingering, end = threading.Event(), threading.Event()
    monkeypatch.setattr(view, "_linger", lambda: lingering.set() or end.wait(PATIENCE_S))

    def run() -> None:
        with view:
            view.show(moments()[0])

    with urlopen(view.url + "moment", timeout=PATIENCE_S) as answer:
        assert answer.status == 204
        assert json.loads(answer.headers["X-Moment"])["phase"] == "starting"
    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert lingering.wait(PATIENCE_S)
        facts, body = next_picture(view, {})
        assert facts["phase"] == "over" and body
    finally:
        end.set()
        thread.join()


def test_who_waits_is_reported_of_the_end_at_once(view) -> None:
    view.show(moments()[0])
    facts, _ = next_picture(view, {})
    reported: list[dict] = []
    path = f"moment?run={facts['run']}&after={facts['version']}"
    visitor = threading.Thread(target=lambda: reported.append(get(view, path)[0]))
    visitor.start()
    eventually(lambda: view._picture._waiting)
    view.close()
    visitor.join()
    assert reported[0]["phase"] == "stopped"


def test_commands_arrive_in_order_and_once(view) -> None:
    origin = view.url.rstrip("/")
    for command in ("left", "restart", "right"):
        assert post(view, {"command": command}, Origin=origin) == 204
    assert view.commands() == ["left", "restart", "right"]
    assert view.commands() == []


@pytest.mark.parametrize(
    ("body", "changes", "status"),
    [
        ({"command": "stop"}, {}, 400),
        ({"command": ["left"]}, {}, 400),
        (["left"], {}, 400),
        (b"left", {}, 400),
        (b"\xff\xfe", {}, 400),
        (b" " * 2000, {}, 413),
        ({"command": "left"}, {"Content_Type": "text/plain"}, 415),
        ({"command": "left"}, {"Origin": "http://evil.example"}, 403),
        ({"command": "left"}, {"Origin": "null"}, 403),
        ({"command": "left"}, {"Host": "evil.example", "Origin": "http://evil.example"}, 403),
        ({"command": "left"}, {"path": "elsewhere"}, 404),
        ({"command": "left"}, {"X_Token": ""}, 403),
        ({"command": "left"}, {"X_Token": "guessed"}, 403),
    ],
)
def test_anything_but_a_command_from_its_own_page_is_refused(view, body, changes, status) -> None:
    assert post(view, body, **changes) == status
    assert view.commands() == []
    assert post(view, {"command": "left"}) == 204


def test_nothing_but_the_printed_address_says_the_token(view, capsys) -> None:
    token = view.address.removeprefix(f"{view.url}#")
    assert len(token) >= 16
    view.show(moments()[0])
    facts, picture = next_picture(view, {})
    _, page = get(view, "")
    assert token not in json.dumps(facts)
    assert token.encode() not in picture + page
    with closing(made()) as other:
        assert other.address in capsys.readouterr().err
        assert not other.address.endswith(token)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_a_foreign_name_gets_nothing(view, host: str) -> None:
    url = urlsplit(view.url)
    connection = http.client.HTTPConnection(url.hostname, url.port, timeout=PATIENCE_S)
    for path in ("/", "/moment"):
        connection.request("GET", path, headers={"Host": host})
        answer = connection.getresponse()
        assert answer.status == 403 and b"<html" not in answer.read()
    connection.request("GET", "/", headers={"Host": f"localhost:{url.port}"})
    assert connection.getresponse().status == 200
    connection.close()


@pytest.mark.parametrize(("path", "status"), [("other", 404), ("moment?after=-1", 400)])
def test_what_is_not_there_is_refused(view, path: str, status: int) -> None:
    with pytest.raises(HTTPError) as caught:
        urlopen(view.url + path, timeout=PATIENCE_S)
    assert caught.value.code == status
    caught.value.close()


def test_nothing_is_drawn_while_nobody_watches(monkeypatch) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(
        browser, "_encode", lambda m, _: drawn.append(m.estimates[0].index) or b"jpeg"
    )
    picture = LivePicture(80, 1000)
    try:
        for _ in range(20):
            picture.put(moments()[0])
        time.sleep(0.1)
        assert drawn == []
        picture.put(moments()[1])
        assert picture.after(0, PATIENCE_S).jpeg == b"jpeg"
        assert drawn == [moments()[1].estimates[0].index]  # the others were never drawn
    finally:
        picture.close()


def test_showing_a_frame_never_waits_for_the_drawing(monkeypatch) -> None:
    go = threading.Event()
    monkeypatch.setattr(browser, "_encode", lambda *_: go.wait(PATIENCE_S) and b"jpeg")
    picture = LivePicture(80, 1000)
    try:
        visitor = threading.Thread(target=picture.after, args=(0, PATIENCE_S))
        visitor.start()
        picture.put(moments()[0])
        eventually(lambda: not picture._undrawn)  # it is being drawn
        for _ in range(3):
            picture.put(moments()[1])
        assert visitor.is_alive()
        go.set()
        visitor.join()
    finally:
        go.set()
        picture.close()


def test_what_goes_wrong_in_drawing_reaches_the_tracker(monkeypatch) -> None:
    def fail(*_: object) -> bytes:
        raise ToftrackError("the picture cannot be drawn")

    monkeypatch.setattr(browser, "_encode", fail)
    picture = LivePicture(80, 1000)
    try:
        picture.put(moments()[0])
        picture.after(0, 0.1)
        eventually(lambda: picture._error)
        with pytest.raises(ToftrackError, match="cannot be drawn"):
            picture.put(moments()[0])
    finally:
        picture.close()


def test_ten_visitors_and_one_who_never_reads_all_get_on(view) -> None:
    counts = [0] * 10

    def watch(number: int) -> None:
        facts: dict = {}
        for _ in range(5):
            facts, _ = next_picture(view, facts)
            counts[number] += 1

    with shown_again_and_again(view), raw(view) as deaf:
        deaf.settimeout(0.2)
        try:  # requests without end, until nothing goes into the pipe any more
            while True:
                deaf.sendall(b"GET /moment HTTP/1.1\r\nHost: localhost\r\n\r\n" * 100)
        except TimeoutError:
            pass
        visitors = [threading.Thread(target=watch, args=(n,)) for n in range(10)]
        for visitor in visitors:
            visitor.start()
        for visitor in visitors:
            visitor.join(PATIENCE_S)
        assert counts == [5] * 10
        view.close()  # although one is still connected
        assert ours() == []


def test_a_tab_closed_in_the_middle_is_no_error(view, capfd) -> None:
    with shown_again_and_again(view):
        for request in (b"", b"GET /mom", b"GET /moment HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            for _ in range(3):
                connection = raw(view)
                connection.sendall(request)
                # Closing with a reset, as a browser that is killed.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                connection.close()
        with raw(view) as nonsense:
            nonsense.sendall(b"\x16\x03\x01 https\r\n\r\n")
            assert b"400" in nonsense.recv(1000)
        assert next_picture(view, {})[1]
    view.close()
    assert capfd.readouterr().err == "" and ours() == []


def test_a_taken_port_is_one_clear_sentence_and_leaves_no_thread(view) -> None:
    port = urlsplit(view.url).port
    before = ours()
    with pytest.raises(ToftrackError, match=rf"port {port} of 127.0.0.1 is taken.*view\.port=PORT"):
        browser_view("", 25.0, None, port=port)
    assert ours() == before


@pytest.mark.parametrize(
    "settings",
    [
        {"port": 65536},
        {"port": "http"},
        {"quality": 0},
        {"most_fps": 0},
        {"wait_s": -1},
        {"linger_s": float("nan")},
        {"host": "192.0.2.1"},
    ],
)
def test_a_bad_setting_is_named(settings: dict) -> None:
    with pytest.raises(ToftrackError, match=f"view.{next(iter(settings))}="):
        browser_view("", 25.0, None, **{"port": 0} | settings)
    assert ours() == []


def test_closing_leaves_no_thread_and_frees_the_port() -> None:
    view = made()
    with raw(view), raw(view) as idle:  # browsers keep connections open
        idle.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert idle.recv(10)
        view.close()
        view.close()
        assert ours() == []
    browser_view("", 25.0, None, port=urlsplit(view.url).port).close()
    with pytest.raises(URLError):
        urlopen(view.url, timeout=PATIENCE_S)
