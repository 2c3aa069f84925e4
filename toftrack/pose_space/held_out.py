"""How well a space describes poses, above all such as it has not seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from sklearn.model_selection import GroupKFold
from torch import Tensor

from toftrack.compute.threads import small_operations
from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.pose_space.base import PoseSpace, clamped_share
from toftrack.pose_space.data.pose_data import PoseData
from toftrack.pose_space.files import fit_pose_space

FOLDS = 4
_STEP = 1e-4
"""Of the differences that stand for derivatives, in parts of the box."""


class Errors(NamedTuple):
    """degrees: root mean square over poses and angles.  mm: mean distance over poses and the 20
    finger joints of a hand of 190 mm.
    """

    degrees: float
    mm: float


class Row(NamedTuple):
    """A line of the table; held_out is None where the clips cannot be split.

    variance: part explained, for spaces that have one.  training, held_out: of decode(encode(x)).
    reached: of the nearest point in the box to held-out poses, which is the best that a tracker
    could do.  clamped: part of the decoded angles in the whole box that the joint limits moved.
    """

    dims: int
    variance: float | None
    training: Errors
    held_out: Errors | None
    reached: Errors | None
    clamped: float


def reconstruction(
    space: PoseSpace, angles: Tensor, latent: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Decoded latents against poses (N, 21) rad: squared angle errors (N, 21) in rad^2 and joint
    distances (N, 20) in metres, on a hand of the default size held still at the wrist.

    latent: (N, d); None encodes the poses.
    """
    angles = angles.to(space.lower)
    again = space.decode(space.encode(angles) if latent is None else latent.to(space.lower))
    shape = default_hand_shape().to(space.lower)
    still = angles.new_zeros(len(angles), 6)
    joints = [
        forward_kinematics(torch.cat((still, pose), 1), shape).joints_m[:, 1:]
        for pose in (angles, again)
    ]
    return (again - angles).square(), (joints[1] - joints[0]).norm(dim=-1)


def summarise(parts: list[tuple[Tensor, Tensor]]) -> Errors:
    """Errors over the results of several calls of `reconstruction`."""
    square = torch.cat([part[0] for part in parts])
    distance = torch.cat([part[1] for part in parts])
    return Errors(math.degrees(float(square.mean().sqrt())), 1e3 * float(distance.mean()))


def clip_folds(clips: Tensor, folds: int = FOLDS) -> Iterator[tuple[Tensor, Tensor]]:
    """Training and held-out rows, whole clips on one side; the folds are of about equal size.

    clips: (M,) numbers.  Yields (training rows, held-out rows); nothing for a single clip.
    """
    count = min(folds, len(clips.unique()))
    if count > 1:
        for training, out in GroupKFold(count).split(clips, groups=clips):
            yield torch.from_numpy(training), torch.from_numpy(out)


def spaces_to_learn(data: PoseData) -> int:
    """How many spaces a row of the table takes: one, and one for each fold."""
    return 1 + sum(1 for _ in clip_folds(data.clips))


@small_operations()
def evaluate_space(
    kind: str,
    dims: int,
    data: PoseData,
    settings: dict[str, Any] | None = None,
    learned: Callable[[], object] = lambda: None,
) -> Row:
    """Errors of one kind of space on its training poses and, fold by fold, on held-out clips.

    learned: called after each of the `spaces_to_learn` that are learned for it.
    """
    settings = settings or {}
    space = fit_pose_space(kind, dims, data, **settings)
    learned()
    results: list[tuple[Tensor, Tensor]] = []
    reached: list[tuple[Tensor, Tensor]] = []
    for training, out in clip_folds(data.clips):
        try:
            fold = fit_pose_space(kind, dims, data.rows(training), **settings)
        except ToftrackError:  # too few poses are left for so many dimensions
            results, reached = [], []
            break
        poses = data.angles_rad[out]
        results.append(reconstruction(fold, poses))
        reached.append(reconstruction(fold, poses, nearest_latents(fold, poses)))
        learned()
    ratios = getattr(space, "explained_variance_ratio", None)
    unit = torch.rand(2000, dims, generator=torch.Generator().manual_seed(0))
    return Row(
        dims=dims,
        variance=None if ratios is None else float(ratios[:dims].sum()),
        training=summarise([reconstruction(space, data.angles_rad)]),
        held_out=summarise(results) if results else None,
        reached=summarise(reached) if reached else None,
        clamped=clamped_share(space, space.lower + unit * (space.upper - space.lower)),
    )


