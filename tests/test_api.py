"""toftrack in a program of one's own: the names, the configuration, images, several trackers."""

from __future__ import annotations

import dataclasses
import inspect
import pydoc
import subprocess
import sys
import threading
import typing
from functools import cache
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from helpers.hands import hand_estimate, lost_hand
from helpers.tracking import sample
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

import toftrack
from toftrack.configuration.compose import configuration
from toftrack.frames.estimate import no_estimate

QUICK = ("filter.particles=100",)


def test_importing_toftrack_is_light_until_a_name_is_used(tmp_path: Path) -> None:
    heavy = ("torch", "numba", "hydra", "cv2", "numpy", "scipy")
    code = f"""
import sys, toftrack
print([name for name in {heavy} if name in sys.modules])
print(toftrack.__all__ == dir(toftrack))
print(toftrack.__version__)
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == ["[]", "True", toftrack.__version__], done.stderr


def test_tracking_in_a_notebook_loads_no_progress_bar_that_warns_there(tmp_path: Path) -> None:
    code = """
import sys, toftrack
toftrack.track("device=sample", "device.stop=1").results()
print("tqdm.auto" in sys.modules)
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.stdout == "False\n", done.stderr


def test_every_stable_name_is_there_and_no_other() -> None:
    for name in toftrack.__all__:
        assert getattr(toftrack, name) is not None, name
    with pytest.raises(AttributeError, match="no attribute 'make_racket'"):
        _ = toftrack.make_racket


def test_a_tracker_of_two_hands_gives_an_estimate_a_slot() -> None:
    scene, tracker = sample(), toftrack.make_hands_tracker("hands=2", *QUICK)
    estimates = tracker.step(scene.depth_m[30], scene.k)
    assert len(estimates) == len(tracker.shapes) == len(tracker.insights) == 2
    assert not all(estimate.lost for estimate in estimates)
    assert {estimate.index for estimate in estimates} == {0}
    with pytest.raises(toftrack.ToftrackError, match="make_hands_tracker follows several"):
        toftrack.make_tracker("hands=2")


@pytest.mark.parametrize(
    ("estimate", "said"),
    [
        (
            hand_estimate(30),
            "frame 30, 1.200 s: right hand, wrist at -0.020 0.080 0.500 m, 90 % sure, palm",
        ),
        (
            hand_estimate(0).updated(gesture="", side=""),
            "frame 0, 0.000 s: hand, wrist at -0.050 0.080 0.500 m, 90 % sure",
        ),
        (
            hand_estimate(1, pinching=True, joint_ok=np.arange(21) > 1),
            "palm, pinching, 2 joints not ok",
        ),
        (lost_hand(2), "frame 2, 0.080 s: lost, no hand found"),
    ],
)
def test_an_estimate_prints_itself_in_a_line(estimate: toftrack.Estimate, said: str) -> None:
    assert f"{estimate}".endswith(f"{said}>") and repr(estimate) == str(estimate)


def test_a_misspelled_field_is_reported() -> None:
    with pytest.raises(TypeError, match="joint_m"):
        hand_estimate(0).updated(joint_m=NOWHERE)


