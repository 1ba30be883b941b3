"""Compiled sweep through affine couplings and its hand-written backward, for training on the CPU in float32.

Per point and feature: two products, one sine and cosine, and what follows from them, in registers and L1. Nothing of
size N F is stored; the backward pass computes the cosines again, which is cheaper than fetching them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from latentds.kernels.compiling import cached

F32 = np.float32
Array = Any
"""A float32 array in compiled code."""


class Couplings:
    """Frozen features of couplings, laid out for the kernels.

    Args:
        frequencies, phases: as :class:`baselines.couplings.AffineCouplings` keeps them.
    """

    def __init__(self, frequencies: Tensor, phases: Tensor) -> None:
        self.frequencies, self.phases = frequencies.numpy(), phases.numpy()

    def linearize(self, u: Tensor, amplitudes: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """φ(u), and the map of tangents (..., N, n) by the inverse of its Jacobian. Differentiable once.

        Args:
            u: (N, n).
            amplitudes: flat.
        """
        x, inverse_scale, slope = _Sweep.apply(u, amplitudes, self)  # type: ignore[no-untyped-call]

        def push(tangent: Tensor) -> Tensor:
            stack = tangent.reshape(-1, *u.shape)
            pushed: Tensor = _Push.apply(stack, inverse_scale, slope)  # type: ignore[no-untyped-call]
            return pushed.reshape(tangent.shape)

        return x, push


class _Sweep(torch.autograd.Function):
    """φ(u), and of every layer's inverse the scale (N, L, h) and the slope (N, L, h, h), h = ⌈n/2⌉."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, amplitudes: Tensor, couplings: Couplings) -> tuple[Tensor, Tensor, Tensor]:
        (n_points, dim), (n_layers, _, _) = u.shape, couplings.phases.shape
        wide = (dim + 1) // 2
        states = np.empty((n_points, n_layers + 1, dim), F32)
        grown = np.zeros((n_points, n_layers, wide), F32)
        affine = np.zeros((n_points, n_layers, 2, wide), F32)
        slopes = np.zeros((n_points, n_layers, 2, wide, wide), F32)
        states[:, 0] = u.numpy()
        given = couplings.frequencies, couplings.phases, amplitudes.numpy()
        _forward(*given, states, grown, affine, slopes)
        ctx.given, ctx.seen = given, (states, grown, affine, slopes)
        slope = grown[..., None] * slopes[:, :, 0] + slopes[:, :, 1]
        results = states[:, -1].copy(), np.exp(-affine[:, :, 0]), slope
        return torch.from_numpy(results[0]), torch.from_numpy(results[1]), torch.from_numpy(results[2])

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, to_x: Tensor, to_inverse_scale: Tensor, to_slope: Tensor) -> tuple[Tensor, Tensor, None]:
        gradient = to_x.contiguous().clone().numpy()
        to_amplitudes = np.zeros_like(ctx.given[2])
        others = to_inverse_scale.contiguous().numpy(), to_slope.contiguous().numpy()
        _backward(gradient, *others, *ctx.given, *ctx.seen, to_amplitudes)
        return torch.from_numpy(gradient), torch.from_numpy(to_amplitudes), None


class _Push(torch.autograd.Function):
    """Tangents (S, N, n) through the layers' inverses, last layer first."""

    @staticmethod
    def forward(ctx: Any, tangents: Tensor, inverse_scale: Tensor, slope: Tensor) -> Tensor:
        count, n_points, dim = tangents.shape
        ctx.seen = (
            np.empty((count, n_points, inverse_scale.shape[1] + 1, dim), F32),
            inverse_scale.numpy(),
            slope.numpy(),
        )
        ctx.seen[0][:, :, -1] = tangents.numpy()
        _push_forward(*ctx.seen)
        return torch.from_numpy(ctx.seen[0][:, :, 0].copy())

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, to_pushed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        to_scale, to_slope = (torch.zeros(part.shape, dtype=torch.float32) for part in ctx.seen[1:])
        results = to_pushed.contiguous().clone(), to_scale, to_slope
        _push_backward(*ctx.seen, *(part.numpy() for part in results))
        return results


_compiled = cached(fastmath=True, nogil=True)

# Inlined in any case: of a function that is called, each kernel brings its own copy, rounded in its own way, and which
# one a process ends up with would depend on what it found compiled on disk.
_inlined = numba.njit(fastmath=True, nogil=True, forceinline=True)


