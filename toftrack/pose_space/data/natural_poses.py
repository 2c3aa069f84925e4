"""Natural joint angles as they are kept in the package: recorded motion, and poses drawn at random.

The drawn ones are of what people show a camera, counting, pinches, thumbs, fists and everything
between, in the ranges of functional motion (Bain et al., J. Hand Surg. Eur. 40(4), 2015; Santello
et al., J. Neurosci. 18(23), 1998, for how the fingers go together). The tracker's poses stay as
they are kept; what the networks learn from is drawn anew (shown_poses.py).
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

_DATA = Path(__file__).parents[2] / "data" / "natural_poses.npz"


def _kept(name: str) -> Tensor:
    with np.load(_DATA, allow_pickle=False) as content:
        return torch.from_numpy(content[name].astype(np.float32))


@functools.cache
def recorded_poses() -> Tensor:
    """(800, 21) joint angles of recorded bare hands, radians (see data/README.md)."""
    return _kept("angles_centidegrees") * (math.pi / 18000)


def drawn_poses() -> Tensor:
    """(480, 21) radians, within the joint limits, from which pose spaces are learned."""
    return _kept("space_rad")


@functools.cache
def natural_poses() -> Tensor:
    """(1600, 21) radians: the recorded poses and as many that were drawn."""
    return torch.cat((recorded_poses(), _kept("sampled_rad")))
