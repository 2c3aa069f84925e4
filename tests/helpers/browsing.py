"""What the tests of `view=browser` share: a view, frames to show, and a visitor."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

from helpers.moments import tracked, with_hand
from helpers.settings import browser_view
from helpers.tracking import make_tracker
from websockets.sync.client import connect

from toftrack.devices.replay import Sample
from toftrack.views.base import TrackedFrame
from toftrack.views.browser.view import BrowserView

PATIENCE_S = 20


@cache
def moments() -> tuple[TrackedFrame, ...]:
    """Two tracked frames of the sample, which look different."""
    kept = tracked(Sample(start=40, stop=46), make_tracker())
    return kept[0], kept[-1]


def made(**settings: float) -> BrowserView:
    return browser_view("", 25.0, None, port=0, **settings)


class Visitor:
    """The page, without a browser: closed at the end of the `with`."""

    def __init__(self, url: str, **headers: str) -> None:
        url = f"ws{url.removeprefix('http').partition('#')[0]}live"
        self._stack = ExitStack()
        self.socket = self._stack.enter_context(connect(url, additional_headers=headers))
        self.first = self.facts()

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def say(self, **content: Any) -> None:
        self.socket.send(json.dumps(content))

    def facts(self) -> dict[str, Any]:
        """The next ones to come."""
        return json.loads(self.socket.recv(PATIENCE_S))

    def picture(self) -> tuple[dict[str, Any], bytes]:
        """Ask for a picture: its facts and its JPEG."""
        self.say(command="picture")
        while not (facts := self.facts()).get("picture"):
            pass
        return facts, self.socket.recv(PATIENCE_S)


def ours() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name == "web-server"]


def eventually(reported: Callable[[], object]) -> object:
    """Wait until something true is reported."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := reported()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return value


@contextmanager
def shown_again_and_again(
    view: BrowserView, frame_of: Callable[[int], TrackedFrame] = lambda n: moments()[n // 5 % 2]
) -> Iterator[list[str]]:
    """A thread that does what the tracker does: shows frames and takes commands."""
    taken: list[str] = []
    stop = threading.Event()

    def run() -> None:
        count = 0
        while not stop.is_set():
            taken.extend(view.commands())
            moment, count = frame_of(count), count + 1
            asked = next((c for c in reversed(taken) if c != "restart"), "right")
            side = "right" if asked == "auto" else asked
            hand = moment.hands[0]
            shape = hand.shape.of_side(side) if side != hand.shape.side else hand.shape
            estimate = replace(hand.estimate, index=count)
            shown = with_hand(moment, estimate=estimate, shape=shape)
            view.show(replace(shown, told=None if asked == "auto" else asked))
            stop.wait(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield taken
    finally:
        stop.set()
        thread.join()
