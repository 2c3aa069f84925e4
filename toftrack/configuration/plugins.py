"""Parts of somebody else's: from the folder of --config-dir, and from installed packages.

A part is named by a configuration, or by an entry point of an installed package. A data file names
none: nothing is imported because of what one says. docs/extending.md shows each kind.
"""

from __future__ import annotations

import functools
import logging
import os
import pkgutil
import sys
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from toftrack.configuration import configuration_folder
from toftrack.errors import reported_errors

_log = logging.getLogger(__name__)

ENTRY_POINTS = {
    "detector": "toftrack.detectors",
    "device": "toftrack.devices",
    "gestures": "toftrack.gestures",
    "likelihood": "toftrack.likelihoods",
    "pose_space": "toftrack.pose_spaces",
    "recordings": "toftrack.recordings",
    "renderer": "toftrack.renderers",
    "stream": "toftrack.streams",
    "view": "toftrack.views",
}
"""Groups of conf/, and readers of recordings, with what the entry points for them are called."""
_LIKE = {"detector": "network", "gestures": "default", "pose_space": "pca"}
"""Groups of which an installed part has the settings of a choice of toftrack's, too."""
IMPORTABLE = (
    "check the name, and that its module lies in the folder of --config-dir, on PYTHONPATH, or is "
    "installed"
)
"""What to do about a part that cannot be imported."""


def installed(group: str) -> dict[str, EntryPoint]:
    """The parts of a group in ENTRY_POINTS that installed packages bring, by their names."""
    found = _entry_points(tuple(sys.path)).select(group=ENTRY_POINTS[group])
    return {entry.name: entry for entry in found if entry.pattern.match(entry.value)}


@functools.cache
def _entry_points(_: tuple[str, ...]) -> Any:
    """Those of all packages in the folders of sys.path, which take a while to read."""
    try:
        return entry_points()
    except Exception as error:  # whatever a damaged file of any package raises
        reason = " ".join(str(error).split())
        _log.warning(
            "no parts of installed packages are used: an entry_points.txt cannot be read: %s",
            reason,
        )
        return EntryPoints()


def offer_installed() -> None:
    """Make a choice of its group of each installed part, without importing any; toftrack's own of
    the same name stay.

    Its settings are the arguments, and device.KEY=VALUE gives one of them.
    """
    own = configuration_folder()
    for group in ENTRY_POINTS:
        for name, entry in installed(group).items():
            if group == "recordings" or (own / group / f"{name}.yaml").exists():
                continue
            node: dict[str, Any] = {"_target_": entry.value.replace(":", ".")}
            if group == "pose_space":  # whose class is not called, but learned, or read from a file
                node = {"kind": name}
            if group in _LIKE:
                node["defaults"] = [_LIKE[group], "_self_"]
            # Which settings there are is known when it is imported, and not before.
            open_node = OmegaConf.create(node, flags={"struct": False})
            ConfigStore.instance().store(name, open_node, group, provider=entry.module)


def import_from(folder: str | Path) -> None:
    """Let modules in a folder of configurations be imported, here and in worker processes."""
    path = str(Path(folder).expanduser().resolve())
    if path not in sys.path:
        sys.path.append(path)
    known = os.environ.get("PYTHONPATH", "")
    if path not in known.split(os.pathsep):
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (known, path)))


def named_object(path: str, named_by: str) -> Any:
    """What a dotted path, or an entry point's value, leads to; ToftrackError where it does not.

    named_by: the setting or the entry point, for the error.
    """
    what = f"{named_by} names {path}, which cannot be imported"
    with reported_errors(what, IMPORTABLE, Exception):  # whatever somebody's module raises
        return pkgutil.resolve_name(path)
