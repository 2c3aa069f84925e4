"""Depth in videos: an Azure Kinect's recordings, and lossless grey ones of 16 bits.

k4arecorder, and the Orbbec Femto's recorder, write Matroska (Microsoft's "Azure Kinect file
format"): tracks titled COLOR, DEPTH and IR, depth and infrared as big-endian 16-bit words, depth in
millimetres along the optical axis, and the calibration as the attachment calibration.json. It gives
the lens of the whole sensor, in parts of its width and with (0, 0) at the corner of the first
pixel; a mode of the camera bins that sensor's pixels and cuts a part out.

A video is read through once for the times of its images, without decoding them; the images then
come from the disk one at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import parse_json
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import MILLIMETRE, Given, bare_camera, metres_of
from toftrack.recordings.frame_store import FrameStore, file_of, rate_of

VIDEOS = frozenset(".mkv .avi .mov .mp4 .m4v .webm .mpg .mpeg .wmv .nut".split())
"""How the names of videos end."""
_GREY = ("gray16le", "gray16be")
_ONLY_THIS_FILE = {
    "format_whitelist": "matroska,webm,avi,mov,mpeg,mpegvideo,asf,nut",
    "protocol_whitelist": "file",
}
"""FFmpeg goes by the content: lists of files and addresses, whatever they are called, are none."""
_MISSING_FRAMES = 5  # fewer at the end say nothing of a file that was cut off


class DepthVideo(FrameStore):
    """The frames of a video: a recording of an Azure Kinect (`.mkv`), or a lossless grey video of
    16 bits (FFV1).

    given: a lens, unit (a millimetre) and frame rate of a video that does not tell them; a lens
    goes before a Kinect's own calibration.
    """

    unit_m: float

    def __init__(self, path: Path, given: Given) -> None:
        path = file_of(path)
        with closing(_opened(path)) as container:
            depth, infrared, offset_s, self.metadata = _kinect_of(container, path)
            number = _grey_stream(container, path, depth)
            shape = container.streams[number].width, container.streams[number].height
            if depth is None:
                self.camera = bare_camera(path, given, *shape)
            else:
                lens = given.camera(*shape, f"'{path}'")
                self.camera = lens or _camera_of(container, path, *shape)
            grey = [index for index in infrared if _kind(container.streams[index])[1] in _GREY]
            tracks, self.damage = _scanned(container, path, [number, *grey])
        self._depth, self._amplitude = tracks[0], tracks[1] if len(tracks) > 1 else None
        times_s = self._depth.times_s + offset_s
        self.unit_m = given.unit_m or MILLIMETRE
        self.fps = given.fps or rate_of(times_s)
        self.timestamp_s = np.arange(len(times_s)) / given.fps if given.fps else times_s

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """An infrared image that is missing is black."""
        depth = metres_of(self._depth.image(index), self.unit_m)
        if self._amplitude is None:
            return depth, None
        found = self._amplitude.number_at(self._depth.ticks[index])
        if found is None:
            return depth, np.zeros(depth.shape, np.uint16)
        return depth, self._amplitude.image(found)

    def close(self) -> None:
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
        with reported_errors(
            f"frame {number} of '{self._path}' cannot be decoded",
            "copy or record it again",
            *_errors(),
        ):
            if self._images is None or number != self._next:
                self._images = self._from(number)
            image = next((frame for frame in self._images if frame.pts >= self.ticks[number]), None)
            self._next = number + 1
            if image is not None and image.pts == self.ticks[number]:
                return image.to_ndarray().astype(np.uint16)
        raise ToftrackError(f"frame {number} of '{self._path}' is damaged; copy or record it again")

    def close(self) -> None:
        container, self._container, self._images = self._container, None, None
        if container is not None:
            container.close()

    def _from(self, number: int) -> Iterator[Any]:
        if self._container is None:
            self._container = _opened(self._path)
        stream = self._container.streams[self._stream]
        self._container.seek(int(self.ticks[number]), stream=stream)
        return self._container.decode(stream)


def _opened(path: Path) -> Any:
    """The container of PyAV; ToftrackError when the file is no video."""
    import av  # takes a while, and most recordings are no videos

    remedy = "it is damaged, cut off or of another kind"
    with reported_errors(f"'{path}' cannot be read as a video", remedy, *_errors()):
        # A damaged text among the tags is no reason to refuse the images, which older ones do.
        old = int(av.__version__.partition(".")[0]) < 19
        more = {"metadata_errors": "replace"} if old else {}
        return av.open(str(path), options=_ONLY_THIS_FILE, **more)


def _errors() -> tuple[type[Exception], ...]:
    """What PyAV raises of a damaged file."""
    import av

    return (av.FFmpegError, OSError)


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


def _scanned(container: Any, path: Path, streams: Sequence[int]) -> tuple[list[Track], str | None]:
    """Some tracks with the times of their images, and what ended the file before its end. Raises
    ToftrackError when the first track has no image.
    """
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
    except _errors() as error:
        damage = f"it is damaged further on ({getattr(error, 'strerror', None) or error})"
    if not ticks[streams[0]]:
        raise ToftrackError(f"'{path}' has no frame of depth ({damage or 'it is empty'})")
    tracks = [
        Track(path, number, np.unique(values), float(container.streams[number].time_base))
        for number, values in ticks.items()
    ]
    times_s = tracks[0].times_s
    missing_s = (container.duration or 0) / 1e6 - times_s[-1]
    step_s = (times_s[-1] - times_s[0]) / max(1, len(times_s) - 1)
    if damage is None and len(times_s) > 1 and missing_s > _MISSING_FRAMES * step_s:
        damage = f"it ends {missing_s:.1f} s before the end that it states"
    return tracks, damage


def _kind(stream: Any) -> tuple[str, str | None]:
    """The names of a track's codec and pixels."""
    codec = stream.codec_context  # None where FFmpeg knows no decoder
    return ("unknown", None) if codec is None else (codec.name, codec.pix_fmt)


