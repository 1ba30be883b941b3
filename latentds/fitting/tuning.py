"""Hyperparameters of a greedy match as the paper chooses them: a grid and its selection rule (Sec. VI-A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arguments import Array
from .matching import add_greedy_layers

GOOD = 1e-5
"""The normalised MSE that the paper asks for."""
BETAS = tuple(i / 10 for i in range(1, 11))
MUS = tuple(i / 10 for i in range(1, 10))
DEPTHS = (25, 50, 75, 100, 125, 150, 175, 200, 250, 300, 400, 500, 600, 750)
POINTS = 1000
"""Most points that are tried on."""


class Tried(NamedTuple):
    """One combination and what it reached; ``normalised`` is ``mse`` for a motion of radius 1."""

    beta: float
    mu: float
    n_layers: int
    mse: float
    normalised: float


class Choice(NamedTuple):
    """The rule's two candidates among combinations with the same M, and whether they are below ``GOOD``."""

    least_beta: Tried
    least_mse: Tried
    good: bool


def choose(tried: Sequence[Tried]) -> Choice:
    """The paper's rule: the fewest layers with a normalised MSE below 1e-5; among those the least β or the least MSE.

    If none gets there, the least MSE. "Unless having slightly more diffeomorphisms significantly reduced MSE" names
    no number and is not applied.
    """
    good = [one for one in tried if one.normalised < GOOD]
    if not good:
        least = min(tried, key=lambda one: one.mse)
        return Choice(least, least, False)
    fewest = min(one.n_layers for one in good)
    equal = [one for one in good if one.n_layers == fewest]
    return Choice(min(equal, key=lambda one: (one.beta, one.mse)), min(equal, key=lambda one: one.mse), True)


def tuned(x: Array, y: Array) -> Tried:
    """The rule's candidate with the least MSE for the match of x to y, (N, n), over the grid.

    A match goes on where the same with fewer layers ended, so every combination is tried with as many layers as the
    quickest one needs, and with no more.
    """
    chosen = np.unique(np.linspace(0, len(x) - 1, min(len(x), POINTS)).round().astype(int))
    target, unit = y[chosen], (float(np.ptp(y, axis=0).max()) / 2) ** 2
    moved = {(beta, mu): x[chosen] for beta in BETAS for mu in MUS}
    tried, used = [], 0
    for depth in DEPTHS:
        for beta, mu in moved:
            moved[beta, mu] = add_greedy_layers(moved[beta, mu], target, depth - used, beta, mu)[1]
            mse = float(np.square(moved[beta, mu] - target).mean())
            tried.append(Tried(beta, mu, depth, mse, mse / unit))
        used = depth
        if choose(tried).good:
            break
    return choose(tried).least_mse
