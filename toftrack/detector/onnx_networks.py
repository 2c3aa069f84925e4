"""The detector's networks on the CPU by ONNX Runtime, from the files that are derived from weights.

Beside the weights NAME.npz lie NAME.pose.onnx and NAME.finder.onnx. Each says of which weights it
was made, and ends with its own checksum. Weights without them, or with those of other weights, are
for torch, which is the reference, and slower on the CPU.
"""

from __future__ import annotations

import functools
import hashlib
import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from toftrack.detector.network import CELLS, JOINTS, REPORTED, SEGMENTS, Finder, Found, PoseNet
from toftrack.detector.weights import load_weights, read_metadata, weights_file
from toftrack.errors import ToftrackError
from toftrack.files.safe_files import open_to_read

FORMAT = "toftrack-detector-network"
VERSION = "3"
"""Of the inputs and outputs of such files; one of another version is made anew."""
DIGEST = 64
"""Last bytes of such a file, the SHA-256 in hexadecimal of all before: a property's value."""
FLOAT, WHOLE = "float32", "int8"
"""Precisions that such a file says it is in."""
COMMAND = "python -m toftrack.training export"
_LARGEST_BYTES = 1 << 28
_log = logging.getLogger(__name__)
Network = TypeVar("Network", PoseNet, Finder)


@dataclass(frozen=True, eq=False)
class OnnxNetwork(Generic[Network]):
    """A network for the CPU.  weights: the file of the one that it was made of."""

    weights: Path
    session: Any
    device = torch.device("cpu")
    name: ClassVar[str]

    @cached_property
    def reference(self) -> Network:
        """The network that it was made of, read when it is asked for: a GPU needs it."""
        return cast(Network, getattr(load_weights(self.weights), self.name))

    def to(self, device: torch.device) -> Network | Self:
        """Itself on the CPU, elsewhere the reference."""
        return self if device.type == "cpu" else self.reference.to(device)


class OnnxPoseNet(OnnxNetwork[PoseNet]):
    """A PoseNet for the CPU."""

    name = "pose"

    def outputs(self, crops: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of crops (N, CROP_CHANNELS, 64, 64): what PoseNet.features returns; without the lock.

        Raises ToftrackError for a file of a network with other outputs.
        """
        outputs = self.session.run(("heads", "keypoints", "parts"), {"crops": crops})
        heads, keypoints, parts = outputs
        n = len(crops)
        # Compiled code reads them, and believes their shapes.
        shapes = (n, REPORTED), (n, 5 * JOINTS, CELLS, CELLS), (n, 4 * SEGMENTS, CELLS, CELLS)
        if any(one.dtype != np.float32 for one in outputs) or shapes != tuple(
            one.shape for one in outputs
        ):
            raise ToftrackError("the detector's pose.onnx is of another network; " + _anew())
        return heads, keypoints, parts


class OnnxFinder(OnnxNetwork[Finder]):
    """A Finder for the CPU."""

    name = "finder"

    def __call__(self, images: Tensor) -> Found:
        """See network.Finder."""
        found = self.session.run(Found._fields, {"images": images.numpy()})
        return Found(*map(torch.from_numpy, found))


def load_networks(
    path: str | Path | None = None,
) -> tuple[PoseNet | OnnxPoseNet, Finder | OnnxFinder]:
    """Both networks as they are used: by ONNX Runtime, or by torch, which is told.

    path: of the weights; None: those of the package.
    Raises ToftrackError when a file is damaged, or the weights are missing.
    """
    weights = weights_file(path)
    sha256 = read_metadata(weights).get("sha256")
    sessions = []
    for network in ("pose", "finder"):
        file = onnx_file(weights, network)
        session = read_session(file, weights)
        known = session is not None
        if not known or _made_of(session) != (FORMAT, VERSION, network, sha256):
            why = f"{file} is of other weights" if known else f"there is no {file}"
            _warn(f"{why}: torch runs the detector's networks, slower; {_make(weights)}")
            loaded = load_weights(weights)
            return loaded.pose, loaded.finder
        sessions.append(session)
    pose, finder = sessions
    return OnnxPoseNet(weights, pose), OnnxFinder(weights, finder)


def onnx_file(weights: Path, network: str) -> Path:
    """Where the file of a network, "pose" or "finder", is that is derived from weights."""
    return weights.with_suffix(f".{network}.onnx")


def digest(content: bytes) -> bytes:
    """What a file ends with, of all that stands before it."""
    return hashlib.sha256(content).hexdigest().encode()


def read_session(file: Path, weights: Path) -> Any:
    """An ONNX Runtime session of a file of some weights; None: there is no such file.

    Raises ToftrackError for one that is damaged.
    """
    try:
        with open_to_read(file) as stream:
            content = stream.read(_LARGEST_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ToftrackError(f"{file} cannot be read ({error}); {_anew(weights)}") from None
    if len(content) > _LARGEST_BYTES or content[-DIGEST:] != digest(content[:-DIGEST]):
        raise ToftrackError(f"{file} is damaged, its checksum is wrong; {_anew(weights)}")
    try:
        return open_session(content)
    except Exception as error:  # ONNX Runtime's have no class of their own
        reason = str(error).partition("\n")[0]
        raise ToftrackError(f"ONNX Runtime refuses {file} ({reason}); {_anew(weights)}") from None


def open_session(content: bytes) -> Any:
    """A session that computes in the thread that asks and nowhere else, also after a fork."""
    runtime = _runtime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 4  # what goes wrong is raised as well
    return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


@functools.cache
def _runtime() -> Any:
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    onnxruntime.disable_telemetry_events()
    return onnxruntime


def _made_of(session: Any) -> tuple[str | None, ...]:
    """Format, version and name of a file's network, and the checksum of its weights."""
    properties = session.get_modelmeta().custom_metadata_map
    return tuple(map(properties.get, ("format", "version", "network", "weights_sha256")))


@functools.cache
def _warn(message: str) -> None:
    """Once in a process."""
    _log.warning(message)


def _make(weights: Path) -> str:
    return f"make it with {COMMAND} {weights}"


def _anew(weights: Path | None = None) -> str:
    return f"make it anew with {COMMAND} {weights or 'FILE'}"
