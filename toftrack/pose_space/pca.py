"""The paper's pose space: principal components of the training poses (section 2.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from toftrack.pose_space.base import PoseSpace, check_dims, signed, tensor32


@dataclass(frozen=True, eq=False)
class PCAPoseSpace(PoseSpace):
    """A linear space: angles = mean + latent components.

    mean: (21,) rad.  components: (d, 21) orthonormal rows.
    explained_variance_ratio: (21,), or one a pose where these are fewer, of all components, the
        kept ones first.
    """

    kind: ClassVar[str] = "pca"

    mean: Tensor
    components: Tensor
    explained_variance_ratio: Tensor

    def decode_freely(self, latent: Tensor) -> Tensor:
        return torch.addmm(self.mean, latent, self.components)

    def encode(self, angles: Tensor) -> Tensor:
        return (angles - self.mean) @ self.components.mT

    @classmethod
    def fit(cls, angles: Tensor, labels: tuple[str, ...], dims: int) -> Self:
        """Principal components of (M, 21) training poses; float32 on the CPU."""
        check_dims(dims, len(angles), min(angles.shape))
        x = angles.double().cpu().numpy()
        mean = x.mean(0)
        _, singular, rows = np.linalg.svd(x - mean, full_matrices=False)
        components = signed(rows.T).T[:dims]
        latents = (x - mean) @ components.T
        return cls(
            mean=tensor32(mean),
            components=tensor32(components),
            explained_variance_ratio=tensor32(singular**2 / (singular**2).sum()),
            lower=tensor32(latents.min(0)),
            upper=tensor32(latents.max(0)),
            training_latents=tensor32(latents),
            training_labels=labels,
        )
