"""Copies between the host and a device keep values and types."""

import pytest
import torch

from toftrack.compute.transfer import on_device, on_host, table

CPU = torch.device("cpu")


def test_on_the_cpu_nothing_is_copied() -> None:
    first, second = torch.rand(2, 3), torch.rand(4).double()
    assert on_host(first, second) == (first, second)
    assert on_device(first, CPU) is first


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_what_comes_back_from_a_device_is_what_went_there() -> None:
    given = torch.rand(2, 3), torch.rand(()).double(), torch.rand(0, 4), torch.rand(5, 2).T
    back = on_host(*(on_device(tensor, torch.device("cuda")) for tensor in given))
    for found, expected in zip(back, given, strict=True):
        assert found.dtype == expected.dtype and torch.equal(found, expected)


def test_a_table_needs_no_autograd_mode() -> None:
    with torch.inference_mode():
        made = table((3.0, 4.0), torch.float64, CPU)
    assert not made.is_inference() and made.tolist() == [3.0, 4.0]