# Coordinate i of the part that layer l reads is 2 i + l % 2; of the part that it moves, 2 i + 1 - l % 2. Rows are
# sliced before they are looped over: an index known to be positive is what lets the compiler vectorise the loop.


@_compiled
def _forward(W: Array, b: Array, A: Array, states: Array, grown: Array, affine: Array, slopes: Array) -> None:
    n_points, _, dim = states.shape
    n_layers, _, n_features = b.shape
    cosines, sines = np.empty(n_features, F32), np.empty(n_features, F32)
    for j in range(n_points):
        w0 = a0 = 0
        for layer in range(n_layers):
            part = layer % 2
            read = (dim + 1 - part) // 2
            moved = dim - read
            state, later = states[j, layer], states[j, layer + 1]
            for h in range(2):
                _waves(W, b[layer, h], state[part::2], w0 + h * read * n_features, cosines, sines)
                for i in range(moved):
                    o = a0 + (h * moved + i) * n_features
                    affine[j, layer, h, i] = _dot(A[o : o + n_features], cosines)
                    for k in range(read):
                        w = w0 + (h * read + k) * n_features
                        slopes[j, layer, h, i, k] = -_dot3(A[o : o + n_features], W[w : w + n_features], sines)
            for k in range(read):
                later[2 * k + part] = state[2 * k + part]
            for i in range(moved):
                q = 2 * i + 1 - part
                grown[j, layer, i] = state[q] * math.exp(affine[j, layer, 0, i])
                later[q] = grown[j, layer, i] + affine[j, layer, 1, i]
            w0 += 2 * read * n_features
            a0 += 2 * moved * n_features


@_compiled
def _backward(
    gradient: Array,
    to_inverse_scale: Array,
    to_slope: Array,
    W: Array,
    b: Array,
    A: Array,
    states: Array,
    grown: Array,
    affine: Array,
    slopes: Array,
    to_A: Array,
) -> None:
    """``gradient`` enters as the cotangent of φ(u) and leaves as that of u."""
    n_points, dim = gradient.shape
    n_layers, _, n_features = b.shape
    wide = (dim + 1) // 2
    cosines, sines = np.empty(n_features, F32), np.empty(n_features, F32)
    to_angles, mixed = np.empty(n_features, F32), np.empty(n_features, F32)
    to_slopes, to_affine, to_moved = np.empty((2, wide, wide), F32), np.empty((2, wide), F32), np.empty(wide, F32)
    for j in range(n_points):
        w0, a0 = len(W), len(A)
        for layer in range(n_layers - 1, -1, -1):
            part = layer % 2
            read = (dim + 1 - part) // 2
            moved = dim - read
            w0 -= 2 * read * n_features
            a0 -= 2 * moved * n_features
            for i in range(moved):
                to_affine[1, i] = gradient[j, 2 * i + 1 - part]
                to_grown = to_affine[1, i]
                for k in range(read):
                    to_grown += to_slope[j, layer, i, k] * slopes[j, layer, 0, i, k]
                    to_slopes[0, i, k] = to_slope[j, layer, i, k] * grown[j, layer, i]
                    to_slopes[1, i, k] = to_slope[j, layer, i, k]
                growth = math.exp(affine[j, layer, 0, i])
                to_affine[0, i] = to_grown * grown[j, layer, i] - to_inverse_scale[j, layer, i] / growth
                to_moved[i] = to_grown * growth
            for h in range(2):
                _waves(W, b[layer, h], states[j, layer, part::2], w0 + h * read * n_features, cosines, sines)
                _clear(to_angles)
                for i in range(moved):
                    _clear(mixed)
                    for k in range(read):
                        w = w0 + (h * read + k) * n_features
                        _add(mixed, to_slopes[h, i, k], W[w : w + n_features])
                    o = a0 + (h * moved + i) * n_features
                    row, to_row, whole = A[o : o + n_features], to_A[o : o + n_features], to_affine[h, i]
                    _scatter(to_row, to_angles, row, whole, mixed, cosines, sines)
                for k in range(read):
                    w = w0 + (h * read + k) * n_features
                    gradient[j, 2 * k + part] += _dot(to_angles, W[w : w + n_features])
            for i in range(moved):
                gradient[j, 2 * i + 1 - part] = to_moved[i]


