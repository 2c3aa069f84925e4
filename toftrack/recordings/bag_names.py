"""What a ROS bag looks like from outside; nothing is read, and rosbags is not needed."""

from __future__ import annotations

import os
from pathlib import Path

_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"


def is_bag(path: str | Path) -> bool:
    """A file `.bag` (ROS 1), `.mcap` or `.db3` (ROS 2), or a folder with such files."""
    if os.path.isdir(path):
        return os.path.exists(os.path.join(path, _METADATA)) or bool(storages(Path(path)))
    return os.path.splitext(path)[1].lower() in _SUFFIXES


def storages(folder: Path) -> list[Path]:
    """The files with messages of a ROS 2 bag's folder; none where it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix in _SUFFIXES[1:])
    except OSError:
        return []


def storage_of(path: Path) -> Path:
    """What rosbags is given: a folder whose metadata was never written is its only file."""
    if path.is_dir() and not (path / _METADATA).exists() and len(storages(path)) == 1:
        return storages(path)[0]
    return path
