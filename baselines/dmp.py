"""DMP: a spring to the goal, bent by a force that fades with a phase (Ijspeert et al. 2013)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import Array, whole_number
from latentds.base import Learned
from latentds.demonstration import Demonstration

from .phase import PhaseDriven, refuse_closed

STIFFNESS = 25.0
"""α_z; β_z = α_z / 4 makes the spring critically damped, and its double rate is α_z / 2."""
FADING = -math.log(0.01)
"""α_x: the phase variable x = exp(-α_x s) has come down to a hundredth when the demonstration ends."""
SPRING_HORIZON = 3.0
"""Durations after which the force, by then a millionth of what it was, is over."""
REST = 1.0
"""Durations of rest at the goal that are appended to each demonstration: without them nothing says where the weights of
the last ψ_i, which go on pushing, lead after its end."""
GRID = 1e-3
"""Durations between two entries of the tables of responses."""
RIDGE_WEIGHT = 1e-6
"""Of the least squares, for responses of unit length."""


class DMP(PhaseDriven):
    """Dynamic movement primitive: y'' = α_z (β_z (y* - y) - y') + x Σ_i w_i ψ_i(x) / Σ_i ψ_i(x), x' = -α_x x.

    Time is in durations. Ijspeert et al. 2013, eq. 2.1 to 2.3, one system per coordinate with a phase for all, with
    α_z = 25 and β_z = α_z / 4; the force is not multiplied by y* - y₀, which makes it useless where a coordinate comes
    back to where it began (their section 2.1.5; Hoffmann et al. 2009). Widths are one over the squared distance of
    neighbouring centers, which are even in time. The motion begins with the demonstrated velocity.

    Position is linear in the weights w, so these are the least squares of the positions themselves, of all
    demonstrations, each followed by a duration of rest at its goal, with a ridge of 1e-6, instead of those of forces
    that are read from second differences; and a rollout is a sum of the responses to every ψ_i, which are tabulated
    once, instead of an integration.

    The spring brings every motion to y*, as the force dies with the phase. What is proven to fall is a function of
    position and velocity: the distance of the position alone may rise.

    ``fit_report.mse`` is of the positions from the demonstrated starts, per coordinate; ``n_layers`` is the number of
    basis functions. Several demonstrations are pooled; the ends and the duration are their means.

    Args:
        dim: n >= 1.
        n_basis: B >= 2 basis functions in each coordinate.

    Attributes:
        weights: (B, n), units of the positions.
        departure: (n,) buffer, velocity at the start, units per duration.
    """

    departure: Tensor
    responses: Tensor

    def __init__(self, dim: int, *, n_basis: int = 100) -> None:
        super().__init__(dim)
        self.n_basis = whole_number(n_basis, "n_basis", at_least=2)
        self.weights = nn.Parameter(torch.zeros(self.n_basis, self.dim, dtype=torch.float64))
        self.register_buffer("departure", torch.zeros(self.dim, dtype=torch.float64))
        self.register_buffer("responses", torch.from_numpy(responses(self.n_basis)).clone(), persistent=False)

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        refuse_closed(shown)
        fresh = DMP(self.dim, n_basis=self.n_basis)
        fresh._place(shown)
        with torch.no_grad():
            fresh.departure.copy_(torch.stack([d.velocities[0] * d.duration for d in shown]).mean(0))
            phases = [torch.arange(round((1 + REST) * (len(d) - 1)) + 1).double() / (len(d) - 1) for d in shown]
            bent = torch.cat([fresh._response(s)[0] for s in phases])
            unbent = [fresh.motion(d.start, 0.0, s) for d, s in zip(shown, phases, strict=True)]
            rested = [
                d.positions[torch.arange(len(s)).clamp(max=len(d) - 1)] for d, s in zip(shown, phases, strict=True)
            ]
            wanted = torch.cat(rested) - torch.cat(unbent)
            lengths = torch.linalg.vector_norm(bent, dim=0)
            bent = torch.cat([bent / lengths, math.sqrt(RIDGE_WEIGHT) * torch.eye(self.n_basis, dtype=torch.float64)])
            wanted = torch.cat([wanted, wanted.new_zeros(self.n_basis, self.dim)])
            solved, *_ = np.linalg.lstsq(bent.numpy(), wanted.numpy())  # torch's rounds by how many threads it has
            fresh.weights.copy_(torch.from_numpy(solved) / lengths[:, None])
            self.load_state_dict(fresh.state_dict())
        return self._learned(shown, self.n_basis)

    def motion(self, y: Tensor, since: float, s: Tensor, *, at_rest: bool = False) -> Tensor:
        moved, _ = self._reference(s)
        before, pace = self._reference(s.new_tensor([since]))
        stand, swing = _spring(s - since)
        offset = stand.unsqueeze(-1) * (y.unsqueeze(-2) - before)
        return moved + offset - (swing.unsqueeze(-1) * pace if at_rest else 0.0)

    def velocity(self, s: Tensor) -> Tensor:
        return self._reference(s)[1]

    def _reference(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities from the demonstrated start, (T, n) each, units and units per duration."""
        rate = STIFFNESS / 2
        stand, swing = (part.unsqueeze(-1) for part in _spring(s))
        fall = torch.exp(-rate * s).unsqueeze(-1)
        gap = self.start - self.attractor
        bent, bending = self._response(s)
        free = self.attractor + stand * gap + swing * self.departure
        speed = -(rate**2) * swing * gap + (fall - rate * swing) * self.departure
        return free + bent @ self.weights, speed + bending @ self.weights

    def _response(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Position and velocity that a weight of 1 has made by phases (T,), for each ψ_i: (T, B) each."""
        inside = s.clamp(0, SPRING_HORIZON) / GRID
        cell = inside.long().clamp(max=self.responses.shape[1] - 2)
        u = (inside - cell).unsqueeze(-1)
        (p, q), (v, w) = ((part[cell], part[cell + 1]) for part in self.responses)
        v, w, rise = v * GRID, w * GRID, q - p
        bend, twist = 3 * rise - 2 * v - w, v + w - 2 * rise
        moved = p + u * (v + u * (bend + u * twist))
        moving = (v + u * (2 * bend + u * 3 * twist)) / GRID
        rate, late = STIFFNESS / 2, (s - SPRING_HORIZON).clamp(min=0)
        stand, swing = (part.unsqueeze(-1) for part in _spring(late))
        fall = torch.exp(-rate * late).unsqueeze(-1)
        return stand * moved + swing * moving, -(rate**2) * swing * moved + (fall - rate * swing) * moving


def _spring(s: Tensor) -> tuple[Tensor, Tensor]:
    """What is left, after s durations, of a unit of position at rest, and what becomes of a unit of velocity."""
    rate = STIFFNESS / 2
    fall = torch.exp(-rate * s)
    return (1 + rate * s) * fall, s * fall


def basis(n_basis: int, x: Array) -> Array:
    """ψ_i(x) / Σ ψ_i(x): (T,) -> (T, B)."""
    centers = np.exp(-FADING * np.linspace(0, 1, n_basis))
    gaps = np.abs(np.diff(centers))
    exponents = -np.square((x[:, None] - centers) / np.append(gaps, gaps[-1]))
    values = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    return np.asarray(values / values.sum(axis=1, keepdims=True))


@lru_cache(maxsize=8)
def responses(n_basis: int) -> Array:
    """The spring's position and velocity under each x ψ_i alone, every ``GRID`` durations: (2, T, B).

    By Runge and Kutta's method of order 4.
    """
    count = round(SPRING_HORIZON / GRID)
    x = np.exp(-FADING * np.arange(2 * count + 1) * GRID / 2)
    forces = x[:, None] * basis(n_basis, x)
    pull = np.array([[0.0, 1.0], [-(STIFFNESS**2) / 4, -STIFFNESS]])
    push = np.array([[0.0], [1.0]])
    state = np.zeros((2, n_basis))
    table = np.empty((2, count + 1, n_basis))
    table[:, 0] = state
    for k in range(count):
        first, middle, last = forces[2 * k : 2 * k + 3]
        a = pull @ state + push * first
        b = pull @ (state + GRID / 2 * a) + push * middle
        c = pull @ (state + GRID / 2 * b) + push * middle
        d = pull @ (state + GRID * c) + push * last
        state = state + GRID / 6 * (a + 2 * b + 2 * c + d)
        table[:, k + 1] = state
    return table
