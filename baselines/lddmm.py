"""LDDMM: the paper's embedding carried onto a demonstration by a flow of landmarks (Joshi and Miller 2000)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from latentds import ChebyshevDS
from latentds.arguments import positive, whole_number
from latentds.base import LatentDS, Learned
from latentds.demonstration import Demonstration, goal_apart
from latentds.diffeomorphism import Diffeomorphism
from latentds.dynamics import RayDynamics
from latentds.fitting.average import mean_motion
from latentds.resizing import assign, make_room

from .fdm import FDM
from .training import descend_smoothly

ENERGY_WEIGHT = 1e-6
"""Of the flow's energy beside the squared distance of landmarks from their targets, both in sizes: how far it may bend
for a nearer match."""
RIDGE = 1e-2
"""On the kernel's diagonal where momenta are learned: landmarks that lie close together are then pushed alike."""

FEWEST_STEPS, MOST_STEPS = 5, 80
"""Of integration: twice as many are taken, and momenta learned on, until way and way back agree."""
INTEGRATION_LIMIT = 1e-5
"""How far ψ⁻¹(ψ(x)) may be from x before Newton's step, in sizes; its square, about, is left."""

WIDTHS = (0.1, 0.3)
"""Of the kernel, tried where none is given: the narrow one comes nearer, the wide one gets through more loops."""

State = tuple[Tensor, ...]
"""Landmarks and momenta, (K, n) each; then points (..., n) and tangents (..., n, m) that are carried along."""


