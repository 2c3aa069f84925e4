"""Hands of MakeHuman's body (CC0 1.0 Universal), posed finger by finger: meshes and true joints.

The folder is that of make_empty.py. Positions are metres in camera axes (x right, y down, z
forward) unless said otherwise.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from make_empty import Solid, read_body, read_target
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

_TO_CAMERA = np.array([0.1, -0.1, -0.1])
"""From MakeHuman's decimetres, y up, z to the front, to a person who faces the camera."""
_FINGERS = (2, 3, 4, 5)
_THUMB_ANGLES = 5
_WRIST_BENDS = 0.9
"""Radians at most."""


@dataclass(frozen=True)
class Pose:
    """Flexion in degrees of the three joints of index, middle, ring and little finger, from
    straight; and where the thumb's tip is: on the index finger's pad, or at rest on the middle
    finger's middle bone, which 1 and 0 stand for."""

    flexion: tuple[tuple[float, float, float], ...]
    pinch: float = 0.0

    def towards(self, other: Pose, share: float) -> Pose:
        """What lies between, share 0..1 of the way."""
        mixed = (1 - share) * np.array(self.flexion) + share * np.array(other.flexion)
        pinch = (1 - share) * self.pinch + share * other.pinch
        return Pose(tuple(map(tuple, mixed.tolist())), pinch)


