"""A diffeomorphism learns where motions start: a density on a ring segment, which no Gaussian fits."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal, Normal, TransformedDistribution

from experiments.report import plain
from experiments.training.loop import Learned, Loop
from latentds import LocallyWeightedTranslations, as_transform, plotting

REACH, SPREAD, SPAN = 0.6, 0.05, math.radians(240)
"""Hands start around a table: radius and its standard deviation in m, and the angle of the ring that they take."""


def learn(quick: bool, seed: int, folder: Path) -> Learned:
    draw = torch.Generator().manual_seed(seed)
    seen, held_out = starts(1000, draw), starts(4000, draw)
    gaussian = MultivariateNormal(seen.mean(0), seen.T.cov())
    psi = spread_out(16 if quick else 48, seen, draw)
    density = TransformedDistribution(gaussian, as_transform(psi))

    def loss(draw: torch.Generator) -> Tensor:
        return -density.log_prob(seen[torch.randperm(len(seen), generator=draw)[:250]]).mean()

    history = Loop("density", 100 if quick else 800, 2e-2, seed, folder / "checkpoint.pt").run(psi, loss)
    with torch.no_grad():
        numbers = {
            "held-out log-likelihood, fitted Gaussian": float(gaussian.log_prob(held_out).mean()),
            "held-out log-likelihood, learned density": float(density.log_prob(held_out).mean()),
            "held-out log-likelihood, the true density": float(true_log_prob(held_out).mean()),
            "learned density, log-likelihood of what it was shown": float(density.log_prob(seen).mean()),
            "integral of the learned density": integral(density),
        }
    notes = f"Nats per start; {len(seen)} shown, {len(held_out)} held out."
    return Learned(history, numbers, notes, draw_densities(gaussian, density, held_out))


def starts(count: int, draw: torch.Generator) -> Tensor:
    """Made-up starts, (count, 2) m."""
    angle = SPAN * (torch.rand(count, generator=draw, dtype=torch.float64) - 0.5)
    radius = REACH + SPREAD * torch.randn(count, generator=draw, dtype=torch.float64)
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1)


def true_log_prob(y: Tensor) -> Tensor:
    """Of what :func:`starts` draws, by the change to polar coordinates: (..., 2) -> (...)."""
    radius = torch.linalg.vector_norm(y, dim=-1)
    return Normal(REACH, SPREAD).log_prob(radius) - math.log(SPAN) - radius.log()


def spread_out(n_layers: int, points: Tensor, draw: torch.Generator) -> LocallyWeightedTranslations:
    """Almost the identity, its layers where points are: with strengths of exactly 0 no centre would have a gradient."""
    psi = LocallyWeightedTranslations(points.shape[-1], n_layers)
    with torch.no_grad():
        psi.centers.copy_(points[torch.randperm(len(points), generator=draw)[:n_layers]])
        psi.log_widths.fill_(-points.std().log())
        psi.strengths.copy_(1e-2 * torch.randn(psi.strengths.shape, generator=draw, dtype=torch.float64))
    return psi


def grid(side: int = 400) -> tuple[Tensor, float]:
    """Points of a square that holds all the starts, (side, side, 2), and the area of each."""
    line = torch.linspace(-2, 2, side, dtype=torch.float64)
    return torch.stack(torch.meshgrid(line, line, indexing="xy"), -1), float(line[1] - line[0]) ** 2


def integral(density: Distribution) -> float:
    points, area = grid()
    return float(density.log_prob(points).exp().sum()) * area


def draw_densities(gaussian: Distribution, density: Distribution, points: Tensor) -> Figure:
    """Both densities as shades with the held-out starts over them."""
    where, _ = grid()
    figure = Figure(figsize=(8.6, 4.4), dpi=plotting.DPI, layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    with torch.no_grad():
        shades = [p.log_prob(where).exp() for p in (gaussian, density)]
    for axes, shade, title in zip(panels, shades, ("fitted Gaussian", "learned density"), strict=True):
        image = axes.pcolormesh(
            *where.numpy().transpose(2, 0, 1), shade.numpy(), cmap="cividis", vmin=0, vmax=float(shades[1].max())
        )
        axes.plot(*points[:400].T.numpy(), ".", color="white", ms=1.5, alpha=0.7)
        axes.set(title=title, xlabel="x [m]", xlim=(-0.9, 0.9), ylim=(-0.9, 0.9))
        axes.set_aspect("equal")
        plain(axes)
        axes.grid(False)
    panels[0].set_ylabel("y [m]")
    figure.colorbar(image, ax=panels, label="density [1/m²]")
    return figure
