"""How long spaces take to decode, for the benchmark."""

from __future__ import annotations

import time

import torch

from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.files import fit_pose_space

LIMITS_MS = {"pca": 2.0, "kernel_pca": 15.0, "lle": 15.0}
"""What decoding 10 000 latents may take on two cores."""


def decode_times(
    kinds: tuple[str, ...] = ("pca", "kernel_pca", "lle", "isomap"),
    dims: int = 4,
    count: int = 10_000,
    repeats: int = 20,
    device: torch.device | str = "cpu",
    spaces: dict[str, PoseSpace] | None = None,
) -> dict[str, float]:
    """Milliseconds to decode `count` latents drawn from the box, the median of the repeats.

    kinds: spaces to learn from the synthetic poses and to measure.
    spaces: measured under their names instead of learning any.
    """
    if spaces is None:
        spaces = {kind: fit_pose_space(kind, dims) for kind in kinds}
    return {name: _decode_ms(space.to(device), count, repeats) for name, space in spaces.items()}


def _decode_ms(space: PoseSpace, count: int, repeats: int) -> float:
    lower, upper = space.lower, space.upper
    generator = torch.Generator(lower.device).manual_seed(0)
    unit = torch.rand(count, space.dims, generator=generator, device=lower.device)
    latent = lower + unit * (upper - lower)
    times = []
    for _ in range(repeats + 3):  # the first ones warm up
        _wait(lower.device)
        began = time.perf_counter()
        space.decode(latent)
        _wait(lower.device)
        times.append(time.perf_counter() - began)
    return 1e3 * float(torch.tensor(times[3:]).median())


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
