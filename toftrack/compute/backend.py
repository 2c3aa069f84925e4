"""The back end: who scores, refines and moves hypotheses here, chosen once for a whole tracker.

Only the types stand here, so that every room may know them; tracking/backend.py chooses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from toftrack.compute.redraw import Redraw

if TYPE_CHECKING:
    from toftrack.hand.shape import HandShape
    from toftrack.refinement.gauss_newton import Keypoints, Refiner
    from toftrack.render.scoring import Scorer


class Motions(NamedTuple):
    """How particles are moved, see compute/rigid.py.

    compose: reference particles and tangent offsets, (N, 6 + d) or broadcast, to particles.
    difference: particles (N, 6 + d) and one reference (1, 6 + d) to tangent offsets (N, 6 + d).
    redraw: particles anew from weighted ones, see compute/redraw.py.
    mean: particles (N, 6 + d) and weights (N,) to their mean (1, 6 + d), which is on the CPU.
    """

    compose: Callable[[Tensor, Tensor], Tensor]
    difference: Callable[[Tensor, Tensor], Tensor]
    redraw: Redraw
    mean: Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Backend:
    """One way to compute everything that depends on the machine.

    name: "torch", "numba" or "triton", as `renderer=` says it.
    device: where the particles are. A frame's estimate is on the CPU, where its few poses are
        refined and compared, as is all that is said of it.
    motions: of particles, there and on the CPU.
    joints_penalty: what speaks against joints besides the image, see tracking/penalty.py; on the
        CPU.
    make_scorer: for a hand of some sizes, given on the CPU; it takes states on the device.
    make_refiner: likewise, on the CPU.
    """

    name: str
    device: torch.device
    motions: Motions
    joints_penalty: Callable[[Tensor, float, float, Keypoints | None, float], Tensor]
    make_scorer: Callable[[HandShape], Scorer]
    make_refiner: Callable[[HandShape], Refiner]
