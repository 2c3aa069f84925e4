"""Recordings as plain `.npz` archives: arrays and text, never pickled objects.

| key | shape, type | required |
| --- | --- | --- |
| `depth_m` or `radial_m` | (T, H, W) float16 or float32, metres, 0 = no reading | one of them |
| `K` | (3, 3) float, pixels | yes |
| `amplitude` | (T, H, W) uint16 | no |
| `fps` | scalar | no: from the time stamps, else 25 |
| `timestamp_s` | (T,) float64 | no: from `fps` |
| `distortion` | (4, 5, 8, 12 or 14,) float, OpenCV's k1 k2 p1 p2 k3 ... | no: zeros |
| `lens` | text, `opencv` or `fisheye` | no: `opencv` |
| `depth_polynomial`, `depth_polynomial_range_m` | (n,), (2,) float, see `Camera` | no: none |
| `joints_m` | (T, 21, 3) float | no |
| `visible`, `in_space` | (T,) bool | no: true |
| `visible_fraction`, `joint_visible` | (T,) float, (T, 21) bool | no |
| `pose_name` | (T,) text | no |
| `joints2_m`, `visible2`, `in_space2`, ... | the same of the other hand | no |
| `metadata` | text, a JSON object | no; of the truth: `side`, `side2`, `still` |

Unknown keys are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.archives import MOST_BYTES, Archive, PickledError, Pieces, write_archive
from toftrack.camera import Camera
from toftrack.errors import ToftrackError, reported_errors
from toftrack.frames import LARGEST_MEDIAN_M, SMALLEST_MEDIAN_M, Truth, median_reading, wrong_unit
from toftrack.json_text import parse_json
from toftrack.recordings.doubts import check_layout, some_images
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, rate_of
from toftrack.recordings.npz_pieces import Images, StreamedImages
from toftrack.safe_files import open_to_read

LOADED_BYTES = MOST_BYTES
"""Longer recordings are not loaded: their images are read in turn."""
_IMAGES = ("depth_m", "radial_m", "amplitude")
CAMERA_KEYS = ("K", "distortion", "lens", "depth_polynomial", "depth_polynomial_range_m")
_POLYNOMIAL = CAMERA_KEYS[3:]


@dataclass(eq=False, kw_only=True)
class Recording(FrameStore):
    """What a camera saw, as it lies in the file: depth keeps the file's type."""

    depth: Images
    """(T, H, W) float16 or float32 metres."""
    radial: bool
    camera: Camera
    timestamp_s: np.ndarray
    fps: float
    amplitude: Images | None = None
    """(T, H, W) uint16."""
    truth: Truth | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        amplitude = None if self.amplitude is None else self.amplitude[index]
        return self.depth[index].astype(np.float32), amplitude

    def close(self) -> None:
        for images in (self.depth, self.amplitude):
            if isinstance(images, StreamedImages):
                images.close()


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


def write_recording(
    path: str | Path, store: FrameStore, progress: Callable[[], object] = lambda: None
) -> None:
    """Write any recording frame by frame, compressed; an existing file is replaced only by a
    complete one.

    path: the file.
    store: read twice where it has amplitudes. Depth keeps the type of a `Recording` (float16 or
        float32), and becomes float32 of others.
    progress: called after each frame's depth.

    Raises ToftrackError: the file cannot be written, or the store not be read.
    """

    def depth_images() -> Iterator[np.ndarray]:
        for index in range(len(store)):
            yield store.image(index)[0]
            progress()

    def amplitude_images() -> Iterator[np.ndarray]:
        for index in range(len(store)):
            amplitude = store.image(index)[1]
            assert amplitude is not None  # all images have one, or none has
            yield amplitude

    shape = (len(store), store.camera.height, store.camera.width)
    kind = store.depth.dtype if isinstance(store, Recording) else np.dtype("<f4")
    arrays: dict[str, Any] = {
        "radial_m" if store.radial else "depth_m": Pieces(shape, kind, depth_images()),
        **camera_arrays(store.camera),
        "timestamp_s": np.asarray(store.timestamp_s, np.float64),
        "fps": np.float64(store.fps),
        "metadata": json.dumps(store.metadata),
    }
    if store.image(0)[1] is not None:
        arrays["amplitude"] = Pieces(shape, np.dtype("<u2"), amplitude_images())
    if store.truth is not None:
        arrays |= truth_arrays(store.truth)
    with reported_errors(f"the recording '{path}' cannot be written", "choose another place"):
        write_archive(path, arrays)


def _read_members(path: Path) -> dict[str, Images]:
    """The known arrays of the archive; every way in which a file can be broken ends here."""
    if path.is_dir():
        raise ToftrackError(f"'{path}' is a directory; give the path of a recording (.npz)")
    try:
        with open_to_read(path) as stream:
            return _read_archive(path, Archive(stream))
    except FileNotFoundError:
        raise ToftrackError(
            f"there is no file '{path}'; give the path of a recording (.npz)"
        ) from None
    except OSError as error:
        raise ToftrackError(
            f"the recording '{path}' cannot be read ({error.strerror or error}); check the file "
            "and its permissions"
        ) from error
    except PickledError as error:
        raise ToftrackError(
            f"the recording '{path}' is refused: {error}, and they can run code; save plain arrays "
            "and text only"
        ) from None
    except ValueError as error:
        raise ToftrackError(
            f"the recording '{path}' is damaged ({error}); copy or record it again"
        ) from error


