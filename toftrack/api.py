"""toftrack in a program of one's own: trackers and devices from the same configuration."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.utils import instantiate
from hydra.version import VersionBase
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

import toftrack
from toftrack.errors import ToftrackError
from toftrack.programs.command_line import sentence

if TYPE_CHECKING:
    from toftrack.devices.base import Device
    from toftrack.tracker import Tracker

_ROOT = "config.yaml"
_composing = threading.Lock()


def make_tracker(*overrides: str, config_dir: str | Path | None = None) -> Tracker:
    """A tracker as `python track.py` with these overrides has it: `tracker.step(depth_m, K)`.

    Any number of them may work in one process, each in a thread of its own; one tracker must not be
    used by two threads at once.

    Args:
        overrides: as on the command line, "hand.side=left" or "filter.particles=1000".
        config_dir: a folder with your own config.yaml and its groups, instead of toftrack's.

    Raises:
        ToftrackError: an override or a file that it names cannot be used.
    """
    config = configuration(*overrides, config_dir=config_dir)
    with _one_sentence():
        from toftrack.programs.track import (
            build_tracker,  # takes seconds: an override's error comes before
        )

        return build_tracker(config)


def make_device(*overrides: str, config_dir: str | Path | None = None) -> Device:
    """The camera or recording of `python track.py` with these overrides, for a `with` and a `for`.

    Its frames are as the camera took them; `device.camera.rectify(frame.depth, frame.radial)` is
    what a tracker wants, together with `device.camera.K`.

    Args:
        overrides: as on the command line, "device=replay" and "device.path=FILE.npz".
        config_dir: as for make_tracker.

    Raises:
        ToftrackError: an override cannot be used, or the device cannot deliver.
    """
    config = configuration(*overrides, config_dir=config_dir)
    with _one_sentence():
        return instantiate(config.device)


def configuration(*overrides: str, config_dir: str | Path | None = None) -> DictConfig:
    """The configuration of `python track.py` with overrides.

    A Hydra application that calls this keeps its own state of Hydra.

    Raises ToftrackError when it cannot be composed.
    """
    folder = (
        configuration_folder() if config_dir is None else Path(config_dir).expanduser().resolve()
    )
    if not (folder / _ROOT).is_file():
        raise ToftrackError(
            f"there is no {_ROOT} in the folder '{folder}'; give config_dir=FOLDER, a folder laid "
            "out as toftrack's conf/"
        )
    for override in overrides:
        if not isinstance(override, str):
            raise ToftrackError(
                f"the override {override!r} is no text; give overrides as on the command line, "
                "'hand.side=left'"
            )
    with _one_sentence(), _own_hydra(), initialize_config_dir(str(folder), version_base="1.3"):
        return compose(_ROOT.removesuffix(".yaml"), overrides=list(overrides))


def configuration_folder() -> Path:
    """toftrack's own conf/: in the package where a wheel was installed, beside it in a checkout."""
    package = Path(toftrack.__file__).parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Hydra has one state a process, which may be that of an application around us."""
    kinds = (GlobalHydra, JobRuntime, VersionBase)
    instances = Singleton._instances
    with _composing:
        kept = {kind: instances.pop(kind) for kind in kinds if kind in instances}
        try:
            yield
        finally:
            for kind in kinds:
                instances.pop(kind, None)
            instances.update(kept)


@contextmanager
def _one_sentence() -> Iterator[None]:
    """Hydra wraps errors, those of ToftrackError too; callers get one they can catch and show."""
    try:
        yield
    except ToftrackError:
        raise
    except (HydraException, OmegaConfBaseException) as error:
        raise ToftrackError(sentence(error)) from error
