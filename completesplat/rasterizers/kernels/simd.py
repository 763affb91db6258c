"""Vectors of 16 lanes, float32 or float64, for variables in numba kernels, and functions of them."""

import inspect
import operator
from functools import reduce
from itertools import product

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
FLAGS = ("contract", "nsz", "arcp", "reassoc", "afn")  # as in `compilation.OPTIONS`

F32 = ir.FloatType()
F64 = ir.DoubleType()
I32 = ir.IntType(32)
I64 = ir.IntType(64)
VECTOR_IR = ir.VectorType(F32, LANES)
INTEGERS_IR = ir.VectorType(I32, LANES)
# The sum x + 1.5 * 2^23 is rounded to an integer, because the last bit of its fraction has the value 1. Minus the bits
# of 1.5 * 2^23, the bits of the sum are the rounded x as int32.
_ROUNDING_SHIFT = 1.5 * 2**23
_ROUNDING_BITS = int(np.float32(_ROUNDING_SHIFT).view(np.int32))
_EXP2 = np.polynomial.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5])
_EXP2_POLYNOMIAL = _EXP2.convert(kind=np.polynomial.Polynomial).coef


class LanesType(types.Type):
    """Type of a vector of 16 numbers or booleans."""

    def __init__(self, name, element):
        super().__init__(name=f"{name}x{LANES}")
        self.llvm = ir.VectorType(element, LANES)


VECTOR = LanesType("Float32", F32)
DOUBLES = LanesType("Float64", F64)
MASK = LanesType("Mask", ir.IntType(1))


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, type_):
        super().__init__(manager, type_, type_.llvm)


def constant(values):
    """Return LLVM's constant vector of 16 numbers."""
    return ir.Constant(VECTOR_IR, [ir.Constant(F32, float(value)) for value in values])


def uniform(value):
    """Return LLVM's constant vector with the same number in every lane."""
    return constant([value] * LANES)


def vector_function(result):
    """Turn `emit(builder, *operands)`, which writes LLVM code, into a function for kernels with this type of result.

    A kernel's arguments arrive in `emit` as follows: an array as the address of its first element, an integer with 64
    bits, any other scalar in every lane (as float64 beside a vector of float64, else as float32). A list that `emit`
    returns becomes a tuple. `result` may be a function of the operands' types that returns the signature.
    """

    def decorate(emit):
        def function(typing_context, *operands):
            return result(*operands), _generator(emit)

        function.__name__ = emit.__name__
        function.__signature__ = inspect.signature(emit)  # type: ignore[attr-defined]  # numba needs fixed operands
        return intrinsic(function)

    return decorate


def _generator(emit):
    def generate(context, builder, signature, values):
        pairs = zip(values, signature.args, strict=True)
        wide = any(DOUBLES in (type_, getattr(type_, "dtype", None)) for type_ in signature.args)
        element = types.float64 if wide else types.float32
        code = emit(builder, *(_operand(context, builder, value, type_, element) for value, type_ in pairs))
        if isinstance(code, list):
            return context.make_tuple(builder, signature.return_type, code)
        return context.get_dummy_value() if signature.return_type == types.void else code

    return generate


def _operand(context, builder, value, type_, element):
    if isinstance(type_, types.Array):
        return context.make_array(type_)(context, builder, value).data
    if isinstance(type_, types.Integer):
        return context.cast(builder, value, type_, types.intp)
    if not isinstance(type_, types.Float):
        return value
    return in_every_lane(builder, context.cast(builder, value, type_, element))


def in_every_lane(builder, scalar):
    """Return a vector with the scalar in every lane, for code in LLVM's terms."""
    undefined = ir.Constant(ir.VectorType(scalar.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS_IR, [0] * LANES))


def _define_operator(function, emit, mask=False, count=2):
    """Define a Python operator with `count` operands for vectors and scalars beside them.

    Args:
        mask: whether it returns a mask.
    """
    for kind in (VECTOR, DOUBLES):
        _define_for(kind, MASK if mask else kind, function, emit, count)


def _define_for(kind, result, function, emit, count=2):
    def type_of(*operands):
        return result if kind in operands and all(t == kind or isinstance(t, types.Float) for t in operands) else None

    # numba needs fixed operands.
    typer = (lambda a: type_of(a)) if count == 1 else (lambda a, b: type_of(a, b))
    type_callable(function)(lambda context: typer)
    for kinds in product((kind, types.Float), repeat=count):
        if kind in kinds:
            lower_builtin(function, *kinds)(_generator(emit))


_define_operator(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=FLAGS))
_define_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=FLAGS))
_define_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=FLAGS))
_define_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS))
_define_operator(operator.gt, lambda builder, a, b: builder.fcmp_ordered(">", a, b), mask=True)
_define_operator(operator.ge, lambda builder, a, b: builder.fcmp_ordered(">=", a, b), mask=True)
_define_operator(operator.le, lambda builder, a, b: builder.fcmp_ordered("<=", a, b), mask=True)
_define_operator(operator.lt, lambda builder, a, b: builder.fcmp_ordered("<", a, b), mask=True)
_define_operator(operator.neg, lambda builder, a: builder.fneg(a), count=1)
_define_for(MASK, MASK, operator.and_, lambda builder, a, b: builder.and_(a, b))
# If either operand is NaN, these return the second one, as the processor's instructions do.
_define_operator(max, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_define_operator(min, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))


