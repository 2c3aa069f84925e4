"""Training from nothing: the same from a seed, and by one command."""

import ctypes
import json
import os
import signal
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import programs
from helpers.tracking import ROOT

from toftrack.detector.crops import CROP
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.onnx_networks import OnnxFinder, OnnxPoseNet, load_networks
from toftrack.detector.weights import load_weights, save_weights
from toftrack.errors import ToftrackError
from toftrack.training import batches, checkpoints, descent, images
from toftrack.training.batches import Batches
from toftrack.training.checkpoints import Checkpoints, Progress
from toftrack.training.descent import Schedule, train_network
from toftrack.training.shapes import ShapeBank

TINY = Schedule(images=24, batch=8, rate=0.002, width=4)


def train_here(kind: type, schedule: Schedule, shapes: int, seed: int, *kept: Checkpoints) -> tuple:
    """On the CPU; kept: the checkpoints, which else are thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        (checkpoints,) = kept or (Checkpoints(Path(folder), 60),)
        return train_network(kind, schedule, shapes, seed, checkpoints, torch.device("cpu"))


train_poses, train_finder = partial(train_here, PoseNet), partial(train_here, Finder)


def same(one: torch.nn.Module, two: torch.nn.Module) -> None:
    for key, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[key]), key


@pytest.mark.slow
@pytest.mark.parametrize("train", [train_poses, train_finder])
def test_a_seed_gives_the_same_weights(train, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many processes make the images."""
    one, other = (train(TINY, 6, seed) for seed in (0, 1))
    monkeypatch.setattr(batches, "threads", lambda: 2)
    two = train(TINY, 6, 0)
    same(one[0], two[0])
    weights = [network.state_dict()["heads.weight"] for network, _ in (one, other)]
    assert not torch.equal(*weights)
    assert one[1][-1]["images"] == 24 and len(one[1]) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"images": 0}, "images=0 is not possible; give a whole number of at least 1, or 0 with"),
        ({"rate": 1.5}, "rate of a network must be between 0 and 1"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(change: dict, words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        Schedule(**{"images": 8, "batch": 8, "rate": 0.002, "width": 4, **change})


def test_no_images_leave_the_weights_of_a_start_as_they_are(tmp_path: Path) -> None:
    torch.manual_seed(0)
    finder = Finder(8)
    save_weights(tmp_path / "w.npz", PoseNet(4), finder, {})
    start = str(tmp_path / "w.npz")
    nothing = Schedule(0, 8, 0.002, 8, start, restart_images=24)
    same, course = train_finder(nothing, shapes=6, seed=0)
    assert course == []
    for key, value in finder.state_dict().items():
        torch.testing.assert_close(same.state_dict()[key], value, atol=1e-3, rtol=1e-3)


@pytest.mark.slow
def test_a_restart_ends_with_the_mean_of_both_ends(tmp_path: Path) -> None:
    """As two trainings do, of which the second begins from the first one's weights."""
    first, before = train_finder(TINY, 6, 0)
    save_weights(tmp_path / "w.npz", PoseNet(4), first, {})
    again = replace(TINY, rate=0.001, start=str(tmp_path / "w.npz"))
    second, _ = train_finder(again, 6, descent._RESTART_SEED)
    schedule = replace(TINY, restart_images=24, restart_rate=0.001)
    both, course = train_finder(schedule, 6, 0)
    moved = 0.0
    for key, value in both.state_dict().items():
        if value.is_floating_point():
            begun, end = first.state_dict()[key], second.state_dict()[key]
            torch.testing.assert_close(value, (begun + end) / 2, atol=1e-3, rtol=1e-3)
            moved = max(moved, float((value - begun).abs().max()))
    assert moved > 0.002
    assert [row["images"] for row in course] == [24, 48]
    assert course[0]["loss"] == before[0]["loss"] and course[1]["seconds"] > course[0]["seconds"]


def noise(n: int, _: ShapeBank, generator: torch.Generator) -> images.WideImages:
    """Instead of images, which take other processes seconds to begin with."""
    drawn = torch.rand(n, 2, CROP, CROP, generator=generator)
    return images.WideImages(drawn, drawn[:, :, 0], drawn[:, 0, 0], drawn[:, 1, 0])


def test_batches_are_those_of_their_numbers_whichever_process_makes_them() -> None:
    made = Batches(noise, 2, 6, 0)
    found = list(batches.made_batches(made, range(3, 6), 2))
    assert len(found) == 3 and found[0].image.dtype == torch.float16
    for number, batch in zip(range(3, 6), found, strict=True):
        for one, other in zip(batch, made[number], strict=True):
            assert np.array_equal(one.numpy(), other)
    assert not np.array_equal(made[3].image, made[4].image)


def ends(*_: object) -> None:
    os._exit(1)


def asked_to_end(n: int, bank: ShapeBank, generator: torch.Generator) -> images.WideImages:
    os.kill(os.getpid(), signal.SIGTERM)
    return noise(n, bank, generator)


def test_a_process_that_makes_batches_leaves_its_end_to_the_one_that_learns() -> None:
    made = batches.made_batches(Batches(asked_to_end, 2, 1, 0), range(2), 1)
    assert len(list(made)) == 2


def test_a_process_that_ends_while_it_makes_batches_is_an_error() -> None:
    ended = pytest.raises(ToftrackError, match="makes training images has ended")
    with ended, batches.makers_watched():
        next(batches.made_batches(Batches(ends, 2, 1, 0), range(2), 1))


def test_the_rate_rises_stays_and_falls_to_nothing() -> None:
    schedule = Schedule(images=30_000, batch=10, rate=0.002, width=4)
    rates = [schedule.rate_at(step) for step in range(schedule.steps)]
    assert rates[0] < 0.01 * 0.002 and rates == sorted(rates[:300]) + rates[300:]
    assert set(rates[300:2000]) == {0.002}
    falling = rates[2000:]
    assert falling == sorted(falling, reverse=True) and 0 < falling[-1] < 0.002 * 0.002


@pytest.mark.slow
def test_the_program_writes_weights_figures_and_a_summary(tmp_path: Path) -> None:
    sizes = ["poses.images=256", "finder.images=256", "poses.batch=32", "finder.batch=32"]
    sizes += ["poses.restart_images=64", "finder.restart_images=32"]
    sizes += ["shapes=6", "poses.width=4", "finder.width=8", f"hydra.run.dir='{tmp_path}'"]
    done = programs.python("-m", "toftrack.training", "train", *sizes)
    assert done.returncode == 0, done.stderr
    derived = ("detector.pose.onnx", "detector.finder.onnx")
    for name in ("detector.npz", *derived, "images.png", "course.png", "summary.json"):
        assert (tmp_path / name).stat().st_size > 0
        assert name in done.stdout
    about = load_weights(tmp_path / "detector.npz").about
    pose, finder = load_networks(tmp_path / "detector.npz")
    assert isinstance(pose, OnnxPoseNet) and isinstance(finder, OnnxFinder)
    assert (about["pose_images"], about["finder_images"], about["shapes"]) == (256, 256, 6)
    assert (about["pose_restart_images"], about["finder_restart_images"]) == (64, 32)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [summary[name][-1]["images"] for name in ("poses", "finder")] == [320, 288]
    assert "poses" in done.stderr and "finder" in done.stderr, "progress bars"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("shapes=0", "shapes"),
        ("poses.batch=0", "poses: batch"),
        ("poses.start=none.npz", "there are no weights of the detector at "),
        ("output=none/weights.npz", "output=none/weights.npz is not possible"),
    ],
)
def test_the_program_refuses_what_cannot_be_before_it_trains(
    given: str, said: str, tmp_path: Path
) -> None:
    program = str(ROOT / "toftrack" / "training" / "__main__.py")
    words = ("train", given, "hydra.run.dir=out")
    status, _, err = programs.call(*words, folder=tmp_path, program=program)
    assert status == 1
    assert err.splitlines()[-1].startswith(f"error: {said}")


