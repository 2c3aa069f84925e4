"""What the benchmark times its methods on, and how: see scoring.py."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape
from toftrack.recordings.store import open_source
from toftrack.render.likelihood import FMeasure
from toftrack.render.reference import ReferenceScorer
from toftrack.render.scoring import Evidence, Scorer
from toftrack.render.segmentation import NearestSurface

_MARGIN_PX = 12
_SEGMENTATION = NearestSurface(
    depth_range_m=0.2,
    min_area_m2=0.0008,
    max_distance_m=1.2,
    occluder_margin_m=0.035,
    reach_m=0.2,
    max_pixels=40_000,
)
_LIKELIHOOD = FMeasure(
    tolerance_m=0.02,
    neighbourhood_m=0.025,
    beta=1.5,
    naming="standard",
    residual_weight=0.0,
    coverage=0.0,
)


@dataclass(frozen=True)
class Row:
    """One line of a table; times in milliseconds from states to counts, on a number of repeats."""

    table: str
    method: str
    particles: int
    pixels: int
    ellipsoids: int
    min_ms: float
    median_ms: float
    repeats: int


def sample_evidence(upsample: float = 1.0) -> tuple[Evidence, Tensor]:
    """Evidence of the sample's first frame around the hand, and the true wrist (3,), metres.

    upsample: scales the number of pixels along each side (nearest neighbour), for the growth with
    the number of pixels.
    """
    sample = open_source("sample")
    depth, k = sample.image(0)[0], sample.camera.K.copy()
    assert sample.truth is not None
    wrist = torch.from_numpy(sample.truth.joints_m[0, 0])
    if upsample != 1:
        height, width = (round(size * upsample) for size in depth.shape)
        rows = (np.arange(height) / upsample).astype(int)
        columns = (np.arange(width) / upsample).astype(int)
        depth = np.ascontiguousarray(depth[rows][:, columns])
        k[:2] *= upsample
    observation = replace(_SEGMENTATION, max_pixels=depth.size)(depth, k)
    evidence = _LIKELIHOOD.evidence(observation)
    v, u = observation.hand.nonzero().unbind(1)
    margin = round(_MARGIN_PX * upsample)
    height, width = depth.shape
    left, right = int(u.min()) - margin, int(u.max()) + margin + 1
    top, bottom = int(v.min()) - margin, int(v.max()) + margin + 1
    return evidence.cropped(
        max(left, 0), max(top, 0), min(right, width), min(bottom, height)
    ), wrist


def filter_states(n: int, wrist: Tensor, seed: int = 0) -> Tensor:
    """(N, 27) open palms at the wrist's position, spread by 1 cm and by 0.1 rad an angle."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.zeros(n, 27)
    states[:, :3] = wrist
    spread = torch.tensor([0.01] * 3 + [0.1] * 24)
    return states + spread * torch.randn(n, 27, generator=generator)


def to_device(evidence: Evidence, device: torch.device) -> Evidence:
    """The same evidence on a device."""
    images = {f.name: getattr(evidence, f.name) for f in fields(evidence)}
    del images["radius_px"]
    return replace(evidence, **{name: image.to(device) for name, image in images.items()})


def check_against_reference(
    scorer: Scorer, shape: HandShape, states: Tensor, evidence: Evidence
) -> float:
    """The largest difference of a count, pixels.

    Raises ToftrackError when it is above 3 pixels and 0.5 % of a particle's count (float32 ties).
    """
    expected = ReferenceScorer(shape)(states, evidence)
    found = scorer(states, evidence)
    worst = 0.0
    for field in ("correct", "false", "missed"):
        a, b = getattr(found, field), getattr(expected, field)
        worst = max(worst, float((a - b).abs().max()))
        if bool(((a - b).abs() > (0.005 * b).clamp(min=3.0)).any()):
            raise ToftrackError(
                f"{scorer.name} disagrees with the reference on {field} by up to {worst:.0f} pixels"
            )
    return worst


def interleaved(
    calls: Mapping[str, Callable[[], object]],
    repeats: dict[str, int],
    device: torch.device,
    progress: tqdm | None = None,
) -> dict[str, list[float]]:
    """Seconds of each call, timed in turn; fewer repeats means the first rounds only."""
    for call in calls.values():
        call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(max(repeats.values(), default=0)):
        for name, call in calls.items():
            if turn >= repeats[name]:
                continue
            wait_for(device)
            start = time.perf_counter()
            call()
            wait_for(device)
            times[name].append(time.perf_counter() - start)
            if progress is not None:
                progress.update()
    return times


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def fastest_chunk(shape: HandShape, states: Tensor, evidence: Evidence, stepping: bool) -> int:
    """The chunk that makes a baseline fastest here, so that the comparison is fair."""
    some = states[:16] if stepping else states[:32]
    chunks = (1, 2, 4, 8) if states.device.type == "cpu" else (32, 128)
    times = {}
    for chunk in chunks:
        scorer = ReferenceScorer(shape, chunk, stepping)
        name = str(chunk)
        found = interleaved({name: partial(scorer, some, evidence)}, {name: 2}, states.device)
        times[chunk] = min(found[name])
    return min(times, key=times.__getitem__)
