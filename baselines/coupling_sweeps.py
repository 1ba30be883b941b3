"""Affine couplings and the speed network of SDS-EF in float64, compiled: eight features at a time, point by point.

Parameters come flat, as :class:`baselines.couplings.AffineCouplings` keeps them: of every layer W (2, a, F), b (2, F)
and A (2, b, F), log-scale first, where the layer reads a coordinates and moves b. Coordinate i of the part that layer l
reads is 2 i + l % 2; of the part that it moves, 2 i + 1 - l % 2.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numba
import numpy as np

from latentds.arguments import Array
from latentds.kernels.compiling import OPTIONS, compiled
from latentds.kernels.lanes import WIDTH, anywhere, load, store

N_UNITS = 100
"""In each hidden layer of the speed network."""
LEAK = 0.01
"""Slope of the speed network's leaky ReLUs below 0."""
_ROUND = 1.5 * 2.0**52
"""Adding and subtracting it rounds to a whole number."""
_PI_A, _PI_B = 3.140625, float(np.float32(math.pi - 3.140625))
_PI_C = math.pi - _PI_A - _PI_B + 1.2246467991473532e-16
"""π in three parts, the first two of so few bits that their products with whole numbers below 2^21 are exact."""
_FAR = 3e6
"""Angle above which they are not, and the standard library takes over."""
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11 = ((-1) ** k / math.factorial(2 * k) for k in range(12))
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10 = ((-1) ** k / math.factorial(2 * k + 1) for k in range(11))
"""Taylor's series on |r| <= π/2, to 1e-16."""


