"""Stacks in one file: what comes out, what is chosen, what is refused."""

import contextlib
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from helpers.damage import damaged
from scipy.io import savemat

from toftrack.api import make_device
from toftrack.errors import ToftrackError
from toftrack.recordings import matlab, stacks
from toftrack.recordings.bare import Given
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.store import ELSEWHERE, open_recording

COUNT, HEIGHT, WIDTH = 5, 24, 32
GIVEN = Given((40.0, 40.0, 15.5, 11.5))
RANDOM = np.random.default_rng(0)
WORDS = RANDOM.integers(300, 2000, (COUNT, HEIGHT, WIDTH)).astype(np.uint16)
METRES = WORDS.astype(np.float32) / 1000


def h5py() -> Any:
    return pytest.importorskip("h5py", reason="h5py is not installed")


def hdf5(path: Path, **arrays: Any) -> Path:
    with h5py().File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, compression="gzip", chunks=True)
    return path


def npy(path: Path, images: np.ndarray) -> Path:
    np.save(path, images)
    return path


def tiff(path: Path, images: np.ndarray, rows_a_strip: int = 5) -> Path:
    cv2.imwritemulti(str(path), list(images), [cv2.IMWRITE_TIFF_ROWSPERSTRIP, rows_a_strip])
    return path


def mat(path: Path, **arrays: Any) -> Path:
    savemat(path, arrays, do_compression=True)
    return path


def matlab_7_3(path: Path, images: np.ndarray) -> Path:
    with h5py().File(path, "w", userblock_size=512) as file:
        file.create_dataset("depth", data=images.transpose(0, 2, 1))
    content = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + content[512:])
    return path


