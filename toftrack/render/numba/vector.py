"""Vectors of the CPU kernel: values of a compiled function that hold sixteen pixels at once.

Written as LLVM vectors, which every processor has or gets split into what it has. Numba keeps them
in registers as it does a number.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

BLOCK = 16
"""Pixels of a row that are worked on at once; images need as much padding on the right."""
WORDS = 8
"""Words of 64 pixels, one above the other, that are worked on at once."""

_INT, _WORD = ir.IntType(32), ir.IntType(64)
_VECTOR, _NUMBERS = ir.VectorType(ir.FloatType(), BLOCK), ir.VectorType(_INT, BLOCK)
_ROWS = ir.VectorType(_WORD, WORDS)
# A product and a sum may be one operation, as everywhere in compiling.OPTIONS.
_FAST = ("contract",)


class _Vector(types.Type):
    """A numba type of a plain LLVM vector of numbers."""

    def __init__(self, name: str, lltype: ir.VectorType) -> None:
        self.lltype = lltype
        super().__init__(name)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, fe_type.lltype)


FLOATS, ROWS = _Vector("toftrack_floats", _VECTOR), _Vector("toftrack_rows", _ROWS)
_KINDS: dict[types.Type, _Vector] = {types.float32: FLOATS, types.uint64: ROWS}


def _spread(builder, value, lltype=_VECTOR):
    """A number in every place of an LLVM vector; a vector as it is."""
    if value.type == lltype:
        return value
    one = builder.insert_element(ir.Constant(lltype, ir.Undefined), value, _INT(0))
    zeros = ir.Constant(ir.VectorType(_INT, lltype.count), [0] * lltype.count)
    return builder.shuffle_vector(one, ir.Constant(lltype, ir.Undefined), zeros)


def _define(function: Callable, number: types.Type, emit: Callable) -> None:
    """Let an operator of Python take two vectors, or a vector and a number.

    emit: the instruction's operands and its builder to its result.
    """
    kind = _KINDS[number]
    pairs = [(kind, kind), (kind, number), (number, kind)]

    @type_callable(function)
    def _(context):
        return lambda left, right: kind if (left, right) in pairs else None

    def lowered(context, builder, sig, args):
        return emit(builder, *(_spread(builder, value, kind.lltype) for value in args))

    for pair in pairs:
        lower_builtin(function, *pair)(lowered)


_define(operator.add, types.float32, partial(ir.IRBuilder.fadd, flags=_FAST))
_define(operator.sub, types.float32, partial(ir.IRBuilder.fsub, flags=_FAST))
_define(operator.mul, types.float32, partial(ir.IRBuilder.fmul, flags=_FAST))
_define(operator.truediv, types.float32, ir.IRBuilder.fdiv)
_define(operator.and_, types.uint64, ir.IRBuilder.and_)
_define(operator.or_, types.uint64, ir.IRBuilder.or_)
_define(operator.xor, types.uint64, ir.IRBuilder.xor)


def _pointer(context, builder, array_type, array, index, lltype=_VECTOR):
    """To an LLVM vector that begins at an index of a flat array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), lltype.as_pointer())


def _call(builder, name, *args):
    """An intrinsic function of LLVM whose result is of its arguments' type."""
    kinds = [arg.type for arg in args]
    return builder.call(_declared(builder, f"llvm.{name}", kinds[0], kinds), args)


def _declared(builder, name, result, kinds):
    """A function of LLVM's, known to the module once."""
    known = builder.module.globals.get(name)
    return known or ir.Function(builder.module, ir.FunctionType(result, kinds), name)


def _unary(name: str):
    def function(typingctx, vector):
        def codegen(context, builder, signature, args):
            return _call(builder, f"{name}.v{BLOCK}f32", *args)

        return FLOATS(FLOATS), codegen

    return intrinsic(function)


root, up, down = _unary("sqrt"), _unary("ceil"), _unary("floor")
"""Square root (NaN below 0), and the next whole numbers."""


@intrinsic
def ramp(typingctx):
    """0, 1, 2 ..: the columns of a block."""
    return FLOATS(), lambda context, builder, signature, args: ir.Constant(
        _VECTOR, [float(j) for j in range(BLOCK)]
    )


