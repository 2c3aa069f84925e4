"""The picture of the rooms is that of the code."""

from __future__ import annotations

import sys

from helpers.tracking import ROOT

sys.path.insert(0, str(ROOT / "docs"))
from make_rooms import PICTURE, imports, layers, picture


def test_the_picture_of_the_rooms_is_of_this_code() -> None:
    assert PICTURE.read_text() == picture(), "make it anew: python docs/make_rooms.py"


def test_a_room_is_drawn_above_what_it_imports() -> None:
    order = [room for row in layers() for room in row]
    assert set(imports("tracking")) >= {"detector", "render", "refinement"}
    for place, room in enumerate(order):
        assert all(order.index(name) > place for name in imports(room) if name in order), room
