"""Fitting ψ to point pairs: greedy fast diffeomorphic matching."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .base import FitReport, LatentDS
from .demonstration import Demonstration
from .diffeomorphism import WIDTH_BOUND, LocallyWeightedTranslations
from .time_law import RayDynamics, TimeLaw

Array = NDArray[np.float64]


class Layers(NamedTuple):
    """Locally weighted translations x + exp(-ρ²‖x-c‖²) v, first to last."""

    centers: Array
    """(m, n)"""
    directions: Array
    """(m, n)"""
    widths: Array
    """(m,) ρ > 0"""


def match(x: Array, y: Array, n_layers: int, beta: float, mu: float) -> Layers:
    """Greedy matching of x to y, both (N, n) (Perrin and Schlehuber-Caissier 2016, Alg. 1)."""
    n_points, dim = x.shape
    moved = x.copy()
    centers, directions, widths = [], [], []
    for _ in range(n_layers):
        error = y - moved
        worst = int(np.argmax(np.einsum("ij,ij->i", error, error)))
        c, v = moved[worst].copy(), beta * error[worst]
        size = float(np.linalg.norm(v))
        if not size > 0:
            break
        q = _best_square(((moved - c) ** 2).sum(1), error @ v, size**2, (mu * WIDTH_BOUND / size) ** 2)
        moved = moved + np.exp(-q * ((moved - c) ** 2).sum(1))[:, None] * v
        centers.append(c), directions.append(v), widths.append(math.sqrt(q))
    return Layers(np.array(centers).reshape(-1, dim), np.array(directions).reshape(-1, dim), np.array(widths))


def _best_square(distances: Array, along: Array, size: float, limit: float) -> float:
    grid = limit * 2.0 ** -np.arange(0, 30, 0.5)
    k = np.exp(-np.outer(grid, distances))
    return float(grid[np.argmin((k * k * size - 2 * k * along).sum(1))])


def settle(ds: LatentDS, latent: Array, shown: Demonstration, law: TimeLaw, *, progress: bool) -> None:
    """Fit ψ so that it maps ``latent`` (N, n) onto the demonstration, and lay the dynamics along it."""
    began = time.perf_counter()
    psi, dynamics = ds.diffeomorphism, ds.dynamics
    assert isinstance(psi, LocallyWeightedTranslations) and isinstance(dynamics, RayDynamics)
    if bool((shown.start == shown.goal).all()):
        raise ValueError("demonstration: expected a goal apart from the start, got a closed loop")
    layers = match(latent, shown.positions.numpy(), psi.n_layers, ds.beta, ds.mu)
    psi.assign(*(torch.from_numpy(part) for part in layers))
    dynamics.law = law.to(ds.attractor)
    with torch.no_grad():
        ds.attractor.copy_(shown.goal)
        dynamics.aim(psi.inverse(shown.start.to(ds.attractor)), psi.inverse(ds.attractor))
        missed = psi(torch.from_numpy(latent).to(ds.attractor)) - shown.positions.to(ds.attractor)
    ds.fit_report = FitReport(float(missed.square().mean()), psi.n_layers, time.perf_counter() - began)
