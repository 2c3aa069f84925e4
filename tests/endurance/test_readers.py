"""Whatever a file holds, its reader reads it or refuses it with one sentence."""

import io
import json
import os
import zipfile
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.readers import Reader, write_readers

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings.npz import Recording, read_recording, write_recording

hypothesis = pytest.importorskip("hypothesis", reason="hypothesis is not installed")

from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.extra import numpy as nps  # noqa: E402

pytestmark = pytest.mark.endurance

_PATIENT = settings(
    deadline=timedelta(seconds=10),
    max_examples=int(os.environ.get("ENDURANCE_EXAMPLES", "500")),
    suppress_health_check=list(HealthCheck),
)
_SCALARS = st.one_of(
    *(nps.boolean_dtypes(), nps.integer_dtypes(), nps.unsigned_integer_dtypes()),
    *(nps.floating_dtypes(), nps.complex_number_dtypes(), nps.datetime64_dtypes()),
    *(nps.unicode_string_dtypes(max_len=4), nps.byte_string_dtypes(max_len=4)),
)
_ARRAYS = nps.arrays(_SCALARS, nps.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
_NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([1e308, 10**30, 2**63, -0.0]))
_JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), _NUMBERS, st.text(max_size=5)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> list[Reader]:
    return write_readers(tmp_path_factory.mktemp("readers"))


def _of(readers: list[Reader], *suffixes: str) -> list[Reader]:
    return [reader for reader in readers if reader.file.suffix in suffixes]


def _reads_or_refuses(reader: Reader, content: bytes) -> None:
    """The reader is given the content, and the valid file is put back."""
    valid = reader.file.read_bytes()
    reader.file.write_bytes(content)
    try:
        reader.read(reader.given)
    except ToftrackError as error:
        assert str(error)
        assert "\n" not in str(error)
    finally:
        reader.file.write_bytes(valid)


def _archive(arrays: dict[str, np.ndarray]) -> bytes:
    target = io.BytesIO()
    np.savez(target, **arrays)
    return target.getvalue()


def test_valid_files_are_read(readers: list[Reader]) -> None:
    for reader in readers:
        reader.read(reader.given)


@_PATIENT
@given(data=st.data())
def test_any_bytes(readers: list[Reader], data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(readers))
    _reads_or_refuses(reader, data.draw(st.binary(max_size=300)))


@_PATIENT
@given(data=st.data())
def test_changed_bytes(readers: list[Reader], data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(readers))
    content = bytearray(reader.file.read_bytes())
    place = st.integers(0, len(content) - 1) | st.integers(0, min(len(content), 400) - 1)
    for at, byte in data.draw(st.lists(st.tuples(place, st.integers(0, 255)), max_size=20)):
        content[at] = byte
    length = data.draw(st.just(len(content)) | st.integers(0, len(content)))
    _reads_or_refuses(reader, bytes(content[:length]))


@_PATIENT
@given(data=st.data())
def test_any_arrays(readers: list[Reader], data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(_of(readers, ".npz")))
    with zipfile.ZipFile(reader.file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
    with np.load(reader.file) as content:
        arrays = {name: content[name] for name in names}
    for name in data.draw(st.lists(st.sampled_from(names), min_size=1, max_size=3)):
        like = nps.arrays(_SCALARS, arrays[name].shape) if arrays[name].size < 500 else _ARRAYS
        arrays[name] = data.draw(_ARRAYS | like)
    for name in data.draw(st.lists(st.sampled_from(names), max_size=1)):
        del arrays[name]
    _reads_or_refuses(reader, _archive(arrays))


@_PATIENT
@given(array=_ARRAYS, data=st.data())
def test_any_stack(readers: list[Reader], array: np.ndarray, data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(_of(readers, ".npy")))
    target = io.BytesIO()
    np.save(target, array)
    _reads_or_refuses(reader, target.getvalue())


def _with_another_value(data: st.DataObject, content: Any) -> Any:
    """JSON of which one value, or all, is another."""
    holder: Any = {"": content}
    key: Any = ""
    while isinstance(holder[key], (dict, list)) and holder[key] and data.draw(st.booleans()):
        inner = holder[key]
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        holder, key = inner, data.draw(st.sampled_from(keys))
    holder[key] = data.draw(_JSON)
    return content if key != "" else holder[key]


@_PATIENT
@given(data=st.data())
def test_any_json(readers: list[Reader], data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(_of(readers, ".json")))
    changed = _with_another_value(data, json.loads(reader.file.read_bytes()))
    _reads_or_refuses(reader, json.dumps(changed).encode())


@_PATIENT
@given(data=st.data())
def test_any_line(readers: list[Reader], data: st.DataObject) -> None:
    (reader,) = _of(readers, ".jsonl")
    lines = [json.loads(line) for line in reader.file.read_text().splitlines()]
    at = data.draw(st.integers(0, len(lines) - 1))
    lines[at] = _with_another_value(data, lines[at])
    _reads_or_refuses(reader, "".join(json.dumps(line) + "\n" for line in lines).encode())


@_PATIENT
@given(data=st.data())
def test_any_text(readers: list[Reader], data: st.DataObject) -> None:
    reader = data.draw(st.sampled_from(_of(readers, ".csv", ".txt", ".yaml")))
    lines = reader.file.read_text().splitlines()
    cell = st.text(max_size=12) | _NUMBERS.map(str)
    at = data.draw(st.integers(0, len(lines) - 1))
    cells = lines[at].split(",")
    cells[data.draw(st.integers(0, len(cells) - 1))] = data.draw(cell)
    lines[at] = ",".join(cells)
    text = "\n".join(lines) + data.draw(st.sampled_from(["", "\n", "\r\n\n"]))
    _reads_or_refuses(reader, text.encode("utf-8", "surrogatepass"))


@_PATIENT
@given(
    depth=nps.arrays(
        st.sampled_from(["f2", "f4"]),
        nps.array_shapes(min_dims=3, max_dims=3, max_side=6),
        elements=st.floats(0.125, 8, width=16) | st.just(0.0),
    ),
    focal=st.floats(0.2, 40),
    radial=st.booleans(),
)
def test_a_recording_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, depth: np.ndarray, focal: float, radial: bool
) -> None:
    count, height, width = depth.shape
    size = max(height, width)
    K = np.array([[focal * size, 0, width / 2], [0, focal * size, height / 2], [0, 0, 1]])
    times = np.arange(count) / 25
    path: Path = tmp_path_factory.mktemp("written") / "recording.npz"
    camera = Camera(K, width, height)
    write_recording(
        path, Recording(depth=depth, radial=radial, camera=camera, timestamp_s=times, fps=25.0)
    )
    read = read_recording(path)
    assert read.radial == radial
    assert (read.camera.K == K).all()
    for number in range(count):
        assert (read.image(number)[0] == depth[number]).all()
    read.close()
