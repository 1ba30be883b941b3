"""Motions that follow a clock: what DMP and ProMP are, and what of it a velocity field can show."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from latentds.arguments import number_in
from latentds.base import Learned, StableDS
from latentds.demonstration import Demonstration, goal_apart

PHASE_NODES = 1000
"""Of the path on which a point's phase is looked up."""

Self = TypeVar("Self", bound="PhaseDriven")


class PhaseDriven(StableDS):
    """A motion of a phase s = t / duration, which runs on whatever becomes of the position: no field of y alone.

    So two things are one in the methods of this library and are not in these.

    * :meth:`rollout` carries the phase: it begins at phase 0 wherever it begins, and goes through the whole motion.
      Paths cross, and a motion begun anew half-way is another one; :meth:`resume` goes on at a later phase.
    * :meth:`forward` has no phase to carry. It answers with the velocity of the motion from the demonstrated start at
      the phase where that is nearest to y, and with 0 from where the goal is nearest. That is a fair reading on the
      demonstrated path, and no more than a reading off it: no rollout is its integral, and nothing brings it to the
      path.
    * :meth:`lyapunov` is ‖y - y*‖², which need not fall: what is proven of these methods is proven of y and its phase.

    Args:
        dim: n >= 1.

    Attributes:
        start: (n,) buffer, where the demonstrated motion begins; the first unit vector until fitted.
        duration: () buffer, seconds.
    """

    start: Tensor
    duration: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__(dim)
        self.register_buffer("start", torch.eye(1, self.dim, dtype=torch.float64)[0])
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))

    @abstractmethod
    def motion(self, y: Tensor, since: float, s: Tensor, *, at_rest: bool = False) -> Tensor:
        """The motion at phases ``s`` (T,) of what is at y at phase ``since`` <= s: (..., n) -> (..., T, n).

        Args:
            at_rest: whether it is held still there; otherwise it has the velocity that the motion has at that phase.
        """

    @abstractmethod
    def velocity(self, s: Tensor) -> Tensor:
        """Velocity of the motion from the demonstrated start at phases (T,), units per duration: (T, n)."""

    def resume(self, y: Tensor, since: float, t: Tensor, *, at_rest: bool = False) -> Tensor:
        """As :meth:`rollout`, by a clock that has run for ``since`` seconds at t[0]: (..., n), (T,) -> (..., T, n).

        Args:
            at_rest: whether the motion is held still at y before.
        """
        points, wanted = self._points(y, "y")
        phase = number_in(since, "since", 0, float("inf"), ends="[)") / float(self.duration)
        path = self.motion(points, phase, phase + self._times(t) / self.duration, at_rest=at_rest)
        return self._with_exact_start(y, path.to(wanted))

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        points, wanted = self._points(y0, "y0")
        return self._with_exact_start(y0, self.motion(points, 0.0, self._times(t) / self.duration).to(wanted))

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        s = torch.arange(PHASE_NODES).to(self.attractor) / PHASE_NODES
        path = torch.cat([self.motion(self.start, 0.0, s), self.attractor.unsqueeze(0)])
        velocities = torch.cat([self.velocity(s), torch.zeros_like(self.attractor).unsqueeze(0)])
        with torch.no_grad():  # not by matrix products, whose rounding differs from batch to batch
            exact = "donot_use_mm_for_euclid_dist"
            rows = points.reshape(-1, self.dim)
            node = torch.cdist(rows, path, compute_mode=exact).argmin(-1).reshape(points.shape[:-1])
        share, apart = [], []
        for first in (node.clamp(min=1) - 1, node.clamp(max=PHASE_NODES - 1)):
            step = path[first + 1] - path[first]
            squared = step.square().sum(-1).clamp(min=torch.finfo(step.dtype).tiny)
            share.append((((points - path[first]) * step).sum(-1) / squared).clamp(0, 1).unsqueeze(-1))
            apart.append((points - path[first] - share[-1] * step).square().sum(-1, keepdim=True))
        later = (apart[1] < apart[0]).squeeze(-1)
        first = torch.where(later, node.clamp(max=PHASE_NODES - 1), node.clamp(min=1) - 1)
        along = torch.where(later.unsqueeze(-1), share[1], share[0])
        velocity = torch.lerp(velocities[first], velocities[first + 1], along) / self.duration
        return velocity.to(wanted)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return (points - self.attractor).square().sum(-1).to(wanted)

    @torch.no_grad()
    def _place(self, shown: Sequence[Demonstration]) -> None:
        """Ends and duration: the means of several."""
        self.attractor.copy_(torch.stack([d.goal for d in shown]).mean(0))
        self.start.copy_(torch.stack([d.start for d in shown]).mean(0))
        self.duration.fill_(sum(d.duration for d in shown) / len(shown))

    @torch.no_grad()
    def _learned(self, shown: Sequence[Demonstration], n_layers: int) -> Learned:
        """What was learned, with the mean squared error per coordinate of the motions from the demonstrated starts."""
        missed = [
            self.motion(d.start.to(self.attractor), 0.0, (d.times / d.duration).to(self.attractor)).cpu() - d.positions
            for d in shown
        ]
        return Learned(float(torch.cat(missed).square().mean()), n_layers)


def refuse_closed(shown: Sequence[Demonstration]) -> None:
    """That each demonstration's own ends are apart."""
    for d in shown:
        goal_apart(d, d.goal)
