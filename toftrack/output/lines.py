"""Estimates as lines of track.jsonl, and what each field is in the arrays of track.npz.

Both follow from the fields of Estimate: a new one is in the files by itself, and files without
it are read no more.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.files.json_text import parse_json
from toftrack.files.safe_files import open_to_read
from toftrack.frames.estimate import Estimate, is_vacant

_KINDS: dict[type, type] = {
    bool: np.bool_,
    int: np.int64,
    float: np.float32,
    str: np.str_,
    np.ndarray: np.float32,
}
_EXACT: dict[str, type] = {"timestamp_s": np.float64, "joint_ok": np.bool_}
"""Fields of another type than their kind's."""
_LONGEST = 2**24
"""Bytes of a line: more are what some file systems leave of one when the power is cut."""
_OF_RUN = ("image_size_px",)
"""What a line says of its frame, and track.npz once."""
_HINTS = get_type_hints(Estimate)
KINDS: dict[str, type] = {
    field.name: _EXACT.get(field.name, _KINDS[_HINTS[field.name]])
    for field in fields(Estimate)
    if field.name not in _OF_RUN
}
"""Of what type each field is in track.npz; arrays have their shape behind the frames' axis."""
_FIRST = (
    *("index", "timestamp_s", "state_name", "lost", "confidence", "outside_rad", "side"),
    *("side_probability", "score"),
)
LINE_FIELDS = (*_FIRST, *(name for name in KINDS if name not in _FIRST), *_OF_RUN)
"""What a line of track.jsonl says, fields of Estimate, in their order."""
FRAME_FIELDS = ("index", "timestamp_s", "compute_s", *_OF_RUN)
"""What is said of a frame, not of each hand in it."""
DROPPED = "dropped"
"""The array of track.npz that says which frames a live run did not track, and what their
`state_name` is; they have no line, and their numbers are missing among those of the lines."""
HAND_FIELDS = tuple(name for name in LINE_FIELDS if name not in FRAME_FIELDS)
SHAPES: dict[str, tuple[int, ...]] = {
    "joints_m": (21, 3),
    "state": (27,),
    "joint_ok": (21,),
    **{name: () for name in KINDS if _HINTS[name] is not np.ndarray},
}
"""Of the fields of a hand whose shape does not depend on the run."""


def json_line(estimates: Sequence[Estimate], names: Sequence[str] = LINE_FIELDS) -> str:
    """A frame's estimates, one a slot, as one line of strict JSON, without newline, with some of
    LINE_FIELDS, in this order.
    """
    content = line_content(estimates, names)
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def line_content(
    estimates: Sequence[Estimate], names: Sequence[str] = LINE_FIELDS
) -> dict[str, Any]:
    """What a line says: of one slot its fields; of several the frame's, and `hands`, those that are
    there, each with its slot and its side.
    """
    if len(estimates) == 1:
        return hand_content(estimates[0], names)
    of_frame = hand_content(estimates[0], [name for name in names if name in FRAME_FIELDS])
    of_hand = ["side", *(name for name in names if name in HAND_FIELDS and name != "side")]
    hands = [
        {"slot": slot} | hand_content(estimate, of_hand)
        for slot, estimate in enumerate(estimates)
        if not is_vacant(estimate)
    ]
    return of_frame | {"hands": hands}


def hands_of(line: dict[str, Any]) -> list[dict[str, Any]]:
    """A record for each hand of a line, with what the line says of the frame as a whole."""
    if "hands" not in line:
        return [line]
    frame = {name: value for name, value in line.items() if name != "hands"}
    return [frame | hand for hand in line["hands"]]


def hand_content(estimate: Estimate, names: Sequence[str]) -> dict[str, Any]:
    """Fields of one hand's estimate as strict JSON has them; NaN becomes None."""
    return {name: strict(getattr(estimate, name)) for name in names}


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of a track.jsonl as dicts; one at the end that was not finished is left out.

    Raises ToftrackError when another one is damaged, OSError when the file cannot be read.
    """
    with open_to_read(path) as stream:
        for number, line in enumerate(iter(lambda: stream.readline(_LONGEST), b""), 1):
            if not line.endswith(b"\n"):
                return  # the run was killed, or the machine went down, while it was written
            try:
                content = parse_json(line)
                if not isinstance(content, dict):
                    raise ValueError("it is no object")
            except ValueError as error:
                if not stream.read(1):
                    return  # the same, where the file system had given the line its room already
                raise damaged(path, number, error) from None
            yield content


def damaged(path: Path, number: int, error: object) -> ToftrackError:
    """What is said about a line that cannot be read."""
    return ToftrackError(
        f"line {number} of '{path}' is not a line of a run ({error}); take it out of the file, then"
        " try again"
    )


def strict(value: Any) -> Any:
    """`value` without what JSON cannot say: arrays become lists, NaN and infinity None."""
    if isinstance(value, dict):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return strict(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
