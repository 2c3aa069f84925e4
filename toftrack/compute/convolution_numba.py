"""Convolutions of one image in one compiled call: for networks that are small and asked often.

A library takes some ten microseconds for each layer of such a network besides its arithmetic, and
the interpreter's lock in between; here a whole network is one call without the lock.

Images are (H + 2 p, W + 2 p, C) float32, with p rows and columns of zeros around and C a multiple
of LANES; they lie in one array, and the layers of a network are the rows of a table. Of an output's
row, PIXELS neighbours and VECTORS * LANES channels are summed up in registers (the micro-kernel of
Goto and van de Geijn, "Anatomy of high-performance matrix multiplication", ACM TOMS 34(3), 2008);
the window of a pixel lies in `kernel` contiguous pieces.
"""

from __future__ import annotations

import platform
from typing import NamedTuple

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from toftrack.compute.compiling import compiled


def _register_shape() -> tuple[int, int, int]:
    """Lanes of a vector, pixels and vectors that are summed up at once in the registers here."""
    if llvmlite.binding.get_host_cpu_features().get("avx512f", False):
        return 16, 8, 3
    return (8, 4, 2) if platform.machine().lower() in ("x86_64", "amd64") else (4, 8, 3)


LANES, PIXELS, VECTORS = _register_shape()
_FEW = min(4, PIXELS)
_BLOCKS = [(p, v) for p in sorted({PIXELS, _FEW, 1}) for v in range(1, VECTORS + 1)]
"""Pixels and vectors of the micro-kernels."""
_CONTRACT = ("contract",)
ADD, RELU = 1, 2
"""Flags of `sums`."""


class Step(NamedTuple):
    """One layer of a network as the kernel takes it, a row of the table of steps.

    All places are those of numbers in one array of weights and in one of images.
    x, wide: place of the image and its width in pixels.  inputs: its channels in memory.
    kernel, stride: in pixels; 0 for `kernel` is a merging, see NetworkBuilder.merged.
    skipped: pixels of the image's border that no window reaches.
    weights: groups of (kernel * kernel * inputs, vectors * LANES), one after the other.
    bias: (outputs,), zeros up to a multiple of LANES.
    out, out_high, out_wide, outputs, border: the image that is written, within its border.
    flags: ADD to what is there, RELU.
    """

    x: int
    wide: int
    inputs: int
    kernel: int
    stride: int
    skipped: int
    weights: int
    bias: int
    out: int
    out_high: int
    out_wide: int
    outputs: int
    border: int
    flags: int


class Image(NamedTuple):
    """Where an image lies: (high + 2 border, wide + 2 border, channels) numbers from `place` on."""

    place: int
    high: int
    wide: int
    channels: int
    border: int

    def shape(self) -> tuple[int, int, int]:
        """In memory."""
        return self.high + 2 * self.border, self.wide + 2 * self.border, self.channels


class Network(NamedTuple):
    """A network for `run`: the table of Steps, the weights, and the numbers its images take."""

    steps: np.ndarray
    weights: np.ndarray
    capacity: int


