"""A browser, for the pages and videos that are made for one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.chromium import headless_chromium


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator:
    """Headless Chromium under WebDriver."""
    with headless_chromium(tmp_path / "profile") as driver:
        yield driver
