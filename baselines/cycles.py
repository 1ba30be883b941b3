"""ImitationFlow's other system: a limit cycle, seen through a learned flow (Urain et al. 2020)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from latentds.arguments import check_points, real_tensor, whole_number
from latentds.demonstration import Demonstration, demonstrations_of

from .couplings import AffineCouplings, no_autocast
from .flows import Normalized
from .networks import seeded_generator
from .transitions import INITIAL_RATE, INITIAL_SPREAD, STRIDE, descend_likelihood

CYCLE_RADIUS = 0.5
"""Of the latent circle, in boxes."""
CLOSES_WITHIN = 0.1
"""Sizes of a demonstration of whole turns between its ends, at most."""


class LimitCycleFlow(nn.Module):
    """A limit cycle for motions that repeat: ṙ = κ r (1 - r²), φ̇ = ω, ẇ = -λ w, seen through ψ (Urain et al. 2020).

    No :class:`~latentds.StableDS`: nothing attracts to a point, so the contract of those says nothing of it. What holds
    instead, whatever was learned: every motion tends to ψ of the unit circle, r = 1 and w = 0, and runs around it in
    one :attr:`period`, but for those that begin on ψ of r = 0, in the plane one point that repels.

    (r, φ) are polar coordinates of z = ψ⁻¹(y) - ψ⁻¹(c), r in units of ``CYCLE_RADIUS``, in the plane in which the
    demonstrations extend most; w is the rest, and c the middle of their box. Learned as :class:`ImitationFlow` is, by
    the likelihood of pairs; but with noise this oscillator has no transition density in closed form, and a Gaussian
    around the motion without noise is taken instead. So there is a mean motion to follow and no process to sample.

    Args:
        dim: n >= 2.
        n_layers, n_features, seed, epochs: as for :class:`ImitationFlow`.
    """

    def __init__(
        self, dim: int, *, n_layers: int = 10, n_features: int = 200, seed: int | None = None, epochs: int = 1500
    ) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=2)
        self.seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        self.epochs = whole_number(epochs, "epochs", at_least=1)
        self.n_layers, self.n_features = n_layers, n_features
        self.diffeomorphism = AffineCouplings(dim, n_layers, n_features, generator=seeded_generator(self.seed))
        self.dynamics = CycleDynamics(self.dim)

    @property
    def period(self) -> float:
        """Seconds of one turn."""
        return 2 * math.pi * float(self.dynamics.duration) / abs(STRIDE * float(self.dynamics.pace.detach()))

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> LimitCycleFlow:
        """Learn from one or more motions of whole turns, all the same way around; forgets any fit before.

        Raises:
            ValueError: if a motion does not end where it begins, within ``CLOSES_WITHIN`` sizes, or does not go around.
        """
        shown = demonstrations_of(demonstration, self.dim)
        for d in shown:
            gap = float(torch.linalg.vector_norm(d.goal - d.start)) / d.size
            if gap > CLOSES_WITHIN:
                raise ValueError(f"demonstration: expected whole turns, got one whose ends are {gap:.2g} sizes apart")
        data = Normalized.of(shown, closed=True)
        settings = {name: getattr(self, name) for name in ("n_layers", "n_features", "seed", "epochs")}
        learner = LimitCycleFlow(self.dim, **settings).to(self.dynamics.duration.device, torch.float32)
        learner.dynamics.double().begin(data)
        center = torch.zeros(self.dim, dtype=torch.float64)
        descend_likelihood(learner.diffeomorphism, learner.dynamics, data, center, self.epochs, progress)
        self.load_state_dict(learner.state_dict())
        with torch.no_grad():
            self.diffeomorphism.center.copy_(data.center)
            self.diffeomorphism.scale.copy_(data.scale)
            self.dynamics.duration.fill_(data.duration)
        return self

    def forward(self, y: Any) -> Tensor:
        """Velocity at ``y``: (..., n) -> (..., n), units of y per second."""
        points = self._points(y, "y")
        with no_autocast(points):
            x, push = self.diffeomorphism.linearize(points)
            velocity = push(self.dynamics(x - self._center()) / self.dynamics.duration)
        return velocity.to(_answer(y, points))

    def rollout(self, y0: Any, t: Any) -> Tensor:
        """The motion from ``y0`` at ``t[0]``, in closed form: (..., n), (T,) seconds, not decreasing -> (..., T, n)."""
        points, times = self._points(y0, "y0"), real_tensor(t, "t").to(self.diffeomorphism.center)
        if times.ndim != 1 or not len(times) or not bool(torch.isfinite(times).all()) or bool((times.diff() < 0).any()):
            raise ValueError(f"t: expected (T,) finite seconds that do not decrease, T >= 1, got {t!r:.80}")
        center = self._center()
        z = (self.diffeomorphism.inverse(points) - center).unsqueeze(-2)
        with no_autocast(points):
            states = self.dynamics.flow(z, (times - times[0]) / self.dynamics.duration)
        moved: Tensor = self.diffeomorphism(center + states)
        return moved.to(_answer(y0, points))

    def _points(self, y: Any, name: str) -> Tensor:
        points = real_tensor(y, name)
        check_points(self.dim, points, name)
        return points.to(self.diffeomorphism.center.dtype)

    def _center(self) -> Tensor:
        return self.diffeomorphism.inverse(self.diffeomorphism.center)


class CycleDynamics(nn.Module):
    """The latent oscillator of :class:`LimitCycleFlow`, in units of the duration; its circle has ``CYCLE_RADIUS``.

    Args:
        dim: n >= 2.

    Attributes:
        pace, log_rates, log_spread: parameters, ω (), log κ and log λ (2,), and the logarithm of the noise (), all over
            ``STRIDE``.
        axes: (n, n) buffer, orthogonal; its first two columns span the circle's plane.
        duration: () buffer, seconds in one unit of time.
    """

    axes: Tensor
    duration: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.pace = nn.Parameter(torch.tensor(2 * math.pi / STRIDE, dtype=torch.float64))
        self.log_rates = nn.Parameter(torch.full((2,), math.log(INITIAL_RATE) / STRIDE, dtype=torch.float64))
        self.log_spread = nn.Parameter(torch.tensor(math.log(INITIAL_SPREAD) / STRIDE, dtype=torch.float64))
        self.register_buffer("axes", torch.eye(dim, dtype=torch.float64))
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))

    @torch.no_grad()
    def begin(self, data: Normalized) -> None:
        """Take the plane and the pace of demonstrations; a ValueError if they do not go around in it."""
        self.axes.copy_(torch.linalg.svd(data.points - data.points.mean(0), full_matrices=True)[2].mT)
        turned, lasted = 0.0, 0.0
        for i, step in enumerate(data.steps):
            a = (data.points[data.owner == i] @ self.axes)[:, :2]
            ahead, aside = (a[1:] * a[:-1]).sum(-1), a[:-1, 0] * a[1:, 1] - a[:-1, 1] * a[1:, 0]
            own = float(torch.atan2(aside, ahead).sum())
            if abs(own) < math.pi or own * turned < 0:
                raise ValueError(
                    "demonstration: expected whole turns around the middle of all, the same way in all, got "
                    f"{own / (2 * math.pi):.2g} turns"
                )
            turned, lasted = turned + own, lasted + float(step) * (len(a) - 1)
        self.pace.fill_(turned / lasted / STRIDE)

    def forward(self, z: Tensor) -> Tensor:
        """ż per duration: (..., n) -> (..., n)."""
        (attracted, decay), w = torch.exp(STRIDE * self.log_rates), z @ self.axes
        a, rest = w[..., :2], w[..., 2:]
        radial = attracted * (1 - a.square().sum(-1, keepdim=True) / CYCLE_RADIUS**2) * a
        around = STRIDE * self.pace * torch.stack([-a[..., 1], a[..., 0]], -1)
        return torch.cat([radial + around, -decay * rest], -1) @ self.axes.mT

    def flow(self, z: Tensor, t: Tensor) -> Tensor:
        """z after ``t`` durations, the last axis but one of z against t's: (..., T or 1, n), (T,) -> (..., T, n)."""
        (attracted, decay), w = torch.exp(STRIDE * self.log_rates), z @ self.axes
        a, rest, t = w[..., :2], w[..., 2:], t.unsqueeze(-1)
        squared = a.square().sum(-1, keepdim=True) / CYCLE_RADIUS**2
        grown = squared + (1 - squared) * torch.exp(-2 * attracted * t)  # r² over what r² becomes
        a = a / grown.clamp(min=torch.finfo(z.dtype).tiny).sqrt()
        cosine, sine = torch.cos(STRIDE * self.pace * t), torch.sin(STRIDE * self.pace * t)
        turned = cosine * a + sine * torch.stack([-a[..., 1], a[..., 0]], -1)
        return torch.cat([turned, torch.exp(-decay * t) * rest], -1) @ self.axes.mT

    def transition(self, z: Tensor, times: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        attracted = torch.exp(STRIDE * self.log_rates[0])
        variance = torch.exp(2 * STRIDE * self.log_spread) * -torch.expm1(-2 * attracted * times)
        return self.flow(z, times[which]), variance[:, None, None] * torch.eye(z.shape[-1]).to(z)


def _answer(given: Any, points: Tensor) -> torch.dtype:
    """The dtype in which a caller is answered: that of what was given, if it is one of floats."""
    dtype = real_tensor(given, "y").dtype
    return dtype if dtype.is_floating_point else points.dtype
