"""How particles are moved: the operations that every back end has."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from toftrack.compute.redraw import Redraw


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
