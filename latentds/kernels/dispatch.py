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
from torch import Tensor, nn

from ..arguments import Array
from . import private

BLOCK = 512
"""Points that go through the layers together: for n = 3 they and what a layer computes of them fit the L1 cache."""

_local = threading.local()


def can_use_kernel(names: Sequence[str], module: nn.Module, *tensors: Tensor) -> bool:
    """Whether a kernel may compute ``module``, whose parameters have these names; if not, the torch path does.

    Kernels serve plain CPU tensors in the module's own float32 or float64; never under torch.func, forward-mode
    differentiation, tracing, compiling, export or an active torch mode, which have to see operations of torch. For
    derivatives see :func:`latentds.kernels.functions.evaluate`.
    """
    if not no_active_transforms():
        return False
    parameters, dtype = private.held_tensors(module, names), tensors[0].dtype
    return dtype in (torch.float64, torch.float32) and all(is_plain(t, dtype) for t in (*tensors, *parameters))


def no_active_transforms() -> bool:
    """Whether nothing watches or transforms torch operations at the moment: tracing, torch.func, a torch mode."""
    return not (
        torch.compiler.is_compiling()
        or private.tracing_active()
        or getattr(_local, "reference", False)
        or private.modes_active()
        or private.function_transforms_active()
        or private.forward_mode_active()
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


def rows_of(x: Tensor) -> Array:
    """(..., n) -> (m, n) float64, contiguous; shares memory where it can."""
    points = x.detach().numpy()
    return np.ascontiguousarray(points.reshape(points.size // points.shape[-1], points.shape[-1]), np.float64)


def tensor_of(rows: Array, like: Tensor, shape: Sequence[int]) -> Tensor:
    """The rows in another tensor's dtype and in the given shape."""
    return torch.from_numpy(rows).to(like.dtype).reshape(shape)


PARALLEL_THRESHOLD = 300_000
"""Points times layers above which more than one core is used; below, a second one costs more than it saves."""

_pool: ThreadPoolExecutor | None = None
_pool_owner = 0


def run(kernel: Callable[..., None], layers: Array, *by_row: Array) -> None:
    """Call a kernel on rows of points, on as many cores as torch may use here for a large batch."""
    count = len(by_row[-1])
    if count == 0:
        return
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
