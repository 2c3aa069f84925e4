"""What a part of the tracker cannot work with is refused, by the name of its key."""

import math
from collections.abc import Callable

import pytest
from helpers import settings

from toftrack.errors import ToftrackError

IMPOSSIBLE = {
    "likelihood": (
        settings.f_measure,
        {"naming": "usual", "tolerance_m": 0.0, "neighbourhood_m": -0.01}
        | {"beta": 0.0, "residual_weight": 1.5, "coverage": math.nan},
    ),
    "segmentation": (
        settings.nearest_surface,
        {"max_pixels": 0.5, "max_distance_m": 0, "depth_range_m": -0.1, "min_area_m2": -1}
        | {"occluder_margin_m": math.inf, "reach_m": math.nan},
    ),
    "detector": (
        settings.detector_settings,
        {"places": 0, "hypotheses": 1.5, "least": 2.0, "merit": math.nan}
        | {"every": 0, "sure": 0.4, "keypoint_m": 0.0},
    ),
    "refine": (settings.refinement, {"iterations": -1, "point_m": -0.01, "angle_rad": "wide"}),
    "posterior": (settings.posterior_weights, {"keypoints": -1, "overlap": -1, "other_hand": -1}),
    "lost": (
        settings.confidence_model,
        {"confidence": 1.5, "give_up": -0.1, "memory": 1.0, "patience": 2.5},
    ),
}


@pytest.mark.parametrize(
    ("group", "part", "key", "value"),
    [
        (group, part, key, value)
        for group, (part, values) in IMPOSSIBLE.items()
        for key, value in values.items()
    ],
)
def test_a_setting_that_cannot_be_is_named(
    group: str, part: Callable, key: str, value: object
) -> None:
    with pytest.raises(ToftrackError, match=f"^{group}.{key}={value}"):
        part(**{key: value})
