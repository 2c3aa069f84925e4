"""JSON: ours, and what others wrote, of which what cannot be meant is a ValueError."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from toftrack.files.safe_files import open_to_read, write_whole

MOST_BYTES = 2**26
"""No file of JSON here comes near 64 MB."""
_MOST_DIGITS = 30
"""Of a whole number; more cannot become a float, or take for ever."""


def parse_json(text: str | bytes) -> Any:
    """The content of a text; ValueError, a few words, for what is damaged or cannot be meant."""
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except MemoryError:
        raise ValueError("it needs more memory than there is") from None


def read_json(path: str | Path) -> Any:
    """The content of a file (UTF-8, which Windows marks); OSError, or ValueError as parse_json."""
    with open_to_read(path) as stream:
        text = stream.read(MOST_BYTES + 1)
    if len(text) > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES // 2**20} MB")
    return parse_json(text.decode("utf-8-sig"))


def read_object(path: str | Path) -> dict[str, Any]:
    """The object in a file; an empty one where the file cannot be read, or holds none."""
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def write_json(path: str | Path, content: Any, allow_nan: bool = True) -> None:
    """Write a file as `write_whole`, for people to read, too; OSError, or ValueError for a NaN."""
    write_whole(path, json.dumps(content, indent=1, allow_nan=allow_nan) + "\n")


def _whole(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a number has {len(digits)} digits")
    return int(digits)
