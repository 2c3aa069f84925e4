"""What holds for recordings of every kind: whole, damaged, cut off, or not there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers import bags, videos
from helpers.damage import damaged

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings import npz
from toftrack.recordings.bare import Given
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.image_folder import write_image_folder
from toftrack.recordings.npz import StreamedImages, read_recording
from toftrack.recordings.sr_frame import HEIGHT, WIDTH, encode_frame, unambiguous_range_m
from toftrack.recordings.srs import SrsWriter
from toftrack.recordings.store import open_recording

COUNT = 9
CAMERA = Camera(np.array([[252.0, 0, 166.0], [0, 253.0, 140.0], [0, 0, 1]]), 320, 288)
GIVEN = Given((252.0, 253.0, 166.0, 140.0))
RANGE_M = unambiguous_range_m(20)


def of_npz(folder: Path, words: np.ndarray, save: Callable = np.savez) -> Path:
    save(folder / "a.npz", depth_m=metres(words), amplitude=words[:, ::-1], K=CAMERA.K)
    return folder / "a.npz"


def of_srs(folder: Path, words: np.ndarray) -> Path:
    with closing(SrsWriter(folder / "a.srs")) as writer:
        for number, image in enumerate(words[:, :HEIGHT, :WIDTH]):
            frame = encode_frame(metres(image), image[::-1], RANGE_M)
            writer.append(frame, number / 25)
    return folder / "a.srs"


def of_folder(folder: Path, words: np.ndarray) -> Path:
    of_npz(folder, words)
    write_image_folder(folder / "a", read_recording(folder / "a.npz"))
    return folder / "a"


def of_kinect(folder: Path, words: np.ndarray) -> Path:
    about = videos.calibration(CAMERA.K, 512, (96, 90))
    return videos.write_kinect(folder / "a.mkv", words, words[:, ::-1], about)


def of_bag(kind: str) -> Callable[[Path, np.ndarray], Path]:
    return lambda folder, words: bags.write_bag(
        folder, kind, bags.recording(list(metres(words)), CAMERA)
    )


KINDS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "npz": of_npz,
    "long npz": lambda folder, words: of_npz(folder, words, np.savez_compressed),
    "srs": of_srs,
    "folder": of_folder,
    "kinect": of_kinect,
    "grey mkv": lambda folder, words: videos.write_grey(folder / "a.mkv", words),
    "grey avi": lambda folder, words: videos.write_grey(folder / "a.avi", words),
    **{kind: of_bag(kind) for kind in bags.KINDS},
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def metres(words: np.ndarray) -> np.ndarray:
    return words.astype(np.float32) / 1000


@pytest.fixture
def words() -> np.ndarray:
    """(COUNT, 288, 320) uint16 millimetres."""
    return np.random.default_rng(0).integers(300, 2000, (COUNT, 288, 320)).astype(np.uint16)


@pytest.fixture
def path(kind: str, tmp_path: Path, words: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> Path:
    if kind == "long npz":  # too long to be loaded
        monkeypatch.setattr(npz, "LOADED_BYTES", 100_000)
    return KINDS[kind](tmp_path, words)


def opened(path: Path) -> FrameStore:
    return open_recording(path, GIVEN)


@each_kind
def test_frames_come_in_any_order_and_after_closing(
    path: Path, words: np.ndarray, kind: str
) -> None:
    store = opened(path)
    assert len(store) == COUNT and store.damage is None
    assert isinstance(getattr(store, "depth", None), StreamedImages) == (kind == "long npz")
    height, width = store.camera.height, store.camera.width
    for number in (4, 5, 5, 1, 6, 0, 8):
        depth, amplitude = store.image(number)
        np.testing.assert_allclose(depth, metres(words[number, :height, :width]), atol=6e-5)
        if amplitude is not None:
            np.testing.assert_array_equal(amplitude, words[number, :height, :width][::-1])
        assert (amplitude is None) == (kind in ("grey mkv", "grey avi", *bags.KINDS))
        depth[:] = 0  # the caller's own
        if number == 6:
            store.close()
    store.close()


@each_kind
def test_whatever_is_damaged_or_cut_off_it_is_read_or_reported(path: Path) -> None:
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.suffix != ".yaml")
    content = files[0].read_bytes()
    cut = [content[: int(share * len(content))] for share in (0, 0.002, 0.3, 0.9, 0.999)]
    for new in (*cut, *(damaged(content, seed) for seed in range(12))):
        files[0].write_bytes(new)
        try:
            store = opened(path)
            assert new not in cut or path.is_dir() or len(store) <= COUNT
            for number in range(len(store)):
                store.image(number)
            store.close()
        except ToftrackError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.mkv", "a.bag", "a"])
def test_what_is_not_there_is_reported(tmp_path: Path, name: str) -> None:
    with pytest.raises(ToftrackError, match=f"there is no (file|bag) .*{name}'; give the path"):
        opened(tmp_path / name)


def test_a_store_of_somebody_elses_may_call_that_of_its_base() -> None:
    class Other(FrameStore):
        def __init__(self) -> None:
            super().__init__()

    assert Other().names == ()
