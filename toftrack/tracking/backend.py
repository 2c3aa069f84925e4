"""The back ends: the only place that chooses between torch, numba and triton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.compute import rigid, rigid_numba
from toftrack.compute.rigid import Motions
from toftrack.errors import ToftrackError, check_choice
from toftrack.hand.shape import HandShape
from toftrack.render.likelihood import Likelihood, checked_score
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.numba.scorer import score_rows as score_rows_compiled
from toftrack.render.scoring import Counts, Scorer, ScoreRows, score_rows
from toftrack.render.torch_scorer import TorchScorer


@dataclass(frozen=True)
class Backend:
    """One way to compute everything that depends on the machine.

    name: "torch", "numba", "triton", as `renderer=` says it, or one's own.
    device: where the particles are. A frame's estimate is on the CPU, where its few poses are
        refined and compared, as is all that is said of it.
    motions: of particles, on the device and on the CPU.
    make_scorer: from a hand on the CPU to its scorer of poses on the device.
    score_rows: poses of several hands, see render.scoring.score_rows.
    """

    name: str
    device: torch.device
    motions: Motions
    make_scorer: Callable[[HandShape], Scorer]
    score_rows: ScoreRows = score_rows

    def judged_by(self, likelihood: Likelihood) -> Backend:
        """The same, with the scorers that a likelihood brings where it brings some."""
        checked_score(likelihood, Counts(*torch.zeros(4, 2)))  # where nothing is seen
        if getattr(type(likelihood), "scorer", Likelihood.scorer) is Likelihood.scorer:
            return self
        make = self.make_scorer
        return replace(
            self,
            make_scorer=lambda shape: likelihood.scorer(shape, make(shape)),
            score_rows=score_rows,  # others are compiled for their own scorers
        )


BACK_ENDS = ("torch", "numba", "triton")


def choose_backend(renderer: str, device: torch.device | str = "cpu") -> Backend:
    """The back end of a name in BACK_ENDS, or `auto`: the fastest that works here.

    device: of the particles. What a back end does not know to do there is done in torch.
    Raises ToftrackError for an unknown name or a back end that cannot run here.
    """
    check_choice("renderer", renderer, ("auto", *BACK_ENDS))
    device = torch.device(device)
    fastest = "triton" if device.type == "cuda" else "numba"
    wanted = fastest if renderer == "auto" else renderer
    try:
        return _make(wanted, device)
    except ImportError as error:
        raise ToftrackError(
            f"renderer={wanted} cannot run here ({error}); install it or give renderer=torch"
            + ("" if device.type == "cpu" else ", which is slow, or compute=cpu")
        ) from None


def make_scorer(renderer: str, shape: HandShape, device: torch.device | str = "cpu") -> Scorer:
    """The scorer of a hand by one back end, see choose_backend, also for errors."""
    return choose_backend(renderer, device).make_scorer(shape)


def _make(name: str, device: torch.device) -> Backend:
    if name == "torch":
        motions = _on_cpu_too(device, rigid.MOTIONS)
        return Backend(name, device, motions, lambda shape: TorchScorer(shape.to(device)))
    if name == "numba":  # which also scores particles elsewhere; torch moves those
        there = rigid_numba.MOTIONS if device.type == "cpu" else rigid.MOTIONS
        motions = _on_cpu_too(device, there)
        return Backend(name, device, motions, NumbaScorer, score_rows_compiled)
    from toftrack.compute import rigid_triton
    from toftrack.render.triton.scorer import TritonScorer, require_device

    require_device()
    motions = _on_cpu_too(device, rigid_triton.MOTIONS)
    return Backend(name, device, motions, lambda shape: TritonScorer(shape.to(device)))


def _on_cpu_too(device: torch.device, there: Motions) -> Motions:
    """The motions `there` for tensors on the device, and compiled ones for those on the CPU."""
    if device.type == "cpu":
        return there

    def at(tensor: Tensor) -> Motions:
        return rigid_numba.MOTIONS if tensor.device.type == "cpu" else there

    return Motions(
        compose=lambda reference, tangent: at(reference).compose(reference, tangent),
        difference=lambda particles, reference: at(particles).difference(particles, reference),
        redraw=there.redraw,
        mean=there.mean,
    )
