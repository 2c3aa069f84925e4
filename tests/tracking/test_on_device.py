"""A frame on a pretended CUDA device: what it finds there, and how often the host waits for it.

Structure, not time: what a real device takes for it is for a real device to say.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.accelerator import DEVICE, Counts, pretended_device
from helpers.configured import detector_settings, refinement
from helpers.pretended_triton import pretended_triton
from helpers.tracking import errors_mm, follow, make_tracker, sample

from toftrack.compute import particle_filter
from toftrack.detector.hand_detector import make_detector
from toftrack.detector.onnx_networks import OnnxPoseNet
from toftrack.estimate import Estimate
from toftrack.hand.shape import default_hand_shape
from toftrack.refinement.gauss_newton import Keypoints, TorchRefiner
from toftrack.refinement.seen_points import SeenPoints

FRAMES = 8
SELECTED = 4
"""From this frame on nothing is made for the first time."""
pretended = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")


@pytest.fixture(scope="module")
def followed() -> tuple[list[Estimate], list[int]]:
    """The first frames of the packaged recording, and how often the host waited in each."""
    scene, estimates, waits = sample(), [], []
    with pretended_device() as counts, pretended_triton(counts):
        tracker = make_tracker("compute=cuda")
        for i in range(FRAMES):
            before = counts.waits.total()
            estimates.append(tracker.step(scene.depth_m[i], scene.k, i, i / 25))
            waits.append(counts.waits.total() - before)
        assert tracker.track is not None and tracker.track.particles.device.type == "cuda"
    return estimates, waits


@pretended
def test_a_frame_waits_for_the_device_a_few_times(
    followed: tuple[list[Estimate], list[int]],
) -> None:
    waits = followed[1][SELECTED:]
    # Where both sides are compared it is three times more.
    assert max(waits) <= 10 and min(waits) <= 7


@pretended
def test_estimates_on_the_device_are_as_good_as_those_on_the_cpu(
    followed: tuple[list[Estimate], list[int]],
) -> None:
    scene = sample().cut(*range(FRAMES))
    on_cpu = errors_mm(follow(scene, "compute=cpu"), scene)
    there = errors_mm(followed[0], scene)
    assert there.max() < 10 and abs(there.mean() - on_cpu.mean()) < 2


def _passes_within(
    monkeypatch: pytest.MonkeyPatch, made: Callable[[], AbstractContextManager[None]]
) -> None:
    """All passes of the filter run in a context of their own."""
    annealed = particle_filter.annealed

    def wrapped(*args: Any) -> Any:
        with made():
            return annealed(*args)

    monkeypatch.setattr(particle_filter, "annealed", wrapped)


def _passes(monkeypatch: pytest.MonkeyPatch, *overrides: str) -> Counts:
    """What the passes of a track's first two frames ask for."""
    scene = sample()
    with pretended_device() as counts, pretended_triton(counts):
        _passes_within(monkeypatch, lambda: counts.within("passes"))
        tracker = make_tracker("compute=cuda", *overrides)
        for i in range(2):
            tracker.step(scene.depth_m[i], scene.k, i, i / 25)
    return counts


@pretended
@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("pose_space=kernel_pca", "filter.bounds=truncate", "filter.resampling=stratified"),
        ("pose_space=lle",),
    ],
)
def test_the_filter_s_passes_wait_for_nothing(
    overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = _passes(monkeypatch, *overrides, "filter.passes=4", "filter.particles=1000")
    assert asked.waits["passes"] == 0
    assert asked.launches["passes"] > 0, "they ran there"


@pretended
def test_refinement_in_torch_waits_for_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    shape = default_hand_shape(side="left")
    states = torch.zeros(3, 27)
    states[:, :3] = torch.tensor([0.0, 0.08, 0.4])
    states += 0.05 * torch.randn(3, 27, generator=generator)
    joints = TorchRefiner(shape).joints(states)
    surface = joints[0].repeat(20, 1) + 0.005 * torch.randn(420, 3, generator=generator)
    k = torch.tensor([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]])
    nearest = torch.rand(60, 60, 2, generator=generator) * 60
    keypoints = joints[1] + 0.01, torch.full((21,), 0.01)

    def refined(device: torch.device, iterations: int) -> torch.Tensor:
        seen = SeenPoints(surface.to(device), nearest.to(device), k.to(device), (144, 176))
        landmarks = Keypoints(*(part.to(device) for part in keypoints))
        refiner = TorchRefiner(shape.to(device))
        cfg = refinement(iterations=iterations)
        there = states.to(device)
        counts.part = f"{iterations} iterations"
        found = refiner(there, there[:, 6:], seen, cfg, landmarks)
        counts.part = "rest"
        return found.cpu()

    with pretended_device() as counts:
        refined(DEVICE, 1)
        found = refined(DEVICE, 5)
        expected = refined(torch.device("cpu"), 5)
    assert counts.waits["5 iterations"] == 0
    assert counts.launches["5 iterations"] > counts.launches["1 iterations"]
    assert not torch.allclose(found, states, atol=1e-3)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


