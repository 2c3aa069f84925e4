"""What a track.npz says of itself, so that it can be read without this package."""

from __future__ import annotations

from typing import Any

import numpy as np

from toftrack.hand.openxr import OPENXR_JOINT_NAMES, OPENXR_PARENTS
from toftrack.hand.skeleton import ANGLE_NAMES, JOINT_PARENTS

_README = """Hands that toftrack followed, a row for each frame of the input. Metres, seconds and
radians. Camera axes: x right, y down, z forward; pixel centres lie at whole numbers, so that
u = K[0,0] x/z + K[0,2], v = K[1,1] y/z + K[1,2] in the undistorted image of image_size_px (width,
height). joint_names, joint_parents: of joints_m and landmarks, in MediaPipe's order;
angle_names: of the 21 joint angles, radians, flexion positive, which are state[..., 6:];
openxr_joint_names, openxr_joint_parents: of openxr_*, whose axes are x right, y up, -z forward. The
parent of a root is -1. Do not use rows with lost, nor joints without joint_ok; NaN is unknown.
metadata is JSON."""


def facts_for_readers(metadata: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays beside those of the frames: names, skeletons, camera, and a text that explains them.

    metadata: of the run; a camera that it does not tell is left out.
    """
    facts = {
        "readme": np.array(_README),
        "angle_names": np.array(ANGLE_NAMES),
        "joint_parents": np.array(JOINT_PARENTS),
        "openxr_joint_names": np.array(OPENXR_JOINT_NAMES),
        "openxr_joint_parents": np.array(OPENXR_PARENTS),
    }
    camera = metadata.get("camera") or {}
    if camera.get("K"):
        facts["K"] = np.array(camera["K"], np.float64)
        facts["image_size_px"] = np.array([camera["width"], camera["height"]])
    return facts
