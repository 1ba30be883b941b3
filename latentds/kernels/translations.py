"""Compiled CPU kernels behind locally weighted translations.

A kernel takes points in blocks, held coordinate by coordinate in the L1 cache, sends a block through all layers and
carries eight points at a time through the arithmetic (:mod:`latentds.kernels.lanes`). A layer is skipped for eight
points that it moves by less than a rounding error. Everything is computed in float64: a float32 module gets its answer
rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numba
import numpy as np
from torch import Tensor

from ..arguments import Array
from . import dispatch
from .adjoint import NEGLIGIBLE, forward_adjoint, inverse_adjoint
from .compiling import OPTIONS, compiled
from .dispatch import BLOCK, rows_of, run, tensor_of
from .lanes import WIDTH, anywhere, either, exp, load, store, where

PARAMETERS = ("centers", "log_widths", "strengths")
"""Of the module, in the order in which the kernels take them."""

BEYOND = 80.0
"""ρ²‖y-c‖² from which the layer's solution s lies below exp(-60): √80 >= √60 + ρ‖v‖, since ρ‖v‖ < √(e/2)."""

can_use_kernel = partial(dispatch.can_use_kernel, PARAMETERS)


def forward(layers: Array, x: Tensor) -> Tensor:
    """ψ(x); this and the three below take layers as :func:`packed` gives them, and plain tensors."""
    return tensor_of(_swept(layers, rows_of(x), np.empty((1, 0)), 0)[0], x, x.shape)


def inverse(layers: Array, y: Tensor) -> Tensor:
    """ψ⁻¹(y)."""
    points = rows_of(y)
    out = np.empty_like(points)
    run(inverse_kernel(points.shape[1]), layers, points, out)
    return tensor_of(out, y, y.shape)


def push(layers: Array, x: Tensor, tangent: Tensor) -> Tensor:
    """J_ψ(x) t."""
    return tensor_of(_swept(layers, rows_of(x), rows_of(tangent), 1)[1], x, x.shape)


def jacobian(layers: Array, x: Tensor) -> Tensor:
    """J_ψ(x)."""
    dim = x.shape[-1]
    return tensor_of(_swept(layers, rows_of(x), np.eye(dim).reshape(1, -1), dim)[1], x, (*x.shape, dim))


def _swept(layers: Array, points: Array, tangents: Array, n_tangents: int) -> tuple[Array, Array]:
    """ψ of points (m, n), and J_ψ of so many tangents at each, (m, n·T) or (1, n·T)."""
    count, dim = points.shape
    moved, pushed = np.empty_like(points), np.empty((count, dim * n_tangents))
    run(forward_kernel(dim, n_tangents), layers, points, tangents, moved, pushed)
    return moved, pushed


def squares_and_gradients(layers: Array, points: Array, targets: Array, weights: Array) -> tuple[float, Array]:
    """Σ w ‖ψ(x) - y‖² of points x and targets y (m, n), weights (m, 1); and its gradients by c, v, ρ², (M, 2n+1)."""
    moved, nothing = np.empty_like(points), np.empty((len(points), 0))
    kernel = forward_adjoint(points.shape[1], 0, True)
    gradients = _summed(kernel, layers, points, nothing, targets, weights, moved, nothing)
    return float((weights * (moved - targets) ** 2).sum()), gradients


Gradients = tuple[tuple[Tensor, ...], Array]
"""dloss/dpoints, and dloss/d(c, v, ρ²) of every layer (M, 2n+1)."""


def forward_gradients(layers: Array, gradient: Tensor, value: Tensor, x: Tensor) -> Gradients:
    """Of a loss through :func:`forward`, from its gradient by the value; the three below are those of the others."""
    nothing = np.empty((value[..., 0].numel(), 0))
    of_x, _, of_layers = _pulled_back(layers, x, np.empty((1, 0)), rows_of(gradient), nothing)
    return (tensor_of(of_x, x, x.shape),), of_layers


