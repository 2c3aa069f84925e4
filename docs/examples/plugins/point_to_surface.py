"""A likelihood of one's own: how far the seen points lie from the hand's surface, in space and not
along the ray, as model-based trackers of depth images often have it.

    toftrack track --config-dir docs/examples/plugins likelihood=point_to_surface \
        experiment=paper lost.score=0.2 filter.exponent=20
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.render.likelihood import Likelihood
from toftrack.render.scoring import Counts, Evidence, Scorer


@dataclass(frozen=True)
class PointToSurface(Likelihood):
    """exp(-mean min(distance, most)^2 / sigma^2) times the part of the model's pixels that are not
    false: the surface is where points are, and points are where the surface is.

    sigma_m: a distance that counts much.  most_m: what is farther off counts no more.
    points: of the image that are asked, at most.
    """

    sigma_m: float
    most_m: float
    points: int

    def score(self, counts: Counts) -> Tensor:
        """(N,) in 0 .. 1; residual is the mean squared distance in units of sigma_m^2."""
        shown = counts.correct / (counts.correct + counts.false).clamp(min=1.0)
        return shown * torch.exp(-counts.residual)

    def scorer(self, shape: HandShape, given: Scorer) -> Scorer:
        """The back end's counts with the points' distances for their residual."""
        return _PointScorer(self, shape, given)


class _PointScorer:
    name = "point to surface"

    def __init__(self, head: PointToSurface, shape: HandShape, given: Scorer) -> None:
        self.head, self.shape, self.given = head, shape, given

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        points_m = _points(evidence, self.head.points)
        if not len(points_m):
            return self.given(states, evidence)
        shape = self.shape.to(states.device)
        centres_m, axes_m = hand_surface(shape).pose(forward_kinematics(states.float(), shape))
        distance_m = distances(points_m, centres_m[:, :-1], axes_m[:, :-1])  # without the wrist
        square = (distance_m.clamp(max=self.head.most_m) / self.head.sigma_m).square()
        return self.given(states, evidence)._replace(residual=square.mean(1))


def _points(evidence: Evidence, most: int) -> Tensor:
    """(P, 3) points of the hand's pixels in the camera frame, m, evenly chosen."""
    row, column = evidence.hand.nonzero(as_tuple=True)
    step = -(-len(row) // most) if most else 1
    row, column = row[::step], column[::step]
    z = (1 / evidence.low[row, column] + 1 / evidence.high[row, column]) / 2
    pixels = torch.stack((column, row, torch.ones_like(row)), 1).float()
    points_m: Tensor = z[:, None] * (pixels @ torch.linalg.inv(evidence.k.float()).mT)
    return points_m


def distances(points_m: Tensor, centres_m: Tensor, axes_m: Tensor) -> Tensor:
    """(N, P) m from points (P, 3) to the surface of N hands of ellipsoids, see Ellipsoids; exact on
    the surface, and of first order beside it.
    """
    square = axes_m.square().sum(2)[:, :, None]  # (N, E, 1, 3), of the semi-axes
    away = points_m - centres_m[:, :, None]  # (N, E, P, 3)
    unit = away @ axes_m / square  # on the unit sphere where a point is on the surface
    parts = unit.square() + 1e-6  # the middle has a way out, too
    radius, slope = parts.sum(-1).sqrt(), (parts / square).sum(-1).sqrt()
    signed: Tensor = (radius - 1) * radius / slope
    return signed.amin(1).abs()  # to the nearest ellipsoid; within one, to the way out
