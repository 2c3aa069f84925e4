"""JSON of others: whatever Python makes of it, what cannot be meant is a ValueError."""

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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # the mark, as of Windows' editors
def test_a_file_is_utf8_whatever_the_locale_is(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.json").write_text('{"é": [-2.5e3, true, null, 12345678901234567]}', encoding)
    assert read_json(tmp_path / "a.json") == {"é": [-2500.0, True, None, 12345678901234567]}


def test_a_file_that_is_too_large_is_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_text, "MOST_BYTES", 2**20)
    path = tmp_path / "large.json"
    path.write_text("1" + " " * 2**20)
    with pytest.raises(ValueError, match="larger than 1 MB"):
        read_json(path)
