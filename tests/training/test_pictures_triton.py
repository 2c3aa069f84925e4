"""Pictures and crops of a CUDA device are those of the CPU, but for the noise of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.detection import clean_sensors, small_bank

from toftrack.training import pictures
from toftrack.training.batches import mapped
from toftrack.training.descent import Schedule, train_poses
from toftrack.training.hands import HAND
from toftrack.training.images import crop_scenes, crops_on_device
from toftrack.training.images_numba import read_pictures
from toftrack.training.pictures import RANGE, Shots, take

pytestmark = pytest.mark.usefixtures("one_thread")

N, SIDE = 2, 56
SIZE = SIDE, SIDE + 3
ALIKE = {
    "SMOOTH": 2.0,
    "COARSE": 0.007,
    "STEP": 0.004,
    "SHADOW": 8.0,
    "BIAS": 0.01,
    "HOLLOW": 1.0,
    "DARK": 1.0,
    "RANGE": 0.8,
}
"""Terms of a sensor that do the same to each pixel."""


def small_shots(seed: int) -> Shots:
    """Scenes of crops in small pictures, as the interpreter is slow, read as they are."""
    shots = crop_scenes(N, small_bank(), torch.Generator().manual_seed(seed)).shots
    factor = SIDE / shots.lens[:, 3]
    f, cx, cy = (shots.lens[:, :3] * factor[:, None]).unbind(1)
    wide, high = torch.full((N,), float(SIDE)), torch.full((N,), SIDE - 5.0)
    return replace(shots, lens=torch.stack((f, cx, cy, wide, high), 1), sensors=clean_sensors(N))


def compared(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raises AssertionError where a device's pictures are not the CPU's."""
    from toftrack.training import pictures_triton

    there = torch.device(device)

    def both(shots: Shots) -> tuple[np.ndarray, ...]:
        found = pictures_triton.take(mapped(shots, lambda one: one.to(there)), SIZE, 0)
        return *take(shots, SIZE), *(one.cpu().numpy() for one in found)

    shots = small_shots(6)
    depth, labels, other, other_labels = both(shots)
    seen = (depth > 0) & (other > 0)
    assert ((labels >= 0) == (other_labels >= 0)).all()
    assert ((depth > 0) != (other > 0)).mean() < 0.01 and seen.mean() > 0.2
    hand = seen & (labels == HAND)
    assert hand.sum() > 100 and (other_labels[hand] == HAND).mean() > 0.97
    off = np.abs(depth - other)
    assert np.median(off[hand]) < 5e-4 and (off[hand] > 2e-3).mean() < 0.1
    assert (off[seen & (labels == 0)] > 1e-3).mean() < 0.02

    # Sensors of the same picture: without skins, which is drawn once.
    plain = replace(shots, whose=torch.full_like(shots.whose, -1))
    drawn = pictures_triton.draw(mapped(plain, lambda one: one.to(there)), SIZE)
    monkeypatch.setattr(pictures_triton, "draw", lambda *_: tuple(one.clone() for one in drawn))
    for name, value in ALIKE.items():
        sensors = clean_sensors(N)
        sensors[:, getattr(pictures, name)] = value
        depth, _, other, _ = both(replace(plain, sensors=sensors))
        # A reading on the edge between two steps may become either.
        assert (np.abs(depth - other) > 1e-4).mean() < 0.03, name
    for name, value in (("HOLES", 0.2), ("PATCHES", 3.0)):
        sensors = clean_sensors(N)
        sensors[:, getattr(pictures, name)] = value
        depth, labels, other, _ = both(replace(plain, sensors=sensors))
        missing = [((one == 0) & (labels >= 0)).mean() for one in (depth, other)]
        assert 0.4 < missing[0] / missing[1] < 2.5, name
    sensors = clean_sensors(N)
    sensors[:, pictures.NOISE], sensors[:, RANGE] = 0.005, 0.8
    clean, *_ = both(replace(plain, sensors=replace_noise(sensors)))
    depth, _, other, _ = both(replace(plain, sensors=sensors))
    noise = [(one - clean)[(one > 0) & (clean > 0) & (clean < 0.7)] for one in (depth, other)]
    assert len(noise[1]) > 300
    assert 0.85 < noise[0].std() / noise[1].std() < 1.15
    assert abs(noise[1].mean()) < 6 * noise[1].std() / len(noise[1]) ** 0.5 + 1e-4

    scenes = crop_scenes(N, small_bank(), torch.Generator().manual_seed(2))
    depth, labels = take(scenes.shots, (183, 183))
    lie = (scenes.side, scenes.distance_m, scenes.turned, scenes.borders)
    image, parts = read_pictures(depth, labels, *(one.numpy() for one in lie))
    pair = torch.from_numpy(depth), torch.from_numpy(labels)
    found = pictures_triton.read_pictures(*(one.to(there) for one in (*pair, *lie)))
    assert (np.abs(found[0].cpu().numpy() - image) > 1e-4).mean() < 1e-3
    assert (found[1].cpu().numpy() != parts).mean() < 1e-3


def replace_noise(sensors: torch.Tensor) -> torch.Tensor:
    """The same sensors without noise."""
    without = sensors.clone()
    without[:, pictures.NOISE] = 0
    return without


def test_triton_takes_the_same_pictures_as_far_as_its_interpreter_goes() -> None:
    pytest.importorskip("triton", reason="triton is not installed")
    code = (
        "import pytest; from training.test_pictures_triton import compared\n"
        "with pytest.MonkeyPatch.context() as monkeypatch: compared('cpu', monkeypatch)"
    )
    env = {**os.environ, "TRITON_INTERPRET": "1"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, cwd="tests"
    )
    assert run.returncode == 0, run.stderr


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_takes_the_same_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    compared("cuda", monkeypatch)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_training_on_a_cuda_device_learns_and_ends_on_the_cpu() -> None:
    schedule = Schedule(images=40_000, batch=128, rate=0.003, width=8)
    network, course = train_poses(schedule, 6, 0, device=torch.device("cuda"))
    assert network.device.type == "cpu"
    assert course[-1]["keypoints_mm"] < 0.8 * course[0]["keypoints_mm"]
    scenes = crop_scenes(8, small_bank(), torch.Generator().manual_seed(0))
    crops = crops_on_device(mapped(scenes, lambda one: one.to("cuda")), 0)
    assert crops.image.device.type == "cuda" and crops.present.any()
