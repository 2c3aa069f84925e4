"""How particles are moved, and drawn anew by their weights, the reference (paper, section 2.3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

Redraw = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, str], Tensor]
"""See `redraw_with`, without the motion."""
BOUNDS = ("truncate", "reflect")


class Motions(NamedTuple):
    """The operations that every back end has, see compute/rigid.py.

    compose: reference particles and tangent offsets, (N, 6 + d) or broadcast, to particles.
    difference: particles (N, 6 + d) and one reference (1, 6 + d) to tangent offsets (N, 6 + d).
    redraw: particles anew from weighted ones.
    mean: particles (N, 6 + d) and weights (N,) to their mean (1, 6 + d), which is on the CPU.
    """

    compose: Callable[[Tensor, Tensor], Tensor]
    difference: Callable[[Tensor, Tensor], Tensor]
    redraw: Redraw
    mean: Callable[[Tensor, Tensor], Tensor]


def pick(weights: Tensor, positions: Tensor) -> Tensor:
    """Which of M weighted particles lie at positions, (M,) and (n,) ascending to (n,) int64.

    positions: in 0 .. 1, of the sum of the weights.
    """
    total = weights.double().cumsum(0)
    # Relative to the sum that was really reached, so that rounding cannot leave a gap at the end.
    indices = torch.searchsorted(total, positions * total[-1], right=True)
    # The last index that has weight: one past the end is only ever a rounding.
    last = torch.searchsorted(total, total[-1:])
    return torch.minimum(indices, last)


def bound(latent: Tensor, lower: Tensor, upper: Tensor, mode: str) -> Tensor:
    """Keep latent coordinates in their box, (N, d).

    mode: of BOUNDS. "truncate" moves what is outside onto the bound, as the paper, which draws
        estimates near a bound away from where they should be and piles particles up on it;
        "reflect" folds it back.
    """
    if mode == "truncate":
        return torch.minimum(torch.maximum(latent, lower), upper)
    width = upper - lower
    folded = torch.remainder(latent - lower, 2 * width)
    return lower + torch.minimum(folded, 2 * width - folded)


def redraw_with(compose: Callable[[Tensor, Tensor], Tensor]) -> Redraw:
    """Draws that move particles by a motion, see rigid.compose."""

    def redraw(
        particles: Tensor,
        weights: Tensor,
        positions: Tensor,
        tangents: Tensor,
        lower: Tensor,
        upper: Tensor,
        mode: str,
    ) -> Tensor:
        """(M, 6 + d) particles of weights (M,) at positions (n,), moved: (n, 6 + d).

        positions, lower, upper, mode: see pick and bound.  tangents: (n, 6 + d) of the moves.
        """
        moved = compose(particles[pick(weights, positions)], tangents)
        moved[:, 6:] = bound(moved[:, 6:], lower, upper, mode)
        return moved

    return redraw
