"""What an emulated SR3000 can be told to do wrong, when, and what comes over the wire then."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.recordings.sr_frame import FRAME_BYTES

PACKET_BYTES = 512
"""Of a bulk endpoint at high speed."""
_PACKETS = FRAME_BYTES // PACKET_BYTES

OPEN_FAULTS = {
    "missing": "no camera is plugged in",
    "permission": "the user may not open it",
    "busy": "another program has claimed it",
}
"""Faults of the attempts to open the camera, numbered from 0."""

REQUEST_FAULTS = {
    "timeout": "no frame comes",
    "late": "the frame comes when nobody waits for it any more",
    "refuse": "the request itself is stalled",
    "stall": "the endpoint stalls until it is cleared",
    "io_error": "an error of the bus",
    "overflow": "more data in a packet than fit",
    "short": "the frame ends in the middle of a packet",
    "cut": "the frame ends behind a whole packet, without a word",
    "empty": "a transfer of no bytes",
    "long": "bytes behind the frame",
    "split": "the frame comes in two transfers, cut behind a packet, a later one each time",
    "garbage": "random bytes, as many as a frame has",
    "zeros": "all 0",
    "ones": "all 0xFFFF",
    "unplug_before": "unplugged when the frame is asked for",
    "unplug_during": "unplugged within the frame",
    "unplug_after": "unplugged right behind the frame",
}
"""Faults of the requests for a frame, numbered from 0."""

HARMLESS = {"split", "garbage", "zeros", "ones", "unplug_after"}
"""A whole frame comes nevertheless."""


@dataclass(frozen=True)
class Fault:
    """A fault of `count` attempts or requests in a row, the first of them number `first`."""

    kind: str
    first: int = 0
    count: int | None = None
    """None = all that follow."""

    def hits(self, number: int) -> bool:
        """Whether this attempt or request goes wrong."""
        return self.first <= number and (self.count is None or number < self.first + self.count)


@dataclass(eq=False)
class Chunk:
    """A piece of what waits at the bulk IN endpoint."""

    ready_s: float
    """On the monotonic clock."""
    data: memoryview = memoryview(b"")
    ends: bool = False
    """The transfer ends behind it."""
    error: int | None = None
    """Instead of data: the errno of a failed transfer."""


def transfer(
    fault: str | None, data: bytes, ready_s: float, split: int, random: np.random.Generator
) -> list[Chunk]:
    """What comes over the wire for a frame at `ready_s`.

    fault: one of REQUEST_FAULTS under which something comes, or None.  split: how many frames came
    in two transfers so far.  random: of the garbage.
    """
    whole = memoryview(data)
    if fault == "overflow":
        return [Chunk(ready_s, error=errno.EOVERFLOW)]
    if fault == "short":
        return [Chunk(ready_s, whole[:50_001], ends=True)]
    if fault == "cut":
        return [Chunk(ready_s, whole[: 99 * PACKET_BYTES])]
    if fault == "empty":
        return [Chunk(ready_s, ends=True)]
    if fault == "long":
        return [Chunk(ready_s, memoryview(data + b"\xa5" * 700), ends=True)]
    if fault == "split":
        at = (1 + split % (_PACKETS - 1)) * PACKET_BYTES
        return [Chunk(ready_s, whole[:at], ends=True), Chunk(ready_s, whole[at:])]
    if fault in ("unplug_during", "unplug_after"):
        came = whole[: 50 * PACKET_BYTES] if fault == "unplug_during" else whole
        return [Chunk(ready_s, came), Chunk(ready_s, error=errno.ENODEV)]
    if fault == "garbage":
        whole = memoryview(random.bytes(FRAME_BYTES))
    elif fault in ("zeros", "ones"):
        whole = memoryview((b"\0" if fault == "zeros" else b"\xff") * FRAME_BYTES)
    return [Chunk(ready_s, whole)]


def parse_faults(texts: Iterable[str]) -> tuple[Fault, ...]:
    """Faults written as KIND (always), KIND@7 (once), KIND@7x3 (thrice) or KIND@7+ (from then on);
    ToftrackError for an unknown kind or another form.
    """
    faults = []
    for text in map(str, texts):
        match = re.fullmatch(r"([a-z_]+)(?:@(\d+)(\+|x(\d+))?)?", text)
        if match is None or match[1] not in OPEN_FAULTS | REQUEST_FAULTS:
            raise ToftrackError(
                f"device.emulated.faults: '{text}' is unknown; give KIND, KIND@7, KIND@7x3 or "
                f"KIND@7+, where KIND is one of {', '.join(OPEN_FAULTS | REQUEST_FAULTS)}"
            )
        kind, first, rest, count = match.groups()
        always = first is None or rest == "+"
        faults.append(Fault(kind, int(first or 0), None if always else int(count or 1)))
    return tuple(faults)


@dataclass(frozen=True)
class EmulatorSettings:
    """What the virtual camera does; see conf/device/sr3000.yaml."""

    source: str
    fps: float | None
    loop: bool
    faults: tuple[str, ...]
    fault_every: int
    replug_s: float
    late_s: float
    serials: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "faults", tuple(self.faults))
        object.__setattr__(self, "serials", tuple(map(str, self.serials)))
        parse_faults(self.faults)
        if (self.fps is not None and not self.fps > 0) or self.fault_every < 0:
            raise ToftrackError(
                "device.emulated needs fps above 0 and fault_every of 0 or more, but they are "
                f"{self.fps} and {self.fault_every}"
            )