def _least(stream: Any) -> int:
    """The fewest bytes that an image of a track may have: all of them where none is compressed."""
    raw = _kind(stream)[0] == "rawvideo"
    return 2 * stream.width * stream.height if raw else 1


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
_MODELS = ("BrownConrady", "Rational6KT")
"""Both are OpenCV's rational model. By the second, which Orbbec's Femto names, a term of p1 and p2
counts half; that is a hundredth of a pixel."""
_CALIBRATION = "calibration.json"
_ADVICE = "give a calibrated camera with camera.file=FILE"


def _kinect_of(container: Any, path: Path) -> tuple[int | None, list[int], float, dict[str, Any]]:
    """What an Azure Kinect's recording says of itself: the numbers of its tracks of depth and of
    infrared (one or none); seconds of the camera's clock at the file's time 0; and facts for the
    metadata, JSON-able. Of every other video there is none of that.
    """
    depth, infrared = _tracks(container, "DEPTH"), _tracks(container, "IR")
    if not depth:
        if not any(key.startswith("K4A_") for key in container.metadata):
            return None, [], 0.0, {}
        raise ToftrackError(
            f"'{path}' is a recording of an Azure Kinect without depth; record it with a depth "
            "mode (k4arecorder --depth-mode NFOV_UNBINNED)"
        )
    tags = {**container.streams[depth[0]].metadata, **container.metadata}
    names = {"camera": "title", "serial": "K4A_DEVICE_SERIAL_NUMBER", "mode": "K4A_DEPTH_MODE"}
    facts = {key: tags[name] for key, name in names.items() if name in tags}
    offset = tags.get("K4A_START_OFFSET_NS", "")
    offset_s = int(offset) / 1e9 if offset.isdecimal() else 0.0
    return depth[0], infrared, offset_s, facts


def _camera_of(container: Any, path: Path, width: int, height: int) -> Camera:
    """The depth camera for images of that size, from the attached calibration."""
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
    named = str(model).removeprefix("CALIBRATION_LensDistortionModel") in _MODELS
    if not named or size != (_SENSOR_PX, _SENSOR_PX) or numbers.shape != (14,):
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


def _tracks(container: Any, title: str) -> list[int]:
    """The number of the track of that title, if there is one."""
    return [
        int(stream.index)
        for stream in container.streams.video
        if stream.metadata.get("title") == title or f"K4A_{title}_TRACK" in stream.metadata
    ][:1]


def _attachment(container: Any) -> str | None:
    for stream in container.streams:
        if stream.type == "attachment" and stream.name == _CALIBRATION:
            # As the camera stores it, the text ends with zeros.
            return bytes(stream.data).rstrip(b"\0").decode("utf-8", "replace")
    return None
