"""What tells one person's hand from another's in a few numbers: the space of hand shapes.

Six components, each a logarithm that is 0 for the hand they start from (the mean adult's) and, in
a population, about normal:

  * length: wrist to middle fingertip.
  * fingers: all fingers longer and the palm shorter, by the ratio of the two.
  * breadth: the palm broader and all flesh thicker, at the same length.
  * thickness: the flesh alone.
  * thumb: its bones, beside the other fingers'.
  * outer: the index finger longer and the little one shorter, the others between.

Standard deviations, published: over the 4082 men and 1986 women of ANSUR II (Gordon et al., "2012
anthropometric survey of U.S. Army personnel", public data), as many men as women, that of
log(hand length) is 0.063, of log((hand length - palm length) / palm length) 0.081, of log(hand
breadth / hand length) 0.055; none of these correlates by more than 0.22 with another, so they are
taken as independent. Log(circumference / length) has 0.056 and goes with the breadth by 0.93, which
is why breadth thickens the flesh as well; what is left of the circumference, 0.021, comes to 0.1 of
the palm's thickness if its section is a stadium.

Assumed: 0.12 for the length, since children are users too and army personnel are all adult; 0.06
for the thumb and 0.05 for the outer fingers: single phalanges vary by 7 to 16 % (Buryanov and
Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28(3), 2010), most of it with the hand's
size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from toftrack.hand.shape import HandShape

COMPONENTS = ("length", "fingers", "breadth", "thickness", "thumb", "outer")
POPULATION_SIGMA = (0.12, 0.08, 0.055, 0.10, 0.06, 0.05)
"""Standard deviations of the components, see above."""
_OUTER = (0.0, 1.0, 1 / 3, -1 / 3, -1.0)
_STEP = 0.01


def shaped(first: HandShape, components: Tensor) -> HandShape:
    """The hand whose components (6,) are these, where `first` has none; of its device and dtype."""
    length, fingers, breadth, thickness, thumb, outer = components.to(first.base_m)
    log_factor = outer * first.base_m.new_tensor(_OUTER) + 0.5 * fingers
    log_factor[0] += thumb
    bones = first.bone_lengths_m * log_factor.exp()[:, None]
    base = first.base_m * torch.stack((breadth, -0.5 * fingers, breadth)).exp()
    middle = base[2].norm() + bones[2].sum()
    scale = length.exp() * first.hand_length_m / middle
    return replace(
        first,
        base_m=base * scale,
        bone_lengths_m=bones * scale,
        thickness=first.thickness * float((breadth + thickness).exp()),
    )


def shape_derivatives(first: HandShape, components: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """How the roots (6, 5, 3) and the bones (6, 5, 3) of a hand on the CPU change with each
    component, metres.
    """
    steps = _STEP * torch.eye(len(COMPONENTS))
    up = [shaped(first, components + step) for step in steps]
    down = [shaped(first, components - step) for step in steps]
    pairs = list(zip(up, down, strict=True))
    base = np.stack([(a.base_m - b.base_m).numpy() for a, b in pairs])
    bones = np.stack([(a.bone_lengths_m - b.bone_lengths_m).numpy() for a, b in pairs])
    return base / (2 * _STEP), bones / (2 * _STEP)
