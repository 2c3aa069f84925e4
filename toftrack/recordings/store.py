"""A recording of any kind behind one face: `.npz`, a folder of images, a ROS bag, a stack, ..."""

from __future__ import annotations

import difflib
import os
from importlib import resources
from pathlib import Path

from toftrack.configuration.plugins import installed, named_object
from toftrack.errors import ToftrackError
from toftrack.files.safe_files import open_to_read
from toftrack.recordings.bare import NOTHING_GIVEN, Given
from toftrack.recordings.frame_store import FrameStore, file_of, reading
from toftrack.recordings.image_folder import ImageFolder
from toftrack.recordings.npz import read_recording
from toftrack.recordings.rosbag import RosBag, is_bag
from toftrack.recordings.srs import SrsRecording
from toftrack.recordings.stacks import DATASETS, STACKS, Stack
from toftrack.recordings.video import VIDEOS, DepthVideo

_BY_OPENNI = (
    "write its depth out as 16-bit PNG images by OpenNI, put a camera.json beside them "
    "(docs/formats.md) and give the folder"
)
_BY_FOLDER = "a recording is the folder that the images lie in; give that"
_BY_NUMBERS = "save the depth images as 16-bit PNG, numbered, and give their folder"
_BY_ARRAY = "save its depth as .npy (frames, rows, columns), and give that"
_BY_PACKER = "unpack it, and give the folder or file that is in it; of archives .zip is read"
_BY_SDK = (
    "export its depth by the program that wrote it, as 16-bit PNG images, and give their folder"
)
_NO_DEPTH = "it holds no depth images; give the recording that it was made of"
_NO_OBJECTS = "it may hold objects that run code, and is never opened; " + _BY_ARRAY
_BY_POINTS = "points have lost the image that they came from; give the depth images themselves"
FIRST_SAMPLE = "right_hand"
SAMPLES = (FIRST_SAMPLE, "left_hand", "two_hands", "point_and_pinch", "glass")
"""The recordings that come with the package; toftrack/data/README.md says what they show."""
ELSEWHERE = {
    ".oni": _BY_OPENNI,
    ".ply": _BY_POINTS,
    ".pcd": _BY_POINTS,
    ".r3d": "export its depth from Record3D as EXR images, and give their folder",
    ".csv": "a table is no image; " + _BY_ARRAY,
    ".sens": "take its depth out by ScanNet's reader as 16-bit PNG images, and give their folder",
    ".part": "it is unfinished: toftrack recover FILE makes a recording of it",
    ".jsonl": "it is what a tracker found, not what a camera saw; give the recording",
    **dict.fromkeys((".svo", ".svo2", ".xed", ".vrs", ".dng", ".heic", ".rrd", ".ifs"), _BY_SDK),
    **dict.fromkeys((".xef", ".rrf", ".klg"), _BY_SDK),
    **dict.fromkeys((".png", ".exr"), _BY_FOLDER),
    **dict.fromkeys((".pgm", ".pfm", ".dpt", ".jp2", ".jxl"), _BY_NUMBERS),
    **dict.fromkeys((".raw", ".bin", ".dat", ".depth", ".zarr", ".parquet", ".txt"), _BY_ARRAY),
    **dict.fromkeys((".pkl", ".pickle", ".pt", ".pth", ".joblib"), _NO_OBJECTS),
    **dict.fromkeys((".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst"), _BY_PACKER),
    **dict.fromkeys((".zstd", ".lz4"), _BY_PACKER),
    **dict.fromkeys((".jpg", ".jpeg", ".bmp", ".webp", ".gif", ".json", ".yaml"), _NO_DEPTH),
    **dict.fromkeys((".glb", ".bvh", ".obj", ".stl", ".fbx", ".las", ".laz", ".e57"), _BY_POINTS),
}
"""What to do with files of other kinds."""
_READ = "a folder of images, .npz, .zip, .npy, .tif, .h5, .mat, .mkv, .avi, .bag, .mcap, .db3, .srs"


def open_recording(path: str | Path, given: Given = NOTHING_GIVEN) -> FrameStore:
    """Open a recording of a kind in docs/formats.md, or that an installed package reads, by its
    name, with the camera that is given, or its own. Large ones are read image by image where the
    format allows it. Raises ToftrackError: it cannot be used, or it says itself what is given; one
    sentence that names it.
    """
    store = open_with_own_camera(path, given)
    size = store.camera.width, store.camera.height
    if lens := given.camera(*size, f"'{path}'"):  # somebody's reader may compute its own
        store.camera = lens
    return store


def open_with_own_camera(path: str | Path, given: Given = NOTHING_GIVEN) -> FrameStore:
    """As `open_recording`, but the camera that is given does not go before its own."""
    store = _opened(path, given)
    told = ("unit_m", "--source-unit", store.unit_m), ("fps", "--fps", store.fps)
    for name, option, own in told:
        if getattr(given, name) not in (None, own):
            raise ToftrackError(
                f"'{path}' says its {name} itself; leave device.{name} (convert: {option}) out"
            )
    return store


def _opened(path: str | Path, given: Given) -> FrameStore:
    path = Path(os.path.expanduser(path))
    suffix = path.suffix.lower()
    with reading(path):  # too long a name
        is_folder = path.is_dir()
    if is_bag(path):
        return RosBag(path, given)
    if given.topic is not None:
        raise ToftrackError(f"'{path}' is no ROS bag, and has no topic {given.topic}; leave it out")
    if given.dataset is not None and suffix not in DATASETS:
        raise ToftrackError(f"'{path}' has no dataset {given.dataset}; leave device.dataset out")
    if is_folder or suffix == ".zip":
        return ImageFolder(path, given)
    if suffix == ".srs":
        return SrsRecording(path, given.modulation_mhz)
    if suffix in STACKS:
        return Stack(path, given)
    if suffix in VIDEOS:
        return DepthVideo(path, given)
    if suffix != ".npz" and suffix[1:] in (others := installed("recordings")):
        read = named_object(others[suffix[1:]].value, f"the installed reader of {suffix}")
        return read(path)
    if suffix in ELSEWHERE:
        raise ToftrackError(f"'{path}' is not read: {ELSEWHERE[suffix]}")
    if suffix != ".npz":
        with reading(file_of(path)), open_to_read(path) as stream:
            if stream.read(2) != b"PK":
                kind = f"that end with {suffix}" if suffix else "without an ending"
                raise ToftrackError(f"'{path}' is not read, nor are any files {kind}; give {_READ}")
    return read_recording(path, given)


def open_source(name: str) -> FrameStore:
    """What a virtual camera sees: the packaged recording for `sample`, else as `open_recording`."""
    return open_sample() if name == "sample" else open_recording(name)


def open_sample(name: str = FIRST_SAMPLE) -> FrameStore:
    """A recording that comes with the package, by its name. ToftrackError as `sample_file`."""
    with resources.as_file(resources.files("toftrack") / "data" / sample_file(name)) as path:
        return open_recording(path)


def sample_file(name: str) -> str:
    """The file's name of a sample, in toftrack/data; ToftrackError where there is none."""
    if name not in SAMPLES:
        near = difflib.get_close_matches(str(name), SAMPLES, 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ToftrackError(
            f"there is no sample '{name}' (device.name); there are {', '.join(SAMPLES)}{meant}"
        )
    return "sample.npz" if name == FIRST_SAMPLE else f"sample_{name}.npz"
