"""Compiled CPU kernels: what they compute, when they run, how they are compiled."""

from __future__ import annotations

from collections.abc import Sequence

from .adjoint import forward_adjoint, inverse_adjoint
from .dispatch import BLOCK
from .greedy import greedy_kernel
from .quasi_newton import direction_kernel
from .translations import forward_kernel, inverse_kernel, pack_kernel
from .velocity import velocity_kernel


def warmup(dims: Sequence[int] = (2, 3)) -> None:
    """Compile the kernels for points of these dimensions now; otherwise their first use does, some seconds each."""
    for dim in dims:
        for block in (1, BLOCK):
            inverse_kernel(dim, block)
            for tangents in {0, 1, dim}:
                forward_kernel(dim, tangents, block)
        for tangents in (0, 1):
            forward_adjoint(dim, tangents)
        forward_adjoint(dim, 0, True)
        inverse_adjoint(dim)
        for tangents in (0, dim):
            velocity_kernel(dim, tangents)
    pack_kernel()
    greedy_kernel()
    direction_kernel()
