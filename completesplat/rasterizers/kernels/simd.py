"""Vectors of 16 float32 lanes inside numba kernels.

They are lowered to LLVM's `<16 x float>`, which LLVM maps to whatever the processor has (AVX-512, AVX2, SSE2,
NEON), so speed does not depend on the auto-vectoriser and no C compiler is needed. Arithmetic between vectors, and
between a vector and a float32 scalar, is written with the usual operators; comparisons give a mask.
"""

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
FLAGS = ("contract", "nsz", "arcp", "reassoc", "afn")  # as in `compilation.OPTIONS`

F32, I32 = ir.FloatType(), ir.IntType(32)
VECTOR_IR, INTEGERS_IR = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Float32x{LANES}")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Mask{LANES}")


VECTOR, MASK = _VectorType(), _MaskType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: types.Type) -> None:
        super().__init__(manager, type_, VECTOR_IR)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: types.Type) -> None:
        super().__init__(manager, type_, ir.VectorType(ir.IntType(1), LANES))


def _constant(values: Any) -> ir.Constant:
    return ir.Constant(VECTOR_IR, [ir.Constant(F32, float(value)) for value in values])


def _uniform(value: float) -> ir.Constant:
    return _constant([value] * LANES)


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(VECTOR_IR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS_IR, [0] * LANES))


def _as_vector(context: Any, builder: Any, value: Any, type_: types.Type) -> Any:
    return value if type_ == VECTOR else _broadcast(builder, context.cast(builder, value, type_, types.float32))


def _vectors(context: Any, builder: Any, signature: Any, values: Any) -> list:
    return [_as_vector(context, builder, v, t) for v, t in zip(values, signature.args, strict=True)]


def _call(builder: Any, name: str, result: ir.Type, *arguments: Any) -> Any:
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments, fastmath=FLAGS)


# Operators. ---------------------------------------------------------------------------------------------------------


