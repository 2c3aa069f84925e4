"""Pose spaces without a linear map back: kernel PCA, locally linear embedding and Isomap.

Their coordinates become angles by kernel ridge regression, the kernel method that the paper asks
for (section 4), where it names Jaeggli, Koller-Meier and Van Gool, "Multi-activity tracking in LLE
body pose space" (ICCV workshop on Human Motion, 2007); the posterior mean of a Gaussian process is
the same formula. A straight-line fit carries the trend, so that beyond the training poses the map
goes on in a line instead of falling back to the mean pose.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from toftrack.errors import ToftrackError, check_number
from toftrack.pose_space.base import PoseSpace, check_dims, signed, tensor32

# Widths of the map's kernel in parts of the median distance between training latents, and ridges
# relative to a kernel's value of 1. All pairs are tried.
_WIDTHS = (0.15, 0.25, 0.4, 0.7, 1.2, 2.0)
_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_FOLDS = 5
# Widths tried for the kernel between poses, in parts of their median distance.
_POSE_WIDTHS = (0.7, 1.0, 1.5, 2.5)
_NEIGHBOUR_RIDGE = 1e-2
"""Regularises the weights of neighbours, in parts of their squared distances."""


@dataclass(frozen=True, eq=False)
class KernelDecodedSpace(PoseSpace):
    """A space whose map back to angles is a fitted kernel regression.

    training_latents: (M, d), the centres of the kernel exp(-|inverse_width (z - z_m)|^2).
    offset: (21,) rad.  trend: (d, 21).  coefficients: (M, 21).
    inverse_width: () 1 / (sqrt(2) width).  poses: (M, 21) rad, the training poses.
    """

    offset: Tensor
    trend: Tensor
    coefficients: Tensor
    inverse_width: Tensor
    poses: Tensor

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


def _regression(latents: np.ndarray, angles: np.ndarray) -> tuple[float, dict[str, Any]]:
    """Kernel ridge from (M, d) to (M, 21), float64, width and ridge by cross-validation.

    The folds are drawn pose by pose with a fixed seed: the map is asked about the gaps between
    training poses. How it does on motion that it has not seen is another question, which
    train_pose_space.py answers with whole clips.

    Returns the root mean square error over the validation poses and angles, rad, and the fields of
    a KernelDecodedSpace that follow from the latents.
    """
    from scipy.linalg import cho_factor, cho_solve  # which only learning needs

    count = len(latents)
    order = np.random.default_rng(0).permutation(count)
    parts = np.array_split(order, min(_FOLDS, count))
    square = _squared_distances(latents)
    median = np.sqrt(_median(square))
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
    return float(np.sqrt(errors[w, r] / angles.size)), {
        "lower": tensor32(latents.min(0)),
        "upper": tensor32(latents.max(0)),
        "training_latents": tensor32(latents),
        "offset": tensor32(line[0]),
        "trend": tensor32(line[1:]),
        "coefficients": tensor32(np.linalg.solve(kernel, angles - design @ line)),
        "inverse_width": tensor32(1 / (np.sqrt(2) * width)),
        "poses": tensor32(angles),
    }


def _squared_distances(points: np.ndarray) -> np.ndarray:
    return np.square(points[:, None] - points[None]).sum(-1)


def _median(square: np.ndarray) -> float:
    """Of the distances that are not 0."""
    return float(np.median(square[square > 0])) if (square > 0).any() else 1.0


def _design(latents: np.ndarray) -> np.ndarray:
    return np.column_stack((np.ones(len(latents)), latents))


def _line(latents: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Design matrix (M, 1 + d) and the least-squares line (1 + d, 21)."""
    design = _design(latents)
    return design, np.linalg.lstsq(design, angles, rcond=None)[0]


