"""What the tests of pages in a browser share: what a page reports, and what it shows."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

PATIENCE_S = 30


def shown(browser: Any, reported: str, send: Callable[[], None]) -> Any:
    """Send until the page says something true in JavaScript, which is returned."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        send()
        if value := browser.execute_script(f"return {reported}"):
            return value
        assert time.monotonic() < deadline, reported
        time.sleep(0.02)


def picture(browser: Any) -> np.ndarray:
    """(H, W) bool: where something is drawn, between the page's words."""
    data = np.frombuffer(io.BytesIO(browser.get_screenshot_as_png()).read(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int)[60:-60]
    return np.ptp(image, axis=2) > 25  # skin is coloured, the ground is not
