"""Which gesture a hand makes: palm, fist, pointing, other, and classes that a user names.

A gesture is one or more named poses. A pose is looked at through ten sums of its joint angles,
which a depth image determines better than the angles themselves: of each finger the total flexion,
and how much more of it the two outer joints have than the knuckle; of the thumb the total flexion
and the abduction. The fingers' abduction is not looked at.

A class says that these lie about its pose (normal distribution); or says nothing of some of them,
as the basic poses say nothing of the thumb. "other" says nothing at all: all sums are equally
likely within the joint limits. Bayes' rule with equal priors gives the probabilities. The widths
come from the definition alone: palm and fist differ by 240 degrees in a finger's total flexion, and
a finger half way lies three standard deviations from both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.estimate import Estimate
from toftrack.gestures.files import NamedPose, read_poses
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, JOINT_NAMES
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.data.training_poses import basic_pose

OTHER = "other"
POINTING = "pointing"
_BASIC = {"palm": "palm", "fist": "fist", POINTING: "gun"}
_THUMB_ANGLES = 5
_RAY = JOINT_NAMES.index("index_mcp"), JOINT_NAMES.index("index_tip")
_OFF_RANGE_RAD = 0.5
"""How far off the pose space a hand may be at all, rms over the angles."""


def _sums() -> np.ndarray:
    """(10, 21): what is added up of the angles; thumb abduction, then flexions, then splits."""
    sums = np.zeros((10, len(ANGLE_NAMES)))
    sums[0, 0] = 1.0
    sums[1, [1, 3, 4]] = 1.0
    for finger in range(4):
        knuckle, *outer = range(_THUMB_ANGLES + 4 * finger + 1, _THUMB_ANGLES + 4 * finger + 4)
        sums[2 + finger, [knuckle, *outer]] = 1.0
        sums[6 + finger, outer] = 1.0
        sums[6 + finger, knuckle] = -1.0
    return sums


_SUMS = _sums()
_RANGES = np.abs(_SUMS) @ np.diff(ANGLE_LIMITS)[:, 0]
"""(10,) rad, from the least to the largest value of each sum within the joint limits."""


@dataclass(frozen=True)
class GestureSettings:
    """How labels are decided; see conf/gestures for what each does."""

    flexion_rad: float
    split_rad: float
    thumb_rad: float
    off_rad: float
    other: float
    doubtful_score: float
    sure_score: float
    smoothing: float
    margin: float

    def __post_init__(self) -> None:
        widths = (self.flexion_rad, self.split_rad, self.thumb_rad, self.off_rad, self.other)
        if not all(0 < width < math.inf for width in widths):
            raise ToftrackError("gestures: the *_rad widths and other must be above 0")
        if not self.doubtful_score < self.sure_score:
            raise ToftrackError("gestures.doubtful_score must be below gestures.sure_score")
        if not (0 <= self.smoothing < 1 and 0 <= self.margin < 1):
            raise ToftrackError("gestures.smoothing and gestures.margin must be in 0 .. below 1")


@dataclass(frozen=True, eq=False)
class Gestures:
    """The classes that are told apart.

    names: C class names, "other" last.  centres: (M, 10) the sums of their poses, rad.
    known: (M, 10) bool, the sums that a pose says something of.  classes: (M,) a pose's class.
    in_space: (M,) bool, poses that the pose space was learned from.
    """

    names: tuple[str, ...]
    centres: np.ndarray
    known: np.ndarray
    classes: np.ndarray
    in_space: np.ndarray
    settings: GestureSettings

    @property
    def widths(self) -> np.ndarray:
        """(10,) rad, standard deviations of the sums."""
        cfg = self.settings
        return np.repeat(
            (cfg.thumb_rad, cfg.flexion_rad, cfg.flexion_rad, cfg.split_rad), (1, 1, 4, 4)
        )

    def probabilities(self, angles: np.ndarray, score: float, off_rad: float) -> np.ndarray:
        """Of each class for one frame by itself, (C,), sum 1.

        angles: (21,) rad.  score: 0..1; below `doubtful_score` all classes are equally probable.
        off_rad: rms distance of the angles from the pose space; NaN says nothing.
        """
        cfg, widths = self.settings, self.widths
        # Logarithms of densities, in parts of the uniform density of "other".
        z = (_SUMS @ angles - self.centres) / widths
        normal = np.log(_RANGES / (widths * math.sqrt(2 * math.pi))) - 0.5 * z**2
        log_poses = np.where(self.known, normal, 0.0).sum(1)
        if math.isfinite(off_rad):
            near = math.log(_OFF_RANGE_RAD * 2 / (cfg.off_rad * math.sqrt(2 * math.pi)))
            log_poses += np.where(self.in_space, near - 0.5 * (off_rad / cfg.off_rad) ** 2, 0.0)
        log_classes = np.full(len(self.names), math.log(cfg.other))
        for number in range(len(self.names) - 1):
            own = log_poses[self.classes == number]
            log_classes[number] = np.logaddexp.reduce(own) - math.log(len(own))
        trust = (score - cfg.doubtful_score) / (cfg.sure_score - cfg.doubtful_score)
        log_classes *= min(max(trust, 0.0), 1.0)
        parts = np.exp(log_classes - log_classes.max())
        return parts / parts.sum()


@dataclass(frozen=True, eq=False)
class GestureState:
    """What is carried from frame to frame: the smoothed probabilities (C,) and the label."""

    probabilities: np.ndarray
    label: str


def make_gestures(file: str | None = None, **settings: float) -> Gestures:
    """The basic gestures, and those that a file names (see gesture_files).

    file: its poses become further classes; those named palm, fist or pointing take the place of the
        basic ones.
    settings: of GestureSettings.

    Raises ToftrackError for a setting out of range, a file that cannot be understood, and two
    classes that look alike.
    """
    named = [] if file is None else read_poses(file)
    taken = {pose.name for pose in named}
    if OTHER in taken:
        raise ToftrackError(f"{file} names a gesture 'other', which is what is none of the classes")
    basic = [pose for pose in basic_gestures() if pose.name not in taken]
    return _gestures(basic, named, GestureSettings(**settings), file)


def no_gestures() -> None:
    """No gesture output: gestures=none."""


def basic_gestures() -> list[NamedPose]:
    """Palm, fist and pointing as the pose spaces are trained on them, with any thumb."""
    poses = []
    for name, basic in _BASIC.items():
        angles = basic_pose(basic).numpy()
        angles[:_THUMB_ANGLES] = math.nan
        poses.append(NamedPose(name, angles))
    return poses


def _gestures(
    basic: Sequence[NamedPose],
    named: Sequence[NamedPose],
    settings: GestureSettings,
    file: str | None,
) -> Gestures:
    poses = [*basic, *named]
    names = list(dict.fromkeys(pose.name for pose in poses))
    angles = np.stack([pose.angles_rad for pose in poses])
    gestures = Gestures(
        names=(*names, OTHER),
        centres=np.nan_to_num(angles) @ _SUMS.T,
        known=(np.isnan(angles) @ np.abs(_SUMS).T) == 0,
        classes=np.array([names.index(pose.name) for pose in poses]),
        in_space=np.arange(len(poses)) < len(basic),
        settings=settings,
    )
    for a in range(len(poses)):
        if not gestures.known[a].any():
            raise ToftrackError(
                f"{file}: gesture {poses[a].name!r} says nothing of any finger's flexion; give all"
                " three flexions of at least one finger"
            )
        for b in range(max(a + 1, len(basic)), len(poses)):
            known = gestures.known[a]
            apart = np.abs(gestures.centres[a] - gestures.centres[b]) / gestures.widths
            if (
                gestures.classes[a] != gestures.classes[b]
                and (known == gestures.known[b]).all()
                and (apart[known] < 1).all()
            ):
                raise ToftrackError(
                    f"{file}: gestures {poses[a].name!r} and {poses[b].name!r} are too much alike"
                    " to be told apart; give them one name, or angles that differ more"
                )
    return gestures


def update(
    state: GestureState | None,
    angles: np.ndarray,
    score: float,
    off_rad: float,
    gestures: Gestures,
    frames: float = 1.0,
) -> tuple[GestureState, str, float]:
    """One frame on: the new state, the label and its probability.

    The probabilities are smoothed over time, and the label changes only when another one's exceeds
    its own by `margin`; so the probability of a label that is about to change may be the smaller.

    state: of the frame before; None at the start or after the hand was lost.
    angles: (21,) rad, the refined estimate.  score: its score, 0..1.
    off_rad: rms distance of the angles from the pose space, rad; NaN where there is none.
    frames: how many times 1/25 s have passed since the state.
    """
    cfg = gestures.settings
    smooth = gestures.probabilities(angles, score, off_rad)
    if state is not None:
        keep = cfg.smoothing**frames
        smooth = keep * state.probabilities + (1 - keep) * smooth
    best = int(smooth.argmax())
    if state is not None:
        current = gestures.names.index(state.label)
        best = best if smooth[best] > smooth[current] + cfg.margin else current
    label = gestures.names[best]
    return GestureState(smooth, label), label, float(smooth[best])


def pointing_ray(joints_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the index finger points, camera frame: its base (3,) m, and the unit vector to its tip.

    joints_m: (21, 3).
    """
    base, tip = (joints_m[number] for number in _RAY)
    way = tip - base
    return base.copy(), way / np.linalg.norm(way)


