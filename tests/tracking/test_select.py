"""Which hypothesis becomes the pose: against a plain reference, and as sequences of frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from helpers.configured import hysteresis

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.errors import ToftrackError
from toftrack.tracking.select import Choice, Hypotheses, Incumbent, Source, select

SETTINGS = hysteresis(lead=0.06, drift=0.01, place_m=0.02, place_lead=0.03, place_frames=3)
FINGER = slice(5, 9)
"""Joints of the one finger that is marked."""


def joints_of(poses: torch.Tensor) -> torch.Tensor:
    """(N, 21, 3): the first number moves the whole hand, the seventh one finger, metres each."""
    joints = poses[:, 0, None, None].repeat(1, 21, 3) / math.sqrt(3)
    joints[:, FINGER] += poses[:, 6, None, None] / math.sqrt(3)
    return joints


def pose(place: float = 0.0, finger: float = 0.0) -> torch.Tensor:
    """(1, 27)"""
    state = torch.zeros(1, 27)
    state[0, 0], state[0, 6] = place, finger
    return state


def random_table(draw: np.random.Generator) -> Hypotheses:
    """A few poses near one another, of which one at least stands."""
    n = int(draw.integers(1, 10))
    poses = torch.zeros(n, 27)
    poses[:, 0] = torch.from_numpy(draw.choice((0, 0, 0.006, 0.05), n) + draw.normal(0, 1e-3, n))
    poses[:, 6] = torch.from_numpy(draw.choice((0, 0, 0.02, 0.06), n) + draw.normal(0, 1e-3, n))
    sources = torch.from_numpy(draw.choice([int(source) for source in Source], n))
    sources[draw.integers(n)] = int(draw.choice((Source.PREVIOUS, Source.DYNAMICS)))
    values = torch.from_numpy(draw.normal(0, 0.05, n)).float()
    return Hypotheses(poses, sources, values)


def random_incumbent(draw: np.random.Generator, table: Hypotheses) -> Incumbent:
    new = bool(draw.random() < 0.15)
    contends = not new and draw.random() < 0.6
    contender = joints_of(table.pose[[int(draw.integers(len(table)))]])
    return Incumbent(
        contender if contends else contender[:0],
        draw.uniform(0, 0.08) if contends else 0.0,
        Duration(float(draw.choice((0.0, 0.04, 0.08)))),
        draw.normal(0, 2),
        new,
        bool(draw.random() < 0.3),
    )


def reference(
    table: Hypotheses, track: Incumbent, dt_s: float, detected: bool, hidden: bool
) -> tuple[int, bool, int | None, float, Duration]:
    """Rows of the pose and of the next contender, by plain loops; and what else a Choice has."""
    value, joints = table.log_posterior.tolist(), joints_of(table.pose).double().numpy()
    sources, rows, s = table.source.tolist(), range(len(table)), SETTINGS

    def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(a - b, axis=1)

    base = max((i for i in rows if sources[i] <= Source.DYNAMICS), key=lambda i: value[i])
    away = [distance(joints[i], joints[base]) for i in rows]
    places = [i for i in rows if sources[i] == Source.DETECTOR and away[i].mean() >= s.place_m]
    best = max(places, key=lambda i: value[i], default=base)
    challenged = track.challenged
    if detected:
        gain = value[best] - value[base]
        leads = gain > s.place_lead and (not hidden or gain > 2.0)
        challenged = challenged.extended(dt_s) if leads else Duration()
        if leads and (track.new or track.emerges or challenged.reached(s.place_frames)):
            return best, True, None, 0.0, Duration()
    others = [i for i in rows if i not in places and sources[i] > Source.DYNAMICS]
    far = [i for i in others if away[i].max() > 0.025]
    base = max([base] + [i for i in others if i not in far], key=lambda i: value[i])
    weight = 1.0 if FRAME_S <= dt_s <= 0.06 else dt_s / FRAME_S
    leads_of = {i: weight * (value[i] - value[base]) - s.drift for i in far}
    for i in far:
        if len(track.contender_m):
            its = distance(joints[i], track.contender_m[0].double().numpy()).max() <= 0.025
            leads_of[i] += track.lead * its
    i = max(leads_of, key=lambda i: leads_of[i], default=-1)
    needed = s.lead * min(1.0, max(0.2, 2 / (1 + math.exp(-track.log_odds))))
    needed = -math.inf if track.new else needed
    if i >= 0 and value[i] > value[base] and leads_of[i] > needed:
        return i, False, None, 0.0, challenged
    kept = i if i >= 0 and leads_of[i] > 0 else None
    return base, False, kept, max(0.0, leads_of.get(i, 0.0)), challenged


@pytest.mark.parametrize("detected", [True, False])
@pytest.mark.parametrize("hidden", [True, False])
def test_the_choice_is_that_of_a_plain_reference(detected: bool, hidden: bool) -> None:
    draw, seen = np.random.default_rng(0), set()
    for _ in range(250):
        table = random_table(draw)
        track, dt_s = random_incumbent(draw, table), float(draw.choice((0.02, 0.04, 0.05, 0.2)))
        joints = joints_of(table.pose)
        choice = select(table, joints, track, dt_s, detected, hidden, SETTINGS)
        row, moved, kept, lead, challenged = reference(table, track, dt_s, detected, hidden)
        assert torch.equal(choice.pose, table.pose[[row]])
        assert choice.moved == moved and choice.challenged == challenged
        assert len(choice.contender) == (kept is not None)
        if kept is not None:
            assert torch.equal(choice.contender, table.pose[[kept]])
        assert choice.lead == pytest.approx(lead, abs=1e-5)
        seen.add((Source(int(table.source[row])), moved, kept is None))
    reached = {source for source, _, _ in seen}
    assert reached >= {Source.PREVIOUS, Source.CONTENDER, Source.EXCHANGED, Source.DETECTOR}
    assert any(moved for _, moved, _ in seen) == (detected and not hidden)
    assert {none for _, _, none in seen} == {True, False}


@dataclass
class Followed:
    """A track over frames: what was chosen in one stands and contends in the next.

    dt_s: from frame to frame.  frames: how many there were.
    """

    dt_s: float = FRAME_S
    log_odds: float = 5.0
    new: bool = False
    detected: bool = True
    hidden: bool = False
    emerges: bool = False
    pose: torch.Tensor = field(default_factory=pose)
    choice: Choice | None = None
    frames: int = 0

    def frame(self, others: Sequence[tuple[torch.Tensor, Source, float]]) -> Choice:
        """A frame in which other poses (1, 27) are better than the standing one by so much."""
        before = self.choice
        tables = [Hypotheses.of(self.pose, Source.PREVIOUS)]
        tables += [Hypotheses.of(other, source) for other, source, _ in others]
        gains = torch.tensor([0.0] + [gain for _, _, gain in others])
        table = replace(Hypotheses.joined(tables), log_posterior=gains)
        incumbent = Incumbent(
            torch.zeros(0, 21, 3) if before is None else joints_of(before.contender),
            0.0 if before is None else before.lead,
            Duration() if before is None else before.challenged,
            self.log_odds,
            self.new and not self.frames,
            self.emerges,
        )
        joints = joints_of(table.pose)
        found = select(table, joints, incumbent, self.dt_s, self.detected, self.hidden, SETTINGS)
        self.choice, self.pose, self.frames = found, found.pose, self.frames + 1
        return found

    def until(self, wanted: torch.Tensor, source: Source, gain: float, most: int = 60) -> int:
        """In which frame a pose takes over that is better by as much in all; 0 = in none."""
        for number in range(1, most + 1):
            if torch.equal(self.frame([(wanted, source, gain)]).pose, wanted):
                return number
        return 0


OTHER_FINGER = pose(finger=0.06)
OTHER_PLACE = pose(place=0.05)


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 10])
def test_a_small_lead_sums_up_and_takes_over_after_the_right_number_of_frames(frames: int) -> None:
    gain = SETTINGS.drift + 1.01 * SETTINGS.lead / frames
    assert Followed().until(OTHER_FINGER, Source.EXCHANGED, gain) == frames


@pytest.mark.parametrize("dt_s", [FRAME_S / 2, FRAME_S / 4])
def test_at_a_higher_rate_a_frame_speaks_for_less(dt_s: float) -> None:
    """So that as much must be seen for as long: what a frame adds is in units of 25 a second."""
    weight = dt_s / FRAME_S
    for frames in (2, 4, 8):
        gain = (SETTINGS.drift + 1.01 * SETTINGS.lead / frames) / weight
        found = Followed(dt_s=dt_s).until(OTHER_FINGER, Source.EXCHANGED, gain)
        assert found == frames


@pytest.mark.parametrize(("dt_s", "frames"), [(1.4 * FRAME_S, 3), (4 * FRAME_S, 1)])
def test_after_a_pause_a_frame_speaks_for_those_that_were_dropped(dt_s: float, frames: int) -> None:
    gain = SETTINGS.drift + 1.01 * SETTINGS.lead / 3
    assert Followed(dt_s=dt_s).until(OTHER_FINGER, Source.EXCHANGED, gain) == frames


def test_what_is_better_by_no_more_than_the_drift_never_takes_over() -> None:
    track = Followed()
    assert track.until(OTHER_FINGER, Source.EXCHANGED, 0.99 * SETTINGS.drift, most=200) == 0
    assert track.choice is not None and len(track.choice.contender) == 0 == track.choice.lead


def test_a_lead_drifts_away_where_nothing_speaks_for_it() -> None:
    track = Followed()
    leads = [track.frame([(OTHER_FINGER, Source.CONTENDER, 0.045)]).lead]
    for _ in range(6):
        leads.append(track.frame([(OTHER_FINGER, Source.CONTENDER, 0.0)]).lead)
    expected = np.maximum(0, leads[0] - SETTINGS.drift * np.arange(7))
    assert leads == pytest.approx(expected.tolist(), abs=1e-6)
    assert track.choice is not None and len(track.choice.contender) == 0


def test_a_lead_is_of_one_pose_and_not_of_the_next() -> None:
    gain = SETTINGS.drift + 0.6 * SETTINGS.lead
    again, changing = Followed(), Followed()
    for track, second in ((again, OTHER_FINGER), (changing, -OTHER_FINGER)):
        track.frame([(OTHER_FINGER, Source.EXCHANGED, gain)])
        track.frame([(second, Source.EXCHANGED, gain)])
    assert torch.equal(again.pose, OTHER_FINGER)
    assert torch.equal(changing.pose, pose())


def test_a_large_lead_does_not_take_over_in_a_frame_that_speaks_against_it() -> None:
    track = Followed()
    kept = Choice(pose(), False, OTHER_FINGER, 10 * SETTINGS.lead, Duration())
    track.choice = kept
    assert torch.equal(track.frame([(OTHER_FINGER, Source.CONTENDER, -0.001)]).pose, pose())
    assert torch.equal(track.frame([(OTHER_FINGER, Source.CONTENDER, 0.001)]).pose, OTHER_FINGER)


def test_a_doubtful_track_gives_way_earlier() -> None:
    gain = SETTINGS.drift + 1.01 * SETTINGS.lead / 10
    found = [
        Followed(log_odds=log_odds).until(OTHER_FINGER, Source.EXCHANGED, gain)
        for log_odds in (30.0, 0.0, -1.1, -2.2, -30.0)
    ]
    # Up to a probability of a half nothing is changed, and with none at all a fifth is needed.
    assert found == [10, 10, 5, 2, 2]


def test_a_new_track_takes_other_fingers_at_once() -> None:
    assert Followed(new=True).until(OTHER_FINGER, Source.EXCHANGED, 1e-4) == 1
    assert Followed(new=True).until(OTHER_FINGER, Source.EXCHANGED, -1e-4) == 0


def test_of_several_a_new_track_takes_the_best() -> None:
    others = [
        (OTHER_FINGER, Source.DETECTOR, 0.01),
        (-OTHER_FINGER, Source.EXCHANGED, 0.03),
        (2 * OTHER_FINGER, Source.EXCHANGED, 0.02),
    ]
    assert torch.equal(Followed(new=True).frame(others).pose, -OTHER_FINGER)


def test_a_pose_that_was_worse_in_the_first_frame_has_no_lead_in_the_second() -> None:
    track = Followed(new=True)
    assert track.frame([(OTHER_FINGER, Source.DETECTOR, -0.2)]).lead == 0
    assert torch.equal(track.frame([(OTHER_FINGER, Source.DETECTOR, 0.02)]).pose, pose())


def test_much_the_same_pose_takes_over_when_it_is_better() -> None:
    near = pose(finger=0.01)
    assert Followed().until(near, Source.DETECTOR, 1e-4) == 1
    assert Followed().until(near, Source.DETECTOR, -1e-4) == 0


def test_the_last_fingers_stand_until_those_of_the_filter_are_better() -> None:
    assert Followed().until(OTHER_FINGER, Source.DYNAMICS, 1e-4) == 1
    assert Followed().until(OTHER_FINGER, Source.DYNAMICS, -1e-4) == 0


def test_a_hand_that_is_held_stays_as_it_is() -> None:
    table = replace(Hypotheses.of(OTHER_FINGER, Source.HELD), log_posterior=torch.tensor([-9.0]))
    none = Incumbent(torch.zeros(0, 21, 3), 0.0, Duration(), 5.0, False)
    joints = joints_of(table.pose)
    choice = select(table, joints, none, FRAME_S, True, True, SETTINGS)
    assert torch.equal(choice.pose, OTHER_FINGER) and not choice.moved


@pytest.mark.parametrize("gain", [0.04, 5.0])
def test_another_place_needs_as_many_frames_as_set_however_much_better_it_is(gain: float) -> None:
    track = Followed()
    assert track.until(OTHER_PLACE, Source.DETECTOR, gain) == SETTINGS.place_frames
    assert track.choice is not None and track.choice.moved
    assert track.choice.challenged == Duration() and len(track.choice.contender) == 0


def test_another_place_begins_anew_after_a_frame_that_does_not_speak_for_it() -> None:
    track = Followed()
    better = [(OTHER_PLACE, Source.DETECTOR, 0.1)]
    for interrupting in ([], [(OTHER_PLACE, Source.DETECTOR, 0.9 * SETTINGS.place_lead)]) * 3:
        for _ in range(SETTINGS.place_frames - 1):
            assert track.frame(better).challenged.begun
        assert not track.frame(interrupting).challenged.begun
    assert torch.equal(track.pose, pose())


def test_frames_in_which_the_detector_was_not_asked_change_nothing_of_a_challenge() -> None:
    track = Followed()
    better = [(OTHER_PLACE, Source.DETECTOR, 0.1)]
    for _ in range(SETTINGS.place_frames - 1):
        challenged = track.frame(better).challenged
        track.detected = False
        for _ in range(5):
            assert track.frame([]).challenged == challenged
        track.detected = True
    assert track.frame(better).moved


def test_another_place_wins_with_a_large_lead_alone_while_the_hand_is_hidden() -> None:
    track = Followed(hidden=True)
    assert track.until(OTHER_PLACE, Source.DETECTOR, 1.9, most=30) == 0
    assert Followed(hidden=True, new=True).until(OTHER_PLACE, Source.DETECTOR, 1.9, most=1) == 0
    assert track.until(OTHER_PLACE, Source.DETECTOR, 2.1) == SETTINGS.place_frames
    assert Followed().until(OTHER_PLACE, Source.DETECTOR, 1.9) == SETTINGS.place_frames


def test_a_hand_that_emerges_elsewhere_is_gone_to_at_once() -> None:
    track = Followed(log_odds=-4.0, emerges=True)
    assert track.until(OTHER_PLACE, Source.DETECTOR, 1.1 * SETTINGS.place_lead) == 1


def test_a_new_track_goes_to_a_better_place_at_once() -> None:
    track = Followed(new=True)
    assert track.until(OTHER_PLACE, Source.DETECTOR, 1.1 * SETTINGS.place_lead) == 1
    little = 0.9 * SETTINGS.place_lead
    assert Followed(new=True).until(OTHER_PLACE, Source.DETECTOR, little) == 0


def test_only_the_detector_moves_a_hand_to_another_place() -> None:
    track = Followed()
    assert not any(track.frame([(OTHER_PLACE, Source.EXCHANGED, 0.5)]).moved for _ in range(5))


def test_a_table_keeps_each_row_with_its_source() -> None:
    one = Hypotheses.of(torch.ones(2, 27), Source.DETECTOR)
    two = Hypotheses.of(2 * torch.ones(3, 27), Source.CONTENDER)
    table = Hypotheses.joined((one, two))
    assert len(table) == 5 and bool(table.log_posterior.isnan().all())
    assert torch.equal(table.of_source(Source.CONTENDER).pose, two.pose)
    assert torch.equal(table.of_source(Source.DETECTOR, Source.HELD).pose, one.pose)


def test_of_equally_good_rows_the_first_is_the_best() -> None:
    table = Hypotheses.of(torch.arange(4.0)[:, None].repeat(1, 27), Source.DETECTOR)
    scored = replace(table, log_posterior=torch.tensor([-1.0, 0.5, 0.5, -torch.inf]))
    assert float(scored.best.pose[0, 0]) == 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("exchanged", -1),
        ("exchanged", 1.5),
        ("lead", -0.1),
        ("drift", math.nan),
        ("place_m", 0),
        ("place_lead", -1),
        ("place_frames", 0),
        ("alternate", 0.4),
        ("alternate", 1.1),
    ],
)
def test_a_setting_that_cannot_be_is_named(name: str, value: float) -> None:
    with pytest.raises(ToftrackError, match=f"hysteresis.{name}"):
        hysteresis(**{name: value})


def test_poses_that_explain_nothing_stand_and_have_no_lead() -> None:
    poses = torch.cat((pose(), pose(finger=0.06)))
    sources = torch.tensor([int(Source.PREVIOUS), int(Source.EXCHANGED)])
    values = torch.full((2,), -math.inf)
    table = Hypotheses(poses, sources, values)
    track = Incumbent(joints_of(poses[:0]), 0.0, Duration(), 2.0, False)
    choice = select(table, joints_of(poses), track, FRAME_S, False, False, SETTINGS)
    assert torch.equal(choice.pose, pose())
    assert choice.lead == 0.0 and not len(choice.contender)