def _read_archive(path: Path, archive: Archive) -> dict[str, Images]:
    # Of unknown keys, too, before anything is used: a file that carries objects is not ours.
    headers = {name: archive.header(name, None) for name in archive.names}
    images = {name for name in _IMAGES if name in headers}
    if sum(headers[name].size for name in images) <= LOADED_BYTES:
        images.clear()
    return {
        key: StreamedImages(path, key, headers[key]) if key in images else archive.read(key)
        for key in _KEYS
        if key in headers
    }


def _parse(arrays: dict[str, Any]) -> Recording:
    depth_key = "depth_m" if "depth_m" in arrays else "radial_m"
    if depth_key not in arrays:
        raise ToftrackError("the required key 'depth_m' is missing; add it (or 'radial_m')")
    if "K" not in arrays:
        raise ToftrackError("the required key 'K' (3x3 camera matrix, pixels) is missing; add it")
    depth = _check_depth(arrays[depth_key], depth_key)
    check_layout(depth.shape, arrays, depth_key)
    count, height, width = depth.shape
    camera = _camera_of(arrays, width, height)
    timestamp_s, fps = _times(arrays, count)
    metadata = _metadata(arrays)
    return Recording(
        depth=depth,
        radial=depth_key == "radial_m",
        camera=camera,
        timestamp_s=timestamp_s,
        fps=fps,
        amplitude=_amplitude(arrays, depth.shape),
        truth=read_truth(arrays, count, metadata),
        metadata=metadata,
    )


def _check_depth(depth: Images, key: str) -> Images:
    if depth.ndim != 3:
        raise ToftrackError(
            f"'{key}' must have 3 dimensions (frames, rows, columns), but has {depth.ndim}, shape "
            f"{depth.shape}"
        )
    whole = depth.dtype.kind in "iu"
    if not whole and depth.dtype.kind != "f":
        raise ToftrackError(f"'{key}' must be float32 or float16 metres, but is {depth.dtype}")
    if len(depth) == 0:
        raise ToftrackError(f"'{key}' has zero frames; record at least one")
    if depth.size == 0:
        raise ToftrackError(f"the images of '{key}' are empty, shape {depth.shape}")
    some = some_images(depth)
    median = median_reading(some)
    if whole or median > LARGEST_MEDIAN_M or 0 < median < SMALLEST_MEDIAN_M:
        raise wrong_unit(f"'{key}'", some, str(depth.dtype) if whole else "")
    if isinstance(depth, StreamedImages) or depth.dtype.newbyteorder("=") in (
        np.float16,
        np.float32,
    ):
        return depth
    return depth.astype(np.float32)


def _times(arrays: dict[str, Any], count: int) -> tuple[np.ndarray, float]:
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
    timestamp_s = of_shape(arrays, "timestamp_s", (count,)).astype(np.float64)
    if not np.isfinite(timestamp_s).all() or (np.diff(timestamp_s) < 0).any():
        raise ToftrackError("'timestamp_s' must be finite and must not go backwards")
    return timestamp_s, rate_of(timestamp_s, DEFAULT_FPS if fps is None else fps)


