"""Depth as other programs write it: an Azure Kinect's recordings, lossless grey videos, and `.npy`.

k4arecorder, and the Orbbec Femto's recorder, write Matroska (Microsoft's "Azure Kinect file
format"): tracks titled COLOR, DEPTH and IR, depth and infrared as big-endian 16-bit words, depth in
millimetres along the optical axis, and the calibration as the attachment calibration.json. It gives
the lens of the whole sensor, in parts of its width and with (0, 0) at the corner of the first
pixel; a mode of the camera bins that sensor's pixels and cuts a part out.

A video is read through once for the times of its images, without decoding them; the images then
come from the disk one at a time.
"""

from __future__ import annotations

import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.frames import LARGEST_MEDIAN_M
from toftrack.json_text import parse_json
from toftrack.recordings.bare import MILLIMETRE, BareFacts, bare_camera
from toftrack.recordings.npz import DEFAULT_FPS
from toftrack.safe_files import check_readable

VIDEOS = frozenset(".mkv .avi .mov .mp4 .m4v .webm .mpg .mpeg .wmv .nut".split())
"""How the names of videos end."""
_GREY = ("gray16le", "gray16be")
_MISSING_FRAMES = 5  # fewer at the end say nothing of a file that was cut off


class DepthVideo:
    """The frames of a video. Made by `read_video`."""

    truth = None
    radial = False

    def __init__(
        self,
        path: Path,
        camera: Camera,
        depth: Track,
        amplitude: Track | None,
        unit_m: float,
        fps: float | None,
        damage: str | None,
        metadata: dict[str, Any],
    ) -> None:
        self.path, self.camera, self.unit_m = path, camera, unit_m
        self.damage, self.metadata = damage, metadata
        steps = np.diff(depth.times_s)
        median = float(np.median(steps)) if len(steps) else 0.0
        self.fps = fps or (1 / median if median > 0 else DEFAULT_FPS)
        self.timestamp_s = np.arange(len(steps) + 1) / fps if fps else depth.times_s
        """(T,) float64 seconds, not decreasing."""
        self._depth, self._amplitude = depth, amplitude

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """A frame's depth, (H, W) float32 metres, and amplitude, (H, W) uint16; new arrays.

        An infrared image that is missing is black. Raises ToftrackError when one is damaged.
        """
        depth = self._depth.image(index).astype(np.float32) * np.float32(self.unit_m)
        if self._amplitude is None:
            return depth, None
        found = self._amplitude.number_at(self._depth.ticks[index])
        if found is None:
            return depth, np.zeros(depth.shape, np.uint16)
        return depth, self._amplitude.image(found)

    def close(self) -> None:
        """Close the file; it opens again by itself."""
        self._depth.close()
        if self._amplitude is not None:
            self._amplitude.close()


class Track:
    """The images of one track of a video, 16 bits a pixel, each to be had by its number."""

    def __init__(self, path: Path, stream: int, ticks: np.ndarray, tick_s: float) -> None:
        self.ticks = ticks
        """(T,) int64: the images' times as the file counts them, rising."""
        self.times_s = ticks * tick_s
        """(T,) float64 seconds."""
        self._path, self._stream = path, stream
        self._container: Any = None
        self._images: Iterator[Any] | None = None
        self._next = 0

    def number_at(self, tick: int) -> int | None:
        """The number of the image of that time, None where there is none."""
        number = int(np.searchsorted(self.ticks, tick))
        return number if number < len(self.ticks) and self.ticks[number] == tick else None

    def image(self, number: int) -> np.ndarray:
        """(H, W) uint16, a new array. Raises ToftrackError when it is damaged."""
        import av  # takes a while, and most recordings are no videos

        try:
            if self._images is None or number != self._next:
                self._go_to(number)
            assert self._images is not None
            image = next(frame for frame in self._images if frame.pts >= self.ticks[number])
            self._next = number + 1
            if image.pts != self.ticks[number]:
                raise ToftrackError(
                    f"frame {number} of '{self._path}' is damaged; copy or record it again"
                )
            return image.to_ndarray().astype(np.uint16)
        except (av.FFmpegError, OSError, StopIteration) as error:
            raise ToftrackError(
                f"frame {number} of '{self._path}' cannot be decoded ({_reason(error)}); copy or "
                "record it again"
            ) from error

    def close(self) -> None:
        """Close the file, if it is open."""
        container, self._container, self._images = self._container, None, None
        if container is not None:
            container.close()

    def _go_to(self, number: int) -> None:
        if self._container is None:
            self._container = opened(self._path)
        stream = self._container.streams[self._stream]
        self._container.seek(int(self.ticks[number]), stream=stream)
        self._images = self._container.decode(stream)


