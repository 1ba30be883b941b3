"""What a method is scored by: each figure is defined once, here, in the docstring of its function.

Distances are exact DTW over ``N_POINTS`` even times of the demonstration that judges, over their number, in sizes of
that demonstration, unless a docstring says otherwise.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.phase import PhaseDriven
from experiments.field.motions import HELD_OUT, IN_SAMPLE, Motion
from experiments.field.references import CURVES, Reference, nearest_velocity
from experiments.report import mean_or_inf
from latentds import Demonstration, StableDS, certify, metrics
from latentds.arguments import Array
from latentds.benchmark import Cell, RolloutProtocol
from latentds.metrics import velocity_cosine
from latentds.probes import unit_ball

N_POINTS, N_BESIDE = 500, 8
"""Of each motion, and how many starts lie around the first shown one."""
JUDGED = RolloutProtocol(N_BESIDE, n_points=N_POINTS)
PUSH, N_PUSHES = 0.1, 4
"""How far a motion is pushed off half-way, in sizes, and in how many directions."""
HELD_FOR = 0.25
"""Of the duration, about a second of handwriting: how long a motion is held still half-way."""
ARRIVED, PATIENCE = 0.02, 20.0
"""A motion has arrived when it stays within so many sizes of the goal; it is waited for so many durations."""
N_CLAIMS = 200
"""Points that a certificate's search tries."""
DRAWN_GRID, DRAWN_POINTS = 25, 60
"""Of the velocity field, per side, and of each motion, in what is kept for pictures."""
THEIR_STEP, THEIR_STEPS, THEIR_START, THEIR_REST = 0.01, 3000, 20, 0.1
"""ds-opt's simulations: seconds a step, steps at most, at which sample they begin, and the speed, in mm/s, that ends
them. The last is ours: their setting is not told with the figures that they keep."""


def measured(ds: StableDS, cell: Cell, motion: Motion, pictured: bool) -> dict[str, Any]:
    """For a cell's ``measure``: every figure that the motion's protocol has."""
    with torch.no_grad():
        figures = of_curves(motion, lambda starts, times: ds.rollout(starts, times).numpy())
        figures |= pushed_and_held(ds, motion.shown[0]) | {"us": microseconds(ds, motion)}
        figures |= of_velocities(ds, motion) if motion.protocol == HELD_OUT else {}
    return figures | (drawn(ds, motion) if pictured else {})


def referred(motion: Motion) -> list[dict[str, Any]]:
    """Rows of what learns nothing, with the figures that it has."""
    rows = []
    for label, curve in CURVES.items():
        rows.append({"method": label} | of_curves(motion, _rollout_of(curve, motion)))
    if motion.protocol == HELD_OUT:
        rows.append({"method": "nearest velocity"} | of_velocities(lambda y: nearest_velocity(motion.shown, y), motion))
    return rows


def _rollout_of(curve: Reference, motion: Motion) -> Callable[[Tensor, Tensor], Array]:
    return lambda starts, times: np.stack([curve(motion.shown, start, times) for start in starts])


# --- motions ----------------------------------------------------------------------------------------------------------

Rollout = Callable[[Tensor, Tensor], Array]
"""Starts (B, n), times (T,) -> (B, T, n)."""


