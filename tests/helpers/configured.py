"""Parts as the configuration has them, with changes: settings have no defaults of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import hydra
from helpers.settings import values
from helpers.tracking import configuration

from toftrack.detector.hand_detector import DetectorSettings


@cache
def _made(group: str, *overrides: str) -> Any:
    return hydra.utils.instantiate(configuration(*overrides)[group])


def _changed(*given: str, **changes: Any) -> Any:
    return replace(_made(*given), **changes)


nearest_surface = partial(_changed, "segmentation")
f_measure = partial(_changed, "likelihood")
refinement = partial(_changed, "refine")
posterior_weights = partial(_changed, "posterior")
confidence_model = partial(_changed, "lost")
rough_start = partial(_changed, "start", "experiment=paper")


def detector_settings(**changes: Any) -> DetectorSettings:
    """conf/detector/network.yaml, without its weights"""
    given = values("detector=network", "detector") | changes
    del given["weights"]
    return DetectorSettings(**given)
