"""Which hypothesis becomes the pose: against a plain reference, and as sequences of frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.tracking.select import Choice, Hypotheses, Hysteresis, Incumbent, Source, select

SETTINGS = Hysteresis()


def joints_of(poses: torch.Tensor) -> torch.Tensor:
    """(N, 21, 3): the first number moves the whole hand, the seventh one finger, metres each."""
    joints = poses[:, 0, None, None].repeat(1, 21, 3) / math.sqrt(3)
    joints[:, 5:9] += poses[:, 6, None, None] / math.sqrt(3)
    return joints


def pose(place: float = 0.0, finger: float = 0.0) -> torch.Tensor:
    """(1, 27)"""
    state = torch.zeros(1, 27)
    state[0, 0], state[0, 6] = place, finger
    return state


OTHER_FINGER = pose(finger=0.06)
OTHER_PLACE = pose(place=0.05)


def random_table(draw: np.random.Generator) -> Hypotheses:
    """A few poses near one another, of which one at least is the filter's."""
    n = int(draw.integers(1, 10))
    poses = torch.zeros(n, 27)
    poses[:, 0] = torch.from_numpy(draw.choice((0, 0, 0.006, 0.05), n) + draw.normal(0, 1e-3, n))
    poses[:, 6] = torch.from_numpy(draw.choice((0, 0, 0.02, 0.06), n) + draw.normal(0, 1e-3, n))
    sources = torch.from_numpy(draw.choice([int(source) for source in Source], n))
    sources[draw.integers(n)] = int(draw.choice((Source.PREVIOUS, Source.DYNAMICS)))
    values = torch.from_numpy(draw.normal(0, 0.05, n)).float()
    return Hypotheses(poses, sources, values)


def reference(
    table: Hypotheses, track: Incumbent, dt_s: float, detected: bool, hidden: bool
) -> tuple[int, bool, Duration]:
    """The row of the pose by plain loops, whether it is of another place, and `challenged`."""
    value, joints = table.log_posterior.tolist(), joints_of(table.pose).double().numpy()
    sources, rows, s = table.source.tolist(), range(len(table)), SETTINGS
    base = max((i for i in rows if sources[i] <= Source.DYNAMICS), key=lambda i: value[i])
    away = [np.linalg.norm(joints[i] - joints[base], axis=1).mean() for i in rows]
    places = [i for i in rows if sources[i] == Source.DETECTOR and away[i] >= s.place_m]
    best = max(places, key=lambda i: value[i], default=base)
    challenged = track.challenged
    if detected:
        gain = value[best] - value[base]
        leads = gain > s.place_lead and (not hidden or gain > 2.0)
        challenged = challenged.extended(dt_s) if leads else Duration()
        if leads and (track.new or track.emerges or challenged.reached(s.place_frames)):
            return best, True, Duration()
    near = [i for i in rows if i not in places]
    margin = [s.margin if sources[i] == Source.DETECTOR else 0.0 for i in rows]
    return max(near, key=lambda i: value[i] - margin[i]), False, challenged


@pytest.mark.parametrize("detected", [True, False])
@pytest.mark.parametrize("hidden", [True, False])
def test_the_choice_is_that_of_a_plain_reference(detected: bool, hidden: bool) -> None:
    draw, seen = np.random.default_rng(0), set()
    for _ in range(250):
        table = random_table(draw)
        challenged = Duration(float(draw.choice((0.0, 0.04, 0.08))))
        track = Incumbent(challenged, bool(draw.random() < 0.15), bool(draw.random() < 0.3))
        dt_s, joints = float(draw.choice((0.02, 0.04, 0.2))), joints_of(table.pose)
        choice = select(table, joints, track, dt_s, detected, hidden, SETTINGS)
        row, moved, challenged = reference(table, track, dt_s, detected, hidden)
        assert torch.equal(choice.pose, table.pose[[row]])
        assert choice.moved == moved and choice.challenged == challenged
        seen.add((Source(int(table.source[row])), moved))
    assert {source for source, _ in seen} == set(Source)
    assert any(moved for _, moved in seen) == (detected and not hidden)


