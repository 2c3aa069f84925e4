"""Recordings as plain `.npz` archives: arrays and text, never pickled objects.

| key | shape, type | required |
| --- | --- | --- |
| `depth_m` or `radial_m` | (T, H, W) float16 or float32, metres, 0 = no reading | one of them |
| `K` | (3, 3) float, pixels | yes |
| `amplitude` | (T, H, W) uint16 | no |
| `fps` | scalar | no: from the time stamps, else 25 |
| `timestamp_s` | (T,) float64 | no: from `fps` |
| `distortion` | (4, 5, 8, 12 or 14,) float, OpenCV's k1 k2 p1 p2 k3 ... | no: zeros |
| `joints_m` | (T, 21, 3) float | no |
| `visible`, `in_space` | (T,) bool | no: true |
| `visible_fraction`, `joint_visible` | (T,) float, (T, 21) bool | no |
| `metadata` | text, a JSON object | no |

Unknown keys are ignored.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.frames import LARGEST_MEDIAN_M, Truth

DEFAULT_FPS = 25.0
_JOINTS = 21
# Of zip's usual method; nothing shrinks to less than a 1032th.
_MOST_COMPRESSION = 1032


@dataclass(frozen=True, eq=False)
class Recording:
    """What a camera saw, as it lies in the file: depth keeps the file's type."""

    depth: np.ndarray
    """(T, H, W) float16 or float32 metres."""
    radial: bool
    """True: `depth` is the distance along each pixel's ray; False: Z along the optical axis."""
    camera: Camera
    timestamp_s: np.ndarray
    """(T,) float64, not decreasing."""
    fps: float
    amplitude: np.ndarray | None = None
    """(T, H, W) uint16."""
    truth: Truth | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.depth)

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """A frame's depth, (H, W) float32 metres, a new array, and its amplitude, (H, W) uint16."""
        amplitude = None if self.amplitude is None else self.amplitude[index]
        return self.depth[index].astype(np.float32), amplitude

    def close(self) -> None:
        """Nothing to close: the file was read as a whole."""


def read_recording(path: str | Path) -> Recording:
    """Read and check a recording.

    Raises ToftrackError, one sentence that names the file, when it is missing, damaged, contains
    pickled objects or breaks the format above.
    """
    path = Path(path).expanduser()
    arrays = _read_members(path)
    try:
        return _parse(arrays)
    except ToftrackError as error:
        raise ToftrackError(f"the recording '{path}' cannot be used: {error}") from None


def write_recording(path: str | Path, recording: Recording) -> None:
    """Write a recording, compressed; an existing file is replaced only by a complete one.

    Depth keeps its type (float16 or float32). A depth polynomial has no place in the format: save
    the camera beside the recording. Raises ToftrackError when the file cannot be written.
    """
    path = Path(path)
    arrays: dict[str, Any] = {
        "radial_m" if recording.radial else "depth_m": recording.depth,
        "K": recording.camera.K,
        "distortion": recording.camera.distortion,
        "timestamp_s": np.asarray(recording.timestamp_s, np.float64),
        "fps": np.float64(recording.fps),
        "metadata": json.dumps(recording.metadata),
    }
    if recording.amplitude is not None:
        arrays["amplitude"] = recording.amplitude
    if recording.truth is not None:
        truth = {name: getattr(recording.truth, name) for name in Truth.__dataclass_fields__}
        arrays.update({name: value for name, value in truth.items() if value is not None})
    partial = path.with_name(path.name + ".part")
    try:
        with open(partial, "wb") as stream:
            np.savez_compressed(stream, **arrays)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise ToftrackError(
            f"the recording '{path}' cannot be written ({error.strerror}); choose another place"
        ) from error


_KEYS = (
    "depth_m",
    "radial_m",
    "K",
    "amplitude",
    "fps",
    "timestamp_s",
    "distortion",
    "joints_m",
    "visible",
    "in_space",
    "visible_fraction",
    "joint_visible",
    "metadata",
)


