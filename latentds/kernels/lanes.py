"""Eight float64 side by side as a Numba type: a kernel reads like scalar arithmetic and is SIMD by construction.

LLVM's own loop vectoriser gives up on our kernels for small reasons (alias checks, trip counts) and then costs a factor
of five without a word; here nothing is left to it. Every function below takes ``lanes`` or a plain float alike.
"""

# mypy: disable-error-code="import-untyped,attr-defined,no-untyped-call,untyped-decorator"
# Numba's extension interface is not typed.

from __future__ import annotations

import operator
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic as _intrinsic
from numba.extending import lower_builtin, lower_cast, models, register_model

from .compiling import OPTIONS
from .private import AbstractTemplate, Conversion, infer_global, signature

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


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@register_model(_Mask)
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


_LOG2_E = 1.4426950408889634
_LN_2 = 0.6931471805599453
_SHIFT = 1.5 * 2.0**52 + 1023
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10 = (
    1.0, 1.0000000000000069, 0.5000000000000006, 0.16666666666553953, 0.04166666666657277, 0.008333333385825085,
    0.0013888888932619635, 0.00019841170071970308, 2.4801504180837137e-05, 2.7640263790318923e-06,
    2.7626426376580335e-07,
)  # fmt: skip
"""Chebyshev interpolation of e^r on |r| <= ln(2)/2: relative error 3.4e-16."""


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def exp(x: Any) -> Any:
    """e^x for x <= 0, and exactly 0 below -650, where results near the denormal numbers would take 14 times as long.

    x = n ln 2 + r; adding 1.5·2^52 rounds to the whole number n.
    """
    t = x * _LOG2_E + _SHIFT
    r = x - (t - _SHIFT) * _LN_2
    z = r * r
    even = ((((_P10 * z + _P8) * z + _P6) * z + _P4) * z + _P2) * z + _P0
    odd = (((_P9 * z + _P7) * z + _P5) * z + _P3) * z + _P1
    return where(x > -650.0, (odd * r + even) * power_of_two(t), 0.0)
