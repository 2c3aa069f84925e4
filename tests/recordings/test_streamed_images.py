"""Long `.npz` recordings are read in turn, and give what short ones give."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.recordings import npz
from toftrack.recordings.npz import StreamedImages, read_recording

K = np.array([[90.0, 0, 40], [0, 91.0, 30], [0, 0, 1]])
RNG = np.random.default_rng(0)
DEPTH = RNG.uniform(0.3, 1.0, (9, 60, 80)).astype(np.float32)
AMPLITUDE = RNG.integers(0, 4000, (9, 60, 80), dtype=np.uint16)


@pytest.fixture
def long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording that is too long to be loaded."""
    monkeypatch.setattr(npz, "LOADED_BYTES", 100_000)
    path = tmp_path / "long.npz"
    np.savez_compressed(path, depth_m=DEPTH, amplitude=AMPLITUDE, K=K, fps=30.0)
    return path


def test_images_are_those_of_the_file_in_any_order(long: Path) -> None:
    recording = read_recording(long)
    assert isinstance(recording.depth, StreamedImages) and len(recording) == 9
    for index in (0, 1, 5, 5, 2, 8, 0):
        depth, amplitude = recording.image(index)
        np.testing.assert_array_equal(depth, DEPTH[index])
        np.testing.assert_array_equal(amplitude, AMPLITUDE[index])
        depth[:] = 0  # the caller's own
    recording.close()
    np.testing.assert_array_equal(recording.image(3)[0], DEPTH[3])
    recording.close()


def test_it_is_played_like_another(long: Path) -> None:
    device = Replay(long, start=2, stop=7)
    frames = list(device)
    assert [frame.index for frame in frames] == [2, 3, 4, 5, 6]
    np.testing.assert_array_equal(np.stack([frame.depth for frame in frames]), DEPTH[2:7])
    assert device.fps == 30


def test_a_short_one_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "short.npz"
    np.savez(path, depth_m=DEPTH[:4], K=K)
    assert isinstance(read_recording(path).depth, np.ndarray)


def test_damage_on_the_way_is_reported_when_it_is_met(long: Path) -> None:
    np.savez(long, depth_m=DEPTH, K=K)
    content = bytearray(long.read_bytes())
    with zipfile.ZipFile(long) as archive:
        at = archive.getinfo("depth_m.npy").header_offset + 170_000
    content[at : at + 4] = b"\0\0\xc0\x7f"
    long.write_bytes(content)
    recording = read_recording(long)
    with pytest.raises(ToftrackError, match="long.npz' is damaged .*CRC"):
        for index in range(9):
            recording.image(index)


@pytest.mark.parametrize(
    "changes", [{"depth_m": np.asfortranarray(DEPTH)}, {"amplitude": AMPLITUDE.astype(np.int32)}]
)
def test_what_cannot_be_read_in_turn_is_reported(long: Path, changes: dict) -> None:
    np.savez(long, **{"depth_m": DEPTH, "amplitude": AMPLITUDE, "K": K} | changes)
    with pytest.raises(ToftrackError, match="long.npz"):
        read_recording(long)
