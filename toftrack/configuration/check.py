"""A light check of what was overridden, before torch is loaded: is a number a number, and possible?

Each value is compared with the one in conf/ that it takes the place of: where that is a number, so
must be the override, whole where it is whole, and not negative, as hardly a number in conf/ is.
Which settings must be above 0, and which may be below, stands here; other bounds are for the parts
that use the settings. Only toftrack's own parts are looked at: what a part of somebody else's
accepts, nobody knows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from toftrack.configuration import configuration_folder
from toftrack.errors import MOST_HANDS, ToftrackError, check_number

_ABOVE_ZERO = frozenset(
    """
    data.poses data.worst_fit_mm
    device.fps device.frames device.height device.queue_frames device.timeout_s device.width
    device.emulated.unit_m device.libmesasr.timeout_ms
    device.persistence.backoff_s device.persistence.first_frame_s device.persistence.give_up_s
    device.persistence.longest_backoff_s device.persistence.reopen_after
    device.usb.drain_ms device.usb.read_multiple device.usb.timeout_ms
    filter.exponent filter.exponent_growth filter.particles filter.passes filter.shrink
    gestures.off_rad gestures.other gestures.pinch.open
    hands
    hand.length_m
    likelihood.beta likelihood.tolerance_m
    pose_space.dims
    record_limit_gb
    refine.angle_rad refine.point_m
    detector.hypotheses detector.keypoint_m detector.places
    segmentation.depth_range_m segmentation.max_distance_m segmentation.max_pixels
    segmentation.reach_m
    smooth.min_cutoff_hz smooth.speed_cutoff_hz
    stream.waiting
    view.most_fps view.quality
    """.split()
)
_AT_MOST = {
    **{"hands": MOST_HANDS, "filter.particles": 100_000, "filter.passes": 1000, "seed": 2**62},
    **{"filter.shrink": 10, "filter.spread.translation_m": 10, "filter.spread.depth_m": 10},
    **{"filter.spread.rotation_rad": 10, "detector.keypoint_weight": 1000},
}
"""More particles or passes than these take minutes a frame; larger seeds are none for torch, and
the others leave numbers behind."""
_OPEN_ENDED = frozenset({"segmentation.reach_m", "view.linger_s", "view.wait_s"})
"""Infinity is a value of these."""
MOST_VALUES = 5000
"""In a configuration, or a file of one, an interpolation or alias counted as what it stands for;
Hydra takes two seconds for so many."""
_LOG_ODDS = ("detector.merit",)
"""How the settings begin that may be below 0."""
_MAY_BE_NONE = frozenset({"data.poses", "device.persistence.give_up_s"})
_OF_NETWORKS = {
    "lost._target_": ("toftrack.tracking.confidence.make_confidence", "lost=calibrated"),
    "hand.shape": ("auto", "hand.shape=auto"),
    "hand.side": ("auto", "hand.side=auto"),
}
"""What the tracker with networks alone has: settings, their values, and how these are given."""
_OF_PAPER = {
    "start._target_": ("toftrack.tracking.paper.RoughStart", "start=rough"),
    "lost._target_": ("toftrack.tracking.paper.ScoreThreshold", "lost=score"),
}
"""Likewise the paper's."""
_GROUPS = {"detector": "network", "renderer": "auto", "posterior": "default"}
"""Groups that a tracker needs, and their usual choices; the paper's needs no posterior."""
_NO_NETWORKS = "toftrack.detector.hand_detector.no_detector"


def check_overrides(config: DictConfig, name: str, overrides: Sequence[str]) -> None:
    """Compare a composed configuration with what it would be if only options were chosen; raise
    ToftrackError with one sentence that names the setting.

    Hydra is initialised within `compose` and a job of `@hydra.main`.

    name: of the configuration file.  overrides: of the command line.
    """
    check_interpolations(config)
    check_tracker(config, overrides)
    given, device = OmegaConf.select(config, "camera.file"), config.get("device")
    if given is not None and device is not None and "camera.file" not in OmegaConf.to_yaml(device):
        raise ToftrackError(
            "this device takes no camera.file: its file in conf/device has no line like"
            " 'camera_file: ${camera.file}'; leave camera.file out, or add one"
        )
    space = config.get("pose_space") or {}
    of_file = space.get("file") is not None and str(space.get("_target_")).startswith("toftrack.")
    for word in overrides if of_file else ():
        if re.match(r"\+*pose_space\.(?!(dims|file|kind)\b|_)", word):
            raise ToftrackError(
                f"{word} is for learning, but pose_space.file={space['file']} is learned already; "
                "leave one out"
            )
    for word in overrides if name == "train_pose_space" else ():
        if re.match(r"\+*pose_space\.data=", word):
            raise ToftrackError(
                f"{word} is a setting of the tracker; give {word.partition('.')[2]} to train"
            )
    if not GlobalHydra.instance().is_initialized():  # --experimental-rerun: it was checked then
        return
    loader = GlobalHydra.instance().config_loader()
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    chosen = [o for o in parsed if not o.is_delete() and loader.get_group_options(o.key_or_group)]
    if len(chosen) == len(parsed):
        return
    try:
        lines = [override.input_line for override in chosen if override.input_line is not None]
        [folder] = [x.path for x in loader.get_search_path().get_path() if x.provider == "main"]
        own = folder == str(configuration_folder())  # files of others may change meanwhile
        default = (_with_choices if own else _with_choices.__wrapped__)(name, *lines)
    except (HydraException, OmegaConfBaseException):
        return  # options that exclude each other unless something is deleted: nothing to compare
    for key, value, usual in _pairs(config, default):
        _check_value(key, value, usual)


