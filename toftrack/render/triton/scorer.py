"""The CUDA scoring back end: three fused kernels, nothing of it waits for the host.

First the ellipsoids of all particles on the screen, then one program a particle that draws it tile
by tile in registers and compares, then one that dilates its silhouette in words of 64 columns.
"""

from __future__ import annotations

import functools
import os

import torch
import triton
from torch import Tensor

from toftrack.compute.transfer import on_device
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import CHAIN_SLOTS
from toftrack.hand.surface import hand_surface
from toftrack.render.scoring import NEAREST_M, Counts, Evidence, disc_square, disc_steps
from toftrack.render.torch_scorer import TorchScorer
from toftrack.render.triton.kernel import (
    TERMS,
    count_kernel,
    missed_kernel,
    pack_kernel,
    project_kernel,
)

_SCRATCH_BYTES = 256 << 20
"""Bound on the silhouettes of the particles scored at once."""
_LARGEST_RADIUS_PX = 63
"""A word of the dilation has one neighbour on either side."""
_BLOCK, _ROWS = 64, 8


def require_device() -> None:
    """Raises ImportError where there is no CUDA, and triton does not interpret its kernels."""
    if not torch.cuda.is_available() and os.environ.get("TRITON_INTERPRET") != "1":
        raise ImportError("there is no CUDA device")


class TritonScorer:
    """Fused kernels for CUDA; radii above 63 pixels are left to TorchScorer."""

    name = "triton"

    def __init__(self, shape: HandShape) -> None:
        """shape: on the device of the states to come."""
        require_device()
        self._shape, tables = shape, _tables(shape.to("cpu"))
        self._numbers, self._slots = (on_device(part, shape.base_m.device) for part in tables)

    @functools.cached_property
    def _large(self) -> TorchScorer:
        return TorchScorer(self._shape)

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        """See Scorer; particles whose state is not finite count 0."""
        if evidence.radius_px > _LARGEST_RADIUS_PX:
            return self._large(states, evidence)
        states = states.detach().float().contiguous()
        height, width = evidence.hand.shape
        words = -(-width // 64)
        device = states.device
        hand = torch.empty(height, words, dtype=torch.int64, device=device)
        pack_kernel[(height, words)](
            evidence.hand.contiguous().view(torch.uint8), hand, width, words
        )
        square = disc_square(evidence.radius_px, height, width)
        steps = _steps(square, height, width, device)
        bands = (evidence.low, evidence.high, evidence.occluder)
        images = tuple(band.float().contiguous() for band in bands)
        camera = evidence.k.float().contiguous()
        chunk = max(1, _SCRATCH_BYTES // (8 * height * words))
        parts = [
            self._score(part, camera, images, hand, width, *steps) for part in states.split(chunk)
        ]
        return Counts(*(torch.cat(parts, 1) if len(parts) > 1 else parts[0]))

    def _score(
        self,
        states: Tensor,
        camera: Tensor,
        images: tuple[Tensor, ...],
        hand: Tensor,
        width: int,
        steps: Tensor,
        reach: int,
    ) -> Tensor:
        """(4, N) counts of one chunk."""
        n, device = len(states), states.device
        counts = torch.empty(4, n, device=device)
        if n == 0:
            return counts
        height, words = hand.shape
        count = len(self._numbers)
        conics = torch.empty(n, count, TERMS, device=device)
        project_kernel[(triton.cdiv(n, _BLOCK), count)](
            states, camera, self._numbers, self._slots, conics, n, count, NEAREST_M, BLOCK=_BLOCK
        )
        model = torch.empty(n, height, words, dtype=torch.int64, device=device)
        boxes = torch.empty(n, 4, dtype=torch.int32, device=device)
        count_kernel[(n,)](
            *(conics, *images, model, boxes, counts, n, height, width, words),
            count=count,
            ELLIPSOIDS=triton.next_power_of_2(count),
            ROWS=_ROWS,
            num_warps=4,
        )
        missed_kernel[(n,)](
            *(conics, model, boxes, hand, steps, counts, n, count),
            *(height, width, words, len(steps), reach),
            ROWS=32,
            num_warps=1,
        )
        return counts


@functools.lru_cache(maxsize=256)
def _steps(square: int, height: int, width: int, device: torch.device) -> tuple[Tensor, int]:
    """Steps of the disc on the device, and its reach; kept, a copy to the device takes time."""
    steps = torch.from_numpy(disc_steps(square, height, width)).int()
    return on_device(steps, device), int(steps[:, 1].max())


def _tables(shape: HandShape) -> tuple[Tensor, Tensor]:
    """What does not depend on the particle, for each ellipsoid: see project_kernel."""
    surface = hand_surface(shape)
    count = len(surface.frame_index)
    covariances = surface.axes_m @ surface.axes_m.mT
    rows, columns = torch.triu_indices(3, 3)
    where = torch.full((25,), -1)
    where[list(CHAIN_SLOTS)] = torch.arange(6, 27)
    numbers, slots = torch.zeros(count, 24), torch.full((count, 5), -1, dtype=torch.int32)
    numbers[:, :3], numbers[:, 3:9] = surface.centres_m, covariances[:, rows, columns]
    numbers[:, 9:21] = torch.eye(3, 4).flatten()
    numbers[:, 23] = -1.0 if shape.side == "left" else 1.0
    for e, frame in enumerate(surface.frame_index.tolist()):
        if frame == 0:
            continue
        finger, bone = divmod(frame - 1, 3)
        rest = torch.cat((shape.base_frames[finger], shape.base_m[finger, :, None]), 1)
        numbers[e, 9:21] = rest.flatten()
        numbers[e, 21 : 21 + bone] = shape.bone_lengths_m[finger, :bone]
        used = (2, 4, 5)[bone]
        slots[e, :used] = where[5 * finger : 5 * finger + used].int()
    return numbers, slots
