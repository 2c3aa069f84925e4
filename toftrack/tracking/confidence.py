"""How likely an estimate, and each of its joints, is right: calibrated probabilities.

Logistic models of a few features of a frame, and a log-linear one of the joints' standard
deviations, all fitted by `toftrack.training` on rendered sequences of other hands, persons and
sensors than any recording that the tracker is judged on. hand/regions.py says along which axes the
deviations are, and what they mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from toftrack.compute.compiling import compiled, entry_point
from toftrack.compute.pace import FRAME_S, Duration
from toftrack.compute.rigid_numba import distance
from toftrack.detector.detection import Detection
from toftrack.errors import ToftrackError, check_number
from toftrack.files.json_text import read_json
from toftrack.frames.frame import DepthImage
from toftrack.render.segmentation import Observation

if TYPE_CHECKING:
    from toftrack.tracking.state import Track

_FITTED = Path(__file__).parents[1] / "data" / "confidence.json"
_LEAST = 1e-3
"""Least score, and least probability, of which the log is taken."""
_LIKELY = 0.03
"""Hypotheses that are less probable are not compared with the estimate."""
_NEAREST_M, _BEHIND_M = 0.05, 0.04
"""Least depth of a joint in projections; and how much nearer than a joint what hides it is."""
_HIDDEN, _OUT_OF_VIEW = 0.3, 0.4
"""A hand is hidden, or out of view, where more than this share of its joints is."""


@dataclass(frozen=True)
class ConfidenceFeatures:
    """Features for and against an estimate in one frame, each a number of order 1.

    log_score: log of the image's score.
    keypoints_off, farthest_keypoint_off: distance of the joints from the network's keypoints, mean
        and largest; like all distances here, log of centimetres.
    pose_off, likeliest_off: mean distance from the likely hypothesis that is most like it, and from
        the likeliest one.
    expected_error, unsure: the network's own expected error of that, and the mean standard
        deviation of its keypoints.
    absent, other_side: minus the log of the network's probability that there is a hand, and that it
        is this one: a hand that is turned round looks like the other one.
    unseen, hidden: shares of the joints that lie outside of the image, and behind something.
    young: 1 in the first frame of a track, falling.
    """

    log_score: float
    keypoints_off: float
    farthest_keypoint_off: float
    pose_off: float
    likeliest_off: float
    expected_error: float
    unsure: float
    absent: float
    other_side: float
    unseen: float
    hidden: float
    young: float

    def values(self) -> list[float]:
        """The features in the order of FEATURES."""
        return list(vars(self).values())


FEATURES = tuple(field.name for field in fields(ConfidenceFeatures))
NO_FEATURES = ConfidenceFeatures(*[0.0] * len(FEATURES))
"""The features before any frame."""


def confidence_features(
    joints_m: Tensor, score: float, track: Track, detection: Detection, observation: Observation
) -> ConfidenceFeatures:
    """The features of a track's estimate with joints (21, 3) in an image.

    track: as of the frame before; without a detection, all of its features but the score hold.
    """
    if detection.empty:
        return replace(track.features, log_score=math.log(max(score, _LEAST)))
    keypoints, k = detection.keypoints, observation.k.double().numpy()
    off = np.empty(len(detection.joints_m))
    known_m, sigma_m = keypoints.points_m.numpy(), keypoints.sigma_m.numpy()
    hypotheses_m, depth_m = detection.joints_m.numpy(), observation.depth_m.numpy()
    mean_m, most_m, unsure_m, unseen, hidden = compare_joints(
        joints_m.numpy(), known_m, sigma_m, hypotheses_m, depth_m, k, off
    )
    likely = off[detection.log_probability.numpy() > math.log(_LIKELY)]
    return ConfidenceFeatures(
        log_score=math.log(max(score, _LEAST)),
        keypoints_off=_log_cm(mean_m),
        farthest_keypoint_off=_log_cm(most_m),
        pose_off=_log_cm(float(likely.min() if len(likely) else off.min())),
        likeliest_off=_log_cm(float(off[0])),
        expected_error=_log_cm(float(detection.error_m[0])),
        unsure=_log_cm(unsure_m),
        absent=_surprise(detection.present),
        other_side=_surprise(detection.right_side),
        unseen=unseen,
        hidden=hidden,
        young=1 / (1 + track.age.seconds / FRAME_S),
    )


@entry_point
def compare_joints(joints, keypoints, sigma, hypotheses, depth, k, off):
    """How joints (21, 3) agree with a detection and an image (H, W).

    Returns their mean and largest distance from the keypoints, the keypoints' mean standard
    deviation, and the shares of joints outside of the image and behind something. Writes into `off`
    (H,) their mean distance from each hypothesis.
    """
    mean = most = unsure = 0.0
    for n in range(len(joints)):
        away = distance(joints[n], keypoints[n])
        mean, most, unsure = mean + away, max(most, away), unsure + sigma[n]
    for h in range(len(hypotheses)):
        off[h] = 0.0
        for n in range(len(joints)):
            off[h] += distance(joints[n], hypotheses[h, n]) / len(joints)
    outside, behind = sight(joints, depth, k)
    return mean / len(joints), most, unsure / len(joints), outside, behind


def log_odds(probability: float) -> float:
    """The log odds of a probability in 0 .. 1, both excluded."""
    return math.log(probability / (1 - probability))


def _log_cm(metres: float) -> float:
    return math.log(max(100 * metres, 0.05))


log_cm = compiled(_log_cm)
"""The same for kernels."""


def _surprise(probability: float) -> float:
    return -math.log(min(max(probability, _LEAST), 1.0))


@entry_point
def out_of_sight(joints, depth, k):
    """The shares of joints (21, 3) outside of the image (H, W), and of those behind something.

    k: (3, 3) float64.
    """
    return sight(joints, depth, k)


@compiled
def sight(joints, depth, k):
    """See out_of_sight."""
    outside = behind = 0
    for n in range(len(joints)):
        z = max(joints[n, 2], _NEAREST_M)
        read = reading(joints[n, 0] / z, joints[n, 1] / z, depth, k)
        outside += math.isnan(read)
        behind += read > 0 and read < z - _BEHIND_M
    return outside / len(joints), behind / len(joints)


@compiled
def reading(x, y, depth, k):
    """The depth in direction (x, y, 1): NaN outside of the image, 0 without a reading."""
    u, v = round(k[0, 0] * x + k[0, 2]), round(k[1, 1] * y + k[1, 2])
    if not (0 <= u < depth.shape[1] and 0 <= v < depth.shape[0]):
        return np.nan
    return max(np.float64(depth[int(v), int(u)]), 0.0)


JOINT_FEATURES = (
    "unsure",
    "keypoint_off",
    "finger_off",
    "outside",
    "unread",
    "behind",
    "before",
    "misfit",
    "pixel",
    "doubt",
)
"""Features of a joint, each a number of order 1 that is larger where it speaks against it:

