"""A pretended CUDA device: tensors that say they are on it and are computed on the CPU, and what a
real one would be asked for: launches, and waits of the host for the device.

Every operation goes through `__torch_dispatch__`, below what Python, roma or `torch.nn` call it.
What is on different devices cannot be mixed, as on a real one.

What it cannot see: operations of several kernels count as one launch; what a library (cuSOLVER,
cuBLAS, MAGMA, cuDNN) does within an operation, but for the checks of `torch.linalg` that are known
to wait; the allocator. Nothing here takes the time that it would take on a device.
"""

from __future__ import annotations

import importlib.util
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from types import ModuleType
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from toftrack.compute import rigid, transfer
from toftrack.compute.backend import Motions
from toftrack.hand import overlap
from toftrack.hand.shape import HandShape
from toftrack.pose_space import base
from toftrack.render import scoring
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.scoring import Evidence

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
        return _computed(func, args, kwargs or {}, None)

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


def _is_there(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def _is_named(x: Any) -> bool:
    return (isinstance(x, torch.device) and x == torch.device("cuda")) or (
        isinstance(x, str) and x == "cuda"
    )


def _computed(func: Any, args: tuple, kwargs: dict, counts: Counts | None) -> Any:
    """An operation on the values that are held, its results on the device where they would be."""
    given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    there = [x for x in given if isinstance(x, Pretended)]
    name = func.overloadpacket.__name__
    if name in ("_to_copy", "copy_"):
        return _copied(func, args, kwargs, counts)
    goes_there = _is_there(kwargs.get("device")) if "device" in kwargs else bool(there)
    if not there and not goes_there:
        return func(*args, **kwargs)
    if func._schema.name.split("::")[0] == "aten" and _is_composite(func):
        # In inference mode these come undivided.
        with _Counting(counts) if counts is not None else _Plain():
            divided = func.decompose(*args, **kwargs)
        if divided is not NotImplemented:
            return divided
    _check_devices(name, args, given)
    if counts is not None:
        _count(func, name, args, kwargs, counts)
    plain_args, plain_kwargs = tree_map(
        lambda x: x.held if isinstance(x, Pretended) else x, (args, kwargs)
    )
    if "device" in kwargs:
        plain_kwargs["device"] = "cpu"
    result = func(*plain_args, **plain_kwargs)
    known = {id(x.held): x for x in there}

    def put_there(x: Any) -> Any:
        if not isinstance(x, Tensor):
            return x
        return known[id(x)] if id(x) in known else Pretended(x)

    return tree_map(put_there, result)


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


def _copied(func: Any, args: tuple, kwargs: dict, counts: Counts | None) -> Any:
    """Copies between the devices, or on one of them."""
    source = args[1] if func.overloadpacket.__name__ == "copy_" else args[0]
    inplace = func.overloadpacket.__name__ == "copy_"
    from_there = isinstance(source, Pretended)
    if inplace:
        to_there = isinstance(args[0], Pretended)
        without_wait = bool(kwargs.get("non_blocking", args[2] if len(args) > 2 else False))
    else:
        device = kwargs.get("device")
        to_there = from_there if device is None else _is_there(device)
        without_wait = bool(kwargs.get("non_blocking", False))
    if counts is not None and (from_there or to_there):
        if from_there and to_there:
            counts.launched("copy")
        elif from_there:
            counts.waited("copy to the host")
        elif without_wait:
            counts.uploaded()
        else:
            counts.waited("copy to the device")
    plain_args, plain_kwargs = tree_map(
        lambda x: x.held if isinstance(x, Pretended) else x, (args, kwargs)
    )
    if "device" in kwargs:
        plain_kwargs["device"] = torch.device("cpu")
    result = func(*plain_args, **plain_kwargs)
    if inplace:
        return args[0]
    return Pretended(result) if to_there else result


class _Plain(TorchDispatchMode):
    """Factories work on the device, nothing is counted."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, None)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # it would be loaded, which takes seconds


class _Counting(TorchDispatchMode):
    def __init__(self, counts: Counts) -> None:
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, self.counts)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False


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
        # Which of the devices is meant would be asked of the driver.
        args, kwargs = tree_map(lambda x: DEVICE if _is_named(x) else x, (args, kwargs or {}))
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
                return _item(args[0], args[1])
            if func is Tensor.__setitem__:
                return _set_item(*args)
        if func is Tensor.pin_memory:
            return args[0]
        return func(*args, **kwargs)


def _item(tensor: Tensor, index: Any) -> Tensor:
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


def _set_item(tensor: Tensor, index: Any, value: Any) -> None:
    """tensor[index] = value."""
    parts = index if isinstance(index, tuple) else (index,)
    value = value if isinstance(value, Tensor) else torch.tensor(value, dtype=tensor.dtype)
    if not any(isinstance(part, (Tensor, list)) for part in parts):
        there = _item(tensor, index)
        if value.dim() == 0 and not isinstance(value, Pretended):
            there.fill_(value.item())
        else:
            torch.ops.aten.copy_(there, value)
        return
    basic = [slice(None) if isinstance(part, (Tensor, list)) else part for part in parts]
    assert all(isinstance(part, slice) for part in basic), "no such index is assigned to here"
    picked = [torch.as_tensor(p) if isinstance(p, (Tensor, list)) else None for p in parts]
    torch.ops.aten.index_put_(_item(tensor, tuple(basic)), picked, value)


def _dimensions(part: Any) -> int:
    """How many dimensions of a tensor a part of an index is about."""
    if part is None:
        return 0
    return part.dim() if isinstance(part, Tensor) and part.dtype == torch.bool else 1


_KEPT = (transfer.table, base._limits, overlap._tables)
"""What keeps tensors of a device."""


@contextmanager
def pretended_device() -> Iterator[Counts]:
    """Within, torch has a CUDA device that is none, and what is asked of it is counted.

    Random numbers are the CPU's.
    """
    counts = Counts()
    generator = torch.Generator
    with (
        patch("torch.cuda._lazy_init", lambda: None),
        patch("torch.cuda.is_available", lambda: True),
        patch("torch.Generator", lambda device="cpu": generator()),
        # A module's parameters cannot become another class in place.
        patch("torch.__future__._overwrite_module_params_on_conversion", True),
        _Entrances(),
        _Counting(counts),
    ):
        yield counts
    for kept in _KEPT:
        kept.cache_clear()


@contextmanager
def pretended_triton(counts: Counts) -> Iterator[None]:
    """Within, `renderer=triton` launches kernels that do nothing, and the counts come from numba.

    triton itself need not be there.
    """
    before = {name: module for name, module in sys.modules.items() if name in _TRITON_MODULES}
    if importlib.util.find_spec("triton") is None:
        sys.modules["triton"] = sys.modules["triton.language"] = _no_triton()
    try:
        scorer, motions = map(importlib.import_module, _TRITON_MODULES[-2:])
        pairs = zip(motions.MOTIONS, rigid.MOTIONS, strict=True)
        moved = Motions(*(_pretended_motion(there, here) for there, here in pairs))
        with (
            patch.multiple(scorer, **_kernels(scorer, counts)),
            patch.multiple(motions, MOTIONS=moved, **_kernels(motions, counts)),
            patch.object(scorer, "TritonScorer", _pretended_scorer(scorer.TritonScorer)),
        ):
            yield
    finally:
        for name in _TRITON_MODULES:
            sys.modules.pop(name, None)
        sys.modules.update(before)
        for package, name in (("toftrack.compute", "rigid_triton"), ("toftrack.render", "triton")):
            if f"{package}.{name}" not in before:
                vars(sys.modules[package]).pop(name, None)


_TRITON_MODULES = (
    "triton",
    "triton.language",
    "toftrack.render.triton",
    "toftrack.render.triton.kernel",
    "toftrack.render.triton.scorer",
    "toftrack.compute.rigid_triton",
)


def _no_triton() -> Any:
    """What is used of the module but for running kernels."""
    module: Any = ModuleType("triton")
    module.language = module
    module.jit = lambda function: function
    module.cdiv = lambda size, block: -(-size // block)
    module.next_power_of_2 = lambda size: 1 << (size - 1).bit_length()
    return module


def _kernels(module: ModuleType, counts: Counts) -> dict[str, _Kernel]:
    return {name: _Kernel(name, counts) for name in vars(module) if name.endswith("_kernel")}


class _Kernel:
    """`kernel[grid](...)`, which runs nothing."""

    def __init__(self, name: str, counts: Counts) -> None:
        self.name, self.counts = name, counts

    def __getitem__(self, grid: tuple[int, ...]) -> _Kernel:
        assert all(isinstance(size, int) and size > 0 for size in grid)
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        given = [x for x in args if isinstance(x, Tensor)]
        assert given and all(isinstance(x, Pretended) and x.is_contiguous() for x in given)
        self.counts.launched(self.name)


def _pretended_motion(
    there: Callable[[Tensor, Tensor], Tensor], here: Callable[[Tensor, Tensor], Tensor]
) -> Callable[[Tensor, Tensor], Tensor]:
    """A motion that launches as one on the device does, with the numbers of one on the CPU."""

    def moved(first: Tensor, second: Tensor) -> Tensor:
        found = there(first, second)
        held(found).copy_(here(held(first), held(second)))
        return found

    return moved


def _pretended_scorer(kind: type) -> type:
    class PretendedScorer(kind):  # type: ignore[misc]
        """Launches as it does, with the counts of the compiled back end."""

        def __init__(self, shape: HandShape, *args: Any, **kwargs: Any) -> None:
            super().__init__(shape, *args, **kwargs)
            self._here = NumbaScorer(_here(shape))

        def __call__(self, states: Tensor, evidence: Evidence) -> scoring.Counts:
            found = super().__call__(states, evidence)
            right = self._here(held(states), _here(evidence))
            for field_, values in zip(found, right, strict=True):
                held(field_).copy_(values)
            return found

    return PretendedScorer


def _here(parts: Any) -> Any:
    """A dataclass of tensors with their values."""
    return replace(parts, **{f.name: held(getattr(parts, f.name)) for f in fields(parts)})


def held(x: Any) -> Any:
    """The values of what may be a tensor on the device."""
    return x.held if isinstance(x, Pretended) else x