def _vectors(count, kind=VECTOR):
    return types.UniTuple(kind, count)


def lane_constant(values):
    """Return a function without arguments that returns these 16 lanes."""
    vector = constant(values)
    return vector_function(VECTOR)(lambda builder: vector)


def zeros(count):
    """Return a function without arguments that returns a tuple of `count` vectors of zeros."""
    return vector_function(_vectors(count))(lambda builder: [uniform(0)] * count)


@vector_function(VECTOR)
def splat(builder, scalar):
    """Return a vector with the scalar in every lane."""
    return scalar


@vector_function(lambda mask, vector: vector(mask, vector))
def keep(builder, mask, vector):
    """Return the vector where the mask is set, zero elsewhere."""
    return builder.select(mask, vector, ir.Constant(vector.type, None))


@vector_function(lambda mask, vector, scalar: vector(mask, vector, scalar))
def choose(builder, mask, vector, scalar):
    """Return the vector where the mask is set, the scalar elsewhere."""
    return builder.select(mask, vector, scalar)


@vector_function(lambda vectors: _vectors(len(vectors), DOUBLES)(vectors))
def widen(builder, vectors):
    """Convert a tuple of vectors to float64."""
    return [builder.fpext(vector, DOUBLES.llvm) for vector in unpack(builder, vectors)]


@vector_function(lambda vectors: _vectors(len(vectors))(vectors))
def narrow(builder, vectors):
    """Convert a tuple of vectors from float64 to float32."""
    return [builder.fptrunc(vector, VECTOR_IR) for vector in unpack(builder, vectors)]


@vector_function(lambda mask, vectors: vectors(mask, vectors))
def keep_each(builder, mask, vectors):
    """Apply `keep` to every vector of a tuple."""
    return [builder.select(mask, vector, uniform(0)) for vector in unpack(builder, vectors)]


@vector_function(MASK)
def all_within(builder, vectors, limit):
    """Return a mask of the lanes in which no vector of a tuple is NaN or exceeds the limit in magnitude."""
    masks = [builder.fcmp_ordered("<=", _each(builder, "fabs", vector), limit) for vector in unpack(builder, vectors)]
    return reduce(builder.and_, masks)


@vector_function(lambda a, b: a(a, b))
def add_each(builder, a, b):
    """Add two tuples of vectors."""
    return [builder.fadd(x, y, flags=FLAGS) for x, y in zip(unpack(builder, a), unpack(builder, b), strict=True)]


@vector_function(types.boolean)
def any_lane(builder, mask):
    """Return whether the mask is set in any lane."""
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@vector_function(lambda vector: vector(vector))
def square_root(builder, vector):
    """Return the square root of every lane."""
    return _each(builder, "sqrt", vector)


@vector_function(VECTOR)
def exp2(builder, x):
    """Return 2^x with a relative error of 2e-7 for x from -126 to 127. Other results are meaningless, but harmless.

    x is split into an integer, which is added to the exponent bits, and a rest in [-1/2, 1/2] for a polynomial.
    """
    shifted = builder.bitcast(builder.fadd(x, uniform(_ROUNDING_SHIFT)), INTEGERS_IR)
    # Undo the shift in integers, because numba lets LLVM reassociate floating-point operations, also (x + s) - s to x.
    whole = builder.sub(shifted, ir.Constant(INTEGERS_IR, [_ROUNDING_BITS] * LANES))
    rest = builder.fsub(x, builder.sitofp(whole, VECTOR_IR), flags=FLAGS)
    power = uniform(_EXP2_POLYNOMIAL[-1])
    for coefficient in _EXP2_POLYNOMIAL[-2::-1]:
        power = builder.fadd(builder.fmul(power, rest, flags=FLAGS), uniform(coefficient), flags=FLAGS)
    exponent = builder.shl(whole, ir.Constant(INTEGERS_IR, [23] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(power, INTEGERS_IR), exponent), VECTOR_IR)


@vector_function(VECTOR)
def lane_sums(builder, vectors):
    """Return the vector whose lane i is the sum over vector i of a tuple of up to 16. Other lanes are zero."""
    rows = unpack(builder, vectors)
    rows += [uniform(0)] * (LANES - len(rows))
    step = 1
    while len(rows) > 1:  # each round adds two lanes of every row and interleaves neighbouring rows
        rows = [_fold(builder, a, b, step) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        step *= 2
    return rows[0]


def _fold(builder, a, b, step):
    chosen = [LANES + lane if lane & step else lane for lane in range(LANES)]
    partner = [LANES + (lane ^ step) if lane & step else (lane ^ step) for lane in range(LANES)]
    halves = [builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, order)) for order in (chosen, partner)]
    return builder.fadd(*halves, flags=FLAGS)