@dataclass
class Followed:
    """A track over frames: what was chosen in one stands in the next."""

    new: bool = False
    detected: bool = True
    hidden: bool = False
    emerges: bool = False
    pose: torch.Tensor = field(default_factory=pose)
    challenged: Duration = Duration()
    frames: int = 0

    def frame(self, others: Sequence[tuple[torch.Tensor, Source, float]]) -> Choice:
        """A frame in which other poses (1, 27) are better than the standing one by so much."""
        tables = [Hypotheses.of(self.pose, Source.PREVIOUS)]
        tables += [Hypotheses.of(other, source) for other, source, _ in others]
        gains = torch.tensor([0.0] + [gain for _, _, gain in others])
        table = replace(Hypotheses.joined(tables), log_posterior=gains)
        incumbent = Incumbent(self.challenged, self.new and not self.frames, self.emerges)
        joints = joints_of(table.pose)
        found = select(table, joints, incumbent, FRAME_S, self.detected, self.hidden, SETTINGS)
        self.challenged, self.pose, self.frames = found.challenged, found.pose, self.frames + 1
        return found

    def until(self, wanted: torch.Tensor, source: Source, gain: float, most: int = 30) -> int:
        """In which frame a pose takes over that is better by as much; 0 = in none."""
        for number in range(1, most + 1):
            if torch.equal(self.frame([(wanted, source, gain)]).pose, wanted):
                return number
        return 0


@pytest.mark.parametrize(
    ("source", "margin"), [(Source.DYNAMICS, 0.0), (Source.DETECTOR, SETTINGS.margin)]
)
def test_other_fingers_take_over_when_they_are_better(source: Source, margin: float) -> None:
    assert Followed().until(OTHER_FINGER, source, margin + 1e-4) == 1
    assert Followed().until(OTHER_FINGER, source, margin - 1e-4) == 0


def test_another_place_needs_as_many_frames_as_set_without_a_break() -> None:
    track, better = Followed(), [(OTHER_PLACE, Source.DETECTOR, 5.0)]
    for interrupting in ([], [(OTHER_PLACE, Source.DETECTOR, 0.9 * SETTINGS.place_lead)]):
        for _ in range(SETTINGS.place_frames - 1):
            assert track.frame(better).challenged.begun
        assert not track.frame(interrupting).challenged.begun
    assert torch.equal(track.pose, pose())
    assert track.until(OTHER_PLACE, Source.DETECTOR, 0.04) == SETTINGS.place_frames


def test_frames_in_which_the_detector_was_not_asked_change_nothing_of_a_challenge() -> None:
    track, better = Followed(), [(OTHER_PLACE, Source.DETECTOR, 0.1)]
    for _ in range(SETTINGS.place_frames - 1):
        challenged = track.frame(better).challenged
        track.detected = False
        assert track.frame([]).challenged == challenged
        track.detected = True
    assert track.frame(better).moved


def test_another_place_wins_with_a_large_lead_alone_while_the_hand_is_hidden() -> None:
    assert Followed(hidden=True).until(OTHER_PLACE, Source.DETECTOR, 1.9) == 0
    assert Followed(hidden=True).until(OTHER_PLACE, Source.DETECTOR, 2.1) == SETTINGS.place_frames


@pytest.mark.parametrize("track", [Followed(new=True), Followed(emerges=True)])
def test_a_new_or_emerging_hand_goes_to_a_better_place_at_once(track: Followed) -> None:
    assert track.until(OTHER_PLACE, Source.DETECTOR, 1.1 * SETTINGS.place_lead) == 1


def test_a_hand_that_is_held_or_explains_nothing_stays_as_it_is() -> None:
    table = replace(Hypotheses.of(OTHER_FINGER, Source.HELD), log_posterior=torch.tensor([-9.0]))
    none = Incumbent(Duration(), False)
    choice = select(table, joints_of(table.pose), none, FRAME_S, True, True, SETTINGS)
    assert torch.equal(choice.pose, OTHER_FINGER) and not choice.moved
    poses = torch.cat((pose(), OTHER_FINGER))
    sources = torch.tensor([int(Source.PREVIOUS), int(Source.DETECTOR)])
    nothing = Hypotheses(poses, sources, torch.full((2,), -math.inf))
    choice = select(nothing, joints_of(poses), none, FRAME_S, False, False, SETTINGS)
    assert torch.equal(choice.pose, pose())
