"""Archives are written as numpy reads them; those of others are read with bounds."""

import io
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toftrack.files import archives
from toftrack.files.archives import (
    MOST_TEXT_BYTES,
    Archive,
    PickledError,
    Pieces,
    read_archive,
    write_archive,
)

STORED, DEFLATED, BZIP2 = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2
ZEROS = bytes(2**20)
every_method = pytest.mark.parametrize(
    "method", [STORED, DEFLATED, BZIP2], ids=["stored", "deflate", "bzip2"]
)


def npy(array: Any) -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array(content, np.asanyarray(array))
    return content.getvalue()


def header(shape: tuple[int, ...], kind: str = "<f4") -> bytes:
    content = io.BytesIO()
    reported = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(content, reported)
    return content.getvalue()


def save(path: Path, content: dict[str, bytes | list[bytes]], method: int) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, pieces in content.items():
            with archive.open(f"{name}.npy", "w") as stream:
                for piece in [pieces] if isinstance(pieces, bytes) else pieces:
                    stream.write(piece)
    return path


@contextmanager
def little_memory() -> Iterator[None]:
    """tracemalloc sees what Python allocates."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def reported(path: Path) -> str:
    """What is said, after little memory was used."""
    with little_memory(), pytest.raises(ValueError) as error:
        read_archive(path)
    return str(error.value)


@every_method
def test_arrays_of_every_kind_are_read_as_numpy_does(tmp_path: Path, method: int) -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "depth": rng.normal(size=(30, 50, 60)).astype(np.float32),
        "zeros": np.zeros((300, 70), np.uint16),
        "turned": np.asfortranarray(rng.normal(size=(3, 4))),
        "none": np.zeros((0, 3)),
        "one": np.float64(25.0),
        "text": np.array(["palm", "fist"]),
        "flags": np.array([True, False]),
    }
    path = save(tmp_path / "a.npz", {key: npy(value) for key, value in arrays.items()}, method)
    found = read_archive(path)
    assert found.keys() == arrays.keys()
    for key, value in arrays.items():
        assert found[key].dtype == value.dtype
        np.testing.assert_array_equal(found[key], value)
    assert read_archive(path, {"one", "absent"}).keys() == {"one"}


def test_what_was_made_to_fill_memories_is_not_unpacked(tmp_path: Path) -> None:
    shape = (128, 2**20 // 4)
    path = save(tmp_path / "bomb.npz", {"a": [header(shape), *[ZEROS] * 128]}, DEFLATED)
    assert path.stat().st_size < 2**20
    assert "'a': it would unpack" in reported(path)


def test_black_images_beside_others_are_read(tmp_path: Path) -> None:
    black = [header((65, 2**20 // 4)), *[ZEROS] * 65]
    noise = npy(np.random.default_rng(0).normal(size=10_000))
    path = save(tmp_path / "a.npz", {"depth": noise, "amplitude": black}, DEFLATED)
    assert not read_archive(path)["amplitude"].any()


def with_more_than_stated(path: Path, method: int) -> Path:
    """The stated size and the header agree, but much more comes."""
    save(path, {"a": [header((1000,)), *[ZEROS] * 128]}, method)
    forged = bytearray(path.read_bytes())
    size = struct.pack("<I", len(header((1000,))) + 4000)
    at = forged.index(b"PK\x01\x02")
    forged[at + 24 : at + 28] = size
    path.write_bytes(forged)
    return path


def test_more_than_the_directory_states_is_not_unpacked(tmp_path: Path) -> None:
    bomb = with_more_than_stated(tmp_path / "deflated.npz", DEFLATED)
    assert "'a' is damaged: Bad CRC-32" in reported(bomb)
    bomb = with_more_than_stated(tmp_path / "packed.npz", BZIP2)
    with little_memory():
        assert read_archive(bomb)["a"].shape == (1000,)


def test_what_is_written_is_what_numpy_reads(tmp_path: Path) -> None:
    images = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
    pieces = Pieces(images.shape, np.dtype("<f2"), (images[i : i + 2] for i in (0, 2, 4)))
    write_archive(tmp_path / "a.npz", {"images": pieces, "one": 2.5, "text": "words"}, level=1)
    with np.load(tmp_path / "a.npz") as found:
        assert found["images"].dtype == np.float16
        np.testing.assert_array_equal(found["images"], images.astype(np.float16))
        assert found["one"] == 2.5 and found["text"] == "words"


@every_method
def test_a_header_that_claims_too_much_is_not_believed(tmp_path: Path, method: int) -> None:
    claims = {"more": header((2**40,)), "negative": header((-1, 4)), "less": header((1,)) + ZEROS}
    for name, content in claims.items():
        path = save(tmp_path / f"{name}.npz", {"a": content}, method)
        assert "'a'" in reported(path) and "length" in reported(path)


def test_a_header_without_end_is_not_read(tmp_path: Path) -> None:
    long = b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**27)
    path = save(tmp_path / "a.npz", {"a": [long, *[b" " * 2**20] * 128]}, DEFLATED)
    assert "'a': its header is damaged" in reported(path)


def edited(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old, new.ljust(len(old)))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (edited(b"'shape': (4, 5), }", b"'shape': (9**9**9,)}"), "'a'"),
        (edited(b"{'descr': '<f8', 'fortran_order'", b"(" * 32), "'a'"),
        (edited(b"'<f8'", b"'z9'"), "'a'"),
        (edited(b"NUMPY\x01", b"NUMPY\x07"), "it is no array"),
        (edited(b"NUMPY\x01", b"NUMB3\x01"), "it is no array"),
        (lambda content: content[:60], "'a'"),
    ],
)
def test_a_damaged_header_is_reported(tmp_path: Path, edit: Callable, words: str) -> None:
    content = edit(npy(np.ones((4, 5))))
    assert words in reported(save(tmp_path / "a.npz", {"a": content}, STORED))


def test_objects_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.array([{"b": 1}], object))
    with pytest.raises(PickledError, match="'a' holds pickled objects"):
        read_archive(tmp_path / "a.npz")


def test_a_text_that_is_too_long_is_refused(tmp_path: Path) -> None:
    length = MOST_TEXT_BYTES // 4 + 1
    pieces = [header((), f"<U{length}"), *[ZEROS] * (MOST_TEXT_BYTES // len(ZEROS)), bytes(4)]
    path = save(tmp_path / "a.npz", {"a": pieces}, DEFLATED)
    assert "'a': it is text of 67 MB" in reported(path)


def test_a_long_column_of_short_texts_is_read(tmp_path: Path) -> None:
    states = np.full(MOST_TEXT_BYTES // 32 + 1, "lost", "U8")
    path = save(tmp_path / "a.npz", {"a": npy(states)}, STORED)
    np.testing.assert_array_equal(read_archive(path)["a"], states)


def test_an_array_beyond_the_cap_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "MOST_BYTES", 1000)
    path = save(tmp_path / "a.npz", {n: npy(np.ones(100)) for n in "ab"}, STORED)
    assert "it is larger than" in reported(path)
    monkeypatch.setattr(archives, "MOST_BYTES", 100)
    with open(path, "rb") as stream, pytest.raises(ValueError, match="'a': it is larger than"):
        Archive(stream).read("a")


def test_other_compressions_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", {"a": npy(np.ones(3))}, zipfile.ZIP_LZMA)
    assert "'a': its compression is unknown; save it with numpy.savez" in reported(path)


@every_method
def test_random_damage_never_ends_otherwise_than_with_a_value_error(
    tmp_path: Path, method: int
) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "a.npz"
    content = {"a": npy(rng.integers(0, 9, (40, 50))), "b": npy(np.array("text"))}
    whole = save(path, content, method).read_bytes()
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), rng.integers(1, 6)):
            damaged[at] = rng.integers(0, 256)
        path.write_bytes(damaged[: rng.integers(len(whole) // 2, 2 * len(whole))])
        try:
            read_archive(path)
        except ValueError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 75


@pytest.mark.parametrize("kind", ["<U2", ">U2"])
def test_characters_that_are_none_are_reported(kind: str, tmp_path: Path) -> None:
    whole = np.array(["a", "\U0010ffff"], kind)
    path = save(tmp_path / "a.npz", {"a": npy(whole)}, STORED)
    assert read_archive(path)["a"].tolist() == whole.tolist()
    broken = npy(whole)[:-4] + b"\x7f\x7f\x7f\x7f"
    path = save(tmp_path / "b.npz", {"a": broken}, STORED)
    assert "text is damaged" in reported(path)
