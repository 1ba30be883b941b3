"""Contracting, after NCDS and ELCD: any two motions come nearer to each other at a certified rate."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn

from latentds.arguments import number_in, whole_number
from latentds.dynamics import Frame
from latentds.integrate import integrate

from .couplings import AffineCouplings, no_autocast
from .flows import FlowDS, FlowDynamics, Normalized, descend_bending, velocity_loss
from .networks import seeded_generator
from .training import Plan, Training


class NCDS(FlowDS):
    """Contracting, after NCDS and ELCD: ẋ has the Jacobian -(JᵀJ + εI) + S in the space of a learned flow.

    φ = ψ⁻¹ is a chain of affine couplings and the latent field :class:`ContractingDynamics`; both are learned together
    from velocities, of one demonstration or of several, pooled; their goals' mean is the attractor. Contraction does
    not depend on coordinates, so motions approach each other at least at the rate ε in the metric of J_φᵀJ_φ.

    Where this differs from NCDS (Beik-Mohammadi et al. 2024), and why: it is not the network of that paper. There J is
    a deep network of x, and ẋ is -(JᵀJ + εI) integrated along a line. Such an integral depends on the line unless the
    rows of JᵀJ are gradients, and then -(JᵀJ + εI) is not the Jacobian of ẋ: what is certified is that motions approach
    the line's first point, not each other. J of one layer has such rows: the integral is in closed form, the same along
    every line, and contraction is certified. What it says less, the flow says, as the flow of the paper's autoencoder
    does; the skew S is from ELCD (Jaffe et al. 2024).

    The loss is that of the velocities alone; in three dimensions and more the demonstration is bent from its chord in
    steps, without which a winding one is not learned.

    ``fit_report.mse`` is the mean over all N n entries of the squared velocity error, (units / second)².

    Args:
        dim: n >= 1.
        n_layers: L >= 1, couplings.
        n_features: F >= 1, random Fourier features in each half of a coupling.
        n_units: M >= 1, rows of J.
        rate: ε > 0, least rate of contraction, per duration of the demonstration.
        seed: of the frozen features, the initial J and the batches; None draws them from torch's generator.
        epochs: passes over the samples, >= 1.
    """

    diffeomorphism: AffineCouplings
    dynamics: ContractingDynamics

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int = 10,
        n_features: int = 200,
        n_units: int = 64,
        rate: float = 0.5,
        seed: int | None = None,
        epochs: int = 500,
    ) -> None:
        self_seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        generator = seeded_generator(self_seed)
        psi = AffineCouplings(dim, n_layers, n_features, generator=generator)
        dynamics = ContractingDynamics(psi.dim, n_units, rate, generator=generator)
        super().__init__(dim, psi, dynamics)
        self.n_layers, self.n_features, self.n_units = psi.n_layers, psi.n_features, dynamics.n_units
        self.rate = dynamics.rate
        self.seed = self_seed
        self.epochs = whole_number(epochs, "epochs", at_least=1)

    def _train(self, data: Normalized, generator: torch.Generator | None, progress: bool) -> Training:
        plan = Plan(self.epochs, learning_rate=2e-3, n_batches=4, warm_up=0.05, clip=1.0, slack=0.3)

        def pull(u: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            return self.dynamics.pull(z), torch.ones_like(z[:, :1])

        loss_of = partial(velocity_loss, self.diffeomorphism, pull)
        return descend_bending(self, loss_of, data, plan, generator, progress)


class ContractingDynamics(FlowDynamics):
    """ẋ = -Wᵀ(tanh(Wz + b) - tanh(b)) - εz + Sz, z = x - x*, S skew, in units of the duration.

    Its Jacobian is -(JᵀJ + εI) + S with J = diag(√(1 - tanh²(Wz + b))) W, so ‖x - z‖ of any two motions falls at least
    at the rate ε.

    Args:
        dim: n >= 1.
        n_units: M >= 1, rows of W.
        rate: ε > 0, per duration.
        generator: draws W and b (torch's global one if None).
    """

    def __init__(self, dim: int, n_units: int, rate: float, *, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.n_units = whole_number(n_units, "n_units", at_least=1)
        self.rate = number_in(rate, "rate", 0, math.inf)
        drawn = torch.randn(self.n_units, dim + 1, dtype=torch.float64, generator=generator)
        self.weight = nn.Parameter(drawn[:, :-1] * (2 / self.n_units) ** 0.5)
        self.bias = nn.Parameter(drawn[:, -1] * 0.5)
        self.turning = nn.Parameter(torch.zeros(dim, dim, dtype=torch.float64))

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        return self.pull(x - frame.attractor) / self.duration

    def pull(self, z: Tensor) -> Tensor:
        """ẋ per duration at x* + z: (..., n) -> (..., n)."""
        with no_autocast(z):
            linear = self.turning - self.turning.mT - self.rate * torch.eye(z.shape[-1]).to(z)
            risen = torch.tanh(z @ self.weight.mT + self.bias) - torch.tanh(self.bias)
            return z @ linear.mT - risen @ self.weight

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        return integrate(lambda states: self(states, states, frame), x, t, frame.attractor)

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float:
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        return self.rate / float(self.duration) if finite and self.duration > 0 else -math.inf
