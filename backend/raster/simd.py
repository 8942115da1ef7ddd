"""SIMD vectors of sixteen float32 lanes for numba kernels.

numba's automatic vectorization keeps a tile's planes in memory and cannot vectorize a loop whose trip count is a
splat's pixel span. These types are LLVM vectors, which are compiled for any target (AVX, AVX-512, NEON, scalar code).
Kernels can thus control which values are kept in registers, without a C compiler on the user's machine.

Lanes: `Floats` (float), `Ints` (int), `Mask` (bool). Arithmetic operators take equal lane types; `splat` (float32) and
`splat_i` (int32) broadcast a scalar.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
"""One AVX-512 register, two AVX registers or four NEON registers; wider than most splats, so a row is one step."""

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BOOLS = ir.VectorType(ir.IntType(1), LANES)
_FLAGS = ("contract", "nsz")


class _Lanes(types.Type):
    def __init__(self, name: str, vector: ir.VectorType) -> None:
        self.vector = vector
        super().__init__(name)


class _FloatLanes(_Lanes): ...


class _IntLanes(_Lanes): ...


class _BoolLanes(_Lanes): ...


Floats = _FloatLanes("lanes_f32", _FLOATS)
Ints = _IntLanes("lanes_i32", _INTS)
Mask = _BoolLanes("lanes_bool", _BOOLS)


@register_model(_FloatLanes)
@register_model(_IntLanes)
@register_model(_BoolLanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, fe_type.vector)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [value] * LANES)


def _broadcast(builder, value, vector):
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, zeros)


@intrinsic
def splat(typingctx, value):
    """Broadcast a float32 to all lanes."""

    def codegen(context, builder, signature, args):
        return _broadcast(builder, context.cast(builder, args[0], signature.args[0], types.float32), _FLOATS)

    return Floats(types.float32), codegen


@intrinsic
def splat_i(typingctx, value):
    """Broadcast an int32 to all lanes."""

    def codegen(context, builder, signature, args):
        return _broadcast(builder, args[0], _INTS)

    return Ints(types.int32), codegen


@intrinsic
def ramp(typingctx, start):
    """Return the lanes start, start + 1, ..., start + LANES - 1."""

    def codegen(context, builder, signature, args):
        steps = ir.Constant(_FLOATS, [float(i) for i in range(LANES)])
        return builder.fadd(_broadcast(builder, args[0], _FLOATS), steps)

    return Floats(types.float32), codegen


def _address(context, builder, array_type, array, index, vector):
    view = context.make_array(array_type)(context, builder, array)
    pointer = builder.gep(view.data, [index])
    return builder.bitcast(pointer, vector.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Load LANES consecutive elements of a contiguous float32 array, from `index` on; no bounds check."""

    def codegen(context, builder, signature, args):
        pointer = _address(context, builder, signature.args[0], args[0], args[1], _FLOATS)
        return builder.load(pointer, align=4)

    return Floats(array, types.intp), codegen


@intrinsic
def spread(typingctx, array, index):
    """Broadcast element `index` of a contiguous float32 array to all lanes; no bounds check."""

    def codegen(context, builder, signature, args):
        view = context.make_array(signature.args[0])(context, builder, args[0])
        return _broadcast(builder, builder.load(builder.gep(view.data, [args[1]])), _FLOATS)

    return Floats(array, types.intp), codegen


@intrinsic
def load_i(typingctx, array, index):
    """Load LANES consecutive elements of a contiguous int32 array, from `index` on; no bounds check."""

    def codegen(context, builder, signature, args):
        pointer = _address(context, builder, signature.args[0], args[0], args[1], _INTS)
        return builder.load(pointer, align=4)

    return Ints(array, types.intp), codegen