def test_three_lines_track(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scene = sample()
    tracker = toftrack.make_tracker(*QUICK)
    found = [tracker.step(depth_m, scene.k) for depth_m in scene.depth_m[:6]]
    assert isinstance(found[0], toftrack.Estimate)
    assert [estimate.index for estimate in found] == list(range(6))
    times = [estimate.timestamp_s for estimate in found]
    assert times == sorted(times) and times[0] < times[-1]
    error = np.linalg.norm(found[-1].joints_m - scene.joints_m[5], axis=-1)
    assert error.mean() < 0.02
    assert not list(tmp_path.iterdir()), "nothing is written"


def test_frames_count_on_from_a_given_index_and_over_missing_hands() -> None:
    tracker = toftrack.make_tracker()
    nothing, k = np.zeros((30, 40), np.float32), np.array([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    indices = [tracker.step(nothing, k, index).index for index in (None, None, 7, None)]
    assert indices == [0, 1, 7, 8]
    assert tracker.step(nothing, k, timestamp_s=3.5).timestamp_s == 3.5


def test_an_image_of_any_floating_type_and_layout_gives_the_same_hand() -> None:
    scene = sample()
    depth = scene.depth_m[0]
    holes = np.where(depth > 0, depth, np.nan)
    masked = np.ma.masked_array(np.where(depth > 0, depth, 0.4), depth <= 0)
    other = (depth.astype(np.float64), np.asfortranarray(depth), torch.from_numpy(holes), masked)
    kinds = (depth, *other)
    joints = [toftrack.make_tracker(*QUICK).step(kind, scene.k).joints_m for kind in kinds]
    assert np.isfinite(joints[0]).all()
    assert all(np.array_equal(joints[0], other) for other in joints[1:])


K = [[200.0, 0, 20], [0, 200.0, 15], [0, 0, 1]]
METRES = np.full((30, 40), 0.6, np.float32)


@pytest.mark.parametrize(
    ("depth", "k", "words"),
    [
        (METRES * 1000, K, "plainly millimetres"),
        (METRES * 10000, K, "neither metres nor millimetres"),  # as a D405 counts
        (np.zeros((30, 40), np.uint16), K, "(uint16), of which none is a reading"),
        (METRES > 0, K, "float32 metres, but is bool"),
        (METRES[None], K, "(1, 30, 40)"),
        ([[0.1, 0.2], [0.3]], K, "NumPy arrays"),
        (METRES, np.eye(4), "K must be 3x3"),
        (METRES, np.full((3, 3), np.nan), "NaN"),
        (METRES, "camera", "K must"),
    ],
)
def test_a_bad_image_or_matrix_is_one_clear_sentence(depth: object, k: object, words: str) -> None:
    with pytest.raises(toftrack.ToftrackError) as caught:
        _tracker().step(depth, k)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@cache
def _tracker() -> toftrack.Tracker:
    return toftrack.make_tracker()


def test_a_bad_image_does_not_disturb_the_track() -> None:
    scene = sample()
    tracker = toftrack.make_tracker(*QUICK)
    before = [tracker.step(scene.depth_m[i], scene.k) for i in range(3)][-1]
    with pytest.raises(toftrack.ToftrackError):
        tracker.step(scene.depth_m[3] * 1000, scene.k)
    after = tracker.step(scene.depth_m[3], scene.k)
    assert (before.index, after.index, after.state_name) == (2, 3, "tracking")


def test_an_estimate_changed_in_place_does_not_change_the_next_one() -> None:
    scene, tracker = sample(), toftrack.make_tracker(*QUICK)
    estimate = tracker.step(scene.depth_m[0], scene.k)
    found = estimate.joints_m.copy()
    estimate.joints_m[:] = 0
    lost = tracker.step(np.zeros_like(scene.depth_m[0]), scene.k)
    assert lost.lost and np.array_equal(lost.joints_m, found), "the last one stands"


def test_a_configuration_of_one_s_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "config.yaml").write_text("seed: 5\n")
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, ""):
        assert configuration("seed=6", config_dir=folder) == {"seed": 6}
    with pytest.raises(toftrack.ToftrackError, match="no config.yaml in the folder"):
        toftrack.make_tracker(config_dir=tmp_path / "gone")


def test_a_hydra_application_around_us_keeps_its_own_state(tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text("mine: 1\n")
    with initialize_config_dir(str(tmp_path), job_name="mine", version_base="1.2"):
        own = GlobalHydra.instance().hydra
        assert configuration().seed == 0
        assert GlobalHydra.instance().hydra is own
        assert hydra.version.getbase() == hydra.version._get_version("1.2")
        assert compose("app", return_hydra_config=True).hydra.job.name == "mine"
    assert not GlobalHydra.instance().is_initialized()


def test_a_failure_leaves_hydra_as_it_was() -> None:
    with pytest.raises(toftrack.ToftrackError):
        configuration("nope=1")
    assert not GlobalHydra.instance().is_initialized()
    assert configuration().seed == 0


def test_trackers_in_threads_do_not_disturb_each_other() -> None:
    scene = sample()

    def follow(seed: int, found: dict[int, np.ndarray]) -> None:
        tracker = toftrack.make_tracker(f"seed={seed}", *QUICK)
        steps = [tracker.step(scene.depth_m[i], scene.k, i, i / 25) for i in range(6)]
        found[seed] = np.stack([estimate.joints_m for estimate in steps])

    alone: dict[int, np.ndarray] = {}
    together: dict[int, np.ndarray] = {}
    for seed in (1, 2):
        follow(seed, alone)
    workers = [threading.Thread(target=follow, args=(seed, together)) for seed in (1, 2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not np.array_equal(alone[1], alone[2])
    for seed in (1, 2):
        assert np.array_equal(alone[seed], together[seed])


def test_help_shows_every_field_with_what_is_written_below_it() -> None:
    shown = inspect.getdoc(toftrack.Estimate) or ""
    for field in dataclasses.fields(toftrack.Estimate):
        assert f"\n    {field.name}: " in shown
        below = shown.split(f"\n    {field.name}: ")[1].splitlines()[1]
        assert below.startswith(" " * 8) and len(below.split()) > 2, field.name
    assert "(21, 3) float32 metres, camera frame" in shown
    assert typing.get_type_hints(toftrack.Estimate)["landmarks"] is np.ndarray
    assert "lambda" not in pydoc.render_doc(toftrack.Estimate), "nor its place in memory"


@pytest.mark.parametrize("kind", ["depth", "amplitude", "colours"])
def test_a_skeleton_is_drawn_where_the_hand_is(kind: str) -> None:
    scene, estimate = sample().cut(0), _estimate()
    image = {
        "depth": scene.depth_m[0],
        "amplitude": (1000 * scene.depth_m[0]).astype(np.uint16),
        "colours": np.full((*scene.depth_m[0].shape, 3), 128, np.uint8),
    }[kind]
    before = toftrack.draw(image, dataclasses.replace(estimate, joints_m=NOWHERE), scene.k)
    picture = toftrack.draw(image, estimate, scene.k)
    rows, columns = np.nonzero((picture != before).any(-1))
    scale = picture.shape[1] / image.shape[1]
    pixels = scene.joints_m[0] @ scene.k.T
    pixels = scale * pixels[:, :2] / pixels[:, 2:]
    reached = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
    assert np.abs(reached - [*pixels.min(0), *pixels.max(0)]).max() < 6 * scale
    lost = toftrack.draw(image, dataclasses.replace(estimate, lost=True), scene.k, scale=1)
    assert lost.shape == (*image.shape[:2], 3)
    assert lost[0, 0, 0] > lost[0, 0, 2], "red is first"


def test_what_cannot_be_drawn_is_reported() -> None:
    scene, estimate = sample(), _estimate()
    with pytest.raises(toftrack.ToftrackError, match="of the shape \\(3,\\)"):
        toftrack.draw(np.zeros(3), estimate, scene.k)
    with pytest.raises(toftrack.ToftrackError, match="scale=0"):
        toftrack.draw(scene.depth_m[0], estimate, scene.k, scale=0)
    small = toftrack.Camera(np.array([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), 40, 30)
    with pytest.raises(toftrack.ToftrackError, match="but the camera 40x30"):
        toftrack.draw(scene.depth_m[0], estimate, small)


NOWHERE = np.full((21, 3), np.nan, np.float32)


def _estimate() -> toftrack.Estimate:
    """The truth of the sample's first frame."""
    joints = sample().joints_m[0].astype(np.float32)
    nothing = no_estimate(0, 0.0, "tracking", 4, 0.0)
    return dataclasses.replace(nothing, lost=False, joints_m=joints)