@dataclass(frozen=True, eq=False)
class KernelPCAPoseSpace(KernelDecodedSpace):
    """Kernel principal components (Scholkopf, Smola, Muller 1998): latent = k(x) projection +
    shift.

    Poses are compared by a Gaussian kernel, so that the coordinates may follow a bent path; as the
    kernel widens the space becomes the linear one.

    gamma: () of the kernel exp(-gamma |x - x_m|^2) between poses, 1 / rad^2.
    projection: (M, d) eigenvectors over the roots of their eigenvalues, in radians.
    shift: (d,) rad, the centring.
    """

    kind: ClassVar[str] = "kernel_pca"

    gamma: Tensor
    projection: Tensor
    shift: Tensor

    def encode(self, angles: Tensor) -> Tensor:
        distance = (angles[:, None] - self.poses).square().sum(-1)
        return (-self.gamma * distance).exp() @ self.projection + self.shift

    @classmethod
    def fit(
        cls, angles: Tensor, labels: tuple[str, ...], dims: int, gamma: float | None = None
    ) -> Self:
        """Kernel PCA of (M, 21) training poses; float32 on the CPU.

        gamma: of the kernel between poses, 1 / rad^2; None tries several and takes the one whose
            cross-validated map back to angles is best.
        """
        import sklearn.decomposition  # here, as it takes a while, and the linear space needs none

        x = angles.double().cpu().numpy()
        check_dims(dims, len(x), len(x) - 1)
        if gamma is not None:
            remedy = ", in 1 / rad^2, or null"
            check_number("pose_space.gamma", gamma, 0, above=True, remedy=remedy)
        square = _squared_distances(x)
        median = _median(square)
        fits = []
        for candidate in (gamma,) if gamma else [1 / (2 * w**2 * median) for w in _POSE_WIDTHS]:
            model = sklearn.decomposition.KernelPCA(
                n_components=dims, kernel="rbf", gamma=candidate, eigen_solver="dense"
            ).fit(x)
            if model.eigenvalues_.shape[0] < dims or model.eigenvalues_[-1] < 1e-10:
                continue
            vectors = signed(model.eigenvectors_)
            # In this unit the coordinates are those of PCA, in radians, when the kernel is wide.
            unit = 1 / np.sqrt(2 * candidate)
            error_rad, found = _regression(unit * vectors * np.sqrt(model.eigenvalues_), x)
            fits.append((error_rad, found, unit * vectors / np.sqrt(model.eigenvalues_), candidate))
        if not fits:
            raise ToftrackError(
                f"pose_space.dims={dims} is more than the {len(x)} poses span; give a smaller"
                " number"
            )
        _, found, projection, chosen = min(fits, key=lambda fit: fit[0])
        # The centred kernel row is k - mean(k) - column means + grand mean; the eigenvectors of a
        # centred kernel sum to zero, so that only the column means are left.
        return cls(
            **found,
            training_labels=labels,
            gamma=tensor32(chosen),
            projection=tensor32(projection),
            shift=tensor32(-np.exp(-chosen * square).mean(0) @ projection),
        )


@dataclass(frozen=True, eq=False)
class NeighbourSpace(KernelDecodedSpace):
    """Coordinates that are known only at the training poses: a new pose asks its neighbours.

    neighbours: () their number.  tried: those that are, where none is given.
    """

    tried: ClassVar[tuple[int, ...]]

    neighbours: Tensor

    @staticmethod
    def embedded(poses: np.ndarray, dims: int, neighbours: int) -> np.ndarray:
        """(M, 21) poses to (M, dims) coordinates, float64."""
        raise NotImplementedError

    @classmethod
    def fit(
        cls, angles: Tensor, labels: tuple[str, ...], dims: int, neighbours: int | None = None
    ) -> Self:
        """The space of (M, 21) training poses whose cross-validated map back to angles is best
        among numbers of neighbours.

        neighbours: the only number to try; None tries those that fit the poses.
        """
        x = angles.double().cpu().numpy()
        most = len(x) - 1
        check_dims(dims, len(x), min(most - 1, x.shape[1]))
        if neighbours is not None:
            remedy = f" for {dims} dimensions of {len(x)} poses, or null"
            check_number(
                "pose_space.neighbours", neighbours, dims + 1, most, whole=True, remedy=remedy
            )
        numbers = (neighbours,) if neighbours else {min(max(k, dims + 1), most) for k in cls.tried}
        fits = []
        for number in sorted(numbers):
            fits.append((*_regression(signed(cls.embedded(x, dims, number)), x), number))
        _, found, number = min(fits, key=lambda fit: fit[0])
        return cls(**found, training_labels=labels, neighbours=tensor32(number))

    @cached_property
    def _count(self) -> int:
        """Read once, so that encoding does not wait for the device."""
        return int(self.neighbours)

    def encode(self, angles: Tensor) -> Tensor:
        """(N, 21) radians to (N, d), by the weights that make up the pose from its neighbours."""
        nearest, weights = barycentric_weights(angles, self.poses, self._count)
        return torch.einsum("nk,nkd->nd", weights, self.training_latents[nearest])


