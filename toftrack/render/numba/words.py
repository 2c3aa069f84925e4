"""Rows of bits of the CPU kernel: words of 64 pixels side by side, several one above the other."""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from toftrack.render.numba.vector import Vector, call, define, spread

WORDS = 8
"""Words, one above the other, that are worked on at once."""

_WORD = ir.IntType(64)
_ROWS = ir.VectorType(_WORD, WORDS)
ROWS = Vector("toftrack_rows", _ROWS)

define(operator.and_, ROWS, types.uint64, ir.IRBuilder.and_)
define(operator.or_, ROWS, types.uint64, ir.IRBuilder.or_)


def _place(context, builder, array_type, array, column, row):
    """A pointer to WORDS words of a (columns, rows) array."""
    struct = context.make_array(array_type)(context, builder, array)
    index = builder.add(builder.mul(column, builder.extract_value(struct.shape, 1)), row)
    return builder.bitcast(builder.gep(struct.data, [index]), _ROWS.as_pointer())


@intrinsic
def load_rows(typingctx, array, column, row):
    """WORDS words of one column of a (columns, rows) array."""

    def codegen(context, builder, signature, args):
        return builder.load(_place(context, builder, signature.args[0], *args), align=8)

    return ROWS(array, types.intp, types.intp), codegen


@intrinsic
def store_rows(typingctx, array, column, row, words):
    """WORDS words of one column of a (columns, rows) array are set."""

    def codegen(context, builder, signature, args):
        *where, words = args
        builder.store(words, _place(context, builder, signature.args[0], *where), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, ROWS), codegen


@intrinsic
def no_rows(typingctx):
    """Words without a bit."""
    return ROWS(), lambda context, builder, signature, args: ir.Constant(_ROWS, [0] * WORDS)


@intrinsic
def shifted(typingctx, words, after, count):
    """Pixels from `count` (0 .. 63) on, of words and of those to their right."""

    def codegen(context, builder, signature, args):
        words, after, count = args
        return call(builder, f"fshr.v{WORDS}i64", after, words, spread(builder, count, _ROWS))

    return ROWS(ROWS, ROWS, types.uint64), codegen


@intrinsic
def widened(typingctx, left, words, right):
    """Words with the pixels to both sides of theirs; left, right: the words beside them."""

    def codegen(context, builder, signature, args):
        left, words, right = args
        one = ir.Constant(_ROWS, [1] * WORDS)
        name = f".v{WORDS}i64"
        higher = call(builder, "fshl" + name, words, left, one)
        lower = call(builder, "fshr" + name, right, words, one)
        return builder.or_(words, builder.or_(higher, lower))

    return ROWS(ROWS, ROWS, ROWS), codegen


@intrinsic
def without(typingctx, words, others):
    """The bits of the first that the second has not."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], builder.not_(args[1]))

    return ROWS(ROWS, ROWS), codegen


@intrinsic
def any_bit(typingctx, words):
    """Whether a bit is set."""

    def codegen(context, builder, signature, args):
        some = builder.icmp_unsigned("!=", args[0], ir.Constant(_ROWS, [0] * WORDS))
        return builder.icmp_unsigned(
            "!=", builder.bitcast(some, ir.IntType(WORDS)), ir.IntType(WORDS)(0)
        )

    return types.boolean(ROWS), codegen


@intrinsic
def ones(typingctx, words):
    """How many bits are set."""

    def codegen(context, builder, signature, args):
        counts = call(builder, f"ctpop.v{WORDS}i64", *args)
        sums = [builder.extract_element(counts, ir.IntType(32)(j)) for j in range(WORDS)]
        while len(sums) > 1:
            sums = [builder.add(a, b) for a, b in zip(sums[::2], sums[1::2], strict=True)]
        return sums[0]

    return types.int64(ROWS), codegen
