"""Parts as the configuration has them, with changes: settings have no defaults of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import hydra
from tracking import configuration

from toftrack.refinement.gauss_newton import Refinement
from toftrack.refinement.steadying import Steadying
from toftrack.render.likelihood import FMeasure
from toftrack.render.segmentation import NearestSurface


@cache
def _part(group: str) -> Any:
    return hydra.utils.instantiate(configuration()[group])


def nearest_surface(**changes: Any) -> NearestSurface:
    """conf/segmentation/nearest.yaml"""
    return replace(_part("segmentation"), **changes)


def f_measure(**changes: Any) -> FMeasure:
    """conf/likelihood/f_measure.yaml"""
    return replace(_part("likelihood"), **changes)


def refinement(**changes: Any) -> Refinement:
    """conf/refine/gauss_newton.yaml"""
    return replace(_part("refine"), **changes)


def steadying(**changes: Any) -> Steadying:
    """The steadying of conf/refine/gauss_newton.yaml"""
    return replace(_part("refine").steadying, **changes)
