"""Copies between the host and a device are few."""

from __future__ import annotations

import pytest
import torch
from helpers.accelerator import DEVICE, pretended_device

from toftrack.compute.transfer import on_device, on_host, table

CPU = torch.device("cpu")


def test_on_the_cpu_nothing_is_copied() -> None:
    first, second = torch.rand(2, 3), torch.rand(4).double()
    assert on_host(first, second) == (first, second)
    assert on_device(first, CPU) is first


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_what_is_wanted_together_comes_in_one_copy() -> None:
    given = torch.rand(2, 3), torch.rand(()).double(), torch.rand(0, 4), torch.rand(5, 2).T
    with pretended_device() as counts:
        there = [on_device(tensor, DEVICE) for tensor in given]
        assert counts.waits.total() == 0 and counts.uploads.total() == 4
        back = on_host(*there)
        assert counts.waits.total() == 1
    for found, expected in zip(back, given, strict=True):
        assert found.dtype == expected.dtype and torch.equal(found, expected)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_table_is_copied_once_and_needs_no_autograd_mode() -> None:
    with pretended_device() as counts:
        for _ in range(3):
            assert table((1.0, 2.0), torch.float32, DEVICE).device == DEVICE
        assert counts.uploads.total() == 1 and counts.waits.total() == 0
    with torch.inference_mode():
        made = table((3.0, 4.0), torch.float64, CPU)
    assert not made.is_inference() and made.tolist() == [3.0, 4.0]