_inlined: Any = numba.njit(forceinline=True, **OPTIONS)
"""For longer functions: of one that is called each kernel brings a copy of its own, rounded in its own way."""


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _reduced(x: Any) -> Any:
    """r in [-π/2, π/2] and a sign with cos x = sign cos r, sin x = sign sin r."""
    turns = (x * (1 / math.pi) + _ROUND) - _ROUND
    odd = turns - 2.0 * ((turns * 0.5 + _ROUND) - _ROUND)
    return ((x - turns * _PI_A) - turns * _PI_B) - turns * _PI_C, 1.0 - 2.0 * odd * odd


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _cosine(r: Any) -> Any:
    z = r * r
    high = (((_C11 * z + _C10) * z + _C9) * z + _C8) * z + _C7
    return ((((((high * z + _C6) * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _sine(r: Any) -> Any:
    z = r * r
    high = (((_S10 * z + _S9) * z + _S8) * z + _S7) * z + _S6
    return r * ((((((high * z + _S5) * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0)


@_inlined  # type: ignore[untyped-decorator]
def _waves_one_by_one(
    W: Array, b: Array, count: int, part: int, state: Array, cosines: Array, sines: Array, begin: int, end: int
) -> None:
    for f in range(begin, end):
        angle = b[f]
        for k in range((len(state) + 1 - part) // 2):
            angle += W[k * count + f] * state[2 * k + part]
        cosines[f] = math.cos(angle)
        if len(sines) > 0:
            sines[f] = math.sin(angle)


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _waves(W: Array, b: Array, count: int, part: int, state: Array, cosines: Array, sines: Array) -> None:
    """cos and sin of W p + b, p the part of a point ``state`` (n,) that is read; no sines if there is no room."""
    read = (len(state) + 1 - part) // 2
    whole = count // WIDTH * WIDTH
    for u in range(0, whole, WIDTH):
        angle = load(b, u, WIDTH)
        for k in range(read):
            angle = angle + load(W, k * count + u, WIDTH) * state[2 * k + part]
        r, sign = _reduced(angle)
        store(cosines, u, sign * _cosine(r))
        if len(sines) > 0:
            store(sines, u, sign * _sine(r))
        if anywhere(angle * angle > _FAR * _FAR):
            _waves_one_by_one(W, b, count, part, state, cosines, sines, u, u + WIDTH)
    _waves_one_by_one(W, b, count, part, state, cosines, sines, whole, count)


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _dot(one: Array, i: int, other: Array, j: int, count: int, parts: Array) -> Any:
    """Of ``count`` entries from i and from j on; the second half of ``parts`` is zeros, as at the start."""
    zero = load(parts, WIDTH, WIDTH)
    first, second = zero, zero  # each sum waits for its last addition
    whole, twice = count // WIDTH * WIDTH, count // (2 * WIDTH) * 2 * WIDTH
    for u in range(0, twice, 2 * WIDTH):
        first = first + load(one, i + u, WIDTH) * load(other, j + u, WIDTH)
        second = second + load(one, i + u + WIDTH, WIDTH) * load(other, j + u + WIDTH, WIDTH)
    for u in range(twice, whole, WIDTH):
        first = first + load(one, i + u, WIDTH) * load(other, j + u, WIDTH)
    total = first + second
    store(parts, 0, total)
    rest = parts.sum()
    for f in range(whole, count):
        rest += one[i + f] * other[j + f]
    return rest


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _dot3(one: Array, i: int, other: Array, j: int, third: Array, count: int, parts: Array) -> Any:
    """Σ of products of three: from i, from j and from 0 on."""
    total = load(parts, WIDTH, WIDTH)
    whole = count // WIDTH * WIDTH
    for u in range(0, whole, WIDTH):
        total = total + load(one, i + u, WIDTH) * load(other, j + u, WIDTH) * load(third, u, WIDTH)
    store(parts, 0, total)
    rest = parts.sum()
    for f in range(whole, count):
        rest += one[i + f] * other[j + f] * third[f]
    return rest


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def room_for(dim: int, count: int) -> Any:
    """How many numbers :func:`_encode_one` works in."""
    wide = (dim + 1) // 2
    return 2 * count + 2 * WIDTH + 2 * wide * (1 + wide)


@_inlined  # type: ignore[untyped-decorator]
def _encode_one(W: Array, phases: Array, A: Array, state: Array, kept: Array, room: Array) -> None:
    """A normalised point ``state`` (n,) through all layers, in place; ``kept`` as the kernel's, or (0, 0)."""
    dim, (n_layers, _, count) = len(state), phases.shape
    wide, slopes = (dim + 1) // 2, len(kept) > 0
    cosines, sines, parts = room[:count], room[count : 2 * count if slopes else count], room[2 * count :][: 2 * WIDTH]
    parts[:] = 0.0
    values = room[2 * count + 2 * WIDTH :][: 2 * wide].reshape(2, wide)
    steep = room[2 * count + 2 * WIDTH + 2 * wide :][: 2 * wide * wide].reshape(2, wide, wide)
    w0 = a0 = 0
    for layer in range(n_layers):
        part = layer % 2
        read = (dim + 1 - part) // 2
        moved = dim - read
        for h in range(2):
            _waves(W[w0:], phases[layer, h], count, part, state, cosines, sines)
            for i in range(moved):
                values[h, i] = _dot(A, a0, cosines, 0, count, parts)
                for k in range(read if slopes else 0):
                    steep[h, i, k] = -_dot3(A, a0, W, w0 + k * count, sines, count, parts)
                a0 += count
            w0 += read * count
        for i in range(moved):
            q = 2 * i + 1 - part
            grown = state[q] * math.exp(values[0, i])
            state[q] = grown + values[1, i]
            if slopes:
                kept[layer, i] = math.exp(-values[0, i])
                for k in range(read):
                    kept[layer, wide + i * wide + k] = grown * steep[0, i, k] + steep[1, i, k]


@cache
def encode_kernel() -> Any:
    """φ of points, (m, n) -> (m, n); and what :func:`push_kernel` needs of every layer and point, if there is room.

    ``box`` (2, n) holds center and scale. ``kept`` (m, L, h (1 + h)), h = ⌈n/2⌉, or (0, 0, 0), receives of every
    coordinate that a layer moves exp(-s), then the slopes of what it becomes by those that the layer reads.
    """

    def encode(W: Array, phases: Array, A: Array, box: Array, y: Array, x_out: Array, kept: Array) -> None:
        dim, nothing = y.shape[1], np.empty((0, 0))
        room = np.empty(room_for(dim, phases.shape[2]))
        for row in range(len(y)):
            for d in range(dim):
                x_out[row, d] = (y[row, d] - box[0, d]) / box[1, d]
            _encode_one(W, phases, A, x_out[row], kept[row] if len(kept) > 0 else nothing, room)

    return compiled(
        encode,
        "void(float64[::1], float64[:, :, ::1], float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], "
        "float64[:, :, ::1])",
    )


@cache
def push_kernel() -> Any:
    """Tangents (S, m, n) through the inverses of the layers, the last first, by what an encoding kept: J_ψ t."""

    def push(box: Array, kept: Array, tangents: Array, out: Array) -> None:
        dim = tangents.shape[2]
        for s in range(len(tangents)):
            for row in range(tangents.shape[1]):
                pushed = out[s, row]
                for d in range(dim):
                    pushed[d] = tangents[s, row, d]
                _pull_through(kept[row], pushed)
                for d in range(dim):
                    pushed[d] *= box[1, d]

    return compiled(push, f"void(float64[:, ::1], {', '.join(['float64[:, :, ::1]'] * 3)})")


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _pull_through(kept: Array, tangent: Array) -> None:
    """A tangent (n,) through the inverses of all layers, in place."""
    dim = len(tangent)
    wide = (dim + 1) // 2
    for layer in range(len(kept) - 1, -1, -1):
        part = layer % 2
        read = (dim + 1 - part) // 2
        for i in range(dim - read):
            rest = tangent[2 * i + 1 - part]
            for k in range(read):
                rest -= kept[layer, wide + i * wide + k] * tangent[2 * k + part]
            tangent[2 * i + 1 - part] = rest * kept[layer, i]


@cache
def decode_kernel() -> Any:
    """ψ of latent points, (m, n) -> (m, n)."""

    def decode(W: Array, phases: Array, A: Array, box: Array, x: Array, y_out: Array) -> None:
        dim, (n_layers, _, count) = x.shape[1], phases.shape
        cosines, none, parts = np.empty(count), np.empty(0), np.zeros(2 * WIDTH)
        values = np.empty((2, (dim + 1) // 2))
        for row in range(len(x)):
            state = y_out[row]
            for d in range(dim):
                state[d] = x[row, d]
            w0, a0 = len(W), len(A)
            for layer in range(n_layers - 1, -1, -1):
                part = layer % 2
                read = (dim + 1 - part) // 2
                moved = dim - read
                for h in range(1, -1, -1):
                    w0 -= read * count
                    a0 -= moved * count
                    _waves(W[w0:], phases[layer, h], count, part, state, cosines, none)
                    for i in range(moved):
                        values[h, i] = _dot(A, a0 + i * count, cosines, 0, count, parts)
                for i in range(moved):
                    q = 2 * i + 1 - part
                    state[q] = (state[q] - values[1, i]) * math.exp(-values[0, i])
            for d in range(dim):
                state[d] = state[d] * box[1, d] + box[0, d]

    return compiled(
        decode,
        "void(float64[::1], float64[:, :, ::1], float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1])",
    )


@cache
def speed_kernel() -> Any:
    """exp(g(u)) / duration of points, (m, n) -> (m,); ``ends`` holds the range of g and the duration."""

    def speed(box: Array, network: Array, ends: Array, y: Array, out: Array) -> None:
        dim = y.shape[1]
        u, room = np.empty(dim), np.zeros(2 * N_UNITS + 2 * WIDTH)
        for row in range(len(y)):
            for d in range(dim):
                u[d] = (y[row, d] - box[0, d]) / box[1, d]
            out[row] = math.exp(_log_speed(network, ends, u, room)) / ends[2]

    signature = "void(float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[::1])"
    return compiled(speed, signature)


@_inlined  # type: ignore[untyped-decorator]
def _log_speed(network: Array, ends: Array, u: Array, room: Array) -> Any:
    """g(u) held within ``ends``: two layers of leaky ReLUs and a sum; ``network`` holds W (out, in) and b in turns."""
    dim = len(u)
    first, second, parts = room[:N_UNITS], room[N_UNITS : 2 * N_UNITS], room[2 * N_UNITS :]
    at = dim * N_UNITS
    for i in range(N_UNITS):
        total = network[at + i]
        for d in range(dim):
            total += network[i * dim + d] * u[d]
        first[i] = max(total, LEAK * total)
    at += N_UNITS
    for i in range(N_UNITS):
        total = network[at + N_UNITS * N_UNITS + i] + _dot(network, at + i * N_UNITS, first, 0, N_UNITS, parts)
        second[i] = max(total, LEAK * total)
    at += N_UNITS * N_UNITS + N_UNITS
    log_speed = network[at + N_UNITS] + _dot(network, at, second, 0, N_UNITS, parts)
    return log_speed if np.isnan(log_speed) else min(max(log_speed, ends[0]), ends[1])


@cache
def field_kernel() -> Any:
    """The velocity of SDS-EF at points one by one, (m, n) -> (m, n); False if one is not finite.

    ``latent`` (n + 1,) holds x* and the guard. The last row of ``room`` (r, n + 2) is given: a shift (n) of the points,
    and the speed and the limit of the velocity; there are no ``slopes``.
    """

    def field(
        W: Array,
        phases: Array,
        A: Array,
        box: Array,
        network: Array,
        ends: Array,
        latent: Array,
        y: Array,
        out: Array,
        slopes: Array,
        room: Array,
    ) -> bool:
        dim, (n_layers, _, count) = y.shape[1], phases.shape
        asked, flat = room[len(room) - 1], room.reshape(room.size)
        wide, work = (dim + 1) // 2, flat[2 * dim :]
        u, state = flat[:dim], flat[dim : 2 * dim]
        kept = work[: n_layers * wide * (1 + wide)].reshape(n_layers, wide * (1 + wide))
        own = work[kept.size :][: room_for(dim, count)]
        hidden = work[kept.size + own.size :][: 2 * N_UNITS + 2 * WIDTH]
        for row in range(len(y)):
            velocity = out[row]
            for d in range(dim):
                if not np.isfinite(y[row, d]):
                    return False
                u[d] = (y[row, d] - asked[d] - box[0, d]) / box[1, d]
                state[d] = u[d]
            _encode_one(W, phases, A, state, kept, own)
            squared = 0.0
            for d in range(dim):
                velocity[d] = state[d] - latent[d]
                squared += velocity[d] ** 2
            hidden[:] = 0.0
            speed = math.exp(_log_speed(network, ends, u, hidden)) / ends[2]
            factor = -speed / max(math.sqrt(squared), latent[dim])
            _pull_through(kept, velocity)
            squared = 0.0
            for d in range(dim):
                velocity[d] *= factor * box[1, d]
                squared += velocity[d] ** 2
            faster = asked[dim]
            if asked[dim + 1] < np.inf and faster * math.sqrt(squared) > asked[dim + 1]:
                faster = asked[dim + 1] / math.sqrt(squared)
            for d in range(dim):
                velocity[d] *= faster
        return True

    flat, table, stack = "float64[::1]", "float64[:, ::1]", "float64[:, :, ::1]"
    arrays = [flat, stack, flat, table, flat, flat, flat, table, table, table, table]
    return compiled(field, f"boolean({', '.join(arrays)})")
