"""Estimates as Open Sound Control: a bundle of messages a frame, by UDP.

The addresses and their arguments: docs/streams.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from toftrack.errors import check_choice, module_of_extra
from toftrack.frames.estimate import Estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.lines import hands_of, line_content
from toftrack.output.stream import UdpStream

_FIELDS = (
    *("index", "timestamp_s", "lost", "confidence", "side", "gesture", "gesture_probability"),
    *("pinch", "pinching", "pointing_origin_m", "pointing_direction", "joint_ok"),
)
_OPENXR = ("openxr_position_m", "openxr_orientation", "openxr_radius_m")
_PARTS = {
    "joints": ("joint", JOINT_NAMES, ("joints_m",)),
    "landmarks": ("landmark", JOINT_NAMES, ("landmarks",)),
    "openxr": ("openxr", OPENXR_JOINT_NAMES, _OPENXR),
}
"""What may be sent of a hand beside the rest: its address, the joints, and their fields."""

Message = tuple[str, list[tuple[str, Any]]]
"""An address, and arguments each with their OSC type."""


class OscStream(UdpStream):
    """A bundle a frame to one address, whether anybody listens there or not.

    The settings: conf/stream/osc.yaml. Raises ToftrackError where python-osc is not installed, for
    an unknown part, a host that cannot be found, or an impossible port.
    """

    def __init__(self, host: str, port: int, parts: Sequence[str]) -> None:
        super().__init__(host, port, None)
        self._parts = (parts,) if isinstance(parts, str) else tuple(parts)
        for part in self._parts:
            check_choice("stream.parts", part, tuple(_PARTS))
        self._bundles, self._messages = (
            module_of_extra(f"pythonosc.osc_{kind}_builder", "stream=osc needs python-osc", "osc")
            for kind in ("bundle", "message")
        )
        more = (name for part in self._parts for name in _PARTS[part][2])
        self._names = (*_FIELDS, *more)
        self._tracked: set[str] = set()

    def datagram(self, estimates: Sequence[Estimate]) -> bytes:
        """The bundle, to be acted upon at once."""
        bundle = self._bundles.OscBundleBuilder(self._bundles.IMMEDIATELY)
        line, numbered = line_content(estimates, self._names), len(estimates) > 2
        said = list(messages(line, self._parts, numbered))
        # Of a hand of which nothing is said any more, a receiver would hold the last word for ever.
        told = {address: bool(one[0][1]) for address, one in said if address.endswith("/tracked")}
        said += [(address, [("i", 0)]) for address in sorted(self._tracked - told.keys())]
        self._tracked = {address for address, tracked in told.items() if tracked}
        for address, arguments in said:
            message = self._messages.OscMessageBuilder(address)
            for kind, value in arguments:
                message.add_arg(value, kind)
            bundle.add_content(message.build())
        content: bytes = bundle.build().dgram
        return content


def messages(line: dict[str, Any], parts: Sequence[str], numbered: bool) -> Iterator[Message]:
    """What is said of a frame, in order; line: as in track.jsonl, of one hand or with `hands`.

    numbered: addresses have the slots' numbers, as of several persons some hands are of one side.
    """
    number = line["index"] % 2**31  # a camera's may be a clock's
    yield "/toftrack/frame", [("i", number), ("d", line["timestamp_s"])]
    for hand in hands_of(line):
        slot = f"_{hand['slot'] + 1}" if numbered else ""
        yield from _messages_of(hand, f"/toftrack/{hand['side'] or 'hand'}{slot}", parts)


def _messages_of(hand: dict[str, Any], root: str, parts: Sequence[str]) -> Iterator[Message]:
    tracked = not hand["lost"]
    yield f"{root}/tracked", [("i", int(tracked))]
    if not tracked:
        return
    if hand["confidence"] is not None:
        yield f"{root}/confidence", [("f", hand["confidence"])]
    yield f"{root}/joint_ok", [("i", int(ok)) for ok in hand["joint_ok"]]
    if hand["gesture"]:
        probability = hand["gesture_probability"]
        yield f"{root}/gesture", [("s", hand["gesture"]), ("f", probability)]
    # One that a joint's doubt has ended is told, too, or a receiver would hold it for ever.
    if hand["pinch"] is not None or not all(hand["joint_ok"]):
        yield f"{root}/pinch", [("f", hand["pinch"] or 0.0), ("i", int(hand["pinching"]))]
    yield from _floats(
        f"{root}/pointing", [*hand["pointing_origin_m"], *hand["pointing_direction"]]
    )
    for part, (name, joints, fields) in _PARTS.items():
        if part in parts:
            for joint, *row in zip(joints, *(hand[field] for field in fields), strict=True):
                yield from _floats(f"{root}/{name}/{joint}", np.hstack(row).tolist())


def _floats(address: str, values: Sequence[float | None]) -> Iterator[Message]:
    """A message of numbers, where all of them are known."""
    if all(value is not None and math.isfinite(value) for value in values):
        yield address, [("f", value) for value in values]
