"""Parts as the configuration has them, with changes: settings have no defaults of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import hydra
from helpers.tracking import configuration
from omegaconf import OmegaConf

from toftrack.detector.hand_detector import DetectorSettings
from toftrack.refinement.gauss_newton import Refinement
from toftrack.render.likelihood import FMeasure
from toftrack.render.segmentation import NearestSurface
from toftrack.tracking.confidence import ConfidenceModel
from toftrack.tracking.paper import RoughStart
from toftrack.tracking.posterior import PosteriorWeights


@cache
def _part(group: str, *overrides: str) -> Any:
    return hydra.utils.instantiate(configuration(*overrides)[group])


def nearest_surface(**changes: Any) -> NearestSurface:
    """conf/segmentation/nearest.yaml"""
    return replace(_part("segmentation"), **changes)


def f_measure(**changes: Any) -> FMeasure:
    """conf/likelihood/f_measure.yaml"""
    return replace(_part("likelihood"), **changes)


def refinement(**changes: Any) -> Refinement:
    """conf/refine/gauss_newton.yaml"""
    return replace(_part("refine"), **changes)


def posterior_weights(**changes: Any) -> PosteriorWeights:
    """conf/posterior/default.yaml"""
    return replace(_part("posterior"), **changes)


def rough_start(**changes: Any) -> RoughStart:
    """conf/start/rough.yaml, of experiment=paper alone"""
    return replace(_part("start", "experiment=paper"), **changes)


def confidence_model(**changes: Any) -> ConfidenceModel:
    """conf/lost/calibrated.yaml"""
    return replace(_part("lost"), **changes)


@cache
def _detector_settings() -> DetectorSettings:
    config = OmegaConf.to_container(configuration("detector=network").detector)
    assert isinstance(config, dict)
    del config["_target_"], config["weights"]
    return DetectorSettings(**config)


def detector_settings(**changes: Any) -> DetectorSettings:
    """conf/detector/network.yaml, without its weights"""
    return replace(_detector_settings(), **changes)
