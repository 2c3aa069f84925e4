"""Labels of points in the making: which frames to label, and a file that grows click by click."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.evaluation.image_labels import Points, parsed_labels
from toftrack.hand.skeleton import FINGERS
from toftrack.json_text import read_json
from toftrack.safe_files import write_whole

TIPS = tuple(f"{finger}_tip" for finger in FINGERS)
KNUCKLES = tuple(f"{finger}_mcp" for finger in FINGERS)
LABELLED = (*TIPS, *KNUCKLES, "wrist")
"""The joints that are asked for, in this order."""
_CONVENTIONS = (
    "pixels of the undistorted image, centres at whole numbers; frames by their number in the "
    "recording; tips 5 mm inside the end of the finger"
)


def chosen_frames(
    count: int,
    wanted: int,
    given: Collection[int] = (),
    confidence: np.ndarray | None = None,
) -> list[int]:
    """Numbers of frames to label, rising: those given, and others until there are `wanted`.

    Args:
        count: frames of the recording.
        given: frames that are in the labels already.
        confidence: (count,) of each frame: the least confident ones are taken, apart from each
            other where there are enough. None: evenly spaced ones.
    """
    chosen, wanted = set(given), min(wanted, count)
    if confidence is None and not chosen:
        return sorted({int((part + 0.5) * count / wanted) for part in range(wanted)})
    if confidence is None:
        away = np.abs(np.arange(count)[:, None] - np.array(sorted(chosen))).min(1)
        while len(chosen) < wanted:
            farthest = int(away.argmax())
            chosen.add(farthest)
            away = np.minimum(away, np.abs(np.arange(count) - farthest))
        return sorted(chosen)
    apart = count // (2 * wanted)
    while len(chosen) < wanted:
        for number in np.argsort(confidence, kind="stable").tolist():
            if len(chosen) < wanted and all(abs(number - one) > apart for one in chosen):
                chosen.add(number)
        apart //= 2
    return sorted(chosen)


class LabelFile:
    """Labels of a recording's frames; every change is in the file when its call returns.

    A file that is there is continued: what it holds stays, also what is not known here. None is
    made before the side is known.

    Args:
        path: the file.
        recording: name of the recording's file.
        size: width and height of its images, pixels.
        count: how many frames it has.
        side: "right" or "left"; None = as the file says, or not known yet.

    Raises:
        ToftrackError: the file is not of this recording and side, or cannot be read or written.
    """

    def __init__(
        self, path: str | Path, recording: str, size: tuple[int, int], count: int, side: str | None
    ) -> None:
        self.path, self._size = Path(path).expanduser(), size
        if self.path.exists():
            self.content = self._continued(recording, count, side)
        else:
            self.content = {
                "recording": recording,
                "conventions": _CONVENTIONS,
                "side": side,
                "image_size": list(size),
                "frames": {},
            }

    @property
    def frames(self) -> dict[str, dict[str, Any]]:
        """By number, as text: `points` by joint, each (u, v, flag), and perhaps `gesture`."""
        found: dict[str, dict[str, Any]] = self.content["frames"]
        return found

    def numbers(self) -> list[int]:
        """The frames that are labelled, or are to be."""
        return sorted(map(int, self.frames))

    def labelled(self) -> int:
        """How many frames have a visible fingertip, which is what is measured."""
        return sum(
            any(frame["points"].get(tip, (0, 0, ""))[2] == "visible" for tip in TIPS)
            for frame in self.frames.values()
        )

    def begin(self, numbers: Collection[int]) -> None:
        """Take up frames, with nothing in them unless they are there."""
        for number in numbers:
            self.frames.setdefault(str(number), {"points": {}})
        self.save()

    def set_side(self, side: object) -> None:
        """Say whose hand it is; ValueError for what is no side."""
        if side not in ("right", "left"):
            raise ValueError("the side is right or left")
        self.content["side"] = side
        self.save()

    def set_gesture(self, number: object, name: object) -> None:
        """Name a frame's gesture, None takes it back; ValueError for a frame not taken up."""
        frame = self._frame(number)
        if not (name is None or (isinstance(name, str) and len(name) < 100)):
            raise ValueError("a gesture is a short name")
        frame.pop("gesture", None)
        if name is not None:
            frame["gesture"] = name
        self.save()

    def set_point(self, number: object, joint: object, point: object) -> None:
        """Set a joint, or with None take it back.

        point: [u, v, "visible" or "guessed"] in pixels, or [None, None, "absent"].

        Raises ValueError for what is none of these, or before the side is known.
        """
        points = self._frame(number)["points"]
        if self.content["side"] is None:
            raise ValueError("say first whether it is a right or a left hand")
        if joint not in LABELLED:
            raise ValueError("there is no such joint to label")
        if point is None:
            points.pop(joint, None)
        else:
            points[joint] = self._checked(point)
        self.save()

    def save(self) -> None:
        """Write the file as a whole; ToftrackError where it cannot be."""
        if self.content["side"] is None:
            return
        frames = {number: self.frames[number] for number in map(str, self.numbers())}
        text = json.dumps(self.content | {"frames": frames}, indent=1, allow_nan=False)
        with reported_errors(
            f"the labels '{self.path}' cannot be written", "give another --output"
        ):
            write_whole(self.path, text + "\n")

    def _frame(self, number: object) -> dict[str, Any]:
        if str(number) not in self.frames:
            raise ValueError("that frame is not to be labelled")
        return self.frames[str(number)]

    def _checked(self, point: object) -> list[Any]:
        if not isinstance(point, list) or len(point) != 3:
            raise ValueError("a point is [u, v, flag]")
        u, v, flag = point
        if [u, v, flag] == [None, None, "absent"]:
            return [u, v, flag]
        number = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (u, v))
        inside = number and all(
            -0.5 <= one <= most - 0.5 for one, most in zip((u, v), self._size, strict=True)
        )
        if not inside or flag not in ("visible", "guessed"):
            raise ValueError("a point is visible or guessed, and within the image")
        return [round(float(u), 2), round(float(v), 2), flag]

    def _continued(self, recording: str, count: int, side: str | None) -> dict[str, Any]:
        with reported_errors(
            f"the labels '{self.path}' cannot be read", "give another --output", OSError, ValueError
        ):
            content = read_json(self.path)
        known = parsed_labels(self.path, content, begun=True)
        of = content.get("recording", recording)
        if not isinstance(known, Points):
            why = "of stills, not of points"
        elif known.size != self._size or max(known.frames, default=0) >= count or of != recording:
            why = f"of another recording than '{recording}'"
        elif side not in (None, known.side):
            why = f"of a {known.side} hand"
        else:
            loaded: dict[str, Any] = content
            return loaded
        raise ToftrackError(f"the labels '{self.path}' are {why}; give another --output")
