"""`view=browser`: what the tracker sees, live on a page that it serves itself.

The tracker only leaves the newest moment here. A thread of its own draws it and makes a JPEG of it,
once for all who watch and not at all when nobody does.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2

from toftrack.compute.threads import small_operations
from toftrack.errors import ToftrackError
from toftrack.estimate import is_vacant, state_words
from toftrack.views.base import TrackedFrame, TrackedHand
from toftrack.views.browser.server import BrowserServer, News
from toftrack.views.overlay import CAPTION_PX, draw_tracked

_STILL_WATCHED_S = 1.0
"""Drawing goes on for so long after the last request, so that pictures are ready for the next."""
_RATE_S = 2.0
"""The frames a second are those of so long."""
_MOST_COMMANDS = 16
_GOODBYE_S = 0.3
"""For the page to fetch the news that the tracker was stopped."""


def browser_view(
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
) -> BrowserView:
    """Serve the page, say on standard error where it is, and wait for a first visitor.

    Only where there is a last frame that could be missed is a visitor waited for.

    Args:
        folder: nothing is written into it.
        fps: not needed.
        frames: how many there are to come; None = no end is known.
        host: address of the network interface.
        port: 0 = any free one.
        quality: of the JPEGs, 1 to 100.
        most_fps: pictures a second at most.
        wait_s: seconds to wait for the first visitor; 0 = do not.
        linger_s: seconds the page stays after the last frame, inf = until Ctrl-C.
        live: nothing to the view; recordings' `realtime` and the sample's `repeat` follow it in the
            configuration.

    Raises:
        ToftrackError: a bad setting, or the page cannot be served there.
    """
    _check(port, quality, most_fps, wait_s, linger_s)
    view = BrowserView(host, port, quality, most_fps, linger_s)
    print(f"live view: {view.address} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if frames is not None and wait_s > 0:
        print(f"waiting up to {wait_s:g} s for it to be opened", file=sys.stderr, flush=True)
        try:
            view.wait_for_visitor(wait_s)
        except BaseException:
            view.close()
            raise
    return view


class BrowserView:
    """The live page, as a view. See `browser_view`, which makes it, for arguments and errors."""

    def __init__(
        self, host: str, port: int, quality: int, most_fps: float, linger_s: float
    ) -> None:
        self._picture = LivePicture(quality, most_fps)
        self._linger_s = linger_s
        try:
            self._server = BrowserServer(self._picture, host, port)
        except BaseException:
            self._picture.close()
            raise
        self.url = self._server.url
        """Where the page is; without its commands."""
        self.address = f"{self.url}#{self._server.token}"
        """Where it is with them."""

    def wait_for_visitor(self, timeout_s: float) -> bool:
        """Wait until somebody has opened the page; False when nobody did in time."""
        return self._picture.visited.wait(min(timeout_s, threading.TIMEOUT_MAX))

    def show(self, tracked: TrackedFrame) -> None:
        """Leave the moment for those who watch; returns at once."""
        self._picture.put(tracked)

    def commands(self) -> Sequence[str]:
        """What the visitors asked for since the last call."""
        return self._picture.commands()

    def close(self) -> None:
        """End the page and its threads; a second call does nothing."""
        self._picture.set_phase("stopped")
        self._server.close()
        self._picture.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close; after an ordinary end the page stays for a while, until Ctrl-C at the longest."""
        try:
            if kind is None:
                self._picture.set_phase("over")
                self._linger()
            elif self._picture.watched:
                self._picture.set_phase("stopped")
                time.sleep(_GOODBYE_S)
        finally:
            self.close()

    def _linger(self) -> None:
        if self._linger_s == 0:
            return
        for_ever = math.isinf(self._linger_s)
        how_long = "until Ctrl-C" if for_ever else f"for {self._linger_s:g} s (Ctrl-C ends it)"
        print(f"that was the last frame; the page stays {how_long}", file=sys.stderr, flush=True)
        try:
            _stay(self._linger_s)
        except KeyboardInterrupt:
            pass  # everything was done by then


