"""What the tests of the detector share: small networks, fixed ones, scenes with one hand."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numba
import numpy as np
import torch
from helpers.settings import detector_settings
from torch import nn

from toftrack.compute.rigid import rotated_pivot
from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.detection import Detection
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.proposals import Places
from toftrack.detector.weights import make_ready
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.refinement.gauss_newton import Keypoints
from toftrack.training.dice import Dice
from toftrack.training.hands import HAND, Hands, posed_hands
from toftrack.training.pictures import RANGE, SENSOR_TERMS, Lens, take_pictures
from toftrack.training.scenes import Scenes
from toftrack.training.shapes import ShapeBank, shape_bank
from toftrack.training.skin import PRIMITIVE
from toftrack.training.things_numba import PART, part_distance

FARTHEST_M = 7.9
"""Nothing is drawn beyond 8 m."""


def dice(seed: int = 0) -> Dice:
    return Dice(torch.Generator().manual_seed(seed))


@numba.njit
def distance_to(part, point):
    """From a point (3,) to a thing's part (PART,)."""
    return part_distance(part, point[0], point[1], point[2])


@cache
def small_bank() -> ShapeBank:
    return shape_bank(12, torch.Generator().manual_seed(0))


@cache
def small_networks() -> tuple[PoseNet, Finder]:
    """Untrained ones, ready for use."""
    torch.manual_seed(0)
    networks = PoseNet(4), Finder(8)
    for network in networks:
        make_ready(network)
    return networks


def used(network: nn.Module, image: torch.Tensor) -> nn.Module:
    """A network whose statistics have seen images, in numbers of half precision."""
    network.train()
    with torch.no_grad():
        for _ in range(3):
            network(image)
        for value in network.state_dict().values():
            if value.is_floating_point():
                value.copy_(value.half().float())
    return network.eval()


def random_hands(
    n: int, seed: int, left: bool = False, pivot_m: Sequence[float] = (0.0, 0.0, 0.5)
) -> Hands:
    """Hands of one side about a place."""
    places = torch.tensor([pivot_m]).expand(n, 3)
    return posed_hands(small_bank(), places, torch.full((n,), left), dice(seed), HAND)


def one_hand(seed: int, pivot_m: Sequence[float], left: bool = False) -> Hands:
    """A random hand about a place, without its forearm."""
    hands = random_hands(1, seed, left, pivot_m)
    hands.labels[hands.labels != HAND] = -1
    return hands


def alone(hands: Hands) -> Scenes:
    """Hands and nothing else."""
    return plain_scenes(hands.centres_m, hands.axes_m, hands.labels)


def clean_sensors(n: int) -> torch.Tensor:
    """(n, SENSOR_TERMS) that read everything as it is."""
    terms = torch.zeros(n, SENSOR_TERMS)
    terms[:, RANGE] = FARTHEST_M
    return terms


def lens_of(k: np.ndarray, height: int, width: int, n: int = 1) -> Lens:
    """A pinhole with square pixels for each of n pictures."""
    values = k[0, 0], k[0, 2], k[1, 2], width, height
    return Lens(*(torch.full((n,), float(value)) for value in values))


