"""What the tracker says about one frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np

from toftrack.frames.help_text import fields_in_help

STATES = {
    "tracking": "tracking",
    "searching": "searching for the hand",
    "hidden": "the hand is hidden",
    "out of view": "the hand is out of view",
    "initialising": "starting",
    "lost": "no hand found",
    "recovering": "trying to recover",
    "other hand": "only the other hand is seen",
    "dropped": "the frame came too late",
}
"""What the tracker does, Estimate.state_name, and how it is said to people."""


class _ArrayOnDemand:
    """A field of a dataclass that may be given as a function without arguments: it is called when
    the field is first read. What few programs read then costs the others nothing."""

    def __init__(self, shape: tuple[int, ...], kind: type) -> None:
        self._shape, self._kind, self._name = shape, kind, ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __call__(self) -> np.ndarray:
        """The default."""
        return np.full(self._shape, np.nan, self._kind)

    def __repr__(self) -> str:  # in signatures
        return "<NaN>"

    def __get__(self, instance: object | None, owner: type) -> Any:
        if instance is None:  # the dataclass asks for the default
            return self
        value = vars(instance)[self._name]
        if callable(value):
            value = vars(instance)[self._name] = value()
        return value

    def __set__(self, instance: object, value: np.ndarray | Callable[[], np.ndarray]) -> None:
        vars(instance)[self._name] = value


def _on_demand(*shape: int, kind: type = np.float64) -> Any:
    """For readers and type checkers the field is the array that it becomes."""
    return _ArrayOnDemand(shape, kind)


@fields_in_help
@dataclass(frozen=True, eq=False)
class Estimate:
    """The hand in one frame, on the host. Arrays are NaN where there never was an estimate and, of
    several slots, where there is no hand now."""

    index: int
    """Number of the input frame."""
    timestamp_s: float
    """Seconds, the frame's time as it was given."""
    state_name: str
    """'tracking', or why not: 'searching', 'hidden', 'out of view', 'other hand' or 'lost'; with
    experiment=paper also 'recovering', and 'initialising' of its first frame; of a frame of a
    finished run that was not tracked 'dropped'. See STATES."""
    lost: bool
    """Not to be used: no hand, or one of which too much is likely wrong, see `lost.confidence` and
    `lost.whole` in conf/lost. Of single joints: `joint_ok`."""
    joints_m: np.ndarray
    """(21, 3) float32 metres, camera frame, in the order of JOINT_NAMES, which is MediaPipe's."""
    state: np.ndarray
    """(27,) float32: the wrist's place (3, m), rotation vector (3, rad) that turns a hand held up,
    palm to the camera, into this one, and joint angles (21, rad) in the order of ANGLE_NAMES."""
    latent: np.ndarray
    """(d,) float32 pose-space coordinates."""
    score: float
    """The likelihood head's score, 0..1."""
    covariance: np.ndarray = _on_demand(10, 10)
    """(6 + d, 6 + d) float32 over translation, rotation (about the camera's axes) and latent."""
    effective_sample_size: float = math.nan
    """Of the weights, before resampling."""
    compute_s: float = math.nan
    """Wall seconds from the raw frame (or `step`'s call) to the estimate, drawing excluded."""
    confidence: float = math.nan
    """Probability that every joint is within 40 mm; NaN where nothing says."""
    outside_rad: float = math.nan
    """How far the pose lies off the pose space: radians, rms over the 21 joint angles."""
    side: str = ""
    """'right' or 'left', whose hand it is; empty where nobody says."""
    side_probability: float = math.nan
    """How sure that is, 0..1; 1 where it was given."""
    gesture: str = ""
    """The gesture ("palm", "pointing_thumb", ... or a name of the user's), 'other' where it is none
    of the known; empty where gesture output is off, the hand is lost, or too little is known of a
    joint that would decide."""
    gesture_probability: float = math.nan
    """How sure the gesture is, 0..1; NaN where there is none."""
    pinch: float = math.nan
    """How nearly thumb tip and index tip touch, 0 open .. 1 touching; NaN, for which
    `if pinch` is true, where gesture output is off, the hand is lost, or too little is known of
    their last joints."""
    pinching: bool = False
    """Whether they pinch: `pinch` with hysteresis, so that one pinch begins and ends once."""
    joint_sigma_m: np.ndarray = _on_demand(21, 3, kind=np.float32)
    """(21, 3) float32 standard deviations of the joints along the camera's ray, along the finger
    and across both; see hand/regions.py. NaN where nothing says."""
    joint_confidence: np.ndarray = field(default_factory=lambda: np.full(21, np.nan, np.float32))
    """(21,) float32 probabilities that the joints are within 40 mm; NaN where nothing says."""
    joint_ok: np.ndarray = field(default_factory=lambda: np.ones(21, bool))
    """(21,) bool: the joint may be used. False for all of a hand that is lost, and for those joints
    of another one whose `joint_confidence` is below `lost.joint_ok`, see conf/lost."""
    pointing_origin_m: np.ndarray = field(default_factory=lambda: np.full(3, np.nan, np.float32))
    """(3,) float32 metres, camera frame: the index finger's base while it points, with or without
    the thumb stretched away, else NaN."""
    pointing_direction: np.ndarray = field(default_factory=lambda: np.full(3, np.nan, np.float32))
    """(3,) float32 unit vector from there to the finger's tip, else NaN."""
    landmarks: np.ndarray = _on_demand(21, 3)
    """(21, 3) the joints as MediaPipe's landmarks: x, y in parts of the image's width and height, z
    the depth beyond the wrist's in parts of the width; see hand/conventions.py."""
    image_size_px: tuple[int, int] | None = None
    """Width and height of the image, which `landmarks` are in parts of; None where nobody says."""
    openxr_position_m: np.ndarray = _on_demand(26, 3)
    """(26, 3) metres, the joints of XR_EXT_hand_tracking; x right, y up, -z forward."""
    openxr_orientation: np.ndarray = _on_demand(26, 4)
    """(26, 4) unit quaternions x y z w of these joints; see hand/openxr.py for their axes."""
    openxr_radius_m: np.ndarray = _on_demand(26)
    """(26,) metres from these joints to the skin."""

    def __repr__(self) -> str:
        """<frame 30, 1.200 s: right hand, wrist at 0.012 -0.034 0.512 m, 97 % sure, palm>"""
        words = ["lost", state_words(self)]
        if not self.lost:
            place = " ".join(f"{value:.3f}" for value in self.joints_m[0])
            bad = int((~self.joint_ok).sum())
            words = [f"{self.side} hand, wrist at {place} m".strip()]
            words += [confidence_words(self.confidence), gesture_words(self)]
            words += [f"{bad} joints not ok"] if bad else []
        return f"<frame {self.index}, {self.timestamp_s:.3f} s: {', '.join(filter(None, words))}>"

    def updated(self, **changes: Any) -> Self:
        """With other values of some fields, as dataclasses.replace; what is on demand stays so."""
        if unknown := changes.keys() - vars(self).keys():
            raise TypeError(f"an Estimate has no field {', '.join(sorted(unknown))}")
        made = object.__new__(type(self))
        vars(made).update(vars(self) | changes)
        return made

    def values(self) -> dict[str, Any]:
        """All fields by name."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def __getstate__(self) -> dict[str, Any]:
        return self.values()  # pickles and copies take no functions


def no_estimate(
    index: int, timestamp_s: float, state_name: str, latent_size: int, compute_s: float
) -> Estimate:
    """The estimate of a frame before any hand was found: lost, score 0, every array NaN."""
    size = 6 + latent_size
    return Estimate(
        index=index,
        timestamp_s=timestamp_s,
        state_name=state_name,
        lost=True,
        joints_m=np.full((21, 3), np.nan, np.float32),
        state=np.full(27, np.nan, np.float32),
        latent=np.full(latent_size, np.nan, np.float32),
        score=0.0,
        covariance=np.full((size, size), np.nan, np.float32),
        effective_sample_size=0.0,
        compute_s=compute_s,
        confidence=0.0,
        joint_ok=np.zeros(21, bool),
    )


def lost_estimate(last: Estimate, index: int, timestamp_s: float, compute_s: float) -> Estimate:
    """The estimate of a frame in which no hand can be: the last one stands, and is lost."""
    return last.updated(
        index=index,
        timestamp_s=timestamp_s,
        state_name="lost",
        lost=True,
        score=0.0,
        confidence=0.0,
        joint_sigma_m=np.full((21, 3), np.nan, np.float32),
        joint_confidence=np.zeros(21, np.float32),
        joint_ok=np.zeros(21, bool),
        compute_s=compute_s,
    )


def is_vacant(estimate: Estimate) -> bool:
    """Whether there is no hand at all: nobody is followed, and there is no last or best guess."""
    return not np.isfinite(estimate.state).all()


def state_words(estimate: Estimate) -> str:
    """What goes on, for people: "tracking", "searching for the hand", "the hand is hidden"."""
    return STATES.get(estimate.state_name, estimate.state_name)


def gesture_words(estimate: Estimate) -> str:
    """The gesture, for people: "thumb up", "ok, pinching"; empty where there is none."""
    pinching = "pinching" if estimate.pinching else ""
    return ", ".join(filter(None, (estimate.gesture.replace("_", " "), pinching)))


def confidence_words(confidence: float) -> str:
    """How sure an estimate is, for people: "97 % sure"; empty where nothing says."""
    if not math.isfinite(confidence):
        return ""
    # Nobody is ever quite sure, whatever the rounding.
    return f"{min(max(round(100 * confidence), 1), 99)} % sure" if confidence else "0 % sure"
