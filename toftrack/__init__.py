"""toftrack: a tracker of a human hand in depth images.

For a program of one's own:

    import toftrack

    for estimate in toftrack.track("hand.npz", "hands=2"):
        print(estimate)

or, of images of one's own:

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
    from toftrack.api import make_device as make_device
    from toftrack.api import make_hands_tracker as make_hands_tracker
    from toftrack.api import make_tracker as make_tracker
    from toftrack.devices.base import BaseDevice as BaseDevice
    from toftrack.devices.pushed import PushDevice as PushDevice
    from toftrack.errors import ToftrackError as ToftrackError
    from toftrack.frames.camera import Camera as Camera
    from toftrack.frames.estimate import Estimate as Estimate
    from toftrack.frames.frame import Frame as Frame
    from toftrack.hand.openxr import OPENXR_JOINT_NAMES as OPENXR_JOINT_NAMES
    from toftrack.hand.skeleton import ANGLE_NAMES as ANGLE_NAMES
    from toftrack.hand.skeleton import JOINT_NAMES as JOINT_NAMES
    from toftrack.output.results import read_results as read_results
    from toftrack.output.run_folder import Run as Run
    from toftrack.output.run_folder import read_run as read_run
    from toftrack.programs.in_python import Results as Results
    from toftrack.programs.in_python import Tracking as Tracking
    from toftrack.programs.in_python import track as track
    from toftrack.tracking.tracker import HandsTracker as HandsTracker
    from toftrack.tracking.tracker import Tracker as Tracker
    from toftrack.views.overlay import draw as draw

    __version__: str

# Imported when they are first asked for: torch takes seconds, and not every program needs it.
_MODULES = {
    "api": "make_device make_hands_tracker make_tracker",
    "devices.base": "BaseDevice",
    "devices.pushed": "PushDevice",
    "errors": "ToftrackError",
    "frames.camera": "Camera",
    "frames.estimate": "Estimate",
    "frames.frame": "Frame",
    "hand.openxr": "OPENXR_JOINT_NAMES",
    "hand.skeleton": "ANGLE_NAMES JOINT_NAMES",
    "output.results": "read_results",
    "output.run_folder": "Run read_run",
    "programs.in_python": "Results Tracking track",
    "tracking.tracker": "HandsTracker Tracker",
    "views.overlay": "draw",
}
_PLACES = {name: f"toftrack.{at}" for at, names in _MODULES.items() for name in names.split()}

if not TYPE_CHECKING:  # checkers would take any name for one of ours, and find none in `import *`
    __all__ = sorted((*_PLACES, "__version__"))

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            from importlib.metadata import version

            value = version("toftrack")
        elif name in _PLACES:
            value = getattr(import_module(_PLACES[name]), name)
        else:
            raise AttributeError(f"module 'toftrack' has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return __all__  # and not our own imports
