"""The optimiser: orthogonal steps for matrices, AdamW's for all else."""

import pytest
import torch
from torch import nn

from toftrack.training import muon
from toftrack.training.muon import Muon, orthogonal


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("size", [(24, 24), (8, 200), (200, 8)])
def test_a_step_has_the_gradient_s_directions_and_even_sizes(
    size: tuple[int, int], half: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In half precision, and in single, as where the former is slow."""
    monkeypatch.setattr(muon, "half_precision", lambda device: half)
    generator = torch.Generator().manual_seed(0)
    u, _, v = torch.linalg.svd(torch.randn(size, generator=generator), full_matrices=False)
    sizes = torch.logspace(0, -1.5, len(v))
    stepped = orthogonal(u @ torch.diag(sizes) @ v)
    assert stepped.shape == size
    found = torch.linalg.svdvals(stepped)
    assert found.max() < 1.35 and found.min() > 0.4 and sizes.max() / sizes.min() > 30
    # The same singular vectors: what lies between them is nearly diagonal.
    inner = u.mT @ stepped @ v.mT
    assert (inner - torch.diag(inner.diagonal())).abs().max() < 0.05


def network_of(seed: int) -> nn.Sequential:
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Linear(6, 16), nn.ReLU(), nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 3)
    )


def test_the_ends_and_vectors_are_stepped_as_by_adamw() -> None:
    one, two = network_of(0), network_of(0)
    ends = [one[0].weight, one[4].weight]
    mine = Muon(one, ends, 0.01, 0.1)
    torchs = torch.optim.AdamW(two.parameters(), 0.01, weight_decay=0.1)
    generator = torch.Generator().manual_seed(1)
    for _ in range(4):
        inner = one[2].weight.detach().clone()
        for a, b in zip(one.parameters(), two.parameters(), strict=True):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        mine.step()
        torchs.step()
        # The inner matrix moves as far as Adam would move it.
        step = (one[2].weight - (1 - 0.01 * 0.1) * inner).square().mean().sqrt()
        assert 0.1 * 0.01 < step < 0.4 * 0.01
    others = [name for name, _ in one.named_parameters() if name != "2.weight"]
    for name in others:
        a, b = one.get_parameter(name), two.get_parameter(name)
        assert torch.allclose(a, b, atol=1e-6), name
    assert not torch.allclose(one[2].weight, two[2].weight, atol=1e-3)
