"""`renderer=triton` on the pretended device: its kernels are counted and run nothing."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from types import ModuleType
from typing import Any
from unittest.mock import patch

from helpers.accelerator import Counts, Pretended, held
from torch import Tensor

from toftrack.compute import rigid
from toftrack.compute.motions import Motions
from toftrack.compute.redraw import redraw_with
from toftrack.hand.shape import HandShape
from toftrack.render import scoring
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.scoring import Evidence


@contextmanager
def pretended_triton(counts: Counts) -> Iterator[None]:
    """Within, `renderer=triton` launches kernels that do nothing, and the counts come from numba.

    triton itself need not be there.
    """
    absent = dict.fromkeys(("triton", "triton.language"), _no_triton())
    if importlib.util.find_spec("triton") is not None:
        absent = {}
    known = {name: sys.modules.pop(name, None) for name in _THEIRS}
    sys.modules.update(absent)
    try:
        scorer, motions = map(importlib.import_module, _THEIRS[:2])
        compose = _pretended_motion(motions.compose, rigid.compose)
        difference = _pretended_motion(motions.difference, rigid.difference)
        moved = Motions(compose, difference, redraw_with(compose), rigid.mean)
        with (
            patch.multiple(scorer, **_kernels(scorer, counts)),
            patch.multiple(motions, MOTIONS=moved, **_kernels(motions, counts)),
            patch.object(scorer, "TritonScorer", _pretended_scorer(scorer.TritonScorer)),
        ):
            yield
    finally:
        for name in (*absent, *_THEIRS):
            del sys.modules[name]
        for name, module in known.items():
            package, _, short = name.rpartition(".")
            delattr(sys.modules[package], short)
            if module is not None:
                sys.modules[name] = module
                setattr(sys.modules[package], short, module)


_THEIRS = (
    "toftrack.render.triton.scorer",
    "toftrack.compute.rigid_triton",
    "toftrack.render.triton.kernel",
)
"""What is imported anew, for it may be without triton itself."""


def _no_triton() -> Any:
    """What is used of the module but for running kernels."""
    module: Any = ModuleType("triton")
    module.language = module
    module.jit = lambda function=None, **options: function or (lambda other: other)
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