class LivePicture:
    """The newest moment as a picture for any number of visitors, drawn by a thread of its own.

    quality: of the JPEGs, 1 to 100.  most_fps: pictures a second at most.
    """

    def __init__(self, quality: int, most_fps: float) -> None:
        self.visited = threading.Event()
        """Somebody has asked for news."""
        self._quality, self._least_s = quality, 1 / most_fps
        self._lock = threading.Lock()
        self._work = threading.Condition(self._lock)  # the drawing thread waits for it
        self._news = threading.Condition(self._lock)  # visitors wait for it
        self._tracked: TrackedFrame | None = None
        self._times_s: deque[float] = deque(maxlen=200)
        self._undrawn, self._closed = False, False
        self._phase, self._version = "starting", 0
        self._jpeg, self._jpeg_version, self._facts = b"", 0, dict[str, Any]()
        self._waiting, self._asked_s = 0, -math.inf
        self._newest_s = self._arrived_s = time.monotonic()  # when the device gave the frame
        self._commands: deque[str] = deque(maxlen=_MOST_COMMANDS)
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._draw_all, name="browser-drawing", daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """Somebody waits for news, or asked a moment ago."""
        return self._waiting > 0 or time.monotonic() - self._asked_s < _STILL_WATCHED_S

    def put(self, tracked: TrackedFrame) -> None:
        """Make a moment the newest one; raises what went wrong when the last one was drawn."""
        with self._lock:
            if self._error is not None:
                raise self._error
            self._tracked, self._undrawn, self._phase = tracked, True, "live"
            now_s, took_s = time.monotonic(), tracked.hands[0].estimate.compute_s
            self._newest_s = now_s - (took_s if math.isfinite(took_s) else 0.0)
            self._times_s.append(now_s)
            self._work.notify()

    def set_phase(self, phase: str) -> None:
        """Tell the visitors: 'starting', 'live', 'over' or 'stopped'; the last two are final."""
        with self._lock:
            if self._phase not in ("over", "stopped"):
                self._phase = phase
                self._version += 1
                self._news.notify_all()

    def after(self, version: int, wait_s: float) -> News:
        """What is newer than a version; waits for it, but no longer than `wait_s`."""
        self.visited.set()
        with self._lock:
            self._waiting += 1
            self._work.notify()
            try:
                self._news.wait_for(lambda: self._version > version or self._closed, wait_s)
            finally:
                self._waiting -= 1
                self._asked_s = time.monotonic()
            jpeg = self._jpeg if self._jpeg_version > version else None
            age = {"age_ms": round(1e3 * (time.monotonic() - self._arrived_s), 1)}
            return News(self._version, jpeg, {"phase": self._phase} | self._facts | age)

    def ask(self, command: str) -> None:
        """Keep a visitor's command; the oldest are forgotten when nobody fetches them."""
        with self._lock:
            self._commands.append(command)

    def commands(self) -> list[str]:
        """The commands since the last call, in order."""
        with self._lock:
            commands = list(self._commands)
            self._commands.clear()
        return commands

    def close(self) -> None:
        """End the drawing thread and let nobody wait any longer."""
        with self._lock:
            self._closed = True
            self._work.notify_all()
            self._news.notify_all()
        self._thread.join()

    def _draw_all(self) -> None:
        with small_operations():
            while (tracked := self._next()) is not None:
                began, arrived_s = time.monotonic(), self._newest_s
                try:
                    jpeg = _encode(tracked, self._quality)
                except Exception as error:  # the tracker's thread raises it
                    with self._lock:
                        self._error = error
                    return
                self._publish(tracked, jpeg, arrived_s)
                with self._lock:
                    rest = began + self._least_s - time.monotonic()
                    self._work.wait_for(lambda: self._closed, max(0.0, rest))
                    # Then the next moment to come: the tracker is between two frames just then, and
                    # drawing takes no time from it. None may come any more, so not for long.
                    self._undrawn, before = False, self._undrawn
                    self._work.wait_for(lambda: self._closed or self._undrawn, self._least_s)
                    self._undrawn |= before

    def _next(self) -> TrackedFrame | None:
        """Wait for a moment that somebody wants to see; None at the end."""
        with self._lock:
            self._work.wait_for(lambda: self._closed or (self._undrawn and self.watched))
            self._undrawn = False
            return None if self._closed else self._tracked

    def _publish(self, tracked: TrackedFrame, jpeg: bytes, arrived_s: float) -> None:
        with self._lock:
            self._arrived_s = arrived_s
            self._version += 1
            self._jpeg, self._jpeg_version = jpeg, self._version
            self._facts = _facts(tracked) | {"fps": _rate(self._times_s)}
            self._news.notify_all()


