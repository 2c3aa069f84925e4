"""Which gesture a hand makes: one of those that are known, of those that a user names, or other.

A pose is described by the numbers of `features`, which do not depend on how the hand is
turned. A class says that these lie in its ranges, with normal tails to both sides; or says nothing
of some of them. "other" says nothing at all: everything is equally likely within the joint limits.
Bayes' rule with equal priors gives the probabilities. The tails are wide, for people make a gesture
each in their own way, and the tracker errs: palm and fist differ by 240 degrees in a finger's total
flexion.

A user's gesture is one or more named poses of joint angles: each with a range of a tail's width,
and of what it varied by where it was recorded, to both sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from toftrack.compute.compiling import entry_point
from toftrack.errors import ToftrackError, check_choice
from toftrack.frames.estimate import Estimate
from toftrack.gestures import features
from toftrack.gestures.definitions import FIST, OTHER, RAY_GESTURES, SETS, Definition
from toftrack.gestures.files import NamedPose, read_poses
from toftrack.gestures.pinch import PinchSettings, PinchState, pinch_of, update_pinch
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.pose_space.base import PoseSpace

_RAY = JOINT_NAMES.index("index_mcp"), JOINT_NAMES.index("index_tip")
_OFF_RANGE_RAD = 0.5
"""How far off the pose space a hand may be at all, rms over the angles."""
FLEXION_RAD, _SPLIT_RAD, _THUMB_RAD, _TIPS_PALMS = 0.44, 0.60, 0.20, 0.12
"""How far out of a gesture's range may be: a finger's total flexion, of which palm and fist are 4
apart; its split between the knuckle and the outer joints; the thumb's abduction; and, in palm
lengths, where the tips are: a thumb folded in and one stretched away are 0.4 apart."""
WIDTHS = np.repeat((_THUMB_RAD, FLEXION_RAD, FLEXION_RAD, _SPLIT_RAD, _TIPS_PALMS), (1, 1, 4, 4, 3))
"""(13,) standard deviations of the features' tails."""
_DOUBTFUL_SCORE, _SURE_SCORE = 0.5, 0.75
"""A frame of that score, or confidence where that is higher, says nothing; and all it can."""
_LEAST_WIDTH = 1e-3
"""Of the pose space's term and of the weight of "other": squares of less overflow."""
_JOINT = 0.34
"""Probability of being within 40 mm from which a joint is asked, where `joint_ok` wants more;
higher leaves more gestures unnamed."""


@dataclass(frozen=True)
class GestureSettings:
    """How labels are decided; see conf/gestures for what each does."""

    off_rad: float | None
    other: float
    smoothing: float
    margin: float
    pinch: PinchSettings

    def __post_init__(self) -> None:
        widths = (self.other,) if self.off_rad is None else (self.other, self.off_rad)
        if not all(_LEAST_WIDTH <= width < math.inf for width in widths):
            raise ToftrackError(
                f"gestures.off_rad and gestures.other must be at least {_LEAST_WIDTH}"
            )
        if not (0 <= self.smoothing < 1 and 0 <= self.margin < 1):
            raise ToftrackError("gestures.smoothing and gestures.margin must be in 0 .. below 1")


