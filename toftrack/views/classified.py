"""The likelihood's view of one hypothesis, pixel by pixel (paper, fig. 3)."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from toftrack.hand.shape import HandShape
from toftrack.render.likelihood import Likelihood
from toftrack.render.model_image import posed_hand, range_image
from toftrack.render.reference import classify_range_images
from toftrack.render.segmentation import Observation

CLASSES = ("nothing", "neighbourhood", "correct", "false", "missed")
"""Names of the labels of `classify`, in order."""

# The paper's red, green and blue in the hues of Okabe and Ito, which colour-blind people can tell
# apart.
CLASS_RGB = ((255, 255, 255), (205, 205, 205), (213, 94, 0), (0, 158, 115), (0, 114, 178))
"""Of each of CLASSES."""


def classify(
    state: np.ndarray, shape: HandShape, observation: Observation, likelihood: Likelihood
) -> tuple[np.ndarray, np.ndarray]:
    """Tell the pixels that the likelihood counts; their numbers are the scorer's counts.

    state: (27,) of the hypothesis; where it is NaN there is none, and both images are empty.

    Returns (H, W) float32 metres, the hypothesis's surface, 0 = none; and (H, W) uint8, positions
    in CLASSES: correct is surface where the image has the hand, at its depth, false where it has
    none and nothing hides it, missed the image's hand in the neighbourhood, which is around the
    silhouette, outside of it and of the wrist.
    """
    evidence = likelihood.evidence(observation)
    height, width = evidence.hand.shape
    if not np.isfinite(state).all():
        return np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    hand, wrist = posed_hand(state, shape)
    k = evidence.k.numpy()
    range_m = range_image(hand, k, height, width)
    on_wrist = range_image(wrist, k, height, width) > 0
    beside = (range_m == 0).astype(np.uint8)
    # OpenCV knows no distance where there is nothing to be distant from.
    reach = np.zeros((height, width), bool)
    if not beside.all():
        distance_px = cv2.distanceTransform(beside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        reach = distance_px <= evidence.radius_px
    surface, at_wrist, near = (torch.from_numpy(a)[None] for a in (range_m, on_wrist, reach))
    classes = classify_range_images(surface, at_wrist, near, evidence)
    labels = classes.near[0].numpy().astype(np.uint8)
    for label in (2, 3, 4):
        labels[getattr(classes, CLASSES[label])[0].numpy()] = label
    return range_m, labels
