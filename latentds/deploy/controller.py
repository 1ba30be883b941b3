"""Velocities for control loops: NumPy in and out, compiled from end to end where the system allows."""

from __future__ import annotations

import copy
import threading
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..kernels.velocity import velocity_kernel
from .tables import VelocityField

Array = NDArray[np.float64]


class Controller:
    """The velocity field of a system as it is now, ready for a real-time loop.

    It keeps its own copy: fitting or moving the system afterwards does not change it. Any number of threads may call
    it at once. Systems of locally weighted translations with the dynamics of this package run in one compiled call
    without torch, and allocate nothing when ``out`` is given; any other system is asked through torch, correct but
    slower by torch's overhead (see ``compiled``).

    Args:
        ds: a stable system, on any device.

    Attributes:
        dim: n.
        compiled: whether calls bypass torch.
    """

    def __init__(self, ds: VelocityField) -> None:
        self.dim = ds.dim
        tables = ds.tables()
        self.compiled = tables is not None
        if tables is None:
            self._ds = copy.deepcopy(ds).requires_grad_(False)
        else:
            self._tables, self._kernel = tables, velocity_kernel(self.dim)
            self._local = threading.local()
        self(np.zeros(self.dim))

    def __call__(self, y: Any, out: Array | None = None) -> Array:
        """Velocity at ``y``: (..., n) -> (..., n) float64, units of y per second.

        Args:
            y: finite positions; one point (n,) is the case this is made for.
            out: where to put the answer, a C-contiguous float64 array of y's shape; returned.

        Raises:
            ValueError: for another shape, or anything but finite real numbers.
        """
        if type(y) is not np.ndarray or y.dtype != np.float64 or not y.flags.c_contiguous:
            y = _real(y)
        if y.ndim == 0 or y.shape[-1] != self.dim:
            raise ValueError(f"y: expected shape (..., {self.dim}), got {y.shape}")
        if out is None:
            out = np.empty_like(y)
        elif out.shape != y.shape or out.dtype != np.float64 or not (out.flags.c_contiguous and out.flags.writeable):
            raise ValueError(
                f"out: expected a writeable C-contiguous float64 array {y.shape}, got {out.dtype} {out.shape}"
            )
        if self.compiled:
            rows = y.size // self.dim
            finite = self._kernel(*self._tables, y.reshape(rows, self.dim), out.reshape(rows, self.dim), self._room())
        else:
            finite = bool(np.isfinite(y).all())
            if finite:
                with torch.no_grad():
                    out[...] = self._ds(torch.from_numpy(y)).numpy()
        if not finite:
            raise ValueError(f"y: expected finite numbers, got {y}")
        return out

    def _room(self) -> Array:
        try:
            return self._local.room  # type: ignore[no-any-return]
        except AttributeError:
            self._local.room = np.empty((len(self._tables.layers) + 1, self.dim + 1))
            return self._local.room  # type: ignore[no-any-return]


def _real(y: Any) -> Array:
    try:
        array = np.asarray(y)
        if array.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError):
        raise ValueError(f"y: expected real numbers, got {type(y).__name__}") from None
    return np.ascontiguousarray(array, dtype=np.float64)
