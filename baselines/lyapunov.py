"""Stable deep dynamics: a network, projected so that a learned convex function falls (Manek and Kolter 2019)."""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from latentds.arguments import number_in, whole_number

from .couplings import no_autocast
from .networks import EPOCHS, VelocityRegression, linear, perceptron, seeded_generator

QUADRATIC_WEIGHT = 1e-2
"""ε, weight of ‖u‖² in V, which makes it positive and unbounded whatever was learned."""


class NeuralLyapunov(VelocityRegression):
    """f = f̂ - ∇V relu(∇V·f̂ + αV) / ‖∇V‖², so that V̇ <= -αV everywhere (Manek and Kolter 2019, sec. 3.2).

    In u, positions from the goal in sizes of the motion: V = g(u) - g(0) - ∇g(0)·u + ε‖u‖² with g an input-convex
    network, and f̂(u) = N(u) - N(0) with N a plain one. Both are learned together from velocities.

    Where this differs from the paper, and why. Its V = σ(g(u) - g(0)) + ε‖u‖², σ a smooth rectifier, is flat wherever
    g lies below g(0), and training stays there; taking away the tangent at 0 gives the same functions, those convex
    and least at 0, without that trap. Its f̂(0) need not be 0, and f then jumps at the goal; ours is an equilibrium, and
    f Lipschitz there too. f has
    kinks where the projection sets in.

    Where nothing was shown, a motion may run along the level sets of V for long: α alone says when it arrives.

    Args:
        dim: n >= 1.
        n_units: in each hidden layer of N, >= 1.
        n_convex: in each hidden layer of g, >= 1.
        alpha: α > 0, least rate at which V falls, per duration of the demonstration.
        seed: of the initial networks and the batches; None draws them from torch's generator.
        epochs: passes over the samples, >= 1.
    """

    def __init__(
        self,
        dim: int,
        *,
        n_units: int = 128,
        n_convex: int = 64,
        alpha: float = 1.0,
        seed: int | None = None,
        epochs: int = EPOCHS,
    ) -> None:
        super().__init__(dim, seed=seed, epochs=epochs)
        self.n_units = whole_number(n_units, "n_units", at_least=1)
        self.n_convex = whole_number(n_convex, "n_convex", at_least=1)
        self.alpha = number_in(alpha, "alpha", 0, math.inf)
        generator = seeded_generator(self.seed)
        self.network = perceptron([self.dim, *[self.n_units] * 3, self.dim], generator)
        self.bowl = Bowl(self.dim, self.n_convex, generator)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        wished = self.network(u) - self.network(torch.zeros_like(u[..., :1, :] if u.ndim > 1 else u))
        energy, slope = self._energy(u)
        steepness, least = slope.square().sum(-1), self.alpha * energy
        flat = (steepness == 0) | (least == 0)  # at the goal, where f̂ = 0
        steepness = torch.where(flat, 1.0, steepness)
        pull = torch.where(flat, 0.0, torch.relu((slope * wished).sum(-1) + least) / steepness)
        velocity: Tensor = wished - pull.unsqueeze(-1) * slope
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        with no_autocast(points):
            return self._energy(self._normalize(points))[0].to(wanted)

    def _energy(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """V and ∇V at u: (..., n) -> (...), (..., n)."""
        value, slope = self.bowl(u)
        return value + QUADRATIC_WEIGHT * u.square().sum(-1), slope + 2 * QUADRATIC_WEIGHT * u


class Bowl(nn.Module):
    """g(u) - g(0) - ∇g(0)·u and its gradient, g = U₂ s(U₁ s(W₀u + b₀) + W₁u + b₁) convex: >= 0, and 0 at 0.

    s is softplus, convex and rising, and U₁, U₂ >= 0 as the softplus of free weights (Amos, Xu and Kolter 2017). All is
    told by differences from 0, so that little is lost to rounding near it, and the gradient is a sweep back through the
    layers, written out so that it is differentiated like any other function.

    Args:
        dim: n >= 1.
        n_units: in each hidden layer, >= 1.
        generator: draws the weights (torch's global one if None).
    """

    def __init__(self, dim: int, n_units: int, generator: torch.Generator | None) -> None:
        super().__init__()
        self.direct = nn.ModuleList([linear(dim, n_units, generator), linear(dim, n_units, generator)])
        self.passed = nn.ParameterList(
            nn.Parameter(torch.randn(*shape, dtype=torch.float64, generator=generator) - math.log(n_units))
            for shape in ((n_units, n_units), (n_units,))
        )

    def forward(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """(..., n) -> (...), (..., n)."""
        first, second = (cast(nn.Linear, layer) for layer in self.direct)
        inner, outer = softplus(self.passed[0]), softplus(self.passed[1])
        below_there = first.bias
        below = u @ first.weight.mT
        risen = _rise(below_there, below)
        above_there = softplus(below_there) @ inner.mT + second.bias
        above = risen @ inner.mT + u @ second.weight.mT
        tilt, steep = outer * above_there.sigmoid(), outer * (above_there + above).sigmoid()
        bent = risen - below_there.sigmoid() * below
        value = ((_rise(above_there, above) - above_there.sigmoid() * above) * outer).sum(-1) + bent @ (tilt @ inner)
        sunk = (steep @ inner) * (below_there + below).sigmoid() - (tilt @ inner) * below_there.sigmoid()
        return value, (steep - tilt) @ second.weight + sunk @ first.weight


def _rise(there: Tensor, step: Tensor) -> Tensor:
    """softplus(there + step) - softplus(there), as precise as its value is small."""
    small = step.clamp(-1, 1)
    near = torch.log1p(there.sigmoid() * torch.expm1(small))
    return torch.where(step == small, near, softplus(there + step) - softplus(there))
