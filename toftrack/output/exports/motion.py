"""The hands of a run as skeletons that move: what is exported of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from toftrack.errors import ToftrackError
from toftrack.hand.openxr import OPENXR_JOINT_NAMES, OPENXR_PARENTS, openxr_hand, openxr_rig
from toftrack.hand.shape import SIDES, HandShape
from toftrack.hand.skeleton import forward_kinematics

_WRIST = OPENXR_JOINT_NAMES.index("wrist")


@dataclass(frozen=True, eq=False)
class HandMotion:
    """One hand over T frames: the 26 joints of OpenXR, each relative to the one it hangs on.

    slot: of the run.
    time_s: (T,) from 0 on, increasing.
    tracked: (T,) bool; where it is false, the pose is held from the frame before, or from the first
        tracked one.
    offset_m: (T, 26, 3) in the axes of the joint that each hangs on; of the wrist in the world.
    turn: (T, 26, 4) unit quaternions x y z w likewise, without jumps of sign.
    rest_offset_m: (26, 3) of the straight hand at the origin.
    shape: of the side that the hand had in most of its frames.
    suffix: of its joints' names, where another hand has the same side.
    """

    slot: int
    time_s: np.ndarray
    tracked: np.ndarray
    offset_m: np.ndarray
    turn: np.ndarray
    rest_offset_m: np.ndarray
    shape: HandShape
    suffix: str = ""

    def name(self, joint: str) -> str:
        """As the specification of OpenXR advises: "Index_Metacarpal_R"."""
        return f"{joint.title()}_{self.shape.side[0].upper()}{self.suffix}"


def motions_of(results: Mapping[str, Any], shapes: Sequence[HandShape]) -> list[HandMotion]:
    """The hands of a run's results, those that were tracked at all.

    results: of a track.npz; arrays of several hands have a second axis.
    shapes: the run's hands, one a slot.

    In a frame that was dropped a hand stays as the row has it, which is as it was before.

    Raises ToftrackError when no slot had a hand that was tracked.
    """
    names = [name for name in ("lost", "joints_m", "state", "side") if name in results]
    arrays = {name: np.asarray(results[name]) for name in names}
    if arrays["lost"].ndim == 1:
        arrays = {name: array[:, None] for name, array in arrays.items()}
    time_s = _times(np.asarray(results["timestamp_s"], np.float64))
    found: list[HandMotion] = []
    for slot in range(arrays["lost"].shape[1]):
        hand = {name: array[:, slot] for name, array in arrays.items()}
        motion = _motion(slot, hand, shapes[slot], time_s)
        if motion is None:
            continue
        # What animates a hand finds its joints by their names.
        if any(motion.shape.side == other.shape.side for other in found):
            motion = replace(motion, suffix=f"_{slot + 1}")
        found.append(motion)
    if not found:
        raise ToftrackError(
            "no frame of this run has a hand that is not lost, so there is nothing to export"
        )
    return found


def relative(position: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints in the world to each in the axes of the one that it hangs on.

    position: (T, 26, 3).  turned: (T, 26, 4).  Returns the same shapes.
    """
    offset, turn = np.empty_like(position), np.empty_like(turned)
    for joint, parent in enumerate(OPENXR_PARENTS):
        if parent < 0:
            offset[:, joint], turn[:, joint] = position[:, joint], turned[:, joint]
            continue
        back = Rotation.from_quat(turned[:, parent]).inv()
        offset[:, joint] = back.apply(position[:, joint] - position[:, parent])
        turn[:, joint] = (back * Rotation.from_quat(turned[:, joint])).as_quat()
    return offset, turn


def rest_joints(shape: HandShape) -> tuple[np.ndarray, np.ndarray]:
    """(26, 3) and (26, 4) of the straight hand with the wrist at the origin, in the world."""
    rest = torch.zeros(1, 27, dtype=torch.float64)
    joints = forward_kinematics(rest, shape.to("cpu", torch.float64)).joints_m.numpy()
    hand = openxr_hand(joints[0], rest[0].numpy(), openxr_rig(shape))
    return hand.position_m, hand.orientation


def _motion(
    slot: int, hand: dict[str, np.ndarray], shape: HandShape, time_s: np.ndarray
) -> HandMotion | None:
    """The motion of a slot's hand, None where it never had one."""
    finite = np.isfinite(hand["joints_m"]).all((1, 2)) & np.isfinite(hand["state"]).all(1)
    tracked = ~hand["lost"].astype(bool) & finite
    if not tracked.any():
        return None
    side = np.asarray(hand.get("side", np.full(len(tracked), shape.side)))
    reported = list(side[tracked])
    shape = shape.of_side(max(SIDES, key=reported.count) if any(reported) else shape.side)
    held = np.maximum.accumulate(np.where(tracked, np.arange(len(tracked)), -1))
    held = np.where(held < 0, tracked.argmax(), held)
    there = openxr_hand(hand["joints_m"], hand["state"], openxr_rig(shape))
    # Until handedness was detected, or where a slot took another one.
    (opposite,) = set(SIDES) - {shape.side}
    other = side == opposite
    mirrored = openxr_rig(shape.of_side(opposite))
    as_other = openxr_hand(hand["joints_m"][other], hand["state"][other], mirrored)
    there.position_m[other], there.orientation[other] = as_other.position_m, as_other.orientation
    offset, turn = relative(there.position_m[held], there.orientation[held])
    position, turned = rest_joints(shape)
    rest_offset, _ = relative(position[None], turned[None])
    return HandMotion(slot, time_s, tracked, offset, _smooth_signum(turn), rest_offset[0], shape)


def _smooth_signum(turn: np.ndarray) -> np.ndarray:
    """(T, 26, 4) quaternions, each with the sign that lies nearer to the one before."""
    agree = np.einsum("tjq,tjq->tj", turn[1:], turn[:-1]) >= 0
    signum = np.cumprod(np.where(agree, 1.0, -1.0), axis=0)
    return np.concatenate((turn[:1], turn[1:] * signum[..., None]))


def _times(timestamp_s: np.ndarray) -> np.ndarray:
    """(T,) from 0 on; where time stands still or goes back, frames of even length."""
    steps = np.diff(timestamp_s)
    if not (steps > 0).all():
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1 / 25
        return step * np.arange(len(timestamp_s))
    return timestamp_s - timestamp_s[:1]
