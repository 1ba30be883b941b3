"""How near a motion comes to the one that was shown.

Paths are (N, n) and (M, n) arrays or tensors of the same n. A path that ran away has no distance: with NaN, inf or
numbers so large that their squares overflow in it, NaN comes back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from fastdtw import fastdtw

from .arguments import Array, number_in, real_array, whole_number
from .kernels.compiling import cached

NAN = math.nan


def dtw(path: Any, reference: Any) -> float:
    """Dynamic time warping, exact: the least sum of Euclidean distances over all monotone alignments.

    Args:
        path: (N, n).
        reference: (M, n).

    Returns:
        The raw sum, in the units of the positions.

    Raises:
        ValueError: if an argument is no such array.
    """
    a, b = _pair(path, reference)
    return float(_dtw(a, b)) if _finite(a, b) else NAN


def fast_dtw(path: Any, reference: Any, radius: int = 1) -> float:
    """FastDTW (Salvador and Chan 2007), the paper's score: an upper bound of :func:`dtw`.

    At radius 1 it can be far too large on a path that winds; see :func:`dtw` for the value itself.

    Args:
        path: (N, n).
        reference: (M, n).
        radius: >= 1, half the width of the band searched at each resolution; 1 is the package's default.

    Returns:
        The raw sum, in the units of the positions.

    Raises:
        ValueError: if an argument is out of range.
    """
    a, b = _pair(path, reference)
    whole_number(radius, "radius", at_least=1)
    # dist=2 is the package's compiled Euclidean norm, 40 times faster than the equal dist=euclidean.
    return float(fastdtw(a, b, radius=radius, dist=2)[0]) if _finite(a, b) else NAN


def frechet(path: Any, reference: Any) -> float:
    """Discrete Fréchet distance: the least, over all monotone alignments, of the largest distance of a pair.

    Args:
        path: (N, n).
        reference: (M, n).

    Raises:
        ValueError: if an argument is no such array.
    """
    a, b = _pair(path, reference)
    return float(_frechet(a, b)) if _finite(a, b) else NAN


def endpoint_error(path: Any, reference: Any) -> float:
    """Euclidean distance between the two last points; (N, n) and (M, n)."""
    a, b = _pair(path, reference)
    return float(np.linalg.norm(a[-1] - b[-1])) if _finite(a, b) else NAN


def path_length_ratio(path: Any, reference: Any, ruler: float = 0.0) -> float:
    """Length of the path over that of the reference, (N, n) and (M, n): far below 1 gives a shortcut away.

    NaN where the reference does not move. Steps up to ``ruler`` (units of the positions, >= 0) from the last point
    counted are left out, in both, so that noise does not count as way.
    """
    a, b = _pair(path, reference)
    number_in(ruler, "ruler", 0, math.inf, ends="[)")
    if not _finite(a, b):
        return NAN
    travelled, shown = path_length(a, ruler), path_length(b, ruler)
    return travelled / shown if shown > 0 else NAN


def path_length(path: Array, ruler: float = 0.0) -> float:
    """Length of a path (N, n) from the first point to the last, by steps longer than ``ruler``."""
    here, *rest = path.tolist()
    total = 0.0
    for there in rest:
        step = math.dist(here, there)
        if step > ruler:
            total, here = total + step, there
    return total + math.dist(here, path[-1].tolist())


def mse(values: Any, reference: Any) -> float:
    """Mean squared error per coordinate: the mean over all entries of two (N, n) arrays."""
    a, b = _pair(values, reference, same_length=True)
    return float(np.square(a - b).mean()) if _finite(a, b) else NAN


def velocity_rmse(velocities: Any, reference: Any) -> float:
    """Root of the mean squared length of v - v_ref, two (N, n) arrays of velocities at the same points."""
    a, b = _pair(velocities, reference, same_length=True)
    return float(np.sqrt(a.shape[1] * mse(a, b)))


def velocity_cosine(velocities: Any, reference: Any) -> float:
    """Mean cosine of the angle between v and v_ref, two (N, n) arrays of velocities at the same points.

    Points where the reference rests have no angle and are left out (NaN if all are); a v at rest elsewhere counts 0.
    """
    a, b = _pair(velocities, reference, same_length=True)
    if not _finite(a, b):
        return NAN
    speeds, shown = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    moving = shown > 1e-9 * shown.max()
    if not moving.any():
        return NAN
    along = np.einsum("ij,ij->i", a / np.where(speeds > 0, speeds, 1)[:, None], b)[moving]
    return float((along / shown[moving]).mean())


def _pair(path: Any, reference: Any, *, same_length: bool = False) -> tuple[Array, Array]:
    a, b = real_array(path, "path"), real_array(reference, "reference")
    for name, array in (("path", a), ("reference", b)):
        if array.ndim != 2 or 0 in array.shape:
            raise ValueError(f"{name}: expected shape (N, n) with N, n >= 1, got {array.shape}")
    if a.shape[1] != b.shape[1] or (same_length and len(a) != len(b)):
        wanted = b.shape if same_length else f"(N, {b.shape[1]})"
        raise ValueError(f"path: expected shape {wanted} like the reference's, got {a.shape}")
    return np.ascontiguousarray(a), np.ascontiguousarray(b)


def _finite(a: Array, b: Array) -> bool:
    return bool((np.abs(a) < 1e150).all() and (np.abs(b) < 1e150).all())


@cached()
def _distances_to(point: Array, points: Array, out: Array) -> None:
    for j in range(points.shape[0]):
        total = 0.0
        for k in range(points.shape[1]):
            gap = point[k] - points[j, k]
            total += gap * gap
        out[j] = np.sqrt(total)


@cached()
def _dtw(a: Array, b: Array) -> float:
    distances = np.empty(b.shape[0])
    row = np.empty(b.shape[0])
    for i in range(a.shape[0]):
        _distances_to(a[i], b, distances)
        corner = row[0]  # the cell up and to the left of the next one
        row[0] = distances[0] + (corner if i > 0 else 0.0)
        for j in range(1, b.shape[0]):
            best = row[j - 1] if i == 0 else min(row[j - 1], row[j], corner)
            corner = row[j]
            row[j] = distances[j] + best
    return float(row[-1])


@cached()
def _frechet(a: Array, b: Array) -> float:
    distances = np.empty(b.shape[0])
    row = np.empty(b.shape[0])
    for i in range(a.shape[0]):
        _distances_to(a[i], b, distances)
        corner = row[0]
        row[0] = distances[0] if i == 0 else max(distances[0], corner)
        for j in range(1, b.shape[0]):
            best = row[j - 1] if i == 0 else min(row[j - 1], row[j], corner)
            corner = row[j]
            row[j] = max(distances[j], best)
    return float(row[-1])
