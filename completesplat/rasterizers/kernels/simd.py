"""A vector of 16 float32 lanes that numba kernels can hold in a variable, and functions of it."""

import inspect
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
FLAGS = ("contract", "nsz", "arcp", "reassoc", "afn")  # as in `compilation.OPTIONS`

F32, I32 = ir.FloatType(), ir.IntType(32)
VECTOR_IR, INTEGERS_IR = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)
# x + 1.5 * 2^23 has its last bit at 1, so it is rounded to an integer, which sits in the low bits of the sum.
_ROUNDING_SHIFT = 1.5 * 2**23
_ROUNDING_BITS = int(np.float32(_ROUNDING_SHIFT).view(np.int32))
_EXP2_POLYNOMIAL = (
    np.polynomial.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5]).convert(kind=np.polynomial.Polynomial).coef
)


class VectorType(types.Type):
    """16 float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name=f"Float32x{LANES}")


class MaskType(types.Type):
    """16 booleans."""

    def __init__(self) -> None:
        super().__init__(name=f"Mask{LANES}")


VECTOR, MASK = VectorType(), MaskType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: types.Type) -> None:
        super().__init__(manager, type_, VECTOR_IR)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: types.Type) -> None:
        super().__init__(manager, type_, ir.VectorType(ir.IntType(1), LANES))


def constant(values: Any) -> ir.Constant:
    """LLVM's constant vector of 16 numbers."""
    return ir.Constant(VECTOR_IR, [ir.Constant(F32, float(value)) for value in values])


def uniform(value: float) -> ir.Constant:
    """LLVM's constant vector with the same number in every lane."""
    return constant([value] * LANES)


def vector_function(result: types.Type) -> Callable[[Callable], Any]:
    """Turn `emit(builder, *operands)`, which writes LLVM code for vectors and masks, into a function for kernels.

    Scalars that a kernel passes to it are broadcast.
    """

    def decorate(emit: Callable) -> Any:
        def function(typing_context: Any, *operands: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                return emit(builder, *_broadcast_scalars(context, builder, signature, values))

            return result(*operands), generate

        function.__name__ = emit.__name__
        function.__signature__ = inspect.signature(emit)  # type: ignore[attr-defined]  # numba needs fixed operands
        return intrinsic(function)

    return decorate


def _broadcast_scalars(context: Any, builder: Any, signature: Any, values: Any) -> list:
    pairs = zip(values, signature.args, strict=True)
    return [_broadcast(context, builder, v, t) if isinstance(t, types.Float) else v for v, t in pairs]


def _broadcast(context: Any, builder: Any, value: Any, type_: types.Type) -> Any:
    undefined = ir.Constant(VECTOR_IR, ir.Undefined)
    scalar = context.cast(builder, value, type_, types.float32)
    first = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS_IR, [0] * LANES))


