"""Fingers that close on a thing: each joint bends until a bone beyond it meets the thing's surface.

Bones are capsules, the thing is a signed distance, everything in the frame of a right hand whose
wrist is the origin. The thumb closes last, on the thing or on the fingers, and begins anew
elsewhere until its pad touches the thing.
"""

from __future__ import annotations

import math

import numpy as np

from toftrack.compute.compiling import compiled, shared_entry_point
from toftrack.compute.rigid_numba import mix_columns
from toftrack.training.things_numba import part_distance

_STEP, _BACK = math.radians(6.0), math.radians(9.0)
_HALVINGS = 4
_LEAST, _STRAIGHT, _WIDEST = math.radians(-20.0), math.radians(-10.0), math.radians(40.0)
_TOUCH_M = 0.0025
_PRESSED_M = 0.003
"""How deep the thumb may lie in the flesh of the fingers."""
_PAD_M, _FACING = 0.003, 0.6
"""How far a thing is looked for where a pad faces, and the cosine within which the pad faces it."""
_CAPSULE = 7
"""Numbers of a capsule: its ends and its radius."""
_BEFORE_THUMB = 9
"""Capsules that a thumb may meet: the bones of index, middle and ring finger."""
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
def _to_capsules(capsules, x, y, z):
    """From a point to the nearest surface of capsules (N, _CAPSULE); below 0 inside."""
    nearest = 1.0
    for c in capsules:
        ax, ay, az = c[3] - c[0], c[4] - c[1], c[5] - c[2]
        px, py, pz = x - c[0], y - c[1], z - c[2]
        along = (ax * px + ay * py + az * pz) / (ax * ax + ay * ay + az * az)
        along = min(max(along, 0.0), 1.0)
        px, py, pz = px - along * ax, py - along * ay, pz - along * az
        nearest = min(nearest, math.sqrt(px * px + py * py + pz * pz) - c[6])
    return nearest


@compiled
def _walk(finger, angles, hand):
    """Of a finger's bones, into the last of `hand`: where they begin, their axes y, against which
    they point, and z, away from the palm.
    """
    (base_frames, base, lengths, _, _), _, _, (frame, at) = hand
    for i in range(3):
        for j in range(3):
            frame[i, j] = base_frames[finger, i, j]
    x, y, z = base[finger, 0], base[finger, 1], base[finger, 2]
    angle = 0 if finger == 0 else 1 + 4 * finger
    for bone in range(3):
        for column in range(0 if bone == 0 or (bone == 1 and finger == 0) else 1, 2):
            mix_columns(frame, column, angles[angle])
            angle += 1
        at[bone, 0, 0], at[bone, 0, 1], at[bone, 0, 2] = x, y, z
        for i in range(3):
            at[bone, 1, i], at[bone, 2, i] = frame[i, 1], frame[i, 2]
        length = lengths[finger, bone]
        x -= length * frame[0, 1]
        y -= length * frame[1, 1]
        z -= length * frame[2, 1]


@compiled
def _inside(bone, along, shift):
    """A point of a bone, see _walk, that lies palmward of its axis."""
    return (
        bone[0, 0] - along * bone[1, 0] - shift * bone[2, 0],
        bone[0, 1] - along * bone[1, 1] - shift * bone[2, 1],
        bone[0, 2] - along * bone[1, 2] - shift * bone[2, 2],
    )


@compiled
def _capsules_of(finger, angles, hand, capsules):
    """A finger's three bones into capsules (3, _CAPSULE)."""
    _walk(finger, angles, hand)
    (_, _, lengths, radii, shifts), _, _, (_, at) = hand
    for bone in range(3):
        length, shift = lengths[finger, bone], shifts[finger, bone]
        end = length - radii[finger, bone] if bone == 2 else length
        for k, along in enumerate((0.0, end)):
            x, y, z = _inside(at[bone], along, shift)
            capsules[bone, 3 * k], capsules[bone, 3 * k + 1], capsules[bone, 3 * k + 2] = x, y, z
        capsules[bone, 6] = radii[finger, bone]


@compiled
def _gap(finger, first, angles, hand):
    """How far the bones of a finger, from number `first` on, are from the thing, and from the
    capsules of other fingers (N, _CAPSULE).
    """
    _walk(finger, angles, hand)
    (_, _, lengths, radii, shifts), parts, others, (_, at) = hand
    gap = 1.0
    for bone in range(first, 3):
        length, radius = lengths[finger, bone], radii[finger, bone]
        end = length - radius if bone == 2 else length
        for sample in range(4):
            x, y, z = _inside(at[bone], end * (0.16 + 0.28 * sample), shifts[finger, bone])
            gap = min(gap, _thing_distance(parts, x, y, z) - radius)
            if len(others) > 0:
                gap = min(gap, _to_capsules(others, x, y, z) - radius + _PRESSED_M)
    return gap


