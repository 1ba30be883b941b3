"""Demonstrations as one set of samples without units, for methods that learn from all of them alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from latentds.demonstration import Demonstration, goal_apart


class Pool(NamedTuple):
    """The samples of all demonstrations, with the goals' mean at 0; sizes and durations are 1.

    Attributes:
        points: (N, n), in sizes.
        velocities: (N, n), in sizes per duration.
        goal: (n,), the goals' mean in the units of the demonstrations.
        size: () largest extent of all samples along an axis, in those units.
        duration: () seconds, the demonstrations' mean.
    """

    points: Tensor
    velocities: Tensor
    goal: Tensor
    size: Tensor
    duration: Tensor

    @classmethod
    def of(cls, shown: Sequence[Demonstration]) -> Pool:
        """At least one demonstration; a closed loop is refused by a ValueError."""
        goal = torch.stack([d.goal for d in shown]).mean(0)
        for d in shown:
            goal_apart(d, goal)
        points, velocities = torch.cat([d.positions for d in shown]), torch.cat([d.velocities for d in shown])
        size = (points.amax(0) - points.amin(0)).max()
        duration = points.new_tensor([d.duration for d in shown]).mean()
        return cls((points - goal) / size, velocities / size * duration, goal, size, duration)
