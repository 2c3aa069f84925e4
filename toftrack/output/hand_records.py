"""The hands of a line of track.jsonl or a stream, whether it speaks of one or of several."""

from __future__ import annotations

from typing import Any


def hands_of(line: dict[str, Any]) -> list[dict[str, Any]]:
    """A record for each hand, with what the line says of the frame as a whole.

    A line has either the fields of its one hand, or `hands`, a list with those of each.
    """
    if "hands" not in line:
        return [line]
    frame = {name: value for name, value in line.items() if name != "hands"}
    return [frame | hand for hand in line["hands"]]
