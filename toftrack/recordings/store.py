"""A recording of any kind behind one face: `.npz`, `.srs`, a folder of images, a ROS bag, ..."""

from __future__ import annotations

import difflib
from contextlib import AbstractContextManager
from importlib import resources
from pathlib import Path

from toftrack.configuration.plugins import installed, named_object
from toftrack.errors import ToftrackError
from toftrack.recordings.bag_names import is_bag
from toftrack.recordings.bare import NOTHING_GIVEN, BareFacts, read_npy
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.npz import read_recording
from toftrack.recordings.png_folder import read_png_folder
from toftrack.recordings.rosbag import read_rosbag
from toftrack.recordings.sr_frame import DEFAULT_MODULATION_MHZ
from toftrack.recordings.srs import read_srs
from toftrack.recordings.video import VIDEOS, read_video

_BY_OPENNI = (
    "write its depth out as 16-bit PNG images by OpenNI, put a camera.json beside them "
    "(docs/formats.md) and give the folder"
)
_BY_IMAGES = "export its depth frames as 16-bit PNG images or .npy, and convert those"
_BY_NUMBERS = "save the depth images as 16-bit PNG, numbered, and give their folder"
_BY_ARRAY = "save its depth as .npy (frames, rows, columns), and convert that"
_BY_POINTS = "points have lost the image that they came from; give the depth images themselves"
FIRST_SAMPLE = "right_hand"
SAMPLES = (FIRST_SAMPLE, "left_hand", "two_hands", "point_and_pinch", "glass")
"""The recordings that come with the package; toftrack/data/README.md says what they show."""
ELSEWHERE = {
    ".oni": _BY_OPENNI,
    ".xef": _BY_IMAGES,
    ".rrf": _BY_IMAGES,
    ".ply": _BY_POINTS,
    ".pcd": _BY_POINTS,
    ".png": "a recording is the folder that the images lie in; give that",
    ".tif": _BY_NUMBERS,
    ".tiff": _BY_NUMBERS,
    ".h5": _BY_ARRAY,
    ".hdf5": _BY_ARRAY,
    ".raw": "say what it is: read it with numpy, save .npy (frames, rows, columns), convert that",
}
"""What to do with files of other kinds."""


def open_recording(
    path: str | Path,
    camera_file: str | Path | None = None,
    modulation_mhz: int = DEFAULT_MODULATION_MHZ,
    topic: str | None = None,
    bare: BareFacts = NOTHING_GIVEN,
) -> FrameStore:
    """Open a recording, whose kind follows from its name. Only `.npz` is loaded as a whole.

    path: `.npz`, `.srs`, a folder of PNG images, a ROS bag (`.bag`, `.mcap`, `.db3`, a folder with
    metadata.yaml), a video (`.mkv` of an Azure Kinect, 16-bit FFV1), `.npy`, or
    of a suffix that an installed package reads (docs/extending.md).  camera_file, bare: of what has
    no camera of its own, and says nothing of itself.  modulation_mhz: tells the range of a `.srs`
    that does not state it.  topic: of a ROS bag that has several of depth images. Raises
    ToftrackError: it cannot be used; one sentence that names it.
    """
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    if is_bag(path):
        return read_rosbag(path, topic, camera_file, bare.unit_m)
    if topic is not None:
        raise ToftrackError(f"'{path}' is no ROS bag, and has no topic {topic}; leave it out")
    if path.is_dir():
        return read_png_folder(path, camera_file, bare)
    if suffix == ".srs":
        return read_srs(path, modulation_mhz)
    if suffix == ".npy":
        return read_npy(path, camera_file, bare)
    if suffix in VIDEOS:
        return read_video(path, camera_file, bare)
    if suffix != ".npz" and suffix[1:] in (others := installed("recordings")):
        read = named_object(others[suffix[1:]].value, f"the installed reader of {suffix}")
        return read(path)
    if suffix in ELSEWHERE:
        raise ToftrackError(f"'{path}' is not read: {ELSEWHERE[suffix]}")
    return read_recording(path)


def open_source(name: str) -> FrameStore:
    """What a virtual camera sees: the packaged recording for `sample`, else as `open_recording`."""
    return open_sample() if name == "sample" else open_recording(name)


def open_sample(name: str = FIRST_SAMPLE) -> FrameStore:
    """A recording that comes with the package, by its name; see `packaged_sample`."""
    with packaged_sample(name) as path:
        return open_recording(path)


def packaged_sample(name: str = FIRST_SAMPLE) -> AbstractContextManager[Path]:
    """A recording that comes with the package, as a file while the context is open. Raises
    ToftrackError when there is none of that name; it lists those that there are.
    """
    return resources.as_file(resources.files("toftrack") / "data" / sample_file(name))


def sample_file(name: str) -> str:
    """The file's name of a sample, in toftrack/data. Raises ToftrackError when there is none."""
    if name not in SAMPLES:
        near = difflib.get_close_matches(str(name), SAMPLES, 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ToftrackError(
            f"there is no sample '{name}' (device.name); there are {', '.join(SAMPLES)}{meant}"
        )
    return "sample.npz" if name == FIRST_SAMPLE else f"sample_{name}.npz"
