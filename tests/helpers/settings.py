"""Parts as conf/ fills them, with changes: nothing in Python repeats those numbers."""

from functools import cache, partial
from inspect import signature
from typing import Any

from helpers.tracking import configuration
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from toftrack.detector.hand_detector import DetectorSettings


@cache
def _node(choice: str, key: str) -> DictConfig:
    return OmegaConf.select(configuration(choice), key)


def values(choice: str, key: str) -> dict[str, Any]:
    """What conf/ gives to a part: `values("view=browser", "view")`; inner parts are made."""
    node = _node(choice, key)
    given = {}
    for name in node:
        if name == "_target_" or OmegaConf.is_missing(node, name):
            continue
        value = node[name]
        if OmegaConf.is_config(value):
            made = "_target_" in value if isinstance(value, DictConfig) else False
            value = instantiate(value) if made else OmegaConf.to_container(value, resolve=True)
        given[str(name)] = value
    return given


def part(choice: str, key: str, *given: Any, **changes: Any) -> Any:
    """A part as conf/ makes it, but for what is given by position or name."""
    target = get_object(_node(choice, key)._target_)
    by_position = dict(zip(signature(target).parameters, given, strict=False))
    return target(**values(choice, key) | by_position | changes)


usb_settings = partial(part, "device=sr3000", "device.usb")
mesa_settings = partial(part, "device=sr3000", "device.libmesasr")
persistence_settings = partial(part, "device=sr3000", "device.persistence")
sr3000_emulator = partial(part, "device=sr3000", "device.emulated")
sr3000 = partial(part, "device=sr3000", "device")
realsense_emulator = partial(part, "device=realsense", "device.emulated")
realsense = partial(part, "device=realsense", "device")
orbbec = partial(part, "device=orbbec", "device")
stdout_stream = partial(part, "stream=stdout", "stream")
udp_stream = partial(part, "stream=udp", "stream")
gestures = partial(part, "gestures=default", "gestures")
browser_view = partial(part, "view=browser", "view")
nearest_surface = partial(part, "segmentation=nearest", "segmentation")
f_measure = partial(part, "likelihood=f_measure", "likelihood")
refinement = partial(part, "refine=gauss_newton", "refine")
posterior_weights = partial(part, "posterior=default", "posterior")
confidence_model = partial(part, "lost=calibrated", "lost")
rough_start = partial(part, "experiment=paper", "start")


def detector_settings(**changes: Any) -> DetectorSettings:
    """conf/detector/network.yaml, without its weights"""
    given = values("detector=network", "detector") | changes
    del given["weights"]
    return DetectorSettings(**given)