def _amplitude(arrays: dict[str, Any], shape: tuple[int, ...]) -> Images | None:
    if "amplitude" not in arrays:
        return None
    amplitude = of_shape(arrays, "amplitude", shape)
    if amplitude.dtype.kind not in "iu":
        raise ToftrackError(f"'amplitude' must be uint16, but is {amplitude.dtype}")
    if amplitude.dtype == np.uint16:
        return amplitude
    if isinstance(amplitude, StreamedImages):
        raise ToftrackError(
            f"'amplitude' must be uint16 in a long recording, but is {amplitude.dtype}"
        )
    return np.clip(amplitude, 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _metadata(arrays: dict[str, Any]) -> dict[str, Any]:
    if "metadata" not in arrays:
        return {}
    array, why = arrays["metadata"], ""
    if array.size == 1 and array.dtype.kind in "US":
        try:
            metadata = parse_json(array.reshape(()).item())
        except ValueError as error:
            metadata, why = None, f" ({error})"
        if isinstance(metadata, dict):
            return metadata
    raise ToftrackError(f"'metadata' must be the text of one JSON object{why}")


def camera_arrays(camera: Camera) -> dict[str, np.ndarray]:
    """Its arrays by key; those of what most cameras do not have only where this one does."""
    arrays = {"K": np.asarray(camera.K), "distortion": np.asarray(camera.distortion)}
    if camera.lens != "opencv":
        arrays["lens"] = np.array(camera.lens)
    for key in _POLYNOMIAL:
        if values := getattr(camera, key):
            arrays[key] = np.array(values)
    return arrays


def _camera_of(arrays: dict[str, Any], width: int, height: int) -> Camera:
    """The camera of images of that size, px; `K` must be there. Raises ToftrackError."""
    lens = arrays.get("lens", np.array("opencv"))
    if lens.size != 1 or lens.dtype.kind != "U":
        raise ToftrackError("'lens' must be one text, opencv or fisheye")
    return Camera(
        arrays["K"],
        width,
        height,
        arrays.get("distortion", np.zeros(5)),
        lens=lens.reshape(()).item(),
        **{key: arrays[key] for key in _POLYNOMIAL if key in arrays},
    )


_JOINTS = 21
_FIELDS = ("joints_m", "visible", "in_space", "visible_fraction", "joint_visible", "pose_name")
_FIRST = {name: name for name in _FIELDS}
"""What fields of Truth are called in a file."""
_OTHER = {name: f"{name}2" for name in _FIELDS} | {"joints_m": "joints2_m"}
"""Those of the other hand."""
_KEYS = (
    "depth_m",
    "radial_m",
    *CAMERA_KEYS,
    "amplitude",
    "fps",
    "timestamp_s",
    *_FIRST.values(),
    *_OTHER.values(),
    "metadata",
)


def truth_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """The arrays of a file; sides and rests belong into its metadata."""
    arrays: dict[str, np.ndarray] = {}
    for keys, hand in ((_FIRST, truth), (_OTHER, truth.other)):
        values = {key: getattr(hand, name, None) for name, key in keys.items()}
        arrays |= {key: value for key, value in values.items() if value is not None}
    return arrays


def read_truth(arrays: dict[str, Any], count: int, metadata: dict[str, Any]) -> Truth | None:
    """The truth of `count` frames; None where a file has none.

    Sides and rests are read from the metadata where it has them: `side` (or `handedness`) and
    `side2`, and `still`, the first and the last frame of each rest of the first hand.

    Raises ToftrackError, a sentence about a key, when an array cannot be meant.
    """
    first = _truth_of_one(arrays, count, _FIRST)
    if first is None:
        return None
    other = _truth_of_one(arrays, count, _OTHER)
    if other is not None:
        other = replace(other, side=_side(metadata, "side2"))
    side = _side(metadata, "side") or _side(metadata, "handedness")
    return replace(first, other=other, side=side, still=_still(metadata.get("still"), count))


def of_shape(arrays: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A numeric or boolean array of the given shape."""
    array = arrays[key]
    if array.dtype.kind not in "biuf":
        raise ToftrackError(f"'{key}' must consist of numbers, but is {array.dtype}")
    return _shaped(array, key, shape)


def _shaped(array: np.ndarray, key: str, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape:
        raise ToftrackError(
            f"'{key}' must have the shape {shape} (the first is the number of frames), but has "
            f"{array.shape}"
        )
    return array


def _truth_of_one(arrays: dict[str, Any], count: int, keys: dict[str, str]) -> Truth | None:
    """Of one hand.  keys: what the fields are called."""
    if keys["joints_m"] not in arrays:
        return None
    joints = of_shape(arrays, keys["joints_m"], (count, _JOINTS, 3)).astype(np.float32)
    if not np.isfinite(joints).all():
        name = keys["joints_m"]
        raise ToftrackError(f"'{name}' contains NaN or infinity; leave it out or repair it")

    found: dict[str, Any] = {"visible": np.ones(count, bool), "in_space": np.ones(count, bool)}
    for name, kind, shape in (
        ("visible", bool, (count,)),
        ("in_space", bool, (count,)),
        ("visible_fraction", np.float32, (count,)),
        ("joint_visible", bool, (count, _JOINTS)),
    ):
        if keys[name] in arrays:
            found[name] = of_shape(arrays, keys[name], shape).astype(kind)
    return Truth(joints, pose_name=_names(arrays, keys["pose_name"], count), **found)


def _names(arrays: dict[str, Any], key: str, count: int) -> np.ndarray | None:
    """(T,) text."""
    if key not in arrays:
        return None
    array = arrays[key]
    if array.dtype.kind not in "US":
        raise ToftrackError(f"'{key}' must be text, but is {array.dtype}")
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    return _shaped(array, key, (count,))


def _side(metadata: dict[str, Any], key: str) -> str:
    side = metadata.get(key)
    return side if side in ("right", "left") else ""


def _still(rests: Any, count: int) -> np.ndarray | None:
    """(T,) bool of [[first, last], ...]; None where there is none, or nothing of that kind."""
    still = np.zeros(count, bool)
    for rest in rests if isinstance(rests, list) else ():
        if isinstance(rest, list) and len(rest) == 2 and all(type(end) is int for end in rest):
            still[max(rest[0], 0) : max(rest[1] + 1, 0)] = True
    return still if still.any() else None
