"""A folder of depth images, or a `.zip` of one, with a camera file; see docs/formats.md."""

from __future__ import annotations

import io
import os
import stat
import zipfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path, PurePosixPath
from typing import IO, Any

import cv2
import numpy as np

from toftrack.errors import ToftrackError, check_number, reported_errors
from toftrack.files.archives import MOST_TEXT_BYTES, broken_is_value_error
from toftrack.files.json_text import parse_json, write_json
from toftrack.files.safe_files import natural_order, open_new, open_to_read
from toftrack.frames.camera import Camera
from toftrack.recordings.bare import (
    MILLIMETRE,
    MOST,
    NOTHING_GIVEN,
    Given,
    check_metres,
    metres_of,
)
from toftrack.recordings.frame_store import DEFAULT_FPS, FrameStore, file_of
from toftrack.recordings.images import decoded_depth, pages_of

_DEPTH, _PICTURES = (".png", ".tif", ".tiff", ".exr"), (".jpg", ".jpeg", ".bmp", ".webp", ".gif")
_MOST_BYTES = 2**28
_CAMERA, _TIMES = "camera.json", "timestamps.txt"


class Files:
    """The files of a folder, or of those in it where it has no images itself; as names with `/`."""

    def __init__(self, path: Path) -> None:
        self.path, self.what = path, f"the folder '{path}'"
        with self.reported():
            here = sorted(path.iterdir())
            if not any(_is_image(file.name) for file in here):
                here += [file for folder in here if folder.is_dir() for file in folder.iterdir()]
        self.names = [file.relative_to(path).as_posix() for file in here]

    def open(self, name: str) -> IO[bytes]:
        """A file; OSError, or ValueError where it is damaged."""
        return open_to_read(self.path / name)

    def read(self, name: str, most_bytes: int | None = None) -> bytes:
        """The content of a file; ToftrackError."""
        with self.reported(f"'{name}' in {self.what}"), self.open(name) as stream:
            most = most_bytes or _MOST_BYTES
            content = stream.read(most + 1)
            if len(content) > most:
                raise ValueError(f"it is larger than {most // 2**20} MB")
            return content

    def text(self, name: str) -> str:
        """The content of a text; ToftrackError, or ValueError where it is none."""
        return self.read(name, MOST_TEXT_BYTES).decode("utf-8-sig")

    def reported(self, what: str = "") -> AbstractContextManager[None]:
        what = f"{what or self.what} cannot be read"
        return reported_errors(what, "check it and its permissions", OSError, ValueError)

    def close(self) -> None:
        """Nothing is open."""


class ZippedFiles(Files):
    """Those of a `.zip`, which is refused where it has links, or names that lead out of it."""

    def __init__(self, path: Path) -> None:
        self.path, self.what = path, f"the archive '{path}'"
        self._zip: zipfile.ZipFile | None = None
        with self.reported():
            entries = [one for one in self._opened().infolist() if not one.filename.endswith("/")]
            self.names = [entry.filename for entry in entries]
            for entry in entries:
                parts = entry.filename.replace("\\", "/").split("/")
                if ".." in parts or not parts[0] or ":" in parts[0]:
                    raise ValueError(f"its name '{entry.filename}' leads out of it")
                if stat.S_ISLNK(entry.external_attr >> 16):
                    raise ValueError(f"'{entry.filename}' is a link")
            if len(set(self.names)) < len(self.names):
                raise ValueError("it has two files of one name")

    def open(self, name: str) -> IO[bytes]:
        with broken_is_value_error():
            entry = self._opened().getinfo(name)
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("its compression is unknown; zip it in the usual way")
            return self._opened().open(entry)

    def read(self, name: str, most_bytes: int | None = None) -> bytes:
        with self.reported(f"'{name}' in {self.what}"), broken_is_value_error():
            content = super().read(name, most_bytes)
            if len(content) != self._opened().getinfo(name).file_size:
                raise ValueError("it is shorter than the archive says")
            return content

    def _opened(self) -> zipfile.ZipFile:
        if self._zip is None:
            with broken_is_value_error():
                self._zip = zipfile.ZipFile(self.path)
        return self._zip

    def close(self) -> None:
        if self._zip is not None:
            self._zip.close()
        self._zip = None


