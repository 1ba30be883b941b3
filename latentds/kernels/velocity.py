"""The velocity of one point after the other, compiled from end to end for control loops."""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from ..time_law import TAIL
from .compiling import OPTIONS, compiled
from .translations import BEYOND, first_root, next_root

Array = NDArray[np.float64]


@cache
def velocity_kernel(dim: int) -> Any:
    """The velocity J_ψ(x) g(x), x = ψ⁻¹(y), of points one by one: (m, n) -> (m, n); False if one is not finite.

    ``goal`` (3, n) holds x*, the axis u and the length ℓ in each entry; with o = (x - x*)/ℓ, a = u·o and p = o - a u,
    g = -ℓ (rate(|a|) a u + rate(|p|) p), the rates h(s)/s by the tables ``along`` and ``across``: (2, m) knots and
    speeds, or the knot -1 and ω for the eigenmap's law. ``steps`` (M, n+1) is room to keep each layer's tangent map.
    """

    def field(layers: Array, goal: Array, along: Array, across: Array, y: Array, out: Array, steps: Array) -> bool:
        for row in range(len(y)):
            velocity = out[row]
            x = steps[len(layers)]
            for d in range(dim):
                if not np.isfinite(y[row, d]):
                    return False
                x[d] = y[row, d]
            for j in range(len(layers) - 1, -1, -1):
                q, a = layers[j, 2 * dim], layers[j, 2 * dim + 1]
                b, c = 0.0, 0.0
                for d in range(dim):
                    w = x[d] - layers[j, d]
                    c += w * w
                    b += w * layers[j, dim + d]
                steps[j, dim] = 0.0
                if q * c > BEYOND:
                    continue
                b, c = q * b, q * c
                s, low, high = first_root(b, c), 0.0, 1.0
                for _ in range(64):
                    s, low, high, still = next_root(s, low, high, a, b, c)
                    if not still:
                        break
                steps[j, dim] = -2.0 * q * s
                for d in range(dim):
                    x[d] -= s * layers[j, dim + d]
                    steps[j, d] = x[d] - layers[j, d]
            length = goal[2, 0]
            ahead = 0.0
            for d in range(dim):
                x[d] = (x[d] - goal[0, d]) / length
                ahead += x[d] * goal[1, d]
            aside = 0.0
            for d in range(dim):
                x[d] -= ahead * goal[1, d]
                aside += x[d] * x[d]
            forward, inward = _rate(along, abs(ahead)) * ahead, _rate(across, np.sqrt(aside))
            for d in range(dim):
                velocity[d] = -length * (forward * goal[1, d] + inward * x[d])
            for j in range(len(layers)):
                if steps[j, dim] != 0.0:
                    grown = 0.0
                    for d in range(dim):
                        grown += steps[j, d] * velocity[d]
                    grown *= steps[j, dim]
                    for d in range(dim):
                        velocity[d] += grown * layers[j, dim + d]
        return True

    return compiled(field, f"boolean({', '.join(['float64[:, ::1]'] * 7)})")


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _rate(table: Array, s: Any) -> Any:
    """h(s)/s of the laws in :mod:`latentds.time_law`."""
    if table[0, 0] < 0.0:
        s = max(s, TAIL)
        return table[1, 0] * (np.sqrt((2.0 - s) / s) if s < 1.0 else 1.0 / s)
    last = table.shape[1] - 1
    if s <= table[0, 0]:
        return table[1, 0] / table[0, 0]
    if s >= table[0, last]:
        return table[1, last] / s
    i = np.searchsorted(table[0], s)
    share = (s - table[0, i - 1]) / (table[0, i] - table[0, i - 1])
    return (table[1, i - 1] + share * (table[1, i] - table[1, i - 1])) / s
