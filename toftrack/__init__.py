"""toftrack: a tracker of a human hand in depth images.

For a program of one's own:

    import toftrack

    tracker = toftrack.make_tracker("hand.side=left")
    estimate = tracker.step(depth_m, K)
    estimate.joints_m

    toftrack.draw(depth_m, estimate, K)  # a picture
    toftrack.read_run("outputs/...").arrays["joints_m"]  # of a finished run

or, of several hands, here two:

    tracker = toftrack.make_hands_tracker("hands=2")
    for estimate in tracker.step(depth_m, K):
        if not estimate.lost:
            estimate.side, estimate.joints_m

The names in `__all__` are stable. Everything else is private and may change with any version.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toftrack.api import make_device, make_hands_tracker, make_tracker
    from toftrack.camera import Camera
    from toftrack.devices.base import BaseDevice
    from toftrack.errors import ToftrackError
    from toftrack.estimate import Estimate
    from toftrack.frames import Frame
    from toftrack.hand.openxr import OPENXR_JOINT_NAMES
    from toftrack.hand.skeleton import ANGLE_NAMES, JOINT_NAMES
    from toftrack.output.results import read_results
    from toftrack.output.run_folder import Run, read_run
    from toftrack.tracking.tracker import HandsTracker, Tracker
    from toftrack.views.overlay import draw

    __version__: str

# Imported when they are first asked for: torch takes seconds, and not every program needs it.
_PLACES = {
    "ANGLE_NAMES": "toftrack.hand.skeleton",
    "BaseDevice": "toftrack.devices.base",
    "Camera": "toftrack.camera",
    "Estimate": "toftrack.estimate",
    "Frame": "toftrack.frames",
    "JOINT_NAMES": "toftrack.hand.skeleton",
    "OPENXR_JOINT_NAMES": "toftrack.hand.openxr",
    "Run": "toftrack.output.run_folder",
    "ToftrackError": "toftrack.errors",
    "HandsTracker": "toftrack.tracking.tracker",
    "Tracker": "toftrack.tracking.tracker",
    "draw": "toftrack.views.overlay",
    "make_device": "toftrack.api",
    "make_hands_tracker": "toftrack.api",
    "make_tracker": "toftrack.api",
    "read_results": "toftrack.output.results",
    "read_run": "toftrack.output.run_folder",
}

__all__ = [
    "ANGLE_NAMES",
    "BaseDevice",
    "Camera",
    "Estimate",
    "Frame",
    "HandsTracker",
    "JOINT_NAMES",
    "OPENXR_JOINT_NAMES",
    "Run",
    "ToftrackError",
    "Tracker",
    "__version__",
    "draw",
    "make_device",
    "make_hands_tracker",
    "make_tracker",
    "read_results",
    "read_run",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("toftrack")
    elif name in _PLACES:
        value = getattr(import_module(_PLACES[name]), name)
    else:
        raise AttributeError(f"module 'toftrack' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