def read_video(path: str | Path, camera_file: str | Path | None, bare: BareFacts) -> DepthVideo:
    """Open a video of depth images.

    path: a recording of an Azure Kinect (`.mkv`), or a lossless grey video of 16 bits (FFV1).
    camera_file: a camera file; None = the recording's own calibration, or what is given.
    bare: intrinsics, unit (a millimetre) and frame rate of a video that does not tell them.

    Raises ToftrackError: it is damaged, has colour images or no depth, or nothing tells its camera.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise ToftrackError(f"there is no file '{path}'; give the path of a recording")
    container = opened(path)
    try:
        own = tracks_of(container, path)
        number = _grey_stream(container, path, None if own is None else own.depth)
        shape = container.streams[number].width, container.streams[number].height
        if camera_file is not None or own is None:
            camera = bare_camera(path, camera_file, bare, *shape)
        else:
            camera = camera_of(container, path, *shape)
        infrared = [] if own is None else own.infrared
        grey = [index for index in infrared if _kind(container.streams[index])[1] in _GREY]
        found = _scanned(container, path, [number, *grey])
    finally:
        container.close()
    depth, *others = (
        Track(path, stream, ticks, found.tick_s[stream]) for stream, ticks in found.ticks.items()
    )
    unit_m = MILLIMETRE if bare.unit_m is None else bare.unit_m
    about = {} if own is None else own.facts
    if own is not None:
        depth.times_s += own.offset_s
    return DepthVideo(
        path, camera, depth, others[0] if others else None, unit_m, bare.fps, found.damage, about
    )


def opened(path: Path) -> Any:
    """The container of PyAV; ToftrackError when the file is no video."""
    import av  # takes a while, and most recordings are no videos

    try:
        # A damaged text among the tags is no reason to refuse the images.
        return av.open(str(path), metadata_errors="replace")
    except (av.FFmpegError, OSError) as error:
        raise ToftrackError(
            f"'{path}' cannot be read as a video ({_reason(error)}); it is damaged, cut off or of "
            "another kind"
        ) from error


def _grey_stream(container: Any, path: Path, wanted: int | None) -> int:
    """The number of the wanted, or the only track of grey 16-bit images."""
    videos = [s for s in container.streams.video if wanted in (None, s.index)]
    kinds = [(s.index, *_kind(s)) for s in videos]
    grey = [index for index, _, pixels in kinds if pixels in _GREY]
    if len(grey) == 1:
        return grey[0]
    codecs = ", ".join(f"{codec} {pixels}" for _, codec, pixels in kinds) or "no video at all"
    if grey:
        raise ToftrackError(f"'{path}' has {len(grey)} tracks of grey 16-bit images; keep one")
    raise ToftrackError(
        f"'{path}' is a video of colour or 8-bit images ({codecs}), from which depth cannot be had;"
        " give the depth images: lossless grey of 16 bits (ffmpeg -c:v ffv1 -pix_fmt gray16le), "
        "16-bit PNG, or .npy"
    )


@dataclass(frozen=True, eq=False)
class _Found:
    ticks: dict[int, np.ndarray]
    """By stream, the images' times, (T,) int64, rising."""
    tick_s: dict[int, float]
    damage: str | None


def _scanned(container: Any, path: Path, streams: list[int]) -> _Found:
    """The times of all images of some tracks; ToftrackError when the first one has none."""
    import av

    ticks: dict[int, list[int]] = {number: [] for number in streams}
    damage = None
    try:
        for packet in container.demux([container.streams[number] for number in streams]):
            if packet.pts is None or not packet.size:
                continue
            if packet.is_corrupt or packet.size < _least(packet.stream):
                damage = "it breaks off within a frame"
                break
            ticks[packet.stream_index].append(packet.pts)
    except (av.FFmpegError, OSError) as error:
        damage = f"it is damaged further on ({_reason(error)})"
    if not ticks[streams[0]]:
        raise ToftrackError(f"'{path}' has no frame of depth ({damage or 'it is empty'})")
    tick_s = {number: float(container.streams[number].time_base) for number in streams}
    times = {number: np.unique(np.array(values, np.int64)) for number, values in ticks.items()}
    first = times[streams[0]]
    missing_s = (container.duration or 0) / 1e6 - first[-1] * tick_s[streams[0]]
    step_s = (first[-1] - first[0]) / max(1, len(first) - 1) * tick_s[streams[0]]
    if damage is None and len(first) > 1 and missing_s > _MISSING_FRAMES * step_s:
        damage = f"it ends {missing_s:.1f} s before the end that it states"
    return _Found(times, tick_s, damage)


