"""The detector's weights as a file: arrays of half precision and JSON, with a checksum."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from toftrack.detector.network import Finder, PoseNet
from toftrack.errors import ToftrackError, check_format, reported_errors
from toftrack.files.archives import read_archive, write_archive
from toftrack.files.json_text import parse_json

FORMAT = "toftrack-detector"
VERSION = 1
DEFAULT_FILE = Path(__file__).parent.parent / "data" / "detector.npz"
_LARGEST_BYTES = 64 << 20
_WIDEST = 256
"""Channels; eight times those of the package's networks."""
_AGAIN = "give other detector.weights, train with python -m toftrack.training train, or reinstall"


def save_weights(path: Path, pose: PoseNet, finder: Finder, about: dict[str, Any]) -> None:
    """Write both networks; `about` says how they were trained."""
    arrays: dict[str, np.ndarray] = {}
    for network in (pose, finder):
        for key, tensor in network.state_dict().items():
            kept = tensor.half() if tensor.is_floating_point() else tensor
            arrays[f"{network.name}.{key}"] = kept.cpu().numpy()
    metadata = {
        "format": FORMAT,
        "version": VERSION,
        "sha256": checksum(arrays),
        "pose_width": pose.width,
        "finder_width": finder.width,
        "about": about,
    }
    write_archive(path, {"metadata": json.dumps(metadata), **arrays})


class Weights(NamedTuple):
    """Both networks ready for use, how they were trained, their arrays' checksum."""

    pose: PoseNet
    finder: Finder
    about: dict[str, Any]
    sha256: str


def load_weights(path: str | Path | None = None) -> Weights:
    """The networks of a file for torch; None: those of the package.

    Raises ToftrackError when the file is missing, damaged, not weights or of another version.
    """
    path = weights_file(path)
    arrays, metadata = _read_whole(path)
    with _other_networks_refused(path):
        pose, finder = PoseNet(_width(metadata, "pose")), Finder(_width(metadata, "finder"))
        for network in (pose, finder):
            _fill(network, arrays)
            make_ready(network)
    return Weights(pose, finder, metadata.get("about", {}), metadata["sha256"])


def go_on_from(path: str | Path, network: PoseNet | Finder) -> str:
    """Give a new network the weights of a file to train on from; returns its arrays' checksum.

    Raises ToftrackError as load_weights does, and for weights of another width.
    """
    path = Path(path)
    arrays, metadata = _read_whole(path)
    with _other_networks_refused(path):
        if (before := _width(metadata, network.name)) != network.width:
            raise ToftrackError(
                f"{path} holds weights for a width of {before}, and the width to train is"
                f" {network.width}; give the same"
            )
        _fill(network, arrays)
    return str(metadata["sha256"])


def weights_file(path: str | Path | None = None) -> Path:
    """A file of weights; None: the package's."""
    return DEFAULT_FILE if path is None else Path(path)


@contextmanager
def _other_networks_refused(path: Path) -> Iterator[None]:
    """Within, what does not fit the networks is a ToftrackError about the file, without torch's
    list of all that does not fit.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, RuntimeError):
        raise ToftrackError(f"{path} holds weights of another network; {_AGAIN}") from None


def _width(metadata: dict[str, Any], name: str) -> int:
    """Of a network; ValueError for one that would take all memory before its weights are seen."""
    width = metadata[f"{name}_width"]
    if type(width) is not int or not 1 <= width <= _WIDEST:
        raise ValueError(f"a width of {width}")
    return width


def _fill(network: PoseNet | Finder, arrays: dict[str, np.ndarray]) -> None:
    """Give a network its own of the arrays, in its own precision."""
    start = f"{network.name}."
    own = [key for key in arrays if key.startswith(start)]
    network.load_state_dict({key.removeprefix(start): torch.from_numpy(arrays[key]) for key in own})


def _read_whole(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and metadata of a file that is whole."""
    arrays, metadata = _read(path)
    if metadata.get("sha256") != checksum(arrays):
        raise ToftrackError(f"{path} is damaged, its checksum is wrong; {_AGAIN}")
    return arrays, metadata


def read_metadata(path: Path) -> dict[str, Any]:
    """What a file says of itself. Raises ToftrackError when it is no file of weights."""
    return _read(path, ("metadata",))[1]


def _read(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays, or those of some names, and metadata of a file."""
    what = f"{path} is no file of the detector's weights"
    with reported_errors(what, _AGAIN, OSError, ValueError, KeyError):
        if not path.exists():
            raise ToftrackError(f"there are no weights of the detector at {path}; {_AGAIN}")
        if path.stat().st_size > _LARGEST_BYTES:
            raise ToftrackError(f"{path} is too large for weights of the detector; {_AGAIN}")
        arrays = read_archive(path, names)
        metadata = parse_json(str(arrays.pop("metadata")))
    check_format(path, metadata, FORMAT, VERSION, "a file of the detector's weights", _AGAIN)
    return arrays, metadata


def checksum(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of arrays and their names, as hexadecimal digits."""
    digest = hashlib.sha256()
    for key in sorted(arrays):
        digest.update(key.encode())
        digest.update(np.ascontiguousarray(arrays[key]).tobytes())
    return digest.hexdigest()


def make_ready(network: nn.Module) -> None:
    """Make a network fit for use: no gradients, each normalisation folded into the convolution
    before it.
    """
    network.eval().requires_grad_(False)
    for module in list(network.modules()):
        for (name, part), (norm, after) in pairwise(list(module.named_children())):
            if isinstance(part, nn.Conv2d) and isinstance(after, nn.BatchNorm2d):
                setattr(module, name, fuse_conv_bn_eval(part, after))
                setattr(module, norm, nn.Identity())
    network.to(memory_format=torch.channels_last)
