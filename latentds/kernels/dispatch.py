"""The one rule that says when a compiled kernel runs, and how its rows are spread over cores."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd import forward_ad

Array = NDArray[np.float64]

BLOCK = 512
"""Points that go through the layers together: with what a layer needs of them they fit the L1 cache for n = 3."""

_local = threading.local()


def can_use_kernel(names: Sequence[str], module: nn.Module, *tensors: Tensor) -> bool:
    """Whether a kernel may compute ``module``, whose parameters have these names; if not, the torch path does.

    They serve plain CPU tensors in the module's own float32 or float64. Never under torch.func, forward-mode
    differentiation, tracing, compiling, export or any active torch mode: those see a torch operation only when there is
    one. A first derivative comes from the operation's adjoint kernel; where derivatives of it are asked in turn, the
    backward pass goes by the torch path, see :func:`evaluate`.
    """
    if not no_active_transforms():
        return False
    learned = [module._parameters.get(name) for name in names]
    dtype = tensors[0].dtype
    return dtype in (torch.float64, torch.float32) and all(is_plain(t, dtype) for t in (*tensors, *learned))


def no_active_transforms() -> bool:
    """Whether nothing watches or transforms torch operations at the moment: tracing, torch.func, a torch mode."""
    return not (
        torch.compiler.is_compiling()
        or torch._C._get_tracing_state() is not None
        or getattr(_local, "reference", False)
        or torch._C._len_torch_function_stack()
        or torch._C._len_torch_dispatch_stack()
        or torch._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
    )


def is_plain(tensor: Any, dtype: torch.dtype) -> bool:
    """Whether a kernel can read its memory: no subclass, on the CPU, of this dtype, no lazy negation."""
    return type(tensor) in (Tensor, nn.Parameter) and tensor.is_cpu and tensor.dtype is dtype and not tensor.is_neg()


@contextmanager
def reference() -> Iterator[None]:
    """Within this context, in this thread, everything takes the torch path."""
    before, _local.reference = getattr(_local, "reference", False), True
    try:
        yield
    finally:
        _local.reference = before


Adjoint = Callable[..., tuple[tuple[Tensor, ...], Callable[[nn.Module], tuple[Tensor, Tensor]]]]
"""(dloss/dvalue, value, *points) -> dloss/dpoints, and of a module (z, dloss/dz) for a z that its parameters make."""


class _Compiled(torch.autograd.Function):
    """A value from a kernel, whose backward pass is another one, or the torch path if that must be derived in turn."""

    @staticmethod
    def forward(
        ctx: Any,
        compute: Callable[..., Tensor],
        adjoint: Adjoint,
        torch_path: Callable[..., Tensor],
        names: Sequence[str],
        module: nn.Module,
        *tensors: Tensor,
    ) -> Tensor:
        ctx.adjoint, ctx.torch_path, ctx.names, ctx.module = adjoint, torch_path, names, module
        value = compute(*tensors[: -len(names)])
        ctx.save_for_backward(value, *tensors)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        value, *tensors = ctx.saved_tensors
        again, needed = torch.is_grad_enabled(), ctx.needs_input_grad[5:]
        plain = torch._C._dispatch_keys(gradient).has(torch._C.DispatchKey.CPU)  # not under is_grads_batched=True
        by_kernel = plain and not again and no_active_transforms() and is_plain(gradient, value.dtype)
        with torch.enable_grad(), reference():
            # Views, so that the gradient for one input does not also flow through another made from it.
            inputs = [tensor.view_as(tensor) for tensor in tensors]
            points, learned = inputs[: -len(ctx.names)], inputs[-len(ctx.names) :]
            twin: Any = object.__new__(type(ctx.module))
            twin.__dict__.update(ctx.module.__dict__, _parameters=dict(zip(ctx.names, learned, strict=True)))
            if by_kernel:
                of_points, through = ctx.adjoint(gradient, value, *(point.detach() for point in points))
                found = [*of_points, *_of_parameters(through, twin, learned, needed[len(points) :])]
                return None, None, None, None, None, *(one if n else None for one, n in zip(found, needed, strict=True))
            value = ctx.torch_path(twin, *points)
        asked = [tensor for tensor, n in zip(inputs, needed, strict=True) if n]
        grads = iter(torch.autograd.grad(value, asked, gradient, create_graph=again, allow_unused=True))
        return None, None, None, None, None, *(next(grads) if n else None for n in needed)


def _of_parameters(through: Any, twin: nn.Module, learned: Sequence[Tensor], needed: Sequence[bool]) -> list[Any]:
    """The gradients of the parameters of which one is asked, None for the others."""
    asked = [tensor for tensor, n in zip(learned, needed, strict=True) if n]
    if not asked:
        return [None] * len(learned)
    made, gradient = through(twin)
    grads = iter(torch.autograd.grad(made, asked, gradient, allow_unused=True))
    return [next(grads) if n else None for n in needed]


def evaluate(
    compute: Callable[..., Tensor],
    adjoint: Adjoint,
    torch_path: Callable[..., Tensor],
    names: Sequence[str],
    module: nn.Module,
    *tensors: Tensor,
) -> Tensor:
    """``compute`` of the tensors, differentiable if that is asked.

    First derivatives run ``adjoint``; those with ``create_graph``, and under torch.func, the ``torch_path`` of the
    module, again and on the very tensors of the forward pass.
    """
    if torch.is_grad_enabled():
        learned = [module._parameters[name] for name in names]
        if any(t.requires_grad for t in (*tensors, *learned)):  # type: ignore[union-attr]
            return _Compiled.apply(compute, adjoint, torch_path, names, module, *tensors, *learned)  # type: ignore[no-any-return,no-untyped-call]
    return compute(*tensors)


def rows_of(x: Tensor) -> Array:
    """(..., n) -> (m, n) float64, contiguous; shares memory where it can."""
    points = x.detach().numpy()
    return np.ascontiguousarray(points.reshape(points.size // points.shape[-1], points.shape[-1]), np.float64)


def tensor_of(rows: Array, like: Tensor, shape: Sequence[int]) -> Tensor:
    """The rows in another tensor's dtype and in the given shape."""
    return torch.from_numpy(rows).to(like.dtype).reshape(shape)


PARALLEL_THRESHOLD = 300_000
"""Point-layers above which more than one core is used; below, a second one costs more than it brings."""

_pool: ThreadPoolExecutor | None = None
_pool_owner = 0


def run(kernel_for: Callable[[int], Callable[..., None]], layers: Array, *by_row: Array) -> None:
    """Call a kernel on rows of points, on as many cores as torch may use here for a large batch."""
    count = len(by_row[-1])
    if count == 0:
        return
    kernel = kernel_for(1 if count == 1 else BLOCK)
    cores = min(torch.get_num_threads(), _available_cores()) if count * len(layers) > PARALLEL_THRESHOLD else 1
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
