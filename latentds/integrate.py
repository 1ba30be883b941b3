"""The motion of a velocity field that has no closed-form flow: Runge–Kutta steps, adapted for each row by itself.

Dormand and Prince's pair of orders 5 and 4 with Shampine's interpolant of order 4, by the coefficients that
scipy.integrate.RK45 carries; step sizes by a proportional-integral rule (Hairer, Nørsett, Wanner: Solving Ordinary
Differential Equations I, section II.4, and II, section IV.2).

Why no library does it: torchdiffeq 0.2.5 takes one step size for the whole batch, so that rows depend on each other,
fails for all rows when one becomes NaN, and refuses times that repeat. torchode 1.0.1 steps each row by itself, but a
row that fails ends the solve for all, with uninitialised memory in their answers; its absolute tolerance is one number
for every row; and it needs torchtyping, which is retired and pins an old typeguard. Neither rests at the attractor.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from functools import cache, reduce
from typing import NamedTuple

import scipy
import torch
from torch import Tensor

from .arguments import refuse_tracing


class _Pair(NamedTuple):
    """Coefficients of the pair, read when a field is first integrated: they cost a quarter of a second to import."""

    stages: list[list[float]]
    """the last is the step's end"""
    error: list[float]
    interpolant: Tensor
    """the slopes' weights, by falling powers of the share of the step"""


@cache
def _pair() -> _Pair:
    rk = scipy.integrate.RK45
    stages = [*(rk.A[stage, :stage].tolist() for stage in range(1, 6)), rk.B.tolist()]
    return _Pair(stages, rk.E.tolist(), torch.from_numpy(rk.P.T[::-1].copy()))


