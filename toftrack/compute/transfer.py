"""Between the host and the device that particles are on: few copies, and tables kept there.

The host waits for a copy from the device until all that was asked of it before is done, so what is
wanted together comes together. It does not wait for a copy to the device from pinned memory. On the
CPU there is nothing to copy.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


def on_host(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Floating tensors on the CPU, all in one copy; those that are there are given back."""
    if all(tensor.device.type == "cpu" for tensor in tensors):
        return tensors
    widest = functools.reduce(torch.promote_types, (tensor.dtype for tensor in tensors))
    packed = torch.cat([tensor.reshape(-1).to(widest) for tensor in tensors]).cpu()
    parts = packed.split([tensor.numel() for tensor in tensors])
    return tuple(
        part.reshape(tensor.shape).to(tensor.dtype)
        for part, tensor in zip(parts, tensors, strict=True)
    )


def on_device(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the CPU on a device; one that is there already is given back."""
    if device.type == tensor.device.type:
        return tensor
    return tensor.pin_memory().to(device, non_blocking=True)


@functools.cache
def table(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers that never change as a tensor, copied to a device once; not to be written to."""
    with torch.inference_mode(False):
        return on_device(torch.tensor(values, dtype=dtype), device)