def of_curves(motion: Motion, rollout: Rollout) -> dict[str, float]:
    """Distances of motions from the starts that a protocol asks for.

    * ``own``: from each shown start to its demonstration, the mean.
    * ``beside``: from ``N_BESIDE`` starts within ``STARTS_WITHIN`` of the first shown one to that demonstration, the
      mean.
    * ``unseen``: from the start of each demonstration that was kept back to that demonstration, the mean.
    * ``arrives``: of the shown starts and those beside, the share from which the motion is within ``ARRIVED`` of the
      first shown goal when it is last looked at, after ``PATIENCE`` durations. ``arrival``: when, in durations, the
      motion from the first start is there to stay; looked at 400 times.
    * ``command``: the largest speed along the motions from shown starts, from one of ``N_POINTS`` points to the next,
      over the largest along what was shown.
    * ``dtwd``: raw sum, not over points and sizes, as protocol C has it; ``dtwd_theirs``: see :func:`their_dtwd`.
    * ``rmse_a``, ``dtwd_a``, ``fd_a``: of protocol A, see :func:`path_errors`.
    """
    shown, kept_back = motion.shown, () if motion.protocol == IN_SAMPLE else motion.judges
    first = shown[0]
    beside = JUDGED.starts(first)[1:]
    owns = [moved(rollout, one.start.unsqueeze(0), one)[0] for one in shown]
    figures = {
        "own": float(np.mean([distance(path, one) for path, one in zip(owns, shown, strict=True)])),
        "beside": float(np.mean([distance(path, first) for path in moved(rollout, beside, first)])),
        "command": max(fastest(path, one.duration) for path, one in zip(owns, shown, strict=True))
        / max(fastest(JUDGED.reference(one), one.duration) for one in shown),
    }
    starts = torch.cat([torch.stack([one.start for one in shown]), beside])
    looks = torch.linspace(0, PATIENCE * first.duration, 401, dtype=torch.float64)
    left = np.linalg.norm(rollout(starts, looks) - first.goal.numpy(), axis=-1) / first.size
    away = np.flatnonzero(~(left[0] <= ARRIVED))
    figures["arrives"] = float((left[:, -1] <= ARRIVED).mean())
    figures["arrival"] = PATIENCE * float(away[-1] + 1) / 400 if len(away) and away[-1] < 400 else float("nan")
    if kept_back:
        paths = [moved(rollout, one.start.unsqueeze(0), one)[0] for one in kept_back]
        figures["unseen"] = float(np.mean([distance(p, one) for p, one in zip(paths, kept_back, strict=True)]))
        if motion.protocol == HELD_OUT:
            raw = [distance(p, one) * N_POINTS * one.size for p, one in zip(paths, kept_back, strict=True)]
            figures |= {"dtwd": float(np.mean(raw)), "dtwd_theirs": their_dtwd(rollout, kept_back)}
    if motion.protocol == IN_SAMPLE:
        paths = [rollout(one.start.unsqueeze(0), one.times)[0] for one in motion.judges]
        figures |= {f"{name}_a": value for name, value in path_errors(paths, motion.judges).items()}
    return figures


def moved(rollout: Rollout, starts: Tensor, judge: Demonstration) -> Array:
    """Motions at ``N_POINTS`` even times of that demonstration's duration: (B, n) -> (B, N, n)."""
    return rollout(starts, JUDGED.times(judge))


def distance(path: Array, judge: Demonstration) -> float:
    """From a motion as :func:`moved` gives it; inf where the motion was lost."""
    return mean_or_inf(np.array([metrics.dtw(path, JUDGED.reference(judge)) / N_POINTS / judge.size]))


