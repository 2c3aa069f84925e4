"""From weights to the files that ONNX Runtime runs, see onnx_networks; needs the extra `train`.

The networks compute in whole numbers of 8 bits, by static quantisation (as Jacob et al.,
"Quantization and training of neural networks for efficient integer-arithmetic-only inference",
CVPR 2018): what the layers say is 0 .. 255, in ranges that are measured on the generator's images;
weights are -64 .. 64, by channel. They have 7 bits because processors without VNNI add two products
in 16 bits.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from toftrack.detector.crops import CROP, CROP_CHANNELS, WIDE_MULTIPLE
from toftrack.detector.network import Finder, Found, PoseNet
from toftrack.detector.onnx_networks import (
    DIGEST,
    FLOAT,
    FORMAT,
    VERSION,
    WHOLE,
    digest,
    onnx_file,
    open_session,
)
from toftrack.detector.weights import load_weights
from toftrack.errors import ToftrackError
from toftrack.files.safe_files import whole_file
from toftrack.training.images import crop_images, wide_images
from toftrack.training.shapes import shape_bank

CALIBRATION, COMPARED = 384, 64
"""Images that ranges are measured on, and others that the result is compared on."""
_SHAPES, _SEED, _BATCH = 100, 5, 16
_WITHIN_M = 0.004
"""How far keypoints may be from torch's, on average; the package's are 0.0025."""
_SPREAD = 0.1
"""How far heads, and what the finder says, may be from torch's, RMS in parts of their spread; the
package's are 0.04 and 0.085."""


def example_crops() -> np.ndarray:
    """(CALIBRATION + COMPARED, CROP_CHANNELS, CROP, CROP) float32, the same ones every time."""
    generator = torch.Generator().manual_seed(_SEED)
    bank = shape_bank(_SHAPES, generator)
    return crop_images(CALIBRATION + COMPARED, bank, generator).image.numpy()


def example_images() -> np.ndarray:
    """(CALIBRATION + COMPARED, 2, H, W) float32 of what the finder sees, the same every time."""
    generator = torch.Generator().manual_seed(_SEED)
    bank, count = shape_bank(_SHAPES, generator), (CALIBRATION + COMPARED) // _BATCH
    return torch.cat([wide_images(_BATCH, bank, generator).image for _ in range(count)]).numpy()


