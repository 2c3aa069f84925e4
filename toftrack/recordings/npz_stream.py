"""Writes a `.npz` recording frame by frame: long ones need no more memory than short ones."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.npz_camera import camera_arrays
from toftrack.safe_files import whole_file


def write_npz_streamed(
    path: str | Path, store: FrameStore, progress: Callable[[], None] = lambda: None
) -> None:
    """Write the frames of a store, compressed; an existing file is replaced only by a complete one.

    The depth becomes float32, radial or Z as it is in the store. Ground truth is not written.

    Args:
        path: the file.
        store: read twice where it has amplitudes.
        progress: called after each frame's depth.

    Raises:
        ToftrackError: the file cannot be written, or the store not be read.
    """
    path = Path(path)
    camera = store.camera
    shape = (len(store), camera.height, camera.width)
    small: dict[str, Any] = {
        **camera_arrays(camera),
        "timestamp_s": np.asarray(store.timestamp_s, np.float64),
        "fps": np.float64(store.fps),
        "metadata": json.dumps(store.metadata),
    }
    try:
        with whole_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, value in small.items():
                content = io.BytesIO()
                np.lib.format.write_array(content, np.asanyarray(value), allow_pickle=False)
                archive.writestr(f"{name}.npy", content.getvalue())
            with _member(
                archive, "radial_m" if store.radial else "depth_m", shape, "<f4"
            ) as stream:
                for index in range(len(store)):
                    stream.write(store.image(index)[0].astype("<f4").tobytes())
                    progress()
            if store.image(0)[1] is not None:
                with _member(archive, "amplitude", shape, "<u2") as stream:
                    for index in range(len(store)):
                        amplitude = store.image(index)[1]
                        assert amplitude is not None  # all images have one, or none has
                        stream.write(amplitude.astype("<u2").tobytes())
    except OSError as error:
        raise ToftrackError(
            f"the recording '{path}' cannot be written ({error.strerror}); choose another place"
        ) from error


def _member(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], kind: str) -> IO[bytes]:
    stream = archive.open(f"{name}.npy", "w", force_zip64=True)
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream
