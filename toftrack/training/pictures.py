"""Depth pictures of scenes, as sensors take them; compiled, one picture after another.

An ellipsoid {c + F u : |u| <= 1} is met by the ray z (x, y, 1) where |z W d - W c| = 1, W = F^-1: a
quadratic in z. For skin and things see skin_numba and things_numba. Then the sensor: noise that
grows with the square of the distance, pixels on depth edges that mix both depths, readings that are
missing, steps, shadows beside near things, hollows that seem deeper than they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from toftrack.compute.compiling import compiled, shared_entry_point
from toftrack.detector.crops import CROP, CROP_CHANNELS, CROP_M
from toftrack.detector.network import PARTS
from toftrack.training.dice import Dice
from toftrack.training.hands import FOREARM, THING
from toftrack.training.scenes import Scenes
from toftrack.training.skin_numba import draw_skin
from toftrack.training.things_numba import TILE, draw_part, seen_between

(
    NOISE, FLYING, BIAS, HOLES, STEP, SHADOW, RANGE, PATCHES, BLUR, DARK, SMOOTH, COARSE, HOLLOW,
) = range(13)  # fmt: skip
SENSOR_TERMS = 13
_ONE_SURFACE_M = np.float32(0.03)
"""A camera's filter smooths over steps of less than this."""
_HOLLOW_M, _HOLLOW_DEPTH_M = np.float32(0.05), np.float32(0.06)
"""Hollows are at most so wide and so deep; what lies farther back is another surface."""
_LATEST = 1.2
"""By what part of its depth a hollow seems deeper, at most."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Pinholes of a batch: f_px, cx, cy (N,), width, height (N,) of what each sees, in pixels."""

    f_px: Tensor
    cx: Tensor
    cy: Tensor
    width: Tensor
    height: Tensor


def random_sensors(n: int, dice: Dice) -> Tensor:
    """(N, SENSOR_TERMS) of Time-of-Flight and structured-light cameras; lengths in metres.

    NOISE: standard deviation at 0.5 m.  FLYING: share of edge pixels that mix.  BIAS: added.
    HOLES: share of missing pixels.  STEP: of the readings at 0.5 m.  SHADOW: pixels without
    readings beside near edges.  RANGE: nothing is read beyond.  PATCHES: how many patches miss.
    BLUR: 1 mixes with neighbours on one surface.  DARK: 1 = the forearm is not read.
    SMOOTH: pixels to each side over which the camera's own filter averages one surface; the folds
    of a fist are lost in it.  COARSE: step of the readings at any distance, as of images that were
    kept with 8 bits.  HOLLOW: by what part of their depth hollows seem deeper, as light that goes
    from one of their walls to the other comes late (Fuchs, Multipath interference compensation in
    time-of-flight camera images, ICPR 2010).
    """
    light = dice.chance(0.25, n)
    terms = torch.zeros(n, SENSOR_TERMS)
    log_noise = dice.uniform(n, low=math.log(0.0008), high=math.log(0.007))
    terms[:, NOISE] = torch.where(light, 0.3, 1.0) * log_noise.exp()
    terms[:, FLYING] = torch.where(light, 0.0, dice.uniform(n, high=0.8))
    terms[:, BIAS] = 0.003 * dice.normal(n)
    few = dice.uniform(n, high=0.01)
    terms[:, HOLES] = torch.where(dice.chance(0.15, n), 0.15 * dice.uniform(n), few)
    terms[:, STEP] = torch.where(light, dice.uniform(n, high=0.004), 0.0005)
    terms[:, SHADOW] = torch.where(light, dice.uniform(n, high=10.0), 0.0)
    terms[:, RANGE] = torch.where(dice.chance(0.3, n), dice.uniform(n, low=0.9, high=1.6), 9.0)
    terms[:, PATCHES] = torch.where(dice.chance(0.15, n), dice.uniform(n, low=1, high=4), 0.0)
    terms[:, BLUR] = dice.chance(0.3, n).float()
    terms[:, DARK] = dice.chance(0.06, n).float()
    wide = dice.uniform(n, low=1.0, high=3.5).floor()
    terms[:, SMOOTH] = torch.where(dice.chance(0.3, n), wide, 0.0)
    terms[:, COARSE] = torch.where(dice.chance(0.1, n), dice.uniform(n, low=0.003, high=0.012), 0.0)
    late = ~light & dice.chance(0.4, n)
    terms[:, HOLLOW] = torch.where(late, dice.uniform(n, high=_LATEST), 0.0)
    return terms


