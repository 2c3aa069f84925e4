"""What the tests of `view=browser` share: a view, frames to show, and a visitor."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from helpers.moments import one_hand, with_hand
from helpers.settings import browser_view
from helpers.tracking import make_tracker

from toftrack.devices.sample import Sample
from toftrack.views.base import TrackedFrame
from toftrack.views.browser.view import BrowserView

PATIENCE_S = 20


@cache
def moments() -> tuple[TrackedFrame, ...]:
    """Two tracked frames of the sample, which look different."""
    device, tracker = Sample(start=40, stop=46), make_tracker()
    kept = []
    for frame in device:
        depth, shape = device.camera.rectify(frame.depth, frame.radial), tracker.shape
        estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
        kept.append(one_hand(frame, depth, device.camera, estimate, shape, tracker.insight))
    return kept[0], kept[-1]


def made(**settings: float) -> BrowserView:
    return browser_view("", 25.0, None, port=0, **settings)


def get(view: BrowserView, path: str) -> tuple[dict, bytes]:
    """The facts and the body of an answer."""
    with urlopen(view.url + path, timeout=PATIENCE_S) as answer:
        return json.loads(answer.headers["X-Moment"] or "{}"), answer.read()


def next_picture(view: BrowserView, facts: dict) -> tuple[dict, bytes]:
    """Ask, as the page does, until there is a newer picture."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        facts, body = get(
            view, f"moment?run={facts.get('run', '')}&after={facts.get('version', 0)}"
        )
        if body:
            return facts, body
    raise AssertionError("no picture came")


def post(view: BrowserView, body: object, path: str = "command", **headers: str) -> int:
    """The status of a POST as the page sends it, but for the given headers."""
    token = view.address.partition("#")[2]
    headers = {"Content-Type": "application/json", "X-Token": token} | {
        name.replace("_", "-"): value for name, value in headers.items()
    }
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    try:
        with urlopen(Request(view.url + path, data, headers), timeout=PATIENCE_S) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


def raw(view: BrowserView) -> socket.socket:
    url = urlsplit(view.url)
    return socket.create_connection((url.hostname, url.port), PATIENCE_S)


def ours() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("browser-")]


def eventually(reported: Callable[[], object]) -> object:
    """Wait until `told` says something true."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := reported()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return value


@contextmanager
def shown_again_and_again(view: BrowserView) -> Iterator[list[str]]:
    """A thread that does what the tracker does: shows frames and takes commands."""
    taken: list[str] = []
    stop = threading.Event()

    def run() -> None:
        count = 0
        while not stop.is_set():
            taken.extend(view.commands())
            moment, count = moments()[count // 5 % 2], count + 1
            told = next((c for c in reversed(taken) if c != "restart"), "right")
            side = "right" if told == "auto" else told
            hand = moment.hands[0]
            shape = hand.shape.of_side(side) if side != hand.shape.side else hand.shape
            estimate = replace(hand.estimate, index=count)
            shown = with_hand(moment, estimate=estimate, shape=shape)
            view.show(replace(shown, side_given=told != "auto"))
            stop.wait(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield taken
    finally:
        stop.set()
        thread.join()
