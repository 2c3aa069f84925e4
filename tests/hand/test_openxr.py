"""The joints of XR_EXT_hand_tracking, against the text of its specification."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from toftrack.hand.openxr import (
    OPENXR_JOINT_NAMES,
    OPENXR_PARENTS,
    OpenXRHand,
    openxr_hand,
    openxr_rig,
)
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_NAMES, JOINT_NAMES, forward_kinematics
from toftrack.hand.surface import hand_surface

# As the specification lists them: XR_HAND_JOINT_..._EXT.
SPECIFIED = """PALM WRIST THUMB_METACARPAL THUMB_PROXIMAL THUMB_DISTAL THUMB_TIP
INDEX_METACARPAL INDEX_PROXIMAL INDEX_INTERMEDIATE INDEX_DISTAL INDEX_TIP
MIDDLE_METACARPAL MIDDLE_PROXIMAL MIDDLE_INTERMEDIATE MIDDLE_DISTAL MIDDLE_TIP
RING_METACARPAL RING_PROXIMAL RING_INTERMEDIATE RING_DISTAL RING_TIP
LITTLE_METACARPAL LITTLE_PROXIMAL LITTLE_INTERMEDIATE LITTLE_DISTAL LITTLE_TIP""".lower().split()
FINGERS = ("index", "middle", "ring", "little")
BONES = ("metacarpal", "proximal", "intermediate", "distal", "tip")
AT = {name: i for i, name in enumerate(OPENXR_JOINT_NAMES)}
FLEXIONS = [i for i, name in enumerate(ANGLE_NAMES) if "flexion" in name and "thumb" not in name]
RIGHT, UP, FORWARD = np.eye(3) * [1, 1, -1]
"""Of the world: forward is -z."""
MIRROR = np.diag([-1.0, 1.0, 1.0])


def state_of(bent_deg: float = 0.0, seed: int | None = None) -> np.ndarray:
    """A right hand half a metre before the camera, palm towards it and fingers up.

    bent_deg: each joint of the four fingers.  seed: any pose and rotation instead.
    """
    state = np.zeros(27)
    state[:3] = 0.05, 0.1, 0.5
    if seed is not None:
        state[3:] = np.random.default_rng(seed).uniform(-0.7, 0.7, 24)
    state[[6 + i for i in FLEXIONS]] += np.radians(bent_deg)
    return state


def placed(state: np.ndarray, side: str = "right", length_m: float = 0.19) -> OpenXRHand:
    shape = default_hand_shape(length_m, side)
    joints = joints_of(state, side, length_m)
    return openxr_hand(joints, state, openxr_rig(shape))


def joints_of(state: np.ndarray, side: str = "right", length_m: float = 0.19) -> np.ndarray:
    shape = default_hand_shape(length_m, side).to(torch.float64)
    return forward_kinematics(torch.from_numpy(state)[None], shape).joints_m[0].numpy()


def axes(hand: OpenXRHand) -> np.ndarray:
    """(26, 3 axes, 3): X, Y and Z of each joint in the world."""
    return Rotation.from_quat(hand.orientation).as_matrix().swapaxes(-1, -2)


POSES = [
    pytest.param(state_of(), "right", id="straight"),
    pytest.param(state_of(80), "right", id="fist"),
    pytest.param(state_of(), "left", id="straight left"),
    pytest.param(state_of(80), "left", id="left fist"),
    *(
        pytest.param(state_of(seed=s), side, id=f"{side} {s}")
        for s in (1, 2)
        for side in ("right", "left")
    ),
]


def test_the_joints_are_those_of_the_specification_in_its_order() -> None:
    assert list(OPENXR_JOINT_NAMES) == SPECIFIED


def test_every_joint_hangs_on_the_bone_before_it_and_all_on_the_wrist() -> None:
    for name, parent in zip(OPENXR_JOINT_NAMES, OPENXR_PARENTS, strict=True):
        finger, _, bone = name.partition("_")
        if name == "wrist":
            assert parent == -1
        elif bone in ("", "metacarpal"):
            assert parent == AT["wrist"]
        else:
            assert parent == AT[name] - 1 and OPENXR_JOINT_NAMES[parent].startswith(finger)


@pytest.mark.parametrize(("state", "side"), POSES)
def test_unit_quaternions_of_one_sign_have_backward_along_the_bone(state, side) -> None:
    hand = placed(state, side)
    assert np.allclose(np.linalg.norm(hand.orientation, axis=1), 1)
    assert (hand.orientation[:, 3] >= 0).all()
    x, _, backward = np.moveaxis(axes(hand), 1, 0)
    for finger in FINGERS:  # all of it bends about one axis, which turns with its abduction
        one, other = AT[f"{finger}_proximal"], AT[f"{finger}_distal"]
        assert x[one] @ backward[other] == pytest.approx(0, abs=1e-6)
    for finger, bones in {"thumb": BONES[:2] + BONES[3:], **dict.fromkeys(FINGERS, BONES)}.items():
        for bone, end in zip(bones, bones[1:], strict=False):
            here, there = AT[f"{finger}_{bone}"], AT[f"{finger}_{end}"]
            way = hand.position_m[here] - hand.position_m[there]
            assert backward[here] @ way / np.linalg.norm(way) == pytest.approx(1, abs=1e-9)
        distal, tip = AT[f"{finger}_distal"], AT[f"{finger}_tip"]
        assert np.allclose(hand.orientation[tip], hand.orientation[distal])


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_nail_of_an_open_hand_s_thumb_faces_sideways_and_never_the_camera(side: str) -> None:
    """Palm to the camera: the back of the hand faces away from it, which is forward."""
    _, y, z = np.moveaxis(axes(placed(state_of(), side)), 1, 0)
    for name in ("thumb_metacarpal", "thumb_proximal", "thumb_distal", "thumb_tip"):
        outwards = RIGHT if side == "right" else -RIGHT
        assert -z[AT[name]] @ outwards > 0.5 and -z[AT[name]] @ UP > 0.6
        assert y[AT[name]] @ FORWARD > 0.5


@pytest.mark.parametrize("side", ["right", "left"])
def test_in_a_fist_the_nails_turn_with_their_bones(side: str) -> None:
    """Bent by 90 degrees each: the first bones point at the camera, the second ones down, the
    third ones back at the palm.
    """
    x, y, z = np.moveaxis(axes(placed(state_of(90), side)), 1, 0)
    for bone, distal, nail in (
        ("metacarpal", UP, FORWARD),
        ("proximal", -FORWARD, UP),
        ("intermediate", -UP, -FORWARD),
        ("distal", FORWARD, -UP),
        ("tip", FORWARD, -UP),
    ):
        for finger in FINGERS:
            joint = AT[f"{finger}_{bone}"]
            assert -z[joint] @ distal > 0.92, (finger, bone)
            assert y[joint] @ nail > 0.92, (finger, bone)
            assert x[joint] @ -RIGHT > 0.9, (finger, bone)


@pytest.mark.parametrize("seed", range(3))
def test_a_left_hand_is_the_mirror_image_of_a_right_one(seed: int) -> None:
    state = state_of(seed=seed)
    mirrored = state * np.r_[-1, 1, 1, 1, -1, -1, np.ones(21)]
    right, left = placed(state), placed(mirrored, "left")
    assert np.allclose(left.position_m, right.position_m @ MIRROR)
    turned = Rotation.from_quat(right.orientation).as_matrix()
    assert np.allclose(Rotation.from_quat(left.orientation).as_matrix(), MIRROR @ turned @ MIRROR)
    assert np.allclose(left.radius_m, right.radius_m)


@pytest.mark.parametrize(("state", "side"), POSES)
def test_palm_and_wrist_lie_and_face_as_specified(state, side) -> None:
    hand = placed(state, side)
    _, y, z = np.moveaxis(axes(hand), 1, 0)
    base, knuckle = hand.position_m[AT["middle_metacarpal"]], hand.position_m[AT["middle_proximal"]]
    assert np.allclose(hand.position_m[AT["palm"]], (base + knuckle) / 2)
    along = (base - knuckle) / np.linalg.norm(base - knuckle)
    assert np.allclose(z[AT["palm"]], along)
    wrist = hand.position_m[AT["wrist"]]
    assert np.allclose(z[AT["wrist"]], (wrist - base) / np.linalg.norm(wrist - base))
    # The back of the hand, wherever it looks: the bones of the palm lie across to it.
    index, little = (hand.position_m[AT[f"{finger}_proximal"]] for finger in ("index", "little"))
    across = (index - little) if side == "right" else (little - index)
    back = np.cross(knuckle - wrist, across)
    assert y[AT["palm"]] @ back / np.linalg.norm(back) > 0.97
    assert y[AT["wrist"]] @ back / np.linalg.norm(back) > 0.97


@pytest.mark.parametrize(("state", "side"), POSES)
def test_the_other_joints_are_the_skeleton_s_in_the_world_s_axes(state, side) -> None:
    hand, joints = placed(state, side), joints_of(state, side) * [1, -1, -1]
    theirs = {"mcp": "proximal", "pip": "intermediate", "dip": "distal"}
    for name, place in zip(JOINT_NAMES, joints, strict=True):
        finger, _, joint = name.partition("_")
        if finger == "thumb":
            theirs_now = {"cmc": "metacarpal", "mcp": "proximal", "ip": "distal"}.get(joint)
        else:
            theirs_now = theirs.get(joint)
        if name == "wrist" or theirs_now:
            there = name if name == "wrist" else f"{finger}_{theirs_now}"
            assert np.allclose(hand.position_m[AT[there]], place)
        else:
            tip = AT[f"{finger}_tip"]
            backward = axes(hand)[tip, 2]
            assert np.allclose(hand.position_m[tip], place + hand.radius_m[tip] * backward)


def test_metacarpals_begin_in_the_carpus_side_by_side() -> None:
    hand, joints = placed(state_of()), joints_of(state_of()) * [1, -1, -1]
    bases = np.stack([hand.position_m[AT[f"{f}_metacarpal"]] for f in FINGERS]) - joints[0]
    assert ((0.01 < bases[:, 1]) & (bases[:, 1] < 0.03)).all()
    assert (np.diff(bases[:, 0]) < -0.008).all()  # from the thumb's side on
    knuckles = np.stack([hand.position_m[AT[f"{f}_proximal"]] for f in FINGERS]) - joints[0]
    lengths = np.linalg.norm(knuckles - bases, axis=1) / 0.19
    assert np.allclose(lengths, [0.38, 0.375, 0.34, 0.31], atol=0.015)


def test_a_radius_is_the_distance_to_the_hand_s_own_skin() -> None:
    hand = placed(state_of())
    assert ((0.003 < hand.radius_m) & (hand.radius_m < 0.022)).all()
    shape = default_hand_shape().to(torch.float64)
    flesh = hand_surface(shape).pose(forward_kinematics(torch.from_numpy(state_of())[None], shape))
    inverse = np.linalg.inv(flesh.axes_m[0, :-1].numpy())
    for name in ("thumb_tip", *(f"{finger}_tip" for finger in FINGERS)):
        _, up, back = axes(hand)[AT[name]] * [1, -1, -1]
        middle, radius = hand.position_m[AT[name]] * [1, -1, -1], hand.radius_m[AT[name]]

        def depth(point: np.ndarray) -> float:
            """1 on the skin, less inside."""
            inside = np.einsum("eab,eb->ea", inverse, point - flesh.centres_m[0, :-1].numpy())
            return float(np.linalg.norm(inside, axis=1).min())

        assert depth(middle) < 1
        # The flesh is set towards the pad, by a part of the thickness.
        through = [depth(middle + part * radius * up) for part in np.linspace(-3, 3, 601)]
        assert np.mean(np.array(through) < 1) * 6 / 2 == pytest.approx(1, abs=0.03)
        assert depth(middle - 0.9 * radius * back) < 1.1


def test_a_larger_hand_has_larger_radii() -> None:
    small, large = placed(state_of(), length_m=0.16), placed(state_of(), length_m=0.2)
    assert (large.radius_m > 1.1 * small.radius_m).all()


def test_leading_axes_stay_and_hands_that_are_none_are_nan() -> None:
    states = np.stack([state_of(seed=s) for s in range(6)])
    joints = np.stack([joints_of(state) for state in states])
    joints[4] = np.nan
    rig = openxr_rig(default_hand_shape())
    hands = openxr_hand(joints.reshape(3, 2, 21, 3), states.reshape(3, 2, 27), rig)
    shapes = tuple(array.shape for array in hands)
    assert shapes == ((3, 2, 26, 3), (3, 2, 26, 4), (3, 2, 26))
    for row in range(6):
        one = openxr_hand(joints[row], states[row], rig)
        for array, single in zip(hands, one, strict=True):
            np.testing.assert_allclose(array[row // 2, row % 2], single)
    assert all(np.isnan(array[2, 0]).all() for array in hands)
    assert all(np.isfinite(array[2, 1]).all() for array in hands)
    none = openxr_hand(np.full((0, 21, 3), np.nan), np.zeros((0, 27)), rig)
    assert none.position_m.shape == (0, 26, 3)
