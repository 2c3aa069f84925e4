"""Isomap of the training poses (Tenenbaum, de Silva, Langford, Science 290, 2000).

The coordinates keep the distances between poses as one walks from neighbour to neighbour: how much
the hand has to move. A fourth space, to show what adding one takes: this file and
conf/pose_space/isomap.yaml.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import sklearn.manifold
from torch import Tensor

from toftrack.pose_space.neighbours import NeighbourSpace, fit_neighbour_space

_NEIGHBOURS = (5, 8, 12, 16, 24, 32, 48)


@dataclass(frozen=True, eq=False)
class IsomapPoseSpace(NeighbourSpace):
    """Coordinates in radians of movement along the training poses."""

    kind: ClassVar[str] = "isomap"


def fit(
    angles: Tensor, labels: tuple[str, ...], dims: int = 4, neighbours: int | None = None
) -> NeighbourSpace:
    """Isomap of (M, 21) training poses; float32 on the CPU.

    neighbours: of each pose in the graph; None tries several and takes the number whose
        cross-validated map back to angles is best.

    Raises ToftrackError when there are too few poses for so many dimensions or neighbours.
    """

    def embed(x: np.ndarray, number: int) -> np.ndarray:
        with warnings.catch_warnings():
            # A graph in several pieces is joined at their nearest poses, which is what is wanted.
            warnings.simplefilter("ignore")
            return sklearn.manifold.Isomap(
                n_neighbors=number, n_components=dims, eigen_solver="dense"
            ).fit_transform(x)

    return fit_neighbour_space(
        IsomapPoseSpace, embed, angles, labels, dims, neighbours, _NEIGHBOURS
    )


Space = IsomapPoseSpace
