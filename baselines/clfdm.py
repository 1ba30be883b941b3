"""CLF-DM: any regression, corrected to descend a learned Lyapunov function (Khansari-Zadeh and Billard 2014)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from latentds.arguments import whole_number

from .mixture import MixtureRegression, drawn_seed, fit_regression, nearby
from .networks import NormalizedDS
from .pooling import Pool
from .training import Training, descend_smoothly

DESCENT_RATE = 1.0
"""α: V falls at least by α V a duration, so that whatever the regression says a motion is within a hundredth of its way
after ten."""
ARRIVING_RADIUS = 0.05
"""Sizes around the goal within which the regression, which is not 0 there, is led to one that moves to the goal."""
ARRIVING_RATE = 10.0
"""Of that one, -10 z, which falls by e in a tenth of the duration: led to 0, a motion would crawl on V's slope."""
SPEED_CAP = 2.0
"""Times the largest demonstrated speed that f approaches where its linear maps, far from where they were learned, would
be faster; what was shown it changes by less than a thousandth."""
MIN_EIGENVALUE = 1e-2
"""Least eigenvalue of the quadratic part of V, whose others are about 1."""
GROWTH_WEIGHT = 1e-6
"""Weight of the squared change of V's parameters: directions do not tell how steep V is, and where it grows without
bound its valleys are so narrow that no motion along them can be integrated."""
DESCENT_WEIGHT = 1e-4
"""Weight of descending steeply beside that of not rising, as in the authors' code."""


class CLFDM(NormalizedDS):
    """Control Lyapunov function-based dynamic movements: ẏ = f(y) + u(y), u as small as makes V fall (2014).

    V is a weighted sum of asymmetric quadratic functions, learned from the directions of the demonstrated velocities
    alone; f is Gaussian mixture regression of the velocities; and u = -∇V max(0, ∇V·f + ρ)/‖∇V‖², the least that gives
    V̇ <= -ρ. Where the demonstrations descend V, f is left as it is. Four things are our own: all matrices are positive
    by parametrisation, so that L-BFGS learns V without constraints; the margin is ρ = α V, which grows without bound
    and makes V fall exponentially; and f becomes -10 z within ``ARRIVING_RADIUS`` sizes of the goal, without which
    the field would jump there, and grows no faster than ``SPEED_CAP`` demonstrated speeds.

    Learns from one demonstration or from several, pooled; their goals' mean is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)²; ``n_layers`` is the mixture's K; the
    notes tell where demonstrations do not descend V.

    Args:
        dim: n >= 1.
        n_components: K >= 1 of the regression; None for as many of 1 to 12 as the Bayesian information criterion
            chooses.
        n_asymmetric: L >= 0 asymmetric functions in V; with none it is a quadratic form.
        iterations: of L-BFGS at most, >= 1.
        seed: of the mixture's k-means; None draws it from torch's generator.

    Attributes:
        pace: () buffer, the largest demonstrated speed in these units.
    """

    pace: Tensor

    def __init__(
        self,
        dim: int,
        *,
        n_components: int | None = None,
        n_asymmetric: int = 3,
        iterations: int = 300,
        seed: int | None = None,
    ) -> None:
        super().__init__(dim, seed=seed)
        self.n_components = None if n_components is None else whole_number(n_components, "n_components", at_least=1)
        self.n_asymmetric = whole_number(n_asymmetric, "n_asymmetric", at_least=0)
        self.iterations = whole_number(iterations, "iterations", at_least=1)
        self.register_buffer("pace", torch.ones((), dtype=torch.float64))
        self.energy = AsymmetricQuadratics(self.dim, self.n_asymmetric)
        self.regression = MixtureRegression(self.dim)

    def _train(self, pool: Pool, progress: bool) -> tuple[CLFDM, Training]:
        learner = CLFDM(**self.settings)
        regression = fit_regression(pool, self.n_components, drawn_seed(self.seed))
        learner.regression.load_state_dict(regression.state_dict())
        history, notes = learner.energy.learn(pool, self.iterations)
        with torch.no_grad():
            learner.pace.copy_(torch.linalg.vector_norm(pool.velocities, dim=-1).max())
        return learner, Training(history, notes, regression.mixture.n_components)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        energy: Tensor = self.energy(self._normalize(points))
        return energy.to(wanted)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        away = -torch.expm1(-u.square().sum(-1, keepdim=True) / (2 * ARRIVING_RADIUS**2))
        wish = torch.lerp(-ARRIVING_RATE * u, self.regression(u, nearby(u)), away)
        speed = torch.linalg.vector_norm(wish, dim=-1, keepdim=True)
        wish = wish / (1 + (speed / (SPEED_CAP * self.pace)) ** 8) ** 0.125
        energy, slope = self.energy.with_gradient(u)
        excess = (slope * wish).sum(-1) + DESCENT_RATE * energy
        steep = slope.square().sum(-1).clamp(min=torch.finfo(u.dtype).tiny)
        velocity: Tensor = wish - (excess.clamp(min=0) / steep).unsqueeze(-1) * slope
        return velocity


