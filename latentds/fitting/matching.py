"""Fitting ψ to point pairs: greedy fast diffeomorphic matching."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from ..arguments import Array
from ..kernels.greedy import greedy_kernel
from ..translations import WIDTH_BOUND, Layers, LocallyWeightedTranslations
from .strands import Strands


def match(x: Array, y: Array, n_layers: int, beta: float, mu: float) -> Layers:
    """Greedy matching of x to y, both (N, n) (Perrin and Schlehuber-Caissier 2016, Alg. 1).

    Each layer moves the point with the largest error by ``beta`` of it, with the ρ below μ√(e/2)/‖v‖ that leaves the
    least squared error over all points. Fewer than ``n_layers`` come back if no error is left.
    """
    return add_greedy_layers(x, y, n_layers, beta, mu)[0]


def add_greedy_layers(
    moved: Array, y: Array, n_layers: int, beta: float, mu: float, narrowest: float = 0.0, at: int = -1
) -> tuple[Layers, Array]:
    """Up to ``n_layers`` greedy layers on points where they stand, and where those layers move them: (N, n).

    No layer is narrower, 1/ρ, than ``narrowest``. Each is laid on the point ``at`` instead of the worst, if given.
    """
    dim = moved.shape[1]
    moved = np.array(moved, dtype=np.float64, order="C")
    rows = np.empty((n_layers, 2 * dim + 1))
    limit = 1 / narrowest**2 if narrowest > 0 else math.inf
    target = np.ascontiguousarray(y, dtype=np.float64)
    used = greedy_kernel()(moved, target, beta, (mu * WIDTH_BOUND) ** 2, limit, at, rows)
    return Layers(rows[:used, :dim], rows[:used, dim:-1], np.sqrt(rows[:used, -1])), moved


def stacked(parts: Sequence[Layers]) -> Layers:
    """The layers of all parts, at least one, in their order."""
    return Layers(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def match_along(curves: Array, n_layers: int, beta: float, mu: float, narrowest: float = 0.0) -> Layers:
    """Greedy matching of the first curve to the last by way of those between, (K+1, N, n).

    Where the curve winds, matching x to y at once tangles strands; following intermediate curves does not
    (continuation). Half of the layers are shared evenly by all K targets, the last takes the rest. With K = 1 this is
    :func:`match`.
    """
    moved, targets = curves[0], curves[1:]
    share, parts = n_layers // (2 * len(targets)), []
    for target in targets[:-1]:
        layers, moved = add_greedy_layers(moved, target, share, beta, mu, narrowest)
        parts.append(layers)
    left = n_layers - sum(len(layers.widths) for layers in parts)
    parts.append(add_greedy_layers(moved, targets[-1], left, beta, mu, narrowest)[0])
    return stacked(parts)


STRIDE = 0.3
"""Longest step along a homotopy that :func:`track` takes, in clearances of each point."""
TRACK_TOLERANCE, FINAL_TOLERANCE = 0.1, 0.02
"""Distance from a curve of the homotopy, in clearances, at which :func:`track` goes on to a further one, and ends."""
LAYERS_PER_LOOK = 10
"""Layers that it adds before it looks again."""
GIVE_UP_AFTER = 1500
"""Layers after which it gives up a step."""


def track(curves: Array, most: int, narrowest: float) -> tuple[Layers, bool]:
    """Greedy matching of the first curve to the last of (K+1, N, n), as closely as strands need.

    From each curve the farthest one is aimed at that no point is more than ``STRIDE`` of its clearance away from, and
    layers are added until every point is within ``TRACK_TOLERANCE`` of it.

    Args:
        curves: a homotopy in fine steps.
        most: layers.
        narrowest: least width 1/ρ of a layer, or the least clearance where that is less.

    Returns:
        The layers that were laid, and whether they arrive.
    """
    clearance, moved, at, last = Strands(curves[-1]).clearance, curves[0], 0, len(curves) - 1
    nowhere = np.empty((0, curves.shape[2]))
    parts = [Layers(nowhere, nowhere, np.empty(0))]
    here, used = clearance(curves[0]), 0
    while at < last:
        step, ahead, there = 1, at + 1, clearance(curves[at + 1])
        while at + 2 * step <= last:
            farther = clearance(curves[at + 2 * step])
            moves = np.linalg.norm(curves[at + 2 * step] - curves[at], axis=1)
            if (moves > STRIDE * np.minimum(here, farther)).any():
                break
            step, there = 2 * step, farther
            ahead = at + step
        began, allowed = used, (TRACK_TOLERANCE if ahead < last else FINAL_TOLERANCE) * there
        while ((missed := np.linalg.norm(moved - curves[ahead], axis=1)) > allowed).any():
            if used - began >= GIVE_UP_AFTER or used >= most:
                if ahead == last and (missed < TRACK_TOLERANCE * there).all():
                    break
                return stacked(parts), False
            worst = int(np.argmax(missed / allowed))
            tight = missed[worst] < 0.5 * missed.max()  # where strands are close, though others are farther off
            count, place = (1, worst) if tight else (LAYERS_PER_LOOK, -1)
            width = min(narrowest, float(there.min()))
            layers, moved = add_greedy_layers(moved, curves[ahead], count, 0.9, 0.9, width, place)
            if not len(layers.widths):
                return stacked(parts), False
            parts.append(layers)
            used += len(layers.widths)
        at, here = ahead, there
    return stacked(parts), used > 0


PINS = 2
"""Layers that :func:`pin_ends` adds."""


def pin_ends(layers: Layers, x: Array, y: Array, mu: float) -> Layers:
    """``layers`` and two more, that bring the first and the last point of x, (N, n), exactly onto those of y.

    Greedy matching leaves both off by about √MSE, and where ψ is badly conditioned ψ⁻¹ of the start and of the goal
    then lies far from the ends of the latent line. Each pin is as wide as leaves the least squared error over all.
    """
    moved, parts = apply_layers(layers, x), [layers]
    for at in (0, len(x) - 1):
        pin, moved = add_greedy_layers(moved, y, 1, 1.0, mu, at=at)
        parts.append(pin)
    return stacked(parts)


@torch.no_grad()
def apply_layers(layers: Layers, x: Array) -> Array:
    """ψ(x) of these layers, (N, n) -> (N, n)."""
    psi = LocallyWeightedTranslations(x.shape[1], max(1, len(layers.widths)))
    psi.assign(*(torch.from_numpy(part) for part in layers))
    moved: Array = psi(torch.from_numpy(x)).numpy()
    return moved
