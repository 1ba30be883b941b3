"""Gaussian mixtures, and regression by them: what several methods take their linear pieces from."""

from __future__ import annotations

import importlib
import random
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import Array, check_points, whole_number
from latentds.resizing import assign, make_room

from .pooling import Pool

MOST_COMPONENTS = 12
"""How many the Bayesian information criterion may choose from."""
NEARBY_RADIUS = 2.0
"""Sizes from the goal beyond which nothing was demonstrated."""
MOST_SAMPLES = 400
"""That a mixture is fitted to, evenly chosen: neighbours in time tell nearly the same, and counted as so many witnesses
they let the criterion choose as many components as there are to choose from."""
VARIANCE_RIDGE = 1e-3
"""Added to the variances of normalised samples: a thirtieth of a size, so that a single demonstration, of no width,
does not make a field that changes within its own width."""


class GaussianMixture(nn.Module):
    """Weighted Gaussian densities h_k exp(-½ ‖W_k (x - μ_k)‖²) over R^n; one of height 1 around 0 until assigned.

    No value of a parameter is forbidden: W_kᵀ W_k is a precision whatever W_k is, and heights are kept as logarithms.
    ``load_state_dict`` takes any number of components.

    Args:
        dim: n >= 1.
        n_components: K >= 1.

    Attributes:
        log_heights: (K,), log h_k: of a mixture with weights π_k log π_k + log |det W_k|, up to a common constant.
        means: (K, n), μ_k.
        whiteners: (K, n, n), W_k.
    """

    def __init__(self, dim: int, n_components: int = 1) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        count = whole_number(n_components, "n_components", at_least=1)
        self.log_heights = nn.Parameter(torch.zeros(count, dtype=torch.float64))
        self.means = nn.Parameter(torch.zeros(count, self.dim, dtype=torch.float64))
        self.whiteners = nn.Parameter(torch.eye(self.dim, dtype=torch.float64).expand(count, -1, -1).clone())

    @property
    def n_components(self) -> int:
        return len(self.log_heights)

    def assign(self, weights: Any, means: Any, covariances: Any) -> None:
        """Become the mixture with weights (K,) > 0, means (K, n) and covariances (K, n, n), positive definite."""
        roots = np.linalg.cholesky(np.asarray(covariances, dtype=np.float64))
        whiteners = np.linalg.inv(roots)
        heights = np.log(weights) - np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(1)
        assign(self, {"log_heights": heights, "means": means, "whiteners": whiteners})

    def log_densities(self, x: Tensor) -> Tensor:
        """log h_k - ½ ‖W_k (x - μ_k)‖², each component's: (..., n) -> (..., K)."""
        check_points(self.dim, x, "x")
        offsets = x.unsqueeze(-2) - self.means
        apart = (self.whiteners * offsets.unsqueeze(-2)).sum(-1)
        return self.log_heights - apart.square().sum(-1) / 2

    def forward(self, x: Tensor) -> Tensor:
        """The components' responsibilities for x, which are >= 0 and add up to 1: (..., n) -> (..., K)."""
        return torch.softmax(self.log_densities(x), dim=-1)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        make_room(self, state_dict, prefix, ["log_heights", "means", "whiteners"])
        super()._load_from_state_dict(state_dict, prefix, *rest)


