"""Velocities beside the path: a few wide layers after a match bring them nearer to those that were shown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ..arguments import Array
from ..curves import interpolated
from ..dynamics import TubeDynamics
from ..time_law import BEGINS_WITHIN, KnottedLaw
from ..translations import Layers, LocallyWeightedTranslations
from .lbfgs import minimize

WIDE_LAYERS, WIDTH = 20, 0.4
"""How many layers are added, and 1/ρ of each at first, in sizes of the motion: what is wider than the differences
between demonstrations cannot learn one of them by heart, as the narrow layers of the match do."""
STEPS = 60
"""Of L-BFGS."""
SHARE_OF_DIRECTION = 0.5
"""What 1 - cos of the angle between velocities counts, beside their distance in root mean square speeds."""
KEPT_SMALL, KEPT_SMOOTH = 1e-2, 1e-2
"""What squared strengths and changes of log ρ count; and squared bends of the logarithm of the time law."""
SHARES = 1.0, 0.5, 0.25
"""Of what was learned, that are tried one after the other."""
AT_REST = 0.03
"""Share of the root mean square speed below which directions count for little, and distances by their squares."""


class Shown(NamedTuple):
    """Velocities at points of demonstrations."""

    points: Tensor
    """(m, n)"""
    velocities: Tensor
    """(m, n)"""

    @classmethod
    def of(cls, strands: Array, arrivals: Array, n_times: int) -> Shown:
        """Of demonstrations (K, N, n) with their times (K, N), ``n_times`` samples of each, even in time."""
        points, velocities = [], []
        for strand, arrival in zip(strands, arrivals, strict=True):
            times = np.linspace(0, arrival[-1], 4 * n_times)
            path = interpolated(times, arrival, strand)
            begun = np.interp(times, arrival, np.linspace(0, 1, len(strand)))[::4] > BEGINS_WITHIN
            points.append(path[::4][begun])
            velocities.append(np.gradient(path, times, axis=0)[::4][begun])
        return cls(torch.from_numpy(np.concatenate(points)), torch.from_numpy(np.concatenate(velocities)))


class Fitted(Protocol):
    """The system that is fitted: a tube whose ψ is made of translations."""

    diffeomorphism: LocallyWeightedTranslations
    dynamics: TubeDynamics

    def __call__(self, y: Tensor) -> Tensor:
        """ẏ at y: (..., n) -> (..., n)."""


def with_wide_layers(layers: Layers, shown: Shown, size: float) -> Layers:
    """Layers, and ``WIDE_LAYERS`` after them that do nothing yet, about points far from one another."""
    points = shown.points.numpy()
    chosen, away = [0], np.full(len(points), np.inf)
    for _ in range(min(WIDE_LAYERS, len(points)) - 1):
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(away.argmax()))
    centers, widths = points[chosen], np.full(len(chosen), 1 / (WIDTH * size))
    wide = centers, np.zeros_like(centers), widths
    return Layers(*(np.concatenate(parts) for parts in zip(layers, wide, strict=True)))


def learned(ds: Fitted, shown: Shown, n_wide: int) -> Iterator[tuple[Layers, KnottedLaw]]:
    """Layers and time law that bring a system nearer to velocities shown: by all that can be learned, then by less.

    Its last ``n_wide`` layers and its time law are moved, by L-BFGS and in place; the others stay.
    """
    psi, given = ds.diffeomorphism, ds.dynamics.law
    assert isinstance(given, KnottedLaw)
    # Candidates share the law that was given, and inference mode may have made it.
    law = ds.dynamics.law = KnottedLaw(given.knots.clone(), given.speeds.clone())
    first, start = law.speeds.log(), psi.log_widths.detach().clone()
    scale = shown.velocities.square().sum(1).mean().sqrt()
    wanted = shown.velocities / scale
    moved = [psi.centers, psi.log_widths, psi.strengths]
    sizes = [*(part[-n_wide:].numel() for part in moved), len(first)]

    def loss(flat: Array) -> tuple[float, Array]:
        *parts, log_speeds = torch.split(torch.from_numpy(flat), sizes)
        with torch.no_grad():
            for parameter, part in zip(moved, parts, strict=True):
                parameter[-n_wide:] = part.view_as(parameter[-n_wide:])
        with torch.enable_grad():
            law.speeds = log_speeds.requires_grad_().exp()
            velocities = ds(shown.points) / scale
            distance = (velocities - wanted).square().sum(1)
            norms = (velocities.square().sum(1) + AT_REST**2) * (wanted.square().sum(1) + AT_REST**2)
            value = (distance + AT_REST**2).sqrt().mean()
            value = value + SHARE_OF_DIRECTION * (1 - (velocities * wanted).sum(1) / norms.sqrt()).mean()
            change = psi.strengths[-n_wide:].square().sum() + (psi.log_widths - start).square().sum()
            value = value + KEPT_SMALL * change + KEPT_SMOOTH * (log_speeds - first).diff().diff().square().sum()
            *slopes, of_speeds = torch.autograd.grad(value, [*moved, log_speeds])
        gradient = torch.cat([*(slope[-n_wide:].flatten() for slope in slopes), of_speeds])
        return float(value.detach()), gradient.numpy()

    flat = torch.cat([*(parameter.detach()[-n_wide:].flatten() for parameter in moved), first])
    best = minimize(loss, flat.numpy(), steps=STEPS).at
    loss(best)
    log_speeds = torch.from_numpy(best[-len(first) :])
    strengths = psi.strengths.detach().clone()
    with torch.no_grad():
        for share in SHARES:
            psi.strengths[-n_wide:] = share * strengths[-n_wide:]
            parts = (part.detach().numpy().copy() for part in (psi.centers, psi.directions, psi.widths))
            speeds = (first + share * (log_speeds - first)).exp()
            yield Layers(*parts), KnottedLaw(law.knots, speeds)