class SwitchedOffError(Exception):
    """As if the machine were switched off."""


@pytest.mark.slow
@pytest.mark.parametrize("train", [train_poses, train_finder])
def test_a_training_that_was_interrupted_twice_ends_with_the_same_weights(
    train, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before its restart and in it."""
    folders = tmp_path_factory.mktemp
    schedule = replace(TINY, restart_images=24)
    whole, course = train(schedule, 6, 0, Checkpoints(folders("whole"), 1e-9))
    part = Checkpoints(folders("part"), 1e-9)
    interrupted(train, part, monkeypatch, after=2, schedule=schedule)
    more = Checkpoints(folders("more"), 1e-9, resume=part.folder)
    interrupted(train, more, monkeypatch, after=2, schedule=schedule)
    again = Checkpoints(folders("rest"), 1e-9, resume=more.folder)
    rest, other = train(schedule, 6, 0, again)
    same(whole, rest)
    one, two = ([row | {"seconds": 0} for row in rows] for rows in (course, other))
    assert one == two and len(one) == 2
    done, _ = train(schedule, 6, 0, Checkpoints(folders("end"), 1e-9, resume=again.folder))
    same(done, rest)


def interrupted(
    train,
    kept_in: Checkpoints,
    monkeypatch: pytest.MonkeyPatch,
    after: int,
    schedule: Schedule = TINY,
) -> None:
    """A training that ends after some batches, with a checkpoint."""
    kept = checkpoints.save

    def save(path: Path, progress: Progress, settings: dict) -> None:
        kept(path, progress, settings)
        if progress.step == after:
            raise SwitchedOffError

    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "save", save)
        with pytest.raises(SwitchedOffError):
            train(schedule, 6, 0, kept_in)


@pytest.mark.slow
def test_a_training_may_end_elsewhere_while_its_rate_has_not_begun_to_fall(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = tmp_path_factory.mktemp
    monkeypatch.setattr(descent, "_WARM", 1)
    more_images = replace(TINY, images=48)
    whole, _ = train_finder(more_images, 6, 0)
    early, late = (Checkpoints(folders(name), 1e-9) for name in ("early", "late"))
    interrupted(train_finder, early, monkeypatch, after=1)
    resumed = Checkpoints(folders("rest"), 1.0, resume=early.folder)
    rest, course = train_finder(more_images, 6, 0, resumed)
    assert course[-1]["images"] == 48
    same(whole, rest)
    interrupted(train_finder, late, monkeypatch, after=3)
    with pytest.raises(ToftrackError, match="finder.images can no longer change from 24 to 48"):
        train_finder(more_images, 6, 0, replace(resumed, resume=late.folder))


def test_a_system_without_glibc_keeps_its_memory_as_it_does(monkeypatch) -> None:
    def of_windows(name: None) -> None:
        raise TypeError("argument of type 'NoneType' is not iterable")

    monkeypatch.setattr(ctypes, "CDLL", of_windows)
    batches.keep_memory()
