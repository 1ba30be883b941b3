"""Stable deep dynamics: a network, projected so that a learned convex function falls (Manek and Kolter 2019)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from latentds.arguments import number_in, whole_number

from .couplings import no_autocast
from .networks import VelocityRegression, linear, perceptron, seeded_generator

QUADRATIC = 1e-2
"""ε, weight of ‖u‖² in V, which makes it positive and unbounded whatever was learned."""


class NeuralLyapunov(VelocityRegression):
    """f = f̂ - ∇V relu(∇V·f̂ + αV) / ‖∇V‖², so that V̇ <= -αV everywhere (Manek and Kolter 2019, sec. 3.2).

    In u, positions from the goal in sizes of the motion: V = g(u) - g(0) - ∇g(0)·u + ε‖u‖² with g an input-convex
    network, and f̂(u) = N(u) - N(0) with N a plain one. Both are learned together from velocities.

    Where this differs from the paper, and why. Its V = σ(g(u) - g(0)) + ε‖u‖², σ a smooth rectifier, is flat wherever
    g lies below g(0), and training stays there; taking away the tangent at 0 gives the same functions, those convex
    and least at 0, without that trap. Its f̂(0) need not be 0, and f then jumps at the goal; ours is an equilibrium, and
    f Lipschitz there too. f has kinks where the projection sets in.

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
        alpha: float = 0.1,
        seed: int | None = None,
        epochs: int = 1000,
    ) -> None:
        super().__init__(dim, seed=seed, epochs=epochs)
        self.n_units = whole_number(n_units, "n_units", at_least=1)
        self.n_convex = whole_number(n_convex, "n_convex", at_least=1)
        self.alpha = number_in(alpha, "alpha", 0, math.inf)
        generator = seeded_generator(self.seed)
        self.network = perceptron([self.dim, *[self.n_units] * 3, self.dim], generator)
        self.convex = InputConvex(self.dim, self.n_convex, generator)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        wished = self.network(u) - self.network(torch.zeros_like(u[..., :1, :] if u.ndim > 1 else u))
        energy, slope = self._energy(u)
        steepness = slope.square().sum(-1)
        excess = torch.relu((slope * wished).sum(-1) + self.alpha * energy)
        flat = steepness == 0  # at the goal alone, where f̂ = 0
        pull = torch.where(flat, 0.0, excess / torch.where(flat, 1.0, steepness))
        velocity: Tensor = wished - pull.unsqueeze(-1) * slope
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        with no_autocast(points):
            return self._energy(self._normalize(points))[0].to(wanted)

    def _energy(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """V and ∇V at u: (..., n) -> (...), (..., n)."""
        value, slope = self.convex(u)
        level, tilt = self.convex(torch.zeros_like(self.attractor))
        energy = value - level - (u * tilt).sum(-1) + QUADRATIC * u.square().sum(-1)
        return energy, slope - tilt + 2 * QUADRATIC * u


class InputConvex(nn.Module):
    """A convex function g of u, and its gradient: z₁ = s(W₀u + b₀), z₂ = s(U₁z₁ + W₁u + b₁), g = U₂z₂.

    s is softplus, convex and rising, and U₁, U₂ >= 0 as the softplus of free weights (Amos, Xu and Kolter 2017); W₂ is
    left out, as V takes tangents away. The gradient is a sweep back through the layers, written out so that it is
    differentiated like any other function.

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
        first, second = self.direct
        inner, outer = softplus(self.passed[0]), softplus(self.passed[1])
        below = first(u)
        above = softplus(below) @ inner.mT + second(u)
        value = (softplus(above) * outer).sum(-1)
        back = outer * above.sigmoid()
        slope = back @ second.weight + ((back @ inner) * below.sigmoid()) @ first.weight
        return value, slope
