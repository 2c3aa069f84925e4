"""Gestures: labels that follow from the pose and do not flicker."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.settings import gestures, part
from helpers.shown_gestures import GESTURES, ON, SURE, fingers, label_of, pose
from helpers.tracking import follow as follow_scene
from helpers.tracking import sample

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate, no_estimate
from toftrack.gestures.features import features
from toftrack.gestures.features import features_of_angles as seen
from toftrack.gestures.recognition import GestureState, pointing_ray, tell_gesture, update
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.pose_space.data.pose_data import synthetic_data
from toftrack.pose_space.files import make_pose_space

PAPER = part("gestures=paper", "gestures")
SPACE = make_pose_space("pca", 4)


def follow(frames: list[np.ndarray], score: float = SURE) -> list[tuple[str, float]]:
    state: GestureState | None = None
    reported = []
    for angles in frames:
        state, label, probability = update(state, seen(angles), score, ON, GESTURES)
        reported.append((label, probability))
    return reported


def estimate(angles: np.ndarray, name: str = "tracking", lost: bool = False) -> Estimate:
    state = torch.zeros(1, 27)
    state[0, 2] = 0.5
    state[0, 6:] = torch.from_numpy(angles)
    joints = forward_kinematics(state, default_hand_shape()).joints_m[0].numpy()
    return no_estimate(0, 0.0, name, 4, 0.0).updated(
        lost=lost,
        joints_m=joints,
        joint_ok=np.ones(21, bool),
        state=state[0].numpy(),
        latent=SPACE.encode(state[:, 6:])[0].numpy(),
        score=SURE,
    )


V = np.radians([12.0, 0, 0, 0, -10, 0, 0, 0])
"""Index and middle finger in a V."""


def spread_v(angles: np.ndarray) -> np.ndarray:
    angles = angles.copy()
    angles[5:13] = V
    return angles


def of_thumb(angles: np.ndarray, thumb: str) -> np.ndarray:
    angles = angles.copy()
    angles[:5] = pose("palm", thumb)[:5]
    return angles


SHOWN = [
    ("palm", fingers(), ("out", "up", "beside")),
    ("four", fingers(), ("across", "tucked")),
    ("fist", fingers(0, 1, 2, 3), ("across", "tucked", "beside")),
    ("thumb_up", fingers(0, 1, 2, 3), ("out", "up")),
    ("pointing", fingers(1, 2, 3), ("across", "tucked", "beside")),
    ("pointing_thumb", fingers(1, 2, 3), ("out", "up")),
    ("pointing", fingers(2, 3), ("across", "tucked")),
    ("pointing_thumb", fingers(2, 3), ("out", "up")),
    ("victory", spread_v(fingers(2, 3)), ("across", "tucked")),
    ("three", spread_v(fingers(2, 3)), ("out", "up")),
    ("three", fingers(3), ("out", "across", "tucked")),
]


@pytest.mark.parametrize(("label", "angles", "thumbs"), SHOWN)
def test_a_gesture_is_reported_by_its_fingers_and_thumb(
    label: str, angles: np.ndarray, thumbs: tuple[str, ...]
) -> None:
    if label.startswith("pointing"):
        angles = angles.copy()
        angles[[5, 9]] = np.radians([-3.0, 4.0])  # two fingers side by side
    for thumb in thumbs:
        _, reported, probability = update(None, seen(of_thumb(angles, thumb)), SURE, ON, GESTURES)
        assert reported == label, thumb
        assert probability > 0.6, thumb


def each(*flexions: float) -> np.ndarray:
    """(21,) rad: every finger's three joints bent by so many degrees."""
    angles = pose("palm")
    for finger in range(4):
        angles[6 + 4 * finger : 9 + 4 * finger] = np.radians(flexions)
    return angles


def loosely(*curled: int, share: float) -> np.ndarray:
    """(21,) rad: as a real camera shows it, bent by a share, and the little finger not straight."""
    angles = fingers() + share * (fingers(*curled) - fingers())
    angles[[18, 19]] = math.radians(8)
    return angles


def pinched(*index: float) -> np.ndarray:
    angles = fingers()
    angles[:9] = np.radians([8, 20, -21, 26, 23, *index])
    return angles


@pytest.mark.parametrize(
    ("label", "angles"),
    [
        *(("thumb_up", of_thumb(each(40, 85, 45), thumb)) for thumb in ("up", "out")),  # loose
        *(("fist", of_thumb(each(38, 115, 72), thumb)) for thumb in ("across", "beside")),
        ("thumb_up", of_thumb(each(38, 115, 72), "up")),
        *(("thumb_up", of_thumb(each(35, 95, 55), thumb)) for thumb in ("up", "out")),  # rolled up
        ("relaxed", (pose("palm") + pose("fist", "out")) / 2),
        ("ok", pinched(-9, 23, 68, 22)),
        # Near a gesture, and none.
        ("other", each(0, 90, 50)),  # hooked
        ("other", each(75, 5, 5)),  # a table top
        *(("other", fingers(*curled)) for curled in ((0, 1, 2), (1, 2), (1, 3), (0, 2))),
        ("other", loosely(0, 1, 2, share=0.68)),
        ("other", loosely(1, 2, share=0.62)),
    ],
)
def test_hands_as_people_hold_them_are_what_they_are(label: str, angles: np.ndarray) -> None:
    assert label_of(angles) == label