class LLEPoseSpace(NeighbourSpace):
    """Locally linear embedding, the alternative that the paper names (Roweis and Saul, Science 290,
    2000): every pose is a weighted mean of its neighbours, and the coordinates are those that the
    same weights reproduce best. Each has unit deviation over the training poses.
    """

    kind: ClassVar[str] = "lle"
    tried: ClassVar[tuple[int, ...]] = (6, 8, 12, 16, 24)

    @staticmethod
    def embedded(poses: np.ndarray, dims: int, neighbours: int) -> np.ndarray:
        from sklearn.manifold import LocallyLinearEmbedding

        latents = LocallyLinearEmbedding(
            n_neighbors=neighbours, n_components=dims, reg=1e-3, eigen_solver="dense"
        ).fit_transform(poses)
        # The method gives coordinates of unit length; unit deviation does not depend on M.
        return (latents - latents.mean(0)) / latents.std(0).clip(1e-12)


class IsomapPoseSpace(NeighbourSpace):
    """Isomap (Tenenbaum, de Silva, Langford, Science 290, 2000): coordinates keep the distances
    between poses as one walks from neighbour to neighbour, in radians: how much the hand moves.
    """

    kind: ClassVar[str] = "isomap"
    tried: ClassVar[tuple[int, ...]] = (5, 8, 12, 16, 24, 32, 48)

    @staticmethod
    def embedded(poses: np.ndarray, dims: int, neighbours: int) -> np.ndarray:
        from sklearn.manifold import Isomap

        with warnings.catch_warnings():
            # A graph in several pieces is joined at their nearest poses, which is what is wanted.
            warnings.simplefilter("ignore")
            model = Isomap(n_neighbors=neighbours, n_components=dims, eigen_solver="dense")
            return model.fit_transform(poses)


def barycentric_weights(angles: Tensor, poses: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """The nearest poses and the weights, summing to 1, that make up each pose best.

    The constrained least squares of locally linear embedding (Saul and Roweis, J. Mach. Learn. Res.
    4, 2003, section 5), regularised in parts of each neighbour's own squared distance, so that
    nearer ones come first and a training pose is made of itself alone.

    angles: (N, 21).  poses: (M, 21).  Returns indices (N, k) and weights (N, k).
    """
    # Differences, not products: float32 must still tell a pose from itself.
    distance = (angles[:, None] - poses).square().sum(-1)
    nearest = distance.topk(neighbours, dim=1, largest=False).indices
    offsets = poses[nearest] - angles[:, None]  # (N, k, 21)
    gram = offsets @ offsets.mT
    loading = (_NEIGHBOUR_RIDGE * gram.diagonal(dim1=1, dim2=2)).clamp(min=1e-9)
    ones = gram.new_ones(len(gram), neighbours, 1)
    weights = torch.linalg.solve(gram + torch.diag_embed(loading), ones)[..., 0]
    return nearest, weights / weights.sum(1, keepdim=True)
