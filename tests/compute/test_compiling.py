"""Compiling a kernel is announced if it takes long, and where its code cannot be kept."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import pytest

from toftrack.compute import compiling
from toftrack.compute.compiling import announced, entry_point


@pytest.mark.parametrize(("silent_s", "told"), [(0.0, ["compiling"]), (1000.0, [])])
def test_only_what_takes_long_is_announced(
    silent_s: float,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(compiling, "_SILENT_S", silent_s)
    caplog.set_level(logging.INFO)
    with announced("compiling"):
        deadline = time.monotonic() + 20
        while len(caplog.messages) < len(told) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert caplog.messages == told


def test_without_a_place_for_the_code_what_to_do_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def njit(cache: bool = False, **options: object) -> Callable:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr(compiling.numba, "njit", njit)
    monkeypatch.setattr(compiling, "_SILENT_S", 0.0)
    monkeypatch.setattr(compiling, "_uncached", threading.Event())
    monkeypatch.setattr(compiling, "_told", threading.Event())
    caplog.set_level(logging.INFO)

    def kernel() -> int:
        return 7

    assert entry_point()(kernel)() == 7
    for number, lines in enumerate((2, 3)):
        with announced(f"compiling {number} (once, about 6 s)"):
            deadline = time.monotonic() + 20
            while len(caplog.messages) < lines and time.monotonic() < deadline:
                time.sleep(0.01)
    assert [message for message in caplog.messages if "NUMBA_CACHE_DIR" not in message] == [
        "compiling 0 (in every run, about 6 s)",
        "compiling 1 (in every run, about 6 s)",
    ]
    assert len(caplog.messages) == 3
