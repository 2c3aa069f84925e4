"""Chequerboards as a Time-of-Flight camera sees them, for the tests of the calibration."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from toftrack.camera import Camera

RANGE_M = 7.4948
_GAIN = 1070.0  # amplitude of a white surface at 1 m
_WALL_M = 3.0
_SAMPLES = 3  # a side of a pixel


def wiggle(radial_m: np.ndarray) -> np.ndarray:
    """A depth error: 3 mm sinusoidal plus 10 mm a metre."""
    return 0.003 * np.sin(2 * np.pi * radial_m / 1.874 + 0.6) + 0.010 * radial_m


def no_error(radial_m: np.ndarray) -> np.ndarray:
    return np.zeros_like(radial_m)


def board_poses(
    count: int, near_m: float, far_m: float, size_m: tuple[float, float], seed: int = 0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations (3, 3) and translations (3,) of boards that are mostly in view, turned by up to 40
    degrees, from near to far; the board's middle is its origin."""
    rng = np.random.default_rng(seed)
    poses = []
    for z in near_m * (far_m / near_m) ** np.linspace(0, 1, count):
        turn = rng.uniform(-0.7, 0.7, 3) * (1, 1, 0.3)
        free_x = max(0.0, 0.40 * z - 0.5 * size_m[0])
        free_y = max(0.0, 0.30 * z - 0.5 * size_m[1])
        middle = np.array([rng.uniform(-free_x, free_x), rng.uniform(-free_y, free_y), z])
        poses.append((cv2.Rodrigues(turn)[0], middle))
    return poses


def render_board(
    camera: Camera,
    board: tuple[int, int],
    square_m: float,
    pose: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator | None = None,
    error: Callable[[np.ndarray], np.ndarray] = no_error,
) -> tuple[np.ndarray, np.ndarray]:
    """The radial distance, (H, W) float32 m, and the amplitude, uint16, of one board.

    The board has `board` = columns, rows of inner corners and a white margin of one square, before
    a grey wall. Each pixel sums the phasors of 3 x 3 samples, so that edges mix as in the camera.
    With `rng`: noise as of the mesh-hand recordings, 3.5 mm at an amplitude of 2560.
    """
    rotation, middle = pose
    rays = _sample_rays(camera)
    lengths = np.sqrt(1 + (rays**2).sum(-1))
    directions = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
    z = (middle @ rotation[:, 2]) / (directions @ rotation[:, 2])
    on_board = (directions * z[..., None] - middle) @ rotation  # (..., 3), the third is 0
    across = on_board[..., 0] / square_m + (board[0] - 1) / 2
    down = on_board[..., 1] / square_m + (board[1] - 1) / 2
    squares = (across > -1) & (across < board[0]) & (down > -1) & (down < board[1])
    margin = (across > -2) & (across < board[0] + 1) & (down > -2) & (down < board[1] + 1)
    black = squares & ((np.floor(across) + np.floor(down)) % 2 == 0)
    seen = margin & (z > 0)
    z = np.where(seen, z, _WALL_M)
    albedo = np.where(seen, np.where(black, 0.12, 0.85), 0.4)
    facing = np.abs(directions @ rotation[:, 2]) / lengths
    radial = z * lengths
    amplitude = _GAIN * albedo * np.where(seen, facing, 1.0) / radial**2
    phasors = (amplitude * np.exp(2j * np.pi * radial / RANGE_M)).mean(axis=(2, 3))
    if rng is not None:
        sigma = 0.0035 * 2560 * 2 * np.pi / RANGE_M
        phasors = phasors + sigma * (
            rng.standard_normal(phasors.shape) + 1j * rng.standard_normal(phasors.shape)
        )
    measured = np.angle(phasors) % (2 * np.pi) * RANGE_M / (2 * np.pi)
    measured = measured + error(measured)
    strength = np.clip(np.abs(phasors), 0, 65535).astype(np.uint16)
    return measured.astype(np.float32), strength


@lru_cache(maxsize=2)
def _sample_rays(camera: Camera) -> np.ndarray:
    """(H, W, S, S, 2) x and y at Z = 1 of the samples of each pixel."""
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    v, u, dv, du = np.meshgrid(
        np.arange(camera.height), np.arange(camera.width), steps, steps, indexing="ij"
    )
    focal, centre = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    distorted = (np.stack([u + du, v + dv], -1) - centre) / focal
    k1, k2, p1, p2, k3 = camera.distortion
    rays = distorted
    for _ in range(15):  # a fixed point: the distortion is mild
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        shift_y = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        rays = (distorted - np.stack([shift_x, shift_y], -1)) / radial[..., None]
    return rays
