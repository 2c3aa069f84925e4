"""The gestures that toftrack knows, said by finger: straight, bent or curled, and the thumb.

A finger's state is a range of its total flexion and of its split (see features.py), in degrees;
the ranges are those of functional motion (Bain et al., J. Hand Surg. Eur. 40(4), 2015): a straight
finger is within 30 degrees of straight, one curled into the palm has about 90, 100 and 50 degrees
in its joints, or 40, 115 and 70 where its knuckle is hardly bent, and the fingers of a resting hand
30, 40 and 15, the little one the most. The thumb is recognised by where its tip is. Nothing here
was fitted to recordings, but where hooked fingers end and curled ones begin was moved by looking at
real fists.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from toftrack.gestures import features

OTHER = "other"
FIST = "fist"
POINTING = "pointing"
POINTING_THUMB = "pointing_thumb"
RAY_GESTURES = (POINTING, POINTING_THUMB)
"""Those that have a pointing ray."""

_Features = dict[int, tuple[float, float]]


class Definition(NamedTuple):
    """One way to make a gesture.

    name: of the gesture.  low, high: (13,) the features' ranges, rad and palm lengths; NaN where a
    feature does not matter.
    """

    name: str
    low: np.ndarray
    high: np.ndarray


# Ranges of total flexion and of split, degrees.
_FINGERS = {
    "S": ((-30, 30), (-25, 25)),  # straight
    "C": ((200, 270), (20, 160)),  # curled
    "L": ((150, 270), (-5, 100)),  # loosely curled
    "U": ((172, 225), (80, 128)),  # rolled up over a knuckle that is hardly bent
    "R": ((55, 130), (-5, 60)),  # resting
    "H": ((120, 176), (100, 180)),  # hooked
    "F": ((60, 110), (-110, -40)),  # flat and bent at the knuckle
    "P": ((70, 160), (-10, 90)),  # pinching
    "N": ((-30, 60), (-25, 40)),  # nearly straight
}

# Where the thumb's tip is: reach and gap in palm lengths, total flexion in degrees.
_ANY: _Features = {}
_STRETCHED: _Features = {features.REACH: (1.30, 1.75)}
_NOT_STRETCHED: _Features = {features.REACH: (0.60, 1.00)}
_ACROSS: _Features = {features.REACH: (0.60, 0.85), features.THUMB_FLEXION: (70, 160)}
_BESIDE: _Features = {features.REACH: (0.75, 1.05), features.THUMB_FLEXION: (-40, 40)}
_OPEN: _Features = {features.REACH: (0.95, 1.75), features.THUMB_FLEXION: (-40, 40)}
_ON_INDEX_TIP: _Features = {features.GAP: (0.0, 0.2)}
# Whether index and middle finger are side by side or make a V, at the tips.
_TOGETHER: _Features = {features.APART: (0.15, 0.28)}
_APART: _Features = {features.APART: (0.42, 0.80)}


def _define(name: str, fingers: str, tips: _Features) -> Definition:
    """fingers: of each the letter in _FINGERS, index to little.  tips: ranges of other features."""
    ranges = np.full((2, features.COUNT), math.nan)
    for number, letter in enumerate(fingers):
        flexion, split = _FINGERS[letter]
        ranges[:, features.FLEXION.start + number] = np.radians(flexion)
        ranges[:, features.SPLIT.start + number] = np.radians(split)
    for feature, values in tips.items():
        ranges[:, feature] = values if feature >= features.REACH else np.radians(values)
    return Definition(name, *ranges)


_ALL = (
    _define("palm", "SSSS", _OPEN),
    _define("palm", "SSSS", _BESIDE),
    _define(FIST, "CCCC", _NOT_STRETCHED),
    _define(POINTING, "SCCC", _NOT_STRETCHED),
    _define(POINTING_THUMB, "SCCC", _STRETCHED),
    # Two fingers side by side point as well; in a V they are a number.
    _define(POINTING, "SSCC", _NOT_STRETCHED | _TOGETHER),
    _define(POINTING_THUMB, "SSCC", _STRETCHED | _TOGETHER),
    # Who puts a thumb up need not make a fist of the rest, and some hardly bend their knuckles.
    _define("thumb_up", "LLLL", _STRETCHED),
    _define("thumb_up", "UUUU", _STRETCHED),
    _define("victory", "SSCC", _NOT_STRETCHED | _APART),
    # Three is counted from the index finger on, or from the thumb on.
    _define("three", "SSSC", _ANY),
    _define("three", "SSCC", _STRETCHED | _APART),
    _define("four", "SSSS", _ACROSS),
    _define("ok", "PNNN", _ON_INDEX_TIP),
    _define("relaxed", "RRRR", _ANY),
    # What is near a gesture and none: a hooked hand is no fist, one bent at the knuckles not
    # relaxed, and neither is one with the little finger up, alone or with the index finger, however
    # loosely the others are curled.
    *(_define(OTHER, fingers, _ANY) for fingers in ("HHHH", "FFFF", "LLLS", "SLLS")),
)
_PAPER = tuple(
    _define(name, fingers, _ANY)
    for name, fingers in (("palm", "SSSS"), (FIST, "CCCC"), (POINTING, "SCCC"))
)
SETS = {"all": _ALL, "paper": _PAPER}
"""By the name that conf/gestures gives: all that are known, or the paper's three, whatever the
thumb does."""