@pretended
def test_the_networks_answer_from_the_device_in_one_copy() -> None:
    scene, settings = sample(), asdict(detector_settings())
    detector = make_detector(**settings)
    assert isinstance(detector.pose, OnnxPoseNet)  # whose whole numbers say a little else
    detector = replace(detector, pose=detector.pose.reference)
    centre = scene.joints_m[0, [0, 9]].mean(0)[None]
    here = detector.detect(scene.depth_m[0], scene.k, centre, "right")[0]
    places = detector.search(scene.depth_m[0], scene.k, "right")
    with pretended_device() as counts:
        there = make_detector(**settings).to(DEVICE)
        with counts.within("detect"):
            detection = there.detect(scene.depth_m[0], scene.k, centre, "right")[0]
        found = there.search(scene.depth_m[0], scene.k, "right")
    assert counts.waits["detect"] == 1
    torch.testing.assert_close(detection.joints_m, here.joints_m, atol=1e-4, rtol=0)
    assert len(found) == len(places) > 0
    np.testing.assert_allclose(found[0].centre_m, places[0].centre_m, atol=1e-4)


@pretended
def test_the_pretended_device_counts_what_a_host_waits_for() -> None:
    with pretended_device() as counts:

        def waits(action: Callable[[], object]) -> int:
            before = counts.waits.total()
            action()
            return counts.waits.total() - before

        there = torch.arange(6.0, device="cuda").view(2, 3)
        mask = there > 2
        assert waits(lambda: there + 1) == 0
        assert waits(lambda: float(there.sum())) == waits(lambda: bool(mask.any())) == 1
        assert waits(lambda: there[mask]) == waits(lambda: mask.nonzero()) == 1
        assert waits(lambda: there[[0, 1]]) == 1 and waits(lambda: there[0, 1:]) == 0
        assert waits(there.cpu) == waits(there.tolist) == 1
        assert waits(lambda: there.new_tensor([1.0, 2.0])) == 1
        assert waits(lambda: torch.ones(3).to("cuda", non_blocking=True)) == 1
        assert waits(lambda: torch.ones(3).pin_memory().to("cuda", non_blocking=True)) == 0
        assert counts.uploads.total() == 1
        there[mask] = 7.0
        assert there.tolist() == [[0.0, 1.0, 2.0], [7.0, 7.0, 7.0]]
        with pytest.raises(RuntimeError, match="on the CPU and on the device"):
            there + torch.ones(2, 3)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_tracks_as_the_cpu_does_and_its_passes_wait_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = sample().cut(*range(FRAMES))
    on_cpu = errors_mm(follow(scene, "compute=cpu"), scene)
    tracker, estimates = make_tracker("compute=cuda"), []
    for i, depth in enumerate(scene.depth_m):
        if i == SELECTED:  # from here on torch itself says where the host waits
            _passes_within(monkeypatch, _waiting_forbidden)
        estimates.append(tracker.step(depth, scene.k, i, i / 25))
    there = errors_mm(estimates, scene)
    assert there.max() < 10 and abs(there.mean() - on_cpu.mean()) < 2


@contextmanager
def _waiting_forbidden() -> Iterator[None]:
    """Within, torch raises where the host would wait for a CUDA device."""
    torch.cuda.set_sync_debug_mode("error")
    yield
    torch.cuda.set_sync_debug_mode("default")