MATLABS = METRES.transpose(1, 2, 0)
KINDS: dict[str, Callable[[Path], Path]] = {
    "whole .npy": lambda at: npy(at / "a.npy", WORDS.astype(np.int32)),
    "float .npy": lambda at: npy(at / "a.npy", METRES.astype(np.float64)),
    "16-bit TIFF": lambda at: tiff(at / "a.tif", WORDS),
    "float TIFF": lambda at: tiff(at / "a.TIFF", METRES),
    "HDF5": lambda at: hdf5(at / "a.h5", depth=WORDS),
    "HDF5, frames last": lambda at: hdf5(at / "a.hdf5", depth=MATLABS),
    "MATLAB": lambda at: mat(at / "a.mat", depth=MATLABS),
    "SciPy's .mat": lambda at: mat(at / "a.mat", depth=WORDS),
    "MATLAB 7.3": lambda at: matlab_7_3(at / "a.mat", METRES),
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def opened(path: Path, dataset: str | None = None) -> FrameStore:
    return open_recording(path, Given(GIVEN.intrinsics, dataset=dataset))


@each_kind
def test_every_stack_gives_the_frames_that_went_in(tmp_path: Path, kind: str) -> None:
    store = opened(KINDS[kind](tmp_path))
    assert (len(store), store.fps, store.camera.width) == (COUNT, 25, WIDTH)
    for number in (3, 0, 4, 4):
        depth, amplitude = store.image(number)
        np.testing.assert_allclose(depth, METRES[number], atol=1e-6)
        assert depth.dtype == np.float32 and amplitude is None
        store.close()


@each_kind
def test_what_is_damaged_or_cut_off_is_read_or_told(tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path)
    content = path.read_bytes()
    often = 1 if kind in ("MATLAB", "SciPy's .mat") else 10  # each in a process of its own
    cut = [content[: len(content) * part // (2 * often)] for part in range(1, 2 * often)]
    for new in (*cut, *(damaged(content, seed) for seed in range(3 * often))):
        path.write_bytes(new)
        with contextlib.suppress(ToftrackError):
            store = opened(path)
            for number in range(min(len(store), COUNT)):
                store.image(number)
            store.close()


def test_a_npy_that_shrinks_while_it_is_read_is_told(tmp_path: Path) -> None:
    """Where it was mapped into memory the system would end the process."""
    path = npy(tmp_path / "a.npy", WORDS)
    store = opened(path)
    os.truncate(path, path.stat().st_size - HEIGHT * WIDTH * 2)
    np.testing.assert_allclose(store.image(3)[0], METRES[3], atol=1e-6)
    with pytest.raises(ToftrackError, match="frame 4 of '.*' cannot be read"):
        store.image(4)


def test_a_npy_in_fortran_order_is_loaded_where_it_is_not_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = npy(tmp_path / "a.npy", np.asfortranarray(WORDS))
    np.testing.assert_allclose(opened(path).image(3)[0], METRES[3], atol=1e-6)
    monkeypatch.setattr(stacks, "MOST_BYTES", WORDS.nbytes - 1)
    with pytest.raises(ToftrackError, match="numpy.ascontiguousarray"):
        opened(path)


def test_a_single_image_is_a_stack_of_one(tmp_path: Path) -> None:
    store = opened(npy(tmp_path / "a.npy", WORDS[0]))
    assert len(store) == 1
    np.testing.assert_allclose(store.image(0)[0], METRES[0], atol=1e-6)


@pytest.mark.parametrize(
    ("stack", "words"),
    [
        (np.ones((2, 3, 4, 3)), "must be depth images"),
        (np.full((2, 24, 32), 900.0), "plainly in another unit.*--source-unit"),
        (np.array([[None] * 4] * 3), "Python objects"),
    ],
)
def test_a_npy_of_another_kind_is_reported(tmp_path: Path, stack: np.ndarray, words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        opened(npy(tmp_path / "a.npy", stack))


@pytest.mark.parametrize(
    "shape", ["(-1, 24, 32)}", "(3, 24, 32, }", "(3, 24, 32)}" + 10_000 * " ", f"({30 * '9'},)}}"]
)
def test_a_npy_whose_header_lies_is_reported(tmp_path: Path, shape: str) -> None:
    text = f"{{'descr': '<u2', 'fortran_order': False, 'shape': {shape}\n".encode()
    header = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    (tmp_path / "a.npy").write_bytes(header + bytes(4608))
    with pytest.raises(ToftrackError, match="a.npy' cannot be read"):
        opened(tmp_path / "a.npy")


@pytest.mark.parametrize("write", [hdf5, mat], ids=["h5", "mat"])
def test_the_dataset_is_chosen_by_its_name(tmp_path: Path, write: Callable[..., Path]) -> None:
    path = write(tmp_path / f"a.{'h5' if write is hdf5 else 'mat'}", depth=WORDS, ir=WORDS // 2)
    with pytest.raises(ToftrackError, match=r"device\.dataset=NAME.*depth.*ir"):
        opened(path)
    np.testing.assert_allclose(opened(path, "ir").image(1)[0], WORDS[1] // 2 / 1000, atol=1e-6)


def test_dataset_unit_and_rate_are_given_on_the_command_line(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "a.h5", depth=WORDS, ir=WORDS // 2)
    with pytest.raises(ToftrackError, match="no array of images 'color'.*depth"):
        opened(path, "color")
    words = [f"device.path='{path}'", "device.dataset=/depth", "device.unit_m=0.0005"]
    lens = "device.intrinsics=[40,40,15.5,11.5]"
    with make_device("device=replay", *words, lens, "device.fps=50") as device:
        first = next(iter(device))
    assert device.fps == 50
    np.testing.assert_allclose(first.depth, METRES[0] / 2, atol=1e-6)


def directory(width: int, height: int, following: int = 0, tile: int = 0) -> bytes:
    tags = {256: width, 257: height, 258: 16, 277: 1, 339: 1} | (
        {322: tile, 323: tile} if tile else {}
    )
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", following)


LARGE = directory(60_000, 60_000)
TWO_WIDTHS = LARGE[:8] + b"\6\0" + LARGE[10:22] + struct.pack("<HHII", 256, 4, 1, 1) + LARGE[22:]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (LARGE, "larger than any camera's"),
        (TWO_WIDTHS, "it is damaged"),
        (directory(32, 24, 0, 100_000), "tiles are larger"),
        (directory(32, 24, 8), "no end"),
        (b"II+\0" + bytes(4) + struct.pack("<Q", 2**63), "damaged"),
        (cv2.imencode(".tif", np.zeros((4, 4, 3), np.uint8))[1].tobytes(), "grey"),
    ],
)
def test_a_tiff_that_lies_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(ToftrackError, match=f"a.tif' cannot be read .*{words}"):
        opened(tmp_path / "a.tif")


def test_a_chunk_of_hdf5_is_unpacked_once_for_all_its_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = opened(hdf5(tmp_path / "a.h5", depth=WORDS))
    read = Mock(wraps=h5py().Dataset.__getitem__)
    monkeypatch.setattr(h5py().Dataset, "__getitem__", lambda *given: read(*given))
    for number in range(COUNT):
        np.testing.assert_allclose(stack.image(number)[0], METRES[number], rtol=1e-6)
    assert read.call_count <= 1


def test_an_image_of_a_tiff_is_read_without_those_before_it(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", WORDS)
    stack = opened(path)
    content = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", content, 4)
    content[first : first + 2] = bytes(2)
    path.write_bytes(content)
    np.testing.assert_allclose(stack.image(2)[0], METRES[2], rtol=1e-6)


def test_a_tiff_without_the_sizes_of_its_strips_is_read(tmp_path: Path) -> None:
    content = tiff(tmp_path / "a.tif", WORDS, len(WORDS[0])).read_bytes()
    sizes = struct.pack("<HHI", 279, 4, 1)
    assert content.count(sizes) == COUNT
    (tmp_path / "a.tif").write_bytes(content.replace(sizes, struct.pack("<HHI", 280, 4, 1)))
    np.testing.assert_allclose(opened(tmp_path / "a.tif").image(2)[0], METRES[2], rtol=1e-6)


def test_what_hdf5_keeps_elsewhere_or_makes_of_nothing_is_not_read(tmp_path: Path) -> None:
    h5 = h5py()
    secret = hdf5(tmp_path / "secret.h5", depth=WORDS)
    (tmp_path / "secret.raw").write_bytes(WORDS.tobytes())
    with h5.File(tmp_path / "a.h5", "w") as file:
        file["link"] = h5.ExternalLink(secret, "/depth")
        virtual = h5.VirtualLayout(WORDS.shape, WORDS.dtype)
        virtual[:] = h5.VirtualSource(secret, "depth", WORDS.shape)
        file.create_virtual_dataset("virtual", virtual)
        where = [(str(tmp_path / "secret.raw"), 0, WORDS.nbytes)]
        file.create_dataset("external", WORDS.shape, WORDS.dtype, external=where)
        file.create_dataset("text", (2, 3, 4), dtype=h5.string_dtype())
    for name in (None, "link", "virtual", "external", "text"):
        with pytest.raises(ToftrackError, match="no array of images.*there is none"):
            opened(tmp_path / "a.h5", name)
    with h5.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("depth", (10**6, HEIGHT, WIDTH), "u2", chunks=(1, HEIGHT, WIDTH))
    with pytest.raises(ToftrackError, match="would unpack 0 bytes to 1536 MB"):
        opened(tmp_path / "b.h5")


def test_a_mat_file_that_would_fill_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matlab, "MOST_BYTES", 2**22)
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(2**16)) for _ in range(70)) + packer.flush()
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "a.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(ToftrackError, match="larger than a gigabyte"):
        opened(tmp_path / "a.mat")


@pytest.mark.parametrize("dataset", [None, "frames"])
def test_images_in_a_cell_are_told_from_what_lies_beside_them(
    tmp_path: Path, dataset: str | None
) -> None:
    cell = np.empty((2, 1), object)
    cell[:, 0] = list(METRES[:2])
    path = mat(tmp_path / "a.mat", frames=cell, boxes=np.ones((2, 4)))
    with pytest.raises(ToftrackError, match=r"cat\(3, frames{:}\)"):
        opened(path, dataset)
    path = mat(tmp_path / "b.mat", depth=np.ones((64, 80), np.float32), labels=cell)
    assert len(opened(path)) == 1, "a single image has its labels in a cell"


def test_whole_numbers_of_a_mat_file_count_by_their_own_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = matlab._PROGRAM.replace(str(2**30), str(WORDS.nbytes))
    monkeypatch.setattr(matlab, "_PROGRAM", program)
    assert len(opened(mat(tmp_path / "a.mat", depth=WORDS))) == COUNT
    with pytest.raises(ToftrackError, match="larger than a gigabyte"):
        opened(mat(tmp_path / "a.mat", depth=METRES))


def test_a_matlab_file_that_crashes_its_reader_gives_one_sentence(tmp_path: Path) -> None:
    """As SciPy 1.17 does where the type of an array's elements is none."""
    savemat(tmp_path / "a.mat", {"a": METRES.astype(np.float64)})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    content[content.index(np.array([9, 8 * METRES.size], "<u4").tobytes())] = 127
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(ToftrackError, match="a.mat' cannot be read .*; it is damaged"):
        opened(tmp_path / "a.mat")


def test_modules_beside_a_matlab_file_are_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    assert len(opened(mat(tmp_path / "a.mat", depth=METRES))) == COUNT


def test_other_kinds_get_a_sentence_of_their_own_and_unknown_ones_are_no_archives(
    tmp_path: Path,
) -> None:
    for suffix in (*ELSEWHERE, ".foo", ""):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(os.urandom(99))
        with pytest.raises(ToftrackError, match="' is not read") as caught:
            open_recording(path)
        assert "archive" not in str(caught.value) or ".zip" in str(caught.value)
    np.savez(tmp_path / "b.npz", depth_m=METRES, K=np.diag((40, 40, 1)))
    assert len(open_recording((tmp_path / "b.npz").rename(tmp_path / "b.mine"))) == COUNT
