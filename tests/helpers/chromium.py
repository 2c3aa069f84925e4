"""A browser, for the pages and videos that are made for one, and what a page shows in it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
DRIVER = shutil.which("chromedriver")
DRAWS_IN_3D = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""WebGL without a graphics card."""
_PATIENCE_S = 30


@contextmanager
def headless_chromium(profile: Path, *graphics: str) -> Iterator[Any]:
    """Headless Chromium under WebDriver; the test is skipped where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install '.[browser-test]'")
    if not (CHROMIUM and DRIVER):
        pytest.skip("needs chromium and chromedriver (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        "--headless",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--autoplay-policy=no-user-gesture-required",
        f"--user-data-dir={profile}",
        "--window-size=1200,900",
        *(graphics or ("--disable-gpu",)),
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


def shown(browser: Any, reported: str, send: Callable[[], None]) -> Any:
    """Send until the page says something true in JavaScript, which is returned."""
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        send()
        if value := browser.execute_script(f"return {reported}"):
            return value
        assert time.monotonic() < deadline, reported
        time.sleep(0.02)


def picture(browser: Any) -> np.ndarray:
    """(H, W) bool: where something is drawn, between the page's words."""
    data = np.frombuffer(browser.get_screenshot_as_png(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int)[60:-60]
    return np.ptp(image, axis=2) > 25  # skin is coloured, the ground is not