def _stay(seconds: float) -> None:
    threading.Event().wait(min(seconds, threading.TIMEOUT_MAX))


def _encode(tracked: TrackedFrame, quality: int) -> bytes:
    # The page writes larger and sharper what the caption says.
    panel = draw_tracked(tracked)[CAPTION_PX:]
    done, jpeg = cv2.imencode(".jpg", panel, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ToftrackError("the picture cannot be encoded as JPEG; choose view=none")
    return jpeg.tobytes()


def _facts(tracked: TrackedFrame) -> dict[str, Any]:
    """What the page writes beside the picture, JSON-able: of the frame and of a hand, or `hands`.

    Of two hands the frame is lost when neither can be used, and its state is the first slot's.
    """
    first = tracked.hands[0]
    of_frame = {
        "index": int(first.estimate.index),
        "ms": _number(1e3 * first.estimate.compute_s),
        "advice": list(tracked.advice),
    }
    if len(tracked.hands) == 1:
        side = {"side": first.shape.side, "side_given": tracked.side_given}
        return of_frame | _hand_facts(first) | side
    return of_frame | {
        "state": state_words(first.estimate),
        "lost": all(estimate.lost for estimate in tracked.estimates),
        "hands": [_hand_facts(hand) for hand in tracked.hands],
    }


def _hand_facts(hand: TrackedHand) -> dict[str, Any]:
    estimate = hand.estimate
    return {
        "there": not is_vacant(estimate),
        "state": state_words(estimate),
        "lost": bool(estimate.lost),
        "score": _number(estimate.score),
        "confidence": _number(estimate.confidence),
        "gesture": estimate.gesture,
        "gesture_probability": _number(estimate.gesture_probability),
        "pinch": _number(estimate.pinch),
        "pinching": bool(estimate.pinching),
        "side": estimate.side,
        "side_probability": _number(estimate.side_probability),
    }


def _number(value: float) -> float | None:
    return round(float(value), 6) if math.isfinite(value) else None


def _rate(times_s: Sequence[float]) -> float | None:
    """Frames a second; None while there are too few to tell."""
    recent = [t for t in times_s if t > times_s[-1] - _RATE_S]
    span_s = recent[-1] - recent[0]
    return round((len(recent) - 1) / span_s, 1) if span_s > 0 else None


def _check(port: int, quality: int, most_fps: float, wait_s: float, linger_s: float) -> None:
    def whole(value: object, low: int, high: int) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high

    def number(value: object) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and value >= 0

    for name, value, right, wanted in (
        ("port", port, whole(port, 0, 65535), "a whole number from 0 (any free one) to 65535"),
        ("quality", quality, whole(quality, 1, 100), "a whole number from 1 to 100"),
        (
            "most_fps",
            most_fps,
            number(most_fps) and 0 < most_fps < math.inf,
            "a number above 0",
        ),
        ("wait_s", wait_s, number(wait_s), "a number of seconds, 0 or above"),
        ("linger_s", linger_s, number(linger_s), "a number of seconds, 0 or above, or inf"),
    ):
        if not right:
            raise ToftrackError(f"view.{name}={value} is not possible; give {wanted}")
