"""A folder of depth images, 16-bit PNG, with a camera file.

| file | content |
| --- | --- |
| `*.png` | one depth image a frame, 16 bits, in the order of their names (numbers by value) |
| `amplitude*.png` | optional: the amplitude images, 16 bits, as many and in the same order |
| `camera.json` | the camera as `Camera.save` writes it, and more keys, see below |
| `timestamps.txt` | optional: the frames' times, seconds, a line each |

The optional further keys of `camera.json`: `depth_unit_m` (metres of one step, 0.001), `radial`
(false), `fps` (25), `metadata` (an object).
"""

from __future__ import annotations

import io
import json
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import read_json
from toftrack.files.safe_files import open_new, open_to_read, write_whole
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import MILLIMETRE, NOTHING_GIVEN, BareFacts, is_positive
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore
from toftrack.recordings.png import read_png

_CAMERA, _TIMES = "camera.json", "timestamps.txt"


class PngFolder(FrameStore):
    """The frames of a folder, read from the disk one at a time. Raises ToftrackError where
    `stated`, the content of the folder's `camera.json`, makes no sense.
    """

    unit_m: float

    def __init__(
        self,
        folder: Path,
        depth: list[Path],
        amplitude: list[Path],
        camera: Camera,
        stated: dict[str, Any],
        bare: BareFacts,
    ) -> None:
        self.camera, path = camera, folder / _CAMERA
        self._depth, self._amplitude = depth, amplitude
        self.radial, self.metadata = stated.get("radial", False), stated.get("metadata", {})
        if not isinstance(self.radial, bool) or not isinstance(self.metadata, dict):
            raise ToftrackError(
                f"in '{path}', radial must be true or false, and metadata an object"
            )
        unit_m = bare.unit_m or stated.get("depth_unit_m", MILLIMETRE)
        fps = bare.fps or stated.get("fps", DEFAULT_FPS)
        for name, value in (("depth_unit_m", unit_m), ("fps", fps)):
            if not is_positive(value):
                raise ToftrackError(
                    f"{name} must be a positive number, but is {value!r} ('{path}')"
                )
        self.unit_m, self.fps = float(unit_m), float(fps)
        times_s = _timestamps(folder / _TIMES, len(depth))
        self.timestamp_s = np.arange(len(depth)) / self.fps if times_s is None else times_s

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        depth = self._read(self._depth[index]).astype(np.float32) * np.float32(self.unit_m)
        return depth, self._read(self._amplitude[index]) if self._amplitude else None

    def _read(self, path: Path) -> np.ndarray:
        return read_png(path, np.uint16, (self.camera.height, self.camera.width))


