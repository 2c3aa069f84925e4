"""Sizes of the hand: bone lengths, where the fingers are rooted, and how thick they are.

The proportions are anthropometric means. Phalanges with the soft tissue of the tips, and
metacarpals: Buryanov and Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28(3), 2010.
Finger breadths and hand breadth: Gordon et al., "2012 anthropometric survey of U.S. Army
personnel" (ANSUR II), mean of both sexes. The wrist's centre of rotation lies in the head of the
capitate (Youm et al., J. Bone Joint Surg. 60-A, 1978), which puts the middle finger's knuckle at
0.49 of the hand's length. All are scaled so that wrist to middle fingertip is the hand length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from toftrack.errors import ToftrackError, check_format, check_number, reported_errors
from toftrack.files.json_text import read_json, write_json

SIDES = ("right", "left")
DEFAULT_HAND_LENGTH_M = 0.190
"""Wrist to middle fingertip: ANSUR II, between the means of men (193 mm) and women (181 mm)."""

_FORMAT = "toftrack-hand-shape"
_VERSION = 2
_TENSORS = ("base_m", "base_frames", "bone_lengths_m")
_BONE_M = 0.002, 0.25
"""Bones of a hand are longer, and they and the way from the wrist to a knuckle shorter."""

# Everything below is in millimetres for a hand of 190 mm and scaled from there.
# Thumb CMC and the four knuckles in the hand frame. The transverse arch of the palm sets the
# index and little knuckles towards the palm (-z).
_BASE_MM = (
    (27.0, -34.0, -17.0),
    (24.0, -89.5, -6.5),
    (1.0, -92.5, -3.0),
    (-18.0, -86.5, -6.0),
    (-35.5, -75.0, -12.5),
)
# The thumb's first bone is the distal part of its metacarpal: the centre of the saddle joint's
# motion as seen from outside lies well distal of the joint's surface.
_BONES_MM = (
    (34.0, 33.5, 26.5),
    (43.5, 24.0, 21.7),
    (46.9, 27.6, 23.0),
    (43.2, 26.8, 22.8),
    (34.5, 19.7, 21.0),
)
# Rest directions of the fingers: (abduction in the plane of the palm, elevation out of it towards
# the palm, roll about the bone), degrees. The thumb's nail faces sideways when the palm is open.
_REST_DEGREES = (
    (42.0, 14.0, 40.0),
    (3.0, 0.0, -3.0),
    (-4.0, 0.0, 0.0),
    (-12.0, 0.0, 5.0),
    (-19.0, 0.0, 10.0),
)


@dataclass(frozen=True)
class Fitted:
    """How a shape was fitted to its user, in components (hand/shape_space.py).

    names: of the components.  mean: (K,).  covariance: (K, K), rows.
    poses: how many different, well seen poses it rests on.
    frozen: nothing more was learned.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    poses: float
    frozen: bool

    @property
    def sigma(self) -> tuple[float, ...]:
        """(K,) standard deviations of the components."""
        return tuple(math.sqrt(row[k]) for k, row in enumerate(self.covariance))

    def content(self) -> dict[str, Any]:
        """As it stands in the file."""
        return {
            "components": dict(zip(self.names, self.mean, strict=True)),
            "sigma": dict(zip(self.names, self.sigma, strict=True)),
            "covariance": [list(row) for row in self.covariance],
            "poses": self.poses,
            "frozen": self.frozen,
        }

    @staticmethod
    def of(content: dict[str, Any]) -> Fitted:
        """What `content` wrote; KeyError, TypeError or ValueError when it is not that."""
        names, mean = zip(*content["components"].items(), strict=True)
        covariance = tuple(tuple(map(float, row)) for row in content["covariance"])
        if [len(row) for row in covariance] != [len(names)] * len(names):
            raise ValueError("a covariance of another size than the components")
        if any(row[k] < 0 for k, row in enumerate(covariance)):
            raise ValueError("a variance below 0")
        return Fitted(
            names,
            tuple(map(float, mean)),
            covariance,
            float(content["poses"]),
            bool(content["frozen"]),
        )


