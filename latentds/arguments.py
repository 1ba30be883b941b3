"""What every public entry point asks of its arguments: a ValueError says which, what was expected and what came."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
"""Numbers as NumPy holds them here: float64."""


def whole_number(value: Any, name: str, *, at_least: int) -> int:
    if isinstance(value, bool) or not hasattr(value, "__index__") or value.__index__() < at_least:
        raise ValueError(f"{name}: expected a whole number >= {at_least}, got {value!r}")
    return int(value.__index__())


def number_in(value: Any, name: str, low: float, high: float, *, ends: str = "()") -> float:
    """A hyperparameter in an interval; ``ends`` are its brackets, as in "(]"."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    above = number >= low if ends[0] == "[" else number > low
    below = number <= high if ends[1] == "]" else number < high
    if not (above and below):
        raise ValueError(f"{name}: expected a number in {ends[0]}{low:g}, {high:g}{ends[1]}, got {value!r}")
    return number


def real_tensor(values: Any, name: str) -> Tensor:
    """``values`` as a tensor of whatever real dtype and device they have; never a copy of a tensor."""
    try:
        if isinstance(values, np.ndarray) and (min(values.strides, default=0) < 0 or not values.dtype.isnative):
            values = values.astype(values.dtype.newbyteorder("="), order="C")  # reversed, or of another byte order
        tensor = torch.as_tensor(values)
        if tensor.is_complex() or tensor.dtype == torch.bool or tensor.layout != torch.strided:
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: expected an array of real numbers, got {_describe(values)}") from None
    return tensor


def real_array(values: Any, name: str) -> np.ndarray:
    """``values`` as a float64 array of its own."""
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu()
            values = (values.float() if values.dtype == torch.bfloat16 else values).numpy()
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: expected an array of real numbers, got {_describe(values)}") from None
    return np.array(array, dtype=np.float64)


def point_array(values: Any, name: str) -> np.ndarray:
    array = real_array(values, name)
    if array.ndim != 2 or array.shape[1] < 1:
        raise ValueError(f"{name}: expected shape (N, n) with n >= 1, got {array.shape}")
    if array.shape[0] < 3:
        raise ValueError(f"{name}: expected at least 3 points, got {array.shape[0]}")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise ValueError(f"{name}: expected finite numbers, got NaN or inf in row {row}")
    if (array == array[0]).all():
        raise ValueError(f"{name}: expected a motion, got {len(array)} equal points")
    return np.ascontiguousarray(array)


def check_points(dim: int, points: Tensor, name: str) -> None:
    """Refuse what is not shaped (..., dim)."""
    if points.ndim == 0 or points.shape[-1] != dim:
        raise ValueError(f"{name}: expected shape (..., {dim}), got {tuple(points.shape)}")


def check_precision(dtype: torch.dtype) -> None:
    """Refuse to move a map or a system to a dtype in which it would be another one."""
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"dtype: expected torch.float64 or torch.float32, got {dtype}, whose rounding, layer after layer, "
            "makes another system; inputs of any real dtype are answered in it"
        )


def refuse_tracing(what: str) -> None:
    """Refuse to be recorded by torch.jit.trace, which keeps the steps that one example took and says nothing."""
    if torch._C._get_tracing_state() is not None:
        raise RuntimeError(f"{what} takes as many steps as its start needs and cannot be traced; trace the velocity")


def positive(value: Any, name: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected a number > 0, got {_describe(value)}") from None
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name}: expected a finite number > 0, got {number:g}")
    return number


def _describe(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else type(value).__name__
