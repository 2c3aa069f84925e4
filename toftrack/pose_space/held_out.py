"""How well a space describes poses, above all such as it has not seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from toftrack.compute.threads import small_operations
from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.pose_space.base import PoseSpace, TensorSpace, clamped_share
from toftrack.pose_space.data.pose_data import PoseData
from toftrack.pose_space.files import fit_pose_space
from toftrack.pose_space.reach import nearest_latents

FOLDS = 4


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
    clamped: float | None


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
    numbers, counts = clips.unique(return_counts=True)
    if len(numbers) < 2:
        return
    members: list[list[int]] = [[] for _ in range(min(folds, len(numbers)))]
    sizes = [0] * len(members)
    for place in counts.argsort(descending=True, stable=True).tolist():
        smallest = sizes.index(min(sizes))
        members[smallest].append(int(numbers[place]))
        sizes[smallest] += int(counts[place])
    for chosen in members:
        out = torch.isin(clips, torch.tensor(chosen))
        yield (~out).nonzero()[:, 0], out.nonzero()[:, 0]


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
    clamped = None
    if isinstance(space, TensorSpace):
        unit = torch.rand(2000, dims, generator=torch.Generator().manual_seed(0))
        clamped = clamped_share(space, space.lower + unit * (space.upper - space.lower))
    return Row(
        dims=dims,
        variance=None if ratios is None else float(ratios[:dims].sum()),
        training=summarise([reconstruction(space, data.angles_rad)]),
        held_out=summarise(results) if results else None,
        reached=summarise(reached) if reached else None,
        clamped=clamped,
    )


def errors_table(rows: list[Row]) -> str:
    """The rows as text for the terminal, without final newline."""
    lines = [
        "dims   variance   training poses        held-out clips        nearest in box       clamped"
    ]
    for row in rows:
        variance = "-" if row.variance is None else f"{100 * row.variance:.2f} %"
        clamped = "-" if row.clamped is None else f"{100 * row.clamped:.1f} %"
        lines.append(
            f"{row.dims:4d} {variance:>10}   {_figures(row.training)}   {_figures(row.held_out)}"
            f"   {_figures(row.reached)}   {clamped:>7}"
        )
    return "\n".join(lines)


def _figures(errors: Errors | None) -> str:
    if errors is None:
        return f"{'-':>19}"
    return f"{errors.degrees:5.2f} deg, {errors.mm:5.2f} mm"