def intrinsics(focal: float, height: int, width: int) -> np.ndarray:
    """(3, 3) of a camera that looks straight ahead."""
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def clean_picture(
    scenes: Scenes, k: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and labels, (N, H, W) each, by a camera without noise."""
    n = len(scenes.labels)
    lens = lens_of(k, height, width, n)
    return take_pictures(scenes, lens, clean_sensors(n), (height, width), dice(1))


def detection_of(states: torch.Tensor, log_size: float = 0.0, side: str = "right") -> Detection:
    """What a network that is sure would say: hands (H, 27) of one size, the first the likeliest."""
    count = len(states)
    shape = default_hand_shape(DEFAULT_HAND_LENGTH_M * math.exp(log_size), side)
    joints = forward_kinematics(states, shape).joints_m
    pivot = rotated_pivot(states[:, 3:6]) * math.exp(log_size)
    return Detection(
        pivot_m=states[:, :3] + pivot,
        rotvec=states[:, 3:6],
        angles=states[:, 6:],
        joints_m=joints,
        log_size=torch.full((count,), log_size),
        log_probability=torch.log_softmax(-2.0 * torch.arange(count), 0),
        error_m=torch.full((count,), 0.01),
        keypoints=Keypoints(joints[0], torch.full((21,), 0.005)),
        present=0.99,
        right_side=0.95,
    )


class FixedDetector:
    """In the networks' place: finds what it is given, and records what it was asked.

    found: what the finder sees, and the pose network there, as a hand of whichever side; of the
        sides in `of_side`, this instead.
    looked: the sides that hands at the finder's places were looked for as.
    images: those that the finder saw.  known: how many hands were, each time.
    centres_m, sides: (C, 3) each and the side, of all calls of `detect` and `start`.
    """

    def __init__(
        self,
        found: Sequence[Detection] = (),
        of_side: Mapping[str, Sequence[Detection]] | None = None,
        **settings: float,
    ) -> None:
        self.settings = detector_settings(**settings)
        self.found = list(found)
        self.of_side = of_side or {}
        self.looked: list[str] = []
        self.images: list[np.ndarray] = []
        self.known: list[int] = []
        self.centres_m: list[np.ndarray] = []
        self.sides: list[str] = []

    def look(self, depth_m, k, places, side) -> list[Detection]:
        self.looked.append(side)
        found = self.of_side.get(side, self.found)
        away = [np.linalg.norm(places.centre_m - one.centre_m.numpy(), axis=1) for one in found]
        return [one for one, off in zip(found, away, strict=True) if (off < 1e-3).any()]

    def start_search(self, depth_m, k, known=0) -> Callable[[], Places]:
        self.images.append(depth_m)
        self.known.append(known)
        found = [*self.found, *(one for each in self.of_side.values() for one in each)]
        centres = np.array([one.centre_m.numpy() for one in found]).reshape(-1, 3)
        return lambda: Places(centres, np.full(len(centres), 0.9, np.float32))

    def detect(self, depth_m, k, centres_m, side, up=None) -> list[Detection]:
        """An open palm whose middle is at each place."""
        self.centres_m.append(np.array(centres_m))
        self.sides.append(side)
        states = torch.zeros(len(centres_m), 27)
        states[:, :3] = torch.from_numpy(np.asarray(centres_m)).float()
        states[:, :3] -= rotated_pivot(states[:, 3:6])
        return [detection_of(state[None], side=side) for state in states]

    def start(self, depth_m, k, centre_m, side, up=None) -> Callable[[], Detection]:
        found = self.detect(depth_m, k, np.asarray(centre_m)[None], side)[0]
        return lambda: found


def plain_scenes(
    centres_m: torch.Tensor, axes_m: torch.Tensor, labels: torch.Tensor, plane_m: float = torch.inf
) -> Scenes:
    """Ellipsoids alone, and a plane across the optical axis."""
    n = len(labels)
    planes = torch.tensor([[[0.0, 0.0, 1.0, plane_m]]]).expand(n, 1, 4)
    skinned, parts = torch.zeros_like(labels, dtype=torch.bool), torch.zeros(n, 0, PART)
    skins = torch.zeros(n, 0, 1, PRIMITIVE), torch.zeros(n, 0, 1), torch.zeros(n, 0, 2)
    return Scenes(centres_m, axes_m, labels, planes, skinned, *skins, parts)


def channels(read_m: np.ndarray, inside: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Readings (N, 2 CROP, 2 CROP) in crop frames, and which lie in the image, as crops about
    centres at distances (N,): the reference of crop_at and read_pictures.
    """
    n = len(read_m)
    blocks = np.ascontiguousarray(read_m).reshape(n, CROP, 2, CROP, 2)
    valid = blocks > 0
    relative = (blocks - distance_m[:, None, None, None, None]) * np.float32(2 / CROP_M)
    near = valid & (np.abs(relative) < 1)
    count = valid.sum((2, 4), dtype=np.float32)
    total = np.where(valid, relative.clip(-1, 1), 0).sum((2, 4), dtype=np.float32)
    out = np.empty((n, CROP_CHANNELS, CROP, CROP), np.float32)
    out[:, 0] = np.where(count > 0, total / np.maximum(count, 1), 1.0)
    out[:, 1] = near.sum((2, 4), dtype=np.float32) * np.float32(0.25)
    out[:, 2] = 1 - count * np.float32(0.25)
    within = inside.reshape(blocks.shape).sum((2, 4), dtype=np.float32)
    out[:, 3] = 1 - within * np.float32(0.25)
    each = np.where(valid, relative.clip(-1, 1), np.float32(1))
    out[:, 4:] = each.transpose(0, 2, 4, 1, 3).reshape(n, 4, CROP, CROP)
    return out
