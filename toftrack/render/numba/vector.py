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

_FLOAT, _INT, _WORD = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_NUMBERS = ir.VectorType(_INT, BLOCK)
_VECTOR = ir.VectorType(_FLOAT, BLOCK)
# A product and a sum may be one operation, as everywhere in compiling.OPTIONS.
_FAST = ("contract",)


class Vector(types.Type):
    """A numba type of a plain LLVM vector."""

    def __init__(self, name: str, lltype: ir.VectorType) -> None:
        self.lltype = lltype
        super().__init__(name)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, fe_type.lltype)


FLOATS = Vector("toftrack_floats", _VECTOR)


def spread(builder, value, lltype=_VECTOR):
    """A number in every place of an LLVM vector; a vector as it is."""
    if value.type == lltype:
        return value
    one = builder.insert_element(ir.Constant(lltype, ir.Undefined), value, _INT(0))
    zeros = ir.Constant(ir.VectorType(_INT, lltype.count), [0] * lltype.count)
    return builder.shuffle_vector(one, ir.Constant(lltype, ir.Undefined), zeros)


def define(function: Callable, kind: Vector, number: types.Type, emit: Callable) -> None:
    """Let an operator of Python take two vectors, or a vector and a number.

    emit: the instruction's operands and its builder to its result.
    """
    pairs = [(kind, kind), (kind, number), (number, kind)]

    @type_callable(function)
    def _(context):
        return lambda left, right: kind if (left, right) in pairs else None

    def lowered(context, builder, sig, args):
        return emit(builder, *(spread(builder, value, kind.lltype) for value in args))

    for pair in pairs:
        lower_builtin(function, *pair)(lowered)


define(operator.add, FLOATS, types.float32, partial(ir.IRBuilder.fadd, flags=_FAST))
define(operator.sub, FLOATS, types.float32, partial(ir.IRBuilder.fsub, flags=_FAST))
define(operator.mul, FLOATS, types.float32, partial(ir.IRBuilder.fmul, flags=_FAST))
define(operator.truediv, FLOATS, types.float32, ir.IRBuilder.fdiv)


def pointer(context, builder, array_type, array, index, lltype=_VECTOR):
    """To an LLVM vector that begins at an index of a flat array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), lltype.as_pointer())


def call(builder, name, *args):
    """An intrinsic function of LLVM whose result is of its arguments' type."""
    kinds = [arg.type for arg in args]
    return builder.call(declared(builder, f"llvm.{name}", kinds[0], kinds), args)


def declared(builder, name, result, kinds):
    """A function of LLVM's, known to the module once."""
    known = builder.module.globals.get(name)
    return known or ir.Function(builder.module, ir.FunctionType(result, kinds), name)


def _unary(name: str):
    def function(typingctx, vector):
        def codegen(context, builder, signature, args):
            return call(builder, f"{name}.v{BLOCK}f32", *args)

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
    """The same number in every place."""
    return FLOATS(types.float32), lambda context, builder, signature, args: spread(builder, args[0])


def _choice(comparison: str):
    def function(typingctx, vector, other):
        def codegen(context, builder, signature, args):
            left, right = (spread(builder, value) for value in args)
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
    """BLOCK numbers of a flat array."""

    def codegen(context, builder, signature, args):
        return builder.load(pointer(context, builder, signature.args[0], *args), align=4)

    return FLOATS(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, vector):
    """BLOCK numbers into a flat array, as whole numbers where it is one of int32."""

    def codegen(context, builder, signature, args):
        array, index, vector = args
        if signature.args[0].dtype == types.int32:
            vector = builder.fptosi(vector, ir.VectorType(_INT, BLOCK))
        at = pointer(context, builder, signature.args[0], array, index, vector.type)
        builder.store(vector, at, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, FLOATS), codegen


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


def _root_estimate(context, builder, square):
    """Square root to four digits where the processor has such an instruction, else in full.

    Of a surface's thickness these are microns, and the root is what drawing waits for most.
    """
    features = context.codegen().magic_tuple()[-1].split(",")
    if "+avx512f" not in features:
        return call(builder, f"sqrt.v{BLOCK}f32", square)
    mask = ir.IntType(BLOCK)
    name, kinds = "llvm.x86.avx512.rsqrt14.ps.512", (_VECTOR, _VECTOR, mask)
    estimate = declared(builder, name, _VECTOR, kinds)
    none = ir.Constant(_VECTOR, [0.0] * BLOCK)
    return builder.fmul(square, builder.call(estimate, [square, none, mask(-1)]), flags=_FAST)


@intrinsic
def draw(typingctx, tile, index, t, plane, peak, slope, curve):
    """tile[index + j] = max(itself, plane + slope j + sqrt(peak - curve t_j^2)), t_j = t + j."""

    def codegen(context, builder, signature, args):
        t, plane, peak, slope, curve = (spread(builder, arg) for arg in args[2:])
        steps = ir.Constant(_VECTOR, [float(j) for j in range(BLOCK)])
        t = builder.fadd(t, steps)
        below = builder.fsub(
            peak, builder.fmul(curve, builder.fmul(t, t), flags=_FAST), flags=_FAST
        )
        plane = builder.fadd(plane, builder.fmul(slope, steps, flags=_FAST), flags=_FAST)
        new = builder.fadd(plane, _root_estimate(context, builder, below), flags=_FAST)
        # As whole numbers, floats from 0 on are in the same order, and what misses, whose square is
        # negative, is made so. A choice between floats would become a masked store.
        sign = builder.and_(
            builder.bitcast(below, _NUMBERS), ir.Constant(_NUMBERS, [1 << 31] * BLOCK)
        )
        new = builder.or_(builder.bitcast(new, _NUMBERS), sign)
        at = pointer(context, builder, signature.args[0], *args[:2], _NUMBERS)
        old = builder.load(at, align=4)
        builder.store(call(builder, f"smax.v{BLOCK}i32", new, old), at, align=4)
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
        at = pointer(context, builder, kinds[0], tile, index)
        u = builder.load(at, align=4)
        zero, one = (ir.Constant(_VECTOR, [value] * BLOCK) for value in (0.0, 1.0))
        builder.store(zero, at, align=4)
        middle, scale, occluder = (
            builder.load(
                pointer(context, builder, kinds[2], images, builder.add(block, _WORD(j * BLOCK))),
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