def integrate(
    velocity: Callable[[Tensor], Tensor], y0: Tensor, times: Tensor, attractor: Tensor, *, max_steps: int = 10_000
) -> Tensor:
    """The integral curves of ``velocity`` from ``y0``; differentiable by ``y0`` and by what ``velocity`` is made of.

    The error of a step, in its worst coordinate, stays below a tolerance: 1e-9 (float32: 1.2e-5, 100 roundings) of the
    distance to the attractor, at the start or now, whichever is larger, plus 16 roundings of the attractor's largest
    coordinate. A row that is nearer to the attractor than ten tolerances has arrived and stays where it is: V does not
    rise, a long time costs no steps, and a field that keeps its speed up to the attractor does not make it jump to and
    fro across it. The steps of a row depend neither on the times asked for, which are interpolated, nor on the other
    rows. No gradient goes through the choice of steps.

    Args:
        velocity: (m, n) -> (m, n), row by row, units per second. It is not asked about rows that have arrived.
        y0: (..., n), floating.
        times: (T,) seconds since the start, the first 0, not decreasing.
        attractor: (n,), where the velocity is 0.
        max_steps: tried for each row, >= 1; none is longer than about three of the field's shortest time constants.

    Returns:
        (..., T, n). A row that cannot go on is NaN from there on, and a RuntimeWarning says so: its velocity is not
        finite or jumps, or ``max_steps`` were not enough, as in a stiff field. A start that is not finite is just NaN.
    """
    refuse_tracing("this rollout")
    clock = times.to(torch.float64).contiguous()
    rounding = torch.finfo(y0.dtype).eps
    floor = 16 * rounding * attractor.detach().abs().amax() + torch.finfo(y0.dtype).tiny
    values: list[Tensor] = []
    places: list[Tensor] = []
    lost: list[str] = []

    def answer(row: Tensor, time: Tensor, value: Tensor) -> None:
        values.append(value)
        places.append(rows[row] * len(clock) + time)

    y = y0.reshape(-1, y0.shape[-1])
    size = (y - attractor).detach().abs().amax(-1)
    rows, t = torch.arange(len(y), device=y.device), clock.new_zeros(len(y))
    slope, h, error_before = torch.zeros_like(y), torch.full_like(t, torch.inf), torch.ones_like(t)
    answered, tracked = torch.searchsorted(clock, t, right=True), False
    row, time = _due(torch.zeros_like(answered), answered)
    answer(row, time, y[row])
    for step in range(max_steps + 1):
        distance = (y - attractor).detach().abs().amax(-1)
        tolerance = max(1e-9, 100 * rounding) * torch.maximum(size, distance) + floor
        done = (answered == len(clock)) | (distance < 10 * tolerance)
        failed = ~done & (~(t + h > t) | ~distance.isfinite() | (step == max_steps))
        stays = ~(done | failed)
        if not stays.all():
            reason = f"{max_steps} steps were not enough" if step == max_steps else "no step was short enough"
            for i in (failed & size.isfinite()).nonzero()[:, 0].tolist():
                lost.append(f"row {int(rows[i])} at {float(t[i]):.6g} s, y = {y[i].tolist()}: {reason}")
            row, time = _due(answered, torch.where(stays, answered, len(clock)))
            answer(row, time, torch.where(failed[row, None], torch.nan, y[row]))
            state = (rows, y, slope, t, h, error_before, size, answered, distance, tolerance)
            rows, y, slope, t, h, error_before, size, answered, distance, tolerance = (part[stays] for part in state)
        if not len(rows):
            break
        if step == 0:
            slope = velocity(y)
            tracked = torch.is_grad_enabled() and (y.requires_grad or slope.requires_grad)
            h = (0.01 * distance / slope.detach().abs().amax(-1)).to(t).nan_to_num(0.0, posinf=float(clock[-1]))
        with torch.no_grad():
            end, slopes = _step(velocity, y, slope, h)
            error = h * _sum(_pair().error, slopes).detach().abs().amax(-1) / tolerance
        error = error.nan_to_num(torch.inf)
        accepted = error <= 1
        if tracked:  # once more, as a graph without rejected steps: one that is not finite would spoil every gradient
            end, slopes = _step(velocity, y, velocity(y), torch.where(accepted, h, 0.0))
        until = torch.searchsorted(clock, torch.where(accepted, t + h, t), right=True)
        row, time = _due(answered, until)
        if len(row):
            answer(row, time, y[row] + _moved(h[row], (clock[time] - t[row]) / h[row], [k[row] for k in slopes]))
        y, slope = torch.where(accepted[:, None], end, y), torch.where(accepted[:, None], slopes[-1], slope)
        t, answered = torch.where(accepted, t + h, t), until
        factor = (0.9 * error**-0.17 * error_before**0.04).clamp(0.2, 10.0)
        h = h * torch.where(accepted, factor, factor.clamp(max=0.9))
        error_before = torch.where(accepted, error.clamp(min=1e-4), error_before)
    if lost:
        warnings.warn(
            f"{len(lost)} of {y0[..., 0].numel()} motions could not go on and are NaN from there, as in a field "
            f"that is stiff, that jumps or that is not finite everywhere; the first is {lost[0]}",
            RuntimeWarning,
            stacklevel=3,
        )
    order = torch.cat(places).argsort()
    return torch.cat(values)[order].reshape(*y0.shape[:-1], len(clock), y0.shape[-1])


def _step(velocity: Callable[[Tensor], Tensor], y: Tensor, slope: Tensor, h: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The state h (m,) seconds after y (m, n), where the velocity is ``slope``, and the seven slopes of that step."""
    slopes, end = [slope], y
    for weights in _pair().stages:
        end = y + h[:, None].to(y.dtype) * _sum(weights, slopes)
        slopes.append(velocity(end))
    return end, slopes


def _moved(h: Tensor, share: Tensor, slopes: list[Tensor]) -> Tensor:
    """How far the state has come (m, n) after a share in (0, 1] of a step of h seconds, both (m,)."""
    weights = torch.zeros((), dtype=h.dtype)
    for coefficients in _pair().interpolant.to(h):
        weights = (weights + coefficients) * share[:, None]
    return _sum((weights * h[:, None]).to(slopes[0]).T[..., None], slopes)


def _sum(weights: Iterable[float] | Tensor, slopes: list[Tensor]) -> Tensor:
    """Term by term, so that a row's sum is rounded alike in every batch."""
    total: Tensor = reduce(torch.add, (w * k for w, k in zip(weights, slopes, strict=True)))
    return total


def _due(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Row and time index of every answer due, where row i is due at times first[i] to last[i] - 1."""
    row = torch.repeat_interleave(last - first)
    return row, torch.arange(len(row), device=row.device) - (last - first).cumsum(0)[row] + last[row]
