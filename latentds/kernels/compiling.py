"""Numba functions as machine code: compiled once, kept on disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numba

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}


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
