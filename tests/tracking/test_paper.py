"""The paper's tracker: its rough start, its step, its parts, and every pose space with it."""

import math

import numpy as np
import pytest
import torch
from helpers.settings import nearest_surface, rough_start
from helpers.tracking import Scene, configuration, errors_mm, first, follow, make_tracker, sample
from omegaconf import OmegaConf

from toftrack.compute.rigid import MOTIONS, rotated_pivot
from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.refinement.shape_fit import first_shape
from toftrack.render.segmentation import Observation
from toftrack.tracking.model import FilterModel
from toftrack.tracking.paper import PaperModel, RoughStart, ScoreThreshold, palm_centre
from toftrack.tracking.state import Track

PALM = [JOINT_NAMES.index(name) for name in ("wrist", "index_mcp", "middle_mcp", "little_mcp")]
PAPER = ("experiment=paper", "filter.particles=50")


def observed(scene: Scene) -> Observation:
    return nearest_surface()(scene.depth_m[0], scene.k)


def begun(start: RoughStart, n: int = 300, seed: int = 0) -> tuple[FilterModel, Track]:
    model = make_tracker("experiment=paper", f"filter.particles={n}").model
    return model, start(observed(first(1)), model, torch.Generator().manual_seed(seed))


def test_a_start_has_as_many_particles_as_asked_for_inside_the_pose_space() -> None:
    (model, one), (_, two) = (begun(rough_start(), n=37, seed=5) for _ in range(2))
    x, space = one.cloud.particles, model.space
    assert x.shape == (37, 6 + space.dims) and x.isfinite().all()
    assert (x[:, 6:] >= space.lower - 1e-5).all() and (x[:, 6:] <= space.upper + 1e-5).all()
    assert torch.equal(x, two.cloud.particles), "the generator alone decides"


def test_a_pose_given_by_hand_is_where_the_particles_are() -> None:
    pose = (0.05, -0.02, 0.6, 0.3, -0.4, 1.2)
    n = 4000
    model, track = begun(rough_start(pose=pose, position_m=0.01, rotation_rad=0.1), n)
    x = track.cloud.particles
    reference = torch.cat((torch.tensor(pose), x[0, 6:]))[None]
    off = MOTIONS.difference(x, reference)[:, :6]
    sigma = torch.tensor([0.01] * 3 + [0.1] * 3)
    # Five standard errors of a mean and of a standard deviation from n draws each, six times: all
    # hold with a probability above 0.9999.
    assert (off.mean(0).abs() < 5 * sigma / math.sqrt(n)).all()
    assert ((off.std(0) / sigma - 1).abs() < 5 / math.sqrt(2 * n)).all()
    palm = model.space.training_labels.index("palm")
    assert (x[:, 6:] == model.space.training_latents[palm]).all(), "an open palm"


def test_rough_positioning_puts_an_open_palm_on_the_nearest_blob() -> None:
    scene = first(1)
    model, track = begun(rough_start())
    middle = (
        (track.cloud.particles[:, :3] + rotated_pivot(track.cloud.particles[:, 3:6]))
        .mean(0)
        .numpy()
    )
    assert np.linalg.norm(middle - scene.joints_m[0, PALM].mean(0)) < 0.06
    mean = MOTIONS.mean(track.cloud.particles, torch.full((300,), 1 / 300))
    hand = model.hand("right", first_shape())
    joints = hand.refiner.joints(model.decode(mean))[0]
    tips = joints[[8, 12, 16, 20]]
    assert (tips[:, 1] < joints[0, 1] - 0.1).all(), "the fingers point up"
    assert float(mean[0, 3:6].norm()) < 0.05


@pytest.mark.parametrize("pose", [(), (0.0, 0.0, 0.5), (0.0,) * 7])
def test_a_pose_that_is_not_six_numbers_is_refused(pose: tuple[float, ...]) -> None:
    with pytest.raises(ToftrackError, match=f"start.pose has {len(pose)} numbers"):
        rough_start(pose=pose)


def test_the_palm_is_mostly_expected_where_it_is_and_else_on_the_wrist_or_arm() -> None:
    scenes = [sample().cut(frame) for frame in range(0, 100, 5)]
    centres = np.stack([palm_centre(observed(scene)) for scene in scenes])
    assert centres.shape == (20, 3) and centres.dtype == np.float32
    palms = np.stack([scene.joints_m[0, PALM].mean(0) for scene in scenes])
    off_m = np.linalg.norm(centres - palms, axis=1)
    # The middle of all the pixels is 0.038 off.
    assert np.median(off_m) < 0.033 and off_m.max() < 0.2