class NetworkBuilder:
    """Lays out the layers of a network, and the images between them, in the order of their run."""

    def __init__(self) -> None:
        self._steps: list[Step] = []
        self._weights: list[np.ndarray] = []
        self._placed = self._capacity = 0

    def network(self) -> Network:
        """What was laid out."""
        steps = np.array(self._steps, np.int64)
        return Network(steps, np.concatenate(self._weights), self._capacity)

    def image(self, high: int, wide: int, channels: int, border: int = 0) -> Image:
        """Room for an image whose channels take so much memory, see `padded`."""
        image = Image(self._capacity, high, wide, channels, border)
        self._capacity += int(np.prod(image.shape()))
        return image

    def layer(
        self,
        x: Image,
        weight: Tensor,
        bias: Tensor,
        stride: int = 1,
        border: int = 0,
        relu: bool = False,
        onto: Image | None = None,
    ) -> Image:
        """A convolution with weights (outputs, channels, kernel, kernel) and (outputs,).

        border: of the output.  relu: what is below 0 becomes 0.  onto: is added to, and returned.
        """
        outputs, channels, kernel, _ = weight.shape
        assert x.border >= kernel // 2
        full = np.zeros((padded(outputs), kernel, kernel, x.channels), np.float32)
        full[:outputs, :, :, :channels] = weight.detach().permute(0, 2, 3, 1).numpy()
        columns = full.reshape(len(full), -1).T
        groups = range(0, len(full), VECTORS * LANES)
        offset = np.zeros(len(full), np.float32)
        offset[:outputs] = bias.detach().numpy()
        out = onto
        if out is None:
            out = self.image(-(-x.high // stride), -(-x.wide // stride), len(full), border)
        step = Step(
            *(x.place, x.shape()[1], x.channels, kernel, stride, x.border - kernel // 2),
            weights=self._put(*(columns[:, at : at + VECTORS * LANES] for at in groups)),
            bias=self._put(offset),
            **_written(out),
            flags=(ADD if onto is not None else 0) + (RELU if relu else 0),
        )
        self._steps.append(step)
        return out

    def merged(self, x: Image, everywhere: Image, border: int) -> Image:
        """An image of twice the size, each pixel four times, with one of a pixel added to all."""
        out = self.image(2 * x.high, 2 * x.wide, x.channels, border)
        assert x.border == 0 and everywhere.channels == x.channels
        step = Step(
            x.place, x.wide, x.channels, 0, 0, 0, 0, everywhere.place, **_written(out), flags=0
        )
        self._steps.append(step)
        return out

    def _put(self, *arrays: np.ndarray) -> int:
        at = self._placed
        for array in arrays:
            self._weights.append(np.ascontiguousarray(array).ravel())
            self._placed += array.size
        return at


def _written(out: Image) -> dict[str, int]:
    high, wide, channels = out.shape()
    named = {"out": out.place, "out_high": high, "out_wide": wide}
    return named | {"outputs": channels, "border": out.border}


def padded(channels: int) -> int:
    """The channels of an image in memory, but for one that is filled from outside."""
    return -(-channels // LANES) * LANES


def _emit(builder, pixels: int, vectors: int, data: list, numbers: list) -> None:
    """The micro-kernel for so many pixels and vectors; see `sums` for the arguments."""
    (x, w), bias, out = data, data[1], data[0]
    at, step, line, rows, length, place, first, to, following, flags = numbers
    vector = ir.VectorType(ir.FloatType(), LANES)
    word = ir.IntType(64)
    zero = ir.Constant(vector, [0.0] * LANES)
    add = builder.icmp_signed("!=", builder.and_(flags, word(ADD)), word(0))
    relu = builder.icmp_signed("!=", builder.and_(flags, word(RELU)), word(0))

    def at_vector(base: ir.Value, index: ir.Value, number: int) -> ir.Value:
        index = builder.add(index, word(number * LANES))
        return builder.bitcast(builder.gep(base, [index]), vector.as_pointer())

    def output(pixel: int, number: int) -> ir.Value:
        index = builder.add(to, builder.mul(following, word(pixel)))
        return at_vector(out, index, number)

    # Places on the stack, which the optimiser turns into registers.
    each = [(pixel, number) for pixel in range(pixels) for number in range(vectors)]
    total = {one: cgutils.alloca_once(builder, vector) for one in each}
    for pixel, number in each:
        start = builder.load(at_vector(bias, first, number), align=4)
        before = builder.load(output(pixel, number), align=4)
        begun = builder.fadd(start, builder.select(add, before, zero))
        builder.store(begun, total[pixel, number])
    with cgutils.for_range(builder, rows) as row:
        from_row = builder.add(at, builder.mul(row.index, line))
        of_row = builder.mul(row.index, length)
        with cgutils.for_range(builder, length) as one:
            index = builder.mul(builder.add(of_row, one.index), word(vectors * LANES))
            index = builder.add(index, place)
            weights = [builder.load(at_vector(w, index, v), align=4) for v in range(vectors)]
            source = builder.add(from_row, one.index)
            for pixel in range(pixels):
                index = builder.add(source, builder.mul(step, word(pixel)))
                value = builder.load(builder.gep(x, [index]))
                spread = _spread(builder, value, vector)
                for v in range(vectors):
                    product = builder.fmul(spread, weights[v], flags=_CONTRACT)
                    before = builder.load(total[pixel, v])
                    builder.store(builder.fadd(before, product, flags=_CONTRACT), total[pixel, v])
    for pixel, number in each:
        found = builder.load(total[pixel, number])
        positive = builder.select(builder.fcmp_ordered(">", found, zero), found, zero)
        activated = builder.select(relu, positive, found)
        builder.store(activated, output(pixel, number), align=4)


def _spread(builder, value: ir.Value, vector: ir.VectorType) -> ir.Value:
    """A number in all lanes."""
    empty = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(empty, value, ir.IntType(32)(0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, empty, lanes)


@intrinsic
def sums(
    typingctx,
    images,
    weights,
    pixels,
    vectors,
    at,
    step,
    line,
    rows,
    length,
    place,
    first,
    to,
    following,
    flags,
):
    """Outputs of a few neighbouring pixels in a few vectors of channels.

    pixels, vectors: how many, of _BLOCKS.  at, to: the first pixel's place, and that of its output.
    step, following: from pixel to pixel and from output to output.
    rows, length, line: pieces of a window, how long each is, and from one to the next.
    place, first: of the weights and of the bias.  flags: ADD, RELU.
    """

    def codegen(context, builder, signature, given):
        data = [
            context.make_array(signature.args[i])(context, builder, given[i]).data for i in range(2)
        ]
        word = ir.IntType(64)
        for count, wide in _BLOCKS:
            this = builder.and_(
                builder.icmp_signed("==", given[2], word(count)),
                builder.icmp_signed("==", given[3], word(wide)),
            )
            with builder.if_then(this):
                _emit(builder, count, wide, data, list(given[4:]))
        return context.get_dummy_value()

    return types.none(images, weights, *[types.int64] * 12), codegen


@compiled
def run(steps, weights, images):
    """All layers of a network, see Network; images: (room,) float32, its borders zeros."""
    for number in range(len(steps)):
        step = steps[number]
        if step[3] > 0:
            _convolve(step, weights, images)
        else:
            _merge(step, images)


@compiled
def _convolve(s, weights, images):
    """One layer; s: the numbers of a Step."""
    x, kernel, channels, border = s[0], s[3], s[11], s[12]
    length, line, step = kernel * s[2], s[1] * s[2], s[4] * s[2]
    place, first = s[6], 0
    while first < channels:
        vectors = min(VECTORS, (channels - first) // LANES)
        for row in range(s[9] - 2 * border):
            column = 0
            while column < s[10] - 2 * border:
                left = s[10] - 2 * border - column
                count = PIXELS if left >= PIXELS else (_FEW if left >= _FEW else 1)
                sums(
                    images,
                    weights,
                    count,
                    vectors,
                    x + (s[4] * row + s[5]) * line + (s[4] * column + s[5]) * s[2],
                    step,
                    line,
                    kernel,
                    length,
                    place,
                    s[7] + first,
                    s[8] + ((row + border) * s[10] + column + border) * channels + first,
                    channels,
                    s[13],
                )
                column += count
        place += kernel * length * vectors * LANES
        first += vectors * LANES


@compiled
def _merge(s, images):
    """See NetworkBuilder.merged."""
    x, everywhere, out, channels, border = s[0], s[7], s[8], s[11], s[12]
    for row in range(s[9] - 2 * border):
        for column in range(s[10] - 2 * border):
            source = x + (row // 2 * s[1] + column // 2) * channels
            to = out + ((row + border) * s[10] + column + border) * channels
            for channel in range(channels):
                images[to + channel] = images[source + channel] + images[everywhere + channel]
