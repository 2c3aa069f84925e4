"""`view=browser`: the page, its pictures, its commands, and what must not disturb the tracker."""

import json
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from helpers.browsing import (
    PATIENCE_S,
    Visitor,
    eventually,
    made,
    moments,
    ours,
    shown_again_and_again,
)
from helpers.moments import two_hands, with_hand
from helpers.settings import browser_view
from websockets.exceptions import ConnectionClosed, InvalidStatus

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import no_estimate, state_words
from toftrack.views.base import TrackedFrame
from toftrack.views.browser import view as browser
from toftrack.views.browser.view import BrowserView
from toftrack.views.overlay import CAPTION_PX, draw_tracked


@pytest.fixture
def visitor(view: BrowserView) -> Iterator[Visitor]:
    with Visitor(view.url) as visitor:
        yield visitor


def test_the_picture_is_the_overlay_of_the_newest_frame(view, visitor) -> None:
    first, second = moments()
    ok = np.arange(21) > 1
    second = with_hand(second, estimate=replace(second.estimates[0], joint_ok=ok))
    second = replace(second, dropped=5)
    view.show(first)
    view.show(second)
    facts, body = visitor.picture()
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    panel = draw_tracked(second)[CAPTION_PX:]
    assert picture.shape == panel.shape
    assert np.abs(picture.astype(int) - panel).mean() < 3
    assert np.abs(picture.astype(int) - draw_tracked(first)[CAPTION_PX:]).mean() > 3
    estimate, (hand,) = second.estimates[0], facts["hands"]
    assert (facts["phase"], facts["index"]) == ("live", estimate.index)
    assert (facts["state"], facts["lost"]) == (state_words(estimate), estimate.lost)
    for name in ("score", "confidence", "pinch"):
        assert hand[name] == pytest.approx(getattr(estimate, name), abs=1e-3)
    assert hand["gesture"] == estimate.gesture and hand["side"] == "right"
    assert (hand["doubted"], facts["dropped"]) == (["wrist", "thumb_cmc"], 5)


MEMORY = np.full((144, 176), 1000, np.uint16)


def numbered(number: int) -> TrackedFrame:
    """A frame that shows its number modulo 8 twice: as the image's grey, and by how far to the
    right the skeleton is. All have the same memory, as some devices' frames.
    """
    moment, number = moments()[0], number % 8
    MEMORY[20:] = 1000 * ((20 + 30 * number) / 255) ** 2
    joints = moment.estimates[0].joints_m + np.float32([0.012 * number - 0.05, 0, 0])
    shown = with_hand(moment, estimate=replace(moment.estimates[0], joints_m=joints))
    return replace(shown, frame=replace(moment.frame, amplitude=MEMORY))


def test_image_skeleton_and_facts_are_of_one_frame_though_the_device_reuses_its_memory(
    view, visitor
) -> None:
    with shown_again_and_again(view, numbered):
        seen = [visitor.picture() for _ in range(8)]
    pictures = [(facts["index"] - 1, body) for facts, body in seen]
    view.show(numbered(3))
    numbered(7)  # before anybody asks
    pictures.append((3, visitor.picture()[1]))
    for number, body in pictures:
        picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR).astype(int)
        drawn = draw_tracked(numbered(number))[CAPTION_PX:]
        assert np.abs(picture - drawn).mean() < 1  # 2.5 with the skeleton of a neighbour


def test_pictures_follow_one_another_and_none_comes_twice(view, visitor) -> None:
    bodies = []
    for count in range(6):
        view.show(moments()[count % 2])
        bodies.append(visitor.picture()[1])
    assert all(a != b for a, b in zip(bodies, bodies[1:], strict=False))
    visitor.say(command="picture")
    with pytest.raises(TimeoutError):
        visitor.socket.recv(0.2)
    with Visitor(view.url) as other:  # who comes later sees the newest one at once
        # What is said of a frame comes with its picture only.
        assert other.first == {"phase": "live", "picture": False}
        assert other.picture()[1] == bodies[-1]


def test_two_hands_are_distinguished_from_the_frame(view, visitor) -> None:
    moment = two_hands(moments()[1], lost=True, gesture="fist")
    view.show(moment)
    facts, _ = visitor.picture()
    assert [(one["side"], one["lost"], one["there"]) for one in facts["hands"]] == [
        *(("right", False, True), ("left", True, True)),
    ]
    assert facts["hands"][1]["gesture"] == "fist" and facts["hands"][0]["side_probability"] == 1
    assert facts["lost"] is False and facts["index"] == moment.estimates[0].index
    gone = no_estimate(7, 0.28, "searching", 4, 0.01)
    first, second = moment.hands
    view.show(replace(moment, hands=(replace(first, estimate=gone), second)))
    facts, _ = visitor.picture()
    assert facts["lost"] and [one["there"] for one in facts["hands"]] == [False, True]


