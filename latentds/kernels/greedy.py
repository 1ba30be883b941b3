"""Greedy fast diffeomorphic matching, compiled."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ..arguments import Array
from .compiling import compiled
from .lanes import WIDTH, exp, load, store, where


@cache
def greedy_kernel() -> Any:
    """The greedy match of :func:`latentds.fitting.matching.match`.

    It moves the points ``moved`` (N, n) towards ``y`` (N, n) in place, fills ``layers`` (M, 2n+1) with rows (c, v, ρ²)
    and returns how many it filled. ``beta`` is β, ``bound`` μ²e/2; each layer lies on the point ``at``, or on the one
    with the largest error if that is -1.

    The loss of a layer, ‖v‖² Σ k² - 2 a k with k = exp(-ρ²d) and a = error·v/‖v‖², is evaluated on a grid of ρ² with
    ratio √2, from the bound down to where every k is near 1. Doubling ρ² squares k, so that the grid costs two
    exponentials a point. From the best of the grid Newton's method goes on inside a bracket, with exact exponentials.
    """

    def greedy(
        moved: Array, y: Array, beta: float, bound: float, largest_rho_squared: float, at: int, layers: Array
    ) -> int:
        count, dim = moved.shape
        padded = (count + WIDTH - 1) // WIDTH * WIDTH
        x, error = np.zeros(dim * padded), np.zeros(dim * padded)
        d, a, k_low, k_high = np.zeros(padded), np.zeros(padded), np.empty(padded), np.empty(padded)
        sums = np.empty(3 * WIDTH)
        for i in range(count):
            for e in range(dim):
                x[e * padded + i] = moved[i, e]
                error[e * padded + i] = y[i, e] - moved[i, e]
        used = 0
        while used < len(layers):
            worst, largest = 0, 0.0
            for i in range(count):
                squared = 0.0
                for e in range(dim):
                    squared += error[e * padded + i] ** 2
                if i == at or (at < 0 and squared > largest):
                    worst, largest = i, squared
            size = beta * beta * largest
            if not (size > 0.0 and bound / size < np.inf):
                break
            layer = layers[used]
            for e in range(dim):
                layer[e] = x[e * padded + worst]
                layer[dim + e] = beta * error[e * padded + worst]
            farthest = 0.0
            for u in range(0, padded, WIDTH):
                w = load(x, u, WIDTH) - layer[0]
                distance = w * w
                along = load(error, u, WIDTH) * layer[dim]
                for e in range(1, dim):
                    w = load(x, e * padded + u, WIDTH) - layer[e]
                    distance = distance + w * w
                    along = along + load(error, e * padded + u, WIDTH) * layer[dim + e]
                store(d, u, distance)
                store(a, u, along * (1.0 / size))
            for i in range(count):
                farthest = max(farthest, d[i])
            # The grid: two chains, q and q√2, doubled until q√2 reaches the bound.
            limit = min(bound / size, largest_rho_squared)
            doublings = max(0, int(np.ceil(np.log2(max(16.0 * limit * farthest, 1.0)))))
            first = 0.5 * limit * 0.5**doublings
            for i in range(count, padded):
                d[i], a[i] = 2000.0 / first, 0.0
            best, lowest = limit, np.inf
            for u in range(0, padded, WIDTH):
                store(k_low, u, exp(load(d, u, WIDTH) * -(first * np.sqrt(2.0))))
                store(k_high, u, exp(load(d, u, WIDTH) * (-2.0 * first)))
            for step in range(doublings + 1):
                low_sum = load(k_low, 0, WIDTH) * 0.0
                high_sum = low_sum
                for u in range(0, padded, WIDTH):
                    along, low, high = load(a, u, WIDTH), load(k_low, u, WIDTH), load(k_high, u, WIDTH)
                    low_sum = low_sum + low * (low - 2.0 * along)
                    high_sum = high_sum + high * (high - 2.0 * along)
                    store(k_low, u, where(low > 1e-150, low * low, 0.0))
                    store(k_high, u, where(high > 1e-150, high * high, 0.0))
                store(sums, 0, low_sum)
                store(sums, WIDTH, high_sum)
                low_loss, high_loss = sums[:WIDTH].sum(), sums[WIDTH : 2 * WIDTH].sum()
                q = first * 2.0 ** (step + 1)
                if low_loss <= lowest:
                    best, lowest = q * np.sqrt(0.5), low_loss
                if high_loss <= lowest:
                    best, lowest = q, high_loss
            q, low_q, high_q, lowest = best, best * np.sqrt(0.5), min(best * np.sqrt(2.0), limit), np.inf
            for _ in range(8):
                loss = load(d, 0, WIDTH) * 0.0
                slope, bend = loss, loss
                for u in range(0, padded, WIDTH):
                    distance, along = load(d, u, WIDTH), load(a, u, WIDTH)
                    kernel = exp(distance * -q)
                    missed = kernel - along
                    loss = loss + kernel * (missed - along)
                    weighted = distance * kernel
                    slope = slope - weighted * missed
                    bend = bend + distance * weighted * (kernel + missed)
                store(sums, 0, loss)
                store(sums, WIDTH, slope)
                store(sums, 2 * WIDTH, bend)
                if sums[:WIDTH].sum() <= lowest:
                    best, lowest = q, sums[:WIDTH].sum()
                first_derivative, second_derivative = sums[WIDTH : 2 * WIDTH].sum(), sums[2 * WIDTH :].sum()
                if first_derivative > 0.0:
                    high_q = q
                else:
                    low_q = q
                new = q - first_derivative / second_derivative if second_derivative > 0.0 else 0.0
                if not low_q < new < high_q:
                    new = 0.5 * (low_q + high_q)
                if abs(new - q) <= 1e-6 * q:
                    break
                q = new
            layer[2 * dim] = best
            for u in range(0, padded, WIDTH):
                kernel = exp(load(d, u, WIDTH) * -best)
                for e in range(dim):
                    shift = kernel * layer[dim + e]
                    store(x, e * padded + u, load(x, e * padded + u, WIDTH) + shift)
                    store(error, e * padded + u, load(error, e * padded + u, WIDTH) - shift)
            used += 1
        for i in range(count):
            for e in range(dim):
                moved[i, e] = x[e * padded + i]
        return used

    points = "float64[:, ::1]"
    return compiled(greedy, f"int64({points}, {points}, float64, float64, float64, int64, {points})")
