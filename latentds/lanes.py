"""Eight float64 side by side as a Numba type: a kernel reads like scalar arithmetic and is SIMD by construction.

LLVM's own loop vectoriser gives up on our kernels for small reasons (alias checks, trip counts) and then costs a factor
of five without a word; here nothing is left to it. Every function below takes ``lanes`` or a plain float alike.
"""

# mypy: disable-error-code="import-untyped,attr-defined,no-untyped-call,untyped-decorator"
# Numba's extension interface is not typed.

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.datamodel import models, register_default
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as _intrinsic

intrinsic: Any = _intrinsic
WIDTH = 8
"""Lanes of one vector: a 512-bit register, or what the compiler makes of it elsewhere."""

CONTRACT = ("contract",)  # a*b + c may round once


class _Lanes(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(name="float64_lanes")

    def can_convert_from(self, context: Any, other: types.Type) -> Any:
        return Conversion.safe if other in (types.float64, types.int64) else None


class _Mask(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(name="mask_lanes")


lanes, mask = _Lanes(), _Mask()
_VECTOR, _BITS, _MASK = (ir.VectorType(kind, WIDTH) for kind in (ir.DoubleType(), ir.IntType(64), ir.IntType(1)))


@register_default(_Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@register_default(_Mask)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _MASK)


@lower_cast(types.float64, lanes)
def _broadcast(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH))


def _operation(function: Any, result: types.Type, emit: Any) -> None:
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, keywords: Any) -> Any:
            numbers = (lanes, types.float64)
            return signature(result, lanes, lanes) if lanes in args and all(a in numbers for a in args) else None

    infer_global(function)(Template)
    lower_builtin(function, lanes, lanes)(lambda context, builder, sig, args: emit(builder, *args))


_operation(operator.add, lanes, lambda b, x, y: b.fadd(x, y, flags=CONTRACT))
_operation(operator.sub, lanes, lambda b, x, y: b.fsub(x, y, flags=CONTRACT))
_operation(operator.mul, lanes, lambda b, x, y: b.fmul(x, y, flags=CONTRACT))
_operation(operator.truediv, lanes, lambda b, x, y: b.fdiv(x, y, flags=CONTRACT))
_operation(operator.lt, mask, lambda b, x, y: b.fcmp_ordered("<", x, y))
_operation(operator.gt, mask, lambda b, x, y: b.fcmp_ordered(">", x, y))


@intrinsic
def where(context: Any, condition: Any, this: Any, other: Any) -> Any:
    """``this`` in the lanes where ``condition`` holds, else ``other``."""
    kind = lanes if condition is mask else types.float64
    return kind(condition, kind, kind), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def either(context: Any, left: Any, right: Any) -> Any:
    """Where one of two conditions holds."""
    return left(left, right), lambda context, builder, sig, args: builder.or_(*args)


@intrinsic
def anywhere(context: Any, condition: Any) -> Any:
    """Whether a condition holds in some lane, as 0 or 1."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if condition is mask:
            packed = builder.bitcast(args[0], ir.IntType(WIDTH))
            hit = builder.icmp_unsigned("!=", packed, ir.Constant(packed.type, 0))
        else:
            hit = args[0]
        return builder.zext(hit, ir.IntType(64))

    return types.int64(condition), emit


@intrinsic
def power_of_two(context: Any, shifted: Any) -> Any:
    """2^n from n + 1023 + 1.5·2^52: the sum's low bits are the exponent that a float64 carries."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = shifted is lanes
        bits, real = (_BITS, _VECTOR) if vector else (ir.IntType(64), ir.DoubleType())
        shift = ir.Constant(bits, [52] * WIDTH if vector else 52)
        return builder.bitcast(builder.shl(builder.bitcast(args[0], bits), shift), real)

    return shifted(shifted), emit


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any, content: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), content.as_pointer())


@intrinsic(prefer_literal=True)
def load(context: Any, array: Any, index: Any, width: Any) -> Any:
    """The entry of a flat float64 array at ``index`` or, for a ``width`` of 8, the eight from there on."""
    kind, content = (lanes, _VECTOR) if width.literal_value == WIDTH else (types.float64, ir.DoubleType())

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, sig.args[0], args[0], args[1], content), align=8)

    return kind(array, types.intp, width), emit


@intrinsic
def store(context: Any, array: Any, index: Any, value: Any) -> Any:
    """Write what :func:`load` reads."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, sig.args[0], args[0], args[1], args[2].type), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes if value is lanes else types.float64), emit
