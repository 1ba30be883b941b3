"""How fast the latent point moves: autonomous laws ṡ = -h(s) on a line to the goal, with their flow in closed form."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from .arguments import Array, positive
from .kernels.dispatch import is_plain, no_active_transforms
from .memo import Memo
from .resizing import make_room
from .tabulated import LINEAR_BELOW, LawKind, LawTable, Tabulated, rounded_pieces

POOLED_CELLS, POOLED_WIDTH = 60, 1.0
"""Cells of the way in which several motions are pooled, and the standard deviation, in cells, that smooths them."""
BEGINS_WITHIN = 0.06
"""A motion that begins, often from rest, does not count within so much of the way where others pass."""
SLOWEST = 1e-2
"""Least speed of a pooled law, in ways per duration, where all rest."""
SERIES_BELOW = 1e-3
"""Where series of five terms, exact to rounding, take the place of what divides by the root of a discriminant."""


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


class KnottedLaw(TimeLaw):
    """h linear from 0 to the first knot, between knots, and constant above the last, with its corners rounded.

    Parabolas round them (:func:`latentds.tabulated.rounded_pieces`), so that h' is continuous, and the acceleration of
    a motion with it; h stays between neighbouring values of the polygon.

    Args:
        knots: (m,) progress, 0 < knots[0] < … < knots[m-1].
        speeds: (m,) of the polygon at the knots, > 0, per second.
    """

    knots: Tensor
    speeds: Tensor

    def __init__(self, knots: Tensor, speeds: Tensor) -> None:
        super().__init__()
        knots, speeds = torch.as_tensor(knots, dtype=torch.float64), torch.as_tensor(speeds, dtype=torch.float64)
        _check_knots(knots, speeds)
        self.register_buffer("knots", knots)
        self.register_buffer("speeds", speeds)
        self._memo = Memo[Tensor]()

    @classmethod
    def uniform(cls, duration: float = 1.0) -> KnottedLaw:
        """Constant rate 1 / duration above the tail: the line that FDM moves on."""
        speed = 1 / positive(duration, "duration")
        return cls(torch.tensor([LINEAR_BELOW], dtype=torch.float64), torch.tensor([speed], dtype=torch.float64))

    @classmethod
    def from_timing(cls, progress: Tensor, times: Tensor, n_knots: int = 256) -> KnottedLaw:
        """The law under which progress falls as shown: a demonstrated time law.

        Knots lie where progress and time, both as shares, advance evenly together, so that slow and fast parts are
        resolved alike; their speeds are settled until the time between any two knots is the demonstrated one. Before
        the start the speed rises (or falls) to the mean within 3 % of the way, so that a start at rest does not hold
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
        mean = s[0] / t[-1]
        law = cls(torch.from_numpy(np.append(knots, s[0] + 0.02)), torch.from_numpy(np.append(1 / pace, mean)))
        for _ in range(30):  # nudge both ends of a gap by what the time over it lacks
            excess = (law.time_to_go(law.knots[:-1]).diff() / torch.from_numpy(spans)).log()
            nudge = torch.nn.functional.pad(excess, (1, 0)) + torch.nn.functional.pad(excess, (0, 1))
            nudge[1:-1] /= 2
            law.speeds[:-1] *= (0.5 * nudge).exp()
        return law

    @classmethod
    def pooled(cls, progress: Array, times: Array) -> KnottedLaw:
        """The law of several motions: in each cell, the way that all pass there over the time that all spend there.

        No cell is faster than the fastest was there. Where one begins and others pass, these alone count, so that who
        starts behind does not wait where others stood. Before the hindmost start the speed turns to the mean within
        3 % of the way.

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
        way, took = (scipy.ndimage.gaussian_filter1d(part, POOLED_WIDTH, mode="nearest") for part in (way, took))
        middle, seen = (edges[1:] + edges[:-1]) / 2, took > 0
        mean = float((1 / times[:, -1]).mean())
        speeds = np.maximum(np.interp(middle, middle[seen], way[seen] / took[seen]), SLOWEST * mean)
        knots = np.concatenate([middle[:1] / 2, middle, edges[-1:] + 0.02])
        return cls(torch.from_numpy(knots), torch.from_numpy(np.concatenate([speeds[:1] / 2, speeds, [mean]])))

    def speed(self, s: Tensor) -> Tensor:
        pieces = self._pieces()
        start, speed, slope, bend, _ = pieces[:, _piece_of(s, pieces[0, 1:])]
        ahead = torch.minimum(s, pieces[0, -1]) - start  # h is constant on the last piece, at infinity too
        h: Tensor = speed + ahead * (slope + ahead * bend)
        return h

    def time_to_go(self, s: Tensor) -> Tensor:
        pieces = self._pieces()
        index = _piece_of(s, pieces[0, 1:])
        start, *piece = pieces[:, index.clamp(min=1)]
        edge, rate = pieces[0, 1], pieces[2, 0]
        inside = _arrivals(pieces)[index] + _travel_time(torch.where(index == 0, 0.0, s - start), *piece)
        return torch.where(index == 0, torch.log(s.clamp(max=edge) / edge) / rate, inside)

    def progress_at(self, time: Tensor) -> Tensor:
        pieces = self._pieces()
        arrivals = _arrivals(pieces)
        index = _piece_of(time, arrivals[1:])
        start, *piece = pieces[:, index.clamp(min=1)]
        inside = start + _travel(torch.where(index == 0, 0.0, time - arrivals[index]), *piece)
        return torch.where(index == 0, pieces[0, 1] * torch.exp(pieces[2, 0] * time.clamp(max=0.0)), inside)

    def convergence_rate_bound(self, reach: float) -> float:
        try:
            _check_knots(self.knots, self.speeds)  # whoever wrote them after the constructor did
        except ValueError:
            return -math.inf
        start, speed, slope, bend, _ = self._pieces()
        # h/s = bend s + … + constant / s of a piece has its least at an end, or where both terms are equal
        constant = speed - start * (slope - start * bend)
        inner = (constant / bend)[(bend > 0) & (constant > 0)].sqrt()
        s = torch.cat([start[1:], inner, start.new_tensor([reach])])
        s = s[s <= reach]
        return float((self.speed(s) / s).min())

    def table(self) -> LawTable:
        numbers = torch.stack([self.knots, self.speeds]).detach().to("cpu", torch.float64, copy=True).numpy()
        return LawTable(LawKind.KNOTTED, *numbers)

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

    def _pieces(self) -> Tensor:
        knots, speeds = self.knots, self.speeds
        if (torch.is_grad_enabled() and (knots.requires_grad or speeds.requires_grad)) or not no_active_transforms():
            return rounded_pieces(knots, speeds)
        return self._memo.of(None, [knots, speeds], lambda: rounded_pieces(knots, speeds))


def _check_knots(knots: Tensor, speeds: Tensor) -> None:
    if knots.is_meta and knots.shape == speeds.shape:
        return  # no numbers yet; those that are loaded are checked
    increasing = knots.ndim == 1 and len(knots) > 0 and bool((knots.diff() > 0).all()) and float(knots[0]) > 0
    if not (increasing and bool(torch.isfinite(knots).all())):
        raise ValueError(f"knots: expected (m,) finite numbers increasing from above 0, got {knots.tolist()!r:.80}")
    if speeds.shape != knots.shape or not bool(((speeds > 0) & torch.isfinite(speeds)).all()):
        raise ValueError(f"speeds: expected {tuple(knots.shape)} finite numbers > 0, got {speeds.tolist()!r:.80}")


def _piece_of(values: Tensor, edges: Tensor) -> Tensor:
    """How many of the edges lie below each value.

    torch wakes a thread a core for more than 200 values, which then spin for longer than it takes to find them all.
    """
    values = values.detach()
    if no_active_transforms() and is_plain(values, values.dtype) and values.numel() > 200:
        found = np.searchsorted(edges.detach().numpy(), values.numpy().ravel())
        return torch.from_numpy(found).view(values.shape)
    return torch.bucketize(values, edges)


def _arrivals(pieces: Tensor) -> Tensor:
    """Seconds from the start of each piece to the edge of the tail, (2m+1,); 0 of the tail itself."""
    steps = _travel_time(pieces[0].diff()[1:], *pieces[1:, 1:-1])
    return torch.cat([torch.zeros_like(pieces[0, :2]), steps.cumsum(0)])


def _travel_time(distance: Tensor, speed: Tensor, slope: Tensor, bend: Tensor, discriminant: Tensor) -> Tensor:
    """Seconds over ``distance`` from where h, h' and h''/2 are ``speed``, ``slope`` and ``bend``: ∫ dδ / h.

    2/√D artanh(√D δ/q), with D = h'² - 2 h h'' and q = 2h + h' δ; an arctangent where D < 0.
    """
    q, ending = 2 * speed + slope * distance, speed + distance * (slope + distance * bend)
    near, roots = _near_and_roots(discriminant, distance / q)
    z = torch.where(near, discriminant * (distance / q).square(), 0.0)
    series = 2 * distance / q * (1 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z / 9))))
    # 1 - (√D δ/q)² is 4 h(0) h(δ) / q²: said so, the logarithm does not cancel where h nearly vanishes
    gone = roots[0] * distance
    hyperbolic = torch.log1p((gone * (q + gone) / (2 * speed * ending)).clamp(min=0)) / roots[0]
    circular = 2 * torch.atan2(roots[1] * distance, q) / roots[1]
    return torch.where(near, series, torch.where(discriminant > 0, hyperbolic, circular))


def _travel(time: Tensor, speed: Tensor, slope: Tensor, bend: Tensor, discriminant: Tensor) -> Tensor:
    """The inverse: 2 h T / (√D - h' T), T = tanh(√D τ/2)."""
    near, roots = _near_and_roots(discriminant, time / 2)
    within = torch.where(near, time, 0.0)
    w = discriminant * within.square() / 4
    within = within * (1 + w * (-1 / 3 + w * (2 / 15 + w * (-17 / 315 + w * 62 / 2835))))
    series = speed * within / (1 - slope * within / 2)
    growth = torch.expm1(roots[0] * torch.where(near | (discriminant < 0), 0.0, time))
    steep = roots[0] + slope.abs()
    lean = torch.where(slope > 0, -4 * bend * speed / steep, steep)  # √D - h', without cancellation
    hyperbolic = 2 * speed * growth / (2 * roots[0] + lean * growth)
    angle = roots[1] * torch.where(near | (discriminant > 0), 0.0, time) / 2
    circular = 2 * speed * angle.sin() / (roots[1] * angle.cos() - slope * angle.sin())
    return torch.where(near, series, torch.where(discriminant > 0, hyperbolic, circular))


def _near_and_roots(discriminant: Tensor, factor: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Where a series serves, by D ``factor``²; √D, √-D, and 1 where they are not needed, so that gradients exist."""
    near = (discriminant * factor.square()).abs() < SERIES_BELOW
    squares = (torch.where(near | (sign * discriminant <= 0), 1.0, sign * discriminant) for sign in (1, -1))
    positive_root, negative_root = (square.sqrt() for square in squares)
    return near, (positive_root, negative_root)
