"""Checks of settings: a number that cannot be meant is refused with one sentence."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

from toftrack.errors import ToftrackError

MOST_HANDS = 8
"""That are followed at once."""


def check_number(
    key: str,
    value: Any,
    least: float = -math.inf,
    most: float = math.inf,
    *,
    above: bool = False,
    whole: bool = False,
    remedy: str = "",
) -> None:
    """Raise ToftrackError unless a setting is a finite number between two bounds.

    key: the setting's name on the command line.  above: `least` itself is not allowed.
    whole: only whole numbers are.  remedy: what else to do, added to the sentence.
    """
    number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    if number and math.isfinite(value) and least <= value <= most and (value > least or not above):
        return
    bounds = []
    if least > -math.inf:
        bounds.append(f"{'above' if above else 'of at least'} {least:g}")
    if most < math.inf:
        bounds.append(f"at most {most:g}")
    wanted = f"{'a whole number' if whole else 'a number'} {' and '.join(bounds)}".strip()
    raise ToftrackError(f"{key}={value} is not possible; give {wanted}{remedy}")