def _kind(stream: Any) -> tuple[str, str | None]:
    """The names of a track's codec and pixels."""
    codec = stream.codec_context  # None where FFmpeg knows no decoder
    return ("unknown", None) if codec is None else (codec.name, codec.pix_fmt)


def _least(stream: Any) -> int:
    """The fewest bytes that an image of a track may have: all of them where none is compressed."""
    raw = _kind(stream)[0] == "rawvideo"
    return 2 * stream.width * stream.height if raw else 1


def _reason(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


_SENSOR_PX = 1024
"""Width and height of the depth sensor."""
_MODES = {
    (320, 288): (512, (96, 90)),
    (640, 576): (1024, (192, 180)),
    (512, 512): (512, (0, 0)),
    (1024, 1024): (1024, (0, 0)),
}
"""By the image's size (narrow binned, narrow, wide binned, wide): the sensor's width after
binning, and where the image begins on it."""
_MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
_CALIBRATION = "calibration.json"
_ADVICE = "give a calibrated camera with camera.file=FILE"


@dataclass(frozen=True)
class Tracks:
    """The tracks of a recording, by their numbers."""

    depth: int
    infrared: list[int]
    """None or one."""
    offset_s: float
    """Of the camera's clock at the file's time 0."""
    facts: dict[str, Any]
    """JSON-able, for the recording's metadata."""


def tracks_of(container: Any, path: Path) -> Tracks | None:
    """The tracks of an Azure Kinect's recording; None for every other video.

    Raises ToftrackError when it was recorded without depth.
    """
    named = {title: _track(container, title) for title in ("DEPTH", "IR")}
    if named["DEPTH"] is None:
        if not any(key.startswith("K4A_") for key in container.metadata):
            return None
        raise ToftrackError(
            f"'{path}' is a recording of an Azure Kinect without depth; record it with a depth "
            "mode (k4arecorder --depth-mode NFOV_UNBINNED)"
        )
    depth = container.streams[named["DEPTH"]]
    tags = {**depth.metadata, **container.metadata}
    names = {"camera": "title", "serial": "K4A_DEVICE_SERIAL_NUMBER", "mode": "K4A_DEPTH_MODE"}
    offset = tags.get("K4A_START_OFFSET_NS", "")
    return Tracks(
        depth=named["DEPTH"],
        infrared=[] if named["IR"] is None else [named["IR"]],
        offset_s=int(offset) / 1e9 if offset.isdecimal() else 0.0,
        facts={key: tags[name] for key, name in names.items() if name in tags},
    )


def camera_of(container: Any, path: Path, width: int, height: int) -> Camera:
    """The depth camera for images of that size, from the attached calibration.

    Raises ToftrackError when that is missing, damaged, or of a kind that no shipped camera has.
    """
    text = _attachment(container)
    if text is None:
        raise ToftrackError(f"'{path}' has no attachment {_CALIBRATION}; {_ADVICE}")
    if (width, height) not in _MODES:
        raise ToftrackError(
            f"'{path}' has depth images of {width}x{height} pixels, which is no mode of an Azure "
            f"Kinect; {_ADVICE}"
        )
    try:
        cameras = parse_json(text)["CalibrationInformation"]["Cameras"]
        depth = next(c for c in cameras if c["Purpose"] == "CALIBRATION_CameraPurposeDepth")
        lens, size = depth["Intrinsics"], (depth["SensorWidth"], depth["SensorHeight"])
        numbers = np.array(lens["ModelParameters"], np.float64)
        model = lens["ModelType"]
    except (ValueError, KeyError, TypeError, StopIteration):
        raise ToftrackError(f"the {_CALIBRATION} in '{path}' is damaged; {_ADVICE}") from None
    if model != _MODEL or size != (_SENSOR_PX, _SENSOR_PX) or numbers.shape != (14,):
        raise ToftrackError(
            f"the {_CALIBRATION} in '{path}' is of another kind ({model}, sensor of {size}, "
            f"{numbers.size} parameters); {_ADVICE}"
        )
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = numbers
    across, (left, top) = _MODES[width, height]
    # The sensor's (0, 0) is a pixel's corner, ours its centre.
    K = np.array(
        [[fx * across, 0, cx * across - left - 0.5], [0, fy * across, cy * across - top - 0.5]]
    )
    distortion = np.array([k1, k2, p1, p2, k3, k4, k5, k6])
    try:
        return Camera(np.vstack((K, (0, 0, 1))), width, height, distortion)
    except ToftrackError as error:
        raise ToftrackError(f"the {_CALIBRATION} in '{path}': {error}; {_ADVICE}") from None


def _track(container: Any, title: str) -> int | None:
    for stream in container.streams.video:
        if stream.metadata.get("title") == title or f"K4A_{title}_TRACK" in stream.metadata:
            return int(stream.index)
    return None


def _attachment(container: Any) -> str | None:
    for stream in container.streams:
        if stream.type == "attachment" and stream.name == _CALIBRATION:
            # As the camera stores it, the text ends with zeros.
            return bytes(stream.data).rstrip(b"\0").decode("utf-8", "replace")
    return None


class NpyStack:
    """The frames of a stack, mapped from the disk."""

    truth = None
    radial = False

    def __init__(
        self, path: Path, images: np.ndarray, camera: Camera, unit_m: float, fps: float
    ) -> None:
        self.path, self.camera, self.unit_m, self.fps = path, camera, unit_m, fps
        self.metadata: dict[str, Any] = {}
        self.timestamp_s = np.arange(len(images)) / fps
        """(T,) float64 seconds."""
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def image(self, index: int) -> tuple[np.ndarray, None]:
        """A frame's depth, (H, W) float32 metres, 0 = no reading, a new array; no amplitude."""
        image = np.asarray(self._images[index])
        depth = image.astype(np.float32) * np.float32(self.unit_m)
        return np.where((depth > 0) & (depth < np.inf), depth, np.float32(0)), None

    def close(self) -> None:
        """Nothing to close: the file is mapped as long as this object lives."""


def read_npy(path: str | Path, camera_file: str | Path | None, bare: BareFacts) -> NpyStack:
    """Open a stack.

    path: the `.npy`.
    camera_file: of the camera; None = the given intrinsics, or camera.json beside the file.
    bare: intrinsics, unit of whole numbers (a millimetre) and frame rate (25) where given.

    Raises ToftrackError: it is no such stack, holds pickled objects, or nothing tells its camera.
    """
    path = Path(path).expanduser()
    images = _mapped(path)
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3 or images.size == 0 or images.dtype.kind not in "uif":
        raise ToftrackError(
            f"'{path}' has the shape {images.shape} of {images.dtype}, but must be depth images, "
            "(frames, rows, columns) of numbers"
        )
    count, height, width = images.shape
    whole = images.dtype.kind in "ui"
    unit_m = bare.unit_m if bare.unit_m is not None else (MILLIMETRE if whole else 1.0)
    stack = NpyStack(
        path,
        images,
        bare_camera(path, camera_file, bare, width, height),
        unit_m,
        DEFAULT_FPS if bare.fps is None else bare.fps,
    )
    some = np.stack(
        [stack.image(i)[0] for i in np.unique(np.linspace(0, count - 1, 8).astype(int))]
    )
    median = float(np.median(some[some > 0])) if (some > 0).any() else 0.0
    if median > LARGEST_MEDIAN_M:
        raise ToftrackError(
            f"the median of '{path}' is {median:.0f} m, which is plainly another unit; say what "
            "one step is with toftrack convert --source-unit METRES"
        )
    return stack


def _mapped(path: Path) -> np.ndarray:
    try:
        check_readable(path)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise ToftrackError(f"there is no file '{path}'; give the path of a recording") from None
    except OSError as error:
        raise ToftrackError(f"'{path}' cannot be read ({error.strerror or error})") from error
    except (
        ValueError,
        EOFError,
        TypeError,
        SyntaxError,
        OverflowError,
        tokenize.TokenError,
    ) as error:
        reason = " ".join(str(error).split())
        raise ToftrackError(
            f"'{path}' is no .npy of numbers, or was cut off ({reason}); save the depth with "
            "numpy.save"
        ) from error
