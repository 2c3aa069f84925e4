"""Signs that an estimate is right or wrong, read off a frame; belief.py weighs them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.detector.hand_detector import Detection

_LEAST = 1e-3
_LIKELY = 0.03


@dataclass(frozen=True)
class ConfidenceFeatures:
    """What speaks for and against an estimate in one frame; each is a number of order 1.

    log_score: of the image, per factor e.
    votes_off, farthest_vote_off: how far the joints are from the networks' votes, on average and
        the farthest, log of centimetres.
    pose_off: likewise from the hypothesis that is most like it, on average.
    likeliest_off: likewise from the likeliest hypothesis.
    expected_error, unsure: what the networks think of their own hypothesis and votes, likewise.
    absent, other_side: log odds that there is no hand, or that it is the other one.
    unseen: share of the joints that lie outside of the image.
    hidden: share of the joints that lie behind something.
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
        """In the order of SIGNS."""
        return [getattr(self, name) for name in FEATURES]


FEATURES = tuple(field.name for field in fields(ConfidenceFeatures))


def confidence_features(
    joints_m: Tensor, score: float, age_s: float, detection: Detection, depth_m: Tensor, k: Tensor
) -> ConfidenceFeatures:
    """The signs of an estimate with joints (21, 3) in an image (H, W) with intrinsics k.

    age_s: seconds since its track began.
    """
    joints = joints_m.cpu()
    at = joints.numpy()
    keypoints = np.linalg.norm(at - detection.keypoints.points_m.numpy(), axis=1)
    off = np.linalg.norm(at - detection.joints_m.numpy(), axis=-1).mean(1)
    likely = off[detection.log_probability.numpy() > math.log(_LIKELY)]
    unseen, hidden = out_of_sight(joints, depth_m, k)
    return ConfidenceFeatures(
        log_score=math.log(max(score, _LEAST)),
        keypoints_off=_log_cm(float(keypoints.mean())),
        farthest_keypoint_off=_log_cm(float(keypoints.max())),
        pose_off=_log_cm(float(likely.min()) if len(likely) else float(off.min())),
        likeliest_off=_log_cm(float(off[0])),
        expected_error=_log_cm(float(detection.error_m[0])),
        unsure=_log_cm(float(detection.keypoints.sigma_m.numpy().mean())),
        absent=_log_odds(1 - detection.present),
        other_side=_log_odds(1 - detection.right_side),
        unseen=unseen,
        hidden=hidden,
        young=1 / (1 + age_s / FRAME_S),
    )


def scored(features: ConfidenceFeatures, score: float) -> ConfidenceFeatures:
    """The same signs with another score of the image, 0 .. 1."""
    return replace(features, log_score=math.log(max(score, _LEAST)))


def _log_cm(metres: float) -> float:
    return math.log(max(100 * metres, 0.05))


def _log_odds(probability: float) -> float:
    p = min(max(probability, _LEAST), 1 - _LEAST)
    return math.log(p / (1 - p))


def out_of_sight(joints: Tensor, depth_m: Tensor, k: Tensor) -> tuple[float, float]:
    """Shares of the joints (21, 3) outside of the image (H, W), and of those behind something."""
    depth, k_px, at = depth_m.cpu().numpy(), k.cpu().numpy(), joints.numpy()
    z = np.maximum(at[:, 2], np.float32(0.05))
    u = np.rint(k_px[0, 0] * at[:, 0] / z + k_px[0, 2])
    v = np.rint(k_px[1, 1] * at[:, 1] / z + k_px[1, 2])
    height, width = depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    column, row = np.where(inside, u, 0).astype(np.int64), np.where(inside, v, 0).astype(np.int64)
    seen = depth[row, column]
    behind = inside & (seen > 0) & (seen < z - np.float32(0.04))
    count = len(at)
    return 1 - np.count_nonzero(inside) / count, np.count_nonzero(behind) / count