@pytest.mark.parametrize(("turn", "side"), [(0, "right"), (1, "left")])
def test_a_gesture_is_the_same_whichever_way_the_hand_is_turned(turn: int, side: str) -> None:
    generator = torch.Generator().manual_seed(turn)
    state = torch.zeros(1, 27)
    state[0, :6] = torch.randn(6, generator=generator)
    for _, angles, thumbs in SHOWN:
        state[0, 6:] = torch.from_numpy(of_thumb(angles, thumbs[0]))
        joints = forward_kinematics(state, default_hand_shape(0.15, side)).joints_m[0].numpy()
        turned = features(state[0, 6:].numpy(), joints)
        assert turned == pytest.approx(seen(of_thumb(angles, thumbs[0])), abs=1e-3)


@pytest.mark.parametrize(("basic", "label"), [("palm",) * 2, ("fist",) * 2, ("gun", "pointing")])
def test_the_papers_gestures_have_their_names_whatever_the_thumb_does(
    basic: str, label: str
) -> None:
    for thumb in (None, "out", "up", "beside", "across", "tucked"):
        _, reported, probability = update(None, seen(pose(basic, thumb)), SURE, ON, PAPER)
        assert reported == label and probability > 0.95, thumb


def test_each_transformation_runs_from_its_first_to_its_last_gesture() -> None:
    names = {"palm": "palm", "fist": "fist", "gun": "pointing"}
    poses = synthetic_data()
    for way in ("palm-fist", "palm-gun", "gun-fist"):
        first, last = (names[end] for end in way.split("-"))
        rows = [a.numpy() for a, b in zip(poses.angles_rad, poses.labels, strict=True) if b == way]
        labels = [label_of(angles, PAPER) for angles in rows]
        assert labels[0] == first and labels[-1] == last
        assert labels.index(last) > len(labels) // 3
        # The little finger leads, so that a closing hand passes a pose like pointing.
        assert set(labels) <= {"other", "pointing", first, last}


def test_noise_leaves_a_gesture_what_it_is() -> None:
    rng = np.random.default_rng(0)
    for label, angles, thumbs in SHOWN[:6]:
        for _ in range(20):
            noisy = of_thumb(angles, thumbs[0]) + rng.normal(0, math.radians(6), 21)
            assert label_of(noisy) == label


def test_a_bad_score_says_nothing() -> None:
    fist, classes = seen(pose("fist")), len(GESTURES.names)
    _, _, probability = update(None, fist, 0.3, ON, GESTURES)
    assert probability == pytest.approx(1 / classes)
    frames = follow([pose("palm")] * 3)
    assert frames[-1][0] == "palm"
    state = update(None, seen(pose("palm")), SURE, ON, GESTURES)[0]
    for _ in range(12):
        state, label, probability = update(state, fist, 0.4, ON, GESTURES)
    assert label == "palm" and probability == pytest.approx(1 / classes, abs=0.01)


def test_labels_do_not_flicker_at_a_border() -> None:
    rng = np.random.default_rng(1)
    fist, palm = pose("fist"), pose("palm")
    mixtures = [palm + part * (fist - palm) for part in np.linspace(1, 0.5, 51)]
    border = next(angles for angles in mixtures if label_of(angles) != "fist")
    between = [border + rng.normal(0, 0.15, 21) for _ in range(120)]
    alone = [label_of(angles) for angles in between]
    followed = [label for label, _ in follow(between)]

    def changes(labels: list[str]) -> int:
        return sum(a != b for a, b in zip(labels, labels[1:], strict=False))

    assert changes(alone) > 12, "a border worth testing"
    assert changes(followed) < changes(alone) / 4


def test_a_new_gesture_is_reported_within_three_frames_and_one_odd_frame_changes_nothing() -> None:
    labels = [label for label, _ in follow([pose("palm")] * 5 + [pose("gun", "tucked")] * 4)]
    assert labels[:5] == ["palm"] * 5 and labels[7:] == ["pointing"] * 2
    labels = [
        label for label, _ in follow([pose("palm")] * 5 + [pose("fist")] + [pose("palm")] * 5)
    ]
    assert labels == ["palm"] * 11


def test_the_pointing_ray_runs_along_the_index_finger() -> None:
    _, reported = tell_gesture(GESTURES, None, estimate(pose("gun")), SPACE)
    assert reported.gesture == "pointing_thumb"
    assert reported.pointing_origin_m == pytest.approx(reported.joints_m[5])
    assert np.linalg.norm(reported.pointing_direction) == pytest.approx(1)
    reach = reported.joints_m[8] - reported.joints_m[5]
    assert np.cross(reported.pointing_direction, reach) == pytest.approx(0, abs=1e-6)
    assert reported.pointing_direction @ reach > 0
    assert reported.pointing_direction[1] < -0.95, "a hand held up points up"
    origin, _ = pointing_ray(reported.joints_m)
    origin += 1.0
    assert reported.pointing_origin_m == pytest.approx(reported.joints_m[5]), "the ray is a copy"


