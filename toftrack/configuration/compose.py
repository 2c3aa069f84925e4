"""The configuration of `python track.py`, composed from conf/ and overrides."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from toftrack.configuration import configuration_folder
from toftrack.configuration.check import MOST_VALUES, check_overrides
from toftrack.configuration.plugins import import_from, offer_installed
from toftrack.configuration.sentences import sentence
from toftrack.errors import ToftrackError

_ROOT = Path("config.yaml")
_MOST_LETTERS = 2**16
"""In a file of the configuration."""
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The fast one where PyYAML was built with libyaml."""
_composing = threading.Lock()
_read: dict[str, Any] = {}
"""What texts of files mean: Hydra reads each file for every composition, which takes most of the
time.
"""


def configuration(*overrides: str, config_dir: str | Path | None = None) -> DictConfig:
    """The configuration of `python track.py` with overrides.

    A Hydra application that calls this keeps its own state of Hydra.

    config_dir: laid out as toftrack's conf/; its config.yaml takes the place of toftrack's, and
    where it has none, it adds choices and modules, as --config-dir does.

    Raises ToftrackError when it cannot be composed.
    """
    given = configuration_folder() if config_dir is None else Path(config_dir)
    folder = given.expanduser().resolve()
    if not (folder / _ROOT).is_file():
        if any(folder.glob("*/*.yaml")):
            return configuration(searched(folder), *overrides)
        raise ToftrackError(
            f"there is no {_ROOT} in the folder '{folder}', nor a GROUP/NAME.yaml; give "
            "config_dir=FOLDER, a folder laid out as toftrack's conf/"
        )
    if folder != configuration_folder():
        import_from(folder)
    offer_installed()
    for override in overrides:
        if not isinstance(override, str):
            raise ToftrackError(
                f"the override {override!r} is no text; give overrides as on the command line, "
                "'hand.side=left'"
            )
    with (
        one_sentence(),
        _own_hydra(),
        modest_files(),
        initialize_config_dir(str(folder), version_base="1.3"),
    ):
        try:
            config = compose(_ROOT.stem, overrides=list(overrides))
        except Exception as error:  # also whatever the readers of YAML say of somebody's file
            raise ToftrackError(sentence(error)) from error
        check_overrides(config, _ROOT.stem, overrides)
        return config


def searched(folder: str | Path) -> str:
    """The override by which choices in a folder are found, as by Hydra's --config-dir; modules in
    it can be imported from now on. Raises ToftrackError when there is no such folder.
    """
    path = Path(folder).expanduser().resolve()
    if not path.is_dir():
        raise ToftrackError(f"there is no folder '{folder}'; give --config-dir one that exists")
    import_from(path)
    return f"hydra.searchpath=[{quoted(f'file://{path}')}]"


def quoted(text: str) -> str:
    """A text as a value of Hydra's that stands for just that, whatever signs are in it."""
    # Hydra takes a backslash for itself only before a quote.
    text = re.sub(r"(\\*)'", r"\1\1\\'", text)
    text = re.sub(r"(\\+)$", r"\1\1", text)
    return f"'{text}'"


def setting_names() -> frozenset[str]:
    """The groups, and the settings that stand in none: how the keys of overrides begin."""
    folder = configuration_folder()
    own = [str(name) for path in folder.glob("*.yaml") for name in OmegaConf.load(path)]
    groups = [path.name for path in folder.iterdir() if path.is_dir()]
    return frozenset({*own, *groups, "hydra"})


def devices_of_files(others: Sequence[str] = ()) -> frozenset[str]:
    """The choices of the group device that play a file: those with a path, and whatever is in
    `others`, the folders of --config-dir, where a path may stand in another file.
    """
    own = [path.stem for folder in others for path in Path(folder).glob("device/*.yaml")]
    paths = (configuration_folder() / "device").glob("*.yaml")
    # By its keys, since a configuration does not count what is still to be given.
    return frozenset([*own, *(p.stem for p in paths if "path" in OmegaConf.load(p).keys())])


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
def modest_files() -> Iterator[None]:
    """Within it, Hydra refuses a file that is larger than configurations are, or becomes so by its
    aliases: it copies every value many times, for hours where a small file repeats itself.
    """
    load = OmegaConf.load

    def checked(file: Any) -> Any:
        if not isinstance(file, io.TextIOWrapper):  # which Hydra alone gives
            return load(file)
        text = file.read(_MOST_LETTERS + 1)
        file.seek(0)
        if text not in _read:
            _check_size(text, file.name)
            _read[text] = load(file)
        return deepcopy(_read[text])

    OmegaConf.load = staticmethod(checked)  # type: ignore[assignment]
    try:
        yield
    finally:
        OmegaConf.load = staticmethod(load)  # type: ignore[method-assign]


def _check_size(text: str, name: str) -> None:
    """Raise ToftrackError where the text of a file or its values are too many, an alias counted as
    what it stands for.
    """
    count = 0
    sizes: dict[str | None, int] = {}
    within: list[tuple[str | None, int]] = []
    with suppress(yaml.YAMLError):  # Hydra meets it, too, and says where
        for event in yaml.parse(text, Loader=_LOADER):
            if isinstance(event, yaml.CollectionEndEvent):
                anchor, before = within.pop()
                sizes[anchor] = count - before + 1
            elif isinstance(event, yaml.NodeEvent):
                count += sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
                if isinstance(event, yaml.CollectionStartEvent):
                    within.append((event.anchor, count))
            if count > MOST_VALUES or len(text) > _MOST_LETTERS:
                raise ToftrackError(
                    f"'{name}' is too large for a file of the configuration (at most "
                    f"{MOST_VALUES} values, aliases counted as what they stand for); let your "
                    "part read a file of its own"
                )


@contextmanager
def one_sentence() -> Iterator[None]:
    """Hydra wraps errors, those of ToftrackError too; callers get one they can catch and show."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ToftrackError(sentence(error)) from error
