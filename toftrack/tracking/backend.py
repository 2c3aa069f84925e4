"""Which back end computes here: the only place that chooses between torch, numba and triton."""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch

from toftrack.compute import rigid
from toftrack.compute.backend import Backend
from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape
from toftrack.refinement.gauss_newton import TorchRefiner
from toftrack.render.scoring import Scorer
from toftrack.render.torch_scorer import TorchScorer
from toftrack.tracking import penalty

log = logging.getLogger(__name__)

BACK_ENDS = ("torch", "numba", "triton")


def choose_backend(renderer: str, device: torch.device | str = "cpu") -> Backend:
    """The back end of a name in BACK_ENDS, or `auto`: the fastest that works here.

    device: of the particles. What a back end does not know to do there is done in torch.
    Raises ToftrackError for an unknown name or a back end that cannot run here.
    """
    device = torch.device(device)
    if renderer == "auto":
        wanted = "triton" if device.type == "cuda" else "numba"
    elif renderer in BACK_ENDS:
        wanted = renderer
    else:
        raise ToftrackError(
            f"renderer={renderer} is unknown; give one of auto, {', '.join(BACK_ENDS)}"
        )
    try:
        return _MAKERS[wanted](device)
    except ImportError as error:
        if renderer != "auto":
            raise ToftrackError(
                f"renderer={renderer} cannot run here ({error}); install it or give renderer=torch"
            ) from None
        log.info("renderer: %s is not available (%s), using torch", wanted, error)
        return _torch(device)


def make_scorer(renderer: str, shape: HandShape, device: torch.device | str = "cpu") -> Scorer:
    """The scorer alone of a back end, see choose_backend."""
    return choose_backend(renderer, device).make_scorer(shape)


def _torch(device: torch.device) -> Backend:
    return Backend(
        "torch",
        device,
        rigid.MOTIONS,
        penalty.joints_penalty,
        make_scorer=lambda shape: TorchScorer(shape.to(device)),
        make_refiner=lambda shape: TorchRefiner(shape.to(device)),
    )


def _numba(device: torch.device) -> Backend:
    """Compiled code on the CPU; particles elsewhere are scored by it, and moved where they are."""
    from toftrack.compute import rigid_numba
    from toftrack.refinement.gauss_newton_numba import CompiledRefiner
    from toftrack.render.numba.scorer import NumbaScorer
    from toftrack.tracking import penalty_numba

    here = device.type == "cpu"
    return Backend(
        "numba",
        device,
        rigid_numba.motions() if here else rigid.MOTIONS,
        penalty_numba.joints_penalty if here else penalty.joints_penalty,
        make_scorer=lambda shape: NumbaScorer(shape.to(device)),
        make_refiner=lambda shape: (CompiledRefiner if here else TorchRefiner)(shape.to(device)),
    )


def _triton(device: torch.device) -> Backend:
    from toftrack.render.triton.scorer import TritonScorer, require_device

    require_device()
    return Backend(
        "triton",
        device,
        rigid.MOTIONS,
        penalty.joints_penalty,
        make_scorer=lambda shape: TritonScorer(shape.to(device)),
        make_refiner=lambda shape: TorchRefiner(shape.to(device)),
    )


_MAKERS: dict[str, Callable[[torch.device], Backend]] = {
    "torch": _torch,
    "numba": _numba,
    "triton": _triton,
}
