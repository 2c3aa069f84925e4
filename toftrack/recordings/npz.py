"""Recordings as plain `.npz` archives: arrays and text, never pickled objects.

docs/formats.md says what each key holds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.archives import MOST_BYTES, Archive, Header, PickledError, Pieces, write_archive
from toftrack.files.json_text import parse_json
from toftrack.files.safe_files import open_to_read
from toftrack.frames.camera import Camera
from toftrack.frames.frame import LARGEST_MEDIAN_M, Truth, could_be_metres, wrong_unit
from toftrack.recordings.bare import NOTHING_GIVEN, Given
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, file_of, rate_of, reading

LOADED_BYTES = MOST_BYTES
"""Longer recordings are not loaded: their images are read in turn."""
_IMAGES = ("depth_m", "radial_m", "amplitude")
_CAMERA = ("K", "distortion", "lens", "depth_polynomial", "depth_polynomial_range_m")
_TRUTH: dict[str, tuple[type, tuple[int, ...]]] = {
    "joints_m": (np.float32, (21, 3)),
    "visible": (bool, ()),
    "in_space": (bool, ()),
    "visible_fraction": (np.float32, ()),
    "joint_visible": (bool, (21,)),
    "pose_name": (str, ()),
}
"""Fields of `Truth`, which are keys of a file: their type, and the shape of one frame's."""
_FIRST = {name: name for name in _TRUTH}
_OTHER = {name: f"{name}2" for name in _TRUTH} | {"joints_m": "joints2_m"}
"""The keys of the other hand's."""
_KEYS = (*_IMAGES, *_CAMERA, "fps", "timestamp_s", *_TRUTH, *_OTHER.values(), "metadata")
_MOST_NAMED = 200
"""Signs of keys that are none of these, in an error."""
_IN_THE_MIDDLE, _ASIDE = 0.12, 0.15
"""How far from the image's middle the centre of K lies, in shares of its sides."""


class StreamedImages:
    """(T, H, W) images of one array of an archive, each to be had by its number.

    Made for going forward: an image before the latest one is found by beginning anew.
    ToftrackError where the array cannot be read in turn, and later where it is damaged.
    """

    def __init__(self, path: Path, name: str, header: Header) -> None:
        self._path, self._name = path, name
        if header.fortran_order or header.kind.kind not in "fiu":
            raise ToftrackError(
                f"'{name}' of the recording '{path}' has {header.size / 1e9:.1f} GB; so large an "
                "array must be numbers in C order: save it with numpy.ascontiguousarray"
            )
        self.shape, self.dtype, self.ndim = header.shape, header.kind, len(header.shape)
        self._images: Iterator[tuple[int, np.ndarray]] = iter(())
        self._latest: tuple[int, np.ndarray] | None = None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> np.ndarray:
        if not 0 <= index < len(self):
            raise IndexError(index)
        if self._latest is None or index < self._latest[0]:
            self._images, self._latest = enumerate(self._in_turn()), None
        while self._latest is None or self._latest[0] < index:
            self._latest = next(self._images)
        return self._latest[1]

    def close(self) -> None:
        self._images, self._latest = iter(()), None

    def _in_turn(self) -> Iterator[np.ndarray]:
        shape = self.shape[1:]
        size = int(np.prod(shape)) * self.dtype.itemsize
        recording, remedy = f"the recording '{self._path}'", "copy or record it again"
        with (
            reported_errors(f"{recording} cannot be read", remedy),
            reported_errors(f"{recording} is damaged", remedy, ValueError),
            open_to_read(self._path) as file,
            Archive(file).rows(self._name) as stream,
        ):
            for _ in range(len(self)):
                content = stream.read(size)
                if len(content) < size:
                    raise ValueError(f"{self._name!r} is cut off")
                yield np.frombuffer(content, self.dtype).reshape(shape)


Images = np.ndarray | StreamedImages
"""(T, H, W) images, in memory or on the disk."""


@dataclass(eq=False, kw_only=True)
class Recording(FrameStore):
    """What a camera saw, as it lies in the file: depth keeps the file's type."""

    depth: Images
    """(T, H, W) metres, floats of any size."""
    amplitude: Images | None = None
    """(T, H, W) uint16."""

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        amplitude = None if self.amplitude is None else self.amplitude[index]
        return self.depth[index].astype(np.float32), amplitude

    def close(self) -> None:
        for images in (self.depth, self.amplitude):
            if isinstance(images, StreamedImages):
                images.close()


