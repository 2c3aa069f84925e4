"""What the virtual SR3000 does."""

from __future__ import annotations

from dataclasses import dataclass

from toftrack.devices.sr3000.faults import parse_faults
from toftrack.errors import ToftrackError


@dataclass(frozen=True)
class EmulatorSettings:
    """What the virtual camera does; see conf/device/sr3000.yaml."""

    source: str
    """The recording that it sees: `sample`, or a file."""
    fps: float | None
    """Frames a second; None = the recording's own."""
    loop: bool
    """Begin again at the end; otherwise the stream ends there."""
    faults: tuple[str, ...]
    """See `toftrack.devices.sr3000.faults`."""
    fault_every: int
    """Each n-th request goes wrong, in all ways in turn; 0 = none."""
    replug_s: float
    """How long it stays unplugged."""
    late_s: float
    """How long after its time a late frame comes."""
    serials: tuple[str, ...]
    """Of the cameras that are plugged in."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "faults", tuple(self.faults))
        object.__setattr__(self, "serials", tuple(map(str, self.serials)))
        parse_faults(self.faults)
        if (self.fps is not None and not self.fps > 0) or self.fault_every < 0:
            raise ToftrackError(
                "device.emulated needs fps above 0 and fault_every of 0 or more, but they are "
                f"{self.fps} and {self.fault_every}"
            )