unsure: the standard deviation of its keypoint, log of centimetres.
keypoint_off: how far it is from that keypoint, log of centimetres.
finger_off: the same of the farthest of its finger; at the wrist, the mean of all joints.
outside, unread: parts of its surroundings that are out of the image, or without a reading.
behind, before: how much farther or nearer it is than where it should be below the surface that is
    seen there, in units of 20 mm, 50 mm at most.
misfit: minus the log of the image's score.
pixel: log of a pixel's width there, in millimetres.
doubt: log(1 + exp(-x)) of the log odds x that the whole estimate is right.
"""
KINDS = (
    *("wrist", "thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip"),
    *("mcp", "pip", "dip", "tip"),
)
"""Joints that are alike."""
COLUMNS = ("ray", "finger", "across", "odds")
"""What a row of weights is about: log standard deviations in centimetres along three axes, see
hand/regions.py, and the log odds that the joint is within 40 mm."""
KIND_OF_JOINT = np.array([0, 1, 2, 3, 4] + 4 * [5, 6, 7, 8])
"""(21,) rows of KINDS."""
_KEYPOINTS = slice(0, 3)
"""The features that come from the network."""
_BELOW_M = np.array([0.012, 0.010, 0.010, 0.008, 0.004] + 4 * [0.010, 0.008, 0.007, 0.004])
"""(21,) how far joints roughly are below the surface that a camera sees."""
_AROUND_M = 0.006
"""Distance of the readings about a joint."""
_LEAST_CM, _MOST_CM = 0.1, 30.0
"""Standard deviations are never smaller or larger."""


@dataclass(frozen=True)
class JointConfidence:
    """The model of a joint's standard deviations and probability; see data/confidence.json.

    kinds: what each kind of joint begins with, in the order of COLUMNS.
    weights: of the features, likewise.
    """

    kinds: Mapping[str, Sequence[float]]
    weights: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        for name, known in (("kinds", KINDS), ("weights", JOINT_FEATURES)):
            rows = getattr(self, name)
            if set(rows) != set(known):
                raise ToftrackError(f"joints.{name} must have a row for each of {', '.join(known)}")
            for key, row in rows.items():
                if not isinstance(row, Sequence) or len(row) != len(COLUMNS):
                    raise ToftrackError(
                        f"joints.{name}.{key} must be {len(COLUMNS)} numbers: {', '.join(COLUMNS)}"
                    )
                for value in row:
                    check_number(f"joints.{name}.{key}", value)

    @cached_property
    def _kinds(self) -> np.ndarray:
        return np.array([list(self.kinds[name]) for name in KINDS])[KIND_OF_JOINT]

    @cached_property
    def _weights(self) -> np.ndarray:
        return np.array([list(self.weights[name]) for name in JOINT_FEATURES])

    def judge(self, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (21, 3), m, and probabilities (21,) from features (21, J)."""
        predicted = features @ self._weights + self._kinds
        sigma_cm = np.exp(predicted[:, :3].clip(-30.0, 30.0))
        sigma = sigma_cm.clip(_LEAST_CM, _MOST_CM) / 100
        odds = predicted[:, 3].clip(-30.0, 30.0)
        return sigma.astype(np.float32), (1 / (1 + np.exp(-odds))).astype(np.float32)


