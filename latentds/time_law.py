"""How fast the latent point moves: autonomous laws ṡ = -h(s) on a line to the goal, with their flow in closed form."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn

from .arguments import Array, positive
from .resizing import make_room
from .tabulated import LawKind, LawTable, Tabulated

LINEAR_BELOW = 1e-3
"""Progress below which laws turn linear, ṡ ∝ -s: a law that reaches the goal in finite time is not Lipschitz there."""
POOLED_CELLS, POOLED_WIDTH = 60, 1.0
"""Cells of the way in which several motions are pooled, and the standard deviation, in cells, that smooths them."""
BEGINS_WITHIN = 0.06
"""A motion that begins, often from rest, does not count within so much of the way where others pass."""
SLOWEST = 1e-2
"""Least speed of a pooled law, in ways per duration, where all rest."""


class TimeLaw(Tabulated, nn.Module, ABC):
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

    def convergence_rate_bound(self, reach: float) -> float | None:
        """The least h(s)/s over 0 < s <= ``reach``, per second: None if unknown, not above 0 if the law is none."""
        return None

    def table(self) -> LawTable | None:
        """The law as numbers, as it is now; None if compiled code cannot compute it."""
        return None


class ChebyshevLaw(TimeLaw):
    """h(s) = ω √(s(2-s)), ω = π / (2 duration): the latent motion of the Laplacian eigenmap (paper, Sec. V).

    It is linear below ``LINEAR_BELOW``, and ω above 1, where the eigenmap says nothing.

    Args:
        duration: seconds from s = 1 to s = 0 without the tail, > 0.
    """

    omega: Tensor

    def __init__(self, duration: float = 1.0) -> None:
        super().__init__()
        omega = math.pi / (2 * positive(duration, "duration"))
        self.register_buffer("omega", torch.tensor(omega, dtype=torch.float64))

    # s = 1 - cos(angle) = 2 sin²(angle/2) makes the motion uniform in the angle.
    _edge = 2 * math.asin(math.sqrt(LINEAR_BELOW / 2))
    _tail_rate = math.sqrt((2 - LINEAR_BELOW) / LINEAR_BELOW)  # in units of ω

    def speed(self, s: Tensor) -> Tensor:
        inside = s.clamp(LINEAR_BELOW, 1.0)
        return self.omega * torch.where(s < LINEAR_BELOW, self._tail_rate * s, (inside * (2 - inside)).sqrt())

    def time_to_go(self, s: Tensor) -> Tensor:
        inside = s.clamp(LINEAR_BELOW, 1.0)
        arc = 2 * torch.asin((inside / 2).sqrt()) - self._edge
        tail = torch.log(s.clamp(max=LINEAR_BELOW) / LINEAR_BELOW) / self._tail_rate
        return (arc + tail + (s - 1).clamp(min=0)) / self.omega

    def progress_at(self, time: Tensor) -> Tensor:
        phase = self.omega * time
        top = math.pi / 2 - self._edge
        arc = 2 * torch.sin((phase.clamp(0.0, top) + self._edge) / 2).square()
        tail = LINEAR_BELOW * torch.exp(self._tail_rate * phase.clamp(max=0.0))
        return torch.where(phase < 0, tail, arc + (phase - top).clamp(min=0))

    def convergence_rate_bound(self, reach: float) -> float:
        return float(self.speed(self.omega.new_tensor(reach))) / reach  # h(s)/s never rises

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        omega = state_dict.get(prefix + "omega")
        if omega is not None and not bool((omega > 0).all()):
            rest[-1].append(f"omega: expected a number > 0, got {omega.tolist()}")
            return
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def table(self) -> LawTable:
        return LawTable(LawKind.EIGENMAP, np.ones(1), np.array([float(self.omega)]))


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
        _check_knots(knots, speeds)
        self.register_buffer("knots", knots)
        self.register_buffer("speeds", speeds)

    @classmethod
    def uniform(cls, duration: float = 1.0) -> PiecewiseLinearLaw:
        """Constant rate 1 / duration above the tail: the line that FDM moves on."""
        speed = 1 / positive(duration, "duration")
        return cls(torch.tensor([LINEAR_BELOW], dtype=torch.float64), torch.tensor([speed], dtype=torch.float64))

    @classmethod
    def from_timing(cls, progress: Tensor, times: Tensor, n_knots: int = 256) -> PiecewiseLinearLaw:
        """The law under which progress falls as shown: a demonstrated time law.

        Knots lie where progress and time, both as shares, advance evenly together, so that slow and fast parts are
        resolved alike; their speeds are settled until the time between any two knots is the demonstrated one. Before
        the start the speed rises (or falls) to the mean within 2 % of the way, so that a start at rest does not hold
        up what starts behind it.

        Args:
            progress: (m,) strictly decreasing from 1, or from where the hindmost of several motions starts, to 0.
            times: (m,) seconds, strictly increasing from 0.
            n_knots: most knots.
        """
        s, t = progress.to(torch.float64).cpu().numpy(), times.to(torch.float64).cpu().numpy()
        clock = (s[0] - s) + s[0] * t / t[-1]
        even = np.interp(np.linspace(0, 2 * s[0], n_knots), clock, s)
        even = even[even > 2 * LINEAR_BELOW]
        apart = np.concatenate([[True], -np.diff(even) > 1e-6])
        knots = np.concatenate([even[apart], [LINEAR_BELOW]])[::-1]
        arrivals = np.interp(-knots, -s, t)
        spans = np.maximum(-np.diff(arrivals), 1e-9 * t[-1])
        gaps = np.diff(knots)
        pace = np.interp(knots, (knots[1:] + knots[:-1]) / 2, spans / gaps)
        speeds = 1 / pace
        for _ in range(30):  # the time over a segment is gap · log(b/a) / (b-a): nudge both ends by what it lacks
            low, high = speeds[:-1], speeds[1:]
            ratio = high / low
            bend = np.where(np.abs(ratio - 1) < 1e-6, 1.0, np.log(ratio) / np.where(ratio == 1, 1.0, ratio - 1))
            excess = np.log(gaps / low * bend / spans)
            nudge = np.zeros_like(speeds)
            nudge[:-1] += excess
            nudge[1:] += excess
            nudge[1:-1] /= 2
            speeds = speeds * np.exp(0.5 * nudge)
        mean = s[0] / t[-1]
        return cls(torch.from_numpy(np.append(knots, s[0] + 0.02)), torch.from_numpy(np.append(speeds, mean)))

    @classmethod
    def pooled(cls, progress: Array, times: Array) -> PiecewiseLinearLaw:
        """The law of several motions: in each cell, the way that all pass there over the time that all spend there.

        No cell is faster than the fastest was there. Where one begins and others pass, these alone count, so that who
        starts behind does not wait where others stood. Before the hindmost start the speed turns to the mean within
        2 % of the way.

        Args:
            progress: (K, N), of each motion from about 1 at its start to 0 at the goal.
            times: (K, N) seconds, rising from 0.
        """
        s = np.minimum.accumulate(np.maximum(progress, 0), axis=1)
        edges = np.linspace(0, max(1.0, float(s.max())), POOLED_CELLS + 1)
        before, after, spent = s[:, :-1, None], s[:, 1:, None], np.diff(times, axis=1)[..., None]
        passed = np.clip(before, edges[:-1], edges[1:]) - np.clip(after, edges[:-1], edges[1:])
        whole = before - after
        share = np.divide(passed, whole, out=np.zeros_like(passed), where=whole > 0)
        rests = (whole <= 0) & (edges[:-1] <= before) & (before < edges[1:])  # they count where they are
        ways, taken = passed.sum(1), (spent * (share + rests)).sum(1)  # of each motion in each cell
        begins = edges[1:] > s[:, :1] - BEGINS_WITHIN * edges[-1]
        others = np.where(begins, 0.0, ways).sum(0) > 0
        counted = ~(begins & others)
        way, took = (np.where(counted, part, 0.0).sum(0) for part in (ways, taken))
        way, took = (gaussian_filter1d(part, POOLED_WIDTH, mode="nearest") for part in (way, took))
        middle, seen = (edges[1:] + edges[:-1]) / 2, took > 0
        mean = float((1 / times[:, -1]).mean())
        speeds = np.maximum(np.interp(middle, middle[seen], way[seen] / took[seen]), SLOWEST * mean)
        knots = np.concatenate([middle[:1] / 2, middle, edges[-1:] + 0.02])
        return cls(torch.from_numpy(knots), torch.from_numpy(np.concatenate([speeds[:1] / 2, speeds, [mean]])))

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

    def convergence_rate_bound(self, reach: float) -> float:
        try:
            _check_knots(self.knots, self.speeds)  # whoever wrote them after the constructor did
        except ValueError:
            return -math.inf
        # h(s)/s is monotone between two knots
        ends = torch.cat([self.knots[self.knots < reach], self.knots.new_tensor([reach])])
        return float((self.speed(ends) / ends).min())

    def table(self) -> LawTable:
        numbers = torch.stack([self.knots, self.speeds]).detach().to("cpu", torch.float64, copy=True).numpy()
        return LawTable(LawKind.PIECEWISE_LINEAR, *numbers)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """A fit chooses how many knots there are, so a fresh law takes any number."""
        knots, speeds = state_dict.get(prefix + "knots"), state_dict.get(prefix + "speeds")
        if knots is not None and speeds is not None:
            try:
                _check_knots(knots, speeds)
            except ValueError as error:
                rest[-1].append(str(error))  # load_state_dict's list of what went wrong
                return
            make_room(self, state_dict, prefix, ["knots", "speeds"])
        super()._load_from_state_dict(state_dict, prefix, *rest)

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


def _check_knots(knots: Tensor, speeds: Tensor) -> None:
    if knots.is_meta and knots.shape == speeds.shape:
        return  # no numbers yet; those that are loaded are checked
    increasing = knots.ndim == 1 and len(knots) > 0 and bool((knots.diff() > 0).all()) and float(knots[0]) > 0
    if not (increasing and bool(torch.isfinite(knots).all())):
        raise ValueError(f"knots: expected (m,) finite numbers increasing from above 0, got {knots.tolist()!r:.80}")
    if speeds.shape != knots.shape or not bool(((speeds > 0) & torch.isfinite(speeds)).all()):
        raise ValueError(f"speeds: expected {tuple(knots.shape)} finite numbers > 0, got {speeds.tolist()!r:.80}")


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