@intrinsic
def splat(typingctx, value):
    """The same number in every place: BLOCK float32, or WORDS uint64."""
    kind = _KINDS[value]
    return kind(value), lambda context, builder, signature, args: _spread(
        builder, args[0], kind.lltype
    )


def _choice(comparison: str):
    def function(typingctx, vector, other):
        def codegen(context, builder, signature, args):
            left, right = (_spread(builder, value) for value in args)
            return builder.select(builder.fcmp_ordered(comparison, left, right), left, right)

        return FLOATS(FLOATS, other), codegen

    return intrinsic(function)


larger, smaller = _choice(">"), _choice("<")
"""The larger or smaller of two; the second where the first is NaN."""


@intrinsic
def where_above(typingctx, condition, vector, otherwise):
    """The second where the first is above 0, elsewhere the third."""

    def codegen(context, builder, signature, args):
        yes = builder.fcmp_ordered(">", args[0], ir.Constant(_VECTOR, [0.0] * BLOCK))
        return builder.select(yes, args[1], args[2])

    return FLOATS(FLOATS, FLOATS, FLOATS), codegen


@intrinsic
def load(typingctx, array, index):
    """BLOCK numbers of a flat array of float32, or WORDS of one of uint64."""
    kind = _KINDS[array.dtype]

    def codegen(context, builder, signature, args):
        at = _pointer(context, builder, signature.args[0], *args, kind.lltype)
        return builder.load(at, align=array.dtype.bitwidth // 8)

    return kind(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, vector):
    """A vector into a flat array, as whole numbers where it is one of int32."""

    def codegen(context, builder, signature, args):
        array, index, vector = args
        kind = signature.args[0]
        if kind.dtype == types.int32:
            vector = builder.fptosi(vector, _NUMBERS)
        at = _pointer(context, builder, kind, array, index, vector.type)
        builder.store(vector, at, align=kind.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), codegen


@intrinsic
def total(typingctx, vector):
    """The sum of all places."""

    def codegen(context, builder, signature, args):
        (vector,) = args
        count = BLOCK
        while count > 1:
            count //= 2
            halves = [
                ir.Constant(ir.VectorType(_INT, count), list(range(first, first + count)))
                for first in (0, count)
            ]
            undefined = ir.Constant(vector.type, ir.Undefined)
            low, high = (builder.shuffle_vector(vector, undefined, half) for half in halves)
            vector = builder.fadd(low, high)
        return builder.extract_element(vector, _INT(0))

    return types.float32(FLOATS), codegen


@intrinsic
def shifted(typingctx, words, after, count):
    """Pixels from `count` (0 .. 63) on, of words and of those to their right."""

    def codegen(context, builder, signature, args):
        words, after, count = args
        return _call(builder, f"fshr.v{WORDS}i64", after, words, _spread(builder, count, _ROWS))

    return ROWS(ROWS, ROWS, types.uint64), codegen


@intrinsic
def widened(typingctx, left, words, right):
    """Words with the pixels to both sides of theirs; left, right: the words beside them."""

    def codegen(context, builder, signature, args):
        left, words, right = args
        one, name = ir.Constant(_ROWS, [1] * WORDS), f".v{WORDS}i64"
        higher = _call(builder, "fshl" + name, words, left, one)
        lower = _call(builder, "fshr" + name, right, words, one)
        return builder.or_(words, builder.or_(higher, lower))

    return ROWS(ROWS, ROWS, ROWS), codegen


@intrinsic
def ones(typingctx, words):
    """How many bits are set."""

    def codegen(context, builder, signature, args):
        counts = _call(builder, f"ctpop.v{WORDS}i64", *args)
        sums = [builder.extract_element(counts, _INT(j)) for j in range(WORDS)]
        while len(sums) > 1:
            sums = [builder.add(a, b) for a, b in zip(sums[::2], sums[1::2], strict=True)]
        return sums[0]

    return types.int64(ROWS), codegen


def _root_estimate(context, builder, square):
    """Square root to four digits where the processor has such an instruction, else in full.

    Of a surface's thickness these are microns, and the root is what drawing waits for most.
    """
    features = context.codegen().magic_tuple()[-1].split(",")
    if "+avx512f" not in features:
        return _call(builder, f"sqrt.v{BLOCK}f32", square)
    mask = ir.IntType(BLOCK)
    name, kinds = "llvm.x86.avx512.rsqrt14.ps.512", (_VECTOR, _VECTOR, mask)
    estimate = _declared(builder, name, _VECTOR, kinds)
    none = ir.Constant(_VECTOR, [0.0] * BLOCK)
    return builder.fmul(square, builder.call(estimate, [square, none, mask(-1)]), flags=_FAST)


@intrinsic
def draw(typingctx, tile, index, t, plane, peak, slope, curve):
    """tile[index + j] = max(itself, plane + slope j + sqrt(peak - curve t_j^2)), t_j = t + j."""

    def codegen(context, builder, signature, args):
        t, plane, peak, slope, curve = (_spread(builder, arg) for arg in args[2:])
        steps = ir.Constant(_VECTOR, [float(j) for j in range(BLOCK)])
        t = builder.fadd(t, steps)
        curved = builder.fmul(curve, builder.fmul(t, t), flags=_FAST)
        below = builder.fsub(peak, curved, flags=_FAST)
        plane = builder.fadd(plane, builder.fmul(slope, steps, flags=_FAST), flags=_FAST)
        new = builder.fadd(plane, _root_estimate(context, builder, below), flags=_FAST)
        # As whole numbers, floats from 0 on are in the same order, and what misses, whose square is
        # negative, is made so. A choice between floats would become a masked store.
        sign = builder.and_(
            builder.bitcast(below, _NUMBERS), ir.Constant(_NUMBERS, [1 << 31] * BLOCK)
        )
        new = builder.or_(builder.bitcast(new, _NUMBERS), sign)
        at = _pointer(context, builder, signature.args[0], *args[:2], _NUMBERS)
        old = builder.load(at, align=4)
        builder.store(_call(builder, f"smax.v{BLOCK}i32", new, old), at, align=4)
        return context.get_dummy_value()

    return types.void(tile, types.intp, *(types.float32,) * 5), codegen


@intrinsic
def compare(typingctx, tile, index, images, block, model, place, correct, false, residual):
    """A block of the tile against the evidence: its silhouette's bits, and what is summed up.

    The block is then cleared. images: see pack_evidence; block: its index there, times 3 * BLOCK.
    model: words of bits; place: which of their quarters, in the order of memory, is set.
    Returns correct, false and residual (FLOATS) with the block's added.
    """

    def codegen(context, builder, sig, args):
        kinds = sig.args
        tile, index, images, block, model, place, *sums = args
        at = _pointer(context, builder, kinds[0], tile, index)
        u = builder.load(at, align=4)
        zero, one = (ir.Constant(_VECTOR, [value] * BLOCK) for value in (0.0, 1.0))
        builder.store(zero, at, align=4)
        middle, scale, occluder = (
            builder.load(
                _pointer(context, builder, kinds[2], images, builder.add(block, _WORD(j * BLOCK))),
                align=4,
            )
            for j in range(3)
        )
        off = builder.fmul(builder.fsub(u, middle), scale)
        square = builder.fmul(off, off, flags=_FAST)
        drawn = builder.fcmp_ordered(">", u, zero)
        right = builder.fcmp_ordered("<=", square, one)
        wrong = builder.and_(
            builder.fcmp_unordered(">", square, one), builder.fcmp_ordered(">=", u, occluder)
        )
        quarter = ir.IntType(BLOCK)
        words = context.make_array(kinds[4])(context, builder, model).data
        quarters = builder.bitcast(words, quarter.as_pointer())
        builder.store(builder.bitcast(drawn, quarter), builder.gep(quarters, [place]))
        found = [
            builder.select(which, builder.fadd(before, more, flags=_FAST), before)
            for which, before, more in zip(
                (right, wrong, right), sums, (one, one, square), strict=True
            )
        ]
        return context.make_tuple(builder, sig.return_type, found)

    sums = (FLOATS,) * 3
    given = (tile, types.intp, images, types.intp, model, types.intp)
    return types.Tuple(sums)(*given, *sums), codegen