@compiled
def _opposition(angles, hand):
    """How far before the palm the thumb's tip is, less half of how far it is beside the middle
    between index and middle finger, metres; -1 where its pad does not touch the thing.
    """
    _walk(0, angles, hand)
    (_, base, lengths, radii, shifts), parts, _, (_, at) = hand
    last, length, radius = at[2], lengths[0, 2], radii[0, 2]
    nearest, way = 1.0, 0.0
    for sample in range(4):
        x, y, z = _inside(last, (length - radius) * (0.16 + 0.28 * sample), shifts[0, 2])
        gap = _thing_distance(parts, x, y, z)
        if gap < nearest:
            dx, dy, dz = _PAD_M * last[2, 0], _PAD_M * last[2, 1], _PAD_M * last[2, 2]
            onward = _thing_distance(parts, x - dx, y - dy, z - dz)
            nearest, way = gap, (gap - onward) / _PAD_M
    if nearest - radius > _TOUCH_M or way < _FACING:
        return -1.0
    beside = last[0, 0] - length * last[1, 0] - 0.5 * (base[1, 0] + base[2, 0])
    return length * last[1, 2] - last[0, 2] - 0.5 * abs(beside)


@compiled
def _bending(finger, bone):
    """Which angle bends a bone of a finger."""
    if finger == 0:
        return 1 if bone == 0 else 2 + bone
    return 2 + 4 * finger + bone


@compiled
def _close(finger, most, angles, hand):
    """Bend a finger about the thing."""
    for bone in range(3):
        angle = _bending(finger, bone)
        free = angles[angle]
        while True:
            angles[angle] = min(free + _STEP, most[angle])
            if _gap(finger, bone, angles, hand) < 0:
                meets = angles[angle]
                for _ in range(_HALVINGS):
                    angles[angle] = 0.5 * (free + meets)
                    if _gap(finger, bone, angles, hand) < 0:
                        meets = angles[angle]
                    else:
                        free = angles[angle]
                angles[angle] = free
                break
            free = angles[angle]
            if free >= most[angle]:
                break


@compiled
def _yield(finger, angles, hand):
    """Stretch a finger until it is not in the thing."""
    for _ in range(14):
        if _gap(finger, 0, angles, hand) >= 0:
            break
        if finger == 0:  # away from the palm first, then straight; as long as it can, opposed
            if angles[0] < _WIDEST:
                angles[0] = min(angles[0] + _BACK, _WIDEST)
                continue
            if max(angles[3], angles[4]) > _STRAIGHT:
                for angle in (3, 4):
                    angles[angle] = min(angles[angle], max(angles[angle] - _BACK, _STRAIGHT))
                continue
        for bone in range(3):
            angle = _bending(finger, bone)
            angles[angle] = max(angles[angle] - _BACK, min(_LEAST, angles[angle]))


@shared_entry_point
def grasp(angles, thumbs, opposed, most, closing, in_palm, flesh, bones, parts, said):
    """N hands on N things.

    angles: (N, 21), bent in place.  thumbs: (N, K, 5) where the thumbs of power grasps begin, tried
    one after another.  opposed: (N,) whether the thumb is taken that is the most opposed, not the
    first one whose pad touches the thing.  most: (N, 21) beyond which nothing bends.
    closing: (N,) whether middle, ring and little finger close on the thing, too; else they only
    give way where they are in it.  in_palm: (N,) the thing is to touch the palm; its parts
    (N, Q, PART) are moved.  flesh: (N,) how thick the palm is before its bones.
    bones: frames (N, 5, 3, 3), places (N, 5, 3) and lengths (N, 5, 3) of HandShape; radii of
    capsules, and how far palmward they lie (N, 5, 3).
    said: (N, 2) fingers that touch, and the deepest that any lies in the thing, metres.
    """
    thumb, none = np.empty(5), np.empty((0, _CAPSULE))
    before, work = np.empty((_BEFORE_THUMB, _CAPSULE)), (np.empty((3, 3)), np.empty((3, 3, 3)))
    base_frames, base, lengths, radii, shifts = bones
    for n in range(len(angles)):
        mine = base_frames[n], base[n], lengths[n], radii[n], shifts[n]
        hand = (mine, parts[n], none, work)  # what _walk, _gap and others are about
        if in_palm[n]:
            _place_in_palm(parts[n], base[n], flesh[n])
        for finger in (1, 2, 3, 4):
            _yield(finger, angles[n], hand)
            if finger == 1 or closing[n]:
                _close(finger, most[n], angles[n], hand)
        # The thumb last: the fingers hold the thing already.
        if in_palm[n]:
            for finger in (1, 2, 3):
                _capsules_of(finger, angles[n], hand, before[3 * (finger - 1) : 3 * finger])
            about = (mine, parts[n], before, work)
            best = -2.0
            for start in range(thumbs.shape[1]):
                angles[n, :5] = thumbs[n, start]
                _yield(0, angles[n], about)
                _close(0, most[n], angles[n], about)
                opposition = _opposition(angles[n], hand)
                if opposition > best:
                    best = opposition
                    thumb[:] = angles[n, :5]
                if best > -1 and not opposed[n]:
                    break
            angles[n, :5] = thumb
        else:
            _yield(0, angles[n], hand)
            _close(0, most[n], angles[n], hand)
        touching, deepest = 0, 0.0
        for finger in range(5):
            gap = _gap(finger, 0, angles[n], hand)
            touching += gap < _TOUCH_M
            deepest = max(deepest, -gap)
        said[n, 0], said[n, 1] = touching, deepest
