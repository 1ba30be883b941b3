"""Compiled CPU kernels behind locally weighted translations, and the one rule that says when they run.

A kernel takes points in blocks, held coordinate by coordinate in the L1 cache, sends a block through all layers and
carries eight points at a time through the arithmetic (:mod:`latentds.lanes`). Layers that move no point of a vector
by a rounding error are skipped for it. Everything is computed in float64: a float32 module gets its answer rounded.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd import forward_ad

from .lanes import WIDTH, anywhere, either, load, power_of_two, store, where
from .time_law import TAIL

if TYPE_CHECKING:
    from .diffeomorphism import LocallyWeightedTranslations

Array = NDArray[np.float64]

BLOCK = 512
"""Points that go through the layers together: with what a layer needs of them they fit the L1 cache for n = 3."""

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}

_NEGLIGIBLE = 60.0
"""A layer with exp(-60) = 9e-27 of its translation at a point leaves the point as it is."""

_BEYOND = 80.0
"""ρ²‖y-c‖² from which the layer's solution s lies below exp(-60): √80 >= √60 + ρ‖v‖, since ρ‖v‖ < √(e/2)."""

_PARAMETERS = ("centers", "log_widths", "strengths")
_local = threading.local()


# --- the rule ---------------------------------------------------------------------------------------------------------


def serves(module: nn.Module, *tensors: Tensor) -> bool:
    """Whether the kernels may compute ``module`` at ``tensors``; if not, the caller takes the torch path.

    They serve plain CPU tensors in the module's own float32 or float64 of which no derivative is asked. Never under
    torch.func, forward-mode differentiation, tracing, compiling, export or any active torch mode: those see a torch
    operation only when there is one. If grad mode is on and only the parameters require a gradient, the kernels
    compute the value, and the backward pass recomputes it by the torch path.
    """
    if not _alone() or (torch.is_grad_enabled() and any(t.requires_grad for t in tensors)):
        return False
    learned = [module._parameters.get(name) for name in _PARAMETERS]
    dtype = tensors[0].dtype
    return dtype in (torch.float64, torch.float32) and all(_plain(t, dtype) for t in (*tensors, *learned))


def _alone() -> bool:
    """Whether nobody watches or transforms torch operations at the moment."""
    return not (
        torch.compiler.is_compiling()
        or torch._C._get_tracing_state() is not None
        or getattr(_local, "reference", False)
        or torch._C._len_torch_function_stack()
        or torch._C._len_torch_dispatch_stack()
        or torch._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
    )


def _plain(tensor: Any, dtype: torch.dtype) -> bool:
    return type(tensor) in (Tensor, nn.Parameter) and tensor.is_cpu and tensor.dtype is dtype and not tensor.is_neg()


@contextmanager
def reference() -> Iterator[None]:
    """Within this context, in this thread, everything takes the torch path."""
    before, _local.reference = getattr(_local, "reference", False), True
    try:
        yield
    finally:
        _local.reference = before


class _Recomputed(torch.autograd.Function):
    """A value from a kernel whose backward pass runs the torch path again, on the very tensors of the forward pass."""

    @staticmethod
    def forward(
        ctx: Any,
        compute: Callable[..., Tensor],
        torch_path: Callable[..., Tensor],
        module: nn.Module,
        *tensors: Tensor,
    ) -> Tensor:
        ctx.torch_path, ctx.module = torch_path, module
        ctx.save_for_backward(*tensors)
        return compute(*tensors[: -len(_PARAMETERS)])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        again = torch.is_grad_enabled()
        with torch.enable_grad(), reference():
            # Views, so that the gradient for one input does not also flow through another made from it.
            inputs = [tensor.view_as(tensor) for tensor in ctx.saved_tensors]
            points, learned = inputs[: -len(_PARAMETERS)], inputs[-len(_PARAMETERS) :]
            twin: Any = object.__new__(type(ctx.module))
            twin.__dict__.update(ctx.module.__dict__, _parameters=dict(zip(_PARAMETERS, learned, strict=True)))
            value = ctx.torch_path(twin, *points)
        asked = [tensor for tensor, needed in zip(inputs, ctx.needs_input_grad[3:], strict=True) if needed]
        found = iter(torch.autograd.grad(value, asked, gradient, create_graph=again, allow_unused=True))
        return None, None, None, *(next(found) if needed else None for needed in ctx.needs_input_grad[3:])


def _evaluate(
    compute: Callable[..., Tensor], torch_path: Callable[..., Tensor], module: nn.Module, *tensors: Tensor
) -> Tensor:
    """``compute`` of the tensors, with a graph that leads to ``torch_path`` of the module if one is asked for."""
    if torch.is_grad_enabled():
        learned = [module._parameters[name] for name in _PARAMETERS]
        if any(t.requires_grad for t in (*tensors, *learned)):  # type: ignore[union-attr]
            return _Recomputed.apply(compute, torch_path, module, *tensors, *learned)  # type: ignore[no-any-return,no-untyped-call]
    return compute(*tensors)


