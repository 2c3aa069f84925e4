"""One back end, chosen once."""

import pytest
import torch

from toftrack.compute import rigid, rigid_numba
from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.render.numba.scorer import NumbaScorer
from toftrack.render.torch_scorer import TorchScorer
from toftrack.tracking.backend import choose_backend, make_scorer

SHAPE = default_hand_shape()


@pytest.mark.parametrize(
    ("name", "scorer", "compose"),
    [
        ("torch", TorchScorer, rigid.compose),
        ("numba", NumbaScorer, rigid_numba.compose),
        ("auto", NumbaScorer, rigid_numba.compose),
    ],
)
def test_a_back_end_is_of_one_kind(name: str, scorer: type, compose: object) -> None:
    backend = choose_backend(name, "cpu")
    assert backend.name == name.replace("auto", "numba")
    assert backend.device == torch.device("cpu") and backend.motions.compose is compose
    assert isinstance(backend.make_scorer(SHAPE), scorer)
    assert isinstance(make_scorer(name, SHAPE), scorer)


def test_unknown_back_ends_are_refused() -> None:
    with pytest.raises(ToftrackError, match="renderer=magic is unknown; give one of auto"):
        choose_backend("magic")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_triton_is_refused_where_it_cannot_run() -> None:
    with pytest.raises(ToftrackError, match="renderer=triton cannot run here"):
        choose_backend("triton")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_on_a_device_no_slow_back_end_is_taken_without_being_asked_for() -> None:
    """Any device but the CPU stands for CUDA: triton is looked for before anything runs there."""
    with pytest.raises(ToftrackError, match="renderer=torch, which is slow, or compute=cpu"):
        choose_backend("auto", torch.device("cuda"))
