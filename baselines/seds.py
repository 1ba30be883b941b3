"""SEDS: a stable mixture of linear systems (Khansari-Zadeh and Billard 2011)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor, nn

from latentds.arguments import whole_number
from latentds.resizing import assign, make_room

from .mixture import GaussianMixture, drawn_seed, fit_regression, nearby
from .networks import NormalizedDS
from .pooling import Pool
from .training import Training, descend_smoothly

LEAST_RATE = 0.05
"""Least rate at which every linear system approaches the goal, in 1 / duration: the margin of a strict inequality."""

USUAL_RATE = 2.0
"""The rate of every linear system in directions that no demonstration tells of: across a single path, all of them."""
RIDGE_WEIGHT = 1e-5
"""Weight of what says so, the squared entries of A_k + ``USUAL_RATE`` I."""
STEP_SIZES = {"spins": 2.0, "pulls": 2.0, "mixture.log_heights": 1.0, "mixture.means": 0.1, "mixture.whiteners": 5.0}
"""How far a parameter goes for a change that shows, in sizes and durations."""
MIXTURE_WEIGHT = 1e-3
"""Weight of what holds the mixture near that of the demonstrations, in squared ``STEP_SIZES``: it lowers the error at
one that was not shown. Of 0, 1e-4, 1e-3 and 1e-2 the best when of LASA's 26 shapes three of demonstrations 1 to 4 were
shown and the fourth judged; 5 to 7, which judge in the comparisons, were not asked."""


class SEDS(NormalizedDS):
    """Stable estimator of dynamical systems: ẏ = Σ_k γ_k(y) A_k (y - y*), A_k + A_kᵀ < 0 (Khansari-Zadeh 2011).

    γ are the responsibilities of a Gaussian mixture over positions, and V(y) = ‖y - y*‖² falls along every motion, so
    that no motion that leads away from the goal first can be learned. The objective is the paper's second one, the
    mean squared error of the velocities, which follows better than the likelihood. The constraint is kept by
    parametrisation, A_k = S_k - S_kᵀ - R_k R_kᵀ - ε I, so that nothing is left to constrain: with the mixture that EM
    finds of positions and velocities L-BFGS moves S and R, then the mixture too. The authors' code constrains a general
    solver instead, and its linear maps are also those of a joint mixture, which the error does not ask for.

    Learns from one demonstration or from several, pooled; their goals' mean is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)²; ``n_layers`` is K.

    Args:
        dim: n >= 1.
        n_components: K >= 1; None for as many of 1 to 12 as the Bayesian information criterion of the mixture over
            positions and velocities chooses.
        iterations: of L-BFGS at most, each time, >= 1.
        seed: of the mixture's k-means; None draws it from torch's generator.
    """

    def __init__(
        self, dim: int, *, n_components: int | None = None, iterations: int = 200, seed: int | None = None
    ) -> None:
        super().__init__(dim, seed=seed)
        self.n_components = None if n_components is None else whole_number(n_components, "n_components", at_least=1)
        self.iterations = whole_number(iterations, "iterations", at_least=1)
        self.systems = StableSystems(self.dim)

    def _train(self, pool: Pool, progress: bool, seen_through: Tensor | None = None) -> tuple[SEDS, Training]:
        """``seen_through``: (N, n, n) by which the error at each sample is multiplied, or None."""
        learner = SEDS(**self.settings)
        systems = learner.systems
        systems.assign(fit_regression(pool, self.n_components, drawn_seed(self.seed)).mixture)
        history = match_velocities(systems, pool, STEP_SIZES, self.iterations, seen_through)
        return learner, Training(history, (), systems.mixture.n_components)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        velocity: Tensor = self.systems(u)
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return (points - self.attractor).square().sum(-1).to(wanted)


class StableSystems(nn.Module):
    """z ↦ Σ_k γ_k(z) A_k z with A_k = S_k - S_kᵀ - R_k R_kᵀ - ε I; one of A = -I - ε I until assigned.

    ``load_state_dict`` takes any number of components.

    Attributes:
        mixture: γ.
        spins, pulls: (K, n, n), S_k and R_k.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.mixture = GaussianMixture(dim)
        self.spins = nn.Parameter(torch.zeros(1, dim, dim, dtype=torch.float64))
        self.pulls = nn.Parameter(torch.eye(dim, dtype=torch.float64)[None].clone())

    @torch.no_grad()
    def assign(self, mixture: GaussianMixture) -> None:
        """Every linear system alike, with this mixture."""
        self.mixture.load_state_dict(mixture.state_dict())
        eye = torch.eye(mixture.dim, dtype=torch.float64).expand(mixture.n_components, -1, -1)
        assign(self, {"spins": torch.zeros_like(eye), "pulls": USUAL_RATE**0.5 * eye})

    def slopes(self) -> Tensor:
        """A_k + ε I, (K, n, n)."""
        return self.spins - self.spins.mT - self.pulls @ self.pulls.mT

    def forward(self, z: Tensor) -> Tensor:
        values = (self.slopes() * z.unsqueeze(-2).unsqueeze(-2)).sum(-1)
        mixed: Tensor = (self.mixture(nearby(z)).unsqueeze(-1) * values).sum(-2) - LEAST_RATE * z
        return mixed

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        make_room(self, state_dict, prefix, ["spins", "pulls"])
        super()._load_from_state_dict(state_dict, prefix, *rest)  # type: ignore[arg-type]


class MixedSystems(Protocol):
    """z ↦ Σ_k γ_k(z) A_k z, learned by :func:`match_velocities`."""

    mixture: GaussianMixture

    def slopes(self) -> Tensor:
        """(K, n, n), near ``-USUAL_RATE`` I where nothing is shown."""

    def get_parameter(self, target: str) -> nn.Parameter: ...

    def __call__(self, z: Tensor) -> Tensor: ...


def match_velocities(
    systems: MixedSystems,
    pool: Pool,
    step_sizes: Mapping[str, float],
    iterations: int,
    seen_through: Tensor | None = None,
) -> tuple[float, ...]:
    """Move linear systems by L-BFGS to the least squared error of velocities, then the mixture with them.

    Args:
        systems: with the mixture that EM found.
        pool: what is shown.
        step_sizes: of each parameter, as of ``STEP_SIZES``; those of the mixture begin with "mixture.".
        iterations: at most, each time.
        seen_through: (N, n, n) by which the error at each sample is multiplied, or None.

    Returns:
        The loss after each iteration.
    """
    steps = {systems.get_parameter(name): step for name, step in step_sizes.items()}
    before = {parameter: parameter.detach().clone() for parameter in systems.mixture.parameters()}
    shown = pool.velocities
    if seen_through is not None:
        shown = (seen_through * shown.unsqueeze(-2)).sum(-1)
    unit = shown.square().mean()

    def plain_loss() -> Tensor:
        missed = systems(pool.points) - pool.velocities
        if seen_through is not None:
            missed = (seen_through * missed.unsqueeze(-2)).sum(-1)
        error: Tensor = missed.square().mean() / unit
        lean: Tensor = (systems.slopes() + USUAL_RATE * torch.eye(pool.points.shape[1]).double()).square().sum()
        return error + RIDGE_WEIGHT * lean

    def loss() -> Tensor:
        return plain_loss() + MIXTURE_WEIGHT * sum(
            ((p - known) / steps[p]).square().sum() for p, known in before.items()
        )

    history = descend_smoothly(plain_loss, {p: step for p, step in steps.items() if p not in before}, iterations)
    return history + descend_smoothly(loss, steps, iterations)
