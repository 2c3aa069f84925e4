"""The tracker: a frame in, an estimate out, particles in between (paper, fig. 1)."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from toftrack import filter as sir
from toftrack.compute.threads import small_operations
from toftrack.depth_image import checked_image
from toftrack.estimate import Estimate, lost_estimate, no_estimate
from toftrack.filter import FilterSettings
from toftrack.gestures import Gestures, GestureState, tell_gesture
from toftrack.hand.shape import HandShape
from toftrack.hand_fit import HandFit, first_belief, retried, update
from toftrack.pose_space.base import PoseSpace, clamp_to_joint_limits
from toftrack.pose_space.density import latent_density
from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.proposals import swap_fingers
from toftrack.refinement.seen_points import seen_points
from toftrack.refinement.steadying import steadied
from toftrack.render.likelihood import FMeasure
from toftrack.render.scoring import Evidence, Scorer
from toftrack.render.segmentation import Expected, NearestSurface, Observation
from toftrack.start import Lately, Start
from toftrack.track_state import Insight, LostSettings, TrackState, expected_depths
from toftrack.tracking.backend import choose_backend

_MODEL_ERROR = sir.Spread(0.002, 0.002, 0.015, 0.015)
"""What the particles do not know: the hand model's own error. Added to their covariance, it makes
the 90 % region of a joint hold the truth in about 93 % of the frames of rendered recordings."""


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
        refinement: Refinement | None,
        start: Start,
        lost: LostSettings,
        fit: HandFit | None = None,
        gestures: Gestures | None = None,
        renderer: str = "auto",
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        self.device = torch.device(device)
        self.space = space.to(self.device)
        self.segmentation = segmentation
        self.likelihood = likelihood
        self.settings = settings
        self.refinement = refinement
        self.start = start
        self.lost = lost
        self.fit = fit
        self.gestures = gestures
        self._gesture: GestureState | None = None
        self._density = latent_density(self.space) if settings.density else None
        self._backend = choose_backend(renderer, self.device)
        self._first_shape = shape.to(self.device)
        self._size = first_belief(fit) if fit else None
        self._refused = 0  # starts not believed
        self._set_shape(self._first_shape)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.track: TrackState | None = None
        self._seen: tuple[Tensor, float] | None = None  # the last hand believed, and when
        self.insight: Insight | None = None
        self._model_variance = _MODEL_ERROR.sigmas(self.space.lower, self.space.upper).square()
        self._poses = self.space.decode(self.space.training_latents)
        self._last: Estimate | None = None
        self._next_index = 0

    def _set_shape(self, shape: HandShape) -> None:
        self.shape = shape
        self.scorer: Scorer = self._backend.make_scorer(shape)
        self._refiner = self._backend.make_refiner(shape)

    def restart(self, side: str | None = None) -> None:
        """Forget the hand, also its size, and look for one anew; of another side if one is given.

        Raises ToftrackError for an unknown side.
        """
        if side is not None:
            self._first_shape = self._first_shape.of_side(side)
        self.track = self._seen = None
        self._size, self._refused = first_belief(self.fit) if self.fit else None, 0
        self._set_shape(self._first_shape)

    @small_operations()
    def step(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        index: int | None = None,
        timestamp_s: float | None = None,
    ) -> Estimate:
        """One frame: segment, predict, resample - diffuse - observe in annealed passes, refine.

        depth_m: (H, W) rectified Z in metres, 0 = no reading; H and W may change.
        k: (3, 3) intrinsics in pixels.
        index: number of the frame; None counts on from the last.
        timestamp_s: None is now, seconds on a clock that never goes back.

        Raises ToftrackError when the image or k has the wrong shape, type or unit.
        """
        began = time.perf_counter()
        depth_m, k = checked_image(depth_m, k)
        index = self._next_index if index is None else index
        timestamp_s = time.monotonic() if timestamp_s is None else timestamp_s
        self._next_index = index + 1
        expected = self._expected()
        observation = self.segmentation(depth_m, k, expected)
        if observation.empty:
            self.track = self.insight = None
            return self._missing(index, timestamp_s, began)
        observation = observation.to(self.device)
        evidence = self.likelihood.evidence(observation)

        track = self.track
        if track is None or track.age < self.lost.probation:
            track = self._started(track, observation, evidence, timestamp_s)
        particles, weights = self._filter(track, evidence)
        self.insight = Insight(observation, particles, weights)
        mean = sir.mean_particle(particles, weights)
        filtered = self.decode(mean, track.offset)
        state = self._refine(filtered, track.state, observation, evidence)
        if track.state is not None and self.refinement is not None:
            state, trend = steadied(
                state,
                track.state,
                track.trend,
                self.refinement.steadying,
                self._backend.motions,
            )
            track = replace(track, trend=trend)
        score = float(self.likelihood.score(self.scorer(state, evidence)))

        estimate = self._estimate(particles, weights, mean, state, score, index, timestamp_s)
        self.track, name, lost = self._judge(track, particles, weights, mean, state, score)
        self._fit_size(state, evidence, lost)
        if self.track is not None and not lost:
            if self.track.age > self.lost.probation:
                self._seen = self.track.mean, timestamp_s
        if self.track is not None and bool(observation.occluder.any()):
            self.track = replace(self.track, expected=expected)
        estimate = replace(estimate, state_name=name, lost=lost)
        self._gesture, estimate = tell_gesture(self.gestures, self._gesture, estimate, self.space)
        self._last = replace(estimate, compute_s=time.perf_counter() - began)
        return self._last

    def _filter(self, track: TrackState, evidence: Evidence) -> tuple[Tensor, Tensor]:
        """Particles and weights after the frame's annealed passes."""
        cfg, lower, upper = self.settings, self.space.lower, self.space.upper
        particles, weights = sir.compose(track.particles, track.velocity[None]), track.weights
        # A hand that was nearly lost is looked for farther away.
        width = 1.0 + track.bad
        sigmas = width * sir.widened(
            cfg.spread.sigmas(lower, upper), track.velocity, cfg.rest, cfg.speed_gain
        )
        for number in range(cfg.passes):
            chosen = sir.RESAMPLERS[cfg.resampling](weights, cfg.particles, self.generator)
            particles = sir.diffuse(
                particles[chosen],
                sigmas * cfg.shrink**number,
                lower,
                upper,
                cfg.bounds,
                self.generator,
            )
            exponent = cfg.exponent * cfg.exponent_growth**number
            scores = self._log_scores(particles, evidence=evidence, offset=track.offset)
            log_weights = exponent * scores
            if self._density is not None:
                nearness = self._density.log_density(particles[:, 6:])
                log_weights = log_weights + cfg.density * nearness
            weights = sir.normalise(log_weights)
        return particles, weights

    def decode(self, particles: Tensor, offset: Tensor | float = 0.0) -> Tensor:
        """(N, 6 + d) particles to (N, 27) hand states."""
        angles = clamp_to_joint_limits(self.space.decode(particles[:, 6:]) + offset)
        return torch.cat((particles[:, :6], angles), 1)

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

    def _started(
        self,
        track: TrackState | None,
        observation: Observation,
        evidence: Evidence,
        timestamp_s: float,
    ) -> TrackState:
        """A new track; or the given young one, if the search finds nothing better than it."""
        n = self.settings.particles
        lately = None
        if self._seen is not None:
            lately = Lately(self._seen[0], max(0.0, timestamp_s - self._seen[1]))
        prior = self.start.prior(observation, lately)

        def log_scores(particles: Tensor, coverage: float) -> Tensor:
            return self._log_scores(particles, coverage, evidence=evidence) + prior(particles)

        improve = partial(self._improved, observation=observation)
        particles = self.start(
            observation, self.space, log_scores, improve, lately, n, self.generator
        )
        if track is not None:
            now = sir.compose(track.particles, track.velocity[None])
            # The search has seen this frame and the track has not, so a little better is no better.
            gain = log_scores(particles, 1.0).max() - log_scores(now, 1.0).max()
            if gain < self.lost.rival_gain:
                return track
        weights = torch.full((n,), 1.0 / n, dtype=torch.float64, device=self.device)
        still = torch.zeros(particles.shape[1], device=self.device)
        offset = torch.zeros(21, device=self.device)
        return TrackState(particles, weights, particles[:1], still, offset)

    def _expected(self) -> Expected | None:
        """Depths of the tracked hand, one movement ahead."""
        if self.track is None:
            return None
        state = self.decode(sir.compose(self.track.mean, self.track.velocity[None]))
        return expected_depths(self.track, self._refiner.joints(state)[0])

    def _improved(self, particles: Tensor, *, observation: Observation) -> Tensor:
        """Hypotheses brought onto the seen points, each by itself, and back into the pose space."""
        if self.refinement is None:
            return particles
        states = self.decode(particles)
        seen = seen_points(observation)
        states = self._refiner(states, states[:, 6:], seen, self.refinement)
        latent = self.space.encode(states[:, 6:])
        latent = sir.bound(latent, self.space.lower, self.space.upper, "truncate")
        return torch.cat((states[:, :6], latent), 1)

    def _refine(
        self,
        state: Tensor,
        before: Tensor | None,
        observation: Observation,
        evidence: Evidence,
    ) -> Tensor:
        """The filter's hand brought onto the seen points; `before` is the last one; (1, 27)."""
        cfg = self.refinement
        if cfg is None:
            return state
        seen = seen_points(observation)
        middle = self._refiner.joints(state).mean(1)
        if not bool(seen.around(middle, cfg.points)[1].any()):
            return state

        def log_scores(states: Tensor) -> Tensor:
            return self.likelihood.log_score(self.scorer(states, evidence))

        def refined(start: Tensor) -> Tensor:
            return self._refiner(start, start[:, 6:], seen, cfg)

        found = refined(state)
        if before is not None:
            # The pose of the last frame stands until another one is clearly better: what the image
            # does not decide, such as a hidden finger, must not flicker.
            kept = refined(torch.cat((state[:, :6], before[:, 6:]), 1))
            scores = log_scores(torch.cat((kept, found)))
            found = kept if scores[0] + cfg.keep_gain >= scores[1] else found
        tried = swap_fingers(found, self._poses, cfg.swaps, self.generator)
        scores = log_scores(tried)
        best = int(scores.argmax())
        if scores[best] <= scores[0] + cfg.swap_gain:
            return found
        swapped = tried[best][None]
        both = torch.cat((swapped, refined(swapped)))
        return both[log_scores(both).argmax()][None]

    def _judge(
        self,
        track: TrackState,
        particles: Tensor,
        weights: Tensor,
        mean: Tensor,
        state: Tensor,
        score: float,
    ) -> tuple[TrackState | None, str, bool]:
        """The track to go on with, the state's name, and whether the hand counts as lost."""
        cfg, lower, upper = self.lost, self.space.lower, self.space.upper
        bad = track.bad + 1 if score < cfg.score else 0
        if track.age == 0 and score < cfg.start_score:
            return None, "initialising", True
        if cfg.patience and bad >= cfg.patience:
            return None, "lost", True
        offset, outside = track.offset, 0
        if self.refinement is not None:
            # The particles follow the refined estimate, and what the space cannot say of its pose
            # is remembered beside them.
            latent = sir.bound(self.space.encode(state[:, 6:]), lower, upper, "truncate")
            refined = torch.cat((state[:, :6], latent), 1)
            particles = sir.compose(particles, sir.difference(refined, mean))
            particles[:, 6:] = sir.bound(particles[:, 6:], lower, upper, "truncate")
            mean = refined
            offset = state[0, 6:] - self.space.decode(latent)[0]
            if float(offset.square().mean().sqrt()) > cfg.outside_rad:
                outside = track.outside + 1
            offset = self.refinement.carry * offset
        velocity = torch.zeros_like(track.velocity)
        if track.age > 0:
            keep = self.settings.velocity_smoothing
            moved = sir.difference(mean, track.mean)[0]
            velocity = keep * track.velocity + (1 - keep) * self.settings.velocity * moved
        new = TrackState(
            particles,
            weights,
            mean,
            velocity,
            offset,
            state,
            track.trend,
            track.age + 1,
            bad,
            outside,
        )
        if bad >= 2 or (bad and not cfg.patience):
            return new, "recovering", True
        return new, "initialising" if track.age == 0 else "tracking", outside >= 2

    def _fit_size(self, state: Tensor, evidence: Evidence, lost: bool) -> None:
        """Let a believed estimate say how large the hand is; try another size if none is."""
        if self.fit is None or self._size is None or self._size.frames >= self.fit.frames:
            return
        before = self._size.index
        if not lost:
            self._size = update(
                self._size, self.fit, state, evidence, self.scorer, self.likelihood, self.generator
            )
        elif self.track is None and self._size.frames == 0:
            self._refused += 1
            self._size = retried(self.fit, self._refused)
        if self._size.index != before:
            self._set_shape(self._first_shape.scaled(self._size.ratio(self.fit)))

    def _estimate(
        self,
        particles: Tensor,
        weights: Tensor,
        mean: Tensor,
        state: Tensor,
        score: float,
        index: int,
        timestamp_s: float,
    ) -> Estimate:
        tangents = sir.difference(particles, mean)
        tangents[:, :3] = particles[:, :3] - mean[:, :3]  # the result speaks of the wrist
        latent = self.space.encode(state[:, 6:])

        def host(tensor: Tensor) -> np.ndarray:
            return tensor.detach().cpu().numpy().astype(np.float32)

        return Estimate(
            index=index,
            timestamp_s=timestamp_s,
            state_name="",
            lost=False,
            joints_m=host(self._refiner.joints(state)[0]),
            state=host(state[0]),
            latent=host(latent[0]),
            score=score,
            covariance=host(sir.covariance(tangents, weights) + torch.diag(self._model_variance)),
            effective_sample_size=float(sir.effective_sample_size(weights)),
            compute_s=math.nan,
        )

    def _missing(self, index: int, timestamp_s: float, began: float) -> Estimate:
        """Nothing in the frame can be a hand: the last estimate stands, and is lost."""
        seconds = time.perf_counter() - began
        if self._last is None:
            return no_estimate(index, timestamp_s, "lost", self.space.dims, seconds)
        missing = lost_estimate(self._last, index, timestamp_s, seconds)
        self._gesture, missing = tell_gesture(self.gestures, None, missing, self.space)
        return missing
