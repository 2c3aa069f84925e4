"""The detector's networks on the CPU by ONNX Runtime, from the files that are derived from weights.

Beside the weights NAME.npz lie NAME.pose.onnx and NAME.finder.onnx. Each says of which weights it
was made, and ends with its own checksum. Weights without them, or with those of other weights, are
for torch, which is the reference, and slower on the CPU.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from toftrack.detector.network import CELLS, JOINTS, REPORTED, SEGMENTS, Finder, Found, PoseNet
from toftrack.detector.weights import load_weights, read_metadata, weights_file
from toftrack.errors import ToftrackError, reported_errors
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
_MADE_OF = ("format", "version", "network", "weights_sha256")
"""Properties of such a file that say which network it is, and of which weights."""
_log = logging.getLogger(__name__)

# Before ONNX Runtime is loaded, here or by an export: later versions report at once that they are.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


@dataclass(frozen=True, eq=False)
class OnnxNetwork:
    """A network for the CPU.

    weights: the file of the network in torch that it was made of.  session: of ONNX Runtime.
    """

    weights: Path
    session: Any
    device = torch.device("cpu")
    name: ClassVar[str]

    def to(self, device: torch.device) -> Any:
        """The same network on a device: itself on the CPU, else the one that it was made of."""
        if device.type == "cpu":
            return self
        return getattr(load_weights(self.weights), self.name).to(device)


class OnnxPoseNet(OnnxNetwork):
    """A PoseNet for the CPU."""

    name = "pose"

    def outputs(self, crops: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What PoseNet.features returns, as arrays, for crops (N, CROP_CHANNELS, 64, 64); it does
        not hold the interpreter's lock.

        Raises ToftrackError for a file of a network with other outputs.
        """
        outputs = self.session.run(("heads", "keypoints", "parts"), {"crops": crops})
        n = len(crops)
        # Compiled code reads them, and believes their shapes.
        shapes = [(n, REPORTED), (n, 5 * JOINTS, CELLS, CELLS), (n, 4 * SEGMENTS, CELLS, CELLS)]
        if [(one.dtype, one.shape) for one in outputs] != [(np.float32, one) for one in shapes]:
            raise ToftrackError("the detector's pose.onnx belongs to another network; " + _anew())
        heads, keypoints, parts = outputs
        return heads, keypoints, parts


class OnnxFinder(OnnxNetwork):
    """A Finder for the CPU."""

    name = "finder"

    def __call__(self, images: Tensor) -> Found:
        """See network.Finder."""
        found = self.session.run(Found._fields, {"images": images.numpy()})
        return Found(*map(torch.from_numpy, found))


def load_networks(
    path: str | Path | None = None,
) -> tuple[PoseNet | OnnxPoseNet, Finder | OnnxFinder]:
    """The pose network and the finder of a file of weights: run by ONNX Runtime, or, where it has
    no files of these weights, by torch, of which a warning is logged.

    path: of the weights; None: those of the package.
    Raises ToftrackError when a file is damaged, or the weights are missing.
    """
    weights = weights_file(path)
    sha256 = read_metadata(weights).get("sha256")
    sessions = []
    for network in ("pose", "finder"):
        file = onnx_file(weights, network)
        session = read_session(file, weights)
        made_of = session and session.get_modelmeta().custom_metadata_map
        known = made_of and tuple(map(made_of.get, _MADE_OF))
        if known != (FORMAT, VERSION, network, sha256):
            why = f"{file} belongs to other weights" if session else f"there is no {file}"
            remedy = f"make it with {COMMAND} {weights}"
            _warn(f"{why}: torch runs the detector's networks, slower; {remedy}")
            return load_weights(weights)[:2]
        sessions.append(session)
    pose, finder = sessions
    return OnnxPoseNet(weights, pose), OnnxFinder(weights, finder)


def onnx_file(weights: Path, network: str) -> Path:
    """The path of ONNX Runtime's file of a network, "pose" or "finder", made of weights."""
    return weights.with_suffix(f".{network}.onnx")


def digest(content: bytes) -> bytes:
    """The checksum with which a file ends, of the content before it."""
    return hashlib.sha256(content).hexdigest().encode()


def read_session(file: Path, weights: Path) -> Any:
    """An ONNX Runtime session of a file made of some weights; None: there is no such file.

    Raises ToftrackError for one that is damaged.
    """
    with reported_errors(f"{file} cannot be read", _anew(weights)):
        if not file.exists():
            return None
        with open_to_read(file) as stream:
            content = stream.read(_LARGEST_BYTES + 1)
    if len(content) > _LARGEST_BYTES or content[-DIGEST:] != digest(content[:-DIGEST]):
        raise ToftrackError(f"{file} is damaged, its checksum is wrong; {_anew(weights)}")
    # ONNX Runtime's errors have no class of their own.
    with reported_errors(f"ONNX Runtime refuses {file}", _anew(weights), Exception):
        return open_session(content)


def open_session(content: bytes) -> Any:
    """A session of a file's content, which computes in the caller's thread alone, also after a
    fork.
    """
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


@functools.cache
def _warn(message: str) -> None:
    """Log a warning, each once in a process."""
    _log.warning(message)


def _anew(weights: Path | None = None) -> str:
    return f"make it anew with {COMMAND} {weights or 'FILE'}"