@dataclass(frozen=True, eq=False)
class HandShape:
    """Sizes of one hand, metres, in the hand frame of a right hand.

    base_m: (5, 3) thumb CMC and the four knuckles.
    base_frames: (5, 3, 3) rest orientation of each finger's first bone, distal end along -y.
    bone_lengths_m: (5, 3) lengths of the three bones of each finger, the last up to the tip of the
        surface.
    thickness: scale of all thicknesses relative to the default hand's proportions.
    side: "right" or "left".
    fitted: how it was fitted to its user; None where it was not.
    """

    base_m: Tensor
    base_frames: Tensor
    bone_lengths_m: Tensor
    thickness: float = 1.0
    side: str = "right"
    fitted: Fitted | None = None

    # Copies that share their tensors have the same surface, which is kept for both. Dataclasses ask
    # `==` of each field from Python 3.13 on, and that of tensors has no truth value.
    def _same(self) -> tuple[object, ...]:
        tensors = map(id, (self.base_m, self.base_frames, self.bone_lengths_m))
        return (*tensors, self.thickness, self.side, self.fitted)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HandShape) and self._same() == other._same()

    def __hash__(self) -> int:
        return hash(self._same())

    def to(self, *args: object, **kwargs: object) -> HandShape:
        """The same shape on another device or of another dtype, as `torch.Tensor.to`."""
        return replace(self, **{name: getattr(self, name).to(*args, **kwargs) for name in _TENSORS})

    @cached_property
    def hand_length_m(self) -> float:
        """Wrist to the middle finger's tip when the finger is straight."""
        return float(self.base_m[2].norm() + self.bone_lengths_m[2].sum())

    def of_side(self, side: str) -> HandShape:
        """The mirror image, or the same; ToftrackError for an unknown side."""
        if side not in SIDES:
            raise ToftrackError(f"hand.side={side} is unknown; give hand.side=auto, right or left")
        return replace(self, side=side)

    def save(self, path: str | Path) -> None:
        """Write the shape as JSON."""
        content = {
            "format": _FORMAT,
            "version": _VERSION,
            "side": self.side,
            "thickness": self.thickness,
            **{name: getattr(self, name).tolist() for name in _TENSORS},
            "fitted": self.fitted and self.fitted.content(),
        }
        write_json(path, content)

    @staticmethod
    def load(path: str | Path) -> HandShape:
        """Read a shape written by `save`; ToftrackError when it is not one."""
        remedy = "give hand.shape=default or a file of a hand's shape"
        with reported_errors(f"{path} cannot be read", remedy, OSError, ValueError):
            content = read_json(path)
        check_format(path, content, _FORMAT, _VERSION, "a hand shape file", remedy)
        fitted = content.get("fitted")
        expected = (KeyError, TypeError, ValueError, AttributeError, RuntimeError)
        with reported_errors(f"{path} is a damaged hand shape file", remedy, *expected):
            shape = HandShape(
                **{name: torch.tensor(content[name], dtype=torch.float32) for name in _TENSORS},
                thickness=float(content["thickness"]),
                side=str(content["side"]),
                fitted=None if fitted is None else Fitted.of(fitted),
            )
            sizes = (shape.base_m.shape, shape.base_frames.shape, shape.bone_lengths_m.shape)
            if sizes != ((5, 3), (5, 3, 3), (5, 3)) or shape.side not in SIDES:
                raise ValueError(f"sizes {sizes}, {shape.side}")
            if not shape._sensible:
                raise ValueError("its numbers make no hand")
        return shape

    @property
    def _sensible(self) -> bool:
        """Whether its numbers can be those of a hand."""
        shortest, longest = _BONE_M
        turned = self.base_frames @ self.base_frames.mT - torch.eye(3)
        return bool(
            turned.abs().max() < 1e-2
            and (self.base_m.norm(dim=1) < longest).all()
            and (self.bone_lengths_m > shortest).all()
            and (self.bone_lengths_m < longest).all()
            and 0.2 <= self.thickness <= 5
        )


def _rotation(degrees: float, axis: int) -> Tensor:
    vector = torch.zeros(3, 3, dtype=torch.float64)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    vector[i, j], vector[j, i] = -math.radians(degrees), math.radians(degrees)
    return torch.matrix_exp(vector)


def default_hand_shape(
    hand_length_m: float = DEFAULT_HAND_LENGTH_M, side: str = "right", thickness: float = 1.0
) -> HandShape:
    """The mean adult hand, scaled to a hand length in metres; float32 on the CPU."""
    remedy = ", in metres from the wrist to the middle fingertip"
    check_number("hand.length_m", hand_length_m, 0.08, 0.30, remedy=remedy)
    frames = [
        _rotation(abduction, 2) @ _rotation(elevation, 0) @ _rotation(roll, 1)
        for abduction, elevation, roll in _REST_DEGREES
    ]
    base = torch.tensor(_BASE_MM, dtype=torch.float64)
    bones = torch.tensor(_BONES_MM, dtype=torch.float64)
    scale = hand_length_m / float(base[2].norm() + bones[2].sum())
    sizes = (base * scale).float(), torch.stack(frames).float(), (bones * scale).float()
    return HandShape(*sizes, thickness).of_side(side)
