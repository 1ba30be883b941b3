"""What is tried on a system by more than one judge: by fidelity after each fit, by the certificate, by the contract.

Each returns a figure; what it may be is for the judge to say.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy
import torch
from torch import Tensor

from .arguments import Array

MOST_POINTS = 16_000
"""Of a motion along which the velocity field is integrated."""


class Moving(Protocol):
    """A velocity field with its motions: any :class:`~latentds.StableDS`."""

    attractor: Tensor

    def __call__(self, y: Tensor) -> Tensor: ...

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor: ...


class Latent(Protocol):
    """A system with a latent space: any :class:`~latentds.LatentDS`."""

    def encode(self, y: Tensor) -> Tensor: ...

    def decode(self, x: Tensor) -> Tensor: ...


def unit_ball(count: int, dim: int, draw: np.random.Generator) -> Array:
    """Points evenly distributed in the unit ball of R^n: (count, n)."""
    # The first n coordinates of a uniform point on the sphere of R^(n+2) are uniform in the ball of R^n.
    normal = draw.standard_normal((count, dim + 2))
    return np.asarray((normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, :dim])


def restart_gap(ds: Moving, motions: Tensor, times: Tensor) -> Tensor:
    """Largest distance of motions from the same ones begun anew half-way, 0 for a flow: (..., T, n), (T,) -> (...)."""
    middle = len(times) // 2
    anew = ds.rollout(motions[..., middle, :], times[middle:])
    gaps: Tensor = torch.linalg.vector_norm(anew - motions[..., middle:, :], dim=-1).amax(-1)
    return gaps


@torch.no_grad()
def flow_gap(ds: Moving, y0: Tensor, times: Tensor, enough: float) -> Tensor:
    """How far motions are from the integral of the velocity field along them: (..., n), (T,) evenly spaced -> (...).

    0 for the field's own flow but for Simpson's rule, at 4, 16, then 64 points a step until a motion is below
    ``enough`` or finer points no longer help it: a map with narrow layers makes velocities that change within a step.
    Nothing is solved, so that stiff fields cost no more.
    """
    starts = y0.reshape(-1, y0.shape[-1])
    every, unsettled = torch.zeros_like(starts[:, 0]), torch.arange(len(starts), device=starts.device)
    before = None
    for finer in (4, 16, 64):
        if before is not None and finer * len(times) > MOST_POINTS:
            break
        clock = torch.linspace(0, float(times[-1] - times[0]), finer * (len(times) - 1) + 1, dtype=times.dtype)
        motions = ds.rollout(starts[unsettled], clock.to(times))
        passed = scipy.integrate.cumulative_simpson(
            ds(motions).double().cpu().numpy(), x=clock.numpy(), axis=-2, initial=0
        )
        missed = motions - motions[..., :1, :] - torch.from_numpy(passed).to(motions)
        gaps: Tensor = torch.linalg.vector_norm(missed, dim=-1).amax(-1)
        # What the rule misses at a kink is at most a quarter of what it missed at a quarter of the points.
        left = gaps if before is None else torch.minimum(gaps, (4 * gaps - before) / 3).clamp(min=0)
        every[unsettled] = left
        settled = left <= enough if before is None else (left <= enough) | (gaps > before / 2)
        before, unsettled = gaps[~settled], unsettled[~settled]
        if not len(unsettled):
            break
    return every.reshape(y0.shape[:-1])


def round_trip_gap(ds: Latent, y: Tensor) -> Tensor:
    """‖decode(encode(y)) - y‖: (..., n) -> (...)."""
    gaps: Tensor = torch.linalg.vector_norm(ds.decode(ds.encode(y)) - y, dim=-1)
    return gaps
