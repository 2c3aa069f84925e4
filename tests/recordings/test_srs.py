"""The vendor's stream file: what is written is read back bit by bit, and broken files are told."""

import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings.sr_frame import (
    FRAME_BYTES,
    HEIGHT,
    WIDTH,
    decode_frame,
    encode_frame,
    unambiguous_range_m,
)
from toftrack.recordings.srs import SrsFacts, SrsInit, SrsRecording, SrsWriter

RANGE_M = unambiguous_range_m(20)
FRAMES = 4


def raw_frames(count: int = FRAMES) -> list[bytes]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 3000, 2 * WIDTH * HEIGHT, "<u2").tobytes() for _ in range(count)]


def record(path: Path, count: int = FRAMES) -> list[bytes]:
    frames = raw_frames(count)
    facts = SrsFacts(RANGE_M, Camera(np.diag((210.0, 211, 1)), WIDTH, HEIGHT), 50.0, {"who": "me"})
    with closing(SrsWriter(path, SrsInit(0x74, 2, 77), bytes(range(64)), facts)) as writer:
        for index, frame in enumerate(frames):
            writer.append(frame, 100 + 0.04 * index)
    return frames


def vendors(*objects: tuple[int, bytes], version: int = 1) -> bytes:
    """A stream as the vendor's recorder writes it."""
    content = struct.pack("<II", 0x4F497273, version)
    for kind, data in objects:
        content += struct.pack("<II", kind, 8 + len(data)) + data
    return content


INIT = (1, struct.pack("<III", 0x74, 0, 5))
CONFIGURE = (2, bytes(64))
FRAME = (3, raw_frames(1)[0])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "recording.srs"


def test_what_is_written_is_read_back(path: Path) -> None:
    frames = record(path)
    recording = SrsRecording(path)
    assert [recording.raw(i) for i in range(len(recording))] == frames
    np.testing.assert_allclose(recording.timestamp_s, 100 + 0.04 * np.arange(FRAMES))
    assert recording.fps == pytest.approx(25)
    assert recording.camera.K[0, 0] == 210
    assert recording.init == SrsInit(0x74, 2, 77)
    assert recording.registers == bytes(range(64))
    assert recording.metadata == {"who": "me"}
    assert recording.damage is None
    recording.close()
    recording.close()
    content = path.read_bytes()  # begins as the vendor's do
    assert content[:4] == b"srIO"
    assert struct.unpack("<6I", content[4:28]) == (1, 1, 20, 0x74, 2, 77)


def test_the_vendors_files_are_read(path: Path) -> None:
    calibration, unknown = (4, b"<xml/>"), (99, b"something else")
    path.write_bytes(vendors(INIT, unknown, CONFIGURE, calibration, FRAME, CONFIGURE, FRAME))
    recording = SrsRecording(path)
    assert len(recording) == 2
    assert recording.raw(1) == FRAME[1]
    assert recording.init.serial_number == 5
    assert (recording.camera.K[0, 2], recording.camera.K[1, 2]) == (92, 60)
    assert recording.fps == 25
    assert recording.range_m == RANGE_M
    assert SrsRecording(path, modulation_mhz=40).range_m == pytest.approx(3.747, abs=1e-3)


def test_decode_undoes_encode() -> None:
    rng = np.random.default_rng(1)
    radial = rng.uniform(0.1, 7.4, (HEIGHT, WIDTH)).astype(np.float32)
    radial[0, :4] = (np.nan, -1, np.inf, 7.6)
    amplitude = rng.integers(0, 65536, (HEIGHT, WIDTH), np.uint16)
    depth, same = decode_frame(encode_frame(radial, amplitude, RANGE_M), RANGE_M)
    np.testing.assert_array_equal(same, amplitude)
    assert (depth[0, :4] == 0).all()
    np.testing.assert_allclose(depth.ravel()[4:], radial.ravel()[4:], atol=RANGE_M / 131000)
    again = encode_frame(depth, same, RANGE_M)
    np.testing.assert_array_equal(decode_frame(again, RANGE_M)[0], depth)


def test_little_endian_distance_then_amplitude() -> None:
    data = bytearray(FRAME_BYTES)
    data[0:2], data[-2:] = b"\x00\x80", b"\x01\x02"
    depth, amplitude = decode_frame(bytes(data), RANGE_M)
    assert depth[0, 0] == pytest.approx(RANGE_M * 0x8000 / 0xFFFF)
    assert amplitude[-1, -1] == 0x0201


def test_cut_off_anywhere_keeps_the_whole_frames_before(path: Path) -> None:
    frames = record(path, 2)
    whole = path.read_bytes()
    ends = [whole.find(frame) + FRAME_BYTES for frame in frames]
    starts = [whole.find(frame) - 24 for frame in frames]  # of the time stamp before it
    edges = {0, 7, 8, 9, 15, 27, 28, 30, *starts, *ends}
    edges |= {start + extra for start in starts for extra in (1, 8, 15, 16, 20, 24, 500)}
    for length in sorted(edges):
        path.write_bytes(whole[:length])
        count = sum(end <= length for end in ends)
        if count == 0:
            with pytest.raises(ToftrackError, match=path.name):
                SrsRecording(path)
            continue
        recording = SrsRecording(path)
        assert [recording.raw(i) for i in range(len(recording))] == frames[:count]
        assert (recording.damage is None) == (length in ends)
        recording.close()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"PK\x03\x04 and so on", "not an .srs"),
        (vendors(INIT, CONFIGURE, FRAME, version=2), "version 2"),
        (vendors(FRAME, INIT, CONFIGURE), "before its Init"),
        (vendors(INIT, CONFIGURE, (3, bytes(100))), "no whole frame.*100 bytes"),
        (vendors(INIT, (2, b"12"), FRAME), "Configure object.*damaged"),
        (vendors(INIT, CONFIGURE, (0x54464F54, b"{"), FRAME), "TOFT"),
        (vendors(INIT, CONFIGURE) + struct.pack("<II", 3, 0xFFFFFFFF), "no whole frame.*cut off"),
        (vendors(INIT, CONFIGURE) + struct.pack("<II", 3, 0), "no whole frame.*no sense"),
    ],
)
def test_broken_files_are_reported(path: Path, content: bytes, words: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ToftrackError, match=words) as caught:
        SrsRecording(path)
    assert path.name in str(caught.value)


def test_a_recording_that_grows_is_not_taken_away_by_another(path: Path) -> None:
    pytest.importorskip("fcntl")
    with closing(SrsWriter(path)) as writer:
        writer.append(raw_frames(1)[0], 0.0)
        assert len(SrsRecording(path)) == 1, "each frame is on the disk when it was appended"
        with pytest.raises(ToftrackError, match="being recorded just now"):
            SrsWriter(path, overwrite=True)
        writer.append(raw_frames(1)[0], 0.04)
    assert len(SrsRecording(path)) == 2
    with pytest.raises(ToftrackError, match="exists already"):
        SrsWriter(path)
    SrsWriter(path, overwrite=True).close()


def test_a_full_disk_is_reported_and_the_whole_frames_are_kept(
    path: Path, files_of_at_most
) -> None:
    two_frames_and_a_half = 260_000
    with files_of_at_most(two_frames_and_a_half):
        with pytest.raises(ToftrackError, match="2 whole frames are kept"):
            record(path, 9)
    recording = SrsRecording(path)
    assert [recording.raw(i) for i in range(len(recording))] == raw_frames(2)
    assert recording.damage is None