def inverse_gradients(layers: Array, gradient: Tensor, value: Tensor, y: Tensor) -> Gradients:
    points = rows_of(value)
    of_y = np.empty_like(points)
    of_layers = _summed(inverse_adjoint(points.shape[1]), layers, points, rows_of(gradient), of_y)
    return (tensor_of(of_y, y, y.shape),), of_layers


def push_gradients(layers: Array, gradient: Tensor, value: Tensor, x: Tensor, tangent: Tensor) -> Gradients:
    of_image = np.zeros((1, x.shape[-1]))
    of_x, of_tangent, of_layers = _pulled_back(layers, x, rows_of(tangent), of_image, rows_of(gradient))
    return (tensor_of(of_x, x, x.shape), tensor_of(of_tangent, x, x.shape)), of_layers


def jacobian_gradients(layers: Array, gradient: Tensor, value: Tensor, x: Tensor) -> Gradients:
    dim = x.shape[-1]
    of_columns = rows_of(gradient.flatten(-2))
    of_x, _, of_layers = _pulled_back(layers, x, np.eye(dim).reshape(1, -1), np.zeros((1, dim)), of_columns)
    return (tensor_of(of_x, x, x.shape),), of_layers


def _pulled_back(
    layers: Array, x: Tensor, tangents: Array, of_image: Array, of_pushed: Array
) -> tuple[Array, Array, Array]:
    """From the gradients of ψ(x) and of the pushed tangents to those of x, of the tangents and of the layers."""
    points, dim = rows_of(x), x.shape[-1]
    of_points, of_tangents = np.empty_like(points), np.empty_like(of_pushed)
    kernel = forward_adjoint(dim, of_pushed.shape[1] // dim)
    of_layers = _summed(kernel, layers, points, tangents, of_image, of_pushed, of_points, of_tangents)
    return of_points, of_tangents, of_layers


def _summed(kernel: Callable[..., None], layers: Array, points: Array, *by_row: Array) -> Array:
    """Run an adjoint kernel; what it adds up over the points for c, v and ρ² of every layer, (M, 2n+1)."""
    shape = (len(layers), points.shape[1] * 2 + 1)
    parts: list[tuple[int, Array]] = []

    def sweep(layers: Array, points: Array, *by_row: Array) -> None:
        count = len(points)
        for cut in range(0, count, BLOCK):
            sums = np.empty(shape)
            rows = (a[cut : cut + BLOCK] if len(a) == count else a for a in (points, *by_row))
            kernel(layers, *rows, sums)
            parts.append((points[cut:].ctypes.data, sums))

    run(sweep, layers, points, *by_row)
    # Block by block in the order of the points, so that the sum is the same to the last bit on any number of cores.
    total = np.zeros(shape)
    for _, part in sorted(parts, key=lambda part: part[0]):
        total += part
    return total + (math.nan if np.isnan(points.sum()) else 0.0)  # as on the torch path


def packed(parameters: Sequence[Tensor]) -> Array:
    """The layers that these parameters make, as the kernels read them: a row (c, v, ρ², ρ²‖v‖²) each, (M, 2n+2).

    Made anew for every call, in some microseconds, so that it is never stale.
    """
    arrays = (np.ascontiguousarray(parameter.detach().numpy(), dtype=np.float64) for parameter in parameters)
    return pack_kernel()(*arrays)  # type: ignore[no-any-return]


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def nan_or_zero(x: float) -> float:
    """0, or NaN of NaN: a row with one is NaN in all coordinates, as on the torch path."""
    return x if np.isnan(x) else 0.0


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def first_root(b: Any, c: Any) -> Any:
    """A Newton step from 0 towards the root s of s = exp(-(A s² - 2 B s + C)), held in [0, 1]."""
    k = exp(c * -1.0)
    slope = 1.0 - 2.0 * k * b
    s = where(slope > 0.3, k / slope, 3.0 * k)
    return where(s > 1.0, 1.0, s)


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def next_root(s: Any, low: Any, high: Any, a: Any, b: Any, c: Any) -> Any:
    """A better s, its bracket, and whether yet another step would change it.

    Halley's method, as two derivatives cost less than another exponential, inside a shrinking bracket. It is done
    when a bound of the next step is lost in rounding.
    """
    g = b - a * s
    exponent = (g + b) * s - c
    k = exp(where(exponent > 0.0, 0.0, exponent))
    gap = s - k
    slope = 1.0 - 2.0 * g * k
    bend = (a - 2.0 * g * g) * k
    low = where(gap < 0.0, s, low)
    high = where(gap > 0.0, s, high)
    new = s - gap * slope / (slope * slope - gap * bend)
    outside = either(new < low, new > high)
    new = where(outside, 0.5 * (low + high), new)
    step = new - s
    step = where(step < 0.0, -1.0 * step, step)
    still = either(outside, step * step * step * (bend * bend + slope) > 2e-16 * new * slope * slope)
    return new, low, high, still


@cache
def pack_kernel() -> Any:
    return compiled(pack, "float64[:, ::1](float64[:, ::1], float64[::1], float64[:, ::1])")


def pack(centers: Array, log_widths: Array, strengths: Array) -> Array:
    count, dim = centers.shape
    layers = np.empty((count, 2 * dim + 2))
    for j in range(count):
        width = np.exp(log_widths[j])
        squared = 0.0
        for d in range(dim):
            squared += strengths[j, d] ** 2
        scale = np.sqrt(math.e / 2 / (1 + squared)) / width
        for d in range(dim):
            layers[j, d] = centers[j, d]
            layers[j, dim + d] = scale * strengths[j, d]
        layers[j, 2 * dim] = width * width
        layers[j, 2 * dim + 1] = math.e / 2 * squared / (1 + squared)
    return layers


@cache
def forward_kernel(dim: int, tangents: int) -> Any:
    """ψ of points, and J_ψ of so many tangents at each: x (m, n) and t (m, n·T) or (1, n·T) -> x, t."""
    width, block, first_tangent = WIDTH, BLOCK, (dim + 1) * BLOCK

    def sweep(layers: Array, x: Array, t: Array, x_out: Array, t_out: Array) -> None:
        held = np.empty((1 + dim + dim * tangents) * block)  # squared distance; coordinates; tangents
        near = np.empty(block, np.int64)
        for begin in range(0, len(x), block):
            count = min(block, len(x) - begin)
            padded = (count + width - 1) // width * width
            for i in range(padded):
                row = begin + min(i, count - 1)
                for d in range(dim):
                    held[(d + 1) * block + i] = x[row, d]
                for e in range(dim * tangents):
                    held[first_tangent + e * block + i] = t[min(row, len(t) - 1), e]
            for j in range(len(layers)):
                q = layers[j, 2 * dim]
                far = NEGLIGIBLE / q
                n_near = 0
                for u in range(0, padded, width):
                    w = load(held, block + u, width) - layers[j, 0]
                    distance = w * w
                    for d in range(1, dim):
                        w = load(held, (d + 1) * block + u, width) - layers[j, d]
                        distance = distance + w * w
                    store(held, u, distance)
                    near[n_near] = u
                    n_near += anywhere(distance < far)
                for i in range(n_near):
                    u = near[i]
                    k = exp(load(held, u, width) * -q)
                    for e in range(tangents):
                        along = (load(held, block + u, width) - layers[j, 0]) * load(
                            held, first_tangent + e * block + u, width
                        )
                        for d in range(1, dim):
                            w = load(held, (d + 1) * block + u, width) - layers[j, d]
                            along = along + w * load(held, first_tangent + (d * tangents + e) * block + u, width)
                        along = where(k > 0.0, -2.0 * q * k * along, k)  # 0·inf is not a number
                        for d in range(dim):
                            place = first_tangent + (d * tangents + e) * block + u
                            store(held, place, load(held, place, width) + along * layers[j, dim + d])
                    for d in range(dim):
                        place = (d + 1) * block + u
                        store(held, place, load(held, place, width) + k * layers[j, dim + d])
            for i in range(count):
                spoilt = 0.0  # NaN if one coordinate is
                for d in range(dim):
                    spoilt += nan_or_zero(held[(d + 1) * block + i])
                for d in range(dim):
                    x_out[begin + i, d] = held[(d + 1) * block + i] + spoilt
                for e in range(dim * tangents):
                    t_out[begin + i, e] = held[first_tangent + e * block + i] + spoilt

    return compiled(sweep, _signature(5))


@cache
def inverse_kernel(dim: int) -> Any:
    """ψ⁻¹ of points: (m, n) -> (m, n).

    Each layer is one root of s = exp(-(A s² - 2 B s + C)) in [0, 1], A = ρ²‖v‖², B = ρ² v·(y-c), C = ρ²‖y-c‖². Vectors
    of points whose roots are found drop out of the iteration.
    """
    width, block = WIDTH, BLOCK
    at_b, at_s, at_low, at_high, at_x = (row * block for row in range(1, 6))

    def inverse(layers: Array, y: Array, x_out: Array) -> None:
        held = np.empty((5 + dim) * block)  # C; B; s; its bracket; coordinates
        near = np.empty(block, np.int64)
        for begin in range(0, len(y), block):
            count = min(block, len(y) - begin)
            padded = (count + width - 1) // width * width
            for i in range(padded):
                for d in range(dim):
                    held[at_x + d * block + i] = y[begin + min(i, count - 1), d]
            for j in range(len(layers) - 1, -1, -1):
                q, a = layers[j, 2 * dim], layers[j, 2 * dim + 1]
                n_near = 0
                for u in range(0, padded, width):
                    w = load(held, at_x + u, width) - layers[j, 0]
                    c = w * w
                    b = w * layers[j, dim]
                    for d in range(1, dim):
                        w = load(held, at_x + d * block + u, width) - layers[j, d]
                        c = c + w * w
                        b = b + w * layers[j, dim + d]
                    c = c * q
                    store(held, u, c)
                    store(held, at_b + u, b * q)
                    near[n_near] = u
                    n_near += anywhere(c < BEYOND)
                for i in range(n_near):
                    u = near[i]
                    s = first_root(load(held, at_b + u, width), load(held, u, width))
                    store(held, at_s + u, s)
                    store(held, at_low + u, s * 0.0)
                    store(held, at_high + u, s * 0.0 + 1.0)
                n_open = n_near
                for _ in range(64):
                    n_left = 0
                    for i in range(n_open):
                        u = near[i]
                        s, low, high, still = next_root(
                            load(held, at_s + u, width),
                            load(held, at_low + u, width),
                            load(held, at_high + u, width),
                            a,
                            load(held, at_b + u, width),
                            load(held, u, width),
                        )
                        store(held, at_s + u, s)
                        store(held, at_low + u, low)
                        store(held, at_high + u, high)
                        near[i], near[n_left] = near[n_left], u
                        n_left += anywhere(still)
                    n_open = n_left
                    if n_open == 0:
                        break
                for i in range(n_near):
                    u = near[i]
                    s = where(load(held, u, width) > 720.0, 0.0, load(held, at_s + u, width))
                    for d in range(dim):
                        place = at_x + d * block + u
                        store(held, place, load(held, place, width) - s * layers[j, dim + d])
            for i in range(count):
                spoilt = 0.0
                for d in range(dim):
                    spoilt += nan_or_zero(held[at_x + d * block + i])
                for d in range(dim):
                    x_out[begin + i, d] = held[at_x + d * block + i] + spoilt

    return compiled(inverse, _signature(3))


def _signature(n_arrays: int) -> str:
    return f"void({', '.join(['float64[:, ::1]'] * n_arrays)})"
