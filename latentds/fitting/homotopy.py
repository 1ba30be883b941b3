"""Homotopies from a straight line to a curve: sequences of curves for the matching to follow without tangling."""

from __future__ import annotations

import math

import numpy as np

from ..arguments import Array, whole_number
from ..curves import interpolated, laid_on, progress_along, step_lengths, transported_frames, turned


def linear_homotopy(x: Array, y: Array, steps: int) -> Array:
    """x + (k/K)(y - x), k = 0 … K: every point moves on a straight line. (N, n) and (N, n) -> (K+1, N, n).

    One step is plain greedy matching. On tight 3-D spirals it is the better of the two; in 2-D the curve can cross
    itself on the way, and then no diffeomorphism follows.
    """
    share = np.linspace(0, 1, whole_number(steps, "steps", at_least=1) + 1)[:, None, None]
    moved: Array = x + share * (y - x)
    return moved


def curvature_homotopy(y: Array, steps: int) -> Array:
    """The curve y (N, n) with its turning scaled by k/K, k = 0 … K: from a straight rod of its length to itself.

    The turning from segment to segment is written in a Bishop (rotation-minimising) frame, scaled, and integrated back;
    each curve is then laid rigidly on the next. Returns (K+1, N, n).
    """
    count = whole_number(steps, "steps", at_least=1)
    segments, lengths = np.diff(y, axis=0), step_lengths(y)
    own, turning = transported_frames(segments / lengths[:, None])
    scaled = np.linspace(0, 1, count + 1)[:, None, None] * turning
    frames = np.repeat(own[:1], count + 1, axis=0)
    tangents = np.empty((count + 1, len(segments), y.shape[1]))
    tangents[:, 0] = frames[:, :, 0]
    for i in range(len(turning)):
        frames = turned(frames, scaled[:, i])
        tangents[:, i + 1] = frames[:, :, 0]
    curves = np.concatenate(
        [np.zeros((count + 1, 1, y.shape[1])), np.cumsum(tangents * lengths[:, None], axis=1)], axis=1
    )
    curves[count] = y
    return _each_laid_on_the_next(curves)


def zoom_homotopy(y: Array, steps: int, pivot: float) -> Array:
    """Ever larger parts of the curve y (N, n) about ``pivot``, a share of it, enlarged to its length: (K+2, N, n).

    The part that is k/K of the curve on a logarithmic scale, from a fiftieth on; before it its chord. A part of a curve
    that does not cross itself does not either, so strands never meet on the way, of a knot neither.
    """
    share = progress_along(y)
    parts = np.geomspace(0.02, 1, whole_number(steps, "steps", at_least=1) + 1)[:, None]
    at = pivot + parts * (share - pivot)
    curves = interpolated(at, share, y) / parts[:, :, None]
    curves[-1] = y
    chord = curves[0, :1] + share[:, None] * (curves[0, -1] - curves[0, 0])
    return _each_laid_on_the_next(np.concatenate([chord[None], curves]))


def clear_direction(y: Array, tries: int = 300, points: int = 120) -> tuple[Array, float]:
    """A direction (n,) along which a line can be bent straight into the curve y (N, n), and how clear its way is.

    Of the chord, the principal axes and ``tries`` random directions, the one for which two points of the curve come
    least close on the linear homotopy from a line as long as the curve, in their final distance: 1 if no two come
    closer than they end, 0 if some meet.
    """
    chosen = np.linspace(0, len(y) - 1, min(points, len(y))).round().astype(int)
    p, length = y[chosen], float(step_lengths(y).sum())
    axes = np.linalg.svd(p - p.mean(0), full_matrices=False)[2]
    random = np.random.default_rng(0).standard_normal((tries, y.shape[1]))
    directions = np.concatenate([p[-1:] - p[:1], axes, -axes, random])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    i, j = np.triu_indices(len(p), 1)
    apart, along = p[j] - p[i], length * (progress_along(y)[chosen][j] - progress_along(y)[chosen][i])
    far, near = (apart**2).sum(1), along**2
    clear = []
    for direction in directions:
        mixed = along * (apart @ direction)
        share = np.clip((near - mixed) / np.maximum(near + far - 2 * mixed, 1e-300), 0, 1)
        least = (1 - share) ** 2 * near + 2 * share * (1 - share) * mixed + share**2 * far
        clear.append(float((least / np.maximum(far, 1e-300)).min()))
    best = int(np.argmax(clear))
    return directions[best], math.sqrt(max(clear[best], 0.0))


def drawn_homotopy(y: Array, direction: Array, length: float, steps: int) -> Array:
    """The linear homotopy to y (N, n) from a line of ``length`` along ``direction``: (K+1, N, n).

    What is left of the line shrinks by the same factor at each step, so that strands that end close come there slowly.
    """
    line = y.mean(0) + length * (progress_along(y) - 0.5)[:, None] * direction
    left = np.append(np.geomspace(1, 1e-5, whole_number(steps, "steps", at_least=1)), 0.0)[:, None, None]
    curves: Array = left * line + (1 - left) * y
    return curves


def _each_laid_on_the_next(curves: Array) -> Array:
    for k in range(len(curves) - 2, -1, -1):
        curves[k] = laid_on(curves[k], curves[k + 1])
    return curves
