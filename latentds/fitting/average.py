"""The one motion that several demonstrations have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..arguments import Array
from ..curves import interpolated
from ..demonstration import Demonstration
from .embedding import arc_length_path
from .search import PLAN

DECIMALS = 9
"""To which a motion is rounded, in its own sizes and durations."""


def mean_motion(shown: Sequence[Demonstration]) -> tuple[Demonstration, Array, Array]:
    """The mean of several demonstrations at equal progress, with the mean goal; each at even progress; and when.

    Each, (K, N, n), is moved onto the common goal, the more the farther along it is; its times are (K, N), in seconds.
    """
    goal = np.mean([one.goal.numpy() for one in shown], axis=0)
    paths, arrivals, even = [], [], np.linspace(0, 1, PLAN.n_points)
    for one in shown:
        path, way, times = arc_length_path(one.positions.numpy(), one.times.numpy(), PLAN.n_points)
        paths.append(path + even[:, None] * (goal - path[-1]))
        arrivals.append(one.duration * (np.interp(even, 1 - way, times) / one.duration).round(DECIMALS))
    strands = np.stack(paths)
    if len(shown) == 1:
        return shown[0], strands, np.stack(arrivals)
    count, arrival = max(len(one) for one in shown), np.mean(arrivals, axis=0)
    at = np.interp(np.linspace(0, arrival[-1], count), arrival, even)
    mean = interpolated(at, even, strands.mean(0))
    return (
        Demonstration(torch.from_numpy(mean), arrival[-1] / (count - 1), f"mean of {len(shown)}"),
        strands,
        np.stack(arrivals),
    )
