"""Which hypothesis becomes the pose: against a plain reference, and case by case."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from toftrack.tracking.candidates import _ELSEWHERE_M, _MARGIN, Hypotheses, Source, select


def joints_of(poses: torch.Tensor) -> torch.Tensor:
    """(N, 21, 3): the first number moves the whole hand, the seventh one finger, metres each."""
    joints = poses[:, 0, None, None].repeat(1, 21, 3) / math.sqrt(3)
    joints[:, 5:9] += poses[:, 6, None, None] / math.sqrt(3)
    return joints


def table_of(*rows: tuple[float, float, Source, float]) -> Hypotheses:
    """Hypotheses by their place, finger, source and log posterior."""
    poses = torch.zeros(len(rows), 27)
    poses[:, 0] = torch.tensor([place for place, _, _, _ in rows])
    poses[:, 6] = torch.tensor([finger for _, finger, _, _ in rows])
    sources = [source for _, _, source, _ in rows]
    values = torch.tensor([value for _, _, _, value in rows])
    return Hypotheses(poses, joints_of(poses), sources, values)


def chosen(table: Hypotheses, hidden: bool = False) -> tuple[int, bool]:
    """The row, and whether it is of another place."""
    pose, moved = select(table, hidden)
    (row,) = (table.pose == pose).all(1).nonzero()[:1].tolist()
    return row[0], moved


def test_the_choice_is_that_of_a_plain_reference() -> None:
    draw, seen = np.random.default_rng(0), set()
    for _ in range(500):
        n = int(draw.integers(1, 10))
        places = draw.choice((0, 0, 0.006, 0.05), n) + draw.normal(0, 1e-3, n)
        fingers = draw.choice((0, 0, 0.02, 0.06), n) + draw.normal(0, 1e-3, n)
        sources = [Source(int(draw.integers(3))) for _ in range(n)]
        sources[0] = Source(int(draw.integers(2)))
        table = table_of(*zip(places, fingers, sources, draw.normal(0, 0.05, n), strict=True))
        value, joints = table.log_posterior.tolist(), table.joints_m.double().numpy()
        filters = [i for i in range(n) if sources[i] != Source.DETECTOR]
        base = max(filters, key=lambda i: value[i])
        margins = [_MARGIN if source == Source.DETECTOR else 0.0 for source in sources]
        away = np.linalg.norm(joints - joints[base], axis=2).mean(1)
        moves = [sources[i] == Source.DETECTOR and away[i] >= _ELSEWHERE_M for i in range(n)]
        hidden = bool(draw.random() < 0.3)
        needed = [2.0 if hidden and moves[i] else margins[i] for i in range(n)]
        best = max(range(n), key=lambda i: value[i] - needed[i])
        assert chosen(table, hidden) == (best, moves[best])
        seen.add((sources[best], moves[best], hidden))
    assert (Source.DETECTOR, True, False) in seen and (Source.DETECTOR, True, True) not in seen
    assert {source for source, _, _ in seen} == set(Source)


@pytest.mark.parametrize(
    ("place", "source", "gain", "taken", "moved"),
    [
        (0.0, Source.DYNAMICS, 1e-4, True, False),
        (0.0, Source.DYNAMICS, -1e-4, False, False),
        (0.0, Source.DETECTOR, _MARGIN + 1e-3, True, False),
        (0.0, Source.DETECTOR, _MARGIN - 1e-3, False, False),
        (0.05, Source.DETECTOR, _MARGIN + 1e-3, True, True),
        (0.05, Source.DYNAMICS, 1.0, True, False),
    ],
)
def test_the_detector_needs_a_margin_and_alone_moves_a_hand(
    place: float, source: Source, gain: float, taken: bool, moved: bool
) -> None:
    table = table_of((0.0, 0.0, Source.PREVIOUS, 0.0), (place, 0.06, source, gain))
    assert chosen(table) == (int(taken), moved)


def test_where_no_pose_explains_anything_the_last_frame_s_fingers_stay() -> None:
    nothing = -math.inf
    table = table_of((0, 0, Source.PREVIOUS, nothing), (0, 0.06, Source.DETECTOR, nothing))
    assert chosen(table) == (0, False)