def errors_table(rows: list[Row]) -> str:
    """The rows as text for the terminal, without final newline."""
    lines = [
        "dims   variance   training poses        held-out clips        nearest in box       clamped"
    ]
    for row in rows:
        variance = "-" if row.variance is None else f"{100 * row.variance:.2f} %"
        clamped = f"{100 * row.clamped:.1f} %"
        lines.append(
            f"{row.dims:4d} {variance:>10}   {_figures(row.training)}   {_figures(row.held_out)}"
            f"   {_figures(row.reached)}   {clamped:>7}"
        )
    return "\n".join(lines)


def _figures(errors: Errors | None) -> str:
    if errors is None:
        return f"{'-':>19}"
    return f"{errors.degrees:5.2f} deg, {errors.mm:5.2f} mm"


def nearest_latents(space: PoseSpace, angles: Tensor, iterations: int = 25) -> Tensor:
    """Latent coordinates within the bounds whose decoded angles are nearest, (N, 21) to (N, d).

    `encode` answers another question: it is exact for PCA only, and need not stay in the box. Here
    Levenberg-Marquardt on |decode(z) - x|^2, in parts of the box and projected on it, starts from
    the encoded pose and from the nearest training pose; the better end counts.

    float64 on the CPU, as everything that this is for.
    """
    space = space.to("cpu", torch.float64)
    angles = angles.double().cpu()
    lower, span = space.lower, (space.upper - space.lower).clamp(min=1e-12)
    training = space.decode(space.training_latents)
    starts = (
        space.encode(angles),
        space.training_latents[torch.cdist(angles, training).argmin(1)],
    )
    ends = [
        _descend(space, angles, ((start - lower) / span).clamp(0, 1), iterations)
        for start in starts
    ]
    first, second = (_squared(space, end, angles) for end in ends)
    best = torch.where((first <= second)[:, None], ends[0], ends[1])
    return lower + span * best


def _decode(space: PoseSpace, unit: Tensor) -> Tensor:
    return space.decode(space.lower + unit * (space.upper - space.lower))


def _squared(space: PoseSpace, unit: Tensor, angles: Tensor) -> Tensor:
    return (_decode(space, unit) - angles).square().sum(1)


def _descend(space: PoseSpace, angles: Tensor, unit: Tensor, iterations: int) -> Tensor:
    damping = unit.new_full((len(unit), 1), 1e-2)
    value = _squared(space, unit, angles)
    steps = _STEP * torch.eye(space.dims, dtype=unit.dtype)
    for _ in range(iterations):
        here = _decode(space, unit)
        columns = [(_decode(space, unit + step) - here) / _STEP for step in steps]
        jacobian = torch.stack(columns, -1)  # (N, 21, d)
        right = (jacobian.mT @ (angles - here)[..., None])[..., 0]
        # On a bound and pushed outwards: that coordinate stays where it is.
        stuck = ((unit <= 0) & (right < 0)) | ((unit >= 1) & (right > 0))
        normal = jacobian.mT @ jacobian
        normal = normal.masked_fill(stuck[:, None] | stuck[..., None], 0.0)
        normal = normal + torch.diag_embed(damping.expand_as(unit) + stuck.double())
        moved = unit + torch.linalg.solve(normal, right.masked_fill(stuck, 0.0))
        moved = moved.clamp(0, 1)
        new = _squared(space, moved, angles)
        better = new < value
        unit = torch.where(better[:, None], moved, unit)
        value = torch.where(better, new, value)
        damping = torch.where(better[:, None], damping / 3, damping * 4).clamp(1e-9, 1e6)
    return unit
