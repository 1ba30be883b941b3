"""Adjoint sweeps through locally weighted translations: the gradients that training and refinement descend on."""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np

from ..arguments import Array
from .compiling import OPTIONS, compiled
from .lanes import WIDTH, anywhere, exp, load, store, where

NEGLIGIBLE = 60.0
"""ρ²‖x-c‖² from which a layer moves a point by less than exp(-60) = 9e-27 of its translation: it is skipped."""

ROWS = 32
"""Points that go through the layers together: what the way there keeps of them for the way back fits the L2 cache."""


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def add_up(parts: Array, sums: Array) -> None:
    """The sums whose eight parts each lie side by side, as a table."""
    for j in range(len(sums)):
        for e in range(sums.shape[1]):
            at = (j * sums.shape[1] + e) * WIDTH
            sums[j, e] = parts[at : at + WIDTH].sum()


@cache
def forward_adjoint(dim: int, tangents: int, to_targets: bool = False) -> Any:
    """The kernel from dloss/dψ(x) and dloss/d(J_ψ t) to the gradients by points, tangents and layers.

    x and x_out are (m, n), gx (m, n) or (1, n); t is (m, n·T) or (1, n·T), gt and t_out (m, n·T). ``sums``
    (M, 2n+1) receives each layer's gradient by c, v and ρ².

    The loss may be Σ w ‖ψ(x) - y‖² itself: then gx are the targets y (m, n), gt the weights w (m, 1), there are no
    tangents, and x_out receives ψ(x).
    """
    entries = 2 * dim + 1

    def sweep(layers: Array, x: Array, t: Array, gx: Array, gt: Array, x_out: Array, t_out: Array, sums: Array) -> None:
        count = len(layers)
        at_t, at_gx, at_gt = dim * ROWS, (dim + dim * tangents) * ROWS, (2 * dim + dim * tangents) * ROWS
        held = np.zeros((2 * dim + 2 * dim * tangents) * ROWS)  # x; t; their cotangents
        row = (dim + 1 + tangents) * ROWS  # x before a layer; k; the tangents' growth
        kept = np.empty(count * row)
        near = np.empty((count, ROWS // WIDTH), np.bool_)
        total = np.zeros(len(layers) * entries * WIDTH)  # every sum in eight parts
        for begin in range(0, len(x), ROWS):
            size = min(ROWS, len(x) - begin)
            padded = (size + WIDTH - 1) // WIDTH * WIDTH
            for i in range(padded):
                point = begin + min(i, size - 1)
                for d in range(dim):
                    held[d * ROWS + i] = x[point, d]
                    held[at_gx + d * ROWS + i] = gx[min(point, len(gx) - 1), d] if i < size else 0.0
                for e in range(dim * tangents):
                    held[at_t + e * ROWS + i] = t[min(point, len(t) - 1), e]
                    held[at_gt + e * ROWS + i] = gt[point, e] if i < size else 0.0
            for j in range(count):
                q, here = layers[j, 2 * dim], j * row
                for u in range(0, padded, WIDTH):
                    w = load(held, u, WIDTH) - layers[j, 0]
                    distance = w * w
                    for d in range(1, dim):
                        w = load(held, d * ROWS + u, WIDTH) - layers[j, d]
                        distance = distance + w * w
                    near[j, u // WIDTH] = anywhere(distance * q < NEGLIGIBLE)
                    if not near[j, u // WIDTH]:
                        continue
                    k = exp(distance * -q)
                    store(kept, here + dim * ROWS + u, k)
                    for e in range(tangents):
                        along = k * 0.0
                        for d in range(dim):
                            w = load(held, d * ROWS + u, WIDTH) - layers[j, d]
                            along = along + w * load(held, at_t + (d * tangents + e) * ROWS + u, WIDTH)
                        along = where(k > 0.0, -2.0 * q * k * along, k)  # 0·inf is not a number
                        store(kept, here + (dim + 1 + e) * ROWS + u, along)
                        for d in range(dim):
                            place = at_t + (d * tangents + e) * ROWS + u
                            store(held, place, load(held, place, WIDTH) + along * layers[j, dim + d])
                    for d in range(dim):
                        moved = load(held, d * ROWS + u, WIDTH)
                        store(kept, here + d * ROWS + u, moved)
                        store(held, d * ROWS + u, moved + k * layers[j, dim + d])
            if to_targets:
                for i in range(size):
                    for d in range(dim):
                        moved_to = held[d * ROWS + i]
                        x_out[begin + i, d] = moved_to
                        held[at_gx + d * ROWS + i] = 2.0 * gt[begin + i, 0] * (moved_to - held[at_gx + d * ROWS + i])
            for j in range(count - 1, -1, -1):
                q, here, sum_at = layers[j, 2 * dim], j * row, j * entries * WIDTH
                for u in range(0, padded, WIDTH):
                    if not near[j, u // WIDTH]:
                        continue
                    k = load(kept, here + dim * ROWS + u, WIDTH)
                    slope = -2.0 * q * k
                    distance, along = k * 0.0, k * 0.0
                    for d in range(dim):
                        w = load(kept, here + d * ROWS + u, WIDTH) - layers[j, d]
                        distance = distance + w * w
                        cotangent = load(held, at_gx + d * ROWS + u, WIDTH)
                        along = along + cotangent * layers[j, dim + d]
                        place = sum_at + (dim + d) * WIDTH
                        store(total, place, load(total, place, WIDTH) + k * cotangent)
                    of_square = along * k * distance * -1.0
                    of_offset = along * slope  # times x - c: what the point's cotangent gains
                    for e in range(tangents):
                        grown = load(kept, here + (dim + 1 + e) * ROWS + u, WIDTH)
                        beta = k * 0.0
                        for d in range(dim):
                            place = at_t + (d * tangents + e) * ROWS + u
                            store(held, place, load(held, place, WIDTH) - grown * layers[j, dim + d])
                            cotangent = load(held, at_gt + (d * tangents + e) * ROWS + u, WIDTH)
                            beta = beta + cotangent * layers[j, dim + d]
                            place = sum_at + (dim + d) * WIDTH
                            store(total, place, load(total, place, WIDTH) + grown * cotangent)
                        of_square = of_square + beta * grown * (1.0 / q - distance)
                        of_offset = of_offset - 2.0 * q * beta * grown
                        for d in range(dim):
                            w = load(kept, here + d * ROWS + u, WIDTH) - layers[j, d]
                            place = at_gt + (d * tangents + e) * ROWS + u
                            store(held, place, load(held, place, WIDTH) + beta * slope * w)
                            change = beta * slope * load(held, at_t + (d * tangents + e) * ROWS + u, WIDTH)
                            place = at_gx + d * ROWS + u
                            store(held, place, load(held, place, WIDTH) + change)
                            place = sum_at + d * WIDTH
                            store(total, place, load(total, place, WIDTH) - change)
                    for d in range(dim):
                        change = of_offset * (load(kept, here + d * ROWS + u, WIDTH) - layers[j, d])
                        place = at_gx + d * ROWS + u
                        store(held, place, load(held, place, WIDTH) + change)
                        place = sum_at + d * WIDTH
                        store(total, place, load(total, place, WIDTH) - change)
                    place = sum_at + 2 * dim * WIDTH
                    store(total, place, load(total, place, WIDTH) + of_square)
            for i in range(size):
                for d in range(0 if to_targets else dim):
                    x_out[begin + i, d] = held[at_gx + d * ROWS + i]
                for e in range(dim * tangents):
                    t_out[begin + i, e] = held[at_gt + e * ROWS + i]
        add_up(total, sums)

    return compiled(sweep, f"void({', '.join(['float64[:, ::1]'] * 8)})")


@cache
def inverse_adjoint(dim: int) -> Any:
    """The kernel from dloss/dx at x = ψ⁻¹(y) to dloss/dy, both (m, n), and to the layers' gradients, in ``sums``.

    It goes from x through the layers towards y, so that no root has to be found: (I + v ∇kᵀ) dx = dy - k dv - v ∂k.
    """
    entries = 2 * dim + 1

    def sweep(layers: Array, x: Array, gx: Array, y_out: Array, sums: Array) -> None:
        held = np.zeros(2 * dim * ROWS)
        at_g = dim * ROWS
        total = np.zeros(len(layers) * entries * WIDTH)  # every sum in eight parts
        for begin in range(0, len(x), ROWS):
            size = min(ROWS, len(x) - begin)
            padded = (size + WIDTH - 1) // WIDTH * WIDTH
            for i in range(padded):
                for d in range(dim):
                    held[d * ROWS + i] = x[begin + min(i, size - 1), d]
                    held[at_g + d * ROWS + i] = gx[begin + i, d] if i < size else 0.0
            for j in range(len(layers)):
                q, sum_at = layers[j, 2 * dim], j * entries * WIDTH
                for u in range(0, padded, WIDTH):
                    w = load(held, u, WIDTH) - layers[j, 0]
                    distance = w * w
                    for d in range(1, dim):
                        w = load(held, d * ROWS + u, WIDTH) - layers[j, d]
                        distance = distance + w * w
                    if not anywhere(distance * q < NEGLIGIBLE):
                        continue
                    k = exp(distance * -q)
                    slope = -2.0 * q * k
                    along, growth = k * 0.0, k * 0.0 + 1.0
                    for d in range(dim):
                        w = load(held, d * ROWS + u, WIDTH) - layers[j, d]
                        along = along + load(held, at_g + d * ROWS + u, WIDTH) * layers[j, dim + d]
                        growth = growth + where(k > 0.0, slope * w, k) * layers[j, dim + d]
                    beta = along / growth
                    for d in range(dim):
                        moved = load(held, d * ROWS + u, WIDTH)
                        change = beta * where(k > 0.0, slope * (moved - layers[j, d]), k)
                        cotangent = load(held, at_g + d * ROWS + u, WIDTH) - change
                        store(held, at_g + d * ROWS + u, cotangent)
                        store(held, d * ROWS + u, moved + k * layers[j, dim + d])
                        place = sum_at + d * WIDTH
                        store(total, place, load(total, place, WIDTH) + change)
                        place = sum_at + (dim + d) * WIDTH
                        store(total, place, load(total, place, WIDTH) - k * cotangent)
                    place = sum_at + 2 * dim * WIDTH
                    store(total, place, load(total, place, WIDTH) + where(k > 0.0, beta * k * distance, k))
            for i in range(size):
                for d in range(dim):
                    y_out[begin + i, d] = held[at_g + d * ROWS + i]
        add_up(total, sums)

    return compiled(sweep, f"void({', '.join(['float64[:, ::1]'] * 5)})")