@intrinsic
def gather_i(typingctx, array, index, lanes):
    """Load the elements `index` + lanes of a contiguous int32 array; no bounds check."""

    def codegen(context, builder, signature, args):
        view = context.make_array(signature.args[0])(context, builder, args[0])
        pointers = builder.gep(builder.gep(view.data, [args[1]]), [args[2]], source_etype=ir.IntType(32))
        # llvmlite takes a vector of addresses for a single one.
        pointers.type = ir.VectorType(ir.PointerType(), LANES)
        all_lanes, undefined = ir.Constant(_BOOLS, [1] * LANES), ir.Constant(_INTS, ir.Undefined)
        kind = ir.FunctionType(_INTS, [pointers.type, ir.IntType(32), _BOOLS, _INTS])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.gather.v{LANES}i32.v{LANES}p0")
        return builder.call(function, [pointers, ir.Constant(ir.IntType(32), 4), all_lanes, undefined])

    return Ints(array, types.intp, lanes), codegen


@intrinsic
def byte(typingctx, lanes, number):
    """Return byte `number`, 0 .. 3 and 0 the lowest, of each lane."""

    def codegen(context, builder, signature, args):
        bits = builder.mul(args[1], ir.Constant(ir.IntType(32), 8))
        shifted = builder.lshr(args[0], _broadcast(builder, bits, _INTS))
        return builder.uitofp(builder.and_(shifted, ir.Constant(_INTS, [255] * LANES)), _FLOATS)

    return Floats(lanes, types.int32), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Store to LANES consecutive elements of a contiguous float32 or int32 array, from `index` on; no bounds check."""

    def codegen(context, builder, signature, args):
        pointer = _address(context, builder, signature.args[0], args[0], args[1], signature.args[2].vector)
        builder.store(args[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


def _binary(name):
    @intrinsic
    def operation(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return getattr(builder, name)(args[0], args[1], flags=_FLAGS)

        return Floats(Floats, Floats), codegen

    return operation


_add, _sub, _mul, _div = _binary("fadd"), _binary("fsub"), _binary("fmul"), _binary("fdiv")


def _overload_operator(symbol, implementation):
    @overload(symbol)
    def lanes_operator(a, b):
        if a is Floats and b is Floats:
            return lambda a, b: implementation(a, b)
        return None


for _symbol, _implementation in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
    (operator.iadd, _add),
    (operator.isub, _sub),
    (operator.imul, _mul),
):
    _overload_operator(_symbol, _implementation)


@intrinsic
def at_least(typingctx, a, b):
    """Return a >= b, lane by lane (false for NaN)."""

    def codegen(context, builder, signature, args):
        return builder.fcmp_ordered(">=", args[0], args[1])

    return Mask(Floats, Floats), codegen


@intrinsic
def above(typingctx, a, b):
    """Return a > b, lane by lane (false for NaN)."""

    def codegen(context, builder, signature, args):
        return builder.fcmp_ordered(">", args[0], args[1])

    return Mask(Floats, Floats), codegen


@intrinsic
def equal_i(typingctx, a, b):
    """Return a == b for integer lanes."""

    def codegen(context, builder, signature, args):
        return builder.icmp_signed("==", args[0], args[1])

    return Mask(Ints, Ints), codegen


@intrinsic
def both(typingctx, a, b):
    """Return the logical and of two masks."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], args[1])

    return Mask(Mask, Mask), codegen


@intrinsic
def either(typingctx, a, b):
    """Return the logical or of two masks."""

    def codegen(context, builder, signature, args):
        return builder.or_(args[0], args[1])

    return Mask(Mask, Mask), codegen


@intrinsic
def where(typingctx, mask, a, b):
    """Select a where the mask is true, otherwise b."""

    def codegen(context, builder, signature, args):
        return builder.select(args[0], args[1], args[2])

    return Floats(Mask, Floats, Floats), codegen


@intrinsic
def where_i(typingctx, mask, a, b):
    """Select a where the mask is true, otherwise b, for integer lanes."""

    def codegen(context, builder, signature, args):
        return builder.select(args[0], args[1], args[2])

    return Ints(Mask, Ints, Ints), codegen


@intrinsic
def keep(typingctx, mask, a):
    """Select a where the mask is true, otherwise 0."""

    def codegen(context, builder, signature, args):
        return builder.select(args[0], args[1], _constant(0.0))

    return Floats(Mask, Floats), codegen


