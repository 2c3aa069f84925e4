"""Fingers that close on a thing: each joint bends until a bone beyond it meets the thing's surface.

Bones are capsules, the thing is a signed distance, everything in the frame of a right hand whose
wrist is the origin.
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute import rigid_numba
from toftrack.compute.compiling import compiled, entry_point
from toftrack.compute.rigid_numba import mix_columns
from toftrack.detector import things_numba
from toftrack.detector.things_numba import part_distance

_entry = entry_point(__file__, things_numba.__file__, rigid_numba.__file__)
CLOSE, YIELD = range(2)
"""What a finger does: it closes on the thing, or gives way where it is in it."""
_STEP, _BACK = math.radians(6.0), math.radians(9.0)
_HALVINGS = 4
_LEAST, _WIDEST = math.radians(-20.0), math.radians(40.0)
_TOUCH_M = 0.0025
_PALM = np.array([0.55, 0.72, 0.88, 1.0])
"""Where along the metacarpals a thing may touch the palm."""


@compiled
def _thing_distance(parts, x, y, z):
    nearest = 1.0
    for part in parts:
        if part[0] >= 0:
            nearest = min(nearest, part_distance(part, x, y, z))
    return nearest


@compiled
def _place_in_palm(parts, base, flesh):
    """Move a thing that lies far before the palm along the hand's z axis until it touches it."""
    total = -0.25
    for part in parts:
        part[3] -= 0.25
    for _ in range(24):
        gap = 1.0
        for finger in range(1, 5):
            for share in _PALM:
                x, y, z = share * base[finger, 0], share * base[finger, 1], share * base[finger, 2]
                gap = min(gap, _thing_distance(parts, x, y, z) - flesh)
        if gap < 0.0002 or total > 0.2:
            break
        total += gap
        for part in parts:
            part[3] += gap


@compiled
def _gap(finger, first, angles, base_frames, base, lengths, radii, shifts, parts, frame):
    """How far the bones of a finger, from number `first` on, are from the thing."""
    start = 0 if finger == 0 else 1 + 4 * finger
    for i in range(3):
        for j in range(3):
            frame[i, j] = base_frames[finger, i, j]
    x, y, z = base[finger, 0], base[finger, 1], base[finger, 2]
    angle = start
    gap = 1.0
    for bone in range(3):
        if bone == 0 or (bone == 1 and finger == 0):
            mix_columns(frame, 0, angles[angle])
            angle += 1
        mix_columns(frame, 1, angles[angle])
        angle += 1
        length, radius = lengths[finger, bone], radii[finger, bone]
        shift = shifts[finger, bone]
        if bone >= first:
            end = length - radius if bone == 2 else length
            for sample in range(4):
                along = end * (0.16 + 0.28 * sample)
                gap = min(
                    gap,
                    _thing_distance(
                        parts,
                        x - along * frame[0, 1] - shift * frame[0, 2],
                        y - along * frame[1, 1] - shift * frame[1, 2],
                        z - along * frame[2, 1] - shift * frame[2, 2],
                    )
                    - radius,
                )
        x -= length * frame[0, 1]
        y -= length * frame[1, 1]
        z -= length * frame[2, 1]
    return gap


@compiled
def _bending(finger, bone):
    """Which angle bends a bone of a finger."""
    if finger == 0:
        return 1 if bone == 0 else 2 + bone
    return 2 + 4 * finger + bone


@compiled
def _close(finger, most, angles, base_frames, base, lengths, radii, shifts, parts, frame):
    for bone in range(3):
        angle = _bending(finger, bone)
        free = angles[angle]
        while True:
            angles[angle] = min(free + _STEP, most[angle])
            if (
                _gap(finger, bone, angles, base_frames, base, lengths, radii, shifts, parts, frame)
                < 0
            ):
                met = angles[angle]
                for _ in range(_HALVINGS):
                    angles[angle] = 0.5 * (free + met)
                    if (
                        _gap(
                            finger,
                            bone,
                            angles,
                            base_frames,
                            base,
                            lengths,
                            radii,
                            shifts,
                            parts,
                            frame,
                        )
                        < 0
                    ):
                        met = angles[angle]
                    else:
                        free = angles[angle]
                angles[angle] = free
                break
            free = angles[angle]
            if free >= most[angle]:
                break


@compiled
def _yield(finger, angles, base_frames, base, lengths, radii, shifts, parts, frame):
    for _ in range(14):
        if _gap(finger, 0, angles, base_frames, base, lengths, radii, shifts, parts, frame) >= 0:
            break
        if finger == 0 and angles[0] < _WIDEST:
            angles[0] = min(angles[0] + _BACK, _WIDEST)  # away from the palm first, still opposed
            continue
        for bone in range(3):
            angle = _bending(finger, bone)
            angles[angle] = max(angles[angle] - _BACK, min(_LEAST, angles[angle]))


@_entry
def grasp(
    angles, most, tasks, in_palm, flesh, base_frames, base, lengths, radii, shifts, parts, said
):
    """N hands on N things.

    angles: (N, 21), bent in place.  most: (N, 21) beyond which nothing bends.
    tasks: (N, 5) CLOSE or YIELD.  in_palm: (N,) the thing is to touch the palm; its parts
    (N, Q, PART) are moved.  flesh: (N,) how thick the palm is before its bones.
    base_frames (N, 5, 3, 3), base (N, 5, 3), lengths (N, 5, 3): of HandShape.
    radii, shifts: (N, 5, 3) of the bones' capsules, and how far palmward they lie.
    said: (N, 2) fingers that touch, and the deepest that any lies in the thing, metres.
    """
    frame = np.empty((3, 3))
    for n in range(len(angles)):
        hand = (base_frames[n], base[n], lengths[n], radii[n], shifts[n], parts[n], frame)
        if in_palm[n]:
            _place_in_palm(parts[n], base[n], flesh[n])
        # The thumb last: the fingers hold the thing already.
        for finger in (1, 2, 3, 4, 0):
            _yield(finger, angles[n], *hand)
            if tasks[n, finger] == CLOSE:
                _close(finger, most[n], angles[n], *hand)
        touching, deepest = 0, 0.0
        for finger in range(5):
            gap = _gap(finger, 0, angles[n], *hand)
            touching += gap < _TOUCH_M
            deepest = max(deepest, -gap)
        said[n, 0], said[n, 1] = touching, deepest
