"""Latent dynamics with noise, learned with a flow by the likelihood of later samples given earlier ones."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from .couplings import AffineCouplings
from .flows import Normalized, quickest_linearize
from .training import Plan, Training, descend

LAGS = (1, 2, 4, 8, 16, 32, 64, 128)
"""Samples from one point of a pair to the other: near ones tell velocities, far ones keep errors from adding up."""
MOST_SAMPLES = 400
"""Samples of all demonstrations together above which only every second, third, … is taken."""
SEEN_WITHIN = 0.01
"""Standard deviation, in boxes of the demonstrations, within which a sample is taken to be seen. A single demonstration
shows no noise, and without this its likelihood grows for ever as the map flattens what lies beside it."""
INITIAL_RATE = 4.0
"""Of the decay, per duration."""
INITIAL_SPREAD = 0.03
"""Of the latent noise, in boxes."""
STRIDE = 10.0
"""Adam moves every number alike: those of the dynamics are kept so many times too small, and so move as much faster."""


class TransitionModel(Protocol):
    """Latent dynamics with noise, in units of the duration, whose parameters :func:`descend_likelihood` learns."""

    def transition(self, z: Tensor, times: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Means (..., n) after ``times[which]`` from z (..., n), and the covariances (U, n, n) after ``times`` (U,)."""

    def parameters(self) -> Any: ...

    def double(self) -> Any: ...


class Pairs(NamedTuple):
    """Which samples follow which, at ``LAGS``."""

    earlier: Tensor
    """(P,) indices of samples"""
    later: Tensor
    """(P,)"""
    which: Tensor
    """(P,) indices of times"""
    times: Tensor
    """(U,) durations from earlier to later"""

    @classmethod
    def of(cls, data: Normalized) -> Pairs:
        stride = math.ceil(len(data.points) / MOST_SAMPLES)
        earlier, later, times = [], [], []
        for i, step in enumerate(data.steps):
            own = (data.owner == i).nonzero().squeeze(-1).flip(0)[::stride].flip(0)  # the goal among them
            for lag in (lag for lag in LAGS if lag < len(own)):
                earlier.append(own[:-lag])
                later.append(own[lag:])
                times.append((step * stride * lag).expand(len(own) - lag))
        known, which = torch.unique(torch.cat(times), return_inverse=True)
        return cls(torch.cat(earlier), torch.cat(later), which, known)


def descend_likelihood(
    psi: AffineCouplings, model: TransitionModel, data: Normalized, anchor: Tensor, epochs: int, progress: bool
) -> Training:
    """Maximise the mean log-likelihood of later samples given earlier ones, z = φ(u) - φ(anchor), to first order in u.

    With e the latent miss of the mean and Σ its covariance, J_φ⁻¹ e is N(0, J_φ⁻¹ Σ J_φ⁻ᵀ + ``SEEN_WITHIN``² I).

    Args:
        psi: φ⁻¹ of normalised points, on the CPU in float32.
        model: the latent dynamics; taken to float64.
        data: the demonstrations.
        anchor: (n,) where z is 0, normalised.
        epochs: steps.
        progress: whether to show a bar.
    """
    model.double()
    pairs = Pairs.of(data)._asdict()
    earlier, later, which, times = (part.to(psi.center.device) for part in pairs.values())
    used, places = torch.unique(torch.cat([earlier, later]), return_inverse=True)
    earlier, later = places.tensor_split(2)
    points = torch.cat([data.points.to(psi.center)[used], anchor.to(psi.center).unsqueeze(0)])
    unit = torch.eye(psi.dim).to(points)
    seen = SEEN_WITHIN**2 * unit.double()
    linearize = quickest_linearize(psi)

    def loss(_: Tensor) -> Tensor:
        x, push = linearize(points)
        back = push(unit.unsqueeze(1).expand(-1, len(points), -1))[:, :-1].movedim(0, -1).double()[later]
        z = x[:-1].double() - x[-1].double()
        mean, covariances = model.transition(z[earlier], times, which)
        missed = (back @ (z[later] - mean).unsqueeze(-1)).squeeze(-1)
        return surprise(missed, back @ covariances[which] @ back.mT + seen).mean()

    plan = Plan(epochs, learning_rate=1e-3, warm_up=0.05, clip=10.0)
    return descend(loss, [*psi.parameters(), *model.parameters()], 1, plan, progress=progress)


def surprise(missed: Tensor, covariance: Tensor) -> Tensor:
    """The negative logarithm of the density of N(0, C) but for (2π)^(-n/2): (..., n), (..., n, n) -> (...).

    NaN where rounding leaves C no covariance.
    """
    factor, failed = torch.linalg.cholesky_ex(covariance)
    white = torch.linalg.solve_triangular(factor, missed.unsqueeze(-1), upper=False).squeeze(-1)
    value = white.square().sum(-1) / 2 + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return torch.where(failed > 0, math.nan, value)