def _define_operator(function: Callable, result: types.Type, emit: Callable) -> None:
    @type_callable(function)
    def typing(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            valid = VECTOR in (a, b) and all(t == VECTOR or isinstance(t, types.Float) for t in (a, b))
            return result if valid else None

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return emit(builder, *_broadcast_scalars(context, builder, signature, values))

    for kinds in ((VectorType, VectorType), (VectorType, types.Float), (types.Float, VectorType)):
        lower_builtin(function, *kinds)(lower)


_define_operator(operator.add, VECTOR, lambda builder, a, b: builder.fadd(a, b, flags=FLAGS))
_define_operator(operator.sub, VECTOR, lambda builder, a, b: builder.fsub(a, b, flags=FLAGS))
_define_operator(operator.mul, VECTOR, lambda builder, a, b: builder.fmul(a, b, flags=FLAGS))
_define_operator(operator.truediv, VECTOR, lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS))
_define_operator(operator.gt, MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define_operator(operator.ge, MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define_operator(operator.le, MASK, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
# Of two numbers of which one is NaN, these give the second, as the processors' own instructions do.
_define_operator(max, VECTOR, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_define_operator(min, VECTOR, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))


@type_callable(operator.neg)
def _type_neg(context: Any) -> Any:
    return lambda a: VECTOR if a == VECTOR else None


@lower_builtin(operator.neg, VectorType)
def _lower_neg(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.fneg(values[0])


@type_callable(operator.and_)
def _type_and(context: Any) -> Any:
    return lambda a, b: MASK if a == MASK and b == MASK else None


@lower_builtin(operator.and_, MaskType, MaskType)
def _lower_and(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.and_(*values)


def lane_constant(values: Any) -> Any:
    """A function without arguments that returns these 16 lanes."""
    vector = constant(values)

    @vector_function(VECTOR)
    def lanes(builder: Any) -> Any:
        return vector

    return lanes


@vector_function(VECTOR)
def splat(builder: Any, scalar: Any) -> Any:
    """The scalar in every lane."""
    return scalar


@vector_function(VECTOR)
def keep(builder: Any, mask: Any, vector: Any) -> Any:
    """The vector where the mask is set, zero elsewhere."""
    return builder.select(mask, vector, uniform(0))


@vector_function(types.boolean)
def any_lane(builder: Any, mask: Any) -> Any:
    """Whether the mask is set anywhere."""
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@vector_function(VECTOR)
def square_root(builder: Any, vector: Any) -> Any:
    """The square root of every lane."""
    return _call(builder, f"llvm.sqrt.v{LANES}f32", VECTOR_IR, vector)


@vector_function(VECTOR)
def exp2(builder: Any, x: Any) -> Any:
    """2^x with a relative error of 2e-7, for x from -126 to 127; meaningless (but harmless) outside.

    x is split into an integer, added to the exponent bits, and a rest in [-1/2, 1/2], put into a polynomial.
    """
    shifted = builder.bitcast(builder.fadd(x, uniform(_ROUNDING_SHIFT)), INTEGERS_IR)
    # Back by an integer operation: numba lets all floating-point ones be reassociated, (x + s) - s to x as well.
    whole = builder.sub(shifted, ir.Constant(INTEGERS_IR, [_ROUNDING_BITS] * LANES))
    rest = builder.fsub(x, builder.sitofp(whole, VECTOR_IR), flags=FLAGS)
    power = uniform(_EXP2_POLYNOMIAL[-1])
    for coefficient in _EXP2_POLYNOMIAL[-2::-1]:
        power = builder.fadd(builder.fmul(power, rest, flags=FLAGS), uniform(coefficient), flags=FLAGS)
    exponent = builder.shl(whole, ir.Constant(INTEGERS_IR, [23] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(power, INTEGERS_IR), exponent), VECTOR_IR)


@vector_function(VECTOR)
def lane_sums(builder: Any, vectors: Any) -> Any:
    """From a tuple of up to 16 vectors, the vector whose lane i is the sum over all lanes of vector i; rest zero."""
    rows = cgutils.unpack_tuple(builder, vectors)
    rows += [uniform(0)] * (LANES - len(rows))
    step = 1
    while len(rows) > 1:  # each round adds two lanes of every row and interleaves neighbouring rows
        rows = [_fold(builder, a, b, step) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        step *= 2
    return rows[0]


def _fold(builder: Any, a: Any, b: Any, step: int) -> Any:
    kept = [LANES + lane if lane & step else lane for lane in range(LANES)]
    partner = [LANES + (lane ^ step) if lane & step else (lane ^ step) for lane in range(LANES)]
    halves = [builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, order)) for order in (kept, partner)]
    return builder.fadd(*halves, flags=FLAGS)


@vector_function(types.int64)
def lowest_bit(builder: Any, bits: Any) -> Any:
    """Index of the lowest set bit of a nonzero uint64."""
    return _call(builder, "llvm.cttz.i64", bits.type, bits, ir.Constant(ir.IntType(1), 1))


def _call(builder: Any, name: str, result: ir.Type, *arguments: Any) -> Any:
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _load(typing_context: Any, array: Any, offset: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(_address(context, builder, signature, values), align=4)

    return VECTOR(array, offset), emit


def _store(typing_context: Any, array: Any, offset: Any, vector: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store(values[2], _address(context, builder, signature, values), align=4)
        return context.get_dummy_value()

    return types.void(array, offset, VECTOR), emit


def _address(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, values[0])
    offset = context.cast(builder, values[1], signature.args[1], types.intp)
    return builder.bitcast(builder.gep(array.data, [offset], inbounds=True), VECTOR_IR.as_pointer())


def _store_shifted(typing_context: Any, array: Any, offset: Any, vector: Any, shift: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        whole = builder.fptosi(values[2], INTEGERS_IR)
        places = ir.Constant(INTEGERS_IR, [shift.literal_value] * LANES)
        address = _address(context, builder, signature, values)
        builder.store(builder.ashr(whole, places), builder.bitcast(address, INTEGERS_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, offset, VECTOR, shift), emit


def _gather(typing_context: Any, array: Any, stride: Any, column: Any, start: Any, last: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        integers = [
            context.cast(builder, v, t, types.intp) for v, t in zip(values[1:], signature.args[1:], strict=True)
        ]
        width, first_column, begin, end = integers
        final = builder.sub(end, ir.Constant(end.type, 1))
        vector = ir.Constant(VECTOR_IR, ir.Undefined)
        for lane in range(LANES):
            i = builder.add(begin, ir.Constant(begin.type, lane))
            i = builder.select(builder.icmp_signed("<", i, final), i, final)
            address = builder.gep(data, [builder.add(builder.mul(i, width), first_column)], inbounds=True)
            vector = builder.insert_element(vector, builder.load(address), ir.Constant(I32, lane))
        return vector

    return VECTOR(array, stride, column, start, last), emit


def _transpose(typing_context: Any, rows: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        matrix = cgutils.unpack_tuple(builder, values[0])
        for step in (1, 2, 4, 8):  # each round swaps the off-diagonal squares of this size
            for i in (i for i in range(LANES) if not i & step):
                a, b = matrix[i], matrix[i + step]
                upper = [LANES + lane - step if lane & step else lane for lane in range(LANES)]
                lower = [LANES + lane if lane & step else lane + step for lane in range(LANES)]
                matrix[i] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, upper))
                matrix[i + step] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, lower))
        return context.make_tuple(builder, signature.return_type, matrix)

    return types.UniTuple(VECTOR, LANES)(rows), emit


# load(array, offset): 16 floats of a flat float32 array, from element `offset` on.
# store(array, offset, vector): the reverse.
# store_shifted(array, offset, vector, shift): the lanes, truncated to integers and shifted down, to a flat int32 array.
# gather(array, stride, column, start, last): array[i * stride + column] of a flat array for i = start, ..., start + 15;
# for i = last - 1 in the lanes beyond that.
# None of them checks bounds.
# transpose(rows): from a tuple of 16 vectors, the tuple whose vector i has lane i of each.
load: Any = intrinsic(_load)
store: Any = intrinsic(_store)
store_shifted: Any = intrinsic(prefer_literal=True)(_store_shifted)
gather: Any = intrinsic(_gather)
transpose: Any = intrinsic(_transpose)
