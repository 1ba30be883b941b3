"""The calls of a fitted system as one writes them first, in loops of torch: what :mod:`experiments.speed` races."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from latentds import ChebyshevDS
from latentds.arguments import Array
from latentds.diffeomorphism import WIDTH_BOUND

Loop = list[tuple[Tensor, Tensor, Tensor]]
"""(c, v, ρ) of every layer."""


def layers_of(ds: ChebyshevDS) -> Loop:
    psi = ds.diffeomorphism
    return list(zip(*(part.detach() for part in (psi.centers, psi.directions, psi.widths)), strict=True))


def forward(layers: Loop, x: Tensor) -> Tensor:
    for c, v, rho in layers:
        x = x + torch.exp(-(rho**2) * ((x - c) ** 2).sum(-1, keepdim=True)) * v
    return x


def inverse(layers: Loop, y: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """x, and the gradient of each layer's weight with its direction, last layer first."""
    steps = []
    for c, v, rho in reversed(layers):
        w = y - c
        a, b, r = v @ v, (w * v).sum(-1, keepdim=True), (w * w).sum(-1, keepdim=True)
        low, high, s = torch.zeros_like(b), torch.ones_like(b), torch.exp(-(rho**2) * r)
        for _ in range(60):
            k = torch.exp(-(rho**2) * (a * s * s - 2 * b * s + r))
            gap = s - k
            low, high = torch.where(gap < 0, s, low), torch.where(gap > 0, s, high)
            new = s - gap / (1 - 2 * rho**2 * (b - a * s) * k)
            new = torch.where((new < low) | (new > high), (low + high) / 2, new)
            moved, s = (new - s).abs().max(), new
            if moved < 1e-15:
                break
        y = y - s * v
        steps.append((-2 * rho**2 * s * (y - c), v))
    return y, steps


def velocity(layers: Loop, y: Tensor, latent_velocity: Callable[[Tensor], Tensor]) -> Tensor:
    x, steps = inverse(layers, y)
    moved = latent_velocity(x)
    for gradient, v in reversed(steps):
        moved = moved + (gradient * moved).sum(-1, keepdim=True) * v
    return moved


def runge_kutta(field: Callable[[Tensor], Tensor], y: Tensor, times: Tensor) -> Tensor:
    path = [y]
    for h in times.diff():
        k1 = field(y)
        k2 = field(y + h / 2 * k1)
        k3 = field(y + h / 2 * k2)
        k4 = field(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        path.append(y)
    return torch.stack(path, dim=-2)


def match(x: Array, y: Array, n_layers: int, beta: float, mu: float) -> float:
    """Greedy matching, one bounded scalar minimisation a layer; the mean squared error that it reaches."""
    for _ in range(n_layers):
        error = y - x
        worst = int((error**2).sum(1).argmax())
        v, squared = beta * error[worst], ((x - x[worst]) ** 2).sum(1)

        def loss(rho: float, v: Array = v, squared: Array = squared, error: Array = error) -> float:
            return float(((error - np.exp(-(rho**2) * squared)[:, None] * v) ** 2).sum())

        rho = minimize_scalar(loss, bounds=(0, mu * WIDTH_BOUND / np.linalg.norm(v)), method="bounded").x
        x = x + np.exp(-(rho**2) * squared)[:, None] * v
    return float(((x - y) ** 2).mean())
