"""The paper's picture of its framework, from a demonstration to the mapped points; what has no numbers is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from experiments.compared import greedy
from experiments.paper.document import DPI, GOAL, NO_NUMBERS, Document
from experiments.paper.study import Study
from experiments.published import TABLE_ONE
from latentds import ChebyshevDS, Demonstration, LatentDS, datasets
from latentds.fitting.embedding import chebyshev_columns
from latentds.plotting import SHOWN, color_of


def framework(_: Study, document: Document) -> None:
    shown = datasets.unstable_spiral(7)
    ds = greedy("Chebyshev", TABLE_ONE["Chebyshev"][shown.name])(3).fit(shown)
    caption = "The paper's framework: from a demonstration to the mapped points"
    document.show("framework", draw_framework(shown, ds), caption)
    simulated = "drawn [on a simulated arm](robot.md), with made-up kinesthetic motions"
    for what in ("Light paintings, robot runs", "End-effector paths of the kinesthetic cases"):
        document.find(what, "figure", simulated, NO_NUMBERS)


def draw_framework(shown: Demonstration, ds: LatentDS, n_nodes: int = 12) -> Figure:
    """From a 3-D demonstration by K = 4 copies, their graph and the latent points to the mapped points."""
    points = shown.positions.numpy()
    columns, latent = chebyshev_columns(len(shown), 3)[::-1], ChebyshevDS.latent_line(shown)
    with torch.no_grad():
        mapped = ds.decode(torch.from_numpy(latent)).numpy()
    figure = Figure(figsize=(13, 8), dpi=DPI, layout="constrained")
    solid = {"projection": "3d"}
    axes = figure.add_subplot(2, 3, 1, **solid)
    axes.plot(*points.T, color=SHOWN, lw=1)
    axes.plot(*points[-1:].T, **GOAL)
    axes.set_title(f"(a) demonstration, {shown.name}")
    axes = figure.add_subplot(2, 3, 2, **solid)
    for copy in range(4):
        axes.plot(*(points + np.array([0, 0, 2.4 * copy])).T, lw=0.8, color=f"C{copy}", label=f"copy {copy + 1}")
    axes.set_title("(b) K = 4 copies (drawn apart)")
    axes.legend(fontsize=8, loc="upper left", frameon=False, ncols=2)
    axes = figure.add_subplot(2, 3, 3)
    draw_graph(axes, 4, n_nodes)
    axes.set_title(f"(c) their graph ({n_nodes} of {len(shown)} nodes a path)")
    for place, title, cloud in (
        (4, "(d) latent points: eigenvector entries", columns),
        (5, "(e) laid from start to goal", latent),
        (6, f"(f) mapped by ψ, MSE {np.square(mapped - points).mean():.1e}", mapped),
    ):
        axes = figure.add_subplot(2, 3, place, **solid)
        dots = cloud[:: max(1, len(cloud) // 120)] if place < 6 else cloud
        axes.plot(*dots.T, ".", ms=4 if place < 6 else 2, color=color_of("Chebyshev"))
        if place > 4:
            axes.plot(*points.T, color=SHOWN, lw=0.6, ls="--", alpha=0.6)
        axes.plot(*cloud[-1:].T, **GOAL)
        axes.set_title(title)
    for axes in figure.axes:
        axes.tick_params(labelsize=7)
        if isinstance(axes, Axes3D):
            axes.view_init(elev=20, azim=-60)
    return figure


def draw_graph(axes: Any, copies: int, n_nodes: int) -> None:
    """The copies as paths of ``n_nodes``, their last nodes in a cycle."""
    angles = np.pi / 4 + 2 * np.pi * np.arange(copies) / copies
    ends = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = np.concatenate([ends, ends[:1]])
    axes.plot(*ring.T, color=SHOWN, lw=1.2, zorder=1)
    for copy, end in enumerate(ends):
        path = end * np.linspace(3, 1, n_nodes)[:, None]
        axes.plot(*path.T, "-o", color=f"C{copy}", ms=5, lw=1.2)
        axes.annotate(f"$\\nu_1^{copy + 1}$", path[0], xytext=14 * end - 6, textcoords="offset points", fontsize=11)
    axes.plot(*ends.T, **GOAL)
    axes.text(0, 0, "cycle of the\nlast nodes", ha="center", va="center", fontsize=9)
    axes.set_aspect("equal")
    axes.axis("off")