@intrinsic
def any_lane(typingctx, mask):
    """Return whether the mask is true in any lane."""

    def codegen(context, builder, signature, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(Mask), codegen


def _minmax(symbol):
    @intrinsic
    def operation(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return builder.select(builder.fcmp_ordered(symbol, args[0], args[1]), args[0], args[1])

        return Floats(Floats, Floats), codegen

    return operation


minimum = _minmax("<")
maximum = _minmax(">")


def _unary(name, doc):
    def operation(typingctx, a):
        def codegen(context, builder, signature, args):
            kind = ir.FunctionType(_FLOATS, [_FLOATS])
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
            return builder.call(function, args)

        return Floats(Floats), codegen

    operation.__doc__ = doc
    return intrinsic(operation)


sqrt = _unary("sqrt", "Return the square root of each lane.")
whole = _unary("trunc", "Round each lane towards 0.")


@intrinsic
def truncate(typingctx, a):
    """Convert the lanes to int32, rounded towards 0."""

    def codegen(context, builder, signature, args):
        return builder.fptosi(args[0], _INTS)

    return Ints(Floats), codegen


@intrinsic
def total(typingctx, a):
    """Return the sum of the lanes as a float32, in a fixed tree order."""

    def codegen(context, builder, signature, args):
        value = args[0]
        undefined = ir.Constant(_FLOATS, ir.Undefined)
        for half in (LANES >> s for s in range(1, LANES.bit_length())):
            index = [(i + half) % LANES for i in range(LANES)]
            picks = ir.Constant(ir.VectorType(ir.IntType(32), LANES), index)
            value = builder.fadd(value, builder.shuffle_vector(value, undefined, picks))
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(Floats), codegen


@intrinsic
def totals(typingctx, sums):
    """Return a vector whose lane i is the sum of the lanes of sums[i] (up to LANES), in a fixed tree order."""
    if not isinstance(sums, types.UniTuple) or sums.count > LANES:
        return None

    def codegen(context, builder, signature, args):
        rows = [builder.extract_value(args[0], i) for i in range(sums.count)]
        # Each round adds the two halves of each block of lanes and combines pairs of vectors into one.
        half = LANES // 2
        while half:
            sides = [block + side * LANES for block in range(0, LANES, 2 * half) for side in (0, 1)]
            picks = [
                ir.Constant(ir.VectorType(ir.IntType(32), LANES), [s + i + shift for s in sides for i in range(half)])
                for shift in (0, half)
            ]
            pairs = [
                (row, rows[i + half] if i + half < len(rows) else _constant(0.0)) for i, row in enumerate(rows[:half])
            ]
            rows = [builder.fadd(*(builder.shuffle_vector(a, b, p) for p in picks)) for a, b in pairs]
            half //= 2
        return rows[0]

    return Floats(sums), codegen


# 2**f on [-1/2, 1/2]: minimax polynomial of degree 5, largest relative error 7.5e-8 before rounding.
_EXP2 = (1.3276461277e-3, 9.6755411419e-3, 5.5507133056e-2, 2.4022119729e-1, 6.9314696705e-1, 1.0000000717)


@intrinsic
def exp2(typingctx, a):
    """Return 2**a for a in [-126, 127]; smaller a are clamped to -126. Relative error below 3e-7."""

    def codegen(context, builder, signature, args):
        low = _constant(-126.0)
        x = builder.select(builder.fcmp_ordered(">", args[0], low), args[0], low)
        # After adding 1.5 * 2**23, the low bits of the significand are round(x).
        magic = _constant(12582912.0)
        shifted = builder.fadd(x, magic)
        fraction = builder.fsub(x, builder.fsub(shifted, magic))
        result = _constant(_EXP2[0])
        for coefficient in _EXP2[1:]:
            result = builder.fadd(builder.fmul(result, fraction, flags=_FLAGS), _constant(coefficient), flags=_FLAGS)
        exponent = builder.shl(builder.bitcast(shifted, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(result, _INTS), exponent), _FLOATS)

    return Floats(Floats), codegen
