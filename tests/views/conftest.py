"""A browser, for the pages and videos that are made for one."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from helpers.browsing import made
from helpers.chromium import headless_chromium

from toftrack.views.browser.view import BrowserView


@pytest.fixture
def view() -> Iterator[BrowserView]:
    """A live page without frames yet."""
    with closing(made()) as view:
        yield view


@pytest.fixture(scope="session")
def _one_chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with headless_chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture
def chromium(_one_chromium: Any) -> Iterator[Any]:
    """Headless Chromium under WebDriver, with an empty page and console."""
    _one_chromium.get_log("browser")
    yield _one_chromium
    _one_chromium.get("data:,")
    _one_chromium.set_window_size(1200, 900)
    _one_chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
