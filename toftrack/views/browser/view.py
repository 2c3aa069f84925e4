"""`view=browser`: what the tracker sees, live on a page that it serves itself.

The tracker only leaves the newest moment here. Another thread draws it and makes a JPEG of it, once
for all who watch and not at all when nobody does.

The page opens a websocket to `/live`. The server sends it JSON: the phase, and where `picture` is
true the facts of one frame, after which the JPEG of that frame comes. The page sends JSON:

| message | what happens |
| --- | --- |
| `{"command": "picture"}` | the next picture is sent; two can be asked for at a time |
| `{"command": C, "token": T}` | the tracker is told, C being one of COMMANDS; `{"refused": WHY}` \
comes back where it is not |

Pictures are asked for rather than pushed, so who is slow gets the newest one and skips the others.
Commands need a token that nothing but the printed address carries: other users of the machine may
watch, no more. It stands after `#`, which a browser keeps to itself.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from toftrack.compute.threads import small_operations
from toftrack.errors import ToftrackError, check_number
from toftrack.frames.estimate import Estimate, is_vacant, state_words
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.lines import hand_content, strict
from toftrack.output.web.server import ANY_PORT, Client, WebServer, request_of, wait
from toftrack.views.base import COMMANDS, TrackedFrame, View
from toftrack.views.overlay import caption_px, draw_tracked

_SHOWN = (
    *("lost", "score", "confidence", "gesture", "gesture_probability", "pinch", "pinching"),
    *("side", "side_probability"),
)
"""Fields of each hand that the page writes."""
_RATE_S = 2.0
"""The frames a second are those of so long."""
_MOST_COMMANDS = 16
_MOST_ASKED = 2
"""Pictures that a page can ask for at a time: one is on its way, the next one being drawn."""
_MOST_WAITING = 8
"""Messages to a page that does not read them."""


class BrowserView(View):
    """The live page, served from construction until `close`.

    Its address is printed on standard error. Where there is a last frame that could be missed, a
    first visitor is waited for. The settings: conf/view/browser.yaml; `live` is for the devices
    alone, which follow it. Raises ToftrackError: a bad setting, or it cannot be served there.
    """

    def __init__(
        self,
        folder: str | Path,
        fps: float,
        frames: int | None = None,
        *,
        host: str,
        port: int,
        quality: int,
        most_fps: float,
        wait_s: float,
        linger_s: float,
        live: bool,
    ) -> None:
        check_number("view.port", port, 0, 65535, whole=True, remedy=ANY_PORT)
        check_number("view.quality", quality, 1, 100, whole=True)
        check_number("view.most_fps", most_fps, 0, above=True)
        for name, seconds in (("wait_s", wait_s), ("linger_s", linger_s)):
            if seconds != math.inf:
                check_number(f"view.{name}", seconds, 0, remedy=" seconds, or inf")
        self._quality, self._least_s, self._linger_s = quality, 1 / most_fps, linger_s
        self._newest: tuple[TrackedFrame, float] | None = None
        """The newest moment, and when the device gave it."""
        self._times_s: deque[float] = deque(maxlen=200)
        self.asked: deque[str] = deque(maxlen=_MOST_COMMANDS)
        """The visitors' commands; the oldest are forgotten when nobody fetches them."""
        self._visited = threading.Event()
        # What follows belongs to the server's thread.
        self._work = asyncio.Event()
        self._phase, self._facts, self._arrived_s = "starting", dict[str, Any](), math.nan
        self.jpeg, self.version = b"", 0
        """The picture, and how many there were before it."""
        self.token = secrets.token_urlsafe(12)
        """What commands must carry."""
        self._server = WebServer(
            *("view", host, port, "toftrack.views.browser", {"/": "page.html"}, "/live"),
            lambda: _Visitor(self),
        )
        self._drawing = self._server.begin(self._draw_all())
        self.url = self._server.url
        """Where the page is; without its commands."""
        self.address = f"{self.url}#{self.token}"
        """Where it is with them."""
        print(f"live view: {self.address} (Ctrl-C ends)", file=sys.stderr, flush=True)
        if frames is not None and wait_s > 0:
            print(f"waiting up to {wait_s:g} s for it to be opened", file=sys.stderr, flush=True)
            try:
                wait(self._visited, wait_s)
            except BaseException:
                self.close()
                raise

    def show(self, tracked: TrackedFrame) -> None:
        """Leave the moment for those who watch; returns at once. Raises what went wrong when the
        last one was drawn.
        """
        if self._drawing.done():
            self._drawing.result()
        if (amplitude := tracked.frame.amplitude) is not None:
            # Drawn later, when the device may have used its memory for the next frame.
            tracked = replace(tracked, frame=replace(tracked.frame, amplitude=np.array(amplitude)))
        now_s, took_s = time.perf_counter(), tracked.hands[0].estimate.compute_s
        self._times_s.append(now_s)
        self._newest = tracked, now_s - (took_s if math.isfinite(took_s) else 0.0)
        self._phase = "live"
        if self._server.clients:
            self._server.call(self._work.set)

    def commands(self) -> Sequence[str]:
        """What the visitors asked for since the last call."""
        return [self.asked.popleft() for _ in range(len(self.asked))]

    def close(self) -> None:
        """End the page and its thread; a second call does nothing."""
        self._end("stopped")
        self._server.close()

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Close; after an ordinary end the page stays for a while, until Ctrl-C at the longest."""
        try:
            if kind is None:
                self._end("over")
                self._linger()
        finally:
            self.close()

    def _end(self, phase: str) -> None:
        """Tell the visitors why there are no more frames, unless they know."""
        if self._phase in ("over", "stopped"):
            return
        self._phase = phase

        def tell() -> None:
            for visitor in self._server.clients:
                visitor.tell(self.facts())

        self._server.call(tell)

    def _linger(self) -> None:
        if self._linger_s == 0:
            return
        for_ever = math.isinf(self._linger_s)
        how_long = "until Ctrl-C" if for_ever else f"for {self._linger_s:g} s (Ctrl-C ends it)"
        print(f"that was the last frame; the page stays {how_long}", file=sys.stderr, flush=True)
        with suppress(KeyboardInterrupt):  # everything was done by then
            wait(threading.Event(), self._linger_s)

    def facts(self, picture: bool = False) -> dict[str, Any]:
        """What the page is told: the phase, and of a `picture`, which follows, its frame."""
        told = {"phase": self._phase, "picture": picture}
        if not picture:
            return told
        age_ms = round(1e3 * (time.perf_counter() - self._arrived_s), 1)
        return told | self._facts | {"age_ms": age_ms}

    def wanted(self) -> None:
        """A visitor waits for a picture."""
        self._visited.set()
        self._work.set()

    async def _draw_all(self) -> None:
        drawn, loop = None, asyncio.get_running_loop()
        while True:
            await self._newer_than(drawn, asked_for=True)
            # Then the next moment to come: the tracker is between two frames just then, and
            # drawing takes no time from it. None may come any more, so not for long.
            with suppress(TimeoutError):
                async with asyncio.timeout(self._least_s):
                    await self._newer_than(self._newest, asked_for=False)
            began, drawn = loop.time(), self._newest
            assert drawn is not None
            tracked, arrived_s = drawn
            self.jpeg = await asyncio.to_thread(_encode, tracked, self._quality)
            self._arrived_s = arrived_s
            self._facts = _facts(tracked) | {"fps": _rate(list(self._times_s))}
            self.version += 1
            for visitor in self._server.clients:
                visitor.news.set()
            await asyncio.sleep(began + self._least_s - loop.time())

    async def _newer_than(self, moment: object, asked_for: bool) -> None:
        """Wait until there is another moment, which somebody waits for if it is to be asked for."""
        clients = self._server.clients
        while self._newest is moment or (asked_for and not any(v.asked for v in clients)):
            self._work.clear()
            await self._work.wait()


class _Visitor(Client):
    def __init__(self, view: BrowserView) -> None:
        super().__init__(_MOST_WAITING)
        self._view = view
        self.asked, self._version = 0, 0
        """Pictures that the page waits for; the last one that it got."""
        self.tell(view.facts())

    def take(self) -> str | bytes | None:
        view = self._view
        if not self._messages and self.asked and view.version > self._version:
            self.asked, self._version = self.asked - 1, view.version
            self.tell(view.facts(picture=True), view.jpeg)
        return super().take()

    def receive(self, message: str | bytes) -> None:
        content, allowed = request_of(message, self._view.token)
        command = content.get("command")
        if command == "picture":
            self.asked = min(self.asked + 1, _MOST_ASKED)
            self.news.set()
            self._view.wanted()
        elif command not in COMMANDS:
            self.tell({"refused": f"a command is one of {', '.join(COMMANDS)}"})
        elif not allowed:
            self.tell({"refused": "commands need the whole address that the tracker printed"})
        else:
            self._view.asked.append(command)


def _encode(tracked: TrackedFrame, quality: int) -> bytes:
    # The page writes larger and sharper what the caption says.
    with small_operations():
        panel = draw_tracked(tracked)[caption_px(len(tracked.hands)) :]
    done, jpeg = cv2.imencode(".jpg", panel, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ToftrackError("the picture cannot be encoded as JPEG; choose view=none")
    return jpeg.tobytes()


def _facts(tracked: TrackedFrame) -> dict[str, Any]:
    """What the page writes beside the picture, JSON-able: of the frame and of each slot's hand.

    The frame is lost when no hand can be used, and its state is the first slot's.
    """
    first = tracked.estimates[0]
    return {
        "index": int(first.index),
        "ms": strict(1e3 * first.compute_s),
        "dropped": tracked.dropped,
        "advice": list(tracked.advice),
        "told": tracked.told,
        "state": state_words(first),
        "lost": all(estimate.lost for estimate in tracked.estimates),
        "hands": [_hand_facts(estimate) for estimate in tracked.estimates],
    }


def _hand_facts(estimate: Estimate) -> dict[str, Any]:
    doubted = [JOINT_NAMES[joint] for joint in np.flatnonzero(~estimate.joint_ok)]
    state = {"there": not is_vacant(estimate), "state": state_words(estimate)}
    return state | {"doubted": doubted} | hand_content(estimate, _SHOWN)


def _rate(times_s: Sequence[float]) -> float | None:
    """Frames a second; None while there are too few to tell."""
    recent = [t for t in times_s if t > times_s[-1] - _RATE_S]
    span_s = recent[-1] - recent[0]
    return round((len(recent) - 1) / span_s, 1) if span_s > 0 else None