@vector_function(types.int64)
def lowest_bit(builder, bits):
    """Return the index of the lowest set bit of a nonzero uint64."""
    return builder.cttz(bits, ir.Constant(ir.IntType(1), 1))


def _each(builder, name, vector):
    """Apply LLVM's function of this name to every lane."""
    suffix = "f64" if vector.type == DOUBLES.llvm else "f32"
    kind = ir.FunctionType(vector.type, [vector.type])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}{suffix}")
    return builder.call(function, [vector])


def unpack(builder, values):
    """Return the elements of a tuple as a list."""
    return list(cgutils.unpack_tuple(builder, values))


# None of the following checks bounds.


@vector_function(VECTOR)
def load(builder, array, offset):
    """Load 16 floats of a flat float32 array, from element `offset` on."""
    return builder.load(address(builder, array, offset, VECTOR_IR), align=4)


@vector_function(types.void)
def store(builder, array, offset, vector):
    """Store a vector as `load` reads it."""
    builder.store(vector, address(builder, array, offset, VECTOR_IR), align=4)


def address(builder, array, offset, kind):
    """Return the address of element `offset`, as a pointer to this kind."""
    return builder.bitcast(builder.gep(array, [offset], inbounds=True), kind.as_pointer())


def gather(count):
    """Return a function (array, stride, column, start, end) that returns `count` neighbouring columns of an array.

    The first is array[i * stride + column] for i = start, ..., start + 15, with end - 1 for any i beyond that.
    """

    @vector_function(_vectors(count))
    def gather_columns(builder, array, stride, column, start, end):
        vectors = [ir.Constant(VECTOR_IR, ir.Undefined)] * count
        firsts = _rows(builder, stride, start, end)
        for k, (lane, first) in product(range(count), enumerate(firsts)):
            place = builder.add(builder.add(first, column), ir.Constant(first.type, k))
            value = builder.load(builder.gep(array, [place], inbounds=True))
            vectors[k] = builder.insert_element(vectors[k], value, ir.Constant(I32, lane))
        return vectors

    return gather_columns


@vector_function(types.void)
def scatter(builder, array, start, end, vectors):
    """Write vectors as `gather` reads them, one for each column. No row beyond end - 1 is written."""
    rows = unpack(builder, vectors)
    firsts = _rows(builder, ir.Constant(I64, len(rows)), start, end)
    # Backwards, so that the final write to row end - 1 is the right one.
    for lane, (k, vector) in product(reversed(range(LANES)), enumerate(rows)):
        value = builder.extract_element(vector, ir.Constant(I32, lane))
        place = builder.add(firsts[lane], ir.Constant(I64, k))
        builder.store(value, builder.gep(array, [place], inbounds=True))


def columns(count):
    """Return a function (array, stride, start) that returns 16 neighbours of each of `count` rows of a flat array."""

    @vector_function(_vectors(count))
    def load_columns(builder, array, stride, start):
        firsts = [builder.add(start, builder.mul(stride, ir.Constant(I64, k))) for k in range(count)]
        return [builder.load(address(builder, array, first, VECTOR_IR), align=4) for first in firsts]

    return load_columns


@vector_function(types.void)
def store_columns(builder, array, stride, start, vectors):
    """Store vectors as `columns` reads them."""
    for k, vector in enumerate(unpack(builder, vectors)):
        first = builder.add(start, builder.mul(stride, ir.Constant(I64, k)))
        builder.store(vector, address(builder, array, first, VECTOR_IR), align=4)


@vector_function(_vectors(LANES))
def gathered_rows(builder, array, places, start):
    """Return the 16 columns of the rows places[start] to places[start + 15], each 16 wide, of a flat array."""
    rows = []
    for lane in range(LANES):
        entry = builder.gep(places, [builder.add(start, ir.Constant(I64, lane))], inbounds=True)
        first = builder.mul(builder.sext(builder.load(entry), I64), ir.Constant(I64, LANES))
        rows.append(builder.load(address(builder, array, first, VECTOR_IR), align=4))
    return transposed(builder, rows)


def transposed(builder, rows):
    """Return the 16 columns of a matrix of 16 rows, as vectors."""
    matrix = list(rows)
    for step in (1, 2, 4, 8):  # each round swaps the off-diagonal squares of this size
        for i in (i for i in range(LANES) if not i & step):
            a = matrix[i]
            b = matrix[i + step]
            upper = [LANES + lane - step if lane & step else lane for lane in range(LANES)]
            lower = [LANES + lane if lane & step else lane + step for lane in range(LANES)]
            matrix[i] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, upper))
            matrix[i + step] = builder.shuffle_vector(a, b, ir.Constant(INTEGERS_IR, lower))
    return matrix


def _rows(builder, stride, start, end):
    """Return the offsets of the rows start, ..., start + 15 of a flat array. Row end - 1 replaces those beyond it."""
    final = builder.sub(end, ir.Constant(end.type, 1))
    numbers = [builder.add(start, ir.Constant(start.type, lane)) for lane in range(LANES)]
    return [builder.mul(builder.select(builder.icmp_signed("<", i, final), i, final), stride) for i in numbers]
