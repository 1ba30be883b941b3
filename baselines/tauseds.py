"""τ-SEDS: SEDS in a space where the demonstrations come nearer to the goal all along (Neumann and Steil 2015)."""

from __future__ import annotations

import torch
from torch import Tensor

from latentds.arguments import whole_number

from .clfdm import AsymmetricQuadratics
from .networks import NormalizedDS
from .pooling import Pool
from .seds import SEDS, StableSystems
from .training import Training


class TauSEDS(NormalizedDS):
    """SEDS through τ(z) = √V(z) z/‖z‖: ż = J⁻¹ g(τ(z)), g a stable mixture of linear systems (Neumann and Steil 2015).

    V is learned first, so that it falls along what was shown (that of :class:`CLFDM`); τ keeps directions and makes V
    the squared distance from the goal, ‖τ(z)‖² = V(z), as SEDS needs it. J = √V/‖z‖ (I - ẑẑᵀ) + ẑ ∇Vᵀ/(2√V) is its
    Jacobian, inverted in closed form. V falls along every motion, and where demonstrations lead away from the goal
    first they can be learned, as far as V falls along them. τ has no derivative at the goal, so that the velocity there
    is no differentiable function; it is continuous, and 0. One thing is our own: the error that SEDS lowers is that of
    the velocities that are seen, J⁻¹ g - ż, where the paper's is that in τ's space.

    Learns from one demonstration or from several, pooled; their goals' mean is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)²; ``n_layers`` is the mixture's K; the
    notes tell where demonstrations do not descend V.

    Args:
        dim: n >= 1.
        n_components: K >= 1; None for as many of 1 to 12 as the Bayesian information criterion chooses.
        n_asymmetric: L >= 0 asymmetric functions in V.
        iterations: of L-BFGS at most, each time, >= 1.
        seed: of the mixture's k-means; None draws it from torch's generator.

    Source: Neumann and Steil, "Learning robot motions with stable dynamical systems under diffeomorphic
    transformations", Robotics and Autonomous Systems 70 (2015).
    """

    def __init__(
        self,
        dim: int,
        *,
        n_components: int | None = None,
        n_asymmetric: int = 3,
        iterations: int = 200,
        seed: int | None = None,
    ) -> None:
        super().__init__(dim, seed=seed)
        self.n_components = None if n_components is None else whole_number(n_components, "n_components", at_least=1)
        self.n_asymmetric = whole_number(n_asymmetric, "n_asymmetric", at_least=0)
        self.iterations = whole_number(iterations, "iterations", at_least=1)
        self.energy = AsymmetricQuadratics(self.dim, self.n_asymmetric)
        self.systems = StableSystems(self.dim)

    def _train(self, pool: Pool, progress: bool) -> tuple[TauSEDS, Training]:
        learner = TauSEDS(**self.settings)
        history, notes = learner.energy.learn(pool, self.iterations)
        seds = SEDS(self.dim, n_components=self.n_components, iterations=self.iterations, seed=self.seed)
        with torch.no_grad():
            images, velocities = learner.tau(pool.points), learner.push(pool.points, pool.velocities)
            eye = torch.eye(self.dim, dtype=torch.float64).expand(len(images), -1, -1)
            back = learner.pull(pool.points.unsqueeze(-2), eye).mT
        trained, training = seds._train(pool._replace(points=images, velocities=velocities), progress, back)
        learner.systems.load_state_dict(trained.systems.state_dict())
        return learner, Training(history + training.history, notes, training.n_parts)

    def tau(self, z: Tensor) -> Tensor:
        """τ, in sizes: (..., n) -> (..., n)."""
        return self._scaled(z)[1]

    def push(self, z: Tensor, tangent: Tensor) -> Tensor:
        """J(z) ẋ: (..., n), (..., n) -> (..., n)."""
        direction, _, stretch, slope = self._scaled(z)
        along = (direction * tangent).sum(-1, keepdim=True)
        rise = (slope * tangent).sum(-1, keepdim=True)
        return stretch * (tangent - along * direction) + rise * direction

    def pull(self, z: Tensor, tangent: Tensor) -> Tensor:
        """J(z)⁻¹ ẋ: (..., n), (..., n) -> (..., n)."""
        direction, _, stretch, slope = self._scaled(z)
        along = (direction * tangent).sum(-1, keepdim=True)
        across = (tangent - along * direction) / stretch
        steep = (slope * direction).sum(-1, keepdim=True)  # above 0: V grows along every ray
        return across + (along - (slope * across).sum(-1, keepdim=True)) / steep * direction

    def normalized_velocity(self, u: Tensor) -> Tensor:
        return self.pull(u, self.systems(self.tau(u)))

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        energy: Tensor = self.energy(self._normalize(points))
        return energy.to(wanted)

    def _scaled(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """ẑ, τ(z), √V/‖z‖ and ∇V/(2√V); at 0, where ẑ is none, those of a place beside it."""
        least = torch.finfo(z.dtype).tiny ** 0.25
        near = z.abs().amax(-1, keepdim=True) < least
        place = torch.where(near, torch.full_like(z, least), z)
        length = torch.linalg.vector_norm(place, dim=-1, keepdim=True)
        energy, slope = self.energy.with_gradient(place)
        root = energy.unsqueeze(-1).sqrt()
        stretch = root / length
        return place / length, stretch * z, stretch, slope / (2 * root)
