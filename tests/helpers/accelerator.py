"""A pretended CUDA device: tensors that say they are on it and are computed on the CPU, and what a
real one would be asked for: launches, and waits of the host for the device.

Every operation goes through `__torch_dispatch__`, below what Python, roma or `torch.nn` call it.
What is on different devices cannot be mixed, as on a real one.

What it cannot see: operations of several kernels count as one launch; what a library (cuSOLVER,
cuBLAS, MAGMA, cuDNN) does within an operation, but for the checks of `torch.linalg` that are known
to wait; the allocator. Nothing here takes the time that it would take on a device.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch
from helpers.indexing import item, set_item
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from toftrack.compute import transfer
from toftrack.hand import overlap
from toftrack.pose_space import base

DEVICE = torch.device("cuda", 0)

_VIEWS = frozenset(
    "alias as_strided detach diagonal expand lift_fresh permute select slice split"
    " split_with_sizes squeeze t transpose unbind unfold unsqueeze view _unsafe_view"
    " _reshape_alias empty empty_strided empty_like new_empty new_empty_strided"
    " is_same_size result_type".split()
)
"""What runs nothing on a device."""
_WAITING = frozenset(
    "_local_scalar_dense nonzero masked_select _unique2 unique_dim equal is_nonzero"
    " _linalg_eigh linalg_eig _linalg_check_errors bincount".split()
)
"""What the host waits for: its result's size, or a number of it."""


class Pretended(Tensor):
    """A tensor on the pretended device.

    held: its values.
    """

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Pretended:
        with torch.inference_mode(False):  # a view of what was made outside is none made within
            made: Pretended = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
                cls,
                held.shape,
                strides=held.stride(),
                storage_offset=held.storage_offset(),
                dtype=held.dtype,
                device=DEVICE,
            )
        made.held = held
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, Counts())

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"Pretended({self.held!r})"


@dataclass
class Counts:
    """What was asked of the device, by part.

    launches: operations that run something there.  waits: of the host for the device.
    uploads: copies there that the host does not wait for.
    what: of launches and waits, by name of the operation.
    """

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    uploads: Counter[str] = field(default_factory=Counter)
    what: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    part: str = "rest"

    def launched(self, name: str) -> None:
        """One operation."""
        self.launches[self.part] += 1
        self.what[self.part, "launch", name] += 1

    def waited(self, name: str) -> None:
        """One wait."""
        self.waits[self.part] += 1
        self.what[self.part, "wait", name] += 1

    def uploaded(self) -> None:
        """One copy to the device."""
        self.uploads[self.part] += 1

    @contextmanager
    def within(self, part: str) -> Iterator[None]:
        """What is asked for within counts for a part."""
        before, self.part = self.part, part
        try:
            yield
        finally:
            self.part = before


def _mapped(function: Callable[[Any], Any], values: Any) -> Any:
    """A function of each of what an operation is given, or gives."""
    if isinstance(values, dict):
        return {name: _mapped(function, value) for name, value in values.items()}
    if type(values) in (list, tuple):
        return type(values)(_mapped(function, value) for value in values)
    return function(values)


def _tensors(values: Any) -> list[Tensor]:
    found: list[Tensor] = []
    _mapped(lambda value: found.append(value) if isinstance(value, Tensor) else None, values)
    return found


def _is_there(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def _named(x: Any) -> Any:
    """The device itself, where only its kind is given: torch would ask the driver which."""
    return DEVICE if isinstance(x, (str, torch.device)) and str(x) == DEVICE.type else x


def _computed(func: Any, args: tuple, kwargs: dict, counts: Counts) -> Any:
    """An operation on the values that are held, its results on the device where they would be."""
    given = _tensors((args, kwargs))
    there = [x for x in given if isinstance(x, Pretended)]
    name = func.overloadpacket.__name__
    if name in ("_to_copy", "copy_"):
        return _copied(func, args, kwargs, counts)
    goes_there = _is_there(kwargs.get("device")) if "device" in kwargs else bool(there)
    if not there and not goes_there:
        return func(*args, **kwargs)
    if func._schema.name.split("::")[0] == "aten" and _is_composite(func):
        # In inference mode these come undivided.
        with _Counting(counts):
            divided = func.decompose(*args, **kwargs)
        if divided is not NotImplemented:
            return divided
    _check_devices(name, args, given)
    _count(func, name, args, kwargs, counts)
    result = _on_values(func, args, kwargs)
    known = {id(x.held): x for x in there}

    def put_there(x: Any) -> Any:
        if not isinstance(x, Tensor):
            return x
        return known[id(x)] if id(x) in known else Pretended(x)

    return _mapped(put_there, result)


def _is_composite(func: Any) -> bool:
    """Whether an operation is divided into others; not, where Python would do it for tracers."""
    key = torch._C.DispatchKey.CompositeImplicitAutograd
    return key not in func.py_kernels and bool(
        torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), key)
    )


def _check_devices(name: str, args: tuple, given: list[Tensor]) -> None:
    """Raises RuntimeError as a real device would for tensors of different devices."""
    allowed: list[Tensor] = []
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        allowed = [x for x in args[1] if x is not None]
    here = [x for x in given if not isinstance(x, Pretended) and x.dim() > 0]
    if any(all(x is not other for other in allowed) for x in here):
        raise RuntimeError(f"{name}: tensors on the CPU and on the device")


