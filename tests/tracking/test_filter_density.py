"""The density of the training poses as a part of the particles' weights: filter.density."""

from __future__ import annotations

import pytest
import torch
from helpers.tracking import make_tracker, sample
from hydra.errors import InstantiationException

from toftrack.pose_space.density import latent_density
from toftrack.tracking import particle_filter as sir
from toftrack.tracking.tracker import Tracker

ALONE = ("refine=none", "hand.side=right")
"""The filter by itself."""


def nearness(tracker: Tracker) -> float:
    """Mean log density of the particles' latents, by weight, after some frames of the recording."""
    scene, total = sample(), 0.0
    for i in range(40, 46):  # the hand turns, so that the image leaves some freedom
        tracker.step(scene.depth_m[i], scene.k, i, i / 25)
        track = tracker.track
        assert track is not None
        logs = latent_density(tracker.space).log_density(track.particles[:, 6:])
        total += float((track.weights * logs).sum())
    return total / 6


def test_density_draws_the_particles_to_the_training_poses() -> None:
    drawn = make_tracker(*ALONE, "filter.density=20")
    assert nearness(drawn) > nearness(make_tracker(*ALONE)) + 0.2


def test_density_is_added_to_the_log_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[torch.Tensor] = []
    normalise = sir.normalise

    def kept(log_weights: torch.Tensor) -> torch.Tensor:
        given.append(log_weights)
        return normalise(log_weights)

    monkeypatch.setattr(sir, "normalise", kept)
    scene, weights = sample(), []
    for density in (0.0, 0.5):
        # One pass from the same start: the same particles, so that only the density differs.
        tracker = make_tracker(*ALONE, "filter.passes=1", f"filter.density={density}")
        given.clear()
        tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
        weights.append(given[-1])
        track = tracker.track
    assert track is not None
    logs = latent_density(tracker.space).log_density(track.particles[:, 6:])
    torch.testing.assert_close(weights[1] - weights[0], 0.5 * logs, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("bad", ["-1", "inf", "nan"])
def test_a_density_out_of_range_is_told(bad: str) -> None:
    with pytest.raises(InstantiationException, match=f"filter.density={bad} is not possible"):
        make_tracker(f"filter.density={bad}")
