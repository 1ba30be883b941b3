"""ImitationFlow: a stable linear stochastic system, seen through a learned flow (Urain et al. 2020)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from latentds.arguments import positive, real_tensor, whole_number
from latentds.dynamics import Frame

from .couplings import AffineCouplings, no_autocast
from .flows import FlowDS, FlowDynamics, Normalized
from .networks import seeded_generator
from .training import Training
from .transitions import INITIAL_RATE, INITIAL_SPREAD, STRIDE, descend_likelihood, surprise

LEAST_RATE = 0.1
"""Of the decay, per duration."""


class ImitationFlow(FlowDS):
    """dz = A z dt + s B dw with A = K - BBᵀ/2, K skew, z = ψ⁻¹(y) - ψ⁻¹(y*): stable by its form (Urain et al. 2020).

    Every linear stochastic system that is stable and that noise moves in all directions is of this form, in
    coordinates in which its stationary density is N(0, s² I); ψ, a chain of affine couplings, holds those coordinates.
    From z it is after t at N(e^{At} z, s² (I - e^{At} e^{Aᵀt})), exactly: :meth:`sample` draws from that, and
    :meth:`log_density` is its density. The velocity and :meth:`rollout` are those without noise, ẏ = J_ψ A z, and
    V(y) = ‖z‖²/s², -2 times the logarithm of z's stationary density but for a constant, falls along them.

    Learns by maximum likelihood from pairs of samples, as the paper does. Three things are our own: pairs are up to 128
    samples apart, not neighbours alone; samples are taken to be seen within ``SEEN_WITHIN`` only, which bounds the
    likelihood of a single demonstration; and the stationary density, from which a demonstration does not start, has no
    part in it. The couplings are learned in float32, as SDS-EF's are, and the dynamics in float64.

    A linear system neither rests at its start nor arrives in finite time: both must be bent into ψ, and a demonstration
    that ends at full speed is rounded off near its goal.

    ``fit_report.mse`` is the mean over all N n entries of the squared velocity error, (units / second)².

    Args:
        dim: n >= 1.
        n_layers: L >= 1, couplings.
        n_features: F >= 1, random Fourier features in each half of a coupling.
        seed: of the frozen features, all that is drawn; None draws them from torch's generator.
        epochs: steps of Adam, each on all pairs, >= 1.

    Source: Urain, Ginesi, Tateo and Peters, "ImitationFlow: Learning Deep Stable Stochastic Dynamic Systems by
    Normalizing Flows", IROS 2020.
    """

    diffeomorphism: AffineCouplings
    dynamics: LinearDynamics

    def __init__(
        self, dim: int, *, n_layers: int = 10, n_features: int = 200, seed: int | None = None, epochs: int = 1500
    ) -> None:
        self_seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        psi = AffineCouplings(dim, n_layers, n_features, generator=seeded_generator(self_seed))
        super().__init__(dim, psi, LinearDynamics(psi.dim))
        self.n_layers, self.n_features, self.seed = psi.n_layers, psi.n_features, self_seed
        self.epochs = whole_number(epochs, "epochs", at_least=1)

    def _train(self, data: Normalized, generator: torch.Generator | None, progress: bool) -> Training:
        return descend_likelihood(self.diffeomorphism, self.dynamics, data, data.goal, self.epochs, progress)

    @torch.no_grad()
    def sample(self, y0: Any, t: Any, count: int, *, seed: int | None = None) -> Tensor:
        """Paths of the stochastic system from ``y0``, without error of a time step; no gradient passes.

        Args:
            y0: (..., n).
            t: (T,) seconds, not decreasing; every path is at y0 at ``t[0]``.
            count: how many from each y0, >= 1.
            seed: of the noise; None draws it from torch's generator.

        Returns:
            (count, ..., T, n).
        """
        points, wanted = self._points(y0, "y0")
        times, count = self._times(t), whole_number(count, "count", at_least=1)
        generator = seeded_generator(None if seed is None else whole_number(seed, "seed", at_least=0))
        frame = self.frame()
        z = (self.diffeomorphism.inverse(points) - frame.attractor).expand(count, *points.shape)
        states = [z]
        for move in self.dynamics.moves(times.diff() / self.dynamics.duration):
            axes, kept, _ = torch.linalg.svd(move)  # a root of I - MMᵀ that rounding cannot make negative
            noise = torch.randn(z.shape, dtype=z.dtype, generator=generator).to(z)
            z = z @ move.mT + self.dynamics.spread() * ((1 - kept.square()).clamp(min=0).sqrt() * noise) @ axes.mT
            states.append(z)
        paths = self.diffeomorphism(frame.attractor + torch.stack(states, dim=-2)).to(wanted)
        return self._with_exact_start(real_tensor(y0, "y0").expand(count, *points.shape), paths)

    def log_density(self, y_next: Any, y: Any, dt: float) -> Tensor:
        """log p(y_next | y), of being at ``y_next`` ``dt`` > 0 seconds after ``y``: (..., n), (..., n) -> (...)."""
        (later, wanted), (earlier, _) = self._points(y_next, "y_next"), self._points(y)
        goal, psi = self.frame().attractor, self.diffeomorphism
        x = psi.inverse(later)
        time = (positive(dt, "dt") / self.dynamics.duration).reshape(1)
        mean, covariance = self.dynamics.transition(psi.inverse(earlier) - goal, time, torch.zeros(1, dtype=torch.long))
        missed = -surprise(x - goal - mean, covariance[0]) - self.dim / 2 * math.log(2 * math.pi)
        return (missed - psi.log_abs_det_jacobian(x)).to(wanted)


class LinearDynamics(FlowDynamics):
    """ẋ = (K - BBᵀ/2)(x - x*), with noise s B that :meth:`transition` knows, in units of the duration.

    BBᵀ is MMᵀ + 2 ``LEAST_RATE`` I, so that ‖x - x*‖ falls at least at that rate, whatever the parameters are.

    Args:
        dim: n >= 1.

    Attributes:
        noise, turning, log_spread: parameters over ``STRIDE``: M (n, n), what is made skew for K (n, n), and log s ().
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.noise = nn.Parameter((2 * (INITIAL_RATE - LEAST_RATE)) ** 0.5 / STRIDE * torch.eye(dim).double())
        self.turning = nn.Parameter(torch.zeros(dim, dim, dtype=torch.float64))
        self.log_spread = nn.Parameter(torch.tensor(math.log(INITIAL_SPREAD) / STRIDE, dtype=torch.float64))

    def spread(self) -> Tensor:
        """s, () > 0."""
        return torch.exp(STRIDE * self.log_spread)

    def drift(self) -> Tensor:
        """A, (n, n), per duration."""
        with no_autocast(self.noise):
            decay = STRIDE**2 / 2 * self.noise @ self.noise.mT + LEAST_RATE * torch.eye(len(self.noise)).to(self.noise)
            return STRIDE * (self.turning - self.turning.mT) - decay

    def moves(self, t: Tensor) -> Tensor:
        """e^{At} for t in durations: (T,) -> (T, n, n)."""
        moves: Tensor = torch.linalg.matrix_exp(t[:, None, None] * self.drift())
        return moves

    def transition(self, z: Tensor, times: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        moves = self.moves(times)
        covariances = self.spread().square() * (torch.eye(z.shape[-1]).to(z) - moves @ moves.mT)
        return (moves[which] @ z.unsqueeze(-1)).squeeze(-1), covariances

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        with no_autocast(x):
            return (x - frame.attractor) @ self.drift().mT / self.duration

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        with no_autocast(x):
            moved = self.moves(t / self.duration) @ (x - frame.attractor)[..., None, :, None]
        return frame.attractor + moved.squeeze(-1)

    def lyapunov(self, x: Tensor, frame: Frame) -> Tensor:
        return super().lyapunov(x, frame) / self.spread().square()

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float:
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        if not (finite and self.duration > 0):
            return -math.inf
        drift = self.drift().detach()
        return -float(torch.linalg.eigvalsh((drift + drift.mT) / 2)[-1] / self.duration)
