"""Motions in one kernel each do what the reference does."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import roma
import torch

from toftrack.compute import rigid


def compared(device: str) -> None:
    """Raises AssertionError where motions on a device are not the reference's."""
    from toftrack.compute import rigid_triton

    generator = torch.Generator().manual_seed(0)

    def rows(n: int, turn: float) -> torch.Tensor:
        drawn = torch.randn(n, 9, generator=generator)
        drawn[:, 3:6] *= turn
        return drawn

    def check(found: torch.Tensor, expected: torch.Tensor) -> None:
        found = found.cpu()
        # A turn by half a circle has two rotation vectors.
        rotations = (roma.rotvec_to_rotmat(each[:, 3:6].double()) for each in (found, expected))
        torch.testing.assert_close(*rotations, atol=5e-6, rtol=0)
        assert found[:, 3:6].norm(dim=1).max() <= torch.pi + 1e-5
        for part in (slice(0, 3), slice(6, None)):
            torch.testing.assert_close(found[:, part], expected[:, part], atol=5e-6, rtol=1e-5)

    for turn in (0.0, 1e-7, 1e-3, 0.3, 2.0):
        for many in ((70, 70), (1, 70), (70, 1)) if turn == 0.3 else ((70, 70),):
            reference, tangent = (rows(n, turn) for n in many)
            there = reference.to(device), tangent.to(device)
            check(rigid_triton.compose(*there), rigid.compose(reference, tangent))
            found = rigid_triton.difference(there[0], there[1][:1])
            check(found, rigid.difference(reference, tangent[:1]))


def test_triton_moves_particles_as_torch_does_as_far_as_its_interpreter_goes() -> None:
    pytest.importorskip("triton", reason="triton is not installed")
    code = "from compute.test_rigid_triton import compared; compared('cpu')"
    env = {**os.environ, "TRITON_INTERPRET": "1"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, cwd="tests"
    )
    assert run.returncode == 0, run.stderr


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_moves_particles_as_torch_does() -> None:
    compared("cuda")
