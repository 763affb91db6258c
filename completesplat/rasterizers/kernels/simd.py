"""A vector of 16 float32 lanes that numba kernels can hold in a variable, and functions of it."""

import inspect
import operator
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from completesplat.rasterizers.kernels.array_layout import BLOCK_SHIFT

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


class LanesType(types.Type):
    """16 numbers (float32) or booleans."""

    def __init__(self, name: str, element: Any) -> None:
        super().__init__(name=f"{name}x{LANES}")
        self.llvm = ir.VectorType(element, LANES)


VECTOR, MASK = LanesType("Float32", F32), LanesType("Mask", ir.IntType(1))


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: Any) -> None:
        super().__init__(manager, type_, type_.llvm)  # type: ignore[no-untyped-call]


def constant(values: Any) -> ir.Constant:
    """LLVM's constant vector of 16 numbers."""
    return ir.Constant(VECTOR_IR, [ir.Constant(F32, float(value)) for value in values])


def uniform(value: float) -> ir.Constant:
    """LLVM's constant vector with the same number in every lane."""
    return constant([value] * LANES)


def vector_function(result: Any) -> Callable[[Callable[..., Any]], Any]:
    """Turn `emit(builder, *operands)`, which writes LLVM code, into a function for kernels with this type of result.

    What a kernel passes to it arrives so: an array as the address of its first element, an integer as one of 64 bits,
    any other scalar in every lane. A list of what it returns becomes a tuple. `result` may be a function of the
    operands' types that returns the signature.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        def function(typing_context: Any, *operands: Any) -> Any:
            return result(*operands), _generator(emit)

        function.__name__ = emit.__name__
        function.__signature__ = inspect.signature(emit)  # type: ignore[attr-defined]  # numba needs fixed operands
        return intrinsic(function)

    return decorate


def _generator(emit: Callable[..., Any]) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pairs = zip(values, signature.args, strict=True)
        found = emit(builder, *(_operand(context, builder, value, type_) for value, type_ in pairs))
        if isinstance(found, list):
            return context.make_tuple(builder, signature.return_type, found)
        return context.get_dummy_value() if signature.return_type == types.void else found

    return generate


def _operand(context: Any, builder: Any, value: Any, type_: Any) -> Any:
    if isinstance(type_, types.Array):
        return context.make_array(type_)(context, builder, value).data
    if isinstance(type_, types.Integer):
        return context.cast(builder, value, type_, types.intp)
    if not isinstance(type_, types.Float):
        return value
    undefined = ir.Constant(VECTOR_IR, ir.Undefined)
    scalar = context.cast(builder, value, type_, types.float32)
    first = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS_IR, [0] * LANES))


def _define_operator(function: Any, result: Any, emit: Callable[..., Any], kind: Any = VECTOR, count: int = 2) -> None:
    """Give a Python operator of this number of operands its meaning for vectors, with scalars beside them, or masks."""

    def type_of(*operands: Any) -> Any:
        return result if kind in operands and all(t == kind or isinstance(t, types.Float) for t in operands) else None

    # numba needs fixed operands.
    typer = (lambda a: type_of(a)) if count == 1 else (lambda a, b: type_of(a, b))
    type_callable(function)(lambda context: typer)  # type: ignore[no-untyped-call]
    for kinds in product((kind, types.Float), repeat=count):
        if kind in kinds:
            lower_builtin(function, *kinds)(_generator(emit))


_define_operator(operator.add, VECTOR, lambda builder, a, b: builder.fadd(a, b, flags=FLAGS))
_define_operator(operator.sub, VECTOR, lambda builder, a, b: builder.fsub(a, b, flags=FLAGS))
_define_operator(operator.mul, VECTOR, lambda builder, a, b: builder.fmul(a, b, flags=FLAGS))
_define_operator(operator.truediv, VECTOR, lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS))
_define_operator(operator.gt, MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define_operator(operator.ge, MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define_operator(operator.le, MASK, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_define_operator(operator.neg, VECTOR, lambda builder, a: builder.fneg(a), count=1)
_define_operator(operator.and_, MASK, lambda builder, a, b: builder.and_(a, b), MASK)
# Of two numbers of which one is NaN, these give the second, as the processors' own instructions do.
_define_operator(max, VECTOR, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_define_operator(min, VECTOR, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))


def _vectors(count: int) -> Any:
    return types.UniTuple(VECTOR, count)  # type: ignore[no-untyped-call]


def lane_constant(values: Any) -> Any:
    """A function without arguments that returns these 16 lanes."""
    vector = constant(values)
    return vector_function(VECTOR)(lambda builder: vector)


def zeros(count: int) -> Any:
    """A function without arguments that returns a tuple of so many vectors of zeros."""
    return vector_function(_vectors(count))(lambda builder: [uniform(0)] * count)


@vector_function(VECTOR)
def splat(builder: Any, scalar: Any) -> Any:
    """The scalar in every lane."""
    return scalar


@vector_function(VECTOR)
def keep(builder: Any, mask: Any, vector: Any) -> Any:
    """The vector where the mask is set, zero elsewhere."""
    return builder.select(mask, vector, uniform(0))


@vector_function(lambda mask, vectors: vectors(mask, vectors))
def keep_each(builder: Any, mask: Any, vectors: Any) -> Any:
    """`keep` for every vector of a tuple."""
    return [builder.select(mask, one, uniform(0)) for one in _unpack(builder, vectors)]


@vector_function(lambda a, b: a(a, b))
def add_each(builder: Any, a: Any, b: Any) -> Any:
    """The sums of two tuples of vectors."""
    return [builder.fadd(x, y, flags=FLAGS) for x, y in zip(_unpack(builder, a), _unpack(builder, b), strict=True)]


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
    rows = _unpack(builder, vectors)
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
    function = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
    return builder.call(function, arguments)


def _unpack(builder: Any, values: Any) -> list[Any]:
    return list(cgutils.unpack_tuple(builder, values))  # type: ignore[no-untyped-call]


# None of the following checks bounds.


@vector_function(VECTOR)
def load(builder: Any, array: Any, offset: Any) -> Any:
    """16 floats of a flat float32 array, from element `offset` on."""
    return builder.load(_at(builder, array, offset, VECTOR_IR), align=4)


@vector_function(types.void)
def store(builder: Any, array: Any, offset: Any, vector: Any) -> None:
    """The reverse of `load`."""
    builder.store(vector, _at(builder, array, offset, VECTOR_IR), align=4)


@vector_function(types.void)
def store_blocks(builder: Any, array: Any, offset: Any, vector: Any) -> None:
    """Pixels, truncated to integers, as the numbers of their blocks, to a flat int32 array."""
    places = ir.Constant(INTEGERS_IR, [BLOCK_SHIFT] * LANES)
    blocks = builder.ashr(builder.fptosi(vector, INTEGERS_IR), places)
    builder.store(blocks, _at(builder, array, offset, INTEGERS_IR), align=4)


def _at(builder: Any, array: Any, offset: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(array, [offset], inbounds=True), kind.as_pointer())


def gather(count: int) -> Any:
    """A function (array, stride, column, start, last) that returns so many neighbouring columns of a flat array.

    The first is array[i * stride + column] for i = start, ..., start + 15, with last - 1 for any i beyond that.
    """

    @vector_function(_vectors(count))
    def gather(builder: Any, array: Any, stride: Any, column: Any, start: Any, last: Any) -> Any:
        vectors = [ir.Constant(VECTOR_IR, ir.Undefined)] * count
        firsts = _rows(builder, stride, start, last)
        for k, (lane, first) in product(range(count), enumerate(firsts)):
            place = builder.add(builder.add(first, column), ir.Constant(first.type, k))
            value = builder.load(builder.gep(array, [place], inbounds=True))
            vectors[k] = builder.insert_element(vectors[k], value, ir.Constant(I32, lane))
        return vectors

    return gather


@vector_function(_vectors(LANES))
def transposed_rows(builder: Any, array: Any, stride: Any, start: Any, last: Any) -> Any:
    """As `gather(16)` from column 0 on, by loads of whole rows."""
    matrix = [
        builder.load(_at(builder, array, first, VECTOR_IR), align=4) for first in _rows(builder, stride, start, last)
    ]
    for step in (1, 2, 4, 8):  # each round swaps the off-diagonal squares of this size
        for i in (i for i in range(LANES) if not i & step):
            a, b = matrix[i], matrix[i + step]
            upper = [LANES + lane - step if lane & step else lane for lane in range(LANES)]
            lower = [LANES + lane if lane & step else lane + step for lane in range(LANES)]
            matrix[i] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, upper))
            matrix[i + step] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, lower))
    return matrix


def _rows(builder: Any, stride: Any, start: Any, last: Any) -> list[Any]:
    """Where the rows start, ..., start + 15 of a flat array begin; row last - 1 instead of those beyond it."""
    final = builder.sub(last, ir.Constant(last.type, 1))
    numbers = [builder.add(start, ir.Constant(start.type, lane)) for lane in range(LANES)]
    return [builder.mul(builder.select(builder.icmp_signed("<", i, final), i, final), stride) for i in numbers]
