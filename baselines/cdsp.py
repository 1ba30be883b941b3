"""CDSP: Gaussian mixture regression that contracts in a metric learned with it (Ravichandar, Salehi and Dani 2017)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from latentds.arguments import whole_number

from .couplings import no_autocast
from .lpvds import LinearSystems
from .mixture import GaussianMixture, drawn_seed, fit_regression, nearby
from .networks import NormalizedDS, thinned
from .pooling import Pool
from .seds import STEP_SIZES, match_velocities
from .training import Training

MIXTURE_STEPS = {name: step for name, step in STEP_SIZES.items() if name.startswith("mixture.")}
LINEAR_STEPS = {"linear.root": 0.1, "linear.turning": 1.0, "linear.damping": 1.0}
"""How far a parameter goes for a change that shows, in sizes and durations."""


class CDSP(NormalizedDS):
    """f(u) = Σ_k γ_k(u) A_k u with M A_k + A_kᵀ M ≼ -2ρM, γ, A and M learned together (Ravichandar et al. 2017).

    What is proven is that it arrives, V = uᵀ M u falling at the rate 2ρ or faster: along a given motion u(t) the system
    v̇ = Σ_k γ_k(u(t)) A_k v contracts in the metric M, and u(t) and 0 are two of its solutions. That is *partial*
    contraction. It is not proven that two motions of f come nearer to each other: the derivative of f has that of γ in
    it, which nothing bounds, and they do not everywhere.

    As LPV-DS's the systems are linear and under one quadratic form, and the inequality holds whatever the parameters
    are. What differs is what is learned: there a mixture, a metric and linear systems one after the other, here the
    mixture of positions and velocities that EM finds, and from the start that LPV-DS's two convex programs give, all
    three together by L-BFGS on the squared error of velocities. Ours are the constant rate and metric, where the
    paper's may depend on the place; that start; and that A is free, where regression by a mixture has it from the
    covariances.

    Learns from one demonstration or from several, pooled; their goals' mean is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)²; ``n_layers`` is K. Needs the extra
    ``field`` to fit.

    Args:
        dim: n >= 1.
        n_components: K >= 1; None for as many of 1 to 12 as the Bayesian information criterion chooses.
        iterations: of L-BFGS at most, each time, >= 1.
        seed: of the mixture's k-means; None draws it from torch's generator.

    Source: Ravichandar, Salehi and Dani, "Learning partially contracting dynamical systems from demonstrations", CoRL
    2017.
    """

    def __init__(
        self, dim: int, *, n_components: int | None = None, iterations: int = 200, seed: int | None = None
    ) -> None:
        super().__init__(dim, seed=seed)
        self.n_components = None if n_components is None else whole_number(n_components, "n_components", at_least=1)
        self.iterations = whole_number(iterations, "iterations", at_least=1)
        self.systems = ContractingSystems(self.dim)

    def _train(self, pool: Pool, progress: bool) -> tuple[CDSP, Training]:
        learner, pool = CDSP(**self.settings), thinned(pool)
        systems = learner.systems
        systems.mixture.load_state_dict(
            fit_regression(pool, self.n_components, drawn_seed(self.seed)).mixture.state_dict()
        )
        with torch.no_grad():
            shares = systems.mixture(pool.points).numpy()
        exact = systems.linear.solve(pool.points.numpy(), pool.velocities.numpy(), shares)
        history = match_velocities(systems, pool, LINEAR_STEPS | MIXTURE_STEPS, self.iterations)
        notes = () if exact else ("began from linear systems that are not the solver's best",)
        return learner, Training(history, notes, systems.mixture.n_components)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        velocity: Tensor = self.systems(u)
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        u = self._normalize(points)
        with no_autocast(u):
            return ((u @ self.systems.linear.metric()) * u).sum(-1).to(wanted)


class ContractingSystems(nn.Module):
    """u ↦ Σ_k γ_k(u) A_k u, (..., n) -> (..., n).

    Attributes:
        mixture: γ.
        linear: A_k and M, for which the inequality holds.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.mixture = GaussianMixture(dim)
        self.linear = LinearSystems(dim)

    def slopes(self) -> Tensor:
        """A_k, (K, n, n)."""
        return self.linear.matrices()

    def forward(self, u: Tensor) -> Tensor:
        mixed: Tensor = (self.mixture(nearby(u)).unsqueeze(-1) * self.linear(u)).sum(-2)
        return mixed