def tell_gesture(
    gestures: Gestures | None,
    state: GestureState | None,
    estimate: Estimate,
    space: PoseSpace,
    frames: float = 1.0,
) -> tuple[GestureState | None, Estimate]:
    """The estimate with its gesture, and with the pointing ray while it points.

    A hand that is lost has no gesture ("" and NaN), except one that is followed well and counts as
    lost only because its pose is none of the pose space: this is a pose like any other.
    """
    if gestures is None or (estimate.lost and estimate.state_name != "tracking"):
        nowhere = np.full(3, np.nan, np.float32)
        return None, replace(
            estimate,
            gesture="",
            gesture_probability=math.nan,
            pointing_origin_m=nowhere,
            pointing_direction=nowhere,
        )
    angles = estimate.state[6:].astype(np.float64)
    latent = space.lower.new_tensor(estimate.latent)[None]
    off = angles - space.decode(latent)[0].cpu().numpy()
    off_rad = float(np.sqrt(np.square(off).mean()))
    state, label, probability = update(state, angles, estimate.score, off_rad, gestures, frames)
    estimate = replace(estimate, gesture=label, gesture_probability=probability)
    if label == POINTING:
        origin, direction = pointing_ray(estimate.joints_m)
        estimate = replace(estimate, pointing_origin_m=origin, pointing_direction=direction)
    return state, estimate
