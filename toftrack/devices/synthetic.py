"""Frames of toftrack's own hand model with Time-of-Flight noise.

For demonstrations and unit tests only: a tracker judged on images of its own renderer looks better
than it is (the inverse crime).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from toftrack.compute.threads import small_operations
from toftrack.devices.base import BaseDevice
from toftrack.errors import check_number
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame, Truth
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import Ellipsoids, hand_surface
from toftrack.pose_space.data.pose_data import basic_pose
from toftrack.render.reference import render_range_images

_CAMERA = Camera(np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]]), 176, 144)
_WALL_M = 1.5
_AMPLITUDE_AT_1M = 700.0


class Synthetic(BaseDevice):
    """A right hand that closes to a fist and opens again while it drifts and turns.

    The arguments are those of conf/device/synthetic.yaml. The noise grows with the square of the
    distance, as a Time-of-Flight camera's does while its amplitude falls.
    """

    def __init__(
        self,
        frames: int = 60,
        fps: float = 25.0,
        noise_m: float = 0.004,
        seed: int = 0,
        camera_file: str | None = None,
    ) -> None:
        check_number("device.frames", frames, 1, whole=True)
        check_number("device.fps", fps, 0, above=True)
        check_number("device.noise_m", noise_m, 0)
        super().__init__(Camera.load(camera_file) if camera_file else _CAMERA, fps, frames)
        self.description = {"device": "synthetic", "noise_m": noise_m, "seed": seed}
        self._noise_m, self._seed = noise_m, seed
        shape = default_hand_shape()
        pose = forward_kinematics(_states(frames), shape)
        self._ellipsoids = hand_surface(shape).pose(pose)
        yes = np.ones(frames, bool)
        self.truth = Truth(pose.joints_m.numpy(), yes, yes)

    def __iter__(self) -> Iterator[Frame]:
        generator = np.random.default_rng(self._seed)
        camera, (centres, axes) = self.camera, self._ellipsoids
        k = torch.tensor(camera.K, dtype=torch.float32)
        for index in range(len(centres)):
            hand = Ellipsoids(centres[index : index + 1], axes[index : index + 1])
            with small_operations():
                depth = render_range_images(hand, k, camera.height, camera.width)[0].numpy()
            depth = np.where(depth > 0, depth, _WALL_M)
            noise = generator.standard_normal(depth.shape) * self._noise_m * (depth / 0.5) ** 2
            amplitude = np.minimum(_AMPLITUDE_AT_1M / depth**2, 65535).astype(np.uint16)
            yield Frame(
                index=index,
                timestamp_s=index / self.fps,
                depth=(depth + noise).astype(np.float32),
                amplitude=amplitude,
                radial=False,
            )


def _states(count: int) -> torch.Tensor:
    phase = torch.arange(count) / 50.0 * 2 * math.pi
    closing = (0.5 - 0.5 * phase.cos())[:, None].double()
    angles = torch.lerp(basic_pose("palm"), basic_pose("fist"), closing).float()
    x, y = 0.05 * phase.sin(), 0.085 + 0.02 * (1.3 * phase).sin()
    z = 0.5 + 0.04 * (0.7 * phase).sin()
    turn = 0.1 * phase.sin(), 0.3 * (0.8 * phase).sin(), 0.2 * phase.sin()
    return torch.cat((torch.stack((x, y, z, *turn), 1), angles), 1)
