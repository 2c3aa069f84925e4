"""Locally linear embedding of the training poses, the alternative that the paper names.

Every pose is written as a weighted mean of its neighbours; the coordinates are those that the same
weights reproduce best (Roweis and Saul, Science 290, 2000).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import sklearn.manifold
from torch import Tensor

from toftrack.pose_space.neighbours import NeighbourSpace, fit_neighbour_space

_NEIGHBOURS = (6, 8, 12, 16, 24)


@dataclass(frozen=True, eq=False)
class LLEPoseSpace(NeighbourSpace):
    """Locally linear coordinates; each has unit deviation over the training poses."""

    kind: ClassVar[str] = "lle"


def fit(
    angles: Tensor, labels: tuple[str, ...], dims: int = 4, neighbours: int | None = None
) -> NeighbourSpace:
    """Locally linear embedding of (M, 21) training poses; float32 on the CPU.

    neighbours: of each pose; None tries several and takes the number whose cross-validated map
        back to angles is best.

    Raises ToftrackError when there are too few poses for so many dimensions or neighbours.
    """

    def embed(x: np.ndarray, number: int) -> np.ndarray:
        latents = sklearn.manifold.LocallyLinearEmbedding(
            n_neighbors=number, n_components=dims, reg=1e-3, eigen_solver="dense"
        ).fit_transform(x)
        # The method gives coordinates of unit length; unit deviation does not depend on M.
        return (latents - latents.mean(0)) / latents.std(0).clip(1e-12)

    return fit_neighbour_space(LLEPoseSpace, embed, angles, labels, dims, neighbours, _NEIGHBOURS)


Space = LLEPoseSpace