def _count(func: Any, name: str, args: tuple, kwargs: dict, counts: Counts) -> None:
    if name in _VIEWS or (func.is_view and not name.endswith("_copy")):
        return
    counts.launched(name)
    if name in _WAITING or kwargs.get("check_errors"):
        counts.waited(name)
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        indices = [x for x in args[1] if x is not None]
        if any(not isinstance(x, Pretended) for x in indices):
            counts.waited(f"{name} by what is on the CPU")
        # A mask is filled with one number without looking at it.
        filled = name != "index" and args[2].dim() == 0 and not isinstance(args[2], Pretended)
        if any(x.dtype in (torch.bool, torch.uint8) for x in indices) and not filled:
            counts.waited(f"{name} by a mask")
    if name == "repeat_interleave" and isinstance(args[0], Tensor) and len(args) == 1:
        counts.waited(name)


def _copied(func: Any, args: tuple, kwargs: dict, counts: Counts) -> Any:
    """Copies between the devices, or on one of them."""
    inplace = func.overloadpacket.__name__ == "copy_"
    source = args[1] if inplace else args[0]
    from_there = isinstance(source, Pretended)
    if inplace:
        to_there, patient = isinstance(args[0], Pretended), True
    else:
        device = kwargs.get("device")
        to_there = from_there if device is None else _is_there(device)
        # Without pinned memory the host would wait after all.
        patient = not (kwargs.get("non_blocking") and hasattr(source, "pinned"))
    if from_there and to_there:
        counts.launched("copy")
    elif from_there:
        counts.waited("copy to the host")
    elif to_there and patient:
        counts.waited("copy to the device")
    elif to_there:
        counts.uploaded()
    result = _on_values(func, args, kwargs)
    if inplace:
        return args[0]
    return Pretended(result) if to_there else result


def _on_values(func: Any, args: tuple, kwargs: dict) -> Any:
    """An operation on the values that are held, which are on the CPU."""
    plain = _mapped(held, kwargs)
    if "device" in kwargs:
        plain["device"] = torch.device("cpu")
    return func(*_mapped(held, args), **plain)


class _Counting(TorchDispatchMode):
    """What goes through the dispatcher."""

    def __init__(self, counts: Counts) -> None:
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, self.counts)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # it would be loaded, which takes seconds


_NUMBERS = {
    Tensor.item: lambda number: number,
    Tensor.__float__: float,
    Tensor.__int__: int,
    Tensor.__index__: int,
    Tensor.__bool__: bool,
}
"""What reads one number."""


_ALIKE = {
    Tensor.copy_: torch.ops.aten.copy_,
    Tensor.__invert__: torch.ops.aten.bitwise_not,
    Tensor.contiguous: torch.ops.aten.contiguous,
    Tensor.nonzero: torch.ops.aten.nonzero,
}
"""What torch does not do before it has asked the driver."""


class _Entrances(TorchFunctionMode):
    """What does not go through the dispatcher as one would think."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        args, kwargs = _mapped(_named, args), _mapped(_named, kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and _is_there(kwargs.get("device")):
            return func(*args, **{**kwargs, "device": "cpu"}).to(DEVICE)
        if args and isinstance(args[0], Pretended):
            if func is Tensor.new_tensor:
                dtype = kwargs.get("dtype") or args[0].dtype
                device = kwargs.get("device", DEVICE)
                return torch.tensor(args[1], dtype=dtype).to(device)
            if func is Tensor.tolist:
                return args[0].cpu().tolist()
            if func in _NUMBERS:
                number = torch.ops.aten._local_scalar_dense(args[0].reshape(()))
                return _NUMBERS[func](number)
            if func in _ALIKE:
                return _ALIKE[func](*args, **kwargs)
            if func is Tensor.__getitem__:
                return item(args[0], args[1])
            if func is Tensor.__setitem__:
                return set_item(*args)
        if func is Tensor.pin_memory:
            pinned = args[0].clone()
            pinned.pinned = True
            return pinned
        return func(*args, **kwargs)


class _Generator(torch.Generator):
    """One that says it is on the device, and draws the CPU's numbers."""

    device = DEVICE


def _generator(
    device: Any = "cpu", make: Callable[[], torch.Generator] = torch.Generator
) -> torch.Generator:
    return _Generator() if _is_there(device) else make()


_KEPT = (transfer.table, base._limits, overlap._tables)
"""What keeps tensors of a device."""


@contextmanager
def pretended_device() -> Iterator[Counts]:
    """Within, torch has a CUDA device that is none, and what is asked of it is counted.

    Random numbers are the CPU's.
    """
    counts = Counts()
    with (
        patch("torch.cuda._lazy_init", lambda: None),
        patch("torch.cuda.is_available", lambda: True),
        patch("torch.cuda.init", lambda: None),
        # What torch does is seen in the thread that asks for it.
        patch("toftrack.compute.threads.threads", lambda: 1),
        patch("torch.Generator", _generator),
        # A module's parameters cannot become another class in place.
        patch("torch.__future__._overwrite_module_params_on_conversion", True),
        _Entrances(),
        _Counting(counts),
    ):
        yield counts
    for kept in _KEPT:
        kept.cache_clear()


def held(x: Any) -> Any:
    """The values of what may be a tensor on the device."""
    return x.held if isinstance(x, Pretended) else x
