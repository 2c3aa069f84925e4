"""The tracker: a frame in, an estimate out, particles in between (paper, fig. 1)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from toftrack import filter as sir
from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.likelihood import FMeasure
from toftrack.pose_space.base import PoseSpace, clamp_to_joint_limits
from toftrack.refine import Refinement, refine, surroundings
from toftrack.render.closed_form import render_range_images
from toftrack.render.scoring import Evidence, Scorer, make_scorer
from toftrack.segmentation import Expected, NearestSurface, Observation
from toftrack.start import Start


@dataclass(frozen=True)
class FilterSettings:
    """How the particles are resampled, moved and weighted; see conf/filter for what each does."""

    particles: int = 300
    passes: int = 3
    exponent: float = 20.0
    exponent_growth: float = 1.5
    shrink: float = 0.6
    spread: sir.Spread = sir.Spread(0.012, 0.012, 0.12, 0.08)
    velocity: float = 0.7
    velocity_smoothing: float = 0.5
    resampling: str = "systematic"
    bounds: str = "reflect"

    def __post_init__(self) -> None:
        if self.resampling not in sir.RESAMPLERS:
            raise ToftrackError(
                f"filter.resampling={self.resampling} is unknown; give one of"
                f" {', '.join(sir.RESAMPLERS)}"
            )
        if self.particles < 1 or self.passes < 1:
            raise ToftrackError("filter.particles and filter.passes must be at least 1")


@dataclass(frozen=True)
class LostSettings:
    """When the tracker says that it has lost the hand.

    score: the estimate's score below which a frame counts as bad.
    patience: so many bad frames in a row and the hand is lost; the next frame with something near
        starts anew.  0 never starts anew (the paper).
    """

    score: float = 0.55
    patience: int = 3


@dataclass(frozen=True)
class TrackState:
    """What the tracker carries from frame to frame.

    particles: (N, 6 + d), after the last observation.  weights: (N,) normalised.
    mean: (1, 6 + d), the last estimate.  velocity: (6 + d,) its change a frame, tangent.
    bad: bad frames in a row.
    """

    particles: Tensor
    weights: Tensor
    mean: Tensor
    velocity: Tensor
    offset: Tensor
    bad: int = 0


class Tracker:
    """Follows one hand through rectified depth images.

    Everything from the observation to the weights is batched torch on one device.
    """

    def __init__(
        self,
        shape: HandShape,
        space: PoseSpace,
        segmentation: NearestSurface,
        likelihood: FMeasure,
        settings: FilterSettings,
        refinement: Refinement,
        start: Start,
        lost: LostSettings,
        renderer: str = "auto",
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        self.device = torch.device(device)
        self.shape = shape.to(self.device)
        self.surface = hand_surface(self.shape)
        self.space = space.to(self.device)
        self.segmentation = segmentation
        self.likelihood = likelihood
        self.settings = settings
        self.refinement = refinement
        self.start = start
        import os
        self.swaps=int(os.environ.get("SWAPS","128")); self.margin=float(os.environ.get("MARGIN","0.02"))
        self._poses = self.space.decode(self.space.training_latents)
        self._finger_of_angle = torch.tensor([0] * 5 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4, device=self.device)
        self.feedback = os.environ.get("FB","1")=="1"; self.keep=float(os.environ.get("KEEP","0.5"))
        self.lost = lost
        self.scorer: Scorer = make_scorer(renderer, self.shape, self.device)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.track: TrackState | None = None
        self._last: Estimate | None = None

    def step(self, depth_m: np.ndarray, k: np.ndarray, index: int, timestamp_s: float) -> Estimate:
        """One frame: segment, predict, then resample - diffuse - observe in annealed passes.

        depth_m: (H, W) rectified Z in metres, 0 = no reading.  k: (3, 3) intrinsics.
        """
        began = time.perf_counter()
        observation = self.segmentation(depth_m, k, self._expected())
        if observation.empty:
            self.track = None
            return self._missing(index, timestamp_s, began)
        observation = observation.to(self.device)
        evidence = self.likelihood.evidence(observation)
        starting = self.track is None
        track = self._initialise(observation, evidence) if self.track is None else self.track

        cfg, lower, upper = self.settings, self.space.lower, self.space.upper
        particles, weights = sir.compose(track.particles, track.velocity[None]), track.weights
        sigmas = cfg.spread.sigmas(lower, upper)
        for number in range(cfg.passes):
            chosen = sir.RESAMPLERS[cfg.resampling](weights, cfg.particles, self.generator)
            scale = sigmas * cfg.shrink**number
            particles = sir.diffuse(
                particles[chosen], scale, lower, upper, cfg.bounds, self.generator
            )
            exponent = cfg.exponent * cfg.exponent_growth**number
            weights = sir.normalise(exponent * self._log_scores(particles, evidence=evidence, offset=track.offset))

        mean = sir.mean_particle(particles, weights)
        state = self._refined(self.decode(mean, track.offset), mean, observation)
        state = self._swap_fingers(state, mean, evidence, observation)
        if self.feedback:
            latent = sir.bound(self.space.encode(state[:, 6:]), lower, upper, "truncate")
            refined = torch.cat((state[:, :6], latent), 1)
            particles = sir.compose(particles, sir.difference(refined, mean))
            particles[:, 6:] = sir.bound(particles[:, 6:], lower, upper, "truncate")
            offset = self.keep * (state[0, 6:] - self.space.decode(latent)[0])
            mean = refined
        else:
            offset = track.offset
        score = float(self.likelihood.score(self.scorer(state, evidence)))
        bad = track.bad + 1 if score < self.lost.score else 0
        velocity = self._velocity(track, mean) if not starting else torch.zeros_like(mean[0])
        self.track = TrackState(particles, weights, mean, velocity, offset, bad)
        lost = self._give_up()
        name = "lost" if lost else "initialising" if starting else "tracking"
        return self._estimate(
            particles, weights, mean, state, score, name, bad > 0, index, timestamp_s, began
        )

    def _expected(self) -> Expected | None:
        """Depths of the tracked hand, one movement ahead."""
        if self.track is None:
            return None
        state = self.decode(sir.compose(self.track.mean, self.track.velocity[None]))
        z = forward_kinematics(state, self.shape).joints_m[0, :, 2]
        return Expected(float(z.min()), float(z.max()))

    def _log_scores(
        self,
        particles: Tensor,
        coverage: float | None = None,
        *,
        evidence: Evidence,
        offset: Tensor | float = 0.0,
    ) -> Tensor:
        counts = self.scorer(self.decode(particles, offset), evidence)
        return self.likelihood.log_score(counts, coverage)

    def decode(self, particles: Tensor, offset: Tensor | float = 0.0) -> Tensor:
        """(N, 6 + d) particles to (N, 27) hand states."""
        angles = clamp_to_joint_limits(self.space.decode(particles[:, 6:]) + offset)
        return torch.cat((particles[:, :6], angles), 1)

    def _initialise(self, observation: Observation, evidence: Evidence) -> TrackState:
        n = self.settings.particles
        particles = self.start(
            observation,
            self.space,
            partial(self._log_scores, evidence=evidence),
            n,
            self.generator,
        )
        weights = torch.full((n,), 1.0 / n, dtype=torch.float64, device=self.device)
        mean = particles[:1]
        return TrackState(
            particles, weights, mean, torch.zeros_like(mean[0]), torch.zeros(21, device=self.device)
        )

    def _refined(self, state: Tensor, mean: Tensor, observation: Observation) -> Tensor:
        """A hand state brought onto the seen points, with the estimate's pose as prior; (1, 27)."""
        if self.refinement.iterations == 0:
            return state
        middle = forward_kinematics(state, self.shape).joints_m[0].mean(0)
        seen = surroundings(observation, middle, self.refinement.points)
        if len(seen.points_m) == 0:
            return state
        return refine(state, state[:, 6:], seen, self.shape, self.surface, self.refinement)

    def _swap_fingers(
        self, state: Tensor, mean: Tensor, evidence: Evidence, observation: Observation
    ) -> Tensor:
        """Try other poses of single fingers and keep the best if it explains the image better.

        Gauss-Newton cannot bring a finger across from where it sees nothing of it. The tried poses
        are those that the finger has in the training poses.
        """
        n = self.swaps
        if n == 0 or self.refinement.iterations == 0:
            return state
        device = self.device
        rows = torch.randint(len(self._poses), (n,), generator=self.generator, device=device)
        fingers = torch.randint(5, (n,), generator=self.generator, device=device)
        tried = state.repeat(n + 1, 1)
        angles = torch.where(self._finger_of_angle == fingers[:, None], self._poses[rows], tried[1:, 6:])
        tried[1:, 6:] = angles
        scores = self.likelihood.log_score(self.scorer(tried, evidence), 0.2)
        best = scores.argmax()
        if not bool(scores[best] > scores[0] + self.margin):
            return state
        refined = self._refined(tried[best][None], mean, observation)
        both = torch.cat((tried[best][None], refined))
        after = self.likelihood.log_score(self.scorer(both, evidence), 0.2)
        return both[after.argmax()][None]

    def _velocity(self, track: TrackState, mean: Tensor) -> Tensor:
        moved = sir.difference(mean, track.mean)[0]
        cfg = self.settings
        keep = cfg.velocity_smoothing
        return keep * track.velocity + (1 - keep) * cfg.velocity * moved

    def _give_up(self) -> bool:
        """Forget a track that has been bad for too long; True when the hand is lost."""
        if self.track is None:
            return True
        if self.lost.patience and self.track.bad >= self.lost.patience:
            self.track = None
            return True
        return False

    def _estimate(
        self,
        particles: Tensor,
        weights: Tensor,
        mean: Tensor,
        state: Tensor,
        score: float,
        name: str,
        lost: bool,
        index: int,
        timestamp_s: float,
        began: float,
    ) -> Estimate:
        tangents = sir.difference(particles, mean)
        tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
        joints = forward_kinematics(state, self.shape).joints_m

        def host(tensor: Tensor) -> np.ndarray:
            return tensor.detach().cpu().numpy().astype(np.float32)

        self._last = Estimate(
            index=index,
            timestamp_s=timestamp_s,
            state_name=name,
            lost=lost,
            joints_m=host(joints[0]),
            state=host(state[0]),
            latent=host(mean[0, 6:]),
            score=score,
            covariance=host(sir.covariance(tangents, weights)),
            effective_sample_size=float(sir.effective_sample_size(weights)),
            compute_s=time.perf_counter() - began,
        )
        return self._last

    def _missing(self, index: int, timestamp_s: float, began: float) -> Estimate:
        """Nothing in the frame can be a hand: the last estimate stands, and is lost."""
        facts = {"index": index, "timestamp_s": timestamp_s, "state_name": "lost", "lost": True}
        d = self.space.dims
        last = self._last or Estimate(
            **facts,
            joints_m=np.full((21, 3), np.nan, np.float32),
            state=np.full(27, np.nan, np.float32),
            latent=np.full(d, np.nan, np.float32),
            score=0.0,
            covariance=np.full((6 + d, 6 + d), np.nan, np.float32),
            effective_sample_size=math.nan,
            compute_s=0.0,
        )
        return replace(last, **facts, score=0.0, compute_s=time.perf_counter() - began)

    def range_image(self, estimate: Estimate, k: np.ndarray, height: int, width: int) -> np.ndarray:
        """The estimate's range image, (H, W) float32 metres, 0 = no surface or no estimate."""
        if not np.isfinite(estimate.state).all():
            return np.zeros((height, width), np.float32)
        state = torch.from_numpy(estimate.state)[None]
        shape = self.shape.to("cpu")
        both = hand_surface(shape).pose(forward_kinematics(state, shape))
        hand = Ellipsoids(both.centres_m[:, :-1], both.axes_m[:, :-1])
        k_t = torch.from_numpy(np.asarray(k, np.float32))
        return render_range_images(hand, k_t, height, width)[0].numpy()