def joint_features(
    joints_m: np.ndarray,
    detection: Detection,
    last: np.ndarray,
    score: float,
    log_odds: float,
    image: DepthImage,
) -> np.ndarray:
    """(21, J) features of the joints (21, 3), in the order of JOINT_FEATURES.

    last: (21, J) of the frame before; in a frame without a detection, those of its keypoints hold.
    score: of the image, 0..1.  log_odds: that the estimate is right.
    """
    features = np.empty((len(joints_m), len(JOINT_FEATURES)))
    if detection.empty:
        features[:, _KEYPOINTS] = last[:, _KEYPOINTS]
    else:
        keypoints = detection.keypoints
        compare_keypoints(joints_m, keypoints.points_m.numpy(), keypoints.sigma_m.numpy(), features)
    look_around(joints_m, image.depth_m, image.k.astype(np.float64), _BELOW_M, features)
    features[:, JOINT_FEATURES.index("misfit")] = -math.log(max(score, _LEAST))
    features[:, JOINT_FEATURES.index("doubt")] = np.logaddexp(0.0, -log_odds)
    return features


@entry_point
def compare_keypoints(joints, keypoints, sigma, features):
    """Write the first three of JOINT_FEATURES of joints (21, 3), from the network's keypoints."""
    mean = 0.0
    for n in range(len(joints)):
        away = distance(joints[n], keypoints[n])
        mean += away / len(joints)
        features[n, 0], features[n, 1] = log_cm(sigma[n]), log_cm(away)
    features[0, 2] = log_cm(mean)
    for n in range(1, len(joints)):
        first = n - (n - 1) % 4
        features[n, 2] = features[first, 1]
        for other in range(first, first + 4):
            features[n, 2] = max(features[n, 2], features[other, 1])


