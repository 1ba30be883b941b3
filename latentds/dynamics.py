"""Latent dynamics, globally asymptotically stable at a point: straight rays to it, and a tube around an axis."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .time_law import TimeLaw

Array = NDArray[np.float64]

UNIT = 1e-6
"""How far from 1 the length of an axis may be: as far as that of one that was in float32 once."""


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

    def convergence_rate_bound(self, radius: float) -> float | None:
        """A lower bound on -V̇/(2V) within ``radius`` of x*, per second, that holds by construction; None if unknown.

        It is taken from the numbers that run; where they break what it rests on, it is not above 0.
        """
        return None

    def check_buffers(self, buffers: Mapping[str, Tensor]) -> None:
        """Refuse numbers for some of the buffers, by name, that no such dynamics can have: those of a file, say.

        Raises:
            ValueError: naming the buffer.
        """

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        names = [name for name in self._buffers if prefix + name in state_dict]
        try:
            self.check_buffers({name: state_dict[prefix + name] for name in names})
        except ValueError as error:
            rest[-1].append(str(error))  # load_state_dict's list of what went wrong
            return
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def tables(self) -> tuple[Array, Array, Array] | None:
        """(goal, along, across) of :class:`latentds.deploy.tables.FieldTables`; None if it cannot be written so."""
        return None


class RayDynamics(LatentDynamics):
    """Straight to the goal: the direction of x - x* stays, its length over ``length`` follows ``law``.

    The paper's isotropic case. Attributes: ``length``, the distance of the demonstrated start from x*, > 0.
    """

    length: Tensor

    def __init__(self, dim: int, law: TimeLaw) -> None:
        super().__init__(dim)
        self.law = law
        self.register_buffer("length", torch.ones((), dtype=torch.float64))

    def set_endpoints(self, start: Tensor, attractor: Tensor) -> None:
        """Set where the demonstration starts and ends in latent space, both (n,)."""
        self.attractor.copy_(attractor)
        self.length.copy_(torch.linalg.vector_norm(start.to(torch.float64) - attractor.to(torch.float64)))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        offset = x - self.attractor
        s = _off_zero(offset / self.length)
        return -(self.law.speed(s) / s) * offset

    def flow(self, x: Tensor, t: Tensor) -> Tensor:
        offset = (x - self.attractor).unsqueeze(-2)
        return self.attractor + _shrink(self.law, _off_zero(offset / self.length), t) * offset

    def convergence_rate_bound(self, radius: float) -> float:
        length = float(self.length)
        return self.law.convergence_rate_bound(radius / length) if length > 0 else -math.inf

    def check_buffers(self, buffers: Mapping[str, Tensor]) -> None:
        check_positive(buffers, "length")

    def tables(self) -> tuple[Array, Array, Array] | None:
        law = self.law.table() if type(self) is RayDynamics else None
        return (
            None
            if law is None
            else (_goal_table(self.attractor, torch.zeros_like(self.attractor), self.length), law, law)
        )


class TubeDynamics(LatentDynamics):
    """Along the axis to the goal by ``law``, and across it inward at ``rate``: ṡ = -h(s), h odd, and ṗ = -κp.

    With u the axis from x* to the demonstrated start and ``length`` their distance, s = u·(x - x*)/length and p is the
    rest. Beyond ``radius`` from the axis the pull is held at κ·radius, so that a far start makes no wild speed.

    Attributes:
        axis: u, (n,).
        length: distance of the demonstrated start from x*, > 0.
    """

    axis: Tensor
    length: Tensor

    def __init__(self, dim: int, law: TimeLaw, transverse_law: TimeLaw) -> None:
        super().__init__(dim)
        self.law = law
        self.transverse_law = transverse_law
        self.register_buffer("axis", torch.eye(dim, dtype=torch.float64)[0])
        self.register_buffer("length", torch.ones((), dtype=torch.float64))

    def set_endpoints(self, start: Tensor, attractor: Tensor) -> None:
        """Set where the demonstration starts and ends in latent space, both (n,)."""
        self.attractor.copy_(attractor)
        offset = start.to(torch.float64) - attractor.to(torch.float64)
        self.length.copy_(torch.linalg.vector_norm(offset))
        self.axis.copy_(offset / torch.linalg.vector_norm(offset))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        along, across = self._split(x)
        s, p = _off_zero(along), _off_zero(across)
        inward = self.law.speed(s) / s * along * self.axis + self.transverse_law.speed(p) / p * across
        return -self.length * inward

    def flow(self, x: Tensor, t: Tensor) -> Tensor:
        along, across = (part.unsqueeze(-2) for part in self._split(x))
        left = _shrink(self.law, _off_zero(along), t) * along * self.axis
        return self.attractor + self.length * (left + _shrink(self.transverse_law, _off_zero(across), t) * across)

    def convergence_rate_bound(self, radius: float) -> float:
        length, dtype = float(self.length), self.axis.dtype
        unit = abs(float(torch.linalg.vector_norm(self.axis.to(torch.float64))) - 1) <= 8 * torch.finfo(dtype).eps
        if not (length > 0 and unit):  # by an axis that is longer, what lies along it would also be pushed back
            return -math.inf
        reach = radius / length
        return min(self.law.convergence_rate_bound(reach), self.transverse_law.convergence_rate_bound(reach))

    def check_buffers(self, buffers: Mapping[str, Tensor]) -> None:
        check_positive(buffers, "length")
        if (axis := buffers.get("axis")) is not None:
            norm = float(torch.linalg.vector_norm(axis.to(self.axis.dtype).to(torch.float64)))
            if not abs(norm - 1) <= max(UNIT, 4 * torch.finfo(self.axis.dtype).eps):
                raise ValueError(f"axis: expected a vector of length 1, got one of length {norm:.9g}")

    def phase(self, x: Tensor) -> Tensor:
        """s, 1 at the demonstrated start and 0 at x*: (..., n) -> (...)."""
        return self._split(x)[0].squeeze(-1)

    def tables(self) -> tuple[Array, Array, Array] | None:
        along, across = self.law.table(), self.transverse_law.table()
        if type(self) is not TubeDynamics or along is None or across is None:
            return None
        return _goal_table(self.attractor, self.axis, self.length), along, across

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Offset from x* in units of length: along the axis (..., 1) and across it (..., n)."""
        offset = (x - self.attractor) / self.length
        along = (offset * self.axis).sum(-1, keepdim=True)
        return along, offset - along * self.axis


def check_positive(buffers: Mapping[str, Tensor], *names: str) -> None:
    """Refuse buffers of these names that are not above 0."""
    for name in names:
        if name in buffers and not bool((buffers[name] > 0).all()):
            raise ValueError(f"{name}: expected a number > 0, got {buffers[name].tolist()}")


def _goal_table(attractor: Tensor, axis: Tensor, length: Tensor) -> Array:
    rows = torch.stack([attractor, axis, length.expand_as(attractor)])
    return rows.detach().to("cpu", torch.float64, copy=True).numpy()


def _shrink(law: TimeLaw, s: Tensor, t: Tensor) -> Tensor:
    """What is left after ``t`` (T,) of the length s (..., 1, 1): the ratio, (..., T, 1)."""
    return law.progress_at(law.time_to_go(s) - t.unsqueeze(-1)) / s


def _off_zero(offset: Tensor) -> Tensor:
    """Length of (..., n) as (..., 1), held off zero far inside the linear tail, where h(s)/s no longer changes."""
    floor: float = torch.finfo(offset.dtype).tiny ** 0.25
    return (offset.square().sum(-1, keepdim=True) + floor**2).sqrt()
