"""L-BFGS with a strong Wolfe line search, for losses of a few thousand parameters that take milliseconds.

SciPy's and torch's leave such vectors to a threaded linear algebra library, whose threads then spin between its calls:
a fit costs two to four times the CPU and is not a bit faster. Here nothing is threaded.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..arguments import Array
from ..kernels.lanes import WIDTH
from ..kernels.quasi_newton import direction_kernel

MEMORY = 20
"""Pairs of steps and changes of the gradient that are kept."""
DECREASE, CURVATURE = 1e-3, 0.9
"""A step is long enough where it lowers the loss by this share of what the slope promises, and the slope to that."""
TRIALS = 20
"""Of a line search."""

Loss = Callable[[Array], tuple[float, Array]]


class Minimum(NamedTuple):
    """Where a minimisation ended, (d,), and the loss after each step."""

    at: Array
    history: tuple[float, ...]


class _Trial(NamedTuple):
    """A step along a direction, the loss and its slope there, and the gradient."""

    step: float
    loss: float
    slope: float
    gradient: Array


def minimize(loss: Loss, start: Array, *, steps: int, least_change: float = 1e-12) -> Minimum:
    """Lower a loss that is smooth, by at most so many steps.

    Args:
        loss: (d,) -> loss and gradient (d,), float64.
        start: (d,)
        steps: at most; none begins after twice as many evaluations.
        least_change: of the loss, relative to it or to 1 if that is larger, below which a step is the last.
    """
    size = len(start)
    padded = -(-size // WIDTH) * WIDTH
    moves, changes, shares = np.zeros((MEMORY, padded)), np.zeros((MEMORY, padded)), np.empty((2, MEMORY))
    direction = np.zeros(padded)
    kernel = direction_kernel()
    held = end = 0
    at = start
    value, gradient = loss(at)
    history: list[float] = []
    evaluations = 1
    while len(history) < steps and evaluations < 2 * steps and np.abs(gradient).max(initial=0.0) > 1e-10:
        direction[:size] = gradient
        kernel(moves, changes, held, end, shares, direction)
        along = direction[:size]
        slope = _dot(along, gradient)
        if not slope < 0:  # the pairs describe another place
            if not held:
                break
            held = 0
            continue
        first = 1.0 if held else min(1.0, 1 / float(np.abs(gradient).sum()))
        found, tried = _line_search(loss, at, along, _Trial(0.0, value, slope, gradient), first)
        evaluations += tried
        if not found.step > 0:
            if not held:
                break
            held = 0
            continue
        move, change = found.step * along, found.gradient - gradient
        if _dot(move, change) > 1e-16 * _dot(change, change):
            moves[end, :size], changes[end, :size] = move, change
            held, end = min(held + 1, MEMORY), (end + 1) % MEMORY
        before, at, value, gradient = value, at + move, found.loss, found.gradient
        history.append(value)
        if before - value <= least_change * max(abs(before), abs(value), 1.0):
            break
    return Minimum(at, tuple(history))


def _line_search(loss: Loss, at: Array, along: Array, start: _Trial, first: float) -> tuple[_Trial, int]:
    """A step that fulfils the strong Wolfe conditions, or the best that was tried; and how many were.

    Nocedal and Wright 2006, algorithms 3.5 and 3.6.
    """
    low, high, step = start, None, first
    for tried in range(1, TRIALS + 1):
        value, gradient = loss(at + step * along)
        trial = _Trial(step, value, _dot(along, gradient), gradient)
        if not (value <= start.loss + DECREASE * step * start.slope and (low is start or value < low.loss)):
            high = trial
        elif abs(trial.slope) <= -CURVATURE * start.slope:
            return trial, tried
        else:
            if trial.slope * ((np.inf if high is None else high.step) - low.step) >= 0:
                high = low
            low = trial
        step = 4 * step if high is None else _between(low, high)
    return low, tried


def _between(low: _Trial, high: _Trial) -> float:
    """The minimum of the cubic through two trials, kept from both by a tenth of their distance."""
    apart = high.step - low.step
    with np.errstate(invalid="ignore", over="ignore"):
        bend = low.slope + high.slope - 3 * (high.loss - low.loss) / apart
        root = np.sqrt(bend * bend - low.slope * high.slope)  # a power of a Python float would raise
        share = 1 - (high.slope + np.sign(apart) * root - bend) / (high.slope - low.slope + 2 * np.sign(apart) * root)
    return low.step + apart * (float(np.clip(share, 0.1, 0.9)) if np.isfinite(share) else 0.5)


def _dot(a: Array, b: Array) -> float:
    return float(np.einsum("i,i->", a, b))  # no BLAS