class AsymmetricQuadratics(nn.Module):
    """V(z) = zᵀ P₀ z + Σ_l max(0, zᵀ P_l (z - μ_l))² with P₀ > 0 and P_l >= 0, by P = R Rᵀ.

    z·∇V > 0 everywhere but at 0, whatever the parameters are: V has no other stationary point, and grows without bound.

    Attributes:
        root: (n, n), of P₀ - ``MIN_EIGENVALUE`` I.
        roots: (L, n, n), R_l.
        centers: (L, n), μ_l.
    """

    def __init__(self, dim: int, n_asymmetric: int) -> None:
        super().__init__()
        eye = torch.eye(dim, dtype=torch.float64)
        self.root = nn.Parameter(eye.clone())
        self.roots = nn.Parameter(eye.expand(n_asymmetric, -1, -1).clone())
        self.centers = nn.Parameter(torch.zeros(n_asymmetric, dim, dtype=torch.float64))

    def learn(self, pool: Pool, iterations: int) -> tuple[tuple[float, ...], tuple[str, ...]]:
        """Fall along the velocities of samples that move, by L-BFGS; the loss by step, and notes on where it rises."""
        speeds, distances = (torch.linalg.vector_norm(part, dim=-1) for part in (pool.velocities, pool.points))
        moving = (speeds > 1e-3 * speeds.max()) & (distances > ARRIVING_RADIUS)
        points, headings = pool.points[moving], pool.velocities[moving] / speeds[moving, None]
        with torch.no_grad():
            places = torch.linspace(0, len(points) - 1, len(self.centers) + 2, dtype=torch.float64)[1:-1].round()
            self.centers.copy_(points[places.long()])

        def rises() -> Tensor:
            slopes = self.gradient(points)
            cosines: Tensor = (slopes * headings).sum(-1) / torch.linalg.vector_norm(slopes, dim=-1)
            return cosines

        begun = {part: part.detach().clone() for part in self.parameters()}

        def loss() -> Tensor:
            rise = rises()
            grown = torch.stack([(part - before).square().sum() for part, before in begun.items()]).sum()
            return torch.where(rise > 0, rise.square(), -DESCENT_WEIGHT * rise.square()).mean() + GROWTH_WEIGHT * grown

        history = descend_smoothly(loss, dict.fromkeys(self.parameters(), 1.0), iterations)
        with torch.no_grad():
            share = float((rises() > 0).double().mean())
        notes = (f"V rises along {share:.1%} of the demonstrated samples, where it bends the motion",) if share else ()
        return history, notes

    def forward(self, z: Tensor) -> Tensor:
        """(..., n) -> (...)."""
        return self.with_gradient(z)[0]

    def gradient(self, z: Tensor) -> Tensor:
        """∇V, (..., n) -> (..., n)."""
        return self.with_gradient(z)[1]

    def with_gradient(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """V and ∇V, (..., n) -> (...), (..., n)."""
        pulled = _times(self.root @ self.root.mT, z) + MIN_EIGENVALUE * z
        here, forms = z.unsqueeze(-2), self.roots @ self.roots.mT
        # zᵀ P_l (z - μ_l), (..., L), with its gradient P_l (2 z - μ_l), (..., L, n)
        values = (here * _times(forms, here - self.centers)).sum(-1).clamp(min=0)
        slopes = _times(forms, 2 * here - self.centers)
        energy: Tensor = (z * pulled).sum(-1) + values.square().sum(-1)
        slope: Tensor = 2 * pulled + (2 * values.unsqueeze(-1) * slopes).sum(-2)
        return energy, slope


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Matrices (..., n, n) by vectors (..., n), summed alike in every batch."""
    return (matrices * vectors.unsqueeze(-2)).sum(-1)
