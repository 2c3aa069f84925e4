"""The pose network in whole numbers of 8 bits, for ONNX Runtime; a part of onnx_export.

Static quantisation (as Jacob et al., "Quantization and training of neural networks for efficient
integer-arithmetic-only inference", CVPR 2018): what the layers say is 0 .. 255, in ranges that are
measured on the generator's crops; weights are -64 .. 64, by channel. They have 7 bits because
processors without VNNI add two products in 16 bits.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from toftrack.detector.images import crop_images
from toftrack.detector.network import PoseNet
from toftrack.detector.onnx_networks import open_session, quiet
from toftrack.detector.shapes import shape_bank
from toftrack.errors import ToftrackError

CALIBRATION, COMPARED = 384, 64
"""Crops that ranges are measured on, and others that the result is compared on."""
_SHAPES, _SEED, _BATCH = 100, 5, 16
_WITHIN_M = 0.004
"""How far keypoints may be from torch's, on average; twice what the package's are."""
_SPREAD = 0.1
"""How far heads may be from torch's, RMS in parts of their spread; three times the package's."""


def example_crops() -> np.ndarray:
    """(CALIBRATION + COMPARED, CROP_CHANNELS, CROP, CROP) float32, the same ones every time."""
    generator = torch.Generator().manual_seed(_SEED)
    bank = shape_bank(_SHAPES, generator)
    return crop_images(CALIBRATION + COMPARED, bank, generator).image.numpy()


def quantised(model: Any, crops: np.ndarray) -> Any:
    """An onnx.ModelProto of the pose network, whose weights and activations are whole numbers.

    The first and the last layers stay as they are, which decide on depths and places, and of the
    dense layers all but the first, on which the hypotheses depend: they take no time.
    crops: (N, CROP_CHANNELS, CROP, CROP) that the ranges are measured on.
    """
    import onnx
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static

    with quiet(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "quantised.onnx"
        quantize_static(
            model,
            str(file),
            _Crops(model.graph.input[0].name, crops),
            # Of separate operators, which ONNX Runtime joins as suits the processor.
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=_kept(model),
            calibrate_method=CalibrationMethod.Percentile,  # 99.999
        )
        return onnx.load(file)


def compare(pose: PoseNet, model: Any, crops: np.ndarray) -> None:
    """Raises ToftrackError where a quantised network is too far from torch's on (N, ...) crops."""
    session = open_session(model.SerializeToString())
    names = ("heads", "keypoints")
    each = [session.run(names, {"crops": one[None]}) for one in crops]
    heads, keypoints = (torch.from_numpy(np.concatenate(part)) for part in zip(*each, strict=True))
    image = torch.from_numpy(crops)
    with torch.inference_mode():
        expected, *maps = pose.features(image)
        joints = pose.decode(image, expected, *maps).joints_m
        found = pose.decode(image, heads, keypoints, maps[1]).joints_m
    away = float((found - joints).norm(dim=2).mean())
    apart = float((heads - expected).square().mean().sqrt() / expected.std())
    if not (away <= _WITHIN_M and apart <= _SPREAD):
        raise ToftrackError(
            f"in 8 bits the network's keypoints are {1e3 * away:.1f} mm away from torch's (at most"
            f" {1e3 * _WITHIN_M:g}) and its heads {100 * apart:.0f} % of their spread (at most"
            f" {100 * _SPREAD:g}), so nothing was written; give --float"
        )


def _kept(model: Any) -> list[str]:
    """Names of the nodes that stay in floating point."""
    nodes = model.graph.node
    ends = {value.name for value in (*model.graph.input, *model.graph.output)}
    flattened = {node.output[0] for node in nodes if node.op_type == "Reshape"}
    return [
        node.name
        for node in nodes
        if ends.intersection((*node.input, *node.output))
        or (node.op_type == "Gemm" and node.input[0] not in flattened)
    ]


class _Crops:
    """What onnxruntime.quantization reads: a CalibrationDataReader."""

    def __init__(self, name: str, crops: np.ndarray) -> None:
        self._batches = iter(
            {name: crops[start : start + _BATCH]} for start in range(0, len(crops), _BATCH)
        )

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next ones, None at the end."""
        return next(self._batches, None)
