"""Latent coordinates to joint angles for spaces without a linear map back (paper, section 4).

Kernel ridge regression, as in Jaeggli, Koller-Meier and Van Gool, "Learning generative models for
monocular body pose estimation" (ACCV 2007), which the paper names for this; the posterior mean of a
Gaussian process is the same formula. A straight-line fit carries the trend, so that beyond the
training poses the map goes on in a line instead of falling back to the mean pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from toftrack.pose_space.base import TensorSpace

# Widths of the kernel in parts of the median distance between training latents, and ridges relative
# to a kernel's value of 1. All pairs are tried.
_WIDTHS = (0.15, 0.25, 0.4, 0.7, 1.2, 2.0)
_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


class Regression(NamedTuple):
    """A fitted map from latent coordinates to angles, float64.

    offset: (21,).  trend: (d, 21).  coefficients: (M, 21).  inverse_width: () 1 / (sqrt(2) width),
    so that the kernel is exp(-|inverse_width (z - z_m)|^2).  error_rad: root mean square over the
    validation poses and angles.
    """

    offset: np.ndarray
    trend: np.ndarray
    coefficients: np.ndarray
    inverse_width: np.ndarray
    error_rad: float


@dataclass(frozen=True, eq=False)
class KernelDecodedSpace(TensorSpace):
    """A space whose map back to angles is a fitted kernel regression.

    training_latents: (M, d), the kernel's centres.
    offset: (21,) rad.  trend: (d, 21).  coefficients: (M, 21).  inverse_width: ().
    """

    offset: Tensor
    trend: Tensor
    coefficients: Tensor
    inverse_width: Tensor

    def decode_freely(self, latent: Tensor) -> Tensor:
        """(N, d) to (N, 21) radians: offset + z trend + k(z) coefficients.

        The kernel's exponent -|z|^2 - |c|^2 + 2 z c is one product of augmented matrices.
        """
        z = latent * self.inverse_width
        c = self.training_latents * self.inverse_width
        ones = z.new_ones(len(z), 1)
        left = torch.cat((z, z.square().sum(1, keepdim=True), ones), 1)
        right = torch.cat((2 * c, -torch.ones_like(c[:, :1]), -c.square().sum(1, keepdim=True)), 1)
        kernel = (left @ right.mT).clamp_(min=-60.0).exp_()
        linear = torch.addmm(self.offset, latent, self.trend)
        return linear.addmm_(kernel, self.coefficients)


def fit_regression(latents: np.ndarray, angles: np.ndarray, folds: int = 5) -> Regression:
    """Kernel ridge from (M, d) to (M, 21), float64, width and ridge by cross-validation.

    The folds are drawn pose by pose with a fixed seed: the map is asked about the gaps between
    training poses. How it does on motion that it has not seen is another question, which
    train_pose_space.py answers with whole clips.
    """
    count = len(latents)
    order = np.random.default_rng(0).permutation(count)
    parts = np.array_split(order, min(folds, count))
    square = _squared_distances(latents)
    median = np.sqrt(np.median(square[square > 0])) if (square > 0).any() else 1.0
    errors = np.zeros((len(_WIDTHS), len(_RIDGES)))
    rests = [np.setdiff1d(order, part) for part in parts]
    lines = [_line(latents[rest], angles[rest]) for rest in rests]
    for w, width in enumerate(_WIDTHS):
        kernel = np.exp(-square / (2 * (width * median) ** 2))
        for part, rest, (design, line) in zip(parts, rests, lines, strict=True):
            residual = angles[rest] - design @ line
            expected = angles[part] - _design(latents[part]) @ line
            among, across = kernel[np.ix_(rest, rest)], kernel[np.ix_(part, rest)]
            for r, ridge in enumerate(_RIDGES):
                # Five of these take half the time of the eigenvectors, which would do for all.
                factor = cho_factor(among + ridge * np.eye(len(rest)), overwrite_a=True)
                predicted = across @ cho_solve(factor, residual)
                errors[w, r] += np.square(predicted - expected).sum()
    w, r = map(int, np.unravel_index(errors.argmin(), errors.shape))
    width = _WIDTHS[w] * median
    design, line = _line(latents, angles)
    kernel = np.exp(-square / (2 * width**2)) + _RIDGES[r] * np.eye(count)
    coefficients = np.linalg.solve(kernel, angles - design @ line)
    return Regression(
        offset=line[0],
        trend=line[1:],
        coefficients=coefficients,
        inverse_width=np.asarray(1 / (np.sqrt(2) * width)),
        error_rad=float(np.sqrt(errors[w, r] / angles.size)),
    )


def regression_tensors(
    regression: Regression, latents: np.ndarray, labels: tuple[str, ...]
) -> dict[str, Any]:
    """The fields of a KernelDecodedSpace, float32 on the CPU."""
    arrays = {
        "lower": latents.min(0),
        "upper": latents.max(0),
        "training_latents": latents,
        "offset": regression.offset,
        "trend": regression.trend,
        "coefficients": regression.coefficients,
        "inverse_width": regression.inverse_width,
    }
    return {name: tensor32(value) for name, value in arrays.items()} | {"training_labels": labels}


def tensor32(array: np.ndarray) -> Tensor:
    """A float32 tensor with its own memory."""
    return torch.tensor(np.asarray(array), dtype=torch.float32)


def _squared_distances(points: np.ndarray) -> np.ndarray:
    return np.square(points[:, None] - points[None]).sum(-1)


def _design(latents: np.ndarray) -> np.ndarray:
    return np.column_stack((np.ones(len(latents)), latents))


def _line(latents: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Design matrix (M, 1 + d) and the least-squares line (1 + d, 21)."""
    design = _design(latents)
    return design, np.linalg.lstsq(design, angles, rcond=None)[0]
