"""Coupling terms: what bends a DMP around an obstacle, learned from motions that went around one (Rai et al. 2014)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import nnls
from scipy.signal import fftconvolve
from torch import Tensor, nn

from latentds.arguments import Array, real_tensor
from latentds.demonstration import Demonstration, demonstrations_of

from .dmp import DMP, FADING, SPRING_HORIZON, STIFFNESS, basis

NARROWING = (1.0, 2.0, 4.0, 8.0, 16.0)
"""β: how much less a term bends what does not head for the obstacle, per radian."""
FADING_AWAY = (1.0, 3.0, 10.0, 30.0)
"""k: how fast a term dies with the distance from the obstacle, per way from the DMP's start to its goal."""
SAME_GOAL = 0.05
"""Ways from start to goal within which a motion around an obstacle must end at the DMP's goal."""
TOLERANCE = 1e-8
"""Of integration, relative and in ways."""


class AvoidanceTerms(nn.Module):
    """C = Σ_ij w_ij R v θ e^{-β_i θ} e^{-k_j d}, to be added to a DMP's acceleration: v turned away from the obstacle.

    θ is the angle between v and the way to the obstacle, d the distance from it; R turns v by a right angle in the
    plane of both, away from it. In any dimension. A point obstacle stands for a body's middle.

    C is orthogonal to v and so does no work: once the DMP's force has died, kinetic energy and that of its spring still
    fall together, and the motion still comes to rest at the goal, whatever the weights are. That it keeps clear of
    anything is not proven: heading straight for the obstacle, θ = 0 and so is C; compare
    :class:`latentds.modulation.AvoidingDS`.

    Args:
        dmp: fitted to motions without an obstacle; kept, not changed. Where it is fitted again, learn again.

    Attributes:
        weights: (5, 4) >= 0, of ``NARROWING`` and ``FADING_AWAY``, per duration; 0 until learned.

    Source: Rai, Meier, Ijspeert and Schaal, "Learning coupling terms for obstacle avoidance", Humanoids 2014; the term
    for one β without distance is Hoffmann et al. 2009, eq. 10.
    """

    def __init__(self, dmp: DMP) -> None:
        super().__init__()
        self.dmp = dmp
        self.weights = nn.Parameter(torch.zeros(len(NARROWING), len(FADING_AWAY), dtype=torch.float64))

    def features(self, y: Tensor, velocity: Tensor, obstacle: Tensor) -> Tensor:
        """The terms of weight 1: (..., n), (..., n) per duration, (..., n) -> (..., n, 5, 4)."""
        tiny = torch.finfo(y.dtype).tiny
        gap = obstacle - y
        d, speed = (torch.linalg.vector_norm(part, dim=-1, keepdim=True) for part in (gap, velocity))
        there, ahead = gap / d.clamp(min=tiny), velocity / speed.clamp(min=tiny)
        along = (there * ahead).sum(-1, keepdim=True)
        aside = there - along * ahead
        sine = torch.linalg.vector_norm(aside, dim=-1, keepdim=True)
        turned = -speed * aside / sine.clamp(min=tiny)
        theta = torch.atan2(sine, along)
        narrow = theta * torch.exp(-torch.tensor(NARROWING).to(y) * theta)
        near = torch.exp(-torch.tensor(FADING_AWAY).to(y) * d / self._way())
        terms: Tensor = turned[..., None, None] * (narrow.unsqueeze(-1) * near.unsqueeze(-2)).unsqueeze(-3)
        return terms

    def forward(self, y: Tensor, velocity: Tensor, obstacle: Tensor) -> Tensor:
        """C, in units per duration squared: (..., n), (..., n) units per duration, (..., n) -> (..., n)."""
        return (self.features(y, velocity, obstacle) * self.weights.to(y)).sum((-2, -1))

    def learn(self, around: Demonstration | Sequence[Demonstration], obstacles: Any) -> AvoidanceTerms:
        """Learn the weights from motions around an obstacle each.

        They are the likeliest of those >= 0, all of which are as likely before. The paper's Bayesian regression has a
        Gaussian prior for each; terms are so alike that weights of both signs then cancel each other by the thousand,
        and on the way to another obstacle do not. And the position is linear in C, through the DMP's spring: regressed
        is how far each motion is from the DMP's own from the same start, at equal shares of their durations, and not
        an acceleration, which is a second difference.

        Args:
            around: motions to the DMP's goal; their durations may differ from its own.
            obstacles: (n,), or (m, n) of each.

        Returns:
            self.
        """
        shown = demonstrations_of(around, self.dmp.dim)
        places = real_tensor(obstacles, "obstacles").to(torch.float64)
        if places.shape not in ((self.dmp.dim,), (len(shown), self.dmp.dim)) or not bool(torch.isfinite(places).all()):
            raise ValueError(
                f"obstacles: expected ({self.dmp.dim},) or ({len(shown)}, {self.dmp.dim}) finite numbers, got "
                f"{tuple(places.shape)}"
            )
        far = max(float(torch.linalg.vector_norm(one.goal - self.dmp.attractor.cpu())) for one in shown) / self._way()
        if far > SAME_GOAL:
            raise ValueError(f"around: expected motions to the DMP's goal, got one that ends {far:.2g} ways from it")
        effects, missed = [], []
        with torch.no_grad():
            for one, obstacle in zip(shown, places.expand(len(shown), -1), strict=True):
                count = len(one) - 1
                phases = torch.arange(count + 1, dtype=torch.float64) / count
                terms = self.features(one.positions, one.velocities * one.duration, obstacle).flatten(-2)
                rate = STIFFNESS / 2
                kick = phases * torch.exp(-rate * phases) / count  # what a push of one sample does by later ones
                effects.append(fftconvolve(terms.numpy(), kick.numpy()[:, None, None], axes=0)[: count + 1])
                missed.append((one.positions - self.dmp.motion(one.start, 0.0, phases)).numpy())
        columns = np.concatenate(effects).reshape(-1, self.weights.numel())
        lengths = np.linalg.norm(columns, axis=0)
        lengths[lengths == 0] = 1
        solved = nnls(columns / lengths, np.concatenate(missed).ravel())[0] / lengths
        with torch.no_grad():
            self.weights.copy_(torch.from_numpy(solved).view_as(self.weights))
        return self

    @torch.no_grad()
    def rollout(self, y0: Any, t: Any, obstacle: Any) -> Tensor:
        """The DMP's motions from ``y0`` around an obstacle at rest: (..., n), (T,) seconds, (n,) -> (..., T, n)."""
        dmp = self.dmp
        points, wanted = dmp._points(y0, "y0")
        place = real_tensor(obstacle, "obstacle").to(points)
        if place.shape != (dmp.dim,) or not bool(torch.isfinite(place).all()):
            raise ValueError(f"obstacle: expected ({dmp.dim},) finite numbers, got {obstacle!r:.80}")
        start, phases = points.cpu().double(), (dmp._times(t) / dmp.duration).cpu().double().numpy()
        weights, goal = dmp.weights.detach().cpu().double().numpy(), dmp.attractor.cpu().double().numpy()
        pace = dmp.departure.cpu().double().expand_as(start)

        def slopes(s: float, state: Array) -> Array:
            y, v = state.reshape(2, -1, dmp.dim)
            x = np.exp(-FADING * np.atleast_1d(s))
            force = (x[:, None] * basis(dmp.n_basis, x)) @ weights if s < SPRING_HORIZON else 0.0
            bend = self(torch.from_numpy(y), torch.from_numpy(v), place.cpu().double()).numpy()
            return np.concatenate([v, STIFFNESS * (STIFFNESS / 4 * (goal - y) - v) + force + bend]).ravel()

        begin = torch.stack([start.reshape(-1, dmp.dim), pace.reshape(-1, dmp.dim)]).numpy().ravel()
        span, limits = (0, max(phases[-1], TOLERANCE)), {"rtol": TOLERANCE, "atol": TOLERANCE * self._way()}
        solved = torch.from_numpy(solve_ivp(slopes, span, begin, t_eval=phases, **limits).y)
        path = solved.reshape(2, *start.shape, len(phases))[0].mT
        return dmp._with_exact_start(y0, path.to(wanted))

    def _way(self) -> float:
        return float(torch.linalg.vector_norm(self.dmp.start - self.dmp.attractor))