@dataclass(frozen=True, eq=False)
class Gestures:
    """The classes that are told apart.

    names: C class names, "other" last.  low, high: (M, 13) the ranges of their definitions'
    features, NaN where a definition says nothing.  classes: (M,) a definition's class.  own: (M,)
    bool, those of the user.
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    classes: np.ndarray
    own: np.ndarray
    settings: GestureSettings

    def probabilities(self, values: np.ndarray, score: float, off_rad: float) -> np.ndarray:
        """Of each class for one frame by itself, (C,), sum 1.

        values: (13,), see features; NaN says nothing.  score: 0..1; below _DOUBTFUL_SCORE all
        classes are equally probable.  off_rad: rms distance of the angles from the pose space; NaN
        says nothing.
        """
        cfg, near = self.settings, 0.0
        if cfg.off_rad is not None and math.isfinite(off_rad):
            near = math.log(_OFF_RANGE_RAD * 2 / (cfg.off_rad * math.sqrt(2 * math.pi)))
            near -= 0.5 * (off_rad / cfg.off_rad) ** 2
        trust = (score - _DOUBTFUL_SCORE) / (_SURE_SCORE - _DOUBTFUL_SCORE)
        trust = min(max(trust, 0.0), 1.0)
        log_poses, found = self._log_densities(values), np.empty(len(self.names))
        log_poses[~self.own] += near
        class_probabilities(log_poses, self.classes, math.log(cfg.other), trust, found)
        return found

    def decided(self, label: str, values: np.ndarray) -> bool:
        """Whether all is known that makes a hand's pose this class: of its definition that suits
        the values (13,) best every feature. Of "other" nothing needs to be known.
        """
        unknown = np.isnan(values)
        mine = self.classes == self.names.index(label)
        if label == OTHER or not unknown.any() or not mine.any():
            return True
        best = self.low[mine][self._log_densities(values)[mine].argmax()]
        return not (unknown & ~np.isnan(best)).any()

    def _log_densities(self, values: np.ndarray) -> np.ndarray:
        """(M,) of the values (13,), in parts of the uniform density of "other"."""
        found = np.empty(len(self.low))
        log_densities(values, self.low, self.high, self._most, found)
        return found

    @cached_property
    def _most(self) -> np.ndarray:
        """(M, 13) likewise within the ranges."""
        extent = self.high - self.low + WIDTHS * math.sqrt(2 * math.pi)
        return np.log(np.maximum(features.RANGES, extent) / extent)


@entry_point
def log_densities(values, low, high, most, found):
    """See Gestures._log_densities; into `found` (M,)."""
    for m in range(len(found)):
        found[m] = 0.0
        for n in range(len(values)):
            said = most[m, n]
            if not (math.isnan(said) or math.isnan(values[n])):
                beyond = max(low[m, n] - values[n], values[n] - high[m, n], 0.0) / WIDTHS[n]
                found[m] += said - 0.5 * beyond * beyond


@entry_point
def class_probabilities(log_poses, classes, other, trust, found):
    """Of classes, into `found` (C,); that of "other", the last one, has a pose of density 1, too.

    log_poses: (M,) log densities of the definitions' poses.  classes: (M,) theirs.
    other: log prior weight of "other".  trust: 0 .. 1, what the frame counts.
    """
    # Loops: numba takes seconds to compile what arrays have for each of these.
    last, largest, whole = len(found) - 1, -np.inf, 0.0
    for c in range(len(found)):
        most = 0.0 if c == last else -np.inf
        for m in range(len(classes)):
            if classes[m] == c:
                most = max(most, log_poses[m])
        number, total = (1, math.exp(-most)) if c == last else (0, 0.0)
        for m in range(len(classes)):
            if classes[m] == c:
                number += 1
                total += math.exp(log_poses[m] - most)
        found[c] = trust * (most + math.log(total / number) + (other if c == last else 0.0))
        largest = max(largest, found[c])
    for c in range(len(found)):
        found[c] = math.exp(found[c] - largest)
        whole += found[c]
    for c in range(len(found)):
        found[c] /= whole


@dataclass(frozen=True, eq=False)
class GestureState:
    """What is carried from frame to frame: smoothed probabilities (C,), the label, the pinch."""

    probabilities: np.ndarray
    label: str
    pinch: PinchState = field(default_factory=PinchState)


def make_gestures(
    file: str | None = None, *, known: str, pinch: PinchSettings, **settings: float
) -> Gestures:
    """The gestures that are known, and those that a file names (see gestures.files).

    file: its poses become further classes; those with the name of a known gesture take its place.
    known: a name of definitions.SETS.  settings: of GestureSettings.
    """
    named = [] if file is None else read_poses(file)
    return gestures_with(known, named, GestureSettings(pinch=pinch, **settings), str(file))


def no_gestures() -> None:
    """No gesture output: gestures=none."""


def definition_of(pose: NamedPose) -> Definition:
    """A user's pose as ranges: a tail's width and its spread to both sides."""
    values = features.features_of_angles(pose.angles_rad)
    half = WIDTHS.copy()
    half[: len(features.SUMS)] += np.sqrt(features.SUMS**2 @ pose.spread_rad**2)
    return Definition(pose.name, values - half, values + half)


def gestures_with(
    known: str, named: Sequence[NamedPose], settings: GestureSettings, source: str
) -> Gestures:
    """The known gestures and a user's poses, which are from `source`; as make_gestures."""
    check_choice("gestures.known", known, SETS)
    taken = {pose.name for pose in named}
    if OTHER in taken:
        raise ToftrackError(
            f"{source} names a gesture 'other', which means none of the gestures; rename it"
        )
    basic = [definition for definition in SETS[known] if definition.name not in taken]
    definitions = [*basic, *map(definition_of, named)]
    names = [name for name in dict.fromkeys(d.name for d in definitions) if name != OTHER]
    names.append(OTHER)
    gestures = Gestures(
        names=tuple(names),
        low=np.stack([definition.low for definition in definitions]),
        high=np.stack([definition.high for definition in definitions]),
        classes=np.array([names.index(definition.name) for definition in definitions]),
        own=np.arange(len(definitions)) >= len(basic),
        settings=settings,
    )
    for own in range(len(basic), len(definitions)):
        name = definitions[own].name
        if np.isnan(definitions[own].low[features.FLEXION]).all():
            raise ToftrackError(
                f"{source}: gesture {name!r} says nothing about any finger's flexion; give all"
                " three flexions of at least one finger"
            )
        for other in range(own):
            different = definitions[other].name not in (name, OTHER)
            if different and _alike(gestures, own, other):
                raise ToftrackError(
                    f"{source}: gestures {definitions[other].name!r} and {name!r} are too much"
                    " alike to be told apart; give them one name, or poses that differ more"
                )
    return gestures


