"""The other method beside the tracker, with a pretended MediaPipe where there is no real one."""

import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.tracking import sample

from toftrack.errors import ToftrackError
from toftrack.evaluation import peer, peer_mediapipe
from toftrack.evaluation.peer import Peer
from toftrack.frames.camera import Camera
from toftrack.programs import benchmark

K = np.array([[200.0, 0, 88], [0, 200, 72], [0, 0, 1]])
FAKE = """
import json, os, sys
import numpy as np
sink = os.fdopen(os.dup(1), "wb")
source = sys.stdin.buffer
def say(what):
    sink.write(json.dumps(what).encode() + b"\\n"); sink.flush()
say({"ready": {"mediapipe": "0", "numpy": "0", "python": "3"}})
frames = 0
for line in iter(source.readline, b""):
    told = json.loads(line)
    if "begin" in told:
        (height, width), frames = told["begin"]["size"], 0
        continue
    source.read(2 * height * width)
    depth = np.frombuffer(source.read(4 * height * width), np.float32)
    answer = np.full(66, np.nan)
    answer[63] = 0.001
    if frames > 0:
        answer[:63] = depth.max()
        answer[64:] = 0.75, 1.0
    frames += 1
    if frames > ENDS:
        print("out of breath", file=sys.stderr)
        break
    sink.write(answer.tobytes()); sink.flush()
"""


def pretended(folder: Path, monkeypatch: pytest.MonkeyPatch, ends: int = 1000) -> None:
    """Another program answers instead of peer_mediapipe.py."""
    file = folder / "fake.py"
    file.write_text(FAKE.replace("ENDS", str(ends)), encoding="utf-8")
    monkeypatch.setattr(peer, "SCRIPT", file)
    peer.peer_process.cache_clear()


def test_frames_go_out_and_joints_come_back(tmp_path, monkeypatch) -> None:
    pretended(tmp_path, monkeypatch)
    depth, amplitude = np.full((144, 176), 0.5, np.float32), np.zeros((144, 176), np.uint16)
    with closing(Peer(sys.executable)) as found:
        found.begin(Camera(K, 176, 144), "right")
        first, second = found.step(depth, amplitude), found.step(depth, amplitude)
    assert found.versions["mediapipe"] == "0"
    assert first.lost and first.side == "" and np.isnan(first.joints_m).all()
    assert not second.lost and second.side == "right" and second.side_probability == 0.75
    assert second.joints_m.shape == (21, 3) and np.allclose(second.joints_m, 0.5)
    assert second.compute_s == 0.001


def test_a_peer_that_ends_says_its_last_words(tmp_path, monkeypatch) -> None:
    pretended(tmp_path, monkeypatch, ends=1)
    depth, amplitude = np.zeros((4, 4), np.float32), np.zeros((4, 4), np.uint16)
    with closing(Peer(sys.executable)) as found:
        found.begin(Camera(K, 4, 4))
        found.step(depth, amplitude)
        with pytest.raises(ToftrackError, match=r"ended in the middle .*out of breath"):
            found.step(depth, amplitude)


def test_an_environment_without_mediapipe_is_one_sentence(tmp_path) -> None:
    with pytest.raises(ToftrackError, match="cannot be run .* make one with: python3 -m venv"):
        Peer(tmp_path / "python")
    if "mediapipe" not in sys.modules:
        with pytest.raises(ToftrackError, match="no usable mediapipe .*mediapipe.*make one with"):
            Peer(sys.executable)


def test_a_recording_without_amplitude_is_refused_before_anything_runs(tmp_path) -> None:
    scene, file = sample().cut(0, 1), tmp_path / "dark.npz"
    np.savez(file, depth_m=scene.depth_m, K=scene.k, joints_m=scene.joints_m)
    given = [str(file), "--peer", "mediapipe", "--peer-python", sys.executable]
    with pytest.raises(ToftrackError, match=r"dark\.npz' has no amplitude image"):
        benchmark.main(["accuracy", *given])
    with pytest.raises(ToftrackError, match="--peer-python does not say"):
        benchmark.main(["accuracy", *given[:3]])


def test_the_lift_finds_a_flat_hand_below_its_skin() -> None:
    """Landmarks on a wall half a metre away, which is all that is read."""
    depth = np.full((144, 176), 0.5, np.float32)
    landmarks = np.random.default_rng(0).uniform(0.3, 0.7, (21, 3))
    landmarks[:, 2] = 0
    joints = peer_mediapipe.lifted(landmarks, depth, K)
    assert np.allclose(joints[:, 2], 0.514, atol=1e-6)
    u = 200 * joints[:, 0] / joints[:, 2] + 88
    assert np.allclose(u, landmarks[:, 0] * 176 - 0.5, atol=1e-6)
    landmarks[8, 2] = -0.1  # of the width: 44 mm nearer, whatever is read there
    nearer = peer_mediapipe.lifted(landmarks, depth, K)
    assert np.allclose(nearer[8, 2], 0.514 - 0.1 * 176 * 0.514 / 200, atol=1e-6)
    nothing = peer_mediapipe.lifted(landmarks, 0 * depth, K)
    assert np.isnan(nothing).all()


def test_the_given_side_goes_before_the_surer_hand() -> None:
    def hand(label: str, score: float) -> SimpleNamespace:
        return SimpleNamespace(classification=[SimpleNamespace(label=label, score=score)])

    found = SimpleNamespace(
        multi_hand_landmarks=["a", "b"],
        multi_handedness=[hand("Left", 0.9), hand("Right", 0.6)],
    )
    assert peer_mediapipe.chosen(found, "left") == ("b", "left", 0.6)
    assert peer_mediapipe.chosen(found, "right") == ("a", "right", 0.9)
    assert peer_mediapipe.chosen(found, "") == ("a", "right", 0.9)
    found.multi_handedness[1] = hand("Left", 0.6)
    assert peer_mediapipe.chosen(found, "left") is None
    nobody = SimpleNamespace(multi_hand_landmarks=None, multi_handedness=None)
    assert peer_mediapipe.chosen(nobody, "left") is None
