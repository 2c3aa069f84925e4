"""Convolutions in one compiled call against those of torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from toftrack.compute import convolution_numba
from toftrack.compute.compiling import entry_point
from toftrack.compute.convolution_numba import Image, NetworkBuilder, padded, run

pytestmark = pytest.mark.usefixtures("one_thread")


@entry_point(__file__, convolution_numba.__file__)
def _run(steps, weights, images):
    run(steps, weights, images)


def outputs(builder: NetworkBuilder, first: Image, x: Tensor, last: Image) -> Tensor:
    """(C, H, W) of the last image, for x (C, H, W) in the first one."""
    network = builder.network()
    images = np.zeros(network.capacity, np.float32)

    def within(image: Image) -> np.ndarray:
        shape, border = image.shape(), image.border
        whole = images[image.place : image.place + int(np.prod(shape))].reshape(shape)
        return whole[border : shape[0] - border, border : shape[1] - border]

    within(first)[:, :, : len(x)] = x.permute(1, 2, 0).numpy()
    _run(network.steps, network.weights, images)
    return torch.from_numpy(within(last).copy()).permute(2, 0, 1)


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize(
    ("channels", "out", "kernel", "stride", "high", "wide"),
    [(3, 24, 5, 2, 12, 22), (24, 48, 3, 2, 9, 10), (48, 105, 1, 1, 5, 13), (72, 7, 3, 1, 1, 3)],
)
def test_a_layer_is_that_of_torch_at_any_size(
    channels: int, out: int, kernel: int, stride: int, high: int, wide: int, relu: bool
) -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(channels, high, wide, generator=draw)
    weight = torch.randn(out, channels, kernel, kernel, generator=draw)
    bias = torch.randn(out, generator=draw)
    builder = NetworkBuilder()
    first = builder.image(high, wide, padded(channels), kernel // 2 + 1)
    found = outputs(builder, first, x, builder.layer(first, weight, bias, stride, 1, relu))
    expected = F.conv2d(x[None], weight, bias, stride, kernel // 2)[0]
    expected = expected.relu() if relu else expected
    torch.testing.assert_close(found[:out], expected, atol=1e-3, rtol=1e-4)
    assert (found[out:] == 0).all(), "what fills the memory up must not become an input"


def test_layers_follow_one_another_and_are_added() -> None:
    draw = torch.Generator().manual_seed(1)
    x = torch.randn(20, 6, 8, generator=draw)
    one, two = (torch.randn(20, 20, 3, 3, generator=draw) / 20 for _ in range(2))
    none = torch.zeros(20)
    builder = NetworkBuilder()
    first = builder.image(6, 8, padded(20), 1)
    between = builder.layer(first, one, none, border=1, relu=True)
    shortcut = builder.layer(first, torch.eye(20)[:, :, None, None], none)
    last = builder.layer(between, two, none, relu=True, onto=shortcut)
    expected = F.conv2d(F.conv2d(x[None], one, padding=1).relu(), two, padding=1)[0] + x
    found = outputs(builder, first, x, last)[:20]
    torch.testing.assert_close(found, expected.relu(), atol=1e-4, rtol=1e-4)


def test_a_merging_doubles_an_image_and_adds_what_is_everywhere() -> None:
    draw = torch.Generator().manual_seed(2)
    x, weight = torch.randn(16, 3, 2, generator=draw), torch.randn(16, 96, 1, 1, generator=draw)
    builder = NetworkBuilder()
    first = builder.image(3, 2, padded(16))
    everywhere = builder.layer(
        Image(first.place, 1, 1, 6 * padded(16), 0), _widened(weight), x[:, 0, 0]
    )
    last = builder.merged(first, everywhere, border=2)
    flat = x.permute(1, 2, 0).flatten()
    added = weight[:, :, 0, 0] @ flat + x[:, 0, 0]
    expected = F.interpolate(x[None], scale_factor=2.0)[0] + added[:, None, None]
    torch.testing.assert_close(
        outputs(builder, first, x, last)[:16], expected, atol=1e-4, rtol=1e-4
    )


def _widened(weight: Tensor) -> Tensor:
    """(16, 96, 1, 1) for six pixels whose channels take `padded(16)` numbers."""
    wide = torch.zeros(16, 6, padded(16))
    wide[:, :, :16] = weight.unflatten(1, (6, 16))[..., 0, 0]
    return wide.flatten(1)[:, :, None, None]