def _define_operator(function: Any, result: types.Type, emit: Any) -> None:
    @type_callable(function)
    def typing(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            pair = (a, b)
            valid = VECTOR in pair and all(t == VECTOR or isinstance(t, types.Float) for t in pair)
            return result if valid else None

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return emit(builder, *_vectors(context, builder, signature, values))

    for kinds in ((_VectorType, _VectorType), (_VectorType, types.Float), (types.Float, _VectorType)):
        lower_builtin(function, *kinds)(lower)


_define_operator(operator.add, VECTOR, lambda builder, a, b: builder.fadd(a, b, flags=FLAGS))
_define_operator(operator.sub, VECTOR, lambda builder, a, b: builder.fsub(a, b, flags=FLAGS))
_define_operator(operator.mul, VECTOR, lambda builder, a, b: builder.fmul(a, b, flags=FLAGS))
_define_operator(operator.truediv, VECTOR, lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS))
_define_operator(operator.gt, MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define_operator(operator.ge, MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define_operator(operator.le, MASK, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))


@type_callable(operator.and_)
def _type_and(context: Any) -> Any:
    return lambda a, b: MASK if a == MASK and b == MASK else None


@lower_builtin(operator.and_, _MaskType, _MaskType)
def _lower_and(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.and_(*values)


# Functions. ---------------------------------------------------------------------------------------------------------


def lane_constant(values: Any) -> Any:
    """A function without arguments that returns these 16 lanes."""
    vector = _constant(values)

    @intrinsic
    def constant(typing_context: Any) -> Any:
        return VECTOR(), lambda context, builder, signature, values: vector

    return constant


@intrinsic
def splat(typing_context: Any, scalar: Any) -> Any:
    """The scalar in every lane."""
    return VECTOR(scalar), lambda *args: _vectors(*args)[0]


def _address(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, values[0])
    offset = context.cast(builder, values[1], signature.args[1], types.intp)
    return builder.bitcast(builder.gep(array.data, [offset], inbounds=True), VECTOR_IR.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, offset: Any) -> Any:
    """16 floats of a flat float32 array, from element `offset` on."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(_address(context, builder, signature, values), align=4)

    return VECTOR(array, offset), emit


@intrinsic
def store(typing_context: Any, array: Any, offset: Any, vector: Any) -> Any:
    """Write 16 floats into a flat float32 array, from element `offset` on."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store(values[2], _address(context, builder, signature, values), align=4)
        return context.get_dummy_value()

    return types.void(array, offset, VECTOR), emit


def _extremum(predicate: str) -> Any:
    # The second operand wins where the first is NaN, as in the processors' own min and max instructions.
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = _vectors(context, builder, signature, values)
        return builder.select(builder.fcmp_ordered(predicate, a, b), a, b)

    return emit


@intrinsic
def minimum(typing_context: Any, a: Any, b: Any) -> Any:
    """The smaller of two, lane by lane; `b` where `a` is NaN."""
    return VECTOR(a, b), _extremum("<")


@intrinsic
def maximum(typing_context: Any, a: Any, b: Any) -> Any:
    """The larger of two, lane by lane; `b` where `a` is NaN."""
    return VECTOR(a, b), _extremum(">")


@intrinsic
def keep(typing_context: Any, mask: Any, vector: Any) -> Any:
    """The vector where the mask is set, zero elsewhere."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.select(values[0], values[1], _uniform(0))

    return VECTOR(MASK, VECTOR), emit


@intrinsic
def any_lane(typing_context: Any, mask: Any) -> Any:
    """Whether the mask is set anywhere."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(MASK), emit


@intrinsic
def square_root(typing_context: Any, vector: Any) -> Any:
    """The square root of every lane."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _call(builder, f"llvm.sqrt.v{LANES}f32", VECTOR_IR, values[0])

    return VECTOR(VECTOR), emit


_ROUNDING_SHIFT = 1.5 * 2**23  # x + this is rounded to an integer, which sits in the low bits of the sum
_EXP2_POLYNOMIAL = (
    np.polynomial.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5]).convert(kind=np.polynomial.Polynomial).coef
)


@intrinsic
def exp2(typing_context: Any, vector: Any) -> Any:
    """2^x to about 1e-7, for x from -126 to 127; meaningless (but harmless) outside.

    x is split into an integer, added to the exponent bits, and a rest in [-1/2, 1/2], put into a polynomial.
    """

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        (x,) = values
        shift = _uniform(_ROUNDING_SHIFT)
        rounded = builder.fadd(x, shift)  # without flags: (x + s) - s must not be simplified to x
        rest = builder.fsub(x, builder.fsub(rounded, shift))
        power = _uniform(_EXP2_POLYNOMIAL[-1])
        for coefficient in _EXP2_POLYNOMIAL[-2::-1]:
            power = builder.fadd(builder.fmul(power, rest, flags=FLAGS), _uniform(coefficient), flags=FLAGS)
        exponent = builder.shl(builder.bitcast(rounded, INTEGERS_IR), ir.Constant(INTEGERS_IR, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, INTEGERS_IR), exponent), VECTOR_IR)

    return VECTOR(VECTOR), emit


@intrinsic
def lane_sums(typing_context: Any, vectors: Any) -> Any:
    """From a tuple of up to 16 vectors, the vector whose lane i is the sum over all lanes of vector i; rest zero."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        rows = cgutils.unpack_tuple(builder, values[0])
        rows += [_uniform(0)] * (LANES - len(rows))
        step = 1
        while len(rows) > 1:  # each round adds two lanes of every row and interleaves neighbouring rows
            rows = [_fold(builder, a, b, step) for a, b in zip(rows[::2], rows[1::2], strict=True)]
            step *= 2
        return rows[0]

    return VECTOR(vectors), emit


def _fold(builder: Any, a: Any, b: Any, step: int) -> Any:
    kept = [lane if not lane & step else LANES + lane for lane in range(LANES)]
    partner = [(lane ^ step) if not lane & step else LANES + (lane ^ step) for lane in range(LANES)]
    halves = [builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, order)) for order in (kept, partner)]
    return builder.fadd(*halves, flags=FLAGS)


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Index of the lowest set bit of a nonzero uint64."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word, is_poison = ir.IntType(64), ir.Constant(ir.IntType(1), 1)
        kind = ir.FunctionType(word, [word, is_poison.type])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.cttz.i64")
        return builder.call(function, [values[0], is_poison])

    return types.int64(types.uint64), emit
