"""A fitted system learns what nobody showed it: to pass a point on its way, and to keep out of a sphere."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from experiments.report import plain
from experiments.training.loop import Learned, Loop, solid
from latentds import Demonstration, StableDS, TubeDS, certify, datasets, plotting

BALL = 0.1
"""Radius of the ball around the demonstrated start in which motions begin, where the motion winds on a unit sphere."""
CENTRE, RADIUS = (-0.83, -0.18, 0.51), 0.2
"""The sphere to keep out of; the demonstration runs through it."""
VIA = (1.06, -0.17, -0.54)
"""The point to pass, 0.2 from the demonstration."""
MARGIN = 0.02
"""Kept from the sphere in training, for starts that were not drawn and what lies between two times."""
TETHER = 0.1
"""Weight of the mean squared distance from the fitted system's motion: what nothing speaks against stays as it was."""


def learn(quick: bool, seed: int, folder: Path) -> Learned:
    shown = datasets.unstable_spiral(3)
    fitted = TubeDS(shown.dim, n_layers=60 if quick else 150, refined=not quick).fit(shown).requires_grad_(False)
    ds = copy.deepcopy(fitted).requires_grad_(True)
    times = torch.linspace(0, shown.duration, 200)

    def loss(draw: torch.Generator) -> Tensor:
        y0 = starts(shown, 8, draw)
        path = ds.rollout(y0, times)
        inside = (MARGIN - clearance(path)).clamp(min=0)
        strayed = path - fitted.rollout(y0, times)
        passed = miss(path).square().mean()
        return 10 * passed + inside.square().sum(-1).mean() + TETHER * strayed.square().sum(-1).mean()

    history = Loop("via-point", 150 if quick else 600, 1e-2, seed, folder / "checkpoint.pt").run(ds, loss)
    ds.save(folder / "system.safetensors")

    held_out = torch.cat([shown.start.unsqueeze(0), starts(shown, 100, torch.Generator().manual_seed(seed + 1))])
    before, after = (motions(system, held_out, shown) for system in (fitted, ds))
    certificate = certify(ds)
    numbers = {
        "largest distance from the via-point, fitted": float(miss(before).max()),
        "largest distance from the via-point, trained": float(miss(after).max()),
        "least clearance of the sphere, fitted": float(clearance(before).min()),
        "least clearance of the sphere, trained": float(clearance(after).min()),
        "distance of the attractor from the goal": float((ds.attractor - shown.goal).abs().max()),
        "claims of the certificate that are false": len(certificate.falsified),
    }
    notes = f"Over {len(held_out)} motions, most from starts that were not trained on. The certificate after training:"
    return Learned(history, numbers, f"{notes}\n\n```\n{certificate}\n```", draw_paths(shown, before, after))


def starts(shown: Demonstration, count: int, draw: torch.Generator) -> Tensor:
    """Uniform in the ball around the demonstrated start: (count, n)."""
    away = torch.randn(count, shown.dim, generator=draw, dtype=torch.float64)
    share = torch.rand(count, 1, generator=draw, dtype=torch.float64) ** (1 / shown.dim)
    return shown.start + BALL * share * torch.nn.functional.normalize(away, dim=-1)


def motions(ds: StableDS, y0: Tensor, shown: Demonstration) -> Tensor:
    """At ten times as many times as in training: (B, n) -> (B, T, n)."""
    with torch.no_grad():
        return ds.rollout(y0, torch.linspace(0, shown.duration, 2000))


def distance_from_via(path: Tensor) -> Tensor:
    """(B, T, n) -> (B, T)."""
    return torch.linalg.vector_norm(path - torch.tensor(VIA).to(path), dim=-1)


def miss(path: Tensor) -> Tensor:
    """Distance of motions from the via-point, where they come nearest: (B, T, n) -> (B,)."""
    return distance_from_via(path).amin(-1)


def clearance(path: Tensor) -> Tensor:
    """Distance from the sphere, below 0 inside: (B, T, n) -> (B, T)."""
    return torch.linalg.vector_norm(path - torch.tensor(CENTRE).to(path), dim=-1) - RADIUS


def draw_paths(shown: Demonstration, before: Tensor, after: Tensor) -> Figure:
    """The motions in space, and their distances from point and sphere."""
    old, new, many = "#0072B2", "#D55E00", 21
    figure = Figure(figsize=(9.6, 4.6), dpi=plotting.DPI, layout="constrained")
    panels = figure.add_gridspec(2, 2, width_ratios=(1.15, 1))
    space = figure.add_subplot(panels[:, 0], projection="3d")
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 40), np.linspace(-np.pi / 2, np.pi / 2, 20))
    unit = (np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height))
    space.plot_surface(*(c + RADIUS * u for c, u in zip(CENTRE, unit, strict=True)), color="#999999", alpha=0.35)
    for paths, color, label in ((before, old, "fitted"), (after, new, "trained")):
        for i, path in enumerate(paths[:many]):
            space.plot(*path.T, color=color, lw=0.8, alpha=0.6, label="" if i else label)
    space.plot(*shown.positions.T, "--", color=plotting.SHOWN, lw=1, label="demonstration")
    space.plot(*VIA, "D", color="#009E73", mec=plotting.SHOWN, ms=7, label="via-point", zorder=9)
    space.plot(*shown.goal, "*", color="#E69F00", mec=plotting.SHOWN, ms=12, label="goal")
    solid(space, -115)
    seconds = np.linspace(0, shown.duration, before.shape[1])
    panes = (("distance from the sphere", clearance), ("distance from the via-point", distance_from_via))
    for row, (title, distance) in enumerate(panes):
        axes = figure.add_subplot(panels[row, 1])
        for paths, color in ((before, old), (after, new)):
            axes.plot(seconds, distance(paths[:many]).T, color=color, lw=0.8, alpha=0.6)
        axes.axhline(0, color=plotting.SHOWN, lw=0.8)
        axes.set(title=title, xlim=(0, seconds[-1]), xlabel="seconds" if row else "")
        plain(axes)
        if not row:
            axes.axhspan(-RADIUS, 0, color="#999999", alpha=0.35, lw=0)
            axes.set_ylim(bottom=-RADIUS)
    figure.legend(*space.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure
