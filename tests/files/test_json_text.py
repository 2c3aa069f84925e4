"""JSON of others: whatever Python makes of it, what cannot be meant is a ValueError."""

from __future__ import annotations

from pathlib import Path

import pytest

from toftrack.errors import ToftrackError
from toftrack.files import json_text
from toftrack.files.json_text import parse_json, read_json
from toftrack.frames.camera import Camera
from toftrack.hand.shape import HandShape

HOSTILE = {
    "lists": ("[" * 100_000, "nested too deeply"),
    "objects": ('{"a":' * 100_000 + "1" + "}" * 100_000, "nested too deeply"),
    "digits": ("9" * 5000, "5000 digits"),
    "cut off": ('{"a": ', "Expecting value"),
}


@pytest.mark.parametrize(("text", "words"), HOSTILE.values(), ids=HOSTILE)
def test_what_cannot_be_meant_is_an_error(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        parse_json(text)
    (tmp_path / "hostile.json").write_text(text)
    for load in (Camera.load, HandShape.load):
        with pytest.raises(ToftrackError, match="hostile.json"):
            load(tmp_path / "hostile.json")


def test_the_mark_that_editors_of_windows_write_is_none_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": 1}', "utf-8-sig")
    assert read_json(tmp_path / "a.json") == {"a": 1}


def test_a_file_that_is_too_large_is_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_text, "MOST_BYTES", 2**20)
    path = tmp_path / "large.json"
    path.write_text("1" + " " * 2**20)
    with pytest.raises(ValueError, match="larger than 1 MB"):
        read_json(path)