class LandmarkFlow(Diffeomorphism):
    """The flow of K landmarks for a unit of time: ẋ = Σ_j k(x, q_j) p_j with k = 1/(1 + ‖x - q‖²/width²).

    q̇ = ∂H/∂p, ṗ = -∂H/∂q with H = ½ Σ_ij k(q_i, q_j) p_i·p_j, which is constant. The flow of any momenta is a
    diffeomorphism, and the same flow run backward its inverse. It is integrated by Runge-Kutta steps of order 4, so
    that the two invert each other only nearly; a step of Newton's method makes up for what is left.

    Attributes:
        landmarks: (K, n) buffer, q at the beginning.
        momenta: (K, n), p at the beginning; 0, the identity, until learned.
        width: () buffer, units of x.
        steps: (S,) buffer, of the integration, a unit of time together; any number.
    """

    landmarks: Tensor
    width: Tensor
    steps: Tensor

    def __init__(self, dim: int, n_landmarks: int) -> None:
        super().__init__()
        self.dim = dim
        self.momenta = nn.Parameter(torch.zeros(n_landmarks, dim, dtype=torch.float64))
        self.register_buffer("landmarks", torch.zeros(n_landmarks, dim, dtype=torch.float64))
        self.register_buffer("width", torch.ones((), dtype=torch.float64))
        self.register_buffer("steps", even_steps(1))

    def forward(self, x: Tensor) -> Tensor:
        return self.carried(self.landmarks, self.momenta, x)[2]

    def inverse(self, y: Tensor) -> Tensor:
        """By the flow run backward, and a step of Newton's method for what integration left over."""
        x = self.reversed_flow(y)
        _, _, mapped, slopes = self.carried(self.landmarks, self.momenta, x, self._frames(x))
        correction: Tensor = torch.linalg.solve(slopes, (mapped - y).unsqueeze(-1)).squeeze(-1)
        return x - correction

    def reversed_flow(self, y: Tensor) -> Tensor:
        """(..., n) -> (..., n), the inverse as far as integration is exact."""
        end = self.carried(self.landmarks, self.momenta)
        return self.carried(end[0], -end[1], y)[2]

    @torch.no_grad()
    def integration_gap(self, x: Tensor) -> float:
        """The largest distance at which the flow back leaves points (..., n) from where they were."""
        return float(torch.linalg.vector_norm(self.reversed_flow(self(x)) - x, dim=-1).max())

    def jacobian(self, x: Tensor) -> Tensor:
        return self.carried(self.landmarks, self.momenta, x, self._frames(x))[3]

    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        x = self.inverse(y)
        slopes = self.jacobian(x)
        return x, lambda tangent: (slopes * tangent.unsqueeze(-2)).sum(-1)

    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        logarithm: Tensor = torch.linalg.slogdet(self.jacobian(x))[1]
        return logarithm

    def energy(self, landmarks: Tensor, momenta: Tensor) -> Tensor:
        """H: (K, n), (K, n) -> ()."""
        return 0.5 * (self.kernel(landmarks, landmarks) * _products(momenta)).sum()

    def kernel(self, a: Tensor, b: Tensor) -> Tensor:
        """k of each with each: (..., n), (K, n) -> (..., K)."""
        gaps: Tensor = (a.unsqueeze(-2) - b).square().sum(-1) / self.width.square()
        return 1 / (1 + gaps)

    def carried(self, *state: Tensor) -> State:
        """Landmarks, momenta, and any points and tangents, after a unit of time; that of -p is the way back."""
        for step in self.steps:
            first = self._pace(*state)
            second = self._pace(*_ahead(state, first, step / 2))
            third = self._pace(*_ahead(state, second, step / 2))
            last = self._pace(*_ahead(state, third, step))
            slopes = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(first, second, third, last, strict=True))
            state = _ahead(state, slopes, step)
        return state

    def _pace(self, q: Tensor, p: Tensor, *moved: Tensor) -> State:
        kernel = self.kernel(q, q)
        pull = 2 * (kernel / self.width).square() * _products(p)
        paces = [_mixed(kernel, p), pull.sum(-1, keepdim=True) * q - _mixed(pull, q)]
        if moved:
            x, *tangents = moved
            kernel = self.kernel(x, q)
            paces.append(_mixed(kernel, p))
            # Dv t = Σ_j p_j (∂k_j/∂x)·t, and ∂k/∂x = -2 k² (x - q)/width²
            slopes = 2 * (kernel / self.width).square().unsqueeze(-1) * (q - x.unsqueeze(-2))
            paces += [p.mT @ (slopes @ tangent) for tangent in tangents]
        return tuple(paces)

    def match(self, targets: Tensor, iterations: int) -> tuple[float, ...]:
        """Learn momenta, from those it has, that bring the landmarks to ``targets`` (K, n), both in sizes, float64.

        Returns:
            The loss after each iteration of L-BFGS.
        """
        landmarks = self.landmarks
        with torch.no_grad():
            kernel = self.kernel(landmarks, landmarks) + RIDGE * torch.eye(len(landmarks), dtype=torch.float64)
            # p = root⁻¹ u has the energy ½‖u‖²: in this measure of momenta L-BFGS gets farther than in p itself.
            root = np.linalg.cholesky(kernel.numpy()).T  # NumPy's: torch's rounds by how many threads it has
            unscaled = torch.from_numpy(np.linalg.inv(root))
            scaled = nn.Parameter(_mixed(torch.from_numpy(root.copy()), self.momenta))

        def momenta() -> Tensor:
            return _mixed(unscaled, scaled)

        def loss() -> Tensor:
            arrived = self.carried(landmarks, momenta())[0]
            return (arrived - targets).square().sum(-1).mean() + ENERGY_WEIGHT * scaled.square().sum() / 2

        history = descend_smoothly(loss, {scaled: 0.03}, iterations)
        with torch.no_grad():
            self.momenta.copy_(momenta())
        return history

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        make_room(self, state_dict, prefix, ["steps"])
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _frames(self, x: Tensor) -> Tensor:
        return torch.eye(self.dim).to(x).expand(*x.shape, -1)


def even_steps(count: int) -> Tensor:
    return torch.full((count,), 1 / count, dtype=torch.float64)


def _mixed(weights: Tensor, vectors: Tensor) -> Tensor:
    """(..., K), (K, n) -> (..., n); no matrix product, whose rounding differs with threads and from batch to batch."""
    return (weights.unsqueeze(-1) * vectors).sum(-2)


def _products(p: Tensor) -> Tensor:
    """p_i·p_j: (K, n) -> (K, K)."""
    return (p.unsqueeze(-2) * p).sum(-1)


def _ahead(state: State, slopes: State, step: Tensor) -> State:
    return tuple(part + step * slope for part, slope in zip(state, slopes, strict=True))


