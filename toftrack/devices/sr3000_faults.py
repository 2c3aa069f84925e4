"""What an emulated SR3000 can be told to do wrong, and when."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from toftrack.errors import ToftrackError

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


def parse_faults(texts: Iterable[str]) -> tuple[Fault, ...]:
    """Faults written as KIND (always), KIND@7 (once), KIND@7x3 (thrice) or KIND@7+ (from then on).

    Raises ToftrackError for an unknown kind or another form.
    """
    return tuple(_parse(str(text)) for text in texts)


def _parse(text: str) -> Fault:
    match = re.fullmatch(r"([a-z_]+)(?:@(\d+)(\+|x(\d+))?)?", text)
    if match is None or match[1] not in OPEN_FAULTS | REQUEST_FAULTS:
        raise ToftrackError(
            f"device.emulated.faults: '{text}' is unknown; give KIND, KIND@7, KIND@7x3 or KIND@7+, "
            f"where KIND is one of {', '.join(OPEN_FAULTS | REQUEST_FAULTS)}"
        )
    kind, first, rest, count = match.groups()
    if first is None or rest == "+":
        return Fault(kind, int(first or 0), None)
    return Fault(kind, int(first), int(count or 1))