def _read_members(path: Path) -> dict[str, np.ndarray]:
    """The known arrays of the archive; every way in which a file can be broken ends here."""
    if path.is_dir():
        raise ToftrackError(f"'{path}' is a directory; give the path of a recording (.npz)")
    try:
        if not zipfile.is_zipfile(path):
            if not path.exists():
                raise ToftrackError(
                    f"there is no file '{path}'; give the path of a recording (.npz)"
                )
            with open(path, "rb") as stream:  # tells "unreadable" from "not an archive"
                stream.read(1)
            raise ToftrackError(
                f"'{path}' is not an .npz archive, or it was cut off; give a recording as "
                "numpy.savez writes it"
            )
        with zipfile.ZipFile(path) as archive:
            return _read_archive(path, archive)
    except OSError as error:
        raise ToftrackError(
            f"the recording '{path}' cannot be read ({error.strerror or error}); check the file "
            "and its permissions"
        ) from error
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        # RuntimeError covers encrypted members and unknown compressions (NotImplementedError).
        raise ToftrackError(
            f"the recording '{path}' is damaged ({error}); copy or record it again"
        ) from error


def _read_archive(path: Path, archive: zipfile.ZipFile) -> dict[str, np.ndarray]:
    members = [name for name in archive.namelist() if name.endswith(".npy")]
    for name in members:
        _check_size(archive, name)
        # Also of unknown keys, before anything is used: a file that carries objects is not ours.
        if _holds_objects(archive, name):
            raise ToftrackError(
                f"the recording '{path}' contains pickled objects in '{name[:-4]}', which are "
                "refused because they can run code; save plain arrays and text only"
            )
    arrays = {}
    for key in _KEYS:
        if f"{key}.npy" in members:
            with archive.open(f"{key}.npy") as stream:
                arrays[key] = np.lib.format.read_array(stream, allow_pickle=False)
    return arrays


def _holds_objects(archive: zipfile.ZipFile, name: str) -> bool:
    with archive.open(name) as stream:
        return _header(stream)[1].hasobject


def _check_size(archive: zipfile.ZipFile, name: str) -> None:
    """ValueError where a damaged header claims more than there is: memory must not go after it."""
    info = archive.getinfo(name)
    with archive.open(name) as stream:
        shape, kind = _header(stream)
    if not kind.hasobject and math.prod(shape) * kind.itemsize > info.file_size:
        raise ValueError(f"'{name[:-4]}' is smaller than its header says")
    if info.file_size > _MOST_COMPRESSION * info.compress_size + 1024:
        raise ValueError(f"'{name[:-4]}' cannot be as large as the archive says")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(stream)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, kind = read_header(stream)
    return shape, kind


def _parse(arrays: dict[str, np.ndarray]) -> Recording:
    depth_key = "depth_m" if "depth_m" in arrays else "radial_m"
    if depth_key not in arrays:
        raise ToftrackError("the required key 'depth_m' is missing; add it (or 'radial_m')")
    if "K" not in arrays:
        raise ToftrackError("the required key 'K' (3x3 camera matrix, pixels) is missing; add it")
    depth = _check_depth(arrays[depth_key], depth_key)
    count, height, width = depth.shape
    camera = Camera(arrays["K"], width, height, arrays.get("distortion", np.zeros(5)))
    timestamp_s, fps = _times(arrays, count)
    return Recording(
        depth=depth,
        radial=depth_key == "radial_m",
        camera=camera,
        timestamp_s=timestamp_s,
        fps=fps,
        amplitude=_amplitude(arrays, depth.shape),
        truth=_truth(arrays, count),
        metadata=_metadata(arrays),
    )


