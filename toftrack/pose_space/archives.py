"""Reading .npz archives of arrays, with errors in words that help a user."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np


def read_archive(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz file by name; pickled objects are never loaded.

    Raises FileNotFoundError; another OSError when it cannot be read; ValueError, saying in few
    words why, when it is no .npz archive, is cut off or damaged, or holds pickled objects.
    """
    # numpy takes anything but an archive for a pickle, and advises to load it unsafely.
    with open(path, "rb") as stream:
        if not zipfile.is_zipfile(stream):
            raise ValueError("it is no .npz archive, or cut off")
        stream.seek(0)
        content = {}
        try:
            with zipfile.ZipFile(stream) as archive:
                for entry in archive.namelist():
                    with archive.open(entry) as array:
                        name = entry.removesuffix(".npy")
                        content[name] = np.lib.format.read_array(array, allow_pickle=False)
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
            raise ValueError(f"the archive is damaged: {error}") from None
        except ValueError as error:
            if "allow_pickle" in str(error):
                raise ValueError(f"{name!r} holds pickled objects, not numbers") from None
            raise ValueError(f"{name!r} is damaged: {error}") from None
    return content