@dataclass
class RightHand:
    """A right hand with its forearm, of a shape of MakeHuman's."""

    folder: Path
    shape: tuple[str, ...]
    _thumbs: dict[Pose, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points, faces, joints = read_body(self.folder)
        for name in self.shape:
            path = self.folder / "targets" / "macrodetails" / f"{name}.target.gz"
            points = points + read_target(path, points)
        points = points * _TO_CAMERA
        path = self.folder / "rigs" / "standard" / "weights.default.json"
        given = json.loads(path.read_text(encoding="utf-8"))["weights"]
        self.rest = {
            f"{finger}-{bone}": points[joints[f"joint-r-finger-{finger}-{bone}"]].mean(0)
            for finger in (1, *_FINGERS)
            for bone in (1, 2, 3, 4)
        }
        self.wrist, self._elbow = (
            points[joints[f"joint-r-{name}"]].mean(0) for name in ("hand", "elbow")
        )
        bones = ["lowerarm", "wrist", *(f"{f}-{b}" for f in (1, *_FINGERS) for b in (1, 2, 3))]
        weights = np.zeros((len(bones), len(points)))
        for bone, rows in given.items():
            name = bone.removesuffix(".R").removeprefix("finger")
            name = "wrist" if name.startswith("metacarpal") else name
            name = "lowerarm" if name.startswith("lowerarm") else name
            if bone.endswith(".R") and name in bones:
                for row, weight in rows:
                    weights[bones.index(name), row] += weight
        arm = weights.sum(0) > 0.5
        kept = np.nonzero(arm)[0]
        number = np.cumsum(arm) - 1
        self.faces = number[faces[arm[faces].all(1)]]
        self.body = Solid(points, faces[~arm[faces].all(1)], 0.55)
        self.points, self.bones = points[kept], bones
        self.weights = weights[:, kept] / weights[:, kept].sum(0)

    @cached_property
    def frame(self) -> np.ndarray:
        """(3, 3) columns: from the little finger's side to the thumb's, out of the back of the
        hand, from the wrist to the middle finger."""
        along = self.rest["3-1"] - self.wrist
        along /= np.linalg.norm(along)
        across = self.rest["2-1"] - self.rest["5-1"]
        across -= along * (across @ along)
        across /= np.linalg.norm(across)
        return np.stack((across, np.cross(along, across), along), 1)

    def _rotations(self, pose: Pose, thumb: np.ndarray) -> dict[str, np.ndarray]:
        """(4, 4) of each bone from where it rests, the hand itself at rest."""
        rotations = {"lowerarm": np.eye(4), "wrist": np.eye(4)}
        across, back, _ = self.frame.T
        for finger, flexion in zip(_FINGERS, pose.flexion, strict=True):
            first = self.rest[f"{finger}-2"] - self.rest[f"{finger}-1"]
            axis = np.cross(back, first)
            axis /= np.linalg.norm(axis)
            before, way = self.frame[:, 2], np.eye(4)
            for bone, wanted in enumerate(flexion, 1):
                along = self.rest[f"{finger}-{bone + 1}"] - self.rest[f"{finger}-{bone}"]
                has = np.arctan2(np.cross(before, along) @ axis, before @ along)
                way = way @ _about(self.rest[f"{finger}-{bone}"], (np.radians(wanted) - has) * axis)
                rotations[f"{finger}-{bone}"], before = way, along
        bend = np.cross(self.rest["1-2"] - self.rest["1-1"], self.rest["1-4"] - self.rest["1-3"])
        bend /= np.linalg.norm(bend)
        way = np.eye(4)
        for bone, vector in ((1, thumb[:3]), (2, thumb[3] * bend), (3, thumb[4] * bend)):
            way = way @ _about(self.rest[f"1-{bone}"], vector)
            rotations[f"1-{bone}"] = way
        return rotations

    def _tips(self, rotations: dict[str, np.ndarray]) -> np.ndarray:
        """(21, 3) joints in toftrack's order, the hand itself at rest."""
        found = [self.wrist]
        for finger in (1, *_FINGERS):
            for bone in (1, 2, 3, 4):
                turn = rotations[f"{finger}-{min(bone, 3)}"]
                found.append(turn[:3, :3] @ self.rest[f"{finger}-{bone}"] + turn[:3, 3])
        return np.array(found)

    def _thumb(self, pose: Pose) -> np.ndarray:
        """The thumb angles (5,): its tip beside the index finger's, or on the middle finger."""

        def off(turn: np.ndarray) -> np.ndarray:
            joints = self._tips(self._rotations(pose, turn))
            tip = joints[4]
            last = joints[7] - joints[8]
            pad = np.cross(last, self.frame[:, 0])
            index = joints[8] + 0.25 * last + 0.013 * pad / np.linalg.norm(pad)
            middle = 0.5 * (joints[10] + joints[11]) + self.frame @ [0.008, -0.012, 0.012]
            wanted = pose.pinch * index + (1 - pose.pinch) * middle
            return np.concatenate((100 * (tip - wanted), 0.25 * turn))

        if pose not in self._thumbs:
            self._thumbs[pose] = least_squares(off, np.zeros(_THUMB_ANGLES)).x
        return self._thumbs[pose]

    def joints(self, pose: Pose) -> np.ndarray:
        """(21, 3) the joints in the hand's own frame, the index finger's base at 0."""
        joints = self._tips(self._rotations(pose, self._thumb(pose)))
        return (joints - joints[5]) @ self.frame

    def posed(
        self, pose: Pose, turn: np.ndarray, place: np.ndarray, elbow: np.ndarray
    ) -> tuple[Solid, np.ndarray]:
        """The mesh, and the true joints (21, 3).

        turn: (3, 3) from the hand's own frame (see `frame`) to the camera's.
        place: of the index finger's base.
        elbow: (3,) the direction in which it is wanted; the wrist bends as far as it can.
        """
        rotations = self._rotations(pose, self._thumb(pose))
        arm = self._elbow - self.wrist
        axis = np.cross(arm, self.frame @ turn.T @ elbow)
        bent = np.arctan2(np.linalg.norm(axis), arm @ (self.frame @ turn.T @ elbow))
        axis *= min(bent, _WRIST_BENDS) / np.linalg.norm(axis)
        rotations["lowerarm"] = _about(self.wrist, axis)
        moved = np.zeros_like(self.points)
        for bone, weight in zip(self.bones, self.weights, strict=True):
            at = rotations[bone]
            moved += weight[:, None] * (self.points @ at[:3, :3].T + at[:3, 3])
        joints = self._tips(rotations)
        base, way = joints[5], turn @ self.frame.T
        return (
            Solid((moved - base) @ way.T + place, self.faces, 0.6),
            (joints - base) @ way.T + place,
        )


def _about(pivot: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """(4, 4) a rotation by a rotation vector about a point."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return turn
