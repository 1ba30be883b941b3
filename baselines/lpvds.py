"""LPV-DS: linear systems under one quadratic Lyapunov function, mixed by Gaussians (Figueroa and Billard 2018)."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import Array, whole_number
from latentds.kernels.dispatch import no_active_transforms
from latentds.memo import Memo
from latentds.resizing import assign, make_room

from .couplings import no_autocast
from .mixture import GaussianMixture, drawn_seed, scikit_learn
from .networks import NormalizedDS, thinned
from .pooling import Pool
from .training import Training

LEAST_RATE = 0.1
"""Least rate at which √V falls, per duration of the demonstration."""
LEAST_EIGENVALUE = 0.02
"""Least eigenvalue of P whose mean eigenvalue is 1: bounds how flat its ellipsoids are."""
DIRECTION_WEIGHT = 0.5
"""What a unit of direction counts beside a size of the motion where samples are clustered."""
LOCAL_WEIGHT = 0.3
"""Weight of each system's own misses beside the mixture's: systems that cancel on the samples run wild off them."""
RIDGE_WEIGHT = 1e-6
"""Weight of the squared entries of the A_k: of directions in which nothing was shown the misses tell nothing, and the
solver finds no end."""
LEAST_VARIANCE = 1e-3
"""Least variance of a component, in squared sizes: narrower ones switch from one system to the next like a jump."""
REST_SPEED = 0.1
"""Share of the mean speed below which a direction counts less."""
LEAST_WEIGHT = 5e-3
"""Components with fewer of the samples are dropped."""


class LPVDS(NormalizedDS):
    """f(u) = Σ_k γ_k(u) A_k u with P A_k + A_kᵀ P ≼ -2ρP, so that V = uᵀ P u falls everywhere.

    In three steps. A mixture with a Dirichlet-process prior, by scikit-learn's variational inference, of positions and
    directions of motion together, so that samples are in one component only if they are near and go the same way: what
    the paper's physically-consistent prior is for. P from the convex program min Σ max(0, ûᵀ P v̂) over unit vectors,
    tr P = n: the ellipsoids that the demonstrations leave least. And the A_k by least squares of the velocities under
    the matrix inequality, a semidefinite program for this P (the paper's third, "P-QLF"). Both by cvxpy with clarabel.
    Beside the mixture's own misses the program has those of each A_k where it is responsible.

    The inequality holds whatever the parameters are: A_k = P⁻¹(K - Kᵀ - LLᵀ) - ρI and P = RRᵀ + I/1000.

    Needs the extra ``field`` to fit. ``load_state_dict`` takes any number of components.

    Args:
        dim: n >= 1.
        n_components: most components, >= 1.
        seed: of the k-means that the mixture starts from; None draws it from torch's generator.
    """

    def __init__(self, dim: int, *, n_components: int = 20, seed: int | None = None) -> None:
        super().__init__(dim, seed=seed)
        self.n_components = whole_number(n_components, "n_components", at_least=1)
        self.mixture = GaussianMixture(self.dim)
        self.systems = LinearSystems(self.dim)

    def _train(self, pool: Pool, progress: bool) -> tuple[LPVDS, Training]:
        learner, pool = LPVDS(**self.settings), thinned(pool)
        points, velocities = pool.points.numpy(), pool.velocities.numpy()
        weights, means, covariances = _clustered(points, velocities, self.n_components, drawn_seed(self.seed))
        learner.mixture.assign(weights, means, covariances)
        with torch.no_grad():
            shares = learner.mixture(pool.points).numpy()
        exact = learner.systems.solve(points, velocities, shares)
        notes = (f"{len(weights)} components", *(() if exact else ("the solver's linear systems are not its best",)))
        return learner, Training((), notes)

    def normalized_velocity(self, u: Tensor) -> Tensor:
        shares = self.mixture(u).unsqueeze(-1)
        velocity: Tensor = (shares * self.systems(u)).sum(-2)
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        u = self._normalize(points)
        with no_autocast(u):
            return ((u @ self.systems.metric()) * u).sum(-1).to(wanted)


class LinearSystems(nn.Module):
    """u ↦ A_k u, for all of which uᵀ P u falls at 2ρ or faster; one, -ρu, until assigned.

    Args:
        dim: n >= 1.

    Attributes:
        root: (n, n), R of P = RRᵀ + I/1000.
        turning: (m, n, n), of which P A_k has the skew part.
        damping: (m, n, n), of which P A_k has the symmetric part beyond -ρP.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.root = nn.Parameter(torch.eye(dim, dtype=torch.float64))
        self.turning = nn.Parameter(torch.zeros(1, dim, dim, dtype=torch.float64))
        self.damping = nn.Parameter(torch.zeros(1, dim, dim, dtype=torch.float64))
        self._memo = Memo[Tensor]()

    def metric(self) -> Tensor:
        """P, (n, n)."""
        return self.root @ self.root.mT + 1e-3 * torch.eye(len(self.root)).to(self.root)

    def matrices(self) -> Tensor:
        """A_k, (m, n, n)."""
        pulled = self.turning - self.turning.mT - self.damping @ self.damping.mT
        matrices: Tensor = torch.linalg.solve(self.metric(), pulled) - LEAST_RATE * torch.eye(len(self.root)).to(
            self.root
        )
        return matrices

    def forward(self, u: Tensor) -> Tensor:
        """(..., n) -> (..., m, n)."""
        return (self._kept_matrices() * u.unsqueeze(-2).unsqueeze(-2)).sum(-1)

    def _kept_matrices(self) -> Tensor:
        """The matrices, solved for when a parameter changed: a motion asks thousands of times."""
        sources: list[Tensor] = [self.root, self.turning, self.damping]
        if torch.is_grad_enabled() or self.root.is_meta or not no_active_transforms():
            return self.matrices()
        return self._memo.of(None, sources, self.matrices)

    def assign(self, metric: Array, matrices: Array) -> None:
        """Become the systems with this P, (n, n), and these A_k, (m, n, n), up to what breaks the inequality."""
        pulled = metric @ matrices + LEAST_RATE * metric
        values, vectors = np.linalg.eigh(-(pulled + pulled.swapaxes(1, 2)) / 2)
        values = np.sqrt(values.clip(min=0))
        root = np.linalg.cholesky(metric - 1e-3 * np.eye(len(metric)))
        assign(self, {"root": root, "turning": pulled / 2, "damping": vectors * values[:, None, :]})

    def solve(self, points: Array, velocities: Array, shares: Array) -> bool:
        """Become what the two convex programs find for samples (N, n) with shares (N, m); whether exactly so."""
        metric = _metric(points, velocities)
        matrices, exact = _matrices(points, velocities, shares, metric)
        self.assign(metric, matrices)
        return exact

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        make_room(self, state_dict, prefix, ["turning", "damping"])
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _clustered(points: Array, velocities: Array, most: int, seed: int) -> tuple[Array, Array, Array]:
    """Weights (m,), means (m, n) and covariances (m, n, n) of positions, from a mixture of them and directions."""
    samples = np.hstack([points, DIRECTION_WEIGHT * _headings(velocities)])
    n, most = points.shape[1], min(most, len(points))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a limit of iterations: what they reached is a mixture, too
        mixture = scikit_learn("mixture").BayesianGaussianMixture(
            n_components=most,
            weight_concentration_prior=1 / most,
            covariance_prior=np.cov(samples.T) + LEAST_VARIANCE * np.eye(2 * n),  # a motion may lie in a plane
            reg_covar=LEAST_VARIANCE,
            max_iter=300,
            random_state=seed,
        )
        found = mixture.fit(samples)
    kept = found.weights_ >= min(LEAST_WEIGHT, found.weights_.max())
    return found.weights_[kept], found.means_[kept, :n], found.covariances_[kept, :n, :n]


def _metric(points: Array, velocities: Array) -> Array:
    """P, (n, n), of trace n, whose ellipsoids around 0 the velocities leave least."""
    cp, n = _cvxpy(), points.shape[1]
    here = points / np.linalg.norm(points, axis=1, keepdims=True).clip(min=1e-9)
    metric = cp.Variable((n, n), PSD=True)
    rise = (here[:, :, None] * _headings(velocities)[:, None, :]).reshape(len(here), -1) @ cp.vec(metric, order="C")
    cost = cp.sum(cp.pos(rise)) / len(here) + 1e-3 * cp.sum_squares(metric - np.eye(n))
    program = cp.Problem(cp.Minimize(cost), [cp.trace(metric) == n, metric >> LEAST_EIGENVALUE * np.eye(n)])
    program.solve(solver=cp.CLARABEL)
    return np.asarray((metric.value + metric.value.T) / 2)


def _matrices(points: Array, velocities: Array, shares: Array, metric: Array) -> tuple[Array, bool]:
    """A_k, (m, n, n), whose mixture has these velocities, by least squares under the inequality; whether exactly so."""
    cp, (count, n) = _cvxpy(), (shares.shape[1], points.shape[1])
    matrices = [cp.Variable((n, n)) for _ in range(count)]
    together = (shares[:, :, None] * points[:, None, :]).reshape(len(points), -1)
    misses = [_miss(together, velocities) @ cp.vstack([*(matrix.T for matrix in matrices), -np.eye(n)])]
    for matrix, share in zip(matrices, np.sqrt(LOCAL_WEIGHT * shares.T)[:, :, None], strict=True):
        misses.append(_miss(share * points, share * velocities) @ cp.vstack([matrix.T, -np.eye(n)]))
    bounds = []
    for matrix in matrices:
        pulled = metric @ matrix + matrix.T @ metric + 2 * LEAST_RATE * metric
        bounds.append((pulled + pulled.T) / 2 << 0)
    cost = cp.sum([cp.sum_squares(miss) for miss in misses]) / len(points)
    cost += RIDGE_WEIGHT * cp.sum([cp.sum_squares(matrix) for matrix in matrices])
    program = cp.Problem(cp.Minimize(cost), bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an inexact solution: the notes say it
        program.solve(solver=cp.CLARABEL)
    return np.stack([matrix.value for matrix in matrices]), program.status == cp.OPTIMAL


def _miss(design: Array, velocities: Array) -> Array:
    """(r, d + n), of as few rows as can be: times [X, -I]ᵀ it is as long as (N, d) @ X - (N, n), for every X (d, n)."""
    return np.asarray(np.linalg.qr(np.hstack([design, velocities]), mode="r"))


def _headings(velocities: Array) -> Array:
    """(N, n) of length 1, less where the motion all but rests and its direction is noise."""
    squares = np.square(velocities).sum(1, keepdims=True)
    headings: Array = velocities / np.sqrt(squares + REST_SPEED**2 * squares.mean())
    return headings


def _cvxpy() -> Any:
    try:
        return importlib.import_module("cvxpy")
    except ImportError as error:
        raise ImportError("LPV-DS needs cvxpy and clarabel: pip install 'latentds[field]'") from error
