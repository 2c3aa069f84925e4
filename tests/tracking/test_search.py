"""The first hypotheses: by hand, at the nearest blob, or searched anywhere in it."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import roma
import torch
from helpers.configured import f_measure, nearest_surface, rough_start, search_start
from helpers.tracking import Scene, configuration, sample

from toftrack.compute.rigid import MOTIONS, rotated_pivot
from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES, forward_kinematics
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.files import make_pose_space
from toftrack.render.segmentation import Observation
from toftrack.tracking.backend import make_scorer
from toftrack.tracking.palm_places import arm_exits, palm_centres
from toftrack.tracking.search import (
    LastSeen,
    LogScores,
    Sought,
    Start,
)

pytestmark = pytest.mark.usefixtures("one_thread")


PALM = [JOINT_NAMES.index(name) for name in ("wrist", "index_mcp", "middle_mcp", "little_mcp")]


@cache
def pose_space() -> PoseSpace:
    return make_pose_space()


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def observed(scene: Scene, frame: int = 0) -> Observation:
    return nearest_surface()(scene.depth_m[frame], scene.k)


def states_of(particles: torch.Tensor) -> torch.Tensor:
    return torch.cat((particles[:, :6], pose_space().decode(particles[:, 6:])), 1)


def log_scores_of(seen: Observation, shape: HandShape) -> LogScores:
    head = f_measure(coverage=0.0)
    evidence, scorer = head.evidence(seen), make_scorer("auto", shape, torch.device("cpu"))
    return lambda x, coverage: head.log_score(scorer(states_of(x), evidence), coverage)


def unscored(x: torch.Tensor, coverage: float) -> torch.Tensor:
    raise AssertionError("nothing is to be scored")


def unimproved(x: torch.Tensor) -> torch.Tensor:
    """The search alone, without Gauss-Newton's help."""
    return x


def sought(seen: Observation, scores: LogScores = unscored) -> Sought:
    return Sought(seen, pose_space(), MOTIONS, scores, unimproved, None)


def first_error_mm(start: Start, scene: Scene, seed: int, side: str = "right") -> float:
    """Mean joint error of the particles' mean on the first frame."""
    shape = default_hand_shape(side=side)
    seen = observed(scene)
    scores = log_scores_of(seen, shape)
    particles = start(sought(seen, scores), 50, generator(seed))
    mean = MOTIONS.mean(particles, torch.full((50,), 0.02))
    joints = forward_kinematics(states_of(mean), shape).joints_m[0].numpy()
    return 1e3 * float(np.linalg.norm(joints - scene.joints_m[0], axis=-1).mean())


@pytest.mark.parametrize("seed", range(4))
def test_the_search_finds_the_hand_with_any_seed(seed: int) -> None:
    assert first_error_mm(search_start(), sample().cut(0), seed) < 20


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_the_search_finds_a_hand_that_is_turned_in_the_image(quarters: int) -> None:
    scene = sample().cut(0).turned(quarters)
    assert first_error_mm(search_start(), scene, seed=0) < 20


def test_the_search_finds_a_left_hand_in_the_mirrored_image() -> None:
    assert first_error_mm(search_start(), sample().cut(0).mirrored(), 0, "left") < 20


def test_the_search_finds_most_hands_that_turn_away_from_the_camera() -> None:
    found = [first_error_mm(search_start(), sample().cut(f), seed=1) for f in range(0, 60, 10)]
    assert sum(error < 30 for error in found) >= 5, found


def test_the_search_beats_the_best_of_as_many_unrefined_hypotheses() -> None:
    seen = observed(sample().cut(0))
    scores = log_scores_of(seen, default_hand_shape())
    search = search_start(hypotheses=1000, samples=256)
    found = search(sought(seen, scores), 50, generator())
    drawn = search._draw(seen, pose_space(), None, generator())
    assert scores(found, 1.0).max() > scores(drawn, 1.0).max() + 0.1


@pytest.mark.parametrize("start", [search_start(hypotheses=200, samples=64), rough_start()])
def test_as_many_particles_as_asked_for_inside_the_pose_space(start: Start) -> None:
    seen = observed(sample().cut(0))
    space = pose_space()
    scores = log_scores_of(seen, default_hand_shape())
    one, two = (start(sought(seen, scores), 37, generator(5)) for _ in range(2))
    assert one.shape == (37, 6 + space.dims)
    assert one.isfinite().all()
    assert (one[:, 6:] >= space.lower - 1e-5).all() and (one[:, 6:] <= space.upper + 1e-5).all()
    assert torch.equal(one, two), "the generator alone decides"


