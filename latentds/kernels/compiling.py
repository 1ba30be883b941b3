"""Numba functions as machine code: compiled once, kept on disk."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

from .private import stamp_cache

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with its cache on disk; without one where none can be written, as in a read-only install."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            kernel = numba.njit(cache=True, **options)(function)
        except RuntimeError:
            return numba.njit(**options)(function)
        # Numba asks only for the age of the file that defines a function; ours inline each other across files.
        stamp_cache(kernel, _sources(inspect.getfile(function)))
        return kernel

    return decorate


@cache
def _sources(file: str) -> str:
    """A hash of what the machine code of a file's functions depends on: that file and the files of this package."""
    digest = hashlib.sha256()
    for path in sorted({Path(file), *Path(__file__).parent.glob("*.py")}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


n_compiled = 0
"""Kernels that this process did not find on disk."""


def compiled(function: Callable[..., Any], signature: str) -> Any:
    """``function`` as machine code, from the cache on disk if it is there; the first one that is not is told."""
    global n_compiled
    kernel = cached(**OPTIONS)(function)
    kernel.compile(signature)
    if not kernel.stats.cache_hits:
        if n_compiled == 0:
            kept = f"kept in {kernel.stats.cache_path}" if kernel.stats.cache_path else "anew in every process"
            print(f"latentds: compiling for this CPU, about ten seconds for a first fit, {kept}", file=sys.stderr)
        n_compiled += 1
    return kernel