@_compiled
def _push_forward(tangents: Array, inverse_scale: Array, slope: Array) -> None:
    """``tangents`` (S, N, L + 1, n) from what entered, at L, to what leaves, at 0."""
    count, n_points, depth, dim = tangents.shape
    for s in range(count):
        for j in range(n_points):
            for layer in range(depth - 2, -1, -1):
                part = layer % 2
                read = (dim + 1 - part) // 2
                before, after = tangents[s, j, layer + 1], tangents[s, j, layer]
                for k in range(read):
                    after[2 * k + part] = before[2 * k + part]
                for i in range(dim - read):
                    rest = before[2 * i + 1 - part]
                    for k in range(read):
                        rest -= slope[j, layer, i, k] * before[2 * k + part]
                    after[2 * i + 1 - part] = rest * inverse_scale[j, layer, i]


@_compiled
def _push_backward(
    tangents: Array, inverse_scale: Array, slope: Array, gradient: Array, to_inverse_scale: Array, to_slope: Array
) -> None:
    """``gradient`` enters as the cotangent of what left and leaves as that of what entered."""
    count, n_points, depth, dim = tangents.shape
    for s in range(count):
        for j in range(n_points):
            flow = gradient[s, j]
            for layer in range(depth - 1):
                part = layer % 2
                read = (dim + 1 - part) // 2
                before, after = tangents[s, j, layer + 1], tangents[s, j, layer]
                for i in range(dim - read):
                    q = 2 * i + 1 - part
                    to_inverse_scale[j, layer, i] += flow[q] * after[q] / inverse_scale[j, layer, i]
                    flow[q] *= inverse_scale[j, layer, i]
                    for k in range(read):
                        to_slope[j, layer, i, k] -= flow[q] * before[2 * k + part]
                        flow[2 * k + part] -= flow[q] * slope[j, layer, i, k]


@_inlined
def _waves(W: Array, phases: Array, p: Array, at: int, cosines: Array, sines: Array) -> None:
    """cos and sin of W p + b, to 1e-6 while the angles stay below 1e4."""
    n_features = len(phases)
    for f in range(n_features):
        cosines[f] = phases[f]
    for i in range(len(p)):
        _add(cosines, p[i], W[at + i * n_features : at + (i + 1) * n_features])
    _turn(cosines, sines)


@_inlined
def _turn(angles: Array, sines: Array) -> None:
    """``angles`` x into cos x, and sin x: x = k π + r, and Taylor series in r."""
    for f in range(len(angles)):
        x = angles[f]
        turns = np.floor(x * F32(1 / math.pi) + F32(0.5))
        r = (x - turns * F32(3.140625)) - turns * F32(math.pi - 3.140625)
        sign = F32(1) - F32(2) * (turns - F32(2) * np.floor(turns * F32(0.5)))
        z = r * r
        sine = F32(1 / 362880) + z * F32(-1 / 39916800)
        sine = F32(1) + z * (F32(-1 / 6) + z * (F32(1 / 120) + z * (F32(-1 / 5040) + z * sine)))
        cosine = F32(1 / 40320) + z * (F32(-1 / 3628800) + z * F32(1 / 479001600))
        cosine = F32(1) + z * (F32(-0.5) + z * (F32(1 / 24) + z * (F32(-1 / 720) + z * cosine)))
        sines[f] = sign * r * sine
        angles[f] = sign * cosine


@_inlined
def _scatter(
    to_row: Array, to_angles: Array, row: Array, whole: float, mixed: Array, cosines: Array, sines: Array
) -> None:
    for f in range(len(row)):
        to_row[f] += whole * cosines[f] - mixed[f] * sines[f]
        to_angles[f] -= row[f] * (whole * sines[f] + mixed[f] * cosines[f])


@_inlined
def _clear(row: Array) -> None:
    for f in range(len(row)):
        row[f] = F32(0)


@_inlined
def _add(target: Array, factor: float, row: Array) -> None:
    for f in range(len(target)):
        target[f] += factor * row[f]


@_inlined
def _dot(one: Array, other: Array) -> Any:
    total = F32(0)
    for f in range(len(one)):
        total += one[f] * other[f]
    return total


@_inlined
def _dot3(one: Array, other: Array, third: Array) -> Any:
    total = F32(0)
    for f in range(len(one)):
        total += one[f] * other[f] * third[f]
    return total
