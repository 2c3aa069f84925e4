"""How long spaces take to decode, for the benchmark."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch

from toftrack.benchmark.timing import interleaved
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.files import fit_pose_space

AIMS_MS = {"pca": 2.0, "kernel_pca": 15.0, "lle": 15.0}
"""What decoding 10 000 latents should take at most on two cores, median."""


@dataclass(frozen=True)
class DecodeRow:
    """One line of the table; times in milliseconds from latents (N, dims) to angles (N, 21).

    aim_ms: what the median should be at most; None where none is set.
    """

    space: str
    latents: int
    dims: int
    min_ms: float
    median_ms: float
    aim_ms: float | None
    repeats: int


def decode_times(
    kinds: tuple[str, ...] = ("pca", "kernel_pca", "lle", "isomap"),
    dims: int = 4,
    count: int = 10_000,
    repeats: int = 20,
    device: torch.device | str = "cpu",
    spaces: dict[str, PoseSpace] | None = None,
) -> list[DecodeRow]:
    """Time the decoding of `count` latents drawn from the box of each space, in turn.

    kinds: spaces to learn from the synthetic poses and to measure.
    spaces: measured under their names instead of learning any.
    """
    device = torch.device(device)
    if spaces is None:
        spaces = {kind: fit_pose_space(kind, dims) for kind in kinds}
    spaces = {name: space.to(device) for name, space in spaces.items()}
    calls = {name: _decoding(space, count, device) for name, space in spaces.items()}
    times = interleaved(calls, dict.fromkeys(calls, repeats), device)
    return [
        DecodeRow(
            space=name,
            latents=count,
            dims=spaces[name].dims,
            min_ms=1e3 * min(found),
            median_ms=1e3 * statistics.median(found),
            aim_ms=AIMS_MS.get(name) if count == 10_000 else None,
            repeats=len(found),
        )
        for name, found in times.items()
    ]


def _decoding(space: PoseSpace, count: int, device: torch.device) -> Callable[[], object]:
    generator = torch.Generator(device).manual_seed(0)
    unit = torch.rand(count, space.dims, generator=generator, device=device)
    latent = space.lower + unit * (space.upper - space.lower)
    return lambda: space.decode(latent)
