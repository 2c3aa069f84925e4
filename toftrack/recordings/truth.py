"""Ground truth as it lies in the arrays and the metadata of a recording, see npz.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames import Truth

_JOINTS = 21
_FIELDS = ("joints_m", "visible", "in_space", "visible_fraction", "joint_visible", "pose_name")
_FIRST = {name: name for name in _FIELDS}
"""What fields of Truth are called in a file."""
_OTHER = {name: f"{name}2" for name in _FIELDS} | {"joints_m": "joints2_m"}
"""Those of the other hand."""
TRUTH_KEYS = (*_FIRST.values(), *_OTHER.values())


def truth_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """The arrays of a file; sides and rests belong into its metadata."""
    arrays: dict[str, np.ndarray] = {}
    for keys, hand in ((_FIRST, truth), (_OTHER, truth.other)):
        values = {key: getattr(hand, name, None) for name, key in keys.items()}
        arrays |= {key: value for key, value in values.items() if value is not None}
    return arrays


def read_truth(arrays: dict[str, Any], count: int, metadata: dict[str, Any]) -> Truth | None:
    """The truth of `count` frames; None where a file has none.

    Sides and rests are read from the metadata where it has them: `side` (or `handedness`) and
    `side2`, and `still`, the first and the last frame of each rest of the first hand.

    Raises ToftrackError, a sentence about a key, when an array cannot be meant.
    """
    first = _truth_of_one(arrays, count, _FIRST)
    if first is None:
        return None
    other = _truth_of_one(arrays, count, _OTHER)
    if other is not None:
        other = replace(other, side=_side(metadata, "side2"))
    side = _side(metadata, "side") or _side(metadata, "handedness")
    return replace(first, other=other, side=side, still=_still(metadata.get("still"), count))


def of_shape(arrays: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A numeric or boolean array of the given shape."""
    array = arrays[key]
    if array.dtype.kind not in "biuf":
        raise ToftrackError(f"'{key}' must consist of numbers, but is {array.dtype}")
    return _shaped(array, key, shape)


def _shaped(array: np.ndarray, key: str, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape:
        raise ToftrackError(
            f"'{key}' must have the shape {shape} (the first is the number of frames), but has "
            f"{array.shape}"
        )
    return array


def _truth_of_one(arrays: dict[str, Any], count: int, keys: dict[str, str]) -> Truth | None:
    """Of one hand.  keys: what the fields are called."""
    if keys["joints_m"] not in arrays:
        return None
    joints = of_shape(arrays, keys["joints_m"], (count, _JOINTS, 3)).astype(np.float32)
    if not np.isfinite(joints).all():
        name = keys["joints_m"]
        raise ToftrackError(f"'{name}' contains NaN or infinity; leave it out or repair it")

    def flags(name: str, shape: tuple[int, ...]) -> np.ndarray | None:
        key = keys[name]
        return of_shape(arrays, key, shape).astype(bool) if key in arrays else None

    visible, in_space = flags("visible", (count,)), flags("in_space", (count,))
    fraction = None
    if keys["visible_fraction"] in arrays:
        fraction = of_shape(arrays, keys["visible_fraction"], (count,)).astype(np.float32)
    return Truth(
        joints_m=joints,
        visible=np.ones(count, bool) if visible is None else visible,
        in_space=np.ones(count, bool) if in_space is None else in_space,
        visible_fraction=fraction,
        joint_visible=flags("joint_visible", (count, _JOINTS)),
        pose_name=_names(arrays, keys["pose_name"], count),
    )


def _names(arrays: dict[str, Any], key: str, count: int) -> np.ndarray | None:
    """(T,) text."""
    if key not in arrays:
        return None
    array = arrays[key]
    if array.dtype.kind not in "US":
        raise ToftrackError(f"'{key}' must be text, but is {array.dtype}")
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    return _shaped(array, key, (count,))


def _side(metadata: dict[str, Any], key: str) -> str:
    side = metadata.get(key)
    return side if side in ("right", "left") else ""


def _still(rests: Any, count: int) -> np.ndarray | None:
    """(T,) bool of [[first, last], ...]; None where there is none, or nothing of that kind."""
    still = np.zeros(count, bool)
    for rest in rests if isinstance(rests, list) else ():
        if isinstance(rest, list) and len(rest) == 2 and all(type(end) is int for end in rest):
            still[max(rest[0], 0) : max(rest[1] + 1, 0)] = True
    return still if still.any() else None
