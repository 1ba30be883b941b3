"""The paper's figures that :mod:`latentds.plotting` does not draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray
from torch import Tensor

from latentds import ChebyshevDS, Demonstration, LatentDS, StableDS
from latentds.fitting.embedding import chebyshev_columns
from latentds.fitting.tuning import Tried
from latentds.plotting import SHOWN, color_of

Array = NDArray[np.float64]

DPI = 100
GOAL: dict[str, Any] = {"marker": "*", "color": "#E69F00", "mec": SHOWN, "mew": 0.6, "ms": 12, "ls": ""}


def framework(shown: Demonstration, ds: LatentDS, n_nodes: int = 12) -> Figure:
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
    _graph(axes, 4, n_nodes)
    axes.set_title(f"(c) their graph ({n_nodes} of {len(shown)} nodes a path)")
    for place_, title, cloud in (
        (4, "(d) latent points: eigenvector entries", columns),
        (5, "(e) laid from start to goal", latent),
        (6, f"(f) mapped by ψ, MSE {np.square(mapped - points).mean():.1e}", mapped),
    ):
        axes = figure.add_subplot(2, 3, place_, **solid)
        some = cloud[:: max(1, len(cloud) // 120)] if place_ < 6 else cloud
        axes.plot(*some.T, ".", ms=4 if place_ < 6 else 2, color=color_of("Chebyshev"))
        if place_ > 4:
            axes.plot(*points.T, color=SHOWN, lw=0.6, ls="--", alpha=0.6)
        axes.plot(*cloud[-1:].T, **GOAL)
        axes.set_title(title)
    for axes in figure.axes:
        axes.tick_params(labelsize=7)
        if isinstance(axes, Axes3D):
            axes.view_init(elev=20, azim=-60)
    return figure


def _graph(axes: Any, copies: int, n_nodes: int) -> None:
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


def heat_map(tried: Sequence[Tried], n_layers: int, title: str) -> Figure:
    """MSE over (μ, β) at one M."""
    found = {(one.mu, one.beta): one.mse for one in tried if one.n_layers == n_layers}
    mus, betas = (sorted({key[i] for key in found}) for i in (0, 1))
    table = np.array([[found[mu, beta] for mu in mus] for beta in betas])
    figure = Figure(figsize=(2.4 + 0.72 * len(mus), 1.8 + 0.42 * len(betas)), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    norm = LogNorm(table.min(), table.max())
    image = axes.imshow(table, origin="lower", aspect="auto", cmap="viridis", norm=norm)
    for (row, column), value in np.ndenumerate(table):
        shade = "white" if norm(value) < 0.6 else "black"
        axes.text(column, row, f"{value:.0e}", ha="center", va="center", fontsize=8, color=shade)
    axes.set_xticks(range(len(mus)), [f"{mu:g}" for mu in mus])
    axes.set_yticks(range(len(betas)), [f"{beta:g}" for beta in betas])
    axes.set(xlabel="μ", ylabel="β", title=title)
    figure.colorbar(image, label="MSE per coordinate")
    return figure


def normalised_bars(scores: Mapping[str, Mapping[str, Array]], title: str) -> Figure:
    """Mean and standard deviation over the starts, every spiral's scores divided by the largest of its means.

    Args:
        scores: {spiral: {method: scores of the starts}}.
    """
    methods = list(dict.fromkeys(method for found in scores.values() for method in found))
    figure = Figure(figsize=(2.5 + 1.0 * len(scores), 4.2), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    width = 0.82 / len(methods)
    for i, method in enumerate(methods):
        for k, found in enumerate(scores.values()):
            worst = max((np.mean(s) for s in found.values() if np.isfinite(s).all()), default=np.nan)
            values = found.get(method, np.array([np.nan])) / worst
            spread = values.std(ddof=1) if len(values) > 1 else 0.0
            mean = values.mean()
            axes.bar(
                k + (i - (len(methods) - 1) / 2) * width,
                mean,
                0.92 * width,
                yerr=[[min(spread, mean)], [spread]] if np.isfinite(mean) else None,
                color=color_of(method),
                ecolor=SHOWN,
                capsize=2.5,
                label="" if k else method,
            )
            if not np.isfinite(mean):
                axes.text(k + (i - (len(methods) - 1) / 2) * width, 0.01, "×", ha="center", color=color_of(method))
    axes.set_xticks(range(len(scores)), list(scores), rotation=20, ha="right")
    axes.set(ylabel="FastDTW, normalised per spiral", title=title)
    axes.grid(axis="y", color="#DDDDDD", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=len(methods), fontsize=9, frameon=False)
    return figure


def p_values(tests: pd.DataFrame) -> Figure:
    """Columns spiral, p (Welch, FastDTW) and lower, the method with the lower mean; log scale."""
    figure = Figure(figsize=(2.5 + 0.8 * len(tests), 3.6), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    floor = 1e-16
    for i, (_, row) in enumerate(tests.iterrows()):
        axes.bar(i, max(row["p"], floor), 0.6, color=color_of(row["lower"]))
    axes.set_yscale("log")
    axes.axhline(0.05, color=SHOWN, ls="--", lw=1)
    axes.text(len(tests) - 0.5, 0.05, "p = 0.05", va="bottom", ha="right", fontsize=8)
    for method in dict.fromkeys(tests["lower"]):
        axes.bar(np.nan, np.nan, color=color_of(method), label=f"{method} nearer")
    axes.set_xticks(range(len(tests)), list(tests["spiral"]), rotation=20, ha="right")
    axes.set(ylabel="p of Welch's t-test", title="Chebyshev against FDM, 20 starts, FastDTW")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def planes(motions: Sequence[Demonstration], fitted: Mapping[str, Mapping[str, StableDS]], starts: int = 8) -> Figure:
    """A row per planar motion: rollouts and streamlines of each method side by side.

    Args:
        fitted: {motion: {method: system}}.
    """
    methods = list(fitted[motions[0].name])
    shape = len(motions), 2 * len(methods)
    figure = Figure(figsize=(3.4 * shape[1], 3.3 * shape[0]), dpi=DPI, layout="constrained")
    grid = figure.subplots(*shape, squeeze=False)
    for row, shown in zip(grid, motions, strict=True):
        points = shown.positions.numpy()
        border = 0.3 * shown.size
        low, high = points.min(axis=0) - border, points.max(axis=0) + border
        x, y = (np.linspace(a, b, 50) for a, b in zip(low, high, strict=True))
        turns = 2 * np.pi * np.arange(starts) / starts
        around = 0.05 * shown.size * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        begins = shown.start + torch.from_numpy(np.concatenate([np.zeros((1, 2)), around]))
        for k, method in enumerate(methods):
            ds = fitted[shown.name][method]
            with torch.no_grad():
                velocity = ds(torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1))).numpy()
                paths = ds.rollout(begins, torch.linspace(0, 3 * shown.duration, 1500)).numpy()
            moved, field = row[2 * k], row[2 * k + 1]
            for path in paths[1:]:
                moved.plot(*path.T, color=color_of(method), lw=0.8, alpha=0.5)
            moved.plot(*paths[0].T, color=color_of(method), lw=2)
            field.streamplot(x, y, velocity[..., 0], velocity[..., 1], color="#999999", linewidth=0.6, arrowsize=0.7)
            for axes in (moved, field):
                axes.plot(*points.T, color=SHOWN, lw=1.4, ls="--")
                axes.plot(*points[0], "o", color=SHOWN, ms=4)
                axes.plot(*points[-1], **GOAL)
                axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
                axes.tick_params(labelsize=7)
            moved.set_title(f"{shown.name}: {method}, rollouts", fontsize=10)
            field.set_title(f"{shown.name}: {method}, field", fontsize=10)
    return figure


def orbits(shown: Demonstration, fitted: Mapping[str, StableDS], begins: Tensor) -> tuple[Figure, dict[str, int]]:
    """Planar motions from starts (B, 2), a picture for each system, crossings marked, and how many there are.

    Motions last thrice the duration; what lies within a twentieth of the size of the goal is left out.
    """
    points, counts = shown.positions.numpy(), {}
    figure = Figure(figsize=(5.2 * len(fitted), 5), dpi=DPI, layout="constrained")
    for axes, (method, ds) in zip(figure.subplots(1, len(fitted), squeeze=False)[0], fitted.items(), strict=True):
        with torch.no_grad():
            paths = ds.rollout(begins, torch.linspace(0, 3 * shown.duration, 900)).numpy()
        far = np.linalg.norm(paths - points[-1], axis=-1) > 0.05 * shown.size
        met = crossings(np.where(far[..., None], paths, np.nan))
        counts[method] = len(met)
        for path in paths:
            axes.plot(*path.T, color=color_of(method), lw=1, alpha=0.7)
        axes.plot(*paths[:, 0].T, "o", color=color_of(method), ms=3)
        axes.plot(*points.T, color=SHOWN, lw=1.6, ls="--", label="demonstration")
        axes.plot(*met.T, "x", color=SHOWN, ms=5, label="crossing")
        axes.plot(*points[-1], **GOAL)
        axes.set_title(f"{shown.name}: {method}, {len(met)} crossings", fontsize=10)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure, counts


def crossings(paths: Array, angle: float = 10.0) -> Array:
    """Where planar paths (B, T, 2) cross each other at more than so many degrees: (C, 2). Steps with NaN cross none."""
    found = [np.empty((0, 2))]
    for one, other in combinations(paths, 2):
        p, q = one[:-1, None], other[None, :-1]
        u, v = np.diff(one, axis=0)[:, None], np.diff(other, axis=0)[None]
        turn, gap = _cross(u, v), q - p
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = _cross(gap, v) / turn, _cross(gap, u) / turn
            apart = np.degrees(np.arctan2(np.abs(turn), (u * v).sum(-1))) > angle
        i, j = np.nonzero((s >= 0) & (s < 1) & (t >= 0) & (t < 1) & apart)
        found.append(one[i] + s[i, j, None] * u[i, 0])
    return np.concatenate(found)


def _cross(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def linearity(frame: pd.DataFrame, slopes: Mapping[int, float]) -> Figure:
    """The largest difference of two columns' entries over N, with the paper's O(1/N²) beside."""
    figure = Figure(figsize=(6.5, 4.4), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    for i, (n, k) in enumerate(slopes.items()):
        chosen = frame[frame["n"] == n]
        axes.loglog(chosen["N"], chosen["entry"], "-o", ms=4, color=f"C{i}", label=f"n = {n}: slope {k:.2f}")
        if n == max(slopes):
            first, last = chosen.iloc[0], chosen.iloc[-1]
            claimed = first["entry"] * (first["N"] / chosen["N"]) ** 2
            axes.loglog(chosen["N"], claimed, ":", color=SHOWN, label="O(1/N²), the paper's")
            axes.set_xticks([first["N"], last["N"]])
    axes.set(xlabel="N", ylabel="largest difference of two columns", title="How far the latent curve is from a line")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(color="#E4E4E4", lw=0.6)
    axes.legend(fontsize=9)
    return figure
