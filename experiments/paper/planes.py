"""Motions in the plane: the rivals' rollouts, fields and attractors, and where orbits of a DMP cross."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from baselines import DMP
from baselines.dmp import FADING, STIFFNESS
from experiments.compared import RIVALS, greedy, handwriting
from experiments.paper.document import CONTRADICTED, DPI, GOAL, IN_PART, REPRODUCED, Document, verdict
from experiments.paper.sensitivity import Variant
from experiments.paper.study import Study, brief
from experiments.report import welch
from latentds import Demonstration, StableDS, TubeDS, datasets
from latentds.arguments import Array
from latentds.benchmark import Cell
from latentds.plotting import SHOWN, color_of

BALL_RADIUS = 0.05
"""Of the ball of starts in the plane, in sizes of the motion; the paper's 0.1 on the spirals' sphere."""
ORBITS, RING_RADIUS = 12, 0.3
"""Starts of DMP's orbits, and how far they are from the demonstrated one, in sizes."""
N_ORBIT_POINTS = 1800
"""Of each orbit: at half as many, the chords of orbits that run together cross where these do not."""


def planes(study: Study, document: Document) -> None:
    drawn = [datasets.archimedean_spiral(), *(datasets.drawn(name) for name in study.plan.strokes)]
    written = handwriting() if study.plan.lasa else {}
    characters = [written[shape][0] for shape in study.plan.lasa if written]
    document.add(
        "The Archimedean spiral and strokes of our own drawing"
        + (", and characters of the LASA handwriting data (not drawn here)" if characters else "")
        + ", hyperparameters by the paper's rule with the least β. 20 starts within "
        f"{BALL_RADIUS:g} sizes of the motion; DTW per point in sizes of the motion. *Attractor off by* is the "
        "distance of ψ(x_N), the paper's attractor, from the goal, in sizes: with ours it is 0."
    )
    lines = []
    fitted: dict[str, dict[str, StableDS]] = {}
    off: dict[str, list[float]] = {method: [] for method in RIVALS}
    for shown in [*drawn, *characters]:
        chosen = {method: study.least_beta(method, shown) for method in RIVALS}
        cells = [Cell(method, greedy(method, setting), shown) for method, setting in chosen.items()]
        rows, _ = study.run(cells, study.protocol(radius=BALL_RADIUS * shown.size))
        near = rows.query("start > 0").groupby("method")["dtw_per_point"]
        scores = {method: near.get_group(method).to_numpy() / shown.size for method in RIVALS}
        line = [shown.name]
        for method, setting in chosen.items():
            printed = Variant(greedy(method, setting, pinned=False)(shown.dim), printed=True).fit(shown).attractor
            off[method].append(float(torch.linalg.vector_norm(printed - shown.goal)) / shown.size)
            line += [brief(setting), f"{scores[method].mean():.4f}", f"{off[method][-1]:.1e}"]
        lines.append([*line, f"{welch(*scores.values()):.1e}"])
        if shown in drawn:
            fitted[shown.name] = {cell.method: cell.factory(2).fit(shown) for cell in cells}
    columns = [f"{m}{what}" for m in RIVALS for what in (", β / μ / M: MSE", ", exact DTW", ", attractor off by")]
    document.table(["motion", *columns, "p"], lines)
    caption = "Rollouts (thrice the duration) and vector fields, Chebyshev and FDM"
    document.show("planes", draw_planes(drawn, fitted), caption)
    lost = {method: sum(distance > 0.01 for distance in distances) for method, distances in off.items()}
    document.find(
        '"FDM converges at an incorrect attractor" (third case)',
        "FDM only, one motion",
        f"ψ(x_N) is off by up to {max(off['FDM']):.1e} (FDM) and {max(off['Chebyshev']):.1e} (Chebyshev) "
        f"sizes; by more than 1 % on {lost['FDM']} and {lost['Chebyshev']} of {len(lines)}; none with the exact "
        "attractor",
        REPRODUCED if lost["FDM"] and not lost["Chebyshev"] else IN_PART if lost["FDM"] else CONTRADICTED,
    )


