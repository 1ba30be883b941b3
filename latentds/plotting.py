"""Pictures of motions and scores, which leave matplotlib's backend alone. A method has one colour in all of them.

Small ones (:func:`motions`, :func:`field`, :func:`embedding`, :func:`tube`, :func:`speeds`) draw on axes that they are
given and return them; they take what ``rollout`` returns. Whole ones return a Figure, to save with
``figure.savefig("name.png")``; their ``paths`` are {label: (B, T, n) rollouts}, over the demonstration's duration, of
several the first one's. NaN in paths leaves a gap.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
import torch
from scipy.linalg import null_space

from .arguments import Array, number_in, real_array
from .base import LatentDS, StableDS
from .cell import joint_name, several
from .curves import extent
from .demonstration import Demonstration
from .dynamics import Frame

try:
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, MaxNLocator
except ImportError as error:
    raise ImportError("plotting needs matplotlib: pip install 'latentds[studies]'") from error

if TYPE_CHECKING:
    import pandas as pd

# Okabe and Ito's palette, told apart by colour-blind readers.
COLORS = {"Chebyshev": "#0072B2", "FDM": "#D55E00", "SDS-EF": "#009E73", "Tube": "#CC79A7", "TubeDS": "#CC79A7"}
OTHERS = ("#56B4E9", "#E69F00", "#882255", "#999933")
SHOWN = "#222222"
DPI = 150


def color_of(label: str) -> str:
    """The colour of a method, by its label alone."""
    return COLORS.get(label, OTHERS[crc32(label.encode()) % len(OTHERS)])


# --- one picture, on axes of yours ------------------------------------------------------------------------------------


def motions(
    paths: Any,
    demonstration: Demonstration | None = None,
    ax: Any = None,
    *,
    times: Any = None,
    label: str = "motions",
) -> Any:
    """Motions as ``rollout`` gives them, over what was shown: curves for n = 2 and 3, else coordinates over time.

    Args:
        paths: (T, n) or (B, T, n).
        demonstration: drawn beneath, if there is one.
        ax: matplotlib's axes, with ``projection="3d"`` for n = 3; new ones, on a figure of their own, if None.
        times: (T,) seconds, of the coordinates; if None even over the demonstration's duration, without one numbers.
        label: the method's name, which chooses the colour.

    Returns:
        The axes; ``ax.figure`` is their figure.

    Raises:
        ValueError: if the shapes do not fit.
    """
    batch = _batch(paths, None if demonstration is None else demonstration.dim)
    dim, color = batch.shape[-1], color_of(label)
    ax = _axes(dim) if ax is None else ax
    if demonstration is not None and dim in (2, 3):
        ax.plot(*demonstration.positions.numpy().T, "--", color=SHOWN, lw=1.6, label="demonstration")
        ax.plot(*demonstration.goal.numpy()[:, None], "*", color="#E69F00", mec=SHOWN, ms=12)
    elif demonstration is not None:
        ax.plot(demonstration.times.numpy(), demonstration.positions.numpy(), "--", color=SHOWN, lw=1.2)
    last = batch.shape[1] - 1 if demonstration is None else demonstration.duration
    clock = np.linspace(0, last, batch.shape[1]) if times is None else real_array(times, "times")
    if clock.shape != (batch.shape[1],):
        raise ValueError(f"times: expected ({batch.shape[1]},) as the paths have, got {clock.shape}")
    for i, path in enumerate(batch):
        if dim in (2, 3):
            ax.plot(*path.T, color=color, lw=1.0, alpha=0.8, label="" if i else label)
        else:
            ax.plot(clock, path, color=color, lw=1.0, alpha=0.8)
    return ax


def field(
    ds: StableDS,
    demonstration: Demonstration | Sequence[Demonstration],
    ax: Any = None,
    *,
    margin: float = 0.35,
    lyapunov: bool = False,
) -> Any:
    """Streamlines of a planar system around what was shown, over contours of √V if these are asked for.

    Args:
        ds, demonstration: of dimension 2.
        ax: matplotlib's axes; new ones if None.
        margin: >= 0, around the demonstrations, as a share of their size.
        lyapunov: whether to draw V.

    Returns:
        The axes, limited to what was drawn.

    Raises:
        ValueError: for another dimension.
    """
    every = several(demonstration, "demonstration")
    if ds.dim != 2 or every[0].dim != 2:
        raise ValueError(f"ds: expected a system and a demonstration in 2-D, got {ds.dim}-D and {every[0].dim}-D")
    margin = number_in(margin, "margin", 0, math.inf, ends="[)")
    ax = _axes(2) if ax is None else ax
    shown = np.concatenate([one.positions.numpy() for one in every])
    border = margin * max(one.size for one in every)
    (left, bottom), (right, top) = shown.min(axis=0) - border, shown.max(axis=0) + border
    x, y = np.linspace(left, right, 60), np.linspace(bottom, top, 60)
    places = torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1))
    with torch.no_grad():
        velocity = ds(places).numpy()
        if lyapunov:
            height = ds.lyapunov(places).clamp(min=0).sqrt().numpy()
            ax.contourf(x, y, height, levels=20, cmap="Blues_r", alpha=0.7)
    shade = "#FFFFFF" if lyapunov else "#AAAAAA"
    ax.streamplot(x, y, velocity[..., 0], velocity[..., 1], color=shade, linewidth=0.7, arrowsize=0.8, density=1.6)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    return ax


def embedding(ds: LatentDS, demonstration: Demonstration, paths: Any = None, ax: Any = None) -> Any:
    """Motions in latent space, in any dimension: progress along the latent line, and distance from it.

    Args:
        ds: fitted.
        demonstration: encoded and drawn in black: how near it lies to the line is how well it was matched.
        paths: (T, n) or (B, T, n), or None.
        ax: matplotlib's axes; new ones if None.

    Returns:
        The axes: 1 is the demonstrated start, 0 the goal; distances are in lengths of the line.
    """
    frame = _frame(ds)
    ax = _axes(2) if ax is None else ax

    def place(points: Any) -> tuple[Array, Array]:
        with torch.no_grad():
            offset = (ds.encode(torch.as_tensor(points)) - frame.attractor) / frame.length
            progress = offset @ frame.axis
            across = torch.linalg.vector_norm(offset - progress.unsqueeze(-1) * frame.axis, dim=-1)
        return progress.numpy(), across.numpy()

    for path in [] if paths is None else _batch(paths, ds.dim):
        ax.plot(*place(path), color=color_of(type(ds).__name__), lw=1.0, alpha=0.8)
    ax.plot(*place(demonstration.positions), color=SHOWN, lw=1.6, ls="--", label="demonstration")
    ax.set_aspect("auto")
    ax.set(xlabel="progress to go", ylabel="distance from the latent line")
    ax.invert_xaxis()
    return ax


def tube(ds: LatentDS, demonstration: Demonstration, ax: Any = None, *, radius: float = 0.05) -> Any:
    """What ψ makes of straight lines around the latent one: how the surroundings of the path bend with it; n = 2 or 3.

    Args:
        ds, demonstration: of dimension 2 or 3.
        ax: matplotlib's axes, with ``projection="3d"`` for n = 3; new ones if None.
        radius: > 0, of the lines' distance, in lengths of the latent line.

    Returns:
        The axes.

    Raises:
        ValueError: for another dimension or radius.
    """
    if ds.dim not in (2, 3):
        raise ValueError(f"ds: expected 2 or 3 dimensions, got {ds.dim}")
    radius, frame = number_in(radius, "radius", 0, math.inf), _frame(ds)
    ax = _axes(ds.dim) if ax is None else ax
    sides = torch.from_numpy(null_space(frame.axis.numpy()[None]))
    turns = torch.arange(2 if ds.dim == 2 else 12) * (2 * math.pi / (2 if ds.dim == 2 else 12))
    ring = torch.stack([turns.cos(), turns.sin()], dim=-1)[:, : ds.dim - 1].to(sides) @ sides.mT
    along = torch.linspace(1, 0, 300, dtype=torch.float64).unsqueeze(-1) * frame.axis
    with torch.no_grad():
        lines = ds.decode(frame.attractor + frame.length * (along + radius * ring.unsqueeze(1))).numpy()
    for line in lines:
        ax.plot(*line.T, color=color_of("TubeDS"), lw=0.7, alpha=0.7)
    ax.plot(*demonstration.positions.numpy().T, "--", color=SHOWN, lw=1.6, label="demonstration")
    return ax


def speeds(
    paths: Any, times: Any, demonstration: Demonstration | None = None, ax: Any = None, *, label: str = "motions"
) -> Any:
    """Speeds over time of motions (T, n) or (B, T, n) at ``times`` (T,), seconds, over those that were shown.

    Returns:
        The axes: ``ax``, or new ones.
    """
    batch, clock = _batch(paths, None if demonstration is None else demonstration.dim), real_array(times, "times")
    if clock.shape != (batch.shape[1],):
        raise ValueError(f"times: expected ({batch.shape[1]},) as the paths have, got {clock.shape}")
    ax = _axes(1) if ax is None else ax
    if demonstration is not None:
        shown = torch.linalg.vector_norm(demonstration.velocities, dim=-1)
        ax.plot(demonstration.times.numpy(), shown.numpy(), "--", color=SHOWN, lw=1.6, label="demonstration")
    for i, path in enumerate(batch):
        speed = np.linalg.norm(np.gradient(path, clock, axis=0), axis=1)
        ax.plot(clock, speed, color=color_of(label), lw=1.0, alpha=0.8, label="" if i else label)
    ax.set(xlabel="time [s]", ylabel="speed")
    return ax


def _frame(ds: LatentDS) -> Frame:
    """Of the latent space, in float64 and without gradients, whatever the system is in."""
    if not isinstance(ds, LatentDS):
        raise ValueError(f"ds: expected a LatentDS, which has a latent space, got {type(ds).__name__}")
    return Frame(*(part.detach().to("cpu", torch.float64) for part in ds.frame()))


def _axes(dim: int) -> Any:
    figure = Figure(figsize=(5.6, 5.2) if dim in (2, 3) else (7.0, 3.6), dpi=DPI, layout="constrained")
    ax = figure.add_subplot(projection="3d") if dim == 3 else figure.add_subplot()
    if dim in (2, 3):
        _quiet(ax)
    return ax


def _batch(paths: Any, dim: int | None) -> Array:
    """Paths (B, T, n) of one (T, n) or many."""
    values = real_array(paths, "paths")
    batch = values[None] if values.ndim == 2 else values
    if batch.ndim != 3 or (dim is not None and batch.shape[-1] != dim):
        raise ValueError(f"paths: expected (T, {dim or 'n'}) or (B, T, {dim or 'n'}), got {values.shape}")
    return batch


# --- whole figures ----------------------------------------------------------------------------------------------------


def replications(
    demonstration: Demonstration | Sequence[Demonstration], paths: Mapping[str, Any], title: str = ""
) -> Figure:
    """The demonstration, or several of one motion, and beside it a panel per method with its rollouts; n = 2 or 3.

    Where rollouts leave the picture, a cube of up to 1.5 times the demonstration's size, the panel says how many.

    Raises:
        ValueError: for another n, or paths that do not fit the demonstration.
    """
    every = several(demonstration, "demonstration")
    first = every[0]
    if first.dim not in (2, 3):
        raise ValueError(f"demonstration: expected 2 or 3 dimensions, got {first.dim}; see joints")
    moved = _moved(paths, first)
    low, high = _box(every, moved)
    figure = Figure(figsize=(3.3 * (len(moved) + 1), 3.9), dpi=DPI, layout="constrained")
    figure.suptitle(title or joint_name(every), fontweight="bold")
    solid = {"projection": "3d"} if first.dim == 3 else {}
    nothing = np.empty((0, 1, first.dim))
    for i, (label, batch) in enumerate([("demonstration", nothing), *moved.items()]):
        axes = figure.add_subplot(1, len(moved) + 1, i + 1, **solid)
        inside = np.all((batch >= low) & (batch <= high), axis=2)
        for path, seen in zip(batch, inside, strict=True):
            axes.plot(*np.where(seen[:, None], path, np.nan).T, color=color_of(label), lw=0.8, alpha=0.55)
        for one in every:
            axes.plot(*one.positions.numpy().T, color=SHOWN, lw=0.9 if i else 1.6, ls="--" if i else "-")
        starts = batch[:, 0] if i else np.stack([one.start.numpy() for one in every])
        axes.plot(*starts.T, "o", color=SHOWN, ms=2.2 if i else 3.5, label="start")
        goals = np.stack([one.goal.numpy() for one in every])
        axes.plot(*goals.T, "*", color="#E69F00", mec=SHOWN, mew=0.6, ms=11, label="goal")
        gone = int((~np.all(inside, axis=1)).sum())
        note = f"\n{gone} of {len(batch)} leave the picture" if gone else ""
        axes.set_title(label + note, color=color_of(label) if i else SHOWN, fontsize=11)
        for axis, label, bounds in zip("xyz", _labels(first), zip(low, high, strict=True), strict=False):
            axes.set(**{f"{axis}lim": bounds, f"{axis}label": label})
            getattr(axes, f"{axis}axis").set_major_locator(MaxNLocator(4, prune="both"))
        _quiet(axes)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def vector_field(
    ds: StableDS,
    demonstration: Demonstration | Sequence[Demonstration],
    paths: Any = None,
    label: str = "rollouts",
    margin: float = 0.35,
) -> Figure:
    """Streamlines of a planar system with the demonstrations of one motion and rollouts (B, T, 2) over them.

    Args:
        ds: of dimension 2.
        demonstration: of dimension 2.
        paths: (B, T, 2), or None to draw none.
        label: the method's name.
        margin: >= 0, of the picture around the demonstration, as a share of its size.

    Raises:
        ValueError: for another n, or paths that do not fit the demonstration.
    """
    every = several(demonstration, "demonstration")
    figure = Figure(figsize=(5.6, 5.6), dpi=DPI, layout="constrained")
    axes = field(ds, every, figure.add_subplot(), margin=margin)
    moved = {} if paths is None else _moved({label: paths}, every[0])
    for batch in moved.values():
        for i, path in enumerate(batch):
            axes.plot(*path.T, color=color_of(label), lw=1.2, alpha=0.7, label="" if i else label)
        axes.plot(*batch[:, 0].T, "o", color=color_of(label), ms=3)
    for i, one in enumerate(every):
        names = ("",) * 3 if i else ("demonstration", "start", "goal")
        axes.plot(*one.positions.numpy().T, color=SHOWN, lw=2, ls="--", label=names[0])
        axes.plot(*one.start.numpy(), "o", color=SHOWN, ms=6, label=names[1])
        axes.plot(*one.goal.numpy(), "*", color="#E69F00", mec=SHOWN, ms=15, label=names[2])
    first, second = _labels(every[0])
    axes.set(xlabel=first, ylabel=second, title=joint_name(every))
    axes.set_aspect("equal")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def dtw_bars(rows: pd.DataFrame, title: str = "") -> Figure:
    """Mean exact DTW over the perturbed starts, with standard deviation and every start as a dot; log scale.

    Args:
        rows: of :func:`latentds.benchmark.compare`; methods and demonstrations keep their order.

    Raises:
        ValueError: if a column is missing.
    """
    if missing := {"method", "demonstration", "start", "dtw"} - set(rows):
        raise ValueError(f"rows: expected the columns of compare, got none named {sorted(missing)}")
    scored = rows[rows["start"] > 0] if (rows["start"] > 0).any() else rows
    methods, motions = (list(scored[column].unique()) for column in ("method", "demonstration"))
    figure = Figure(figsize=(2.5 + 1.25 * len(motions), 4.2), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    width = 0.82 / len(methods)
    groups = {key: group.dropna().to_numpy() for key, group in scored.groupby(["method", "demonstration"])["dtw"]}
    for i, method in enumerate(methods):
        place = np.arange(len(motions)) + (i - (len(methods) - 1) / 2) * width
        scores = [groups.get((method, motion), np.empty(0)) for motion in motions]
        means = np.array([s.mean() if len(s) else np.nan for s in scores])
        spread = np.array([s.std(ddof=1) if len(s) > 1 else 0.0 for s in scores])
        axes.bar(place, means, 0.92 * width, color=color_of(method), alpha=0.8, label=method)
        # On a log scale mean - sd may lie below zero: the whisker then ends at the smallest score.
        lowest = np.array([s.min() if len(s) else np.nan for s in scores])
        down = means - np.maximum(means - spread, np.minimum(lowest, means))
        axes.errorbar(place, means, [down, spread], fmt="none", ecolor=SHOWN, elinewidth=1.1, capsize=3)
        for x, s in zip(place, scores, strict=True):
            axes.plot(x + np.linspace(-0.3, 0.3, len(s)) * width, s, ".", color=SHOWN, ms=2.5, alpha=0.35)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set_xticks(np.arange(len(motions)), motions)
    axes.set(xlim=(-0.5, len(motions) - 0.5), ylabel="exact DTW, sum over the path", title=title)
    axes.grid(axis="y", color="#DDDDDD", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=len(methods), fontsize=9, frameon=False)
    return figure


def joints(
    demonstration: Demonstration | Sequence[Demonstration],
    paths: Mapping[str, Any],
    title: str = "",
    unit: str = "rad",
) -> Figure:
    """Every coordinate over time, one row each: the demonstrations and the rollouts of each method; any n.

    Raises:
        ValueError: if paths do not fit the demonstration.
    """
    every = several(demonstration, "demonstration")
    first = every[0]
    moved = _moved(paths, first)
    figure = Figure(figsize=(7.5, 1.0 + 1.25 * first.dim), dpi=DPI, layout="constrained")
    figure.suptitle(title or joint_name(every))
    rows = figure.subplots(first.dim, 1, sharex=True, squeeze=False)[:, 0]
    for k, axes in enumerate(rows):
        # A wide pale line beneath, and dashes from the second method on: a rollout that fits hides nothing.
        for i, one in enumerate(every):
            name = "" if k or i else "demonstration"
            axes.plot(one.times.numpy(), one.positions[:, k].numpy(), color="#CCCCCC", lw=5, label=name)
        for (label, batch), dashes in zip(moved.items(), cycle(("-", "--", ":", "-.")), strict=False):
            times = np.linspace(0, first.duration, batch.shape[1])
            for i, path in enumerate(batch):
                name = label if k == i == 0 else ""
                axes.plot(times, path[:, k], dashes, color=color_of(label), lw=1.2, label=name)
        axes.set_ylabel(f"{_labels(first)[k]} [{unit}]")
        axes.grid(color="#EEEEEE", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    rows[-1].set_xlabel("time [s]")
    figure.legend(loc="outside lower center", ncols=len(moved) + 1, fontsize=9, frameon=False)
    figure.align_ylabels(list(rows))
    return figure


def checked(shown: Sequence[Demonstration]) -> Figure:
    """Every coordinate of demonstrations over time, a column each, with what their check finds marked; any n."""
    figure = Figure(figsize=(7.5 * len(shown), 1.6 + 1.25 * shown[0].dim), dpi=DPI, layout="constrained")
    grid = figure.subplots(shown[0].dim, len(shown), sharex="col", squeeze=False)
    for column, one in zip(grid.T, shown, strict=True):
        found = list(one.check())
        for k, axes in enumerate(column):
            axes.plot(one.times.numpy(), one.positions[:, k].numpy(), color="#444444", lw=1.2)
            for number, finding in enumerate(found):
                if finding.column in (None, k):
                    for first, last in finding.places(len(one)):
                        ends = (first - 0.5) * one.dt, (last + 0.5) * one.dt
                        axes.axvspan(*ends, color=f"C{number}", alpha=0.3)
            axes.set_ylabel(_labels(one)[k])
            axes.spines[["top", "right"]].set_visible(False)
        column[0].set_title(one.name)
        column[-1].set_xlabel("time [s]")
        marks = [
            Patch(color=f"C{number}", alpha=0.3, label=textwrap.fill(str(f), 95)) for number, f in enumerate(found)
        ]
        column[-1].legend(handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.6), fontsize=8, frameon=False)
    return figure


def _labels(demonstration: Demonstration) -> tuple[str, ...]:
    """What to write at the axes: the names of the columns, or x, y, z, or numbers."""
    if demonstration.columns:
        return tuple(name.replace("$", r"\$") for name in demonstration.columns)  # no formula
    return tuple(
        "xyz"[: demonstration.dim] if demonstration.dim <= 3 else (f"$y_{{{k + 1}}}$" for k in range(demonstration.dim))
    )


def _moved(paths: Mapping[str, Any], demonstration: Demonstration) -> dict[str, Array]:
    batches = {label: real_array(batch, "paths") for label, batch in paths.items()}
    for label, batch in batches.items():
        if batch.ndim != 3 or batch.shape[-1] != demonstration.dim:
            raise ValueError(f"paths: expected (B, T, {demonstration.dim}) for {label!r}, got {batch.shape}")
    return batches


def _box(every: Sequence[Demonstration], moved: Mapping[str, Array]) -> tuple[Array, Array]:
    """A cube around the demonstrations, up to 1.5 times their size where rollouts ask for it."""
    shown = np.concatenate([one.positions.numpy() for one in every])
    middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
    wanted = [np.nanmax(np.abs(b - middle), initial=0.0, where=np.isfinite(b)) for b in moved.values()]
    half = extent(shown) / 2 * 1.05
    half = min(max([half, *wanted]), 1.5 * half)
    return middle - half, middle + half


def _quiet(axes: Any) -> None:
    axes.tick_params(labelsize=7)
    if hasattr(axes, "zaxis"):
        axes.set_box_aspect((1, 1, 1), zoom=1.0)
        axes.view_init(elev=22, azim=-58)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color((1, 1, 1, 0))
            axis._axinfo["grid"].update(color="#E4E4E4", linewidth=0.5)
        axes.tick_params(pad=-2)
        for name in ("xaxis", "yaxis", "zaxis"):
            getattr(axes, name).labelpad = -6
    else:
        axes.set_aspect("equal")
        axes.spines[["top", "right"]].set_visible(False)