class LDDMM(LatentDS):
    """The paper's latent points carried onto the demonstration by :class:`LandmarkFlow` instead of greedy layers.

    Landmarks are even samples of the latent points; their momenta are learned by L-BFGS through the flow, so that they
    arrive at the demonstrated ones with little energy: inexact matching. The latent point moves straight to the goal,
    and the motion is globally asymptotically stable there whatever the momenta are, as far as the flow is integrated
    exactly. A motion that crosses itself in the plane is no image of a line: what comes near it all the same squeezes
    space until floats cannot undo it, and is refused. Of several demonstrations it learns their mean, and notes that.

    Our own are three things: what is learned are the first momenta, from which all the rest follows (Miller, Trouvé and
    Younes 2006), and not whole paths of landmarks; the kernel, whose heavy tails let far landmarks help each other; and
    Newton's step, without which ψ⁻¹ is only as exact as the integration.

    ``fit_report.mse`` is the mean over all N n entries of the squared distance of all mapped points from the
    demonstration; ``n_layers`` is K; the notes tell how far ψ⁻¹(ψ(x)) is from x.

    Args:
        dim: n >= 1.
        n_landmarks: K >= 2.
        width: > 0, of the kernel, in sizes of the demonstration; None for the one of ``WIDTHS`` that comes nearer.
        iterations: of L-BFGS at most, >= 1; a quarter of them again each time that more steps are taken.
        straight: whether latent points lie on a straight line, even in time, as FDM's do, and not on the eigenmap's.

    Source: Joshi and Miller, "Landmark matching via large deformation diffeomorphisms", IEEE TIP 9 (2000).
    """

    diffeomorphism: LandmarkFlow
    dynamics: RayDynamics

    def __init__(
        self,
        dim: int,
        *,
        n_landmarks: int = 80,
        width: float | None = None,
        iterations: int = 200,
        straight: bool = False,
    ) -> None:
        self.n_landmarks = whole_number(n_landmarks, "n_landmarks", at_least=2)
        self.straight = bool(straight)
        method = FDM if straight else ChebyshevDS
        super().__init__(dim, LandmarkFlow(dim, self.n_landmarks), RayDynamics(method.time_law(1.0)))
        self.width = None if width is None else positive(width, "width")
        self.iterations = whole_number(iterations, "iterations", at_least=1)

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        motion, *_ = mean_motion(shown)
        goal_apart(motion, motion.goal)
        method = FDM if self.straight else ChebyshevDS
        points, latent = motion.positions, torch.from_numpy(method.latent_line(motion))
        learner, history = self._flow_onto(points / motion.size, latent / motion.size)
        psi = self.diffeomorphism
        assign(psi, {"steps": learner.steps})
        self.dynamics.law = method.time_law(motion.duration).to(self.attractor)
        with torch.no_grad():
            psi.landmarks.copy_(motion.size * learner.landmarks)
            psi.momenta.copy_(motion.size * learner.momenta)
            psi.width.copy_(motion.size * learner.width)
            self.attractor.copy_(motion.goal)
            self.start.copy_(motion.start)
            missed = psi(latent.to(self.attractor)) - points.to(self.attractor)
        self._refuse_folds(motion)
        several = f"learned the mean of {len(shown)} demonstrations, as it learns from one"
        notes = (
            *([several] if len(shown) > 1 else []),
            f"a kernel {float(learner.width):g} sizes wide; in {len(psi.steps)} steps, the flow and the flow back "
            f"differ by at most {learner.integration_gap(latent / motion.size):.1e} sizes",
        )
        return Learned(float(missed.square().mean()), self.n_landmarks, history, notes)

    def _flow_onto(self, points: Tensor, latent: Tensor) -> tuple[LandmarkFlow, tuple[float, ...]]:
        """The flow that carries latent points (N, n) onto those shown, all in sizes, and its loss by iteration."""
        chosen = torch.linspace(0, len(points) - 1, self.n_landmarks).round().long()
        tried: list[tuple[LandmarkFlow, tuple[float, ...]]] = []
        for width in WIDTHS if self.width is None else (self.width,):
            flow = LandmarkFlow(self.dim, self.n_landmarks)
            flow.steps = even_steps(FEWEST_STEPS)
            with torch.no_grad():
                flow.landmarks.copy_(latent[chosen])
                flow.width.fill_(width)
            tried.append((flow, flow.match(points[chosen], self.iterations)))
        flow, history = min(tried, key=lambda one: one[1][-1])
        while flow.integration_gap(latent) > INTEGRATION_LIMIT and 2 * len(flow.steps) <= MOST_STEPS:
            flow.steps = even_steps(2 * len(flow.steps))
            history += flow.match(points[chosen], -(-self.iterations // 4))
        return flow, history
