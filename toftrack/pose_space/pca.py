"""The paper's pose space: principal components of the training poses (section 2.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.pose_space.base import PoseSpace


@dataclass(frozen=True, eq=False)
class PCAPoseSpace(PoseSpace):
    """A linear space: angles = mean + latent components.

    mean: (21,) rad.  components: (d, 21) orthonormal rows.
    explained_variance_ratio: (21,) of all components, the kept ones first.
    """

    kind: ClassVar[str] = "pca"

    mean: Tensor
    components: Tensor
    explained_variance_ratio: Tensor

    def decode_freely(self, latent: Tensor) -> Tensor:
        return torch.addmm(self.mean, latent, self.components)

    def encode(self, angles: Tensor) -> Tensor:
        return (angles - self.mean) @ self.components.mT


def fit_pca(angles: Tensor, labels: tuple[str, ...], dims: int = 4) -> PCAPoseSpace:
    """Principal components of (M, 21) training poses; float32 on the CPU."""
    if not 1 <= dims <= min(angles.shape):
        raise ToftrackError(
            f"pose_space.dims={dims} cannot be learned from {angles.shape[0]} poses of"
            f" {angles.shape[1]} angles; give 1 to {min(angles.shape)}"
        )
    x = angles.double().cpu().numpy()
    mean = x.mean(0)
    _, singular, rows = np.linalg.svd(x - mean, full_matrices=False)
    # The sign of a component is no one's: its largest entry is positive, as scikit-learn has it.
    largest = np.abs(rows).argmax(1)
    rows = rows * np.sign(rows[np.arange(len(rows)), largest])[:, None]
    components = rows[:dims]
    latents = (x - mean) @ components.T
    return PCAPoseSpace(
        mean=torch.from_numpy(mean).float(),
        components=torch.from_numpy(components.copy()).float(),
        explained_variance_ratio=torch.from_numpy(singular**2 / (singular**2).sum()).float(),
        lower=torch.from_numpy(latents.min(0)).float(),
        upper=torch.from_numpy(latents.max(0)).float(),
        training_latents=torch.from_numpy(latents).float(),
        training_labels=labels,
    )