def read_recording(path: str | Path, given: Given = NOTHING_GIVEN) -> Recording:
    """Read and check a recording; given: its camera and rate, where it says nothing of them."""
    path = file_of(path)
    try:
        with reading(path), open_to_read(path) as stream:
            arrays = _read_archive(path, Archive(stream))
    except PickledError as error:
        raise ToftrackError(
            f"the recording '{path}' is refused: {error}, and they can run code; save plain arrays "
            "and text only"
        ) from None
    except ValueError as error:
        raise ToftrackError(
            f"the recording '{path}' is damaged ({error}); copy or record it again"
        ) from error
    try:
        key = "depth_m" if "depth_m" in arrays else "radial_m"
        depth = _check_depth(arrays[key], key)
        _check_layout(depth.shape, arrays, key)
        count, height, width = depth.shape
        camera = _camera_of(arrays, width, height, given)
        timestamp_s, fps = _times(arrays, count, given.fps)
        metadata = _metadata(arrays)
        return Recording(
            depth=depth,
            radial=key == "radial_m",
            camera=camera,
            timestamp_s=timestamp_s,
            fps=fps,
            amplitude=_amplitude(arrays, depth.shape),
            truth=_read_truth(arrays, count, metadata),
            metadata=metadata,
        )
    except ToftrackError as error:
        raise ToftrackError(f"the recording '{path}' cannot be used: {error}") from None


def write_recording(
    path: str | Path, store: FrameStore, progress: Callable[[], object] = lambda: None
) -> None:
    """Write any recording frame by frame, compressed; an existing file is replaced only by a
    complete one.

    store: read twice where it has amplitudes. Depth keeps the type of a `Recording` (float16 or
    float32), and becomes float32 of others.  progress: called after each frame's depth.
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
    hands = ((store.truth, _FIRST), (store.truth and store.truth.other, _OTHER))
    for truth, keys in hands:  # sides and rests belong into the metadata
        told = {key: getattr(truth, name, None) for name, key in keys.items()}
        arrays |= {key: array for key, array in told.items() if array is not None}
    with reported_errors(f"the recording '{path}' cannot be written", "choose another place"):
        write_archive(path, arrays)


def _read_archive(path: Path, archive: Archive) -> dict[str, Images]:
    # Of unknown keys, too, before anything is used: a file that carries objects is not ours.
    headers = {name: archive.header(name) for name in archive.names}
    if not {"depth_m", "radial_m"} & headers.keys():
        some = ", ".join(headers)[:_MOST_NAMED]
        raise ToftrackError(
            f"the recording '{path}' has no 'depth_m' (or 'radial_m'), but {some or 'nothing'}; "
            "save its depth images under that name"
        )
    images = {name for name in _IMAGES if name in headers}
    others = sum(headers[name].size for name in headers.keys() & set(_KEYS) - images)
    if others > MOST_BYTES:
        raise ValueError(f"besides its images it holds {others / 1e9:.1f} GB")
    if sum(headers[name].size for name in images) <= LOADED_BYTES:
        images.clear()
    return {
        key: StreamedImages(path, key, headers[key]) if key in images else archive.read(key)
        for key in _KEYS
        if key in headers
    }


def some_images(depth: Images) -> np.ndarray:
    """(n, H, W) of it, to judge the whole by: all of a long one would only take longer."""
    if isinstance(depth, StreamedImages):
        return np.stack([depth[index] for index in range(min(4, len(depth)))])
    return depth[np.unique(np.linspace(0, len(depth) - 1, 16).astype(int))]


def _check_layout(shape: tuple[int, ...], arrays: dict[str, Any], key: str) -> None:
    """ToftrackError where the images' middle and K say that the frames are counted last."""
    per_frame = ("timestamp_s", *_TRUTH)
    lengths = {len(arrays[name]) for name in per_frame if name in arrays and arrays[name].ndim}
    k = np.asarray(arrays.get("K", ()))
    centre = k[:2, 2] if k.shape == (3, 3) else None
    if centre is None or centre.dtype.kind not in "iuf" or shape[0] in lengths:
        return
    aside, aside_if_last = (
        np.abs(centre / (width, height) - 0.5).max() for height, width in (shape[1:], shape[:2])
    )
    if shape[2] in lengths or (aside_if_last < _IN_THE_MIDDLE and aside > _ASIDE):
        raise ToftrackError(
            f"'{key}' has the shape {shape}, which by K and the other keys is (rows, columns, "
            f"frames), but must be (frames, rows, columns); save numpy.moveaxis({key}, -1, 0)"
        )


def _check_depth(depth: Images, key: str) -> Images:
    if depth.ndim != 3 or 0 in depth.shape:
        raise ToftrackError(
            f"'{key}' must have 3 dimensions (frames, rows, columns) and at least one frame of at "
            f"least one pixel, but has the shape {depth.shape}"
        )
    whole = depth.dtype.kind in "iu"
    if not whole and depth.dtype.kind != "f":
        raise ToftrackError(f"'{key}' must be float32 or float16 metres, but is {depth.dtype}")
    some = some_images(depth)
    if whole or could_be_metres(some) is False:
        raise wrong_unit(f"'{key}'", some)
    kept = depth.dtype.newbyteorder("=") in (np.float16, np.float32)
    return depth if kept or isinstance(depth, StreamedImages) else depth.astype(np.float32)


