"""How well a fitted system follows what it was shown, measured by its own motions and never assumed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import scipy
import torch
from torch import Tensor

from .arguments import Array, number_in, point_array, positive
from .curves import extent, interpolated, jitter
from .demonstration import Demonstration
from .metrics import dtw, endpoint_error, path_length, path_length_ratio
from .probes import flow_gap, restart_gap, unit_ball

MISS_LIMIT = 0.05
"""Largest mean distance from the demonstration, in its sizes; good fits stay below half of it, even of 1 % noise."""
END_LIMIT, SPREAD_LIMIT = 0.05, 0.1
"""Largest distance from the demonstrated end when the demonstration ends, in sizes of the motion; and how much more is
allowed at most where the goals, or the paces, of several demonstrations differ."""
LEAST_LENGTH_RATIO, LARGEST_LENGTH_RATIO = 0.8, 1.25
"""Length of the motion over that of the demonstration: a shortcut is shorter, a detour longer."""
NEARBY_DISTANCE, NEARBY_LIMIT = 0.01, 0.15
"""A start so near the demonstrated one, in sizes, that nobody places it better, may miss by thrice ``MISS_LIMIT``:
a tight spiral spreads good fits that far. A motion that jumps to another strand or to the goal misses by twice it."""
COMMAND_LIMIT = 2.0
"""From where it was shown to begin, from beside it, and from between several such starts, no motion is so many times as
fast as what was shown."""
BESIDE_PATH, SPEED_LIMIT = 0.1, 5.0
"""Within so many sizes of the path no velocity exceeds the largest demonstrated one so many times. The pull of a tube
that brings back what is so far off in a twentieth of the duration is a few times it; near a fold it is hundreds."""
ROUNDING_LIMIT = 1e-3
"""What rounding may do along a motion: let V rise by so much of itself, carry it so many sizes away when it is begun
anew half-way, bring encode(decode(x)) so many latent lengths off x. Sound systems stay orders of magnitude below."""
FLOW_GAP_LIMIT = 0.05
"""Distance of a rollout from the integral of the velocity field, in sizes; sound fits stay below a third."""
TIMING_LIMIT = 0.05
"""Mean distance from the demonstration at equal times, in sizes: neither DTW nor a length sees too fast a motion."""
COORDINATE_LIMIT, CONSTANT_WITHIN = 0.15, 1e-4
"""A coordinate that is missed by so much of its own range is hardly followed; one that moves by less than the second
number, in sizes, rests."""

NEARBY_STARTS = 8
"""Motions from nearby starts."""
PLACES_BESIDE = 400
"""Points beside the path at which velocities are looked at."""
EXCERPT_POINTS, MOST_EXCERPT_POINTS, EXCERPT_POINTS_PER_SIZE = 200, 1000, 10
"""Points of an excerpt: so many for each of its sizes that the path is long, within these bounds."""
MOST_EXCERPTS = 8
"""Most demonstrations of one fit that are looked at."""


class FitWarning(UserWarning):
    """A fit does not follow what it was shown; the text says in what, ``fit_report.fidelity`` has the figures."""


@dataclass(frozen=True)
class Excerpt:
    """What a system keeps of a demonstration, so that it can be held against it later.

    Attributes:
        path: (T, n) positions, even in time from the start to the goal.
        duration: seconds.
        fastest: largest demonstrated speed, units per second.
        ruler: length below which a step counts as noise, in the units of the positions.

    Raises:
        ValueError: naming the attribute, if one is none of this.
    """

    path: tuple[tuple[float, ...], ...]
    duration: float
    fastest: float
    ruler: float

    def __post_init__(self) -> None:
        if len(point_array(self.path, "path")) > MOST_EXCERPT_POINTS:  # aligning one takes its square in time
            raise ValueError(f"path: expected at most {MOST_EXCERPT_POINTS} points, got {len(self.path)}")
        positive(self.duration, "duration")
        positive(self.fastest, "fastest")
        number_in(self.ruler, "ruler", 0, math.inf, ends="[)")

    @classmethod
    def of(cls, shown: Demonstration) -> Excerpt:
        positions = shown.positions.numpy()
        ruler = 4 * jitter(positions)
        length = path_length(positions, ruler)
        count = int(np.clip(EXCERPT_POINTS_PER_SIZE * length / shown.size, EXCERPT_POINTS, MOST_EXCERPT_POINTS))
        path = shown.at(np.linspace(0, shown.duration, count))
        fastest = float(torch.linalg.vector_norm(shown.velocities, dim=-1).max())
        return cls(tuple(map(tuple, path.tolist())), shown.duration, fastest, ruler)

    @classmethod
    def of_each(cls, shown: Sequence[Demonstration]) -> tuple[Excerpt, ...]:
        """Of each demonstration, or of ``MOST_EXCERPTS`` of them, evenly chosen."""
        chosen = np.unique(np.linspace(0, len(shown) - 1, MOST_EXCERPTS).round().astype(int))
        return tuple(cls.of(shown[i]) for i in chosen)


class System(Protocol):
    """What is measured: any :class:`~latentds.StableDS`."""

    attractor: Tensor

    def __call__(self, y: Tensor) -> Tensor: ...

    def lyapunov(self, y: Tensor) -> Tensor: ...

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor: ...

    def latent_error(self, y0: Tensor, t: Tensor) -> Tensor | None: ...


@dataclass(frozen=True)
class Fidelity:
    """How a system follows what it was shown; of several demonstrations each figure is the worst.

    Sizes are the largest extents of the demonstration along an axis. The motion lasts as long as the demonstration, and
    as the longest of several: the system has one timing for all of them.

    Attributes:
        miss: distance of the motion from the demonstrated start and the demonstration: exact DTW over points, in sizes.
        length_ratio: length of that motion over that of the demonstration.
        end: distance of its end from the demonstrated one, in sizes.
        nearby: as ``miss``, the worst of ``NEARBY_STARTS`` motions from ``NEARBY_DISTANCE`` sizes beside the
            demonstrated start, or from a quarter of the way to where the demonstration comes back to it.
        fastest: largest velocity on the demonstrated path and within ``BESIDE_PATH`` sizes of it, over the largest
            shown in any.
        rise: largest rise of V along the motion, over V at its start.
        restart_gap: largest distance of the motion from the same one begun anew half-way, in sizes.
        flow_gap: largest distance, in sizes, of that motion and of two from beside its start from the integral of the
            velocity field, which is what a robot runs.
        timing: mean distance of that motion from the demonstration at equal times, in sizes, after the best shift by up
            to a tenth of the duration, as one that starts to move a little later. Of several demonstrations, which one
            system cannot all keep the times of, each counts in the mean of their durations.
        command: largest velocity along the motions from the demonstrated start, from beside it, and from between the
            starts of several demonstrations, over the largest shown in any.
        coordinate: mean miss of one coordinate, over its own range: the worst of those that move by more than noise.
        latent_error: see :meth:`~latentds.LatentDS.latent_error`; 0 for a system without latent space.
        spread: of several demonstrations, the largest distance of a goal from the mean of their goals, in sizes. One
            attractor cannot be nearer to all of them, so it is added, up to ``SPREAD_LIMIT``, to what ``end`` may be.
        pace_spread: of several, the largest mean distance of one from their mean at equal shares of their durations, in
            sizes. No one timing is nearer to all, so it is added, up to ``SPREAD_LIMIT``, to what ``timing`` may be.
        shown: what it was held against.
    """

    miss: float
    length_ratio: float
    end: float
    nearby: float
    fastest: float
    rise: float
    restart_gap: float
    flow_gap: float = 0.0
    timing: float = 0.0
    coordinate: float = 0.0
    command: float = 0.0
    latent_error: float = 0.0
    spread: float = 0.0
    pace_spread: float = 0.0
    shown: tuple[Excerpt, ...] = field(default=(), repr=False)

    @property
    def end_limit(self) -> float:
        """What ``end`` may be."""
        return END_LIMIT + min(self.spread, SPREAD_LIMIT)

    @property
    def timing_limit(self) -> float:
        """What ``timing`` may be."""
        return TIMING_LIMIT + min(self.pace_spread, SPREAD_LIMIT)

    @property
    def follows(self) -> bool:
        """Whether nothing is off."""
        return all(badness <= 1 for badness, _ in self.findings)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is off, in words, the worst first; then what may be, if the coordinates have different units."""
        off = [words for badness, words in sorted(self.findings, reverse=True) if not badness <= 1]
        if not off and self.coordinate > COORDINATE_LIMIT:
            off.append(
                f"a coordinate that moves little is missed by {self.coordinate:.3g} of its own range: if its unit is "
                "another one, such as rad beside mm, scale the coordinates to like ranges before the fit"
            )
        return tuple(off)

    @property
    def findings(self) -> tuple[tuple[float, str], ...]:
        """Each figure over its limit, and in words."""
        return tuple(
            (math.inf if math.isnan(badness) else badness, words) for _, _, _, badness, words in self._judged()
        )

    def __str__(self) -> str:
        """Each figure beside its limit, a line each."""
        head = f"{'':62}{'measured':>10}{'may be':>14}"
        return "\n".join([head, *(f"  {what:60}{value:10.3g}{limit:>14}" for what, value, limit, *_ in self._judged())])

    def _judged(self) -> Iterator[tuple[str, float, str, float, str]]:
        """Each figure: what it is, its value, what it may be, its value over that, and what a note says of it."""
        beside = f"within {BESIDE_PATH:.0%} of the size"
        for limit, value, what, words in (
            (MISS_LIMIT, self.miss, "distance from the demonstration, in its sizes",
             "misses its demonstration by {} of the size"),
            (NEARBY_LIMIT, self.nearby, "the same, the worst from starts beside the demonstrated one",
             "misses by {} of the size from a start beside the demonstrated one"),
            (self.end_limit, self.end, "distance of its end from the demonstrated one, in sizes",
             "is {} of the size from the end when the demonstration ends"),
            (self.timing_limit, self.timing, "distance at equal times, on average, in sizes",
             "is {} of the size from where its demonstration is at the same time, on average"),
            (COMMAND_LIMIT, self.command, "largest speed from the shown start, over the largest shown",
             "moves {} times as fast as shown from where it was shown to begin or from beside it"),
            (SPEED_LIMIT, self.fastest, f"largest speed {beside} of the path, over that",
             f"moves {{}} times as fast as shown {beside} from the path"),
            (ROUNDING_LIMIT, self.rise, "largest rise of V along the motion, over V",
             "V rises by {} of itself along its motion"),
            (ROUNDING_LIMIT, self.restart_gap, "the motion begun anew half-way is away, in sizes",
             "its motion begun anew half-way is another one, {} sizes away"),
            (FLOW_GAP_LIMIT, self.flow_gap, "its rollout from the integral of the field, in sizes",
             "its rollout is {} sizes off the integral of its velocity field, which a robot runs"),
            (ROUNDING_LIMIT, self.latent_error, "encode(decode(x)) from x, in latent lengths",
             "rounding breaks its map, encode(decode(x)) is {} latent lengths from x"),
        ):  # fmt: skip
            yield what, value, f"{limit:.3g}", value / limit, words.format(f"{value:.3g}")
        folded = math.inf if not self.length_ratio > 0 else self.length_ratio
        yield (
            "its length over that of the demonstration",
            self.length_ratio,
            f"{LEAST_LENGTH_RATIO:g} to {LARGEST_LENGTH_RATIO:g}",
            max(folded / LARGEST_LENGTH_RATIO, LEAST_LENGTH_RATIO / folded),
            f"moves {self.length_ratio:.3g} times as far as its demonstration",
        )


