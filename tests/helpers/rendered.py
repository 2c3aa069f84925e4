"""Hands that are drawn as the tracker's own model has them, and what it makes of their images."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from helpers.detection import FixedDetector, detection_of
from helpers.tracking import make_tracker

from toftrack.compute.pace import FRAME_S, Duration
from toftrack.detector.detection import NO_DETECTION, Detection
from toftrack.frames.frame import DepthImage
from toftrack.hand.shape import default_hand_shape
from toftrack.render.model_image import model_range_image
from toftrack.tracking.candidates import View
from toftrack.tracking.filter import new_track
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.scene import Scene
from toftrack.tracking.state import Track, TrackerState
from toftrack.tracking.views import expected_of

K = np.array([[200.0, 0, 87.5], [0, 200.0, 71.5], [0, 0, 1]])
SIZE = 144, 176
WALL_M = 1.2


def hand_at(x: float = 0.0, z: float = 0.5) -> torch.Tensor:
    """(1, 27) an open palm."""
    state = torch.zeros(1, 27)
    state[0, :3] = torch.tensor([x, 0.08, z])
    return state


def bent(state: torch.Tensor, seed: int, by_rad: float = 0.15) -> torch.Tensor:
    """(1, 27) the same with other angles."""
    draw = torch.Generator().manual_seed(seed)
    changed = state.clone()
    changed[:, 6:] += by_rad * torch.rand(1, 21, generator=draw)
    return changed


def image_of(*hands: torch.Tensor, side: str = "right", wall_m: float = WALL_M) -> DepthImage:
    """Hands (1, 27) before a wall."""
    depth = np.full(SIZE, np.float32(wall_m))
    for hand in hands:
        drawn = model_range_image(hand[0].numpy(), default_hand_shape(side=side), K, *SIZE)
        depth = np.where(drawn > 0, drawn, depth)
    return DepthImage(depth.astype(np.float32), K, 0, 0.0)


EMPTY = DepthImage(np.zeros(SIZE, np.float32), K, 0, 0.0)
"""Nothing in it can be a hand."""


@cache
def right_hand_model() -> TrackerModel:
    """A small tracker of a right hand of the mean size; its detector finds nothing."""
    model = make_tracker("hand.shape=default", "hand.side=right", "filter.particles=20").model
    return replace(model, detector=FixedDetector())


@cache
def any_hand_model() -> TrackerModel:
    """The same, but the hand's side and shape are found out."""
    return replace(make_tracker("filter.particles=20").model, detector=FixedDetector())


def track_of(pose: torch.Tensor, model: TrackerModel | None = None, **changes: object) -> Track:
    """A track at a pose that goes on for a second, and is surely right."""
    track = new_track(pose, model or right_hand_model())
    usual = {"age": Duration(1.0), "log_odds": 5.0, "confirmed": True}
    return replace(track, **(usual | changes))


def state_of(
    *tracks: Track, hands: int = 1, model: TrackerModel | None = None, **changes: object
) -> TrackerState:
    """A state with tracks, which get their numbers by their order and are in the slots by it."""
    state = (model or right_hand_model()).first_state(0, hands)
    numbered = tuple(replace(track, number=at) for at, track in enumerate(tracks))
    slots = tuple(
        replace(slot, track=at if at < len(tracks) else -1) for at, slot in enumerate(state.slots)
    )
    usual = {"tracks": numbered, "slots": slots, "next_track": len(tracks), "timestamp_s": 0.0}
    return replace(state, **(usual | changes))


def scene_of(*tracks: Track, image: DepthImage, model: TrackerModel | None = None) -> Scene:
    """An image in the next frame of tracks."""
    return Scene(tracks, image, FRAME_S, model or right_hand_model())


def view_of(
    image: DepthImage,
    track: Track,
    detection: Detection = NO_DETECTION,
    others: tuple[torch.Tensor, ...] = (),
    model: TrackerModel | None = None,
) -> View:
    """A hand in an image, segmented where its track is."""
    model = model or right_hand_model()
    fitted = model.hand(track.side, track.shape)
    expected = expected_of(detection_of(track.pose))
    seen = model.segmentation(image.depth_m, image.k, expected)
    at = expected.nearest_m
    return View(track, fitted, seen, at, detection, others, model, model.posterior)
