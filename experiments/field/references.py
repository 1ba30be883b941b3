"""What learns next to nothing, to hold methods against: curves from a start, and velocities of the nearest sample.

None is a dynamical system: a curve is a function of its start and of the time since, and nothing says where it goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from latentds import Demonstration
from latentds.arguments import Array, check_points, real_array, real_tensor
from latentds.cell import several
from latentds.curves import progress_along

Reference = Callable[[Sequence[Demonstration], Tensor, Tensor], Array]
"""(demonstrations, start (n,), times (T,) in seconds since the start) -> path (T, n)."""


def mean_in_time(demonstrations: Sequence[Demonstration]) -> Demonstration:
    """The mean of demonstrations at equal shares of their durations; it ends at their goals' mean, after their mean."""
    shown = several(demonstrations, "demonstrations")
    shares = np.linspace(0, 1, max(len(one) for one in shown))
    positions = np.mean([one.at(shares * one.duration) for one in shown], axis=0)
    duration = float(np.mean([one.duration for one in shown]))
    return Demonstration(positions, duration / (len(shares) - 1), "mean")


def plain_mean(demonstrations: Sequence[Demonstration], start: Tensor, times: Tensor) -> Array:
    """The mean as it is, wherever the motion starts; of one demonstration its own path."""
    return _joined(mean_in_time(demonstrations), None, start, times)


def dying_offset(demonstrations: Sequence[Demonstration], start: Tensor, times: Tensor) -> Array:
    """The mean from its own start; the offset of the start, kept parallel, dies linearly in progress along it."""
    return _joined(mean_in_time(demonstrations), 0, start, times)


def nearest_join(demonstrations: Sequence[Demonstration], start: Tensor, times: Tensor) -> Array:
    """The mean from its sample nearest to the start; the offset from there dies linearly along what is left of it."""
    mean = mean_in_time(demonstrations)
    entry = int(np.linalg.norm(mean.positions.numpy() - real_array(start, "start"), axis=1).argmin())
    return _joined(mean, entry, start, times)


def _joined(path: Demonstration, entry: int | None, start: Tensor, times: Tensor) -> Array:
    """A path from its sample ``entry`` on, with the offset of the start from there; None: all of it, without offset."""
    check_points(path.dim, real_tensor(start, "start"), "start")
    since = real_array(times, "times")
    if since.ndim != 1 or not (since >= 0).all():
        raise ValueError(f"times: expected (T,) seconds >= 0, got {times!r}")
    if entry is None:
        return path.at(since)
    points, clocks = path.positions.numpy(), since + entry * path.dt
    progress = progress_along(points)
    left = np.interp(np.interp(clocks, path.times.numpy(), progress), [progress[entry], 1.0], [1.0, 0.0])
    joined: Array = path.at(clocks) + left[:, None] * (real_array(start, "start") - points[entry])
    return joined


def nearest_velocity(demonstrations: Sequence[Demonstration], positions: Tensor) -> Tensor:
    """At each position (N, n) the velocity of the nearest sample of all demonstrations: (N, n)."""
    shown = several(demonstrations, "demonstrations")
    check_points(shown[0].dim, positions, "positions")
    nearest = torch.cdist(positions, torch.cat([one.positions for one in shown])).argmin(-1)
    return torch.cat([one.velocities for one in shown])[nearest]


CURVES: dict[str, Reference] = {
    "plain mean": plain_mean,
    "dying offset": dying_offset,
    "nearest join": nearest_join,
}
"""By the name that tables give them."""
