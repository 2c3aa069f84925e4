"""A run as glTF, BVH and CSV: read back with the formats' own rules, and compared with the run."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.animation import Gltf, read_bvh
from helpers.hands import hand_estimate, lost_hand

from toftrack.frames.estimate import Estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.exports import glb_of, hand_mesh, motions_of
from toftrack.programs.export import bvh_of, csv_of

NAMES = ("index", "timestamp_s", "state_name", "lost", "side", "joints_m", "state", "gesture")
MORE = (
    *("confidence", "joint_ok", "pinching", "pointing_origin_m", "pointing_direction"),
    "openxr_position_m",
)


def results_of(estimates: list[Estimate]) -> dict[str, Any]:
    columns = {n: np.array([getattr(e, n) for e in estimates]) for n in NAMES + MORE}
    return columns | {"joint_names": JOINT_NAMES}


def moving(side: str = "right", lost: tuple[int, ...] = ()) -> list[Estimate]:
    """Eight frames of a hand that moves and closes."""
    hands = [hand_estimate(index, side, bent=0.2 * index) for index in range(8)]
    return [replace(hand, lost=hand.index in lost) for hand in hands]


def exported(estimates: list[Estimate], side: str) -> Gltf:
    pytest.importorskip("pygltflib", reason="pip install '.[export]'")
    return Gltf(glb_of(motions_of(results_of(estimates), (default_hand_shape(side=side),))))


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_joint_is_a_node_with_a_key_a_frame_that_puts_it_where_it_was(side: str) -> None:
    estimates = moving(side)
    gltf = exported(estimates, side)
    channels = gltf.channels()
    letter = side[0].upper()
    for name in OPENXR_JOINT_NAMES:
        for path in ("translation", "rotation"):
            time, values, steps = channels[f"{name.title()}_{letter}", path]
            assert np.allclose(time, np.arange(8) / 25) and len(values) == 8 and steps == "LINEAR"
    for frame in (0, 5):
        world = gltf.world(frame)
        places = np.stack([world[f"{n.title()}_{letter}"][:3, 3] for n in OPENXR_JOINT_NAMES])
        assert np.allclose(places, estimates[frame].openxr_position_m, atol=2e-6)


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
    mesh = hand_mesh(default_hand_shape(side=side))
    corners = mesh.points_m[mesh.triangles]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fa,fa->f", outwards, mesh.normals[mesh.triangles].mean(1)) > 0).all()
    edges = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
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


def test_a_bvh_puts_the_joints_where_they_were() -> None:
    estimates = moving("left")
    (motion,) = motions_of(results_of(estimates), (default_hand_shape(side="left"),))
    text = bvh_of(motion)
    names, found = read_bvh(text)
    assert "Frames: 8\nFrame Time: 0.040000\n" in text
    assert len(names) == 25 and names[0] == "Wrist_L" and "Ring_Distal_L" in names
    wrist = 100 * np.stack([e.openxr_position_m[1] for e in estimates])
    assert np.allclose(found[:, -1], wrist, atol=0.001)  # the root ends last
    for joint, name in enumerate(OPENXR_JOINT_NAMES):
        if name == "palm":
            continue
        there = 100 * np.stack([e.openxr_position_m[joint] for e in estimates])
        assert np.linalg.norm(found - there[:, None], axis=-1).min(1).max() < 0.01, name


def test_a_csv_has_a_row_a_frame_and_a_column_a_number() -> None:
    estimates = [lost_hand(0), *moving(lost=(2,))[1:]]
    rows = list(csv.DictReader(io.StringIO(csv_of(results_of(estimates)))))
    assert len(rows) == 8
    assert rows[0]["wrist_x_m"] == "" and rows[0]["lost"] == "1" and rows[2]["lost"] == "1"
    for row, estimate in zip(rows[1:], estimates[1:], strict=True):
        assert (row["index"], row["side"]) == (str(estimate.index), "right")
        assert float(row["timestamp_s"]) == pytest.approx(estimate.timestamp_s, abs=1e-6)
        for number, name in enumerate(JOINT_NAMES):
            place = [float(row[f"{name}_{axis}_m"]) for axis in "xyz"]
            assert place == pytest.approx(estimate.joints_m[number].tolist(), abs=1e-5)
            assert row[f"{name}_ok"] == str(int(estimate.joint_ok[number]))
        assert row["pointing_origin_x_m"] == ""