def test_a_pose_given_by_hand_is_where_the_particles_are() -> None:
    pose = (0.05, -0.02, 0.6, 0.3, -0.4, 1.2)
    start = rough_start(pose=pose, position_m=0.01, rotation_rad=0.1)
    n = 4000
    seen = observed(sample().cut(0))
    x = start(sought(seen), n, generator())
    reference = torch.cat((torch.tensor(pose), x[0, 6:]))[None]
    off = MOTIONS.difference(x, reference)[:, :6]
    sigma = torch.tensor([0.01] * 3 + [0.1] * 3)
    # Five standard errors of a mean and of a standard deviation from n draws each, six times: all
    # hold with a probability above 0.9999.
    assert (off.mean(0).abs() < 5 * sigma / math.sqrt(n)).all()
    assert ((off.std(0) / sigma - 1).abs() < 5 / math.sqrt(2 * n)).all()
    palm = pose_space().training_labels.index("palm")
    assert (x[:, 6:] == pose_space().training_latents[palm]).all(), "an open palm"


def test_rough_positioning_puts_an_open_palm_on_the_nearest_blob() -> None:
    scene = sample().cut(0)
    seen = observed(scene)
    x = rough_start()(sought(seen), 300, generator())
    middle = (x[:, :3] + rotated_pivot(x[:, 3:6])).mean(0).numpy()
    true_palm = scene.joints_m[0, PALM].mean(0)
    assert np.linalg.norm(middle - true_palm) < 0.06
    mean = MOTIONS.mean(x, torch.full((300,), 1 / 300))
    joints = forward_kinematics(states_of(mean), default_hand_shape()).joints_m[0]
    tips = joints[[8, 12, 16, 20]]
    assert (tips[:, 1] < joints[0, 1] - 0.1).all(), "the fingers point up"
    assert float(mean[0, 3:6].norm()) < 0.05


@pytest.mark.parametrize("pose", [(), (0.0, 0.0, 0.5), (0.0,) * 7])
def test_a_pose_that_is_not_six_numbers_is_refused(pose: tuple[float, ...]) -> None:
    with pytest.raises(ToftrackError, match=f"start.pose has {len(pose)} numbers"):
        rough_start(pose=pose)


def test_a_pose_can_be_given_on_the_command_line() -> None:
    import hydra

    config = configuration("start=rough", "start.pose=[0,0.1,0.5,0,0,0]")
    start = hydra.utils.instantiate(config.start)
    x = start(sought(observed(sample().cut(0))), 100, generator())
    assert float((x[:, :3].mean(0) - torch.tensor([0, 0.1, 0.5])).norm()) < 0.02


@pytest.mark.parametrize("frame", range(0, 100, 20))
def test_palm_centres_lie_on_the_hand_and_often_in_its_palm(frame: int) -> None:
    scene = sample().cut(frame)
    centres = palm_centres(observed(scene), 400, generator(frame))
    off = np.linalg.norm(centres - scene.joints_m[0, PALM].mean(0), axis=1)
    assert (off < 0.35).all()
    # No farther than the fingertips and the forearm beside the wrist, except for those that follow
    # the arm out of the image, a third at most.
    assert (off < 0.2).mean() > 0.6
    # One in five is plenty for thousands of hypotheses. It is above a quarter in every frame here,
    # from which 400 draws do not fall below 0.19 with a probability above 0.999.
    assert (off < 0.06).mean() > 0.19


@pytest.mark.parametrize("behind_m", [0.08, 0.12, 0.17])
def test_palm_centres_are_never_on_a_wall_behind_the_hand(behind_m: float) -> None:
    scene = sample().cut(0)
    hand = observed(scene).hand.numpy()
    depth = scene.depth_m[0].copy()
    wall_m = float(depth[hand].min()) + behind_m
    depth[~hand | (depth > wall_m)] = wall_m
    beside = 100  # pixels of wall on all sides
    depth = np.pad(depth, beside, constant_values=wall_m)
    k = scene.k.copy()
    k[:2, 2] += beside
    seen = nearest_surface(max_pixels=depth.size)(depth, k)
    assert seen.hand.float().mean() > 0.99, "the wall is taken for a part of the hand"
    centres = palm_centres(seen, 2000, generator())
    # What is seen of the wall between two fingers may be taken for something narrow.
    on_the_wall = centres[:, 2] > wall_m - 0.005
    assert on_the_wall.mean() < 0.1
    palm = scene.joints_m[0, PALM].mean(0)
    assert (np.linalg.norm(centres[on_the_wall, :2] - palm[:2], axis=1) < 0.17).all()


def test_a_surface_that_is_all_wall_still_gives_points_on_it() -> None:
    depth = np.full((60, 80), 0.5, np.float32)
    k = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    seen = nearest_surface()(depth, k)
    centres = palm_centres(seen, 100, generator())
    assert centres.shape == (100, 3) and np.isfinite(centres).all()
    assert centres[:, 2] == pytest.approx(0.5, abs=0.03)


