"""The second hand in a process of its own: the same estimates, and no harm where it fails."""

from __future__ import annotations

import logging
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, cast

import numpy as np
import pytest
import torch
from helpers.rendered import right_hand_model
from helpers.tracking import configuration, sample
from helpers.two_hands import TwoHands, beside_its_mirror

from toftrack.api import build_hands_tracker
from toftrack.compute.quality import Quality
from toftrack.estimate import Estimate
from toftrack.refinement.shape_fit import first_shape
from toftrack.tracking import second_process
from toftrack.tracking.second_process import SecondProcess
from toftrack.tracking.step import HandTask
from toftrack.tracking.tracker import HandsTracker

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = ("hands=2", "filter.particles=80")
FRAMES = 14
READY_S = 120.0


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second_process, "threads", lambda: 2)


@pytest.fixture(scope="module")
def scene() -> TwoHands:
    return beside_its_mirror(sample().cut(*range(14, 14 + FRAMES)), 30)


@pytest.fixture(scope="module")
def expected(scene: TwoHands) -> list[tuple[Estimate, ...]]:
    """By one process."""
    return stepped(tracker_of("tracker.second_process=false"), scene, range(FRAMES))


def tracker_of(*overrides: str) -> HandsTracker:
    return build_hands_tracker(configuration(*SMALL, *overrides))


def stepped(tracker: HandsTracker, scene: TwoHands, rows: range) -> list[tuple[Estimate, ...]]:
    return [tracker.step(scene.depth_m[i], scene.k, i, i / 25) for i in rows]


def process_of(tracker: HandsTracker) -> SecondProcess:
    process = tracker._second
    assert isinstance(process, SecondProcess)
    return process


def asked(tracker: HandsTracker, scene: TwoHands) -> bool:
    """After frames until both hands are followed: whether the process has begun."""
    stepped(tracker, scene, range(FRAMES))
    return process_of(tracker)._began is not None


def wait_until_ready(process: SecondProcess) -> None:
    end = time.monotonic() + READY_S
    while process._began is not None and process._began.connection is None:
        assert time.monotonic() < end and process._began.process.poll() is None
        time.sleep(0.05)


def killed_before(process: SecondProcess, answer: Callable[..., Any], *asked: object) -> Any:
    """Its answer after it was killed."""
    assert process._began is not None
    process._began.process.kill()
    return answer(*asked)


def same(one: list[tuple[Estimate, ...]], two: list[tuple[Estimate, ...]]) -> bool:
    names = [field.name for field in fields(Estimate) if field.name != "compute_s"]
    pairs = [
        (getattr(a, name), getattr(b, name))
        for first, second in zip(one, two, strict=True)
        for a, b in zip(first, second, strict=True)
        for name in names
    ]
    return all(
        np.array_equal(a, b, equal_nan=True)
        if isinstance(a, np.ndarray)
        else a == b or (a != a and b != b)
        for a, b in pairs
    )


def test_the_estimates_are_those_of_one_process_also_after_it_has_ended(
    scene: TwoHands,
    expected: list[tuple[Estimate, ...]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = tracker_of()
    assert asked(tracker, scene), "both hands are followed"
    process = process_of(tracker)
    wait_until_ready(process)
    answers = []
    answer = process._answer

    def kept(*asked: Any) -> Any:
        answers.append(answer(*asked))
        return answers[-1]

    monkeypatch.setattr(process, "_answer", kept)
    tracker.state = tracker.model.first_state(0, 2)
    half = FRAMES - 4
    found = stepped(tracker, scene, range(half))
    assert len(answers) > 2 and None not in answers
    assert not caplog.records and process._began is not None
    monkeypatch.setattr(process, "_answer", partial(killed_before, process, answer))
    with caplog.at_level(logging.WARNING):
        found += stepped(tracker, scene, range(half, FRAMES))
    assert same(found, expected)
    assert len(caplog.records) == 1 and "both hands are followed by one process" in caplog.text


def test_where_it_cannot_begin_both_hands_are_followed_here(
    scene: TwoHands,
    expected: list[tuple[Estimate, ...]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(second_process.sys, "executable", "no such program")
    assert same(stepped(tracker_of(), scene, range(FRAMES)), expected)
    assert len(caplog.records) == 1 and "both hands are followed by one process" in caplog.text


def test_it_begins_only_where_there_are_two_cores_and_two_hands(
    scene: TwoHands, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(second_process, "threads", lambda: 1)
    assert not asked(tracker_of(), scene)
    assert tracker_of("hands=1")._second is None
    assert tracker_of("tracker.second_process=false")._second is None


def test_after_a_frame_that_failed_here_the_process_begins_anew(
    scene: TwoHands, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = tracker_of()
    assert asked(tracker, scene)
    process = process_of(tracker)
    wait_until_ready(process)
    first, begin, tasks = process._began, process.begin, list[tuple[Any, ...]]()

    def noted(*task: Any) -> Any:
        tasks.append(task)
        return begin(*task)

    monkeypatch.setattr(process, "begin", noted)
    stepped(tracker, scene, range(FRAMES))
    assert first is not None and process._began is first and not process._busy
    assert begin(*tasks[-1]) is not None, "and nobody waits for it"
    assert begin(*tasks[-1]) is None
    assert first.process.poll() is not None and process._began is not first


def test_it_ends_with_its_tracker(scene: TwoHands) -> None:
    process = SecondProcess({})
    assert process.begin(Quality(), cast(HandTask, None)) is None, "it is not ready yet"
    assert process._began is not None
    running = process._began.process
    assert running.poll() is None
    del process
    assert running.poll() is not None


def test_what_both_processes_have_is_named_and_not_sent() -> None:
    kept, new = torch.rand(2000), torch.rand(3)
    theirs = kept.clone()
    message = second_process._pickled((kept, new, None), (None, kept))
    got = second_process._unpickled(bytes(message), (None, theirs))
    assert got[0] is theirs and torch.equal(got[1], new) and got[2] is None
    assert len(message) < 1000


def test_a_hand_that_was_made_for_a_shape_arrives_as_the_one_made_there() -> None:
    model = right_hand_model()
    hand = model.made_hand("left", first_shape().applied)
    message = bytes(second_process._pickled([hand, hand]))
    assert second_process._unpickled(message, model=model) == [hand, hand]
    assert len(message) < 1000


def test_tensors_and_generators_arrive_as_they_were() -> None:
    generator = torch.Generator().manual_seed(3)
    sent = {"a": torch.arange(6.0).reshape(2, 3)[:, 1], "b": torch.tensor(True), "g": generator}
    one, other = multiprocessing.Pipe()
    one.send_bytes(second_process._pickled(sent))
    got = second_process._unpickled(other.recv_bytes())
    assert torch.equal(got["a"], sent["a"]) and bool(got["b"])
    assert torch.equal(torch.rand(5, generator=got["g"]), torch.rand(5, generator=generator))
