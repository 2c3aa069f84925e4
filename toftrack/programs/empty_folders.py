"""The folder of a run that failed before it wrote anything of its own goes away again.

Hydra makes the folder, with its own files in it, before the program has looked at its settings.
"""

from __future__ import annotations

import contextlib
import logging
from dataclasses import dataclass
from pathlib import Path

_HYDRAS = frozenset({"config.yaml", "hydra.yaml", "overrides.yaml"})
_SWEEPS = "multirun.yaml"


@dataclass(frozen=True)
class _Folder:
    path: Path
    new: tuple[Path, ...]
    """Those of it and its parents that were not there, the innermost first."""


_expected: list[_Folder] = []


def expect(folder: Path) -> None:
    """A run or a sweep is about to make this folder. One with files in it is nobody's to clear."""
    path = folder.absolute()
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        return
    new = [place for place in (path, *path.parents) if not place.exists()]
    _expected.append(_Folder(path, tuple(new)))


def forget() -> None:
    """What was expected so far stays as it is."""
    _expected.clear()


def clear() -> None:
    """Remove the expected folders that hold nothing but what Hydra put there."""
    for folder in _expected:
        with contextlib.suppress(OSError):  # the error that is being reported counts for more
            _clear(folder)
    forget()


def _clear(folder: _Folder) -> None:
    files = [path for path in folder.path.glob("*") if path.name != ".hydra"]
    inner = list(folder.path.glob(".hydra/*"))
    if any(path.suffix != ".log" and path.name != _SWEEPS for path in files):
        return
    if any(path.name not in _HYDRAS for path in inner):
        return
    _close_logs(folder.path)
    for path in (*files, *inner):
        path.unlink()
    for place in (folder.path / ".hydra", *folder.new):
        if place.is_dir():
            place.rmdir()


def _close_logs(folder: Path) -> None:
    """Windows removes no file that is open."""
    root = logging.getLogger()
    for handler in list(root.handlers):
        if (
            isinstance(handler, logging.FileHandler)
            and folder in Path(handler.baseFilename).parents
        ):
            root.removeHandler(handler)
            handler.close()
