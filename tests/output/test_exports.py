"""A run as glTF: read back with the format's own rules, and compared with the run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.animation import Gltf
from helpers.hands import hand_estimate, lost_hand
from scipy.spatial.transform import Rotation

from toftrack.frames.estimate import Estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.output.exports import glb_of, hand_mesh, motions_of
from toftrack.output.run_folder import Run

NAMES = (
    *("timestamp_s", "lost", "side", "joints_m", "state"),
    *("openxr_position_m", "openxr_orientation"),
)


def run_of(estimates: list[Estimate], shape: HandShape) -> Run:
    results = {name: np.array([getattr(one, name) for one in estimates]) for name in NAMES}
    return Run(Path(), results, np.arange(len(estimates)), {}, (shape,))


def moving(side: str = "right", lost: tuple[int, ...] = ()) -> list[Estimate]:
    """Eight frames of a hand that moves and closes."""
    hands = [hand_estimate(index, side, bent=0.2 * index) for index in range(8)]
    return [replace(hand, lost=hand.index in lost) for hand in hands]


def exported(estimates: list[Estimate], side: str) -> Gltf:
    pytest.importorskip("pygltflib", reason="pip install '.[export]'")
    return Gltf(glb_of(motions_of(run_of(estimates, default_hand_shape(side=side)))))


def test_joints_are_where_they_were_before_the_hand_was_fitted() -> None:
    first, *_ = estimates = moving()  # as long as hands are on average
    (motion,) = motions_of(run_of(estimates, default_hand_shape(0.17)))
    wrist, metacarpal = map(OPENXR_JOINT_NAMES.index, ("wrist", "little_metacarpal"))
    turned = Rotation.from_quat(motion.turn[0, wrist])
    place = motion.offset_m[0, wrist] + turned.apply(motion.offset_m[0, metacarpal])
    assert np.allclose(place, first.openxr_position_m[metacarpal], atol=2e-6)


@pytest.mark.parametrize(
    "times",
    [
        [0, 0.04, 0.08, 0.12, 1.7e9, 1.7e9 + 0.04],  # the clock was set
        [4294.9, 4294.94, 0.01, 0.05, 0.09, 0.13],  # 32 bits of microseconds
        [0, 0, 0.08, 0.08, 0.16, 0.16, 0.24],  # one stamp for two frames
        [0, 0.04, 0.08, 60.0, 60.04, 0.01, 0.05],  # plugged in again after a minute
    ],
)
def test_a_clock_that_errs_leaves_frames_of_even_length(times: list[float]) -> None:
    estimates = [replace(one, timestamp_s=at) for one, at in zip(moving(), times, strict=False)]
    (motion,) = motions_of(run_of(estimates, default_hand_shape()))
    assert np.allclose(motion.time_s, 0.04 * np.arange(len(times)))


def test_the_skin_follows_the_joints() -> None:
    """Skinned by the rules of the format, the tip of the mesh is the tip of the finger."""
    estimates = moving("left")
    gltf = exported(estimates, "left")
    (skin,), (mesh,) = gltf.document["skins"], gltf.document["meshes"]
    inverse = gltf.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    names = [gltf.document["nodes"][joint]["name"] for joint in skin["joints"]]
    attributes = mesh["primitives"][0]["attributes"]
    points, joint, weight = (
        gltf.array(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0")
    )
    assert np.allclose(weight.sum(1), 1) and not weight[:, 1:].any()
    for frame in (0, 6):
        world = gltf.world(frame)
        moves = np.stack([world[name] for name in names]) @ inverse
        skinned = np.einsum("pab,pb->pa", moves[joint[:, 0]], np.c_[points, np.ones(len(points))])
        for tip in (8, 12, 20):
            there = estimates[frame].joints_m[tip] * [1, -1, -1]
            nearest = np.linalg.norm(skinned[:, :3] - there, axis=1).min()
            assert nearest < 0.003  # its axis is set towards the pad of the finger


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_mesh_is_closed_and_faces_outwards(side: str) -> None:
    points_m, normals, _, triangles = hand_mesh(default_hand_shape(side=side))
    corners = points_m[triangles]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fa,fa->f", outwards, normals[triangles].mean(1)) > 0).all()
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    volume = np.einsum("fa,fa->f", corners[:, 0], outwards).sum() / 6
    assert 2e-4 < volume < 9e-4  # m3, all ellipsoids by themselves


def test_a_lost_hand_is_hidden_and_its_pose_held() -> None:
    estimates = [lost_hand(0), *moving(lost=(3, 4))[1:]]
    gltf = exported(estimates, "right")
    _, scale, steps = gltf.channels()["Hand_R", "scale"]
    assert steps == "STEP"
    assert scale.tolist() == [[float(shown)] * 3 for shown in (0, 1, 1, 0, 0, 1, 1, 1)]
    for frame, held in ((0, 1), (3, 2), (4, 2)):
        for name, place in gltf.world(frame).items():
            assert np.allclose(place, gltf.world(held)[name]), (frame, name)


def test_keys_that_32_bits_cannot_tell_apart_follow_one_another() -> None:
    steps_s = [0, 0.04, 2400, 0.00005, 0.00005, 0.04, 0.04, 0.04]  # a burst after 40 minutes
    times_s = np.cumsum(steps_s)
    late = [replace(hand, timestamp_s=t) for hand, t in zip(moving(), times_s, strict=True)]
    time_s, _, _ = exported(late, "right").channels()["Hand_R", "scale"]
    assert (np.diff(time_s) > 0).all() and np.allclose(time_s, times_s, rtol=0, atol=0.001)


def test_a_left_hand_is_exported_as_one_though_the_file_of_its_shape_says_right() -> None:
    (motion,) = motions_of(run_of(moving("left"), default_hand_shape(side="right")))
    assert motion.shape.side == "left"