def draw_planes(motions: Sequence[Demonstration], fitted: Mapping[str, Mapping[str, StableDS]]) -> Figure:
    """A row per planar motion: rollouts and streamlines side by side, of {motion: {method: system}}."""
    methods = list(fitted[motions[0].name])
    shape = len(motions), 2 * len(methods)
    figure = Figure(figsize=(3.4 * shape[1], 3.3 * shape[0]), dpi=DPI, layout="constrained")
    grid = figure.subplots(*shape, squeeze=False)
    for row, shown in zip(grid, motions, strict=True):
        points = shown.positions.numpy()
        border = 0.3 * shown.size
        low, high = points.min(axis=0) - border, points.max(axis=0) + border
        x, y = (np.linspace(a, b, 50) for a, b in zip(low, high, strict=True))
        begins = torch.cat([shown.start[None], ring_of_starts(shown, 8, BALL_RADIUS)])
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


def ring_of_starts(shown: Demonstration, count: int, radius: float) -> Tensor:
    """Starts evenly on a circle around the demonstrated one, ``radius`` in sizes of the motion: (count, 2)."""
    turns = 2 * np.pi * np.arange(count) / count
    around = radius * shown.size * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return shown.start + torch.from_numpy(around)


def orbits(_: Study, document: Document) -> None:
    shown, dmp = datasets.drawn("curl"), DMP(2)
    fitted = {"DMP": dmp.fit(shown), "TubeDS": TubeDS(2).fit(shown)}
    drawn, counts = draw_orbits(shown, fitted, ring_of_starts(shown, ORBITS, RING_RADIUS))
    document.add(
        "The paper shows orbits of a DMP that cross each other, without its parameters. Ours: the stroke "
        f"{shown.name!r} of our own drawing, {dmp.n_basis} basis functions, α_z = {STIFFNESS:g}, β_z = α_z / 4, "
        f"α_x = {FADING:.3g}; {ORBITS} starts {RING_RADIUS:g} sizes around the demonstrated one. A DMP's force follows "
        "a clock, so that one place has as many velocities as motions come by; orbits of an autonomous system, such "
        "as TubeDS, cannot cross. Crossings at less than 10° are not counted, nor those within 0.05 sizes of the goal."
    )
    document.show("dmp_orbits", drawn, f"{shown.name}: motions of a DMP and of TubeDS from the same {ORBITS} starts")
    counted = ", ".join(f"{method} {count}" for method, count in counts.items())
    crossed = verdict(counts["DMP"] and not counts["TubeDS"])
    document.find("DMP's forward orbits", "cross", f"crossings: {counted}", crossed)


def draw_orbits(shown: Demonstration, fitted: Mapping[str, StableDS], begins: Tensor) -> tuple[Figure, dict[str, int]]:
    """Planar motions from starts (B, 2), a picture for each system, crossings marked, and how many there are.

    Motions last thrice the duration; what lies within a twentieth of the size of the goal is left out.
    """
    points, counts = shown.positions.numpy(), {}
    figure = Figure(figsize=(5.2 * len(fitted), 5), dpi=DPI, layout="constrained")
    for axes, (method, ds) in zip(figure.subplots(1, len(fitted), squeeze=False)[0], fitted.items(), strict=True):
        with torch.no_grad():
            paths = ds.rollout(begins, torch.linspace(0, 3 * shown.duration, N_ORBIT_POINTS)).numpy()
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
    places = [np.empty((0, 2))]
    for first, second in combinations(paths, 2):
        p, q = first[:-1, None], second[None, :-1]
        u, v = np.diff(first, axis=0)[:, None], np.diff(second, axis=0)[None]
        turn, gap = _cross(u, v), q - p
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = _cross(gap, v) / turn, _cross(gap, u) / turn
            apart = np.degrees(np.arctan2(np.abs(turn), (u * v).sum(-1))) > angle
        i, j = np.nonzero((s >= 0) & (s < 1) & (t >= 0) & (t < 1) & apart)
        places.append(first[i] + s[i, j, None] * u[i, 0])
    return np.concatenate(places)


def _cross(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
