"""Recordings: what is written is read back, and every broken file is told in one sentence."""

import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.recordings import npz
from toftrack.recordings.npz import read_recording, write_recording

T, H, W = 4, 6, 8
K = np.array([[20.0, 0, 4], [0, 21.0, 3], [0, 0, 1]])


def arrays(**changes: Any) -> dict[str, Any]:
    """A whole recording's arrays; None takes a key away."""
    rng = np.random.default_rng(0)
    content = {
        "depth_m": rng.uniform(0.3, 2.0, (T, H, W)).astype(np.float32),
        "K": K,
        "amplitude": rng.integers(0, 4000, (T, H, W), dtype=np.uint16),
        "timestamp_s": np.arange(T) * 0.1 + 5,
        "joints_m": rng.normal(size=(T, 21, 3)).astype(np.float32),
        "visible": np.array([True, True, False, True]),
        "in_space": np.ones(T, bool),
        "visible_fraction": np.ones(T, np.float32),
        "joint_visible": np.ones((T, 21), bool),
        "distortion": np.array([-0.1, 0.02, 0, 0, 0]),
        "metadata": '{"hand_length_mm": 190.2}',
    } | changes
    return {key: value for key, value in content.items() if value is not None}


def save(folder: Path, **changes: Any) -> Path:
    path = folder / "recording.npz"
    np.savez(path, **arrays(**changes))
    return path


def complaint(path: Path) -> str:
    with pytest.raises(ToftrackError) as caught:
        read_recording(path)
    text = str(caught.value)
    assert path.name in text, "the sentence must name the file"
    return text


