"""A tensor's items through the dispatcher alone: what Python's brackets do asks for a driver."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def item(tensor: Tensor, index: Any) -> Tensor:
    """tensor[index]; torch's own asks for the driver."""
    aten = torch.ops.aten
    parts = list(index) if isinstance(index, tuple) else [index]
    if Ellipsis in [part for part in parts if not isinstance(part, Tensor)]:
        at = next(i for i, part in enumerate(parts) if part is Ellipsis)
        taken = sum(_dimensions(part) for part in parts if part is not Ellipsis)
        parts[at : at + 1] = [slice(None)] * (tensor.dim() - taken)
    found, dim, picked = tensor, 0, []
    for part in parts:
        if part is None:
            found = aten.unsqueeze(found, dim)
        elif isinstance(part, slice):
            if part != slice(None):
                found = aten.slice(found, dim, part.start, part.stop, part.step or 1)
        elif isinstance(part, int):
            found, dim = aten.select(found, dim, part), dim - 1
        else:
            picked += [None] * (dim - len(picked)) + [torch.as_tensor(part)]
            dim += _dimensions(part) - 1
        dim += 1
    return aten.index(found, picked) if picked else found


def set_item(tensor: Tensor, index: Any, value: Any) -> None:
    """tensor[index] = value."""
    parts = index if isinstance(index, tuple) else (index,)
    value = value if isinstance(value, Tensor) else torch.tensor(value, dtype=tensor.dtype)
    if not any(isinstance(part, (Tensor, list)) for part in parts):
        there = item(tensor, index)
        if value.dim() == 0 and value.device.type == "cpu":
            there.fill_(value.item())
        else:
            torch.ops.aten.copy_(there, value)
        return
    basic = [slice(None) if isinstance(part, (Tensor, list)) else part for part in parts]
    assert all(isinstance(part, slice) for part in basic), "no such index is assigned to here"
    picked = [torch.as_tensor(p) if isinstance(p, (Tensor, list)) else None for p in parts]
    torch.ops.aten.index_put_(item(tensor, tuple(basic)), picked, value)


def _dimensions(part: Any) -> int:
    """How many dimensions of a tensor a part of an index is about."""
    if part is None:
        return 0
    return part.dim() if isinstance(part, Tensor) and part.dtype == torch.bool else 1
