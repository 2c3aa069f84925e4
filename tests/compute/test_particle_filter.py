"""The particle filter's pure functions."""

import math

import pytest
import torch

from toftrack.compute import particle_filter as sir
from toftrack.compute.rigid import MOTIONS, bound, pick

LOWER, UPPER = torch.tensor([-1.0, -2.0, 0.0, -0.5]), torch.tensor([1.0, 2.0, 3.0, 0.5])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def particles(n: int, seed: int = 0) -> torch.Tensor:
    x = torch.randn(n, 10, generator=generator(seed))
    return torch.cat((x[:, :6], LOWER + (UPPER - LOWER) * x[:, 6:].sigmoid()), 1)


@pytest.mark.parametrize("scheme", sorted(sir.RESAMPLERS))
@pytest.mark.parametrize("n", [1, 10, 300])
def test_resampling_is_unbiased(scheme: str, n: int) -> None:
    weights = torch.rand(50, generator=generator(1)).double() ** 3
    weights /= weights.sum()
    g, draws = generator(2), 400
    counts = torch.zeros(50, dtype=torch.float64)
    for _ in range(draws):
        counts += torch.bincount(pick(weights, sir.draw_positions(scheme, n, g)), minlength=50)
    # Each draw's variance is at most the multinomial one. 5 of its standard deviations, and three
    # hits more of what is hardly ever drawn, hold all 50 means with a probability above 0.9999.
    sigma = (n * weights * (1 - weights) / draws).sqrt()
    assert ((counts / draws - n * weights).abs() <= 5 * sigma + 3 / draws).all()


def test_systematic_resampling_gives_each_particle_its_share_rounded() -> None:
    weights = torch.rand(40, generator=generator(3)).double()
    weights /= weights.sum()
    for seed in range(20):
        indices = pick(weights, sir.draw_positions("systematic", 100, generator(seed)))
        counts = torch.bincount(indices, minlength=40)
        assert ((counts - 100 * weights).abs() < 1).all()


@pytest.mark.parametrize("scheme", sorted(sir.RESAMPLERS))
def test_resampling_survives_degenerate_weights(scheme: str) -> None:
    def resample(weights: torch.Tensor, n: int) -> torch.Tensor:
        return pick(weights, sir.draw_positions(scheme, n, generator()))

    one = torch.zeros(8, dtype=torch.float64)
    one[3] = 1.0
    assert (resample(one, 20) == 3).all()
    last = torch.zeros(8, dtype=torch.float64)
    last[0] = 1.0  # nothing behind the first has weight: no rounding may pick it
    assert (resample(last, 1000) == 0).all()
    # Weights whose sum falls short of 1, as a float32 running sum does: no index past the end.
    short = torch.full((1000,), 0.9999e-3)
    indices = resample(short, 1000)
    assert int(indices.max()) <= 999
    assert len(indices.unique()) > 600


@pytest.mark.parametrize(
    ("log_weights", "expected"),
    [
        ([-1000.0, -1000.0 + math.log(3.0)], [0.25, 0.75]),
        ([-math.inf] * 4, [0.25] * 4),
        ([math.nan] * 4, [0.25] * 4),
        ([0.0, math.nan, -math.inf, 0.0], [0.5, 0.0, 0.0, 0.5]),
        ([-math.inf, -5.0, -math.inf, -math.inf], [0.0, 1.0, 0.0, 0.0]),
    ],
)
def test_weights_sum_to_one_whatever_they_were(log_weights, expected) -> None:
    weights = sir.normalise(torch.tensor(log_weights, dtype=torch.float64))
    torch.testing.assert_close(weights, torch.tensor(expected, dtype=torch.float64))


def test_effective_sample_size_runs_from_one_to_n() -> None:
    assert float(sir.effective_sample_size(torch.full((7,), 1 / 7))) == pytest.approx(7)
    assert float(sir.effective_sample_size(torch.tensor([0.0, 1.0, 0.0]))) == pytest.approx(1)


def test_truncation_piles_particles_up_at_a_bound_and_reflection_does_not() -> None:
    latent = UPPER.expand(10_000, 4) + 0.1 * torch.randn(10_000, 4, generator=generator())
    truncated = bound(latent, LOWER, UPPER, "truncate")
    reflected = bound(latent, LOWER, UPPER, "reflect")
    assert 0.4 < (truncated == UPPER).float().mean() < 0.6
    assert (reflected == UPPER).float().mean() < 0.01


def test_mean_and_covariance_of_particles_are_the_weighted_ones() -> None:
    x = particles(200)
    x[:, 3:6] *= 0.1
    weights = torch.rand(200, generator=generator(1)).double()
    weights /= weights.sum()
    mean = MOTIONS.mean(x, weights)
    torch.testing.assert_close(mean[0, 6:], (weights.float() @ x)[6:])
    tangents = MOTIONS.difference(x, mean)
    expected = torch.cov(tangents.double().T, aweights=weights, correction=0)
    torch.testing.assert_close(
        sir.covariance(tangents, weights).double(), expected, atol=1e-5, rtol=1e-4
    )
