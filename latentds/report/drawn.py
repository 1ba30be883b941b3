"""A motion and its rollouts as numbers for the page, as few as it takes."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arguments import Array, real_array
from ..demonstration import Demonstration
from .comparison import Comparison, Motion

ROOM = 900_000
"""Bytes of a file that rollouts may take, beside the 5 MB of Plotly: they are thinned to that."""
FEWEST = 120
"""Points to which a rollout is thinned before some rollouts are left out."""
WIDER = 1.5
"""The picture is a box so many times as wide as the demonstration; rollouts that leave it are counted."""
GAP = -32768
"""Stands for no number among 16-bit positions."""


def drawn(motion: Motion, comparison: Comparison, paths: Mapping[tuple[str, str, int], Any]) -> dict[str, Any]:
    """What ``page.js`` draws of a motion; of several seeds the lowest.

    Raises:
        ValueError: if rollouts have another shape than the starts and the demonstration ask for.
    """
    first = motion.shown[0]
    moved: dict[str, Array] = {}
    for label, name, seed in sorted(paths, key=lambda key: key[2]):
        if name == motion.name and label in comparison.methods and label not in moved:
            array = real_array(paths[label, name, seed], "paths")
            wanted = motion.share * len(motion.shown), first.dim
            if array.ndim != 3 or array.shape[::2] != wanted:
                expected = f"({wanted[0]}, T, {wanted[1]}) for {label!r} and {name!r}"
                raise ValueError(f"paths: expected {expected}, got {array.shape}")
            moved[label] = array
    count, others = _thinned(motion, len(comparison.motions) * (1 + len(comparison.methods)))
    n_points = min((len(batch[0]) for batch in moved.values()), default=500)
    grid = _grid(first, min(count, n_points), n_points)
    chosen = np.unique(np.linspace(1, motion.share - 1, others).round().astype(int)) if others else np.empty(0, int)
    starts = np.concatenate([i * motion.share + np.r_[0, chosen] for i in range(len(motion.shown))]).astype(int)
    shown = np.stack([one.at(grid * one.duration) for one in motion.shown])
    middle, half = (shown.min((0, 1)) + shown.max((0, 1))) / 2, motion.size / 2 * WIDER
    low, high = middle - half, middle + half
    return {
        "name": motion.name,
        "columns": list(first.columns) or _axes(first.dim),
        "dim": first.dim,
        "durations": [motion.judge(int(start)).duration for start in starts],
        "own": (starts % motion.share == 0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "grid": _packed(grid, "<f4"),
        "shown": _packed(_quantized(shown, low, high), "<i2"),
        "shown_durations": [one.duration for one in motion.shown],
        "shown_speed": _packed(_speed(first.velocities.numpy(), first.times.numpy() / first.duration, grid), "<f4"),
        "starts": {"drawn": len(starts), "of": motion.share * len(motion.shown)},
        "methods": [
            _rollouts(moved[label], starts, grid, first.duration, low, high) if label in moved else None
            for label in comparison.methods
        ],
        "scores": [
            scores and {"own": _finite(scores.own), "others": _finite(scores.others)}
            for scores in (comparison.distances(label, motion) for label in comparison.methods)
        ],
    }


def _thinned(motion: Motion, parts: int) -> tuple[int, int]:
    """Points of each rollout, and rollouts beside each demonstrated start, for which ``parts`` parts of ROOM do."""
    room = ROOM * 3 / 4 / 2 / parts / motion.shown[0].dim / len(motion.shown)
    others = motion.share - 1
    if room / (1 + others) < FEWEST:
        others = max(0, min(others, int(room / FEWEST) - 1))
    return max(2, int(room / (1 + others))), others


def _grid(shown: Demonstration, count: int, n_points: int) -> Array:
    """``count`` of ``n_points`` shares of the duration: half of them even in time, half of them even along the path."""
    even = np.linspace(0, 1, n_points)
    if count >= n_points:
        return even
    steps = np.linalg.norm(np.diff(shown.at(even * shown.duration), axis=0), axis=1)
    passed = even + np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    chosen: Array = even[np.unique(np.searchsorted(passed, np.linspace(0, passed[-1], count)).clip(0, n_points - 1))]
    return chosen


def _rollouts(
    batch: Array, starts: NDArray[Any], grid: Array, duration: float, low: Array, high: Array
) -> dict[str, Any]:
    even = np.linspace(0, 1, batch.shape[1])
    nearest = np.searchsorted(even, grid - 1e-9).clip(0, len(even) - 1)
    with np.errstate(all="ignore"):
        velocities = np.gradient(batch[0], duration / (len(even) - 1), axis=0)
        inside = np.all((batch >= low) & (batch <= high), axis=(1, 2))
    return {
        "paths": _packed(_quantized(batch[starts][:, nearest], low, high), "<i2"),
        "speed": _packed(_speed(velocities, even, grid), "<f4"),
        "gone": int((~inside).sum()),
    }


def _speed(velocities: Array, shares: Array, grid: Array) -> Array:
    with np.errstate(all="ignore"):
        speed: Array = np.interp(grid, shares, np.linalg.norm(velocities, axis=1))
    return speed


def _quantized(values: Array, low: Array, high: Array) -> NDArray[np.int16]:
    """Points (..., n) of a box as 16-bit numbers; a point outside it is a gap in all its coordinates."""
    with np.errstate(invalid="ignore"):
        inside = np.all((values >= low) & (values <= high), axis=-1, keepdims=True)
        share = np.where(inside, (values - low) / (high - low), 0.0)
    whole: NDArray[np.int16] = np.where(inside, np.round(65534 * share) - 32767, GAP).astype(np.int16)
    return whole


def _packed(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode()


def _finite(scores: Array) -> list[float | None]:
    """For JSON, in percent."""
    return [round(100 * float(score), 6) if math.isfinite(score) else None for score in scores]


def _axes(dim: int) -> list[str]:
    return list("xyz"[:dim]) if dim <= 3 else [f"y{i + 1}" for i in range(dim)]