def fastest(path: Array, duration: float) -> float:
    """The largest speed along a path at even times."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).max()) * (len(path) - 1) / duration


def their_dtwd(rollout: Rollout, kept_back: Sequence[Demonstration]) -> float:
    """DTWD by ds-opt's rule, mm: raw sum of exact DTW between a motion and all samples of a demonstration, the mean.

    The motion begins at sample ``THEIR_START`` and goes on in steps of ``THEIR_STEP`` until it rests, for
    ``THEIR_STEPS`` at most, so that each step on which it lingers counts.
    """
    sums = []
    times = THEIR_STEP * torch.arange(THEIR_STEPS, dtype=torch.float64)
    for one in kept_back:
        path = rollout(one.positions[min(THEIR_START, len(one)) - 1].unsqueeze(0), times)[0]
        speeds = np.linalg.norm(np.diff(path, axis=0), axis=1) / THEIR_STEP
        moving = np.flatnonzero(~(speeds < THEIR_REST))
        sums.append(metrics.dtw(path[: moving[-1] + 2 if len(moving) else 1], one.positions))
    return mean_or_inf(np.array(sums))


def path_errors(paths: Sequence[Any], judges: Sequence[Demonstration]) -> dict[str, float]:
    """How far paths are from as many demonstrations, step k from sample k, in the mean over them.

    ``rmse``: root of the mean over points and coordinates; ``dtwd``: exact DTW over the number of points; ``fd``:
    discrete Fréchet distance.
    """
    each = [
        (np.sqrt(metrics.mse(path, y)), metrics.dtw(path, y) / len(y), metrics.frechet(path, y))
        for path, y in zip(paths, (one.positions for one in judges), strict=True)
    ]
    return dict(zip(("rmse", "dtwd", "fd"), np.mean(each, axis=0).tolist(), strict=True))


# --- fields -----------------------------------------------------------------------------------------------------------


def of_velocities(field: Callable[[Tensor], Tensor], motion: Motion) -> dict[str, float]:
    """``test_rmse``, ``test_e``: the :func:`velocity_errors` at the samples that were kept back."""
    return {f"test_{name}": value for name, value in velocity_errors(field, motion.judges).items()}


def velocity_errors(ds: Callable[[Tensor], Tensor], demonstrations: Sequence[Demonstration]) -> dict[str, float]:
    """How far off the velocities are at all samples of some demonstrations together, as ds-opt counts.

    ``rmse``: mean over samples of the root of the mean over coordinates of the squared error, units per second; ``e``:
    mean of 1 - cos of the angle, samples at rest left out.
    """
    positions, shown = (
        torch.cat([d.positions for d in demonstrations]),
        torch.cat([d.velocities for d in demonstrations]),
    )
    with torch.no_grad():
        velocities = ds(positions)
    missed, cosine = (velocities - shown).numpy(), velocity_cosine(velocities, shown)
    return {"rmse": float(np.sqrt(np.square(missed).mean(axis=1)).mean()), "e": 1 - cosine}


def pushed_and_held(ds: StableDS, shown: Demonstration) -> dict[str, float]:
    """What becomes of the second half of a demonstration when the motion is disturbed half-way.

    * ``pushed``: it is at a point ``PUSH`` off in each of ``N_PUSHES`` directions; distance of the rest of the motion
      to the second half of the demonstration, the mean.
    * ``held``: it is held still for ``HELD_FOR``, released, and given the time that it had left. A field goes on where
      it was; a clock ran on.
    """
    half = shown.duration / 2
    there = ds.rollout(shown.start, torch.tensor([0.0, half], dtype=torch.float64))[-1]
    ball = unit_ball(N_PUSHES, shown.dim, np.random.default_rng(1))
    directions = torch.from_numpy(ball / np.linalg.norm(ball, axis=1, keepdims=True))
    places = torch.cat([there + PUSH * shown.size * directions, there.unsqueeze(0)])
    times = torch.linspace(0, half, N_POINTS // 2, dtype=torch.float64)
    rest = shown.at((half + times).numpy())

    def mean(paths: Tensor) -> float:
        return mean_or_inf(np.array([metrics.dtw(path.numpy(), rest) for path in paths])) / len(times) / shown.size

    if isinstance(ds, PhaseDriven):
        pushed = ds.resume(places[:-1], half, half + times)
        late = half + HELD_FOR * shown.duration
        held = ds.resume(there, late, late + times, at_rest=True).unsqueeze(0)
    else:
        pushed, held = ds.rollout(places, times).split([N_PUSHES, 1])
    return {"pushed": mean(pushed), "held": mean(held)}


def microseconds(ds: StableDS, motion: Motion) -> float:
    """``us``: median time of one velocity at one point, µs."""
    point, spent = motion.shown[0].positions[len(motion.shown[0]) // 3], []
    for _ in range(30):
        began = time.perf_counter()
        ds(point)
        spent.append(time.perf_counter() - began)
    return 1e6 * float(np.median(spent))


# --- pictures ---------------------------------------------------------------------------------------------------------


def drawn(ds: StableDS, motion: Motion) -> dict[str, Any]:
    """``claims``: verdicts of its certificate; ``drawn``: of planar motions what a picture needs, as JSON."""
    lines = certify(ds, n_samples=N_CLAIMS).lines
    counts = [sum(line.verdict == verdict for line in lines) for verdict in ("proven", "not falsified", "falsified")]
    told: dict[str, Any] = {"claims": " / ".join(map(str, counts))}
    if ds.dim == 2:
        grid = np.stack(np.meshgrid(*window(motion)), axis=-1)
        starts = torch.stack([one.start for one in (*motion.shown, *motion.judges)])
        times = torch.linspace(0, 1.5 * motion.shown[0].duration, DRAWN_POINTS, dtype=torch.float64)
        with torch.no_grad():
            field, paths = ds(torch.from_numpy(grid)).numpy(), ds.rollout(starts, times).numpy()
        digits = 4 - int(np.ceil(np.log10(motion.shown[0].size)))
        told["drawn"] = json.dumps({"field": _rounded(field, digits), "paths": _rounded(paths, digits)})
    return told


def window(motion: Motion) -> tuple[Array, Array]:
    """The grid's coordinates along both axes: a square around what was shown and kept back."""
    every = torch.cat([one.positions for one in (*motion.shown, *motion.judges)]).numpy()
    middle, reach = (every.max(0) + every.min(0)) / 2, 0.65 * np.ptp(every, axis=0).max()
    x, y = (np.linspace(at - reach, at + reach, DRAWN_GRID) for at in middle)
    return x, y


def _rounded(values: Array, digits: int) -> list[Any]:
    return np.where(np.isfinite(values), values, 0.0).round(digits).tolist()