def test_a_surface_that_is_all_wall_still_has_a_place_on_it() -> None:
    k = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    seen = nearest_surface()(np.full((60, 80), 0.5, np.float32), k)
    assert palm_centre(seen)[2] == pytest.approx(0.5, abs=0.03)


def test_the_estimate_is_the_filters_mean_and_nothing_else() -> None:
    scene, tracker = first(4), make_tracker(*PAPER)
    for i, depth in enumerate(scene.depth_m):
        estimate = tracker.step(depth, scene.k, i, i / 25)
        mean = tracker.model.decode(tracker.track.cloud.mean)[0].numpy()
        assert np.array_equal(estimate.state, mean)
        assert (estimate.side, estimate.side_probability) == ("right", 1.0)
        assert math.isnan(estimate.confidence), "nobody says"


def test_the_paper_s_system_differs_from_print_in_what_is_said() -> None:
    letter = OmegaConf.to_container(configuration("experiment=paper_to_the_letter"))
    sharpened = OmegaConf.to_container(configuration("experiment=paper"))
    sharpened["filter"]["exponent"], sharpened["likelihood"]["naming"] = 1.0, "printed"
    sharpened["filter"]["spread"]["latent"] = letter["filter"]["spread"]["latent"]
    assert sharpened == letter


@pytest.mark.parametrize("space", ["pca", "kernel_pca", "lle", "isomap"])
def test_the_sample_is_followed_in_every_pose_space(space: str) -> None:
    given = {"kernel_pca": ("pose_space.gamma=0.1",)}.get(space, ())
    given = ("pose_space.neighbours=8",) if space in ("lle", "isomap") else given
    scene = first(25)
    errors = errors_mm(follow(scene, "experiment=paper", f"pose_space={space}", *given), scene)
    assert errors.mean() < 25 and errors.max() < 50


def test_an_empty_image_does_not_end_the_track() -> None:
    tracker, scene = make_tracker(*PAPER), first(3)
    tracker.step(scene.depth_m[0], scene.k, 0, 0.0)
    followed = tracker.track
    assert followed is not None
    nothing = tracker.step(np.zeros_like(scene.depth_m[0]), scene.k, 1, 0.04)
    assert nothing.lost and tracker.state.tracks == (followed,)
    again = tracker.step(scene.depth_m[2], scene.k, 2, 0.08)
    assert not again.lost and again.state_name == "tracking"


def test_a_low_score_is_flagged_and_changes_nothing() -> None:
    scene = first(6)
    usual, flagged = follow(scene, *PAPER), follow(scene, *PAPER, "lost.score=1.0")
    assert usual[0].state_name == "initialising" and not any(one.lost for one in usual)
    assert {one.state_name for one in flagged} == {"recovering"} and flagged[-1].lost
    for one, other in zip(usual, flagged, strict=True):
        assert np.array_equal(one.joints_m, other.joints_m)


def test_the_paper_to_the_letter_runs_and_is_the_paper_s() -> None:
    config = configuration("experiment=paper_to_the_letter")
    assert (config.filter.particles, config.filter.passes, config.filter.exponent) == (300, 1, 1)
    assert (config.filter.bounds, config.filter.velocity) == ("truncate", 0)
    head = config.likelihood
    assert (head.beta, head.naming, head.tolerance_m) == (1.5, "printed", 0.02)
    assert (head.residual_weight, head.coverage) == (0, 0)
    assert (config.hand.shape, config.hand.side) == ("default", "right")
    assert config.segmentation.min_area_m2 == config.segmentation.occluder_margin_m == 0
    assert config.segmentation.reach_m == math.inf and config.refine.iterations == 0
    assert config.pose_space.kind == "pca" and config.pose_space.dims == 4
    model = make_tracker("experiment=paper_to_the_letter").model
    assert isinstance(model, PaperModel) and not (model.fits or model.detects)
    assert isinstance(model.start, RoughStart) and isinstance(model.lost, ScoreThreshold)
    scene = first(8)
    found = follow(scene, "experiment=paper_to_the_letter")
    assert all(np.isfinite(one.joints_m).all() and 0 < one.score <= 1 for one in found)
    # Positioned by hand, as in the paper, and nearly right: it does not run away at once.
    wrist = ",".join(f"{x:.3f}" for x in (*scene.joints_m[0, 0], 0, 0, 0))
    placed = follow(scene, "experiment=paper_to_the_letter", f"start.pose=[{wrist}]")
    assert errors_mm(placed, scene).max() < 60


def test_a_left_hand_is_the_mirror_image_of_a_right_one() -> None:
    scene = first(5).mirrored()
    found = follow(scene, "experiment=paper", "hand.side=left")
    assert found[-1].side == "left" and errors_mm(found, scene)[-1] < 40
