"""The hand model: skeleton (kinematics), shape (sizes) and surface (ellipsoids)."""

from __future__ import annotations

from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, HandShape, default_hand_shape


def make_hand_shape(
    shape: str = "default", side: str = "right", length_m: float = DEFAULT_HAND_LENGTH_M
) -> HandShape:
    """The hand of a configuration: the mean adult's scaled to a length, or one read from a file.

    shape: "default"; "auto", the same as a guess to start from; or the path of a hand-shape file.
    Raises ToftrackError for an unknown side, an impossible length or an unreadable file.
    """
    if shape in ("default", "auto"):
        return default_hand_shape(length_m, side)
    return HandShape.load(shape).of_side(side)