def _times(arrays: dict[str, Any], count: int, given: float | None) -> tuple[np.ndarray, float]:
    """Times and rate.  given: the rate of a file that says neither."""
    fps = None
    if "fps" in arrays:
        rate = arrays["fps"]
        fps = float(rate.reshape(())) if rate.size == 1 and rate.dtype.kind in "iuf" else 0.0
        if not 0 < fps < np.inf:
            raise ToftrackError(f"'fps' must be one positive number, but is {str(rate):.40}")
    if "timestamp_s" not in arrays:
        fps = fps or given or DEFAULT_FPS
        return np.arange(count) / fps, fps
    timestamp_s = _shaped(arrays, "timestamp_s", (count,)).astype(np.float64)
    sound = np.append(True, np.diff(timestamp_s) >= 0) & np.isfinite(timestamp_s)
    if not sound.all():
        raise ToftrackError(
            "'timestamp_s' must be finite and must not go backwards, as it does at frame "
            f"{sound.argmin()}; repair it, or leave it out and give 'fps'"
        )
    return timestamp_s, rate_of(timestamp_s, DEFAULT_FPS if fps is None else fps)


def _amplitude(arrays: dict[str, Any], shape: tuple[int, ...]) -> Images | None:
    if "amplitude" not in arrays:
        return None
    amplitude = _shaped(arrays, "amplitude", shape)
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
    content = camera.to_dict()
    return {key: np.array(content[key]) for key in _CAMERA if content.get(key)}


def _camera_of(arrays: dict[str, Any], width: int, height: int, given: Given) -> Camera:
    """The camera of images of that size, px: the file's, else the given one. ToftrackError."""
    if "K" not in arrays:
        if lens := given.camera(width, height, "the recording"):
            return lens
        raise ToftrackError(
            "the required key 'K' (3x3 camera matrix, pixels) is missing; add it, or give the lens "
            "with device.intrinsics=[FX,FY,CX,CY] (toftrack convert: --intrinsics FX FY CX CY)"
        )
    own: dict[str, Any] = {key: arrays[key] for key in _CAMERA if key in arrays}
    if "lens" in own:
        if own["lens"].size != 1 or own["lens"].dtype.kind != "U":
            raise ToftrackError("'lens' must be one text, opencv or fisheye")
        own["lens"] = own["lens"].item()
    return Camera(width=width, height=height, **own)


def _read_truth(arrays: dict[str, Any], count: int, metadata: dict[str, Any]) -> Truth | None:
    """The truth of `count` frames; None where a file has none.

    Sides and rests are read from the metadata where it has them: `side` (or `handedness`) and
    `side2`, and `still`, the first and the last frame of each rest of the first hand.
    """
    first = _truth_of_one(arrays, count, _FIRST)
    if first is None:
        return None
    other = _truth_of_one(arrays, count, _OTHER)
    if other is not None:
        other = replace(other, side=_side(metadata, "side2"))
    side = _side(metadata, "side") or _side(metadata, "handedness")
    return replace(first, other=other, side=side, still=_still(metadata.get("still"), count))


def _truth_of_one(arrays: dict[str, Any], count: int, keys: dict[str, str]) -> Truth | None:
    """Of one hand.  keys: what the fields are called."""
    if keys["joints_m"] not in arrays:
        return None
    found: dict[str, Any] = {"visible": np.ones(count, bool), "in_space": np.ones(count, bool)}
    for name, (kind, shape) in _TRUTH.items():
        if keys[name] in arrays:
            array = _shaped(arrays, keys[name], (count, *shape), text=kind is str)
            found[name] = array if kind is str else array.astype(kind)
    name, joints = keys["joints_m"], found["joints_m"]
    # A hand that is not visible may be nowhere.
    nowhere = ~found["visible"][:, None, None] & ~np.isfinite(joints)
    found["joints_m"] = np.where(nowhere, np.float32(0), joints)
    if not np.isfinite(found["joints_m"]).all():
        raise ToftrackError(f"'{name}' contains NaN or infinity; leave it out or repair it")
    if np.median(np.abs(joints)) > LARGEST_MEDIAN_M:
        raise ToftrackError(f"'{name}' is plainly in millimetres; divide it by 1000")
    return Truth(**found)


def _shaped(
    arrays: dict[str, Any], key: str, shape: tuple[int, ...], text: bool = False
) -> np.ndarray:
    """An array of the given shape, of numbers and booleans, or of text."""
    array = arrays[key]
    if array.dtype.kind not in ("US" if text else "biuf"):
        wanted = "be text" if text else "consist of numbers"
        raise ToftrackError(f"'{key}' must {wanted}, but is {array.dtype}")
    if array.shape != shape:
        raise ToftrackError(
            f"'{key}' must have the shape {shape} (the first is the number of frames), but has "
            f"{array.shape}"
        )
    return np.char.decode(array, "utf-8", "replace") if array.dtype.kind == "S" else array


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