def _check_depth(depth: np.ndarray, key: str) -> np.ndarray:
    if depth.ndim != 3:
        raise ToftrackError(
            f"'{key}' must have 3 dimensions (frames, rows, columns), but has {depth.ndim}, shape "
            f"{depth.shape}"
        )
    if np.issubdtype(depth.dtype, np.integer):
        raise ToftrackError(
            f"'{key}' consists of whole numbers ({depth.dtype}), which looks like millimetres, but "
            f"must be float metres; convert with {key} = depth.astype('float32') / 1000"
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise ToftrackError(f"'{key}' must be float32 or float16 metres, but is {depth.dtype}")
    if len(depth) == 0:
        raise ToftrackError(f"'{key}' has zero frames; record at least one")
    if depth.size == 0:
        raise ToftrackError(f"the images of '{key}' are empty, shape {depth.shape}")
    # A median of a few frames decides; all of a long recording would only take longer.
    some = depth[np.unique(np.linspace(0, len(depth) - 1, 16).astype(int))]
    readings = some[(some > 0) & (some < np.inf)]
    median = float(np.median(readings.astype(np.float32))) if readings.size else 0.0
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of '{key}' is {median:.0f}, which is plainly millimetres, but it must be "
            f"metres; convert with {key} = depth / 1000"
        )
    if depth.dtype.newbyteorder("=") in (np.float16, np.float32):
        return depth
    return depth.astype(np.float32)


def _of_shape(arrays: dict[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A numeric or boolean array of the given shape."""
    array = arrays[key]
    if array.dtype.kind not in "biuf":
        raise ToftrackError(f"'{key}' must consist of numbers, but is {array.dtype}")
    if array.shape != shape:
        raise ToftrackError(
            f"'{key}' must have the shape {shape} (the first is the number of frames), but has "
            f"{array.shape}"
        )
    return array


def _times(arrays: dict[str, np.ndarray], count: int) -> tuple[np.ndarray, float]:
    fps = None
    if "fps" in arrays:
        if arrays["fps"].size != 1 or arrays["fps"].dtype.kind not in "iuf":
            raise ToftrackError("'fps' must be one number")
        fps = float(arrays["fps"].reshape(()))
        if not (np.isfinite(fps) and fps > 0):
            raise ToftrackError(f"'fps' must be a positive number, but is {fps:g}")
    if "timestamp_s" not in arrays:
        fps = DEFAULT_FPS if fps is None else fps
        return np.arange(count) / fps, fps
    timestamp_s = _of_shape(arrays, "timestamp_s", (count,)).astype(np.float64)
    steps = np.diff(timestamp_s)
    if not np.isfinite(timestamp_s).all() or (steps < 0).any():
        raise ToftrackError("'timestamp_s' must be finite and must not go backwards")
    if len(steps) and np.median(steps) > 0:
        fps = 1.0 / float(np.median(steps))
    return timestamp_s, DEFAULT_FPS if fps is None else fps


def _amplitude(arrays: dict[str, np.ndarray], shape: tuple[int, ...]) -> np.ndarray | None:
    if "amplitude" not in arrays:
        return None
    amplitude = _of_shape(arrays, "amplitude", shape)
    if amplitude.dtype.kind not in "iu":
        raise ToftrackError(f"'amplitude' must be uint16, but is {amplitude.dtype}")
    if amplitude.dtype == np.uint16:
        return amplitude
    return np.clip(amplitude, 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _truth(arrays: dict[str, np.ndarray], count: int) -> Truth | None:
    if "joints_m" not in arrays:
        return None
    joints = _of_shape(arrays, "joints_m", (count, _JOINTS, 3)).astype(np.float32)
    if not np.isfinite(joints).all():
        raise ToftrackError("'joints_m' contains NaN or infinity; leave it out or repair it")

    def flags(key: str, shape: tuple[int, ...]) -> np.ndarray | None:
        return _of_shape(arrays, key, shape).astype(bool) if key in arrays else None

    visible, in_space = flags("visible", (count,)), flags("in_space", (count,))
    fraction = None
    if "visible_fraction" in arrays:
        fraction = _of_shape(arrays, "visible_fraction", (count,)).astype(np.float32)
    return Truth(
        joints_m=joints,
        visible=np.ones(count, bool) if visible is None else visible,
        in_space=np.ones(count, bool) if in_space is None else in_space,
        visible_fraction=fraction,
        joint_visible=flags("joint_visible", (count, _JOINTS)),
    )


def _metadata(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    if "metadata" not in arrays:
        return {}
    array = arrays["metadata"]
    if array.size == 1 and array.dtype.kind in "US":
        text = array.reshape(()).item()
        try:
            metadata = json.loads(text)
        except ValueError:
            metadata = None
        if isinstance(metadata, dict):
            return metadata
    raise ToftrackError("'metadata' must be the text of one JSON object")
