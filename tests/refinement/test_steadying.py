"""Rest is still, movement does not lag."""

import pytest
import torch

from toftrack.compute import rigid
from toftrack.compute.pace import FRAME_S
from toftrack.refinement.steadying import steadied


def hand(x: float = 0.0) -> torch.Tensor:
    state = torch.zeros(1, 27)
    state[0, 0] = x
    state[0, 2] = 0.5
    return state


def followed(states: list[torch.Tensor]) -> torch.Tensor:
    """(T, 27) the steadied states."""
    believed, trend, path = states[0], torch.full((27,), torch.nan), [states[0]]
    for state in states[1:]:
        believed, trend = steadied(state, believed, trend, FRAME_S, rigid.MOTIONS)
        path.append(believed)
    return torch.cat(path)


def trembling(frames: int, seed: int = 0) -> list[torch.Tensor]:
    """A hand at rest, seen with a noise of 1 mm, 10 mrad and 30 mrad of an angle."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.tensor([0.001] * 3 + [0.01] * 3 + [0.03] * 21)
    return [hand() + noise * torch.randn(27, generator=generator) for _ in range(frames)]


def test_a_hand_at_rest_moves_a_tenth_of_what_is_seen() -> None:
    seen = trembling(60)
    moved = followed(seen)[20:].std(0)
    assert (moved < 0.3 * torch.cat(seen)[20:].std(0)).all()
    assert moved.mean() < 0.1 * torch.cat(seen)[20:].std(0).mean()


@pytest.mark.parametrize("speed_m", [0.005, 0.02])
def test_a_moving_hand_is_followed_to_within_its_noise(speed_m: float) -> None:
    path = followed([hand(i * speed_m) for i in range(30)])
    lag = torch.arange(30) * speed_m - path[:, 0]
    assert (lag[5:] < 0.003).all()


def test_a_slow_movement_after_rest_is_followed_soon() -> None:
    rest = trembling(30)
    states = rest + [state + hand(0.001 * i) - hand() for i, state in enumerate(trembling(40, 1))]
    lag = torch.cat(states)[:, 0] - followed(states)[:, 0]
    assert lag[30:].max() < 0.012
    assert lag[-10:].mean() < 0.004


def test_a_jump_is_taken_at_once() -> None:
    path = followed([*trembling(20), hand(0.2)])
    assert float(path[-1, 0]) > 0.19


def test_a_movement_is_forgotten_by_the_time_and_not_by_the_frame() -> None:
    two = 2 * FRAME_S
    _, trend = steadied(hand(0.001 * 2), hand(), torch.full((27,), 0.5), two, rigid.MOTIONS)
    one = steadied(hand(0.001), hand(), torch.full((27,), 0.5), FRAME_S, rigid.MOTIONS)[1]
    assert float(trend[10]) == pytest.approx(float(one[10]) ** 2 / 0.5, rel=1e-4)
