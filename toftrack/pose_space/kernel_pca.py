"""Kernel principal components of the training poses (Scholkopf, Smola, Muller 1998).

Poses are compared by a Gaussian kernel, so that the coordinates may follow a bent path; as the
kernel widens the space becomes the linear one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import sklearn.decomposition
import torch
from torch import Tensor

from toftrack.errors import ToftrackError
from toftrack.pose_space.kernel_decoder import (
    KernelDecodedSpace,
    fit_regression,
    regression_tensors,
    tensor32,
)

# Widths tried for the kernel between poses, in parts of their median distance.
_WIDTHS = (0.7, 1.0, 1.5, 2.5)


@dataclass(frozen=True, eq=False)
class KernelPCAPoseSpace(KernelDecodedSpace):
    """latent = k(x) projection + shift, angles by kernel regression.

    poses: (M, 21) rad, the kernel's centres.  gamma: () of exp(-gamma |x - x_m|^2), 1 / rad^2.
    projection: (M, d) eigenvectors over the roots of their eigenvalues, in radians.
    shift: (d,) rad, the centring.
    """

    kind: ClassVar[str] = "kernel_pca"

    poses: Tensor
    gamma: Tensor
    projection: Tensor
    shift: Tensor

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) radians to (N, d)."""
        distance = (angles[:, None] - self.poses).square().sum(-1)
        return (-self.gamma * distance).exp() @ self.projection + self.shift


def fit(
    angles: Tensor, labels: tuple[str, ...], dims: int = 4, gamma: float | None = None
) -> KernelPCAPoseSpace:
    """Kernel PCA of (M, 21) training poses; float32 on the CPU.

    gamma: of the kernel between poses, 1 / rad^2; None tries several and takes the one whose
        cross-validated map back to angles is best.

    Raises ToftrackError when the poses do not span so many dimensions.
    """
    x = angles.double().cpu().numpy()
    if not 1 <= dims < len(x):
        raise ToftrackError(
            f"pose_space.dims={dims} cannot be learned from {len(x)} poses; give 1 to {len(x) - 1}"
        )
    if gamma is not None and gamma <= 0:
        raise ToftrackError(f"pose_space.gamma={gamma} must be above 0, in 1 / rad^2, or null")
    square = np.square(x[:, None] - x[None]).sum(-1)
    median = float(np.median(square[square > 0])) if (square > 0).any() else 1.0
    candidates = (gamma,) if gamma else tuple(1 / (2 * w**2 * median) for w in _WIDTHS)
    best = None
    for candidate in candidates:
        model = sklearn.decomposition.KernelPCA(
            n_components=dims, kernel="rbf", gamma=candidate, eigen_solver="dense"
        ).fit(x)
        if model.eigenvalues_.shape[0] < dims or model.eigenvalues_[-1] < 1e-10:
            continue
        # The sign of an eigenvector is arbitrary: the largest entry is made positive.
        vectors = model.eigenvectors_
        vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(0), np.arange(dims)])
        # In this unit the coordinates are those of PCA, in radians, when the kernel is wide.
        unit = 1 / np.sqrt(2 * candidate)
        latents = unit * vectors * np.sqrt(model.eigenvalues_)
        regression = fit_regression(latents, x)
        if best is None or regression.error_rad < best[0].error_rad:
            best = regression, latents, unit * vectors / np.sqrt(model.eigenvalues_), candidate
    if best is None:
        raise ToftrackError(
            f"pose_space.dims={dims} is more than the {len(x)} poses span; give a smaller number"
        )
    regression, latents, projection, chosen = best
    kernel = np.exp(-chosen * square)
    # The centred kernel row is k - mean(k) - column means + grand mean; the eigenvectors of a
    # centred kernel sum to zero, so that only the column means are left.
    return KernelPCAPoseSpace(
        **regression_tensors(regression, latents, labels),
        poses=tensor32(x),
        gamma=torch.tensor(chosen, dtype=torch.float32),
        projection=tensor32(projection),
        shift=tensor32(-kernel.mean(0) @ projection),
    )


Space = KernelPCAPoseSpace
