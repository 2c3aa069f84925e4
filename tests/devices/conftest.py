"""What holds after every test of a device."""

import threading
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterator[None]:
    yield
    assert not [t for t in threading.enumerate() if t.name == "sr3000-reader"]