class ImageFolder(FrameStore):
    """The frames of a folder of depth images, or of a `.zip`, read from the disk one at a time: the
    first image is checked when it is opened.  given: goes before what `camera.json` says.
    """

    unit_m: float

    def __init__(self, folder: Path, given: Given = NOTHING_GIVEN) -> None:
        zipped = folder.suffix.lower() == ".zip" and not folder.is_dir()
        files = self._files = ZippedFiles(file_of(folder)) if zipped else Files(folder)
        self._depth, self._amplitude, self.left_out = _sorted_out(files)
        count, amplitudes = len(self._depth), len(self._amplitude)
        if amplitudes not in (0, count):
            raise ToftrackError(
                f"{files.what} has {count} depth and {amplitudes} amplitude images; there must be "
                "as many of both, or no amplitude"
            )
        first = _decoded(files, self._depth[0])
        self._kind, whole = first.dtype, first.dtype == np.uint16
        self.camera, stated = _camera(files, self._depth[0], first, given)
        path = f"{_CAMERA} of {files.what}"
        self.radial, self.metadata = stated.get("radial", False), stated.get("metadata", {})
        if not isinstance(self.radial, bool) or not isinstance(self.metadata, dict):
            raise ToftrackError(f"in {path}, radial must be true or false, and metadata an object")
        unit_m = given.unit_m or stated.get("depth_unit_m", MILLIMETRE if whole else 1.0)
        fps = given.fps or stated.get("fps", DEFAULT_FPS)
        for name, value in (("depth_unit_m", unit_m), ("fps", fps)):
            check_number(name, value, 0, MOST, above=True, remedy=f" ({path})")
        self.unit_m, self.fps = float(unit_m), float(fps)
        times_s = _timestamps(files, self._depth)
        self.timestamp_s = np.arange(count) / self.fps if times_s is None else times_s
        self.names = tuple(self._depth)
        if not whole:
            what = f"the image '{self._depth[0]}' in {files.what}"
            check_metres(metres_of(first, self.unit_m), what)

    def image(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        depth = metres_of(self._read(self._depth[index], self._kind), self.unit_m)
        if not self._amplitude:
            return depth, None
        return depth, self._read(self._amplitude[index], np.dtype(np.uint16))

    def close(self) -> None:
        self._files.close()

    def _read(self, name: str, kind: np.dtype) -> np.ndarray:
        image = _decoded(self._files, name)
        if image.shape != (self.camera.height, self.camera.width) or image.dtype != kind:
            raise ToftrackError(
                f"the image '{name}' in {self._files.what} is {image.shape[1]}x{image.shape[0]} of "
                f"{image.dtype}, but must be {self.camera.width}x{self.camera.height} of {kind}, "
                "like the others"
            )
        return image


def _is_image(name: str) -> bool:
    return name.lower().endswith(_DEPTH + _PICTURES)


def _sorted_out(files: Files) -> tuple[list[str], list[str], str | None]:
    """Depth and amplitude images, and what else there is, in words; ToftrackError where no depth is
    to be told from the rest."""
    images = [n for n in files.names if _is_image(n) and not _last(n).startswith(".")]
    images = sorted(sorted(images), key=natural_order)
    grey = [name for name in images if not _surely_no_depth(files, name)]
    amplitude = [n for n in grey if _last(n).lower().startswith("amplitude")]
    known = set(amplitude)
    depth = [name for name in grey if name not in known]
    # Infrared has 16 bits, too.
    depth = [name for name in depth if "depth" in name.lower()] or depth
    others = sorted(set(images) - {*depth, *amplitude}, key=natural_order)
    if not depth:
        there = f"; '{others[0]}' is a picture of colours or of 8 bits" if others else ""
        raise ToftrackError(
            f"{files.what} has no depth image (grey of 16 bits, *.png or *.tif, or floats, *.tif or"
            f" *.exr){there}; choose another"
        )
    folders = sorted(folder or "." for folder in {name.rpartition("/")[0] for name in depth})
    if len(folders) > 1:
        raise ToftrackError(
            f"{files.what} has images in {len(folders)} folders, {', '.join(folders[:5])}; give "
            "one of them" + (" by itself" if isinstance(files, ZippedFiles) else "")
        )
    left_out = others and (
        f"{len(others)} images that are not depth, as '{others[0]}', are left out; depth are "
        f"'{depth[0]}' and {len(depth) - 1} others"
    )
    return depth, amplitude, left_out or None


def _last(name: str) -> str:
    """A name without its folders: a path object of each of many would take seconds."""
    return name.rpartition("/")[2]


def _surely_no_depth(files: Files, name: str) -> bool:
    """By what it says of itself; what is damaged is told when its turn comes."""
    if name.lower().endswith(_PICTURES):
        return True
    try:
        with broken_is_value_error(), files.open(name) as stream:
            pages = pages_of(stream)
    except (OSError, ValueError):
        return False
    return bool(pages) and not pages[0].is_depth


def _camera(
    files: Files, image: str, first: np.ndarray, given: Given
) -> tuple[Camera, dict[str, Any]]:
    """The camera of the images, whose first one has that name; and what camera.json says."""
    height, width = first.shape
    content: Any = {}
    if found := _beside(files, image, _CAMERA):
        what = f"the camera file '{found}' in {files.what} cannot be read"
        with reported_errors(what, "write it anew (docs/formats.md)", ValueError):
            content = parse_json(files.text(found))
        if not isinstance(content, dict):
            raise ToftrackError(f"'{found}' in {files.what} is not a camera file")
    what = f"the image '{image}' in {files.what}"
    if lens := given.camera(width, height, what):
        return lens, content
    if not found:
        raise ToftrackError(
            f"{files.what} has no {_CAMERA}; put the camera's file there (docs/formats.md "
            "has an example), or give another with camera.file=FILE (toftrack convert: --camera "
            "FILE), or the lens with device.intrinsics=[FX,FY,CX,CY] (--intrinsics FX FY CX CY)"
        )
    camera = Camera.from_dict(content, files.path / found)
    camera.check_size(first, what)
    return camera, content


def _decoded(files: Files, name: str) -> np.ndarray:
    what = f"the image '{name}' in {files.what} cannot be used"
    with reported_errors(what, "copy or record it again", ValueError):
        return decoded_depth(files.read(name))


def _beside(files: Files, image: str, name: str) -> str | None:
    """A file in the folder of an image, or in those around it."""
    places = (str(parent / name) for parent in PurePosixPath(image).parents)
    return next((place for place in places if place in files.names), None)


def write_image_folder(
    folder: str | Path,
    store: FrameStore,
    unit_m: float = MILLIMETRE,
    progress: Callable[[], object] = lambda: None,
) -> None:
    """Write any recording as a folder of PNG images that `ImageFolder` reads.

    folder: made when it does not exist; must hold nothing of such a folder.  unit_m: metres of one
    step, to which depth is rounded; no reading and what is too far become 0.  progress: called
    after each frame.
    """
    folder = Path(os.path.expanduser(folder))
    facts = {"depth_unit_m": unit_m, "radial": store.radial, "fps": store.fps}
    content = store.camera.to_dict() | facts | {"metadata": store.metadata}

    def save(name: str, image: np.ndarray) -> None:
        with open_new(folder / name) as stream:
            stream.write(cv2.imencode(".png", image)[1].tobytes())

    with reported_errors(f"the folder '{folder}' cannot be written", "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        names = (_CAMERA, _TIMES)
        if any(at.suffix.lower() in _DEPTH or at.name in names for at in folder.iterdir()):
            raise ToftrackError(
                f"the folder '{folder}' has images, {_CAMERA} or {_TIMES} already; choose an empty "
                "one"
            )
        write_json(folder / _CAMERA, content)
        with io.TextIOWrapper(open_new(folder / _TIMES), encoding="utf-8") as times:
            for number, time_s in enumerate(store.timestamp_s):
                depth_m, amplitude = store.image(number)
                steps = metres_of(depth_m, 1.0).astype(np.float64) / unit_m
                words = np.where(steps <= 0xFFFF, np.rint(steps), 0).astype(np.uint16)
                save(f"depth_{number:06d}.png", words)
                if amplitude is not None:
                    save(f"amplitude_{number:06d}.png", amplitude)
                times.write(f"{float(time_s)!r}\n")
                progress()


def _timestamps(files: Files, depth: list[str]) -> np.ndarray | None:
    path = _beside(files, depth[0], _TIMES)
    if path is None:
        return None
    what, count = f"'{path}' in {files.what} cannot be used", len(depth)
    remedy = f"it needs {count} finite times, one an image, never going back; repair or remove it"
    with reported_errors(what, remedy, ValueError):
        words = files.text(path).split(maxsplit=count)
        times = np.array([float(word) for word in words[:count]])
        if len(words) != count or not np.isfinite(times).all() or (np.diff(times) < 0).any():
            raise ValueError("too few, too many, backwards or not finite")
    return times