@torch.no_grad()
def measure(ds: System, shown: Sequence[Excerpt]) -> Fidelity:
    """Hold a system against demonstrations of its dimension. Nothing is changed, and torch's generator not drawn from.

    Args:
        ds: the system as it is now, on any device.
        shown: at least one.

    Raises:
        ValueError: if a motion of the system is not shaped as :meth:`~latentds.StableDS.rollout` promises.
    """
    draw = np.random.default_rng(0)
    dim = len(shown[0].path[0])
    around = draw.standard_normal((NEARBY_STARTS, dim))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    ball = unit_ball(PLACES_BESIDE, dim, draw)
    paths = [np.array(one.path) for one in shown]
    duration = max(one.duration for one in shown)
    mean = float(np.mean([one.duration for one in shown]))
    every = [
        _measure(ds, one, path, duration, mean / one.duration, around[i :: len(shown)], ball[i :: len(shown)])
        for i, (one, path) in enumerate(zip(shown, paths, strict=True))
    ]
    figures = {name: float(np.max([one[name] for one in every])) for name in every[0]}
    ratios = [one["length_ratio"] for one in every]
    figures["length_ratio"] = max(ratios, key=lambda ratio: abs(math.log(ratio)) if ratio > 0 else math.inf)
    if len(shown) > 1:
        shares = draw.dirichlet(np.ones(len(shown)), NEARBY_STARTS)
        between = torch.from_numpy(shares @ np.stack([path[0] for path in paths])).to(ds.attractor)
        times = torch.linspace(0, duration, EXCERPT_POINTS, dtype=torch.float64).to(ds.attractor.device)
        figures["command"] = float(np.max([figures["command"], largest_speed(ds, ds.rollout(between, times))]))
    for name in ("command", "fastest"):
        figures[name] /= max(one.fastest for one in shown)
    goals = np.stack([path[-1] for path in paths])
    sizes = np.array([extent(path) for path in paths])
    spread = np.linalg.norm(goals - goals.mean(0), axis=1) / sizes
    shares = np.linspace(0, 1, EXCERPT_POINTS)
    paced = np.stack([interpolated(shares, np.linspace(0, 1, len(path)), path) for path in paths])
    pace_spread = np.linalg.norm(paced - paced.mean(0), axis=-1).mean(1) / sizes
    return Fidelity(**figures, spread=float(spread.max()), pace_spread=float(pace_spread.max()), shown=tuple(shown))