def quantised(model: Any, images: np.ndarray) -> Any:
    """An onnx.ModelProto of a network, whose weights and activations are whole numbers.

    The first and the last layers stay as they are, which decide on depths and places, and of the
    dense layers all but the first, on which the hypotheses depend: they take no time.
    images: (N, ...) that the ranges are measured on.
    """
    import onnx
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static

    name, starts = model.graph.input[0].name, range(0, len(images), _BATCH)
    batches = iter([{name: images[start : start + _BATCH]} for start in starts])
    with _quiet(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "quantised.onnx"
        quantize_static(
            model,
            str(file),
            SimpleNamespace(get_next=lambda: next(batches, None)),  # a CalibrationDataReader
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


def compare(network: PoseNet | Finder, model: Any, images: np.ndarray) -> None:
    """Raises ToftrackError where a quantised network is too far from torch's on (N, ...) images."""
    session = open_session(model.SerializeToString())
    name = session.get_inputs()[0].name
    each = [session.run(None, {name: one[None]}) for one in images]
    found = [torch.from_numpy(np.concatenate(part)) for part in zip(*each, strict=True)]
    shown = torch.from_numpy(images)
    with torch.inference_mode():
        if isinstance(network, Finder):
            both = zip(found, network(shown), strict=True)
            expected = dict(zip(Found._fields, both, strict=True))
        else:
            heads, *maps = network.features(shown)
            joints = network.decode(shown, heads, *maps).joints_m
            away = network.decode(shown, *found).joints_m - joints
            if not (away_m := float(away.norm(dim=2).mean())) <= _WITHIN_M:
                raise ToftrackError(
                    f"in 8 bits the network's keypoints are {1e3 * away_m:.1f} mm away from torch's"
                    f" (at most {1e3 * _WITHIN_M:g}), so nothing was written; give --float"
                )
            expected = {"heads": (found[0], heads)}
    for name, (one, two) in expected.items():
        apart = float((one - two).square().mean().sqrt() / two.std())
        if not apart <= _SPREAD:
            raise ToftrackError(
                f"in 8 bits the network's {name} is {100 * apart:.0f} % of its spread away from"
                f" torch's (at most {100 * _SPREAD:g}), so nothing was written; give --float"
            )


def _kept(model: Any) -> list[str]:
    """Names of the nodes that stay in floating point."""
    given = {value.name for value in model.graph.input}
    said = {value.name for value in model.graph.output}
    flattened = {node.output[0] for node in model.graph.node if node.op_type == "Reshape"}
    kept = []
    for node in reversed(model.graph.node):
        last = bool(said.intersection(node.output))
        if last and node.op_type not in ("Conv", "Gemm"):
            said.update(node.input)  # the layer before says it
        dense = node.op_type == "Gemm" and node.input[0] not in flattened
        if last or dense or given.intersection(node.input):
            kept.append(node.name)
    return kept


_OPSET, _IR = 18, 10
"""Which all versions of ONNX Runtime read that the package asks for."""
_AGREE = 1e-3
"""How far, of the largest of an output, ONNX Runtime may be from torch."""


def missing_packages() -> list[str]:
    """What must be installed before anything can be exported."""
    return [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]


def needed(missing: list[str]) -> str:
    """How to get what is missing."""
    return f'ONNX files need {" and ".join(missing)}: pip install "toftrack[train]"'


def export_networks(weights: Path, whole_numbers: bool = True) -> list[Path]:
    """Write the networks of a file of weights beside it; returns the files.

    whole_numbers: in 8 bits, else in floating point.
    Raises ToftrackError when the weights cannot be used, when a package is missing, and when ONNX
    Runtime computes something else than torch.
    """
    if missing := missing_packages():
        raise ToftrackError(needed(missing))
    loaded = load_weights(weights)
    features = _Features(loaded.pose)
    several = torch.export.Dim("n", min=1, max=1 << 16)
    # In multiples, as `crops.wide` makes them.
    high, wide = (WIDE_MULTIPLE * torch.export.Dim(name, min=1, max=1 << 12) for name in ("h", "w"))
    crop = CROP_CHANNELS, CROP, CROP
    whole = 2, 5 * WIDE_MULTIPLE, 6 * WIDE_MULTIPLE
    outputs = ["heads", "keypoints", "parts"]
    contents = {
        "pose": _exported(features, crop, "crops", outputs, {0: several}),
        "finder": _exported(
            loaded.finder, whole, "images", list(Found._fields), {0: several, 2: high, 3: wide}
        ),
    }
    _compare(features, contents["pose"], "crops", crop)
    _compare(loaded.finder, contents["finder"], "images", (2, 3 * WIDE_MULTIPLE, 4 * WIDE_MULTIPLE))
    if whole_numbers:
        for network, images in (("pose", example_crops()), ("finder", example_images())):
            contents[network] = quantised(contents[network], images[:-COMPARED])
            compare(getattr(loaded, network), contents[network], images[-COMPARED:])
    files = []
    for network, content in contents.items():
        facts = {"format": FORMAT, "version": VERSION, "network": network}
        facts["precision"] = WHOLE if whole_numbers else FLOAT
        file = onnx_file(weights, network)
        with whole_file(file) as stream:
            stream.write(_signed(content, facts | {"weights_sha256": loaded.sha256}))
        files.append(file)
    return files


class _Features(nn.Module):
    """PoseNet.features."""

    def __init__(self, pose: PoseNet) -> None:
        super().__init__()
        self.pose = pose

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.pose.features(crops)


def _exported(
    network: nn.Module,
    shape: tuple[int, ...],
    name: str,
    outputs: list[str],
    sizes: dict[int, Any],
) -> Any:
    """A network as an onnx.ModelProto; shape: of an image; sizes: which may be others."""
    with _quiet():
        program = torch.onnx.export(
            network.eval(),
            (torch.zeros(2, *shape),),
            dynamo=True,
            input_names=[name],
            output_names=outputs,
            dynamic_shapes=(sizes,),
            opset_version=_OPSET,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.ir_version = min(model.ir_version, _IR)
    graph = model.graph
    for part in (*graph.node, *graph.input, *graph.output, *graph.value_info):
        del part.metadata_props[:]  # where in the source it stands
    return model


@torch.inference_mode()
def _compare(network: nn.Module, model: Any, name: str, shape: tuple[int, ...]) -> None:
    """Raises ToftrackError where ONNX Runtime says something else than torch of any images."""
    session = open_session(model.SerializeToString())
    generator = torch.Generator().manual_seed(0)
    for count in (1, 3):
        images = 2 * torch.rand(count, *shape, generator=generator) - 1
        found = session.run(None, {name: images.numpy()})
        for one, two in zip(network(images), found, strict=True):
            away = float(np.abs(one.numpy() - two).max())
            if not away <= _AGREE * max(1.0, float(one.abs().max())):
                raise ToftrackError(
                    f"ONNX Runtime's {name} are {away:.2g} away from torch's; nothing was written"
                )


def _signed(model: Any, properties: dict[str, str]) -> bytes:
    """A file's content, which ends with its checksum."""
    del model.metadata_props[:]
    for key, value in properties.items():
        model.metadata_props.add(key=key, value=value)
    # Messages that follow one another are one: the last property comes to stand at the end.
    last = type(model)()
    last.metadata_props.add(key="sha256", value="0" * DIGEST)
    content = (model.SerializeToString() + last.SerializeToString())[:-DIGEST]
    return content + digest(content)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Within, nothing is said of how an export or a quantisation goes, nor of other packages."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