# --- what diffeomorphism.py calls -------------------------------------------------------------------------------------


def forward(module: LocallyWeightedTranslations, x: Tensor) -> Tensor:
    return _evaluate(partial(_forward, layers_of(module)), type(module).forward, module, x)


def inverse(module: LocallyWeightedTranslations, y: Tensor) -> Tensor:
    return _evaluate(partial(_inverse, layers_of(module)), type(module).inverse, module, y)


def jacobian(module: LocallyWeightedTranslations, x: Tensor) -> Tensor:
    return _evaluate(partial(_jacobian, layers_of(module)), type(module).jacobian, module, x)


def linearize(module: LocallyWeightedTranslations, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    layers = layers_of(module)
    x = _evaluate(partial(_inverse, layers), type(module).inverse, module, y)

    def push(tangent: Tensor) -> Tensor:
        if not (_alone() and _plain(tangent, x.dtype)):
            return _pushed(module, x, tangent)
        points, tangents = torch.broadcast_tensors(x, tangent)  # type: ignore[no-untyped-call]
        return _evaluate(partial(_push, layers), _pushed, module, points, tangents)

    return x, push


def _pushed(module: LocallyWeightedTranslations, x: Tensor, tangent: Tensor) -> Tensor:
    return (module.jacobian(x) @ tangent.unsqueeze(-1)).squeeze(-1)


def _forward(layers: Array, x: Tensor) -> Tensor:
    points = _rows(x)
    out, nothing = np.empty_like(points), np.empty((1, 0))
    kernel = partial(_sweep, points.shape[1], 0)
    _run(kernel, layers, points, nothing, out, np.empty((len(points), 0)))
    return _tensor(out, x, x.shape)


def _inverse(layers: Array, y: Tensor) -> Tensor:
    points = _rows(y)
    out = np.empty_like(points)
    _run(partial(_unwind, points.shape[1]), layers, points, out)
    return _tensor(out, y, y.shape)


def _push(layers: Array, x: Tensor, tangent: Tensor) -> Tensor:
    points, tangents = _rows(x), _rows(tangent)
    moved, out = np.empty_like(points), np.empty_like(tangents)
    _run(partial(_sweep, points.shape[1], 1), layers, points, tangents, moved, out)
    return _tensor(out, x, x.shape)


def _jacobian(layers: Array, x: Tensor) -> Tensor:
    points, dim = _rows(x), x.shape[-1]
    moved, out = np.empty_like(points), np.empty((len(points), dim * dim))
    _run(partial(_sweep, dim, dim), layers, points, np.eye(dim).reshape(1, -1), moved, out)
    return _tensor(out, x, (*x.shape, dim))


def layers_of(module: LocallyWeightedTranslations) -> Array:
    """The layers as the kernels read them, a row (c, v, ρ², ρ²‖v‖²) each: (M, 2n+2).

    Made anew for every call, in some microseconds, so that it is never stale.
    """
    arrays = [module._parameters[name].detach().numpy() for name in _PARAMETERS]  # type: ignore[union-attr]
    return _pack()(*(np.ascontiguousarray(a, dtype=np.float64) for a in arrays))  # type: ignore[no-any-return]


def _rows(x: Tensor) -> Array:
    points = x.detach().numpy()
    return np.ascontiguousarray(points.reshape(points.size // points.shape[-1], points.shape[-1]), np.float64)


def _tensor(rows: Array, like: Tensor, shape: Sequence[int]) -> Tensor:
    return torch.from_numpy(rows).to(like.dtype).reshape(shape)


# --- cores ------------------------------------------------------------------------------------------------------------

_ALONE = 300_000
"""Point-layers below which a second core costs more than it brings."""

_pool: ThreadPoolExecutor | None = None
_pool_owner = 0


def _run(kernel_for: Callable[[int], Callable[..., None]], layers: Array, *by_row: Array) -> None:
    """Call a kernel on rows of points, on as many cores as torch may use here for a large batch."""
    count = len(by_row[-1])
    if count == 0:
        return
    kernel = kernel_for(1 if count == 1 else BLOCK)
    cores = min(torch.get_num_threads(), _available_cores()) if count * len(layers) > _ALONE else 1
    if cores == 1:
        kernel(layers, *by_row)
        return
    share = -(-count // (2 * cores * BLOCK)) * BLOCK
    cuts = range(0, count, share)
    tasks = [
        _workers(cores).submit(kernel, layers, *(a[cut : cut + share] if len(a) == count else a for a in by_row))
        for cut in cuts
    ]
    for task in tasks:
        task.result()


def _available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _workers(cores: int) -> ThreadPoolExecutor:
    """Our own threads, so that no global thread count is touched; new ones after a fork, which copies none."""
    global _pool, _pool_owner
    if _pool is None or _pool_owner != os.getpid():
        _pool, _pool_owner = ThreadPoolExecutor(max(cores, _available_cores()), "latentds"), os.getpid()
    return _pool


# --- compiling --------------------------------------------------------------------------------------------------------


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with its cache on disk, or without where no place for one can be written (a read-only install)."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            return numba.njit(**options)(function)

    return decorate


def compiled(function: Callable[..., Any], signature: str) -> Any:
    """``function`` as machine code, from the cache on disk if it is there; says so if compiling took over a second."""
    began = time.perf_counter()
    kernel = cached(**OPTIONS)(function)
    kernel.compile(signature)
    seconds = time.perf_counter() - began
    if seconds > 1 and not kernel.stats.cache_hits:
        print(f"latentds: compiled {function.__name__} for this CPU in {seconds:.1f} s", file=sys.stderr)
    return kernel


def warmup(dims: Sequence[int] = (2, 3)) -> None:
    """Compile the kernels for points of these dimensions now; otherwise their first use does, some seconds each."""
    for dim in dims:
        for block in (1, BLOCK):
            _unwind(dim, block)
            for tangents in {0, 1, dim}:
                _sweep(dim, tangents, block)
        steer(dim)
    _pack()
    greedy()


# --- kernels ----------------------------------------------------------------------------------------------------------

_LOG2_E = 1.4426950408889634
_LN_2 = 0.6931471805599453
_SHIFT = 1.5 * 2.0**52 + 1023
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10 = (
    1.0, 1.0000000000000069, 0.5000000000000006, 0.16666666666553953, 0.04166666666657277, 0.008333333385825085,
    0.0013888888932619635, 0.00019841170071970308, 2.4801504180837137e-05, 2.7640263790318923e-06,
    2.7626426376580335e-07,
)  # fmt: skip
"""Chebyshev interpolation of e^r on |r| <= ln(2)/2: relative error 3.4e-16."""


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _exp(x: Any) -> Any:
    """e^x for x <= 0, and exactly 0 below -650, where results near the denormal numbers would take 14 times as long.

    x = n ln 2 + r; adding 1.5·2^52 rounds to the whole number n.
    """
    t = x * _LOG2_E + _SHIFT
    r = x - (t - _SHIFT) * _LN_2
    z = r * r
    even = ((((_P10 * z + _P8) * z + _P6) * z + _P4) * z + _P2) * z + _P0
    odd = (((_P9 * z + _P7) * z + _P5) * z + _P3) * z + _P1
    return where(x > -650.0, (odd * r + even) * power_of_two(t), 0.0)


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _doubt(x: float) -> float:
    """0, or NaN of NaN: a row with one is NaN in all coordinates, as on the torch path."""
    return x if np.isnan(x) else 0.0


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _first_root(b: Any, c: Any) -> Any:
    """A Newton step from 0 towards the root s of s = exp(-(A s² - 2 B s + C)), held in [0, 1]."""
    k = _exp(c * -1.0)
    slope = 1.0 - 2.0 * k * b
    s = where(slope > 0.3, k / slope, 3.0 * k)
    return where(s > 1.0, 1.0, s)


@numba.njit(inline="always", **OPTIONS)  # type: ignore[untyped-decorator]
def _next_root(s: Any, low: Any, high: Any, a: Any, b: Any, c: Any) -> Any:
    """A better s, its bracket, and whether yet another step would change it.

    Halley's method, as two derivatives cost less than another exponential, inside a shrinking bracket. It is done
    when a bound of the next step is lost in rounding.
    """
    g = b - a * s
    exponent = (g + b) * s - c
    k = _exp(where(exponent > 0.0, 0.0, exponent))
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
def _pack() -> Any:
    return compiled(pack, "float64[:, ::1](float64[:, ::1], float64[::1], float64[:, ::1])")


def pack(centers: Array, log_widths: Array, strengths: Array) -> Array:
    count, dim = centers.shape
    layers = np.empty((count, 2 * dim + 2))
    for j in range(count):
        width = np.exp(log_widths[j])
        squared = 0.0
        for d in range(dim):
            squared += strengths[j, d] ** 2
        scale = np.sqrt(np.e / 2 / (1 + squared)) / width
        for d in range(dim):
            layers[j, d] = centers[j, d]
            layers[j, dim + d] = scale * strengths[j, d]
        layers[j, 2 * dim] = width * width
        layers[j, 2 * dim + 1] = np.e / 2 * squared / (1 + squared)
    return layers


@cache
def _sweep(dim: int, tangents: int, block: int) -> Any:
    """ψ of points, and J_ψ of so many tangents at each: x (m, n) and t (m, n·T) or (1, n·T) -> x, t."""
    width = WIDTH if block > 1 else 1
    first_tangent = (dim + 1) * block

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
                far = _NEGLIGIBLE / q
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
                    k = _exp(load(held, u, width) * -q)
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
                doubt = 0.0  # or not a number, as soon as one coordinate is
                for d in range(dim):
                    doubt += _doubt(held[(d + 1) * block + i])
                for d in range(dim):
                    x_out[begin + i, d] = held[(d + 1) * block + i] + doubt
                for e in range(dim * tangents):
                    t_out[begin + i, e] = held[first_tangent + e * block + i] + doubt

    return compiled(sweep, _signature(5))


@cache
def _unwind(dim: int, block: int) -> Any:
    """ψ⁻¹ of points: (m, n) -> (m, n).

    Each layer is one root of s = exp(-(A s² - 2 B s + C)) in [0, 1], A = ρ²‖v‖², B = ρ² v·(y-c), C = ρ²‖y-c‖². Vectors
    of points whose roots are found drop out of the iteration.
    """
    width = WIDTH if block > 1 else 1
    at_b, at_s, at_low, at_high, at_x = (row * block for row in range(1, 6))

    def unwind(layers: Array, y: Array, x_out: Array) -> None:
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
                    n_near += anywhere(c < _BEYOND)
                for i in range(n_near):
                    u = near[i]
                    s = _first_root(load(held, at_b + u, width), load(held, u, width))
                    store(held, at_s + u, s)
                    store(held, at_low + u, s * 0.0)
                    store(held, at_high + u, s * 0.0 + 1.0)
                n_open = n_near
                for _ in range(64):
                    n_left = 0
                    for i in range(n_open):
                        u = near[i]
                        s, low, high, still = _next_root(
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
                doubt = 0.0
                for d in range(dim):
                    doubt += _doubt(held[at_x + d * block + i])
                for d in range(dim):
                    x_out[begin + i, d] = held[at_x + d * block + i] + doubt

    return compiled(unwind, _signature(3))


def _signature(n_arrays: int) -> str:
    return f"void({', '.join(['float64[:, ::1]'] * n_arrays)})"


@cache
def steer(dim: int) -> Any:
    """The velocity J_ψ(x) g(x), x = ψ⁻¹(y), of points one by one: (m, n) -> (m, n); False if one is not finite.

    ``goal`` (3, n) holds x*, the axis u and the length ℓ in each entry; with o = (x - x*)/ℓ, a = u·o and p = o - a u,
    g = -ℓ (rate(|a|) a u + rate(|p|) p), the rates h(s)/s by the tables ``along`` and ``across``: (2, m) knots and
    speeds, or the knot -1 and ω for the eigenmap's law. ``steps`` (M, n+1) is room to keep each layer's tangent map.
    """

    def steer(layers: Array, goal: Array, along: Array, across: Array, y: Array, out: Array, steps: Array) -> bool:
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
                if q * c > _BEYOND:
                    continue
                b, c = q * b, q * c
                s, low, high = _first_root(b, c), 0.0, 1.0
                for _ in range(64):
                    s, low, high, still = _next_root(s, low, high, a, b, c)
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

    return compiled(steer, f"boolean({', '.join(['float64[:, ::1]'] * 7)})")


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


@cache
def greedy() -> Any:
    """The greedy match of :func:`latentds.matching.match`; moves ``moved`` in place.

    (moved, y: (N, n); β, μ²e/2, largest ρ²; the point to move, -1 for the one with the largest error; layers
    (M, 2n+1) to fill with (c, v, ρ²)) -> layers filled. The loss of a layer, ‖v‖² Σ k² - 2 a k with k = exp(-ρ²d) and
    a = error·v/‖v‖², is evaluated on a grid of ρ² with ratio √2 from the bound down to where every k is near 1:
    doubling ρ² squares k, so the grid costs two exponentials a point. From the best of the grid, Newton's method
    inside a bracket, with exact exponentials.
    """

    def greedy(moved: Array, y: Array, beta: float, bound: float, narrowest: float, at: int, layers: Array) -> int:
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
            limit = min(bound / size, narrowest)
            doublings = max(0, int(np.ceil(np.log2(max(16.0 * limit * farthest, 1.0)))))
            first = 0.5 * limit * 0.5**doublings
            for i in range(count, padded):
                d[i], a[i] = 2000.0 / first, 0.0
            best, lowest = limit, np.inf
            for u in range(0, padded, WIDTH):
                store(k_low, u, _exp(load(d, u, WIDTH) * -(first * np.sqrt(2.0))))
                store(k_high, u, _exp(load(d, u, WIDTH) * (-2.0 * first)))
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
                    kernel = _exp(distance * -q)
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
                kernel = _exp(load(d, u, WIDTH) * -best)
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