def read_png_folder(
    folder: str | Path,
    camera_file: str | Path | None = None,
    bare: BareFacts = NOTHING_GIVEN,
) -> PngFolder:
    """Open a folder of depth images: the first one is checked, the others stay on the disk.

    camera_file: instead of the folder's `camera.json`.  bare: what is given goes before what
    `camera.json` says; the unit is else 0.001, fps 25. Raises ToftrackError: there is no folder,
    image or camera, or the first image is not a 16-bit grey PNG, or of another size than the
    camera's; later, another one.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ToftrackError(f"there is no folder '{folder}'; give a folder of 16-bit PNG images")
    with reported_errors(f"the folder '{folder}' cannot be read", "check its permissions"):
        images = sorted((p for p in folder.iterdir() if p.suffix.lower() == ".png"), key=_order)
    amplitude = [path for path in images if path.name.lower().startswith("amplitude")]
    depth = [path for path in images if path not in set(amplitude)]
    if not depth:
        raise ToftrackError(f"the folder '{folder}' has no depth image (*.png); choose another")
    if amplitude and len(amplitude) != len(depth):
        raise ToftrackError(
            f"the folder '{folder}' has {len(depth)} depth and {len(amplitude)} amplitude images; "
            "there must be as many of both, or no amplitude"
        )
    height, width = read_png(depth[0], np.uint16).shape
    content = _camera_content(folder / _CAMERA)
    if camera_file is not None:
        camera = Camera.load(camera_file)
    elif configured := bare.camera(width, height):
        camera = configured
    elif content is not None:
        camera = Camera.from_dict(content, folder / _CAMERA)
    else:
        raise ToftrackError(
            f"the folder '{folder}' has no {_CAMERA}; put the camera's file there (docs/formats.md "
            "has an example), or give another with camera.file=FILE (toftrack convert: --camera "
            "FILE), or the lens with device.intrinsics=[FX,FY,CX,CY] (--intrinsics FX FY CX CY)"
        )
    if (width, height) != (camera.width, camera.height):
        raise ToftrackError(
            f"the image '{depth[0]}' has {width}x{height} pixels, but the camera has "
            f"{camera.width}x{camera.height}; give the camera of these images"
        )
    return PngFolder(folder, depth, amplitude, camera, content or {}, bare)


class PngFolderWriter:
    """Writes a folder that `read_png_folder` reads; use it with `with`.

    folder: made when it does not exist; must not contain PNG images.  unit_m: metres of one step of
    the depth images.  camera, radial, fps, metadata (JSON-able) go to `camera.json`. Raises
    ToftrackError: the folder cannot be written or is in use.
    """

    def __init__(
        self,
        folder: str | Path,
        camera: Camera,
        unit_m: float = 0.001,
        radial: bool = False,
        fps: float = DEFAULT_FPS,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        self.folder, self.unit_m, self.frames = Path(folder).expanduser(), unit_m, 0
        facts = {"depth_unit_m": unit_m, "radial": radial, "fps": fps, "metadata": metadata or {}}
        with self._writing():
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.glob("*.png")):
                raise ToftrackError(
                    f"the folder '{self.folder}' contains PNG images already; choose an empty one"
                )
            text = json.dumps(camera.to_dict() | facts, indent=1) + "\n"
            write_whole(self.folder / _CAMERA, text)
            self._times = io.TextIOWrapper(
                open_new(self.folder / _TIMES, replace=True), encoding="utf-8"
            )

    def append(self, depth_m: np.ndarray, amplitude: np.ndarray | None, timestamp_s: float) -> None:
        """Add a frame: (H, W) metres, rounded to the unit (no reading and too far become 0), and
        the (H, W) uint16 amplitude. Raises ToftrackError when it cannot be written."""
        valid = (depth_m > 0) & (depth_m < np.inf)
        steps = np.where(valid, depth_m, 0).astype(np.float64) / self.unit_m
        words = np.where(steps <= 0xFFFF, np.rint(steps), 0).astype(np.uint16)
        with self._writing():
            self._save(f"depth_{self.frames:06d}.png", words)
            if amplitude is not None:
                self._save(f"amplitude_{self.frames:06d}.png", amplitude)
            self._times.write(f"{timestamp_s!r}\n")
        self.frames += 1

    def close(self) -> None:
        with self._writing():
            self._times.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _save(self, name: str, image: np.ndarray) -> None:
        with open_new(self.folder / name) as stream:
            stream.write(cv2.imencode(".png", image)[1].tobytes())

    def _writing(self) -> AbstractContextManager[None]:
        what = f"the folder '{self.folder}' cannot be written"
        return reported_errors(what, "choose another place")


def _camera_content(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    what = f"the camera file '{path}' cannot be read"
    with reported_errors(what, "write it anew (docs/formats.md)", OSError, ValueError):
        content = read_json(path)
    if not isinstance(content, dict):
        raise ToftrackError(f"'{path}' is not a camera file")
    return content


def _timestamps(path: Path, count: int) -> np.ndarray | None:
    if not path.exists():
        return None
    what, remedy = f"'{path}' cannot be read", "it must consist of one number a line"
    with reported_errors(what, remedy, OSError, ValueError), open_to_read(path) as stream:
        times = np.array([float(word) for word in stream.read().decode("utf-8").split()])
    if len(times) != count or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise ToftrackError(
            f"'{path}' must hold {count} finite times, one for each depth image, that do not go "
            "backwards; repair or remove it"
        )
    return times


def _order(path: Path) -> list[tuple[int, int, str]]:
    """Sorts names with numbers in them by value: 2 before 10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(p), p) if p.isdecimal() else (1, 0, p) for p in parts]