@lru_cache(maxsize=16)
def _with_choices(name: str, *lines: str) -> DictConfig:
    """What Hydra composes of options alone. It is half of the time in which a tracker is made, and
    the next one's options are mostly the same.
    """
    return GlobalHydra.instance().config_loader().load_configuration(name, [*lines], RunMode.RUN)


def check_interpolations(config: DictConfig) -> None:
    """Raise ToftrackError where interpolations of interpolations, as `b: ${a}${a}`, `c: ${b}${b}`,
    make a large configuration of a small one: OmegaConf resolves each anew wherever it stands.
    """
    plain: Any = OmegaConf.to_container(config)
    sizes: dict[tuple[str, ...], int] = {}

    def size(path: tuple[str, ...]) -> int:
        """Values of a setting or a group, 0 where there is none of that path."""
        if path in sizes:
            return sizes[path]
        sizes[path] = 0  # of a circle, which OmegaConf tells of
        value, inner = plain, []
        try:
            for key in path:
                value = value[int(key) if isinstance(value, list) else key]
        except (LookupError, TypeError, ValueError):
            return 0
        if isinstance(value, dict | list):
            keys = value if isinstance(value, dict) else range(len(value))
            inner = [(*path, str(key)) for key in keys]
        elif "${" in str(value):  # each word that is a setting's may be asked for
            for dots, words in re.findall(r"(\.*)(\w[\w.[\]]*)", str(value)):
                inner.append((*path[: -len(dots) or -len(path)], *re.findall(r"\w+", words)))
        sizes[path] = 1 + sum(map(size, inner))
        return sizes[path]

    if size(()) > MOST_VALUES:
        raise ToftrackError(
            "interpolations (${...}) that stand for one another make the configuration too large "
            f"(at most {MOST_VALUES} values in all); write the values instead"
        )


def check_groups(config: DictConfig) -> None:
    """Raise ToftrackError where a folder of somebody's own lacks a group."""
    paper = OmegaConf.select(config, "detector._target_") == _NO_NETWORKS
    for group, choice in _GROUPS.items():
        needless = paper and group == "posterior"
        if not (needless or isinstance(config.get(group), DictConfig)):
            raise ToftrackError(
                f"the configuration has no {group}; add '- {group}: {choice}' to the defaults of "
                f"your config.yaml, or leave ~{group} out"
            )


def check_tracker(config: DictConfig, overrides: Sequence[str] = ()) -> None:
    """Raise ToftrackError where parts of the paper's tracker and of the other one are mixed.

    overrides: of the command line, which the error names.
    """
    without = OmegaConf.select(config, "detector._target_") == _NO_NETWORKS
    given = [
        choice
        for key, (value, choice) in (_OF_NETWORKS if without else _OF_PAPER).items()
        if OmegaConf.select(config, key) == value
    ]
    refined = without and OmegaConf.select(config, "refine.iterations")
    if refined:
        said = (word for word in overrides if word.startswith("refine."))
        given.append(next(said, "refine=gauss_newton"))
    given += [word for word in overrides if without and word.startswith("posterior.")]
    some = ", ".join(given)
    if not given:
        return
    if "detector=none" in overrides or (refined and "lost=calibrated" in given):
        raise ToftrackError(
            "detector=none belongs to experiment=paper, the tracker without networks; give"
            " experiment=paper, or leave detector=none out"
        )
    if without:
        raise ToftrackError(
            f"{some} works only with networks, which experiment=paper lacks; leave {some} out,"
            " or leave experiment=paper out"
        )
    if "start=rough" in given:  # which experiment=paper brings
        raise ToftrackError(
            "experiment=paper is the tracker without networks; leave it out, or the detector"
        )
    raise ToftrackError(
        f"{some} belongs to experiment=paper; give experiment=paper as well, or leave {some} out"
    )


def _check_value(key: str, value: object, usual: object) -> None:
    """Raise ToftrackError where a setting's value cannot stand in for the usual one in conf/."""
    if isinstance(usual, bool):
        if not isinstance(value, bool):
            raise ToftrackError(f"{key}={value} is not possible; give true or false")
    elif isinstance(usual, (int, float)):
        if value is None and key in _MAY_BE_NONE or value == math.inf and key in _OPEN_ENDED:
            return
        least = -math.inf if key.startswith(_LOG_ODDS) else 0
        most = _AT_MOST.get(key, math.inf)
        above, whole = key in _ABOVE_ZERO, isinstance(usual, int)
        check_number(key, value, least, most, above=above, whole=whole)
    elif isinstance(usual, dict):  # and the value is none
        name = next((name for name in usual if name != "_target_"), "NAME")
        raise ToftrackError(
            f"{key}={value} is not possible: it has settings of its own; give these, as "
            f"{key}.{name}=VALUE"
        )
    elif isinstance(usual, list) and not isinstance(value, list):
        raise ToftrackError(f"{key}={value} is not possible; give a list, as [{value}]")


def _pairs(
    config: DictConfig, default: DictConfig, prefix: str = ""
) -> Iterator[tuple[str, object, object]]:
    """Key, value and usual value of every setting that both have and that differs."""
    ours = str(OmegaConf.select(config, "_target_", default="toftrack.")).startswith("toftrack.")
    for name in map(str, config):
        key = f"{prefix}{name}"
        if name not in default or any(OmegaConf.is_missing(one, name) for one in (config, default)):
            continue
        try:
            value, usual = config[name], default[name]
        except OmegaConfBaseException:
            continue  # an interpolation that only resolves elsewhere
        if isinstance(value, DictConfig) and isinstance(usual, DictConfig):
            yield from _pairs(value, usual, f"{key}.")
        elif ours:
            plain, other = (
                OmegaConf.to_container(one) if OmegaConf.is_config(one) else one
                for one in (value, usual)
            )
            if plain != other or type(plain) is not type(other):
                yield key, plain, other