def take_pictures(
    scenes: Scenes, lens: Lens, sensors: Tensor, size: tuple[int, int], dice: Dice
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (N, H, W) float32, 0 = no reading, and labels (N, H, W) int8, -1 = not seen.

    size: H, W of the arrays; each picture fills its own width and height of them.
    """
    n = len(sensors)
    clean, depth = np.zeros((2, n, *size), np.float32)
    labels = np.full((n, *size), -1, np.int8)
    seeds = torch.randint(1, 2**31 - 1, (n,), generator=dice.generator)
    which = torch.where(scenes.skinned, -1, scenes.labels)
    axes = scenes.axes_m
    ellipsoids = (_plain(scenes.centres_m), _plain(axes), _plain(torch.linalg.inv(axes)))
    lenses = _plain(torch.stack((lens.f_px, lens.cx, lens.cy, lens.width, lens.height), 1))
    terms = _plain(sensors)
    _draw_scenes(
        (*ellipsoids, _integers(which)),
        (_plain(scenes.skins), _integers(scenes.skin_labels), _plain(scenes.skin_widths_m)),
        (_plain(scenes.planes), _plain(scenes.parts)),
        lenses,
        clean,
        labels,
    )
    for row, seed in enumerate(seeds.tolist()):
        opened = _opened(clean[row], lenses[row]) if terms[row, HOLLOW] > 0 else clean[row]
        state = np.array([seed], np.uint32)
        _sense(terms[row], lenses[row], state, clean[row], opened, depth[row], labels[row])
    return depth, labels


def _opened(depth: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """The opening of a picture's depths, behind which its hollows lie."""
    seen = depth[: int(lens[4]), : int(lens[3])]
    reach = int(np.float32(0.5) * _HOLLOW_M * lens[0] / (seen.min() + _HOLLOW_DEPTH_M))
    about = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return cv2.morphologyEx(seen, cv2.MORPH_OPEN, about)


def _plain(tensor: Tensor) -> np.ndarray:
    return tensor.float().contiguous().numpy()


def _integers(tensor: Tensor) -> np.ndarray:
    return tensor.to(torch.int8).numpy()


@compiled
def _random(state):
    """Uniform in [0, 1) by xorshift; state: (1,) uint32."""
    x = state[0]
    x ^= np.uint32((x << np.uint32(13)) & np.uint32(0xFFFFFFFF))
    x ^= np.uint32(x >> np.uint32(17))
    x ^= np.uint32((x << np.uint32(5)) & np.uint32(0xFFFFFFFF))
    state[0] = x
    return np.float32(np.float64(x) * 2.3283064365386963e-10)


@compiled
def _normal(state):
    """Nearly normal: the sum of four uniforms."""
    total = _random(state) + _random(state) + _random(state) + _random(state)
    return (total - np.float32(2.0)) * np.float32(1.7320508)


@compiled
def _draw(centre, axes, whiten, label, lens, depth, labels):
    """One ellipsoid into the depth buffer."""
    cx, cy, cz = centre
    xx = axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2
    yy = axes[1, 0] ** 2 + axes[1, 1] ** 2 + axes[1, 2] ** 2
    zz = axes[2, 0] ** 2 + axes[2, 1] ** 2 + axes[2, 2] ** 2
    xz = axes[0, 0] * axes[2, 0] + axes[0, 1] * axes[2, 1] + axes[0, 2] * axes[2, 2]
    yz = axes[1, 0] * axes[2, 0] + axes[1, 1] * axes[2, 1] + axes[1, 2] * axes[2, 2]
    if cz - math.sqrt(zz) < 0.05:
        return
    f, px, py = lens[0], lens[1], lens[2]
    left, right = seen_between(cx, cz, xx, xz, zz, f, px, int(lens[3]))
    top, bottom = seen_between(cy, cz, yy, yz, zz, f, py, int(lens[4]))
    p0 = whiten[0, 0] * cx + whiten[0, 1] * cy + whiten[0, 2] * cz
    p1 = whiten[1, 0] * cx + whiten[1, 1] * cy + whiten[1, 2] * cz
    p2 = whiten[2, 0] * cx + whiten[2, 1] * cy + whiten[2, 2] * cz
    outside = p0 * p0 + p1 * p1 + p2 * p2 - np.float32(1.0)
    step = np.float32(1.0) / f
    for v in range(top, bottom + 1):
        y = (np.float32(v) - py) * step
        r0 = whiten[0, 1] * y + whiten[0, 2]
        r1 = whiten[1, 1] * y + whiten[1, 2]
        r2 = whiten[2, 1] * y + whiten[2, 2]
        for u in range(left, right + 1):
            x = (np.float32(u) - px) * step
            q0, q1, q2 = whiten[0, 0] * x + r0, whiten[1, 0] * x + r1, whiten[2, 0] * x + r2
            a = q0 * q0 + q1 * q1 + q2 * q2
            b = q0 * p0 + q1 * p1 + q2 * p2
            disc = b * b - a * outside
            if disc > 0:
                z = (b - math.sqrt(disc)) / a
                if z < depth[v, u]:
                    depth[v, u] = z
                    labels[v, u] = label


@compiled
def _smooth(reach, width, height, depth):
    """Each reading becomes the mean of those about it that lie on the same surface. It goes along
    rows, so that the arithmetic is vectorised.
    """
    scratch = np.empty(depth.shape, np.float32)
    total, count = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(height):
        for u in range(width):
            scratch[v, u] = depth[v, u]
    for v in range(height):
        for u in range(width):
            total[u] = np.float32(0)
            count[u] = np.float32(0)
        for v2 in range(max(v - reach, 0), min(v + reach, height - 1) + 1):
            for shift in range(-reach, reach + 1):
                for u in range(max(-shift, 0), width - max(shift, 0)):
                    other = scratch[v2, u + shift]
                    near = (other > 0) & (abs(other - scratch[v, u]) < _ONE_SURFACE_M)
                    total[u] += other if near else np.float32(0)
                    count[u] += np.float32(1) if near else np.float32(0)
        for u in range(width):
            if scratch[v, u] > 0:
                depth[v, u] = total[u] / count[u]


@shared_entry_point
def _sense(sensor, lens, state, clean, opened, depth, labels):
    """What a sensor makes of a picture: `depth`, from `clean`, whose hollows become deeper."""
    width, height = int(lens[3]), int(lens[4])
    if sensor[HOLLOW] > 0:
        for v in range(height):
            for u in range(width):
                hollow = clean[v, u] - opened[v, u]
                if hollow < _HOLLOW_DEPTH_M:
                    clean[v, u] += sensor[HOLLOW] * hollow
    blur, flying = sensor[BLUR] > 0, sensor[FLYING]
    shadow = int(sensor[SHADOW])
    for v in range(height):
        for u in range(width):
            z = clean[v, u]
            v2 = min(max(v + int(_random(state) * 3) - 1, 0), height - 1)
            u2 = min(max(u + int(_random(state) * 3) - 1, 0), width - 1)
            other = clean[v2, u2]
            gap = abs(other - z)
            if gap > 0.02:
                if _random(state) < flying:
                    z += _random(state) * (min(other, z + 2.0) - z)
            elif blur:
                z = 0.5 * (z + other)
            if sensor[DARK] > 0 and labels[v, u] == FOREARM:
                depth[v, u] = 0.0
                continue
            if z > sensor[RANGE] or _random(state) < sensor[HOLES]:
                depth[v, u] = 0.0
                continue
            ratio = min(z * z * 4.0, 20.0)
            z += sensor[BIAS] + sensor[NOISE] * ratio * _normal(state)
            step = sensor[STEP] * ratio
            if step > 0:
                z = math.floor(z / step + 0.5) * step
            depth[v, u] = max(z, 0.0)
    if sensor[SMOOTH] > 0:
        _smooth(int(sensor[SMOOTH]), width, height, depth)
    if sensor[COARSE] > 0:
        for v in range(height):
            for u in range(width):
                depth[v, u] = math.floor(depth[v, u] / sensor[COARSE] + 0.5) * sensor[COARSE]
    if shadow > 0:
        for v in range(height):
            for u in range(width - 1):
                if clean[v, u] - clean[v, u + 1] > 0.03:
                    reach = int(shadow * min((clean[v, u] - clean[v, u + 1]) * 3.0, 1.0))
                    for back in range(reach + 1):
                        if u - back >= 0 and clean[v, u - back] > clean[v, u + 1] + 0.02:
                            depth[v, u - back] = 0.0
    for _ in range(int(sensor[PATCHES])):
        radius = 2.0 + _random(state) * 0.08 * width
        v0, u0 = int(_random(state) * height), int(_random(state) * width)
        for v in range(max(0, int(v0 - radius)), min(height, int(v0 + radius) + 1)):
            for u in range(max(0, int(u0 - radius)), min(width, int(u0 + radius) + 1)):
                if (v - v0) ** 2 + (u - u0) ** 2 < radius * radius * (0.6 + 0.6 * _random(state)):
                    depth[v, u] = 0.0


@shared_entry_point
def _draw_scenes(ellipsoids, skins, others, lenses, depth, labels):
    """Exact depths of all pictures of a batch, see take_pictures."""
    (centres, axes, whiten, which), (primitives, whose, widths) = ellipsoids, skins
    planes, parts = others
    tiles = (depth.shape[1] // TILE + 1) * (depth.shape[2] // TILE + 1)
    count = primitives.shape[2]
    balls, lists = np.empty((count, 4), np.float32), np.empty((tiles, count), np.int64)
    counts, on = np.empty(tiles, np.int64), np.empty(count, np.int64)
    near = np.empty(count, np.float32)
    six = np.empty((6, TILE * TILE), np.float32)
    rays = six[0], six[1], six[2], six[3], six[4], six[5]
    work = balls, lists, counts, on, near, rays
    for n in range(len(depth)):
        lens = lenses[n]
        width, height = int(lens[3]), int(lens[4])
        for v in range(height):
            y = (np.float32(v) - lens[2]) / lens[0]
            for u in range(width):
                x = (np.float32(u) - lens[1]) / lens[0]
                nearest = np.float32(8.0)
                for p in range(planes.shape[1]):
                    across = planes[n, p, 0] * x + planes[n, p, 1] * y + planes[n, p, 2]
                    z = planes[n, p, 3] / across
                    if 0.1 < z < nearest:
                        nearest = z
                depth[n, v, u] = nearest
                labels[n, v, u] = 0
        for e in range(centres.shape[1]):
            if which[n, e] >= 0:
                one = centres[n, e], axes[n, e], whiten[n, e], which[n, e]
                _draw(*one, lens, depth[n], labels[n])
        for q in range(parts.shape[1]):
            if parts[n, q, 0] >= 0:
                draw_part(parts[n, q], THING, lens, depth[n], labels[n])
        for s in range(primitives.shape[1]):
            skin = primitives[n, s], whose[n, s], widths[n, s, 0], widths[n, s, 1]
            draw_skin(skin, lens, depth[n], labels[n], work)


_PER_PART = CROP // PARTS
_SCALE, _QUARTER = np.float32(2 / CROP_M), np.float32(0.25)


def read_pictures(
    depth: np.ndarray,
    labels: np.ndarray,
    side: Tensor,
    distance_m: Tensor,
    turn: Tensor,
    border: Tensor,
) -> tuple[Tensor, Tensor]:
    """Crops (N, CROP_CHANNELS, CROP, CROP) of pictures, see detector/crops.py, and parts
    (N, PARTS, PARTS).

    depth, labels: (N, H, W) of side (N, 2) int32 pixels: of the picture and, in its middle, of the
    crop.  distance_m: (N,) of the crops' centres.  turn: (N,) by how much crops are turned about
    their centres, radians, as crops.crop_rotation turns them.
    border: (N, 2, 3) what is in the image, a x + b y < c for x, y in -0.5 .. 0.5 across the crop as
    it were without its turn; parts beyond are -1, and nothing is read there.
    """
    n = len(depth)
    image = np.zeros((n, CROP_CHANNELS, CROP, CROP), np.float32)
    parts = np.empty((n, PARTS, PARTS), np.int8)
    crops = side.numpy(), distance_m.numpy(), turn.numpy(), border.numpy()
    _read(depth, labels, *crops, image, parts)
    return torch.from_numpy(image), torch.from_numpy(parts).long()


@shared_entry_point
def _read(depth, labels, side, distance, turn, border, image, parts):
    shown = np.empty((2 * CROP, 2 * CROP), np.int8)
    for n in range(len(depth)):
        edge, each, cosine, sine = border[n], side[n, 1], math.cos(turn[n]), math.sin(turn[n])
        middle = 0.5 * side[n, 0]
        for row in range(CROP):
            for column in range(CROP):
                total, near, count, outside = np.float32(0), 0, 0, 0
                image[n, 4:, row, column] = 1
                for line in range(2 * row, 2 * row + 2):
                    down = (line + 0.5) / (2 * CROP) - 0.5
                    for sample in range(2 * column, 2 * column + 2):
                        across = (sample + 0.5) / (2 * CROP) - 0.5
                        x = cosine * across - sine * down
                        y = sine * across + cosine * down
                        if (
                            edge[0, 0] * x + edge[0, 1] * y >= edge[0, 2]
                            or edge[1, 0] * x + edge[1, 1] * y >= edge[1, 2]
                        ):
                            outside += 1
                            shown[line, sample] = -1
                            continue
                        v = min(max(int(middle + y * each), 0), side[n, 0] - 1)
                        u = min(max(int(middle + x * each), 0), side[n, 0] - 1)
                        shown[line, sample] = labels[n, v, u]
                        z = depth[n, v, u]
                        if z > 0:
                            relative = (z - distance[n]) * _SCALE
                            clipped = min(max(relative, np.float32(-1)), np.float32(1))
                            total += clipped
                            reading = 4 + 2 * (line - 2 * row) + sample - 2 * column
                            image[n, reading, row, column] = clipped
                            near += abs(relative) < 1
                            count += 1
                image[n, 0, row, column] = total / count if count > 0 else 1
                image[n, 1, row, column] = near * _QUARTER
                image[n, 2, row, column] = 1 - count * _QUARTER
                image[n, 3, row, column] = outside * _QUARTER
        for row in range(PARTS):
            for column in range(PARTS):
                # At the middle of the part, as far as there is a sample.
                line = 2 * _PER_PART * row + _PER_PART
                sample = 2 * _PER_PART * column + _PER_PART
                parts[n, row, column] = shown[line, sample]
                if image[n, 3, line // 2, sample // 2] > 0.5:
                    parts[n, row, column] = -1
