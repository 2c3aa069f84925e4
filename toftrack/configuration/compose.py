"""The configuration of `python track.py`, composed from conf/ and overrides."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from toftrack.configuration import configuration_folder
from toftrack.configuration.check import check_overrides
from toftrack.configuration.sentences import sentence
from toftrack.errors import ToftrackError

_ROOT = "config.yaml"
_composing = threading.Lock()


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
    with one_sentence(), _own_hydra(), initialize_config_dir(str(folder), version_base="1.3"):
        name = _ROOT.removesuffix(".yaml")
        try:
            config = compose(name, overrides=list(overrides))
        except (HydraException, OmegaConfBaseException):
            raise
        except Exception as error:  # whatever the readers of YAML say of somebody's file
            raise ToftrackError(
                f"the configuration in '{folder}' cannot be read ({' '.join(str(error).split())}); "
                "mend its YAML, or give a folder laid out as toftrack's conf/"
            ) from error
        check_overrides(config, name, overrides)
        return config


def setting_names() -> frozenset[str]:
    """The groups, and the settings that stand in none: how the keys of overrides begin."""
    folder = configuration_folder()
    own = [str(name) for path in folder.glob("*.yaml") for name in OmegaConf.load(path)]
    groups = [path.name for path in folder.iterdir() if path.is_dir()]
    return frozenset({*own, *groups, "hydra"})


def devices_of_files() -> frozenset[str]:
    """The choices of the group device that play a file: those with a path."""
    paths = (configuration_folder() / "device").glob("*.yaml")
    # By its keys, since a configuration does not count what is still to be given.
    return frozenset(path.stem for path in paths if "path" in OmegaConf.load(path).keys())


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Hydra has one state a process, which may be that of an application around us."""
    with _composing:
        application, job = GlobalHydra.instance().hydra, JobRuntime.instance().conf
        version = VersionBase.instance().version_base
        GlobalHydra.instance().clear()
        JobRuntime.instance().conf = job.copy()
        try:
            yield
        finally:
            GlobalHydra.instance().hydra = application
            JobRuntime.instance().conf = job
            VersionBase.instance().version_base = version


@contextmanager
def one_sentence() -> Iterator[None]:
    """Hydra wraps errors, those of ToftrackError too; callers get one they can catch and show."""
    try:
        yield
    except ToftrackError:
        raise
    except (HydraException, OmegaConfBaseException) as error:
        raise ToftrackError(sentence(error)) from error