@pytest.mark.parametrize(("phase", "error"), [("over", None), ("stopped", ZeroDivisionError())])
def test_visitors_are_told_the_beginning_and_the_end_at_once(phase: str, error: Any) -> None:
    view = made(linger_s=0)
    with Visitor(view.url) as visitor:
        assert visitor.first["phase"] == "starting"
        view.show(moments()[0])
        assert visitor.picture()[0]["phase"] == "live"
        view.__exit__(type(error) if error else None, error, None)
        assert visitor.facts()["phase"] == phase
        with pytest.raises(ConnectionClosed):
            visitor.facts()
    view.close()
    assert ours() == []


def test_commands_arrive_in_order_and_once(view, visitor) -> None:
    for command in ("left", "restart", "right"):
        visitor.say(command=command, token=view.token)
    eventually(lambda: len(view.asked) == 3)
    assert view.commands() == ["left", "restart", "right"]
    assert view.commands() == []


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ('{"command": "stop", "token": "%s"}', "a command is one of restart"),
        ('["left", "%s"]', "a command is one of"),
        (b"\xff\xfe", "a command is one of"),
        ('{"command": "left"}', "the whole address"),
        ('{"command": "left", "token": "\\ud800"}', "the whole address"),
    ],
)
def test_anything_but_a_command_with_the_token_is_refused(view, visitor, message, words) -> None:
    given = message.replace("%s", view.token) if isinstance(message, str) else message
    visitor.socket.send(given)
    assert words in visitor.facts()["refused"]
    assert view.commands() == []


def test_pages_of_other_sites_may_neither_watch_nor_command(view, caplog) -> None:
    for origin in ("http://evil.example", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            Visitor(view.url, Origin=origin)
        assert f"may not listen: only {view.url} may" in caplog.records[-1].getMessage()
    with Visitor(view.url, Origin=view.url.rstrip("/")) as own:
        assert own.first["phase"] == "starting"


def test_nothing_but_the_printed_address_says_the_token(view, visitor, capsys) -> None:
    assert view.address == f"{view.url}#{view.token}" and len(view.token) >= 16
    view.show(moments()[0])
    facts, picture = visitor.picture()
    with urlopen(view.url, timeout=PATIENCE_S) as answer:
        page = answer.read()
    assert view.token not in json.dumps([facts, visitor.first])
    assert view.token.encode() not in picture + page
    with closing(made()) as other:
        assert other.address in capsys.readouterr().err
        assert other.token != view.token


def test_showing_a_frame_never_waits_for_the_drawing(view, visitor, monkeypatch) -> None:
    began, go = threading.Event(), threading.Event()

    def slowly(*_: object) -> bytes:
        began.set()
        go.wait(PATIENCE_S)
        return b"jpeg"

    monkeypatch.setattr(browser, "_encode", slowly)
    visitor.say(command="picture")
    view.show(moments()[0])
    assert began.wait(PATIENCE_S)
    for _ in range(3):
        view.show(moments()[1])
    go.set()
    assert visitor.facts()["picture"]


def test_ten_visitors_and_one_who_never_reads_all_get_on(view, capfd) -> None:
    counts = [0] * 10

    def watch(number: int) -> None:
        with Visitor(view.url) as visitor:
            for _ in range(5):
                visitor.picture()
                counts[number] += 1

    deaf = Visitor(view.url)
    with shown_again_and_again(view):
        for _ in range(1000):
            deaf.say(command="stop")
            deaf.say(command="picture")
        visitors = [threading.Thread(target=watch, args=(n,)) for n in range(10)]
        for visitor in visitors:
            visitor.start()
        for visitor in visitors:
            visitor.join(PATIENCE_S)
        deaf.socket.socket.close()  # as a browser that is killed
        assert counts == [5] * 10
    capfd.readouterr()
    view.close()
    assert capfd.readouterr().err == "" and ours() == []


@pytest.mark.parametrize("settings", [{"port": 65536}, {"quality": 0}, {"host": "192.0.2.1"}])
def test_a_bad_setting_is_named(settings: dict) -> None:
    with pytest.raises(ToftrackError, match=f"view.{next(iter(settings))}="):
        browser_view("", 25.0, None, **{"port": 0} | settings)
    assert ours() == []


def test_closing_frees_the_port(view) -> None:
    port = urlsplit(view.url).port
    with pytest.raises(ToftrackError, match=rf"port {port} of 127.0.0.1 is taken.*view\.port=PORT"):
        browser_view("", 25.0, None, port=port)
    with Visitor(view.url):
        view.close()
        view.close()
        assert ours() == []
    browser_view("", 25.0, None, port=port).close()
