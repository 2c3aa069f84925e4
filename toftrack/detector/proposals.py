"""What the networks' outputs say: places of hands by the finder, detections by the pose network.

The pose network knows right hands. For a left one the image is read as a mirror shows it, and what
was found is mirrored after: t_x -> -t_x, R -> M R M with M = diag(-1, 1, 1), angles as they are.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from toftrack.detector.crops import CROP, CROP_CHANNELS, crop_at, crop_rotation
from toftrack.detector.decoding_numba import KEPT, decode_at
from toftrack.detector.detection import OF_HYPOTHESES, Detection, doubted_sigma_m
from toftrack.detector.network import JOINTS, STRIDE, Found
from toftrack.detector.parts import Parts, likeliest_parts
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.refinement.gauss_newton import Keypoints

SAME_PLACE_M = 0.06
"""Hands that are detected closer together are one."""
_ONE_PALM_M = 0.035
"""Places of the finder that lie closer together are one palm. It is less than the above, since the
finder takes hands that touch for nearer than they are: 4 cm apart where it was 9."""
_MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Places:
    """Where hands may be, likeliest first.

    centre_m: (P, 3) middles of palms, camera frame.  probability: (P,).
    """

    centre_m: np.ndarray
    probability: np.ndarray


@torch.inference_mode()
def likely_places(found: Found, wide_k: np.ndarray, most: int, least: float) -> Places:
    """At most `most` places of hands, each at least `least` likely, by what the finder says.

    wide_k: (3, 3) of the image that the finder has seen.
    """
    # In numpy: on few numbers each of torch's operations takes longer than its arithmetic.
    heat = found.heat[0].sigmoid().numpy()
    peaks = (heat == cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat >= least)
    row, column = np.nonzero(peaks)
    order = np.argsort(-heat[row, column], kind="stable")
    row, column = row[order], column[order]
    z, right, down = (
        image[0].numpy()[row, column] for image in (found.log_depth.exp(), found.column, found.row)
    )
    z = z.clip(0.1, 3.0)
    u = (column.astype(np.float32) + right.clip(-2, 2) + 0.5) * STRIDE - 0.5
    v = (row.astype(np.float32) + down.clip(-2, 2) + 0.5) * STRIDE - 0.5
    x, y = (u - wide_k[0, 2]) / wide_k[0, 0] * z, (v - wide_k[1, 2]) / wide_k[1, 1] * z
    centres = np.stack((x, y, z), 1).astype(np.float32)
    rows = _apart(centres, most)
    return Places(centres[rows], heat[row, column][rows])


def _apart(centres_m: np.ndarray, most: int) -> list[int]:
    """Indices of places, likeliest first, `most` at most: of those on one palm only the first."""
    kept: list[int] = []
    for row, centre in enumerate(centres_m):
        if len(kept) == most:
            break
        if all(np.linalg.norm(centre - centres_m[other]) > _ONE_PALM_M for other in kept):
            kept.append(row)
    return kept


class Crop:
    """The crop that the pose network sees at a place, where a hand of one side is looked for.

    image: (1, CROP_CHANNELS, CROP, CROP).
    """

    def __init__(
        self,
        depth_m: np.ndarray,
        k: np.ndarray,
        centre_m: np.ndarray,
        side: str,
        up: np.ndarray | None,
    ) -> None:
        # Copies: numba compiles once more for arrays that must not be written to.
        k, centre, left = np.array(k, np.float64), np.array(centre_m, np.float64), side == "left"
        if left:  # depth, k and centre are, or are read, as a mirror shows them
            k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
            centre *= _MIRROR
            up = None if up is None else up * _MIRROR
        turn = crop_rotation(centre, up)
        self.place, self.hand = (turn, centre, left), _mean_hand(side)
        self.image = np.empty((1, CROP_CHANNELS, CROP, CROP), np.float32)
        crop_at(np.ascontiguousarray(depth_m, np.float32), left, k, centre, turn, self.image[0])

    def decode(self, outputs: tuple[np.ndarray, ...]) -> Detection:
        """The detection, in the camera frame, that the network's outputs for the crop mean."""
        heads, keypoints, painted = outputs
        found = {name: np.empty((KEPT, *row), np.float32) for name, row in OF_HYPOTHESES.items()}
        points, sigma, odds = (np.empty(shape, np.float32) for shape in ((JOINTS, 3), JOINTS, 2))
        written = *found.values(), points, sigma, odds
        decode_at(heads[0], keypoints[0], self.image[0, 0], *self.place, self.hand, written)
        length_m = DEFAULT_HAND_LENGTH_M * math.exp(found["log_size"][0])
        points_m, sigma_m = torch.from_numpy(points), torch.from_numpy(sigma)
        present, right_side = torch.from_numpy(odds).sigmoid().tolist()
        hypotheses: dict[str, Any] = {name: torch.from_numpy(one) for name, one in found.items()}
        return Detection(
            **hypotheses,
            keypoints=Keypoints(points_m, doubted_sigma_m(points_m, sigma_m, length_m)),
            present=present,
            right_side=right_side,
            parts=Parts(likeliest_parts(painted[0]), *self.place),
        )


@functools.cache
def _mean_hand(side: str) -> tuple[np.ndarray, ...]:
    """Frames, places and bones of the mean adult's hand of a side."""
    shape = default_hand_shape(side=side)
    parts = shape.base_frames, shape.base_m, shape.bone_lengths_m
    return tuple(part.double().numpy() for part in parts)
