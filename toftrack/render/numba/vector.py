"""Vector instructions of the CPU kernel that numba does not reach from plain Python.

Written as LLVM vectors, which every processor has or gets split into what it has; they are inlined.
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

BLOCK = 8
"""Pixels of a row that are worked on at once; images need this much padding on the right."""

WORDS = 8
"""Words of 64 pixels, one above the other, that are worked on at once."""

_VECTOR = ir.VectorType(ir.FloatType(), BLOCK)
_WORDS = ir.VectorType(ir.IntType(64), WORDS)


def _pointer(context, builder, array_type, array, index, lltype=None):
    data = context.make_array(array_type)(context, builder, array).data
    at = builder.gep(data, [index])
    return at if lltype is None else builder.bitcast(at, lltype.as_pointer())


def _load(context, builder, array_type, array, index, lltype=_VECTOR):
    align = 4 if lltype is _VECTOR else 8
    return builder.load(_pointer(context, builder, array_type, array, index, lltype), align=align)


def _splat(builder, value):
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), BLOCK), [0] * BLOCK)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), zeros)


@intrinsic
def draw(typingctx, tile, index, t, u, slope, peak, curve):
    """tile[index + j] = max(itself, u + slope t_j + sqrt(peak - curve t_j^2)), t_j = t + j."""

    def codegen(context, builder, signature, args):
        tile, index, *numbers = args
        t, u, slope, peak, curve = (_splat(builder, number) for number in numbers)
        fast = ("contract",)
        steps = ir.Constant(_VECTOR, [float(j) for j in range(BLOCK)])
        t = builder.fadd(t, steps)
        below = builder.fsub(peak, builder.fmul(curve, builder.fmul(t, t), fast), flags=fast)
        sqrt = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.sqrt.v{BLOCK}f32"
        )
        plane = builder.fadd(u, builder.fmul(slope, t, flags=fast), flags=fast)
        new = builder.fadd(plane, builder.call(sqrt, [below]))
        at = _pointer(context, builder, signature.args[0], tile, index, _VECTOR)
        old = builder.load(at, align=4)
        # An ordered comparison: the NaN of a missed pixel loses.
        builder.store(builder.select(builder.fcmp_ordered(">", new, old), new, old), at, align=4)
        return context.get_dummy_value()

    return types.void(tile, types.intp, *(types.float32,) * 5), codegen


@intrinsic
def count(typingctx, tile, index, images, low, high, occluder, residuals):
    """Bits of model, correct and false in the lowest 3 * BLOCK bits; adds to `residuals`."""

    def codegen(context, builder, signature, args):
        kinds = signature.args
        u = _load(context, builder, kinds[0], args[0], args[1])
        low, high, occluder = (_load(context, builder, kinds[2], args[2], i) for i in args[3:6])
        zero, half = (ir.Constant(_VECTOR, [value] * BLOCK) for value in (0.0, 0.5))
        model = builder.fcmp_ordered(">", u, zero)
        correct = builder.and_(
            builder.fcmp_ordered(">=", u, low), builder.fcmp_ordered("<=", u, high)
        )
        correct = builder.and_(model, correct)
        false = builder.and_(model, builder.fcmp_ordered(">=", u, occluder))
        false = builder.and_(false, builder.not_(correct))
        middle = builder.fmul(builder.fadd(low, high), half)
        width = builder.fmul(builder.fsub(high, low), half)
        part = builder.fdiv(builder.fsub(u, middle), width)
        part = builder.select(correct, builder.fmul(part, part), zero)
        at = _pointer(context, builder, kinds[6], args[6], ir.IntType(64)(0), _VECTOR)
        builder.store(builder.fadd(builder.load(at, align=4), part), at, align=4)
        word, packed = ir.IntType(64), ir.IntType(64)(0)
        for shift, bits in ((0, model), (BLOCK, correct), (2 * BLOCK, false)):
            bits = builder.zext(builder.bitcast(bits, ir.IntType(BLOCK)), word)
            packed = builder.or_(packed, builder.shl(bits, word(shift)))
        return packed

    indices = (types.intp,) * 3
    return types.uint64(tile, types.intp, images, *indices, residuals), codegen


@intrinsic
def widen(typingctx, buffer, at, to, model, over, under):
    """Words from `at` widened by a bit to both sides, and two of the model's, are stored at `to`.

    The words to the left and right are WORDS before and after.
    """

    def codegen(context, builder, signature, args):
        kinds, (buffer, at, to, model, over, under) = signature.args, args
        one, top = (ir.Constant(_WORDS, [value] * WORDS) for value in (1, 63))
        step = ir.IntType(64)(WORDS)
        left, middle, right = (
            _load(context, builder, kinds[0], buffer, i, _WORDS)
            for i in (builder.sub(at, step), at, builder.add(at, step))
        )
        parts = (
            builder.shl(middle, one),
            builder.lshr(middle, one),
            builder.lshr(left, top),
            builder.shl(right, top),
            _load(context, builder, kinds[3], model, over, _WORDS),
            _load(context, builder, kinds[3], model, under, _WORDS),
        )
        for part in parts:
            middle = builder.or_(middle, part)
        builder.store(middle, _pointer(context, builder, kinds[0], buffer, to, _WORDS), align=8)
        return context.get_dummy_value()

    indices = (types.intp,) * 2
    return types.void(buffer, *indices, model, *indices), codegen


@intrinsic
def merge(typingctx, buffer, at, model, over, under):
    """Two times WORDS words of the model are added to those at `at`."""

    def codegen(context, builder, signature, args):
        kinds, (buffer, at, model, over, under) = signature.args, args
        words = _load(context, builder, kinds[0], buffer, at, _WORDS)
        for index in (over, under):
            words = builder.or_(words, _load(context, builder, kinds[2], model, index, _WORDS))
        builder.store(words, _pointer(context, builder, kinds[0], buffer, at, _WORDS), align=8)
        return context.get_dummy_value()

    return types.void(buffer, types.intp, model, types.intp, types.intp), codegen


@intrinsic
def near(typingctx, buffer, at, wanted, index):
    """How many bits WORDS words of both have in common."""

    def codegen(context, builder, signature, args):
        words = builder.and_(
            _load(context, builder, signature.args[0], args[0], args[1], _WORDS),
            _load(context, builder, signature.args[2], args[2], args[3], _WORDS),
        )
        total = ir.IntType(64)(0)
        for j in range(WORDS):
            total = builder.add(
                total, builder.ctpop(builder.extract_element(words, ir.IntType(32)(j)))
            )
        return total

    return types.int64(buffer, types.intp, wanted, types.intp), codegen


@intrinsic
def ones(typingctx, word):
    """How many bits are set."""

    def codegen(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.int64(types.uint64), codegen