def test_the_arm_leaves_the_image_where_the_true_wrist_points_to() -> None:
    """In the sample the arm comes from below; in the turned images from the other sides."""
    for quarters in range(4):
        scene = sample().cut(0).turned(quarters)
        wrist, middle = scene.joints_m[0, 0], scene.joints_m[0, 9]
        exits = arm_exits(observed(scene), 50, generator())
        way, arm = exits - wrist, wrist - middle
        cosine = way[:, :2] @ arm[:2] / np.linalg.norm(way[:, :2], axis=1)
        assert (cosine / np.linalg.norm(arm[:2]) > math.cos(math.radians(45))).all()
        u, v = (exits @ scene.k.T)[:, :2].T / exits[:, 2]
        height, width = scene.depth_m.shape[1:]
        assert (np.minimum(np.minimum(u, v), np.minimum(width - 1 - u, height - 1 - v)) < 3).all()


def test_a_blob_inside_the_image_has_no_arm_that_leaves_it() -> None:
    depth = np.zeros((60, 80), np.float32)
    depth[20:40, 30:50] = 0.5
    k = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    assert arm_exits(nearest_surface()(depth, k), 5, generator()) is None


def test_hypotheses_of_the_search_point_along_the_arm_mostly_but_anywhere_too() -> None:
    scene = sample().cut(0)
    seen = observed(scene)
    x = search_start(hypotheses=3000)._draw(seen, pose_space(), None, generator())
    down = roma.rotvec_to_rotmat(x[:, 3:6])[:, :, 1].numpy()  # from the fingers to the wrist
    arm = scene.joints_m[0, 0] - scene.joints_m[0, 9]
    angle = np.degrees(
        np.arccos(
            (down[:, :2] @ arm[:2] / np.linalg.norm(arm[:2]) / np.hypot(*down[:, :2].T)).clip(-1, 1)
        )
    )
    assert (angle < 60).mean() > 0.6
    # A fifth point anywhere in the plane: a quarter of those away from the arm, 5 % of all. With
    # 3000 draws more than 2.5 % are seen with a probability above 0.9999.
    assert (angle > 135).mean() > 0.025
    facing = roma.rotvec_to_rotmat(x[:, 3:6])[:, 2, 2]
    assert 0.4 < float((facing > 0).float().mean()) < 0.6, "palms and backs alike"


def test_a_palm_is_also_looked_for_beyond_the_border_that_cuts_the_hand() -> None:
    scene = sample().cut(0)
    palm = scene.joints_m[0, PALM].mean(0)
    u = int(scene.k[0, 0] * palm[0] / palm[2] + scene.k[0, 2])
    left = scene.depth_m[0][:, : u - 8]  # the middle of the palm lies outside
    centres = palm_centres(nearest_surface()(left, scene.k), 1000, generator())
    pixels = scene.k[0, 0] * centres[:, 0] / centres[:, 2] + scene.k[0, 2]
    beyond = pixels > left.shape[1]
    assert 0.02 < beyond.mean() < 0.4
    assert (np.linalg.norm(centres - palm, axis=1) < 0.04).any()


def test_a_hand_as_last_seen_is_preferred_and_forgotten_with_time() -> None:
    seen = observed(sample().cut(0))
    before = torch.zeros(1, 10)
    before[:, 2] = 0.5
    turned = before.clone()
    turned[:, 5] = 3.0
    start = search_start(forearm=0.0)
    both = torch.cat((before, turned))

    def gain(age_s: float) -> float:
        same, other = start.prior(seen, LastSeen(before, age_s))(both)
        return float(same - other)

    assert gain(0.0) == pytest.approx(start.memory, abs=0.01)
    assert gain(start.memory_s) == pytest.approx(start.memory / math.e, abs=0.01)
    assert not start.prior(seen, None)(both).any()
    assert not rough_start().prior(seen, LastSeen(before, 0.0))(both).any()


def test_a_quarter_of_the_hypotheses_is_turned_and_bent_as_the_hand_last_seen() -> None:
    seen = observed(sample().cut(0))
    last = LastSeen(torch.tensor([[0, 0, 0.5, 0, 0, 2.5, 0.1, 0.1, 0.1, 0.1]]), 1.0)
    search = search_start(hypotheses=400)
    alike = (search._draw(seen, pose_space(), last, generator())[:, 6:] == 0.1).all(1)
    assert int(alike.sum()) == 100
    old = LastSeen(last.particle, 10.0)
    assert not (search._draw(seen, pose_space(), old, generator())[:, 6:] == 0.1).all(1).any()