def test_most_of_the_image_may_be_65535_millimetres_for_no_reading(tmp_path: Path) -> None:
    depth = np.full((T, H, W), 65.535)
    for kind in (np.float16, np.float32):
        assert len(read_recording(save(tmp_path, depth_m=depth.astype(kind)))) == T
        depth[:, : H // 3] = 0.7
    depth[:, : H // 3] = 700.0
    assert "median of 'depth_m' is 700" in complaint(save(tmp_path, depth_m=depth))


def test_two_keys_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "least.npz"
    np.savez(path, depth_m=np.ones((T, H, W), np.float16), K=K)
    recording = read_recording(path)
    assert recording.depth.dtype == np.float16
    assert recording.amplitude is None
    assert recording.truth is None
    assert recording.metadata == {}
    np.testing.assert_allclose(recording.timestamp_s, np.arange(T) / 25)
    truth = read_recording(save(tmp_path, visible=None, in_space=None)).truth
    assert truth.visible.all() and truth.in_space.all()


def test_times_come_from_stamps_then_rate(tmp_path: Path) -> None:
    for stamps_s, fps in ((None, 50), (np.arange(T) * 0.2, 5)):
        recording = read_recording(save(tmp_path, timestamp_s=stamps_s, fps=50.0))
        assert recording.fps == pytest.approx(fps)
        np.testing.assert_allclose(np.diff(recording.timestamp_s), 1 / fps)


@pytest.mark.parametrize(("kind", "radial"), [(np.float16, False), (np.float32, True)])
def test_write_then_read_is_the_same(tmp_path: Path, kind: type, radial: bool) -> None:
    depth = arrays()["depth_m"].astype(kind)
    changes = {"depth_m": None, "radial_m": depth} if radial else {"depth_m": depth}
    first = read_recording(save(tmp_path, **changes))
    write_recording(tmp_path / "copy.npz", first)
    second = read_recording(tmp_path / "copy.npz")
    assert second.depth.dtype == kind
    assert second.radial == radial
    for name in ("depth", "amplitude", "timestamp_s"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for name in ("joints_m", "visible", "in_space", "visible_fraction", "joint_visible"):
        np.testing.assert_array_equal(getattr(first.truth, name), getattr(second.truth, name))
    np.testing.assert_array_equal(first.camera.distortion, second.camera.distortion)
    assert first.metadata == second.metadata
    assert [p.name for p in tmp_path.glob("*.part")] == []


def test_the_other_hands_truth_is_kept_and_cut_with_the_first_ones(tmp_path: Path) -> None:
    joints, seen = np.full((T, 21, 3), 0.5, np.float32), np.array([False, True, True, False])
    first = read_recording(save(tmp_path, joints2_m=joints, visible2=seen))
    write_recording(tmp_path / "copy.npz", first)
    for truth in (first.truth, read_recording(tmp_path / "copy.npz").truth):
        np.testing.assert_array_equal(truth.other.joints_m, joints)
        np.testing.assert_array_equal(truth[1:3].other.visible, [True, True])
        np.testing.assert_array_equal(truth.of_frames(np.array([0, 3])).other.visible, [False] * 2)
        assert truth.other.in_space.all() and truth.other.joint_visible is None
    assert read_recording(save(tmp_path)).truth.other is None


def test_writing_into_no_folder_is_reported(tmp_path: Path) -> None:
    recording = read_recording(save(tmp_path))
    with pytest.raises(ToftrackError, match="cannot be written"):
        write_recording(tmp_path / "nowhere" / "copy.npz", recording)


class Canary:
    """Unpickling one leaves a trace."""

    woken = False

    def __setstate__(self, state: object) -> None:
        Canary.woken = True

    def __getstate__(self) -> dict[str, int]:
        return {"egg": 1}


@pytest.mark.parametrize("key", ["depth_m", "K", "metadata", "something_else"])
def test_pickled_objects_are_refused(tmp_path: Path, key: str) -> None:
    path = save(tmp_path, **{key: np.array([Canary()], dtype=object)})
    text = complaint(path)
    assert "pickled" in text
    assert key in text
    path.write_bytes(pickle.dumps(Canary()))
    assert "it is no .npz archive" in complaint(path)
    assert not Canary.woken


def test_frames_that_are_counted_last_are_reported(tmp_path: Path) -> None:
    path, K = tmp_path / "recording.npz", np.array([[70.0, 0, 32], [0, 70.0, 24], [0, 0, 1]])
    content = {"depth_m": np.full((48, 64, 20), 0.6, np.float32), "K": K}
    for times in ({}, {"timestamp_s": np.arange(20.0)}):
        np.savez(path, **content, **times)
        assert "(rows, columns, frames)" in complaint(path)
    # As many frames as rows, and a time for each: K alone does not decide.
    np.savez(path, **content, timestamp_s=np.arange(48.0))
    assert len(read_recording(path)) == 48


IMAGES = np.ones((T, H, W), np.float32)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("depth_m", None, "no 'depth_m' .*, but .*K, "),
        ("K", None, "missing"),
        ("depth_m", IMAGES[0], "3 dimensions"),
        ("depth_m", IMAGES[:0], "at least one frame"),
        ("depth_m", IMAGES.astype(complex), "float32"),
        ("depth_m", (500 * IMAGES).astype(np.uint16), "millimetres.*/ 1000"),
        ("depth_m", 480 * IMAGES, "millimetres.*/ 1000"),
        ("depth_m", 40 * IMAGES, "centimetres.*/ 100"),
        ("depth_m", (40 * IMAGES).astype(np.uint16), "centimetres.*/ 100"),
        ("depth_m", 1e-6 * IMAGES, "neither metres nor millimetres"),
        ("K", np.eye(4), "3x3"),
        ("K", np.full((3, 3), np.nan), "NaN"),
        ("joints_m", np.zeros((T, 20, 3)), ""),
        ("joints_m", np.full((T, 21, 3), np.nan), ""),
        ("joints_m", np.full((T, 21, 3), 400.0), "millimetres"),
        ("visible", np.ones(T + 1, bool), ""),
        ("amplitude", np.ones((T, H, W - 1), np.uint16), ""),
        ("timestamp_s", np.arange(T - 1.0), ""),
        ("timestamp_s", np.array([0.0, 0.1, 0.05, 0.2]), "frame 2; .*'fps'"),
        ("fps", 0.0, ""),
        ("distortion", np.zeros(3), ""),
        ("metadata", "no json", ""),
    ],
)
def test_what_breaks_the_format_is_reported_by_its_key(
    tmp_path: Path, key: str, value: Any, words: str
) -> None:
    text = complaint(save(tmp_path, **{key: value}))
    assert key in text and re.search(words, text)


def test_a_hand_that_is_not_visible_may_be_nowhere(tmp_path: Path) -> None:
    joints = arrays()["joints_m"]
    joints[2] = np.nan  # the frame in which it is not visible
    truth = read_recording(save(tmp_path, joints_m=joints)).truth
    assert truth is not None and np.isfinite(truth.joints_m).all()
    np.testing.assert_array_equal(truth.joints_m[[0, 1, 3]], joints[[0, 1, 3]])


def test_damage_on_the_way_is_reported_when_it_is_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(npz, "LOADED_BYTES", 100_000)
    depth = np.random.default_rng(0).uniform(0.3, 1.0, (9, 60, 80)).astype(np.float32)
    long = save(tmp_path, depth_m=depth, **dict.fromkeys(arrays().keys() - {"depth_m", "K"}))
    content = bytearray(long.read_bytes())
    with zipfile.ZipFile(long) as archive:
        at = archive.getinfo("depth_m.npy").header_offset + 170_000
    content[at : at + 4] = b"\0\0\xc0\x7f"
    long.write_bytes(content)
    recording = read_recording(long)
    with pytest.raises(ToftrackError, match="recording.npz' is damaged .*CRC"):
        for index in range(9):
            recording.image(index)
