"""A vector of 16 float32 lanes as a type that numba kernels can hold in a variable, with its operators.

Vectors are lowered to LLVM's `<16 x float>`, which LLVM maps to whatever the processor has (AVX-512, AVX2, SSE2,
NEON). So speed does not depend on the auto-vectoriser, and users need no C compiler. Arithmetic between vectors, or
a vector and a scalar, is written with the usual operators, min and max; comparisons give a mask. `simd` has the rest.
"""

import inspect
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
FLAGS = ("contract", "nsz", "arcp", "reassoc", "afn")  # as in `compilation.OPTIONS`

F32, I32 = ir.FloatType(), ir.IntType(32)
VECTOR_IR, INTEGERS_IR = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)


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
