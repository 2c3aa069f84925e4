"""On a CUDA device frames are tracked as on the CPU, and the filter's passes do not wait for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from helpers.tracking import errors_mm, follow, make_tracker, sample

from toftrack.compute import particle_filter

FRAMES = 8
SELECTED = 4
"""From this frame on nothing is made for the first time."""


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_tracks_as_the_cpu_does_and_its_passes_wait_for_nothing(monkeypatch) -> None:
    annealed = particle_filter.annealed

    def without_waiting(*args: Any) -> Any:
        with _waiting_forbidden():
            return annealed(*args)

    scene = sample().cut(*range(FRAMES))
    on_cpu = errors_mm(follow(scene, "compute=cpu"), scene)
    tracker, estimates = make_tracker("compute=cuda"), []
    for i, depth in enumerate(scene.depth_m):
        if i == SELECTED:  # from here on torch itself says where the host waits
            monkeypatch.setattr(particle_filter, "annealed", without_waiting)
        estimates.append(tracker.step(depth, scene.k, i, i / 25))
    there = errors_mm(estimates, scene)
    assert there.max() < 10 and abs(there.mean() - on_cpu.mean()) < 2


@contextmanager
def _waiting_forbidden() -> Iterator[None]:
    """Within, torch raises where the host would wait for a CUDA device."""
    torch.cuda.set_sync_debug_mode("error")
    yield
    torch.cuda.set_sync_debug_mode("default")