def _alike(gestures: Gestures, own: int, other: int) -> bool:
    """Whether a user's pose lies within another definition, of which it knows no more."""
    low, high = gestures.low[[own, other]], gestures.high[[own, other]]
    if gestures.own[other]:
        low = high = (low + high) / 2
    value = (low[0] + high[0]) / 2
    known = ~np.isnan(low)
    thumb = [features.THUMB_ABDUCTION, features.THUMB_FLEXION, features.REACH, features.GAP]
    said = np.column_stack((known[:, features.FLEXION], known[:, thumb].any(1)))
    more = said[0] & ~said[1] if not gestures.own[other] else said[0] != said[1]
    apart = np.maximum(np.maximum(low[1] - value, value - high[1]), 0) / WIDTHS
    return not more.any() and bool((apart[known.all(0)] < 1).all())


def update(
    state: GestureState | None,
    values: np.ndarray,
    score: float,
    off_rad: float,
    gestures: Gestures,
    frames: float = 1.0,
) -> tuple[GestureState, str, float]:
    """One frame on: the new state, the label and its probability.

    The probabilities are smoothed over time, and the label changes only when another one's exceeds
    its own by `margin`; so the probability of a label that is about to change may be the smaller.

    state: of the frame before; None at the start or after the hand was lost.
    values: (13,) features of the refined estimate.  score: its score, 0..1.
    off_rad: rms distance of the angles from the pose space, rad; NaN where there is none.
    frames: how many times 1/25 s have passed since the state.
    """
    cfg = gestures.settings
    smooth = gestures.probabilities(values, score, off_rad)
    if state is None:
        best, pinch = int(smooth.argmax()), PinchState()
    else:
        keep = cfg.smoothing**frames
        smooth = keep * state.probabilities + (1 - keep) * smooth
        best, pinch = int(smooth.argmax()), state.pinch
        current = gestures.names.index(state.label)
        best = best if smooth[best] > smooth[current] + cfg.margin else current
    label = gestures.names[best]
    return GestureState(smooth, label, pinch), label, float(smooth[best])


def pointing_ray(joints_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the index finger points, camera frame: its base (3,) m, and the unit vector to its tip.

    joints_m: (21, 3).
    """
    base, tip = (joints_m[number] for number in _RAY)
    way = tip - base
    return base.copy(), way / np.linalg.norm(way)


def without_gesture(estimate: Estimate) -> Estimate:
    """The same without a gesture, a pinch and a pointing ray, as of a hand that is lost."""
    nowhere = np.full(3, np.nan, np.float32)
    return estimate.updated(
        gesture="",
        gesture_probability=math.nan,
        pinch=math.nan,
        pinching=False,
        pointing_origin_m=nowhere,
        pointing_direction=nowhere,
    )


def tell_gesture(
    gestures: Gestures | None,
    state: GestureState | None,
    estimate: Estimate,
    space: PoseSpace,
    frames: float = 1.0,
) -> tuple[GestureState | None, Estimate]:
    """The estimate with its gesture and pinch, and with the pointing ray while it points.

    A hand that is lost has no gesture ("" and NaN). Only joints that are ok, or likely enough, are
    asked: a gesture that others decide is not named, and so with the pinch.
    """
    if gestures is None or estimate.lost:
        return None, without_gesture(estimate)
    angles = estimate.state[6:].astype(np.float64)
    off_rad = math.nan
    if gestures.settings.off_rad is not None:
        latent = space.lower.new_tensor(estimate.latent)[None]
        off = angles - space.decode(latent)[0].cpu().numpy()
        off_rad = float(np.sqrt(np.square(off).mean()))
    joints = estimate.joints_m.astype(np.float64)
    # Which fingers are straight is told by joints that are less exact than who uses a joint wants.
    asked = estimate.joint_ok | (estimate.joint_confidence >= _JOINT)
    values = features.features(angles, joints, asked)
    # Of a hand on a table much of the image is not explained, and the pose is right all the same.
    score = float(np.fmax(estimate.score, estimate.confidence))
    state, label, probability = update(state, values, score, off_rad, gestures, frames)
    if not gestures.decided(label, values):
        label, probability = "", math.nan
    pinch = pinch_of(joints, gestures.settings.pinch, asked)
    # The thumb of a fist lies beside the index finger's tip and pinches nothing.
    nothing = label == FIST and not state.pinch.pinching
    pinched = update_pinch(state.pinch, 0.0 if nothing else pinch, gestures.settings.pinch, frames)
    state = replace(state, pinch=pinched)
    estimate = estimate.updated(
        gesture=label,
        gesture_probability=probability,
        pinch=pinch,
        pinching=pinched.pinching,
    )
    if label in RAY_GESTURES:
        origin, direction = pointing_ray(estimate.joints_m)
        estimate = estimate.updated(pointing_origin_m=origin, pointing_direction=direction)
    return state, estimate
