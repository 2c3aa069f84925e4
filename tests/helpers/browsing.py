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

import cv2
import numpy as np
from helpers.moments import tracked, with_hand
from helpers.settings import browser_view
from helpers.tracking import make_tracker
from websockets.sync.client import connect

from toftrack.devices.replay import Sample
from toftrack.views.base import TrackedFrame
from toftrack.views.browser.view import BrowserView
from toftrack.views.overlay import CAPTION_PX, draw_tracked

PATIENCE_S = 20
_MEMORY = np.full((144, 176), 1000, np.uint16)


@cache
def moments() -> tuple[TrackedFrame, ...]:
    """Two tracked frames of the sample, which look different."""
    kept = tracked(Sample(start=40, stop=46), make_tracker())
    return kept[0], kept[-1]


def made(**settings: float) -> BrowserView:
    return browser_view("", 25.0, None, port=0, **settings)


def numbered(number: int) -> TrackedFrame:
    """A frame that shows its number modulo 8 twice: as the grey of the image's upper left corner,
    and by how far to the right the skeleton is. All have the same memory, as some devices' frames.
    """
    moment, number = moments()[0], number % 8
    _MEMORY[:16, :16] = 1000 * ((20 + 30 * number) / 255) ** 2
    joints = moment.estimates[0].joints_m + np.float32([0.012 * number - 0.05, 0, 0])
    shown = with_hand(moment, estimate=replace(moment.estimates[0], joints_m=joints))
    return replace(shown, frame=replace(moment.frame, amplitude=_MEMORY))


def numbers_of(picture: bytes) -> tuple[int, int]:
    """The numbers that an encoded picture of `numbered` shows, by its image and by its skeleton."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)[:, :528]
    places = np.abs(np.array(_skeletons()) - _skeleton(pixels))
    return round((pixels[5:40, 5:40].mean() - 20) / 30), int(places.argmin())


def _skeleton(pixels: np.ndarray) -> float:
    """Where it lies, across."""
    return float(np.nonzero(np.ptp(pixels.astype(int), axis=2) > 60)[1].mean())


@cache
def _skeletons() -> list[float]:
    return [_skeleton(draw_tracked(numbered(n))[CAPTION_PX:, :528]) for n in range(8)]


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
            view.show(replace(shown, side_given=asked != "auto"))
            stop.wait(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield taken
    finally:
        stop.set()
        thread.join()