class MixtureRegression(nn.Module):
    """Affine maps mixed by a Gaussian mixture of their inputs, x ↦ Σ_k γ_k(x) (A_k x + b_k); zero until assigned.

    That is Gaussian mixture regression (Ghahramani and Jordan 1994): the mean of v given x in a mixture over (x, v).
    ``load_state_dict`` takes any number of components.

    Args:
        dim: n >= 1, of inputs and of outputs.
        n_components: K >= 1.

    Attributes:
        mixture: γ, over the inputs.
        slopes: (K, n, n), A_k.
        offsets: (K, n), b_k.
    """

    def __init__(self, dim: int, n_components: int = 1) -> None:
        super().__init__()
        self.mixture = GaussianMixture(dim, n_components)
        count, dim = self.mixture.n_components, self.mixture.dim
        self.slopes = nn.Parameter(torch.zeros(count, dim, dim, dtype=torch.float64))
        self.offsets = nn.Parameter(torch.zeros(count, dim, dtype=torch.float64))

    def assign(self, weights: Array, means: Array, covariances: Array) -> None:
        """Become the regression by the mixture over (x, v): (K,), (K, 2n), (K, 2n, 2n), as ``GaussianMixture``'s."""
        n = self.mixture.dim
        self.mixture.assign(weights, means[:, :n], covariances[:, :n, :n])
        slopes = np.linalg.solve(covariances[:, :n, :n], covariances[:, :n, n:]).swapaxes(1, 2)
        offsets = means[:, n:] - np.einsum("kij,kj->ki", slopes, means[:, :n])
        assign(self, {"slopes": slopes, "offsets": offsets})

    def forward(self, x: Tensor, seen_at: Tensor | None = None) -> Tensor:
        """(..., n) -> (..., n); the responsibilities are those ``seen_at`` other places (..., n) if these are given."""
        shares: Tensor = self.mixture(x if seen_at is None else seen_at).unsqueeze(-1)
        values = (self.slopes * x.unsqueeze(-2).unsqueeze(-2)).sum(-1) + self.offsets
        mixed: Tensor = (shares * values).sum(-2)
        return mixed

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        make_room(self, state_dict, prefix, ["slopes", "offsets"])
        super()._load_from_state_dict(state_dict, prefix, *rest)


def nearby(z: Tensor) -> Tensor:
    """z (..., n), or where the way there from 0 leaves the ball of radius ``NEARBY_RADIUS``: (..., n).

    Far from all Gaussians their responsibilities change from 0 to 1 within less and less of a size. A field mixed by
    those of the nearby place is as good there and can be integrated.
    """
    distance = torch.linalg.vector_norm(z, dim=-1, keepdim=True).clamp(min=NEARBY_RADIUS)
    near: Tensor = z * (NEARBY_RADIUS / distance)
    return near


def fit_mixture(
    samples: Array, n_components: int | None, seed: int, *, most: int = MOST_COMPONENTS
) -> tuple[Array, Array, Array]:
    """Weights (K,), means (K, d) and full covariances (K, d, d) of a mixture of samples (N, d), by scikit-learn's EM.

    Args:
        samples: (N, d), of about unit size: ``VARIANCE_RIDGE`` is added to their variances.
        n_components: K >= 1; None for the number of 1 to ``most`` with the least Bayesian information criterion.
        seed: of the k-means that EM starts from.
        most: >= 1.
    """
    sklearn = scikit_learn("mixture")
    most = min(most, len(samples) // (2 * samples.shape[1]) or 1)
    counts = range(1, most + 1) if n_components is None else [n_components]
    fits = [
        sklearn.GaussianMixture(count, reg_covar=VARIANCE_RIDGE, random_state=seed, max_iter=200).fit(samples)
        for count in counts
    ]
    best = fits[0] if len(fits) == 1 else min(fits, key=lambda fit: float(fit.bic(samples)))
    return best.weights_, best.means_, best.covariances_


def fit_regression(pool: Pool, n_components: int | None, seed: int) -> MixtureRegression:
    """The velocities of a pool by its points: regression by the mixture that :func:`fit_mixture` finds of both.

    ``MOST_SAMPLES`` of them are looked at, or thirty for each component.
    """
    pace = float(pool.velocities.square().mean().sqrt() / pool.points.std())
    samples = torch.cat([pool.points, pool.velocities / pace], dim=1).numpy()
    chosen = np.linspace(0, len(samples) - 1, min(len(samples), max(MOST_SAMPLES, 30 * (n_components or 0)))).round()
    weights, means, covariances = fit_mixture(samples[chosen.astype(int)], n_components, seed)
    dim = pool.points.shape[1]
    units = np.concatenate([np.ones(dim), np.full(dim, pace)])
    regression = MixtureRegression(dim)
    regression.assign(weights, means * units, covariances * units * units[:, None])
    return regression


def scikit_learn(module: str) -> Any:
    """A part of scikit-learn, which only fitting needs.

    Raises:
        ImportError: without it; the message says how to install it.
    """
    state = random.getstate()  # which the first import of it moves
    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError as error:
        raise ImportError("Gaussian mixtures need scikit-learn: pip install 'latentds[field]'") from error
    finally:
        random.setstate(state)


def drawn_seed(seed: int | None) -> int:
    """``seed``, or one from torch's generator."""
    return int(torch.randint(2**31 - 1, ())) if seed is None else seed
