"""The velocity of one point after the other, and its Jacobian, compiled from end to end for control loops."""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np

from ..arguments import Array
from ..tabulated import LINEAR_BELOW, LawKind
from .compiling import OPTIONS, compiled
from .translations import BEYOND, first_root, next_root

_EIGENMAP = float(LawKind.EIGENMAP)


@cache
def velocity_kernel(dim: int, tangents: int) -> Any:
    """The velocity J_ψ(x) g(x), x = ψ⁻¹(y - shift), of points one by one: (m, n) -> (m, n); False if one is not finite.

    ``goal`` (3, n) holds x*, the axis u and the length ℓ in each entry; with o = (x - x*)/ℓ, a = u·o and p = o - a u,
    g = -ℓ (rate(|a|) a u + rate(|p|) p), the rates h(s)/s by the laws ``along`` and ``across``, as
    :meth:`latentds.tabulated.LawTable.packed` gives them. It is then made ``speed`` times as long, or shortened to
    ``limit``. ``slopes`` (m, n·tangents) takes the derivatives by the first ``tangents`` coordinates of y, row by row.

    ``room`` (M+2+tangents, n+2) keeps each layer's tangent map, then x, then tangents of x; its last row is given: the
    shift (n), the speed and the limit.
    """

    def field(
        layers: Array, goal: Array, along: Array, across: Array, y: Array, out: Array, slopes: Array, room: Array
    ) -> bool:
        x, asked = room[len(layers)], room[len(room) - 1]
        for row in range(len(y)):
            velocity, slope = out[row], slopes[min(row, len(slopes) - 1)]
            for d in range(dim):
                if not np.isfinite(y[row, d]):
                    return False
                x[d] = y[row, d] - asked[d]
                for e in range(tangents):
                    room[len(layers) + 1 + e, d] = 1.0 if d == e else 0.0
            for j in range(len(layers) - 1, -1, -1):
                q, a = layers[j, 2 * dim], layers[j, 2 * dim + 1]
                b, c = 0.0, 0.0
                for d in range(dim):
                    w = x[d] - layers[j, d]
                    c += w * w
                    b += w * layers[j, dim + d]
                room[j, dim] = 0.0
                if q * c > BEYOND:
                    continue
                b, c = q * b, q * c
                s, low, high = first_root(b, c), 0.0, 1.0
                for _ in range(64):
                    s, low, high, still = next_root(s, low, high, a, b, c)
                    if not still:
                        break
                room[j, dim] = -2.0 * q * s
                for d in range(dim):
                    x[d] -= s * layers[j, dim + d]
                    room[j, d] = x[d] - layers[j, d]
                if tangents > 0:  # (1 + v hᵀ)⁻¹ of each, h = -2 ρ² s (x - c)
                    share = 1.0
                    for d in range(dim):
                        share += room[j, dim] * room[j, d] * layers[j, dim + d]
                    for e in range(tangents):
                        tangent = room[len(layers) + 1 + e]
                        grown = 0.0
                        for d in range(dim):
                            grown += room[j, d] * tangent[d]
                        grown *= room[j, dim] / share
                        for d in range(dim):
                            tangent[d] -= grown * layers[j, dim + d]
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
            for e in range(tangents):
                tangent = room[len(layers) + 1 + e]
                gone, near = 0.0, 0.0
                for d in range(dim):
                    gone += tangent[d] * goal[1, d] / length
                for d in range(dim):
                    near += x[d] * (tangent[d] / length - gone * goal[1, d])
                faster = _slope(along, abs(ahead)) * gone
                bend = (_slope(across, np.sqrt(aside)) - inward) * near / aside if aside > 0.0 else 0.0
                for d in range(dim):
                    across_it = inward * (tangent[d] / length - gone * goal[1, d])
                    slope[d * tangents + e] = -length * (faster * goal[1, d] + bend * x[d] + across_it)
            for j in range(len(layers)):
                if room[j, dim] != 0.0:
                    grown = 0.0
                    for d in range(dim):
                        grown += room[j, d] * velocity[d]
                    grown *= room[j, dim]
                    for e in range(tangents):
                        tangent = room[len(layers) + 1 + e]
                        moved, turned, carried = 0.0, 0.0, 0.0
                        for d in range(dim):
                            moved += room[j, d] * tangent[d]
                            turned += velocity[d] * tangent[d]
                            carried += room[j, d] * slope[d * tangents + e]
                        change = room[j, dim] * (turned + carried) - 2.0 * layers[j, 2 * dim] * moved * grown
                        for d in range(dim):
                            slope[d * tangents + e] += change * layers[j, dim + d]
                            tangent[d] += room[j, dim] * moved * layers[j, dim + d]
                    for d in range(dim):
                        velocity[d] += grown * layers[j, dim + d]
            squared = 0.0
            for d in range(dim):
                squared += velocity[d] * velocity[d]
            factor = asked[dim]
            if factor * np.sqrt(squared) > asked[dim + 1]:
                factor = asked[dim + 1] / np.sqrt(squared)
                for e in range(tangents):  # as long as it is, it can only turn
                    longer = 0.0
                    for d in range(dim):
                        longer += velocity[d] * slope[d * tangents + e] / squared
                    for d in range(dim):
                        slope[d * tangents + e] -= longer * velocity[d]
            for d in range(dim):
                velocity[d] *= factor
                for e in range(tangents):
                    slope[d * tangents + e] *= factor
        return True

    return compiled(field, f"boolean({', '.join(['float64[:, ::1]'] * 8)})")


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _is_eigenmap(law: Array) -> Any:
    return law[0, 0] == _EIGENMAP


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _rate(law: Array, s: Any) -> Any:
    """h(s)/s of the laws in :mod:`latentds.time_law`."""
    if _is_eigenmap(law):
        s = max(s, LINEAR_BELOW)
        return law[2, 0] * (np.sqrt((2.0 - s) / s) if s < 1.0 else 1.0 / s)
    i = _piece(law, s)
    if i == 0:
        return law[3, 0]
    ahead = min(s, law[1, -1]) - law[1, i]
    return (law[2, i] + ahead * (law[3, i] + ahead * law[4, i])) / s


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _slope(law: Array, s: Any) -> Any:
    """h'(s) of them."""
    if _is_eigenmap(law):
        if s <= LINEAR_BELOW:
            return _rate(law, s)
        return law[2, 0] * (1.0 - s) / np.sqrt(s * (2.0 - s)) if s < 1.0 else 0.0
    i = _piece(law, s)
    return law[3, i] + 2.0 * law[4, i] * (min(s, law[1, -1]) - law[1, i])


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _piece(law: Array, s: Any) -> Any:
    """Which piece of a knotted law s lies on."""
    return max(np.searchsorted(law[1], s) - 1, 0)