def _timing_gap(motion: Array, lasts: float, path: Array, duration: float) -> float:
    """Mean distance at equal times after the best shift of a motion that ``lasts`` so many seconds."""
    times, clock = np.linspace(0, duration, len(path)), np.linspace(0, lasts, len(motion))
    shifts = duration * np.linspace(-0.1, 0.1, 21)
    later = interpolated(times + shifts[:, None], clock, motion)
    return float(np.linalg.norm(later - path, axis=-1).mean(-1).min())


def _worst_coordinate(motion: Array, path: Array, still: float) -> float:
    """The largest mean miss of one coordinate, over its range, among those that move by more than ``still``.

    Missed where the motion is nearest in all coordinates together, which those of the largest unit decide.
    """
    ranges = np.ptp(path, axis=0)
    apart = motion[scipy.spatial.distance.cdist(path, motion).argmin(1)] - path
    missed = np.abs(apart).mean(0)[ranges > still] / ranges[ranges > still]
    return float(np.max(missed, initial=0.0))


def largest_speed(ds: System, points: Tensor) -> float:
    """Of the velocities at points (..., n), units per second."""
    return float(torch.linalg.vector_norm(ds(points), dim=-1).max())


def _measure(
    ds: System, one: Excerpt, path: Array, duration: float, pace: float, around: Array, ball: Array
) -> dict[str, float]:
    size, count = extent(path), len(path)
    distance = np.linalg.norm(path - path[0], axis=1)
    away = np.argmax(distance > 2 * NEARBY_DISTANCE * size)
    near = min(NEARBY_DISTANCE * size, float(distance[away:].min()) / 4)
    starts = torch.from_numpy(np.concatenate([path[:1], path[0] + near * around])).to(ds.attractor)
    times = torch.linspace(0, duration, count, dtype=torch.float64).to(ds.attractor.device)
    moved = ds.rollout(starts, times)
    if moved.shape != (len(starts), *path.shape):
        raise ValueError(f"rollout: expected shape {(len(starts), *path.shape)}, got {tuple(moved.shape)}")
    motions = moved.double().cpu().numpy()
    energy, error = ds.lyapunov(moved[0]), ds.latent_error(starts[0], times)
    missed = [dtw(motion, path) / count / size for motion in motions]
    beside = path[np.arange(len(ball)) * count // len(ball)] + BESIDE_PATH * size * ball
    return {
        "miss": missed[0],
        "length_ratio": path_length_ratio(motions[0], path, one.ruler),
        "end": endpoint_error(motions[0], path) / size,
        "nearby": float(np.max(missed[1:], initial=0.0)),
        "command": largest_speed(ds, moved),
        "fastest": largest_speed(ds, torch.from_numpy(np.concatenate([path, beside])).to(ds.attractor)),
        "timing": _timing_gap(motions[0], duration, path, pace * one.duration) / size,
        "coordinate": _worst_coordinate(motions[0], path, max(one.ruler, CONSTANT_WITHIN * size)),
        "rise": float(energy.diff().max() / energy[0]),
        "restart_gap": float(restart_gap(ds, moved[0], times)) / size,
        "flow_gap": float(flow_gap(ds, starts[:3], times, FLOW_GAP_LIMIT / 2 * size).max()) / size,
        "latent_error": 0.0 if error is None else float(error.max()),
    }