@entry_point
def look_around(joints, depth, k, below, features):
    """Write what the image shows about joints (21, 3): outside, unread, behind, before, pixel.

    By 3 x 3 readings about each joint and their median.  below: (21,) m, see _BELOW_M.
    """
    near = np.empty(9)
    for n in range(len(joints)):
        z = max(joints[n, 2], _NEAREST_M)
        outside = count = 0
        for row in range(-1, 2):
            for column in range(-1, 2):
                x = (joints[n, 0] + _AROUND_M * column) / z
                read = reading(x, (joints[n, 1] + _AROUND_M * row) / z, depth, k)
                outside += math.isnan(read)
                if read > 0:  # sorted in: numba takes seconds to compile np.sort
                    at = count
                    while at > 0 and near[at - 1] > read:
                        near[at] = near[at - 1]
                        at -= 1
                    near[at] = read
                    count += 1
        deeper = 0.0
        if count > 0:
            # The lower middle is the median.
            deeper = joints[n, 2] - near[(count - 1) // 2] - below[n]
        features[n, 3], features[n, 4] = outside / 9, (9 - outside - count) / 9
        features[n, 5] = min(max(deeper, 0.0), 0.05) / 0.02
        features[n, 6] = min(max(-deeper, 0.0), 0.05) / 0.02
        features[n, 8] = math.log(1e3 * z / k[0, 0])


@dataclass(frozen=True)
class LogOdds:
    """A logistic model of a frame's features.

    intercept: log odds where all features are 0.  weights: of the features, by name.
    """

    intercept: float
    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        check_number("intercept", self.intercept)
        for name, value in self.weights.items():
            if name not in FEATURES:
                raise ToftrackError(
                    f"weights.{name} is unknown; the features are {', '.join(FEATURES)}"
                )
            check_number(f"weights.{name}", value)

    def __call__(self, features: ConfidenceFeatures) -> float:
        """The log odds of one frame."""
        return self.intercept + sum(w * getattr(features, n) for n, w in self.weights.items())


@dataclass(frozen=True)
class ConfidenceModel:
    """When an estimate is lost, and when its track ends; see conf/lost.

    confidence: estimates that are right with a lower probability are flagged lost.
    believe, believe_frames: what a new track must reach for so many frames in a row to be believed
        for the first time, as SORT's min_hits (Bewley et al., ICIP 2016).
    believe_at_once: a new track that reaches this is believed in that frame.
    give_up: below this, a frame is bad.  patience: bad frames in a row that end a track; 0 = none.
    whole: estimates whose mean joint error is below 40 mm with a lower probability are flagged lost
        as well: a hand taken for another one, or turned round, is not to be used at all, while one
        of whose joints a hidden thumb is wrong is, but for that joint.
    memory: part of the log odds that comes from the frames before.
    joint_ok: joints of an estimate that are near with a lower probability are not ok.
    log_odds: that every joint is within 40 mm, from one frame.  whole_odds: that their mean error
        is below that.  joints: of each joint.
    """

    confidence: float
    believe: float
    believe_at_once: float
    believe_frames: int
    give_up: float
    patience: int
    memory: float
    joint_ok: float
    whole: float
    log_odds: LogOdds
    whole_odds: LogOdds
    joints: JointConfidence

    def __post_init__(self) -> None:
        shares = ("confidence", "believe", "believe_at_once", "whole", "give_up", "joint_ok")
        for name in shares:
            check_number(f"lost.{name}", getattr(self, name), 0, 1)
        check_number("lost.believe_frames", self.believe_frames, 1, whole=True)
        check_number("lost.memory", self.memory, 0, 0.99)
        check_number("lost.patience", self.patience, 0, whole=True)


def make_confidence(fitted: str | None = None, **thresholds: Any) -> ConfidenceModel:
    """The confidence of a configuration.

    fitted: a file of fit_confidence; None = the package's.
    thresholds: the fields of ConfidenceModel that are numbers.
    Raises ToftrackError when the file cannot be used.
    """
    path = _FITTED if fitted is None else Path(fitted)
    try:
        content = read_json(path)
        log_odds, whole_odds = (
            LogOdds(float(content[name]["intercept"]), dict(content[name]["weights"]))
            for name in ("every_joint", "whole")
        )
        joints = JointConfidence(*(content["joints"][name] for name in ("kinds", "weights")))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, ToftrackError) as error:
        raise ToftrackError(
            f"lost.fitted='{path}' is no file of a fitted confidence ({error}); give a file of"
            " python -m toftrack.training fit-confidence, or leave it out"
        ) from None
    return ConfidenceModel(**thresholds, log_odds=log_odds, whole_odds=whole_odds, joints=joints)


@dataclass(frozen=True)
class Status:
    """What is thought of a frame's estimate.

    state_name, lost: as Estimate has them.
    confidence: probability that every joint is within 40 mm; NaN where nothing says.
    log_odds: the same, smoothed over time.  whole_odds: likewise of the mean joint error.
    likely, doubtful: as Track has them, with this frame.
    """

    state_name: str
    lost: bool
    confidence: float = math.nan
    log_odds: float = 0.0
    whole_odds: float = 0.0
    likely: Duration = Duration()
    doubtful: Duration = Duration()


def judge(
    track: Track, features: ConfidenceFeatures, dt_s: float, model: ConfidenceModel
) -> Status:
    """The status of a track's estimate, dt_s after its last one."""
    kept = model.memory ** (dt_s / FRAME_S) if track.age.begun else 0.0
    smooth = kept * track.log_odds + (1 - kept) * model.log_odds(features)
    whole = kept * track.whole_odds + (1 - kept) * model.whole_odds(features)
    confidence, probable = probability(smooth), probability(whole)
    # What was dropped between two frames was not doubtful: a frame counts twice FRAME_S at most.
    doubtful = track.doubtful.extended(dt_s, 2 * FRAME_S)
    doubtful = doubtful if confidence < model.give_up else Duration()
    likely = track.likely.extended(dt_s, FRAME_S) if confidence >= model.believe else Duration()
    at_once = confidence >= model.believe_at_once
    confirmed = track.confirmed or at_once or likely.reached(model.believe_frames)
    lost = not confirmed or confidence < model.confidence or probable < model.whole
    name = _state_name(features) if lost else "tracking"
    return Status(name, lost, confidence, smooth, whole, likely, doubtful)


def probability(log_odds: float) -> float:
    """The probability of log odds, which count up to 30 either way."""
    return 1 / (1 + math.exp(-min(max(log_odds, -30.0), 30.0)))


def _state_name(features: ConfidenceFeatures) -> str:
    """Why an estimate is lost."""
    if features.unseen > _OUT_OF_VIEW:
        return "out of view"
    return "hidden" if features.hidden > _HIDDEN else "searching"
