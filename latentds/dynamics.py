"""Latent dynamics, globally asymptotically stable at a point: straight rays to it, and a tube around an axis."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from .arguments import Array
from .tabulated import LawTable, Tabulated
from .time_law import TimeLaw


class Frame(NamedTuple):
    """Where latent motions end, and the line on which the demonstrated one comes from its start."""

    attractor: Tensor
    """x*, (n,)"""
    axis: Tensor
    """(n,) of length 1, from x* to the demonstrated start; 0 if they are one point"""
    length: Tensor
    """() their distance, > 0"""

    @classmethod
    def between(cls, start: Tensor, attractor: Tensor) -> Frame:
        """Of the latent start and attractor, both (n,); their distance is taken for 1 if they are one point."""
        offset = start - attractor
        distance = torch.linalg.vector_norm(offset)
        rounding = 64 * torch.finfo(offset.dtype).eps * attractor.detach().abs().amax()
        length = distance + (distance <= rounding)
        return cls(attractor, offset / length, length)


class LatentDynamics(Tabulated, nn.Module, ABC):
    """ẋ = g(x), globally asymptotically stable at the frame's attractor; ‖x - x*‖² decreases along every motion."""

    @abstractmethod
    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        """ẋ at x: (..., n) -> (..., n). ``y`` = ψ(x) is given for dynamics whose speed is a function of it."""

    @abstractmethod
    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        """States at times ``t`` (T,), seconds since x: (..., n) -> (..., T, n)."""

    def straight(self) -> LatentDynamics:
        """Dynamics as fast along the line whose motions are straight; itself, if they are."""
        return self

    def lyapunov(self, x: Tensor, frame: Frame) -> Tensor:
        """V = ‖x - x*‖²: (..., n) -> (...)."""
        return (x - frame.attractor).square().sum(-1)

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float | None:
        """A lower bound on -V̇/(2V) within ``radius`` of x*, per second, that holds by construction; None if unknown.

        It is taken from the numbers that run; where they break what it rests on, it is not above 0.
        """
        return None

    def table(self, frame: Frame) -> tuple[Array, LawTable, LawTable] | None:
        """(goal, along, across) of :class:`latentds.deploy.tables.FieldTables`; None if it cannot be written so."""
        return None


class RayDynamics(LatentDynamics):
    """Straight to the goal: x - x* keeps its direction, and its length in units of the frame's follows ``law``.

    The paper's isotropic case.
    """

    def __init__(self, law: TimeLaw) -> None:
        super().__init__()
        self.law = law

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        offset = x - frame.attractor
        s = _norm_above_zero(offset / frame.length)
        return -(self.law.speed(s) / s) * offset

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        offset = (x - frame.attractor).unsqueeze(-2)
        return frame.attractor + _remaining_share(self.law, _norm_above_zero(offset / frame.length), t) * offset

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float | None:
        length = float(frame.length)
        return self.law.convergence_rate_bound(radius / length) if length > 0 else -math.inf

    def table(self, frame: Frame) -> tuple[Array, LawTable, LawTable] | None:
        law = self.law.table()
        return None if law is None else (_goal_table(frame._replace(axis=torch.zeros_like(frame.axis))), law, law)


class TubeDynamics(LatentDynamics):
    """Along the axis to the goal by ``law``, and across it inward by ``transverse_law``, both odd: ṡ = -h(s).

    With the frame's axis u and length, s = u·(x - x*)/length and p is the rest. Beyond the last knot of
    ``transverse_law`` from the axis the pull no longer grows, so that a far start makes no wild speed.
    """

    def __init__(self, law: TimeLaw, transverse_law: TimeLaw) -> None:
        super().__init__()
        self.law = law
        self.transverse_law = transverse_law

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        along, across = _split(x, frame)
        s, p = _norm_above_zero(along), _norm_above_zero(across)
        inward = self.law.speed(s) / s * along * frame.axis + self.transverse_law.speed(p) / p * across
        return -frame.length * inward

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        along, across = (part.unsqueeze(-2) for part in _split(x, frame))
        ahead = _remaining_share(self.law, _norm_above_zero(along), t) * along * frame.axis
        aside = _remaining_share(self.transverse_law, _norm_above_zero(across), t) * across
        return frame.attractor + frame.length * (ahead + aside)

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float | None:
        length, dtype = float(frame.length), frame.axis.dtype
        norm = float(torch.linalg.vector_norm(frame.axis.to(torch.float64)))
        # The part across a longer axis would push back along it.
        if not (length > 0 and (norm == 0 or abs(norm - 1) <= 8 * torch.finfo(dtype).eps)):
            return -math.inf
        reach = radius / length
        along, across = (law.convergence_rate_bound(reach) for law in (self.law, self.transverse_law))
        return None if along is None or across is None else min(along, across)

    def straight(self) -> LatentDynamics:
        return RayDynamics(self.law)

    def phase(self, x: Tensor, frame: Frame) -> Tensor:
        """s, 1 at the demonstrated start and 0 at x*: (..., n) -> (...)."""
        return _split(x, frame)[0].squeeze(-1)

    def table(self, frame: Frame) -> tuple[Array, LawTable, LawTable] | None:
        along, across = self.law.table(), self.transverse_law.table()
        return None if along is None or across is None else (_goal_table(frame), along, across)


def _split(x: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
    """Offset from x* in units of length: along the axis (..., 1) and across it (..., n)."""
    offset = (x - frame.attractor) / frame.length
    along = (offset * frame.axis).sum(-1, keepdim=True)
    return along, offset - along * frame.axis


def _goal_table(frame: Frame) -> Array:
    rows = torch.stack([frame.attractor, frame.axis, frame.length.expand_as(frame.axis)])
    return rows.detach().to("cpu", torch.float64, copy=True).numpy()


def _remaining_share(law: TimeLaw, s: Tensor, t: Tensor) -> Tensor:
    """The share of the length s (..., 1, 1) that is left after ``t`` (T,) seconds: (..., T, 1)."""
    return law.progress_at(law.time_to_go(s) - t.unsqueeze(-1)) / s


def _norm_above_zero(offset: Tensor) -> Tensor:
    """(..., n) -> (..., 1), kept above zero by a floor so low that h(s)/s no longer changes there."""
    floor: float = torch.finfo(offset.dtype).tiny ** 0.25
    return (offset.square().sum(-1, keepdim=True) + floor**2).sqrt()
