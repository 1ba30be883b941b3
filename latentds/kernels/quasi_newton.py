"""The direction of L-BFGS, compiled: sums of products that no thread of a linear algebra library spins for."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ..arguments import Array
from .compiling import compiled
from .lanes import WIDTH, load, store


@cache
def direction_kernel() -> Any:
    """The kernel that turns a gradient into the direction -H g, in place; H approximates the inverse Hessian.

    It is the two-loop recursion of Nocedal (1980) over the last ``held`` pairs of steps and changes of the gradient,
    (m, p) each and used in a ring that ends before row ``end``; p is a multiple of 8, filled up with zeros. ``share``
    (2, m) receives what the loops keep.
    """

    def direction(steps: Array, changes: Array, held: int, end: int, share: Array, out: Array) -> None:
        memory, padded = steps.shape
        s, y = steps.reshape(steps.size), changes.reshape(changes.size)
        parts = np.empty(WIDTH)
        scale = 1.0
        for back in range(held):
            row = (end - 1 - back) % memory
            at = row * padded
            along, both, squares = load(s, at, WIDTH) * 0.0, load(s, at, WIDTH) * 0.0, load(s, at, WIDTH) * 0.0
            for u in range(0, padded, WIDTH):
                change = load(y, at + u, WIDTH)
                along = along + load(s, at + u, WIDTH) * load(out, u, WIDTH)
                both = both + load(s, at + u, WIDTH) * change
                squares = squares + change * change
            store(parts, 0, both)
            curvature = parts.sum()
            if back == 0:
                store(parts, 0, squares)
                scale = curvature / parts.sum()
            store(parts, 0, along)
            share[0, row], share[1, row] = parts.sum() / curvature, curvature
            for u in range(0, padded, WIDTH):
                store(out, u, load(out, u, WIDTH) - load(y, at + u, WIDTH) * share[0, row])
        for u in range(0, padded, WIDTH):
            store(out, u, load(out, u, WIDTH) * -scale)
        for back in range(held - 1, -1, -1):
            row = (end - 1 - back) % memory
            at = row * padded
            along = load(s, at, WIDTH) * 0.0
            for u in range(0, padded, WIDTH):
                along = along + load(y, at + u, WIDTH) * load(out, u, WIDTH)
            store(parts, 0, along)
            change = -share[0, row] - parts.sum() / share[1, row]
            for u in range(0, padded, WIDTH):
                store(out, u, load(out, u, WIDTH) + load(s, at + u, WIDTH) * change)

    return compiled(direction, "void(float64[:, ::1], float64[:, ::1], int64, int64, float64[:, ::1], float64[::1])")
