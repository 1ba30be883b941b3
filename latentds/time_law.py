"""How fast the latent point moves: autonomous laws ṡ = -h(s) on a line to the goal, with their flow in closed form."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from .arguments import positive

TAIL = 1e-3
"""Progress below which every law turns linear, ṡ ∝ -s: laws that reach the goal in finite time are not Lipschitz there."""


class TimeLaw(nn.Module, ABC):
    """ṡ = -h(s) for progress s > 0: 1 at the demonstrated start, 0 at the goal; h(0) = 0, h > 0.

    Both maps are elementwise over any shape. :meth:`time_to_go` is strictly increasing, 0 at the edge of the
    exponential tail and negative inside it, so the flow is s(t) = progress_at(time_to_go(s) - t).
    """

    @abstractmethod
    def speed(self, s: Tensor) -> Tensor:
        """h(s), per second, for s >= 0."""

    @abstractmethod
    def time_to_go(self, s: Tensor) -> Tensor:
        """Seconds from s > 0 to the edge of the tail."""

    @abstractmethod
    def progress_at(self, time: Tensor) -> Tensor:
        """The inverse of :meth:`time_to_go`."""


class ChebyshevLaw(TimeLaw):
    """h(s) = ω √(s(2-s)), ω = π / (2 duration): the latent motion of the Laplacian eigenmap (paper, Sec. V).

    Below ``TAIL`` linear; above 1, where the eigenmap says nothing, the constant rate ω.

    Args:
        duration: seconds from s = 1 to s = 0 without the tail, > 0.
    """

    omega: Tensor

    def __init__(self, duration: float = 1.0) -> None:
        super().__init__()
        omega = math.pi / (2 * positive(duration, "duration"))
        self.register_buffer("omega", torch.tensor(omega, dtype=torch.float64))

    # s = 1 - cos(angle) = 2 sin²(angle/2) makes the motion uniform in the angle.
    _edge = 2 * math.asin(math.sqrt(TAIL / 2))
    _tail_rate = math.sqrt((2 - TAIL) / TAIL)  # in units of ω

    def speed(self, s: Tensor) -> Tensor:
        inside = s.clamp(TAIL, 1.0)
        return self.omega * torch.where(s < TAIL, self._tail_rate * s, (inside * (2 - inside)).sqrt())

    def time_to_go(self, s: Tensor) -> Tensor:
        inside = s.clamp(TAIL, 1.0)
        arc = 2 * torch.asin((inside / 2).sqrt()) - self._edge
        tail = torch.log(s.clamp(max=TAIL) / TAIL) / self._tail_rate
        return (arc + tail + (s - 1).clamp(min=0)) / self.omega

    def progress_at(self, time: Tensor) -> Tensor:
        phase = self.omega * time
        top = math.pi / 2 - self._edge
        arc = 2 * torch.sin((phase.clamp(0.0, top) + self._edge) / 2).square()
        tail = TAIL * torch.exp(self._tail_rate * phase.clamp(max=0.0))
        return torch.where(phase < 0, tail, arc + (phase - top).clamp(min=0))


class PiecewiseLinearLaw(TimeLaw):
    """h linear between knots, h(0) = 0, constant above the last knot.

    Args:
        knots: (m,) progress, 0 < knots[0] < … < knots[m-1]; below the first one the law is linear to 0.
        speeds: (m,) h at the knots, > 0, per second.
    """

    knots: Tensor
    speeds: Tensor

    def __init__(self, knots: Tensor, speeds: Tensor) -> None:
        super().__init__()
        knots, speeds = torch.as_tensor(knots, dtype=torch.float64), torch.as_tensor(speeds, dtype=torch.float64)
        if knots.ndim != 1 or len(knots) < 1 or not bool((knots.diff() > 0).all()) or not float(knots[0]) > 0:
            raise ValueError(f"knots: expected (m,) increasing from above 0, got {knots}")
        if speeds.shape != knots.shape or not bool((speeds > 0).all()):
            raise ValueError(f"speeds: expected {tuple(knots.shape)} numbers > 0, got {speeds}")
        self.register_buffer("knots", knots)
        self.register_buffer("speeds", speeds)

    @classmethod
    def uniform(cls, duration: float = 1.0) -> PiecewiseLinearLaw:
        """Constant rate 1 / duration above the tail: the line that FDM moves on."""
        return cls(torch.tensor([TAIL]), torch.tensor([1 / positive(duration, "duration")], dtype=torch.float64))

    def speed(self, s: Tensor) -> Tensor:
        low, high = self._segment(torch.bucketize(s.detach(), self.knots))
        fraction = ((s - low[0]) / (high[0] - low[0])).clamp(max=1.0)
        return low[1] + fraction * (high[1] - low[1])

    def time_to_go(self, s: Tensor) -> Tensor:
        index = torch.bucketize(s.detach(), self.knots)
        low, high = self._segment(index)
        inside = low[2] + _travel_time(s - low[0], low[1], (high[1] - low[1]) / (high[0] - low[0]))
        tail = self.knots[0] / self.speeds[0] * torch.log(s.clamp(max=self.knots[0]) / self.knots[0])
        return torch.where(index == 0, tail, inside)

    def progress_at(self, time: Tensor) -> Tensor:
        arrivals = self._arrivals()
        index = torch.bucketize(time.detach(), arrivals)
        low, high = self._segment(index)
        slope = (high[1] - low[1]) / (high[0] - low[0])
        inside = low[0] + _travel(torch.where(index == 0, 0.0, time - low[2]), low[1], slope)
        tail = self.knots[0] * torch.exp(self.speeds[0] / self.knots[0] * time.clamp(max=0.0))
        return torch.where(index == 0, tail, inside)

    def _arrivals(self) -> Tensor:
        """Seconds from each knot to the first one, (m,)."""
        gaps = self.knots.diff()
        steps = _travel_time(gaps, self.speeds[:-1], self.speeds.diff() / gaps)
        return torch.cat([torch.zeros_like(self.knots[:1]), steps.cumsum(0)])

    def _segment(self, index: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
        """(progress, speed, seconds) at the lower and (progress, speed) at the upper end of segment 0 … m."""
        zero, beyond = torch.zeros_like(self.knots[:1]), self.knots[-1:] + 1
        knots = torch.cat([zero, self.knots, beyond])
        speeds = torch.cat([zero, self.speeds, self.speeds[-1:]])
        arrivals = torch.cat([zero, self._arrivals()])
        return (knots[index], speeds[index], arrivals[index]), (knots[index + 1], speeds[index + 1])


def _travel_time(distance: Tensor, speed: Tensor, slope: Tensor) -> Tensor:
    """Seconds to cover ``distance`` while the speed grows by ``slope`` per unit: log(1 + slope d / speed) / slope."""
    safe = torch.where(speed > 0, speed, 1.0)
    ratio = (slope * distance / safe).clamp(min=-1 + 1e-12)
    near = ratio.abs() < 1e-6
    log = torch.log1p(torch.where(near, 1.0, ratio)) / torch.where(near, 1.0, ratio)
    return distance / safe * torch.where(near, 1 - ratio / 2 + ratio.square() / 3, log)


def _travel(time: Tensor, speed: Tensor, slope: Tensor) -> Tensor:
    """The inverse: speed (exp(slope t) - 1) / slope."""
    growth = slope * time
    near = growth.abs() < 1e-6
    factor = torch.expm1(torch.where(near, 1.0, growth)) / torch.where(near, 1.0, growth)
    return speed * time * torch.where(near, 1 + growth / 2 + growth.square() / 6, factor)


class LatentDynamics(nn.Module, ABC):
    """ẋ = g(x), globally asymptotically stable at ``attractor``; ‖x - x*‖² decreases along every motion."""

    attractor: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("attractor", torch.zeros(dim, dtype=torch.float64))

    @abstractmethod
    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """ẋ at x: (..., n) -> (..., n). ``y`` = ψ(x) is given for dynamics whose speed is a function of it."""

    @abstractmethod
    def flow(self, x: Tensor, t: Tensor) -> Tensor:
        """States at times ``t`` (T,), seconds since x: (..., n) -> (..., T, n)."""

    def lyapunov(self, x: Tensor) -> Tensor:
        """V = ‖x - x*‖²: (..., n) -> (...)."""
        return (x - self.attractor).square().sum(-1)


class RayDynamics(LatentDynamics):
    """Straight to the goal: the direction of x - x* stays, its length over ``length`` follows ``law``.

    The paper's isotropic case. Attributes: ``length``, the distance of the demonstrated start from x*, > 0.
    """

    length: Tensor

    def __init__(self, dim: int, law: TimeLaw) -> None:
        super().__init__(dim)
        self.law = law
        self.register_buffer("length", torch.ones((), dtype=torch.float64))

    def aim(self, start: Tensor, attractor: Tensor) -> None:
        """Set where the demonstration starts and ends in latent space, both (n,)."""
        self.attractor.copy_(attractor)
        self.length.copy_(torch.linalg.vector_norm(start.to(torch.float64) - attractor.to(torch.float64)))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        offset, s = self._polar(x)
        return -self._rate(s).unsqueeze(-1) * offset

    def flow(self, x: Tensor, t: Tensor) -> Tensor:
        offset, s = self._polar(x)
        later = self.law.progress_at(self.law.time_to_go(s).unsqueeze(-1) - t)
        return self.attractor + (later / s.unsqueeze(-1)).unsqueeze(-1) * offset.unsqueeze(-2)

    def _rate(self, s: Tensor) -> Tensor:
        return self.law.speed(s) / s

    def _polar(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x - x*, and the progress s, held off zero far inside the linear tail where h(s)/s no longer changes."""
        offset = x - self.attractor
        floor = torch.finfo(x.dtype).tiny ** 0.25
        unit = offset / self.length
        return offset, (unit.square().sum(-1) + floor**2).sqrt()
