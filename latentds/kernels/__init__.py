"""Compiled CPU kernels: what they compute, when they run, how they are compiled."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

from . import compiling
from .adjoint import forward_adjoint, inverse_adjoint
from .greedy import greedy_kernel
from .quasi_newton import direction_kernel
from .translations import forward_kernel, inverse_kernel, pack_kernel
from .velocity import velocity_kernel


def warmup(dims: Sequence[int] = (2, 3)) -> None:
    """Compile the kernels for points of these dimensions now; otherwise their first use does, some seconds each.

    On two cores, as numba compiles in one thread at a time: another process leaves its half in the cache on disk.
    """
    before = compiling.n_compiled
    pack_kernel()
    for dim in dims:
        inverse_kernel(dim)
    helper = None
    if compiling.n_compiled > before and sys.executable:
        command = f"from latentds.kernels import compile_second_half; compile_second_half({list(map(int, dims))})"
        paths = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
        helper = subprocess.Popen([sys.executable, "-c", command], env=os.environ | paths, stderr=subprocess.DEVNULL)
    compile_first_half(dims)
    if helper is not None:
        helper.wait()
    compile_second_half(dims)


def compile_all(dims: Sequence[int]) -> None:
    """As :func:`warmup`, in this process alone."""
    compile_first_half(dims)
    compile_second_half(dims)


def compile_first_half(dims: Sequence[int]) -> None:
    """Each half has all kernels of a function, as two processes that add to what is kept of one forget each other's."""
    pack_kernel()
    direction_kernel()
    for dim in dims:
        inverse_kernel(dim)
        for tangents in {0, 1, dim}:
            forward_kernel(dim, tangents)
        for tangents in (0, 1):
            forward_adjoint(dim, tangents)
        forward_adjoint(dim, 0, True)


def compile_second_half(dims: Sequence[int]) -> None:
    for dim in dims:
        for tangents in (0, dim):
            velocity_kernel(dim, tangents)
        inverse_adjoint(dim)
    greedy_kernel()