def test_only_a_pointing_hand_that_is_followed_has_a_ray() -> None:
    state, palm = tell_gesture(GESTURES, None, estimate(pose("palm")), SPACE)
    assert palm.gesture == "palm" and np.isnan(palm.pointing_direction).all()
    pointing = tell_gesture(GESTURES, None, estimate(pose("gun")), SPACE)[1]
    for lost in (
        estimate(pose("gun"), "lost", True),
        estimate(pose("gun"), "recovering", True),
        # As for a frame without a hand: the last estimate repeated.
        pointing.updated(state_name="lost", lost=True),
        no_estimate(0, 0.0, "lost", 4, 0.0),
    ):
        state, reported = tell_gesture(GESTURES, state, lost, SPACE)
        assert state is None
        assert reported.gesture == "" and math.isnan(reported.gesture_probability)
        assert math.isnan(reported.pinch) and not reported.pinching
        assert np.isnan((reported.pointing_origin_m, reported.pointing_direction)).all()


@pytest.mark.parametrize(
    ("made", "doubted", "name"),
    [
        ("gun", 20, ""),  # the little finger, which is curled in both gestures that point
        ("gun", 4, ""),  # the thumb tells one of them from the other
        ("palm", 0, "palm"),  # no finger bends at the wrist
    ],
)
def test_a_gesture_is_not_named_where_a_joint_that_decides_is_not_ok(
    made: str, doubted: int, name: str
) -> None:
    one = dataclasses.replace(estimate(pose(made)), joint_ok=np.arange(21) != doubted)
    _, reported = tell_gesture(GESTURES, None, one, SPACE)
    assert reported.gesture == name
    assert math.isnan(reported.gesture_probability) == (name == "")
    assert np.isnan(reported.pointing_direction).all()


def test_a_fist_whose_thumb_lies_beside_the_index_finger_pinches_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("toftrack.gestures.recognition.pinch_of", lambda *_: 1.0)
    for shown, pinches in ((pose("fist"), False), (pose("palm"), True)):
        state = None
        for _ in range(6):
            state, reported = tell_gesture(GESTURES, state, estimate(shown), SPACE)
        assert reported.pinch == 1 and reported.pinching == pinches, reported.gesture


@pytest.mark.parametrize(("confidence", "name"), [(0.9, "palm"), (0.2, "fist"), (math.nan, "fist")])
def test_a_pose_that_is_surely_right_has_its_gesture_whatever_the_image_explains(
    confidence: float, name: str
) -> None:
    state, _ = tell_gesture(GESTURES, None, estimate(pose("fist")), SPACE)
    one = dataclasses.replace(estimate(pose("palm")), score=0.4, confidence=confidence)
    for _ in range(6):
        state, reported = tell_gesture(GESTURES, state, one, SPACE)
    assert reported.gesture == name


@pytest.mark.parametrize("bad", [{"off_rad": 0.0}, {"smoothing": 1.0}, {"known": "most"}])
def test_settings_out_of_range_are_reported(bad: dict[str, float]) -> None:
    with pytest.raises(ToftrackError, match="gestures"):
        gestures(**bad)


def test_the_tracker_tells_the_gestures_of_the_recording() -> None:
    scene = sample()
    rows = range(55, 98)  # from the palm on; "" until the hand is found

    reported = follow_scene(scene.cut(*rows))
    labels = [one.gesture for one in reported]
    assert "palm" in labels[:6] and set(labels[:6]) <= {"palm", ""}
    assert labels[-10:] == ["pointing_thumb"] * 10
    assert min(one.gesture_probability for one in reported[-10:]) > 0.9
    last = reported[-1]
    reach = scene.joints_m[rows[-1], 8] - scene.joints_m[rows[-1], 5]
    cosine = last.pointing_direction @ reach / np.linalg.norm(reach)
    assert cosine > math.cos(math.radians(15))


def test_two_frames_at_once_are_as_one_after_the_other() -> None:
    first = update(None, seen(pose("palm")), SURE, ON, GESTURES)[0]
    fist = seen(pose("fist"))
    once = update(first, fist, SURE, ON, GESTURES, 2.0)[0]
    twice = update(update(first, fist, SURE, ON, GESTURES)[0], fist, SURE, ON, GESTURES)[0]
    assert once.probabilities == pytest.approx(twice.probabilities)


def test_after_a_second_without_frames_another_gesture_is_told_at_once() -> None:
    state, _ = tell_gesture(GESTURES, None, estimate(pose("palm")), SPACE)
    _, reported = tell_gesture(GESTURES, state, estimate(pose("fist")), SPACE, 25.0)
    assert reported.gesture == "fist"
