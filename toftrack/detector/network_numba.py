"""The pose network in one compiled call, without the interpreter's lock; see network.PoseNet."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from torch import Tensor, nn

from toftrack.compute.compiling import compiled
from toftrack.compute.convolution_numba import Image, Network, NetworkBuilder, run
from toftrack.detector.crops import CROP
from toftrack.detector.network import PoseNet, Residual

_MARGIN = 2
"""Of the crop, for the first layer's kernel."""


class PackedPoseNet(NamedTuple):
    """A PoseNet for `pose_outputs`; the first image is the crop.

    inputs: channels of the crop.  heads, keypoints: where these outputs are.
    keypoint_channels: of a cell, in memory.
    """

    network: Network
    inputs: int
    heads: int
    keypoints: int
    keypoint_channels: int


def pack_pose_net(pose: PoseNet) -> PackedPoseNet:
    """The layers of a network on the CPU that is ready for use, see weights.make_ready."""
    builder = NetworkBuilder()
    crop = builder.image(CROP, CROP, pose.inputs, _MARGIN)
    half = _layer(builder, crop, pose.stem[0], border=1, relu=True)
    at_16 = _residual(builder, half, pose.fine)
    at_8 = _residual(builder, _residual(builder, at_16, pose.middle[0]), pose.middle[1])
    at_4 = _residual(builder, at_8, pose.coarse, border=0)
    first, second = (layer for layer in pose.dense if isinstance(layer, nn.Linear))
    # Each output of the first one sees the whole image: a kernel of that size, which is flat.
    kernel = first.weight.unflatten(1, (-1, at_4.high * at_4.wide)).transpose(1, 2)
    wide = kernel.new_zeros(len(kernel), at_4.high * at_4.wide, at_4.channels)
    wide[:, :, : kernel.shape[2]] = kernel
    flat = Image(at_4.place, 1, 1, wide[0].numel(), 0)
    bent = _dense(builder, flat, wide.flatten(1), first.bias, relu=True)
    bent = _dense(builder, bent, second.weight, second.bias, relu=True)
    everywhere = _dense(builder, bent, pose.context.weight, pose.context.bias)
    merged = builder.merged(_layer(builder, at_8, pose.lateral_8), everywhere, border=1)
    _layer(builder, at_16, pose.lateral_16, relu=True, onto=merged)
    smooth = _layer(builder, merged, pose.smooth[0], relu=True)
    keypoints = _layer(builder, smooth, pose.keypoints)
    heads = _dense(builder, bent, pose.heads.weight, pose.heads.bias)
    return PackedPoseNet(
        builder.network(), pose.inputs, heads.place, keypoints.place, keypoints.channels
    )


def _layer(
    builder: NetworkBuilder,
    x: Image,
    layer: nn.Module,
    border: int = 0,
    relu: bool = False,
    onto: Image | None = None,
) -> Image:
    assert isinstance(layer, nn.Conv2d)
    assert layer.bias is not None  # the normalisation's, where it had none of its own
    return builder.layer(x, layer.weight, layer.bias, layer.stride[0], border, relu, onto)


def _dense(
    builder: NetworkBuilder, x: Image, weight: Tensor, bias: Tensor, relu: bool = False
) -> Image:
    return builder.layer(x, weight[:, :, None, None], bias, relu=relu)


def _residual(builder: NetworkBuilder, x: Image, block: nn.Module, border: int = 1) -> Image:
    assert isinstance(block, Residual)
    layer = partial(_layer, builder)
    between = layer(x, block.first, border=1, relu=True)
    shortcut = block.shortcut
    if isinstance(shortcut, nn.Sequential):
        out = layer(x, shortcut[0], border=border)
    else:
        outputs = block.second.out_channels
        identity = nn.init.dirac_(block.second.weight.new_empty(outputs, outputs, 1, 1))
        out = builder.layer(x, identity, identity.new_zeros(outputs), border=border)
    return layer(between, block.second, relu=True, onto=out)


@compiled
def pose_outputs(image, net):
    """Of one crop (inputs, CROP, CROP): the heads' numbers and the keypoints, see PoseNet.features.

    net: PackedPoseNet.  The keypoints are (16, 16, channels); both have more numbers than outputs.
    """
    network, inputs, heads, keypoints, channels = net
    steps, weights, capacity = network
    images = np.zeros(capacity, np.float32)
    size = image.shape[1]
    for row in range(size):
        for column in range(size):
            at = ((row + _MARGIN) * (size + 2 * _MARGIN) + column + _MARGIN) * inputs
            for channel in range(inputs):
                images[at + channel] = image[channel, row, column]
    run(steps, weights, images)
    cells = size // 4
    keypoint_map = images[keypoints : keypoints + cells * cells * channels].reshape(
        (cells, cells, channels)
    )
    return images[heads:], keypoint_map


@compiled
def sigmoid(x):
    """Of a number."""
    return 1 / (1 + math.exp(-x))


@compiled
def softplus(x):
    """Of a number: log(1 + exp(x))."""
    return x + math.log1p(math.exp(-x)) if x > 0 else math.log1p(math.exp(x))
