"""Pictures of the ablation and of the speed measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from latentds import Demonstration, plotting

Array = NDArray[np.float64]


def gains(rows: pd.DataFrame, families: Sequence[str]) -> Figure:
    """Mean score of every method on every family, from the demonstrated start and from the others."""
    families = [family for family in families if (rows["family"] == family).any()]
    labels = list(rows[rows["family"].isin(families)]["method"].unique())
    figure = Figure(figsize=(3.2 * len(families) + 2, 5.2), dpi=plotting.DPI, layout="constrained")
    panels = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
    place = -np.arange(len(labels))
    for axes, family in zip(panels, families, strict=True):
        found = rows[rows["family"] == family]
        for part, colour, shift, name in (
            (found[found["start"] > 0], plotting.COLORS["Chebyshev"], 0.19, "other starts"),
            (found[found["start"] == 0], plotting.COLORS["FDM"], -0.19, "demonstrated start"),
        ):
            means = part.groupby("method")["share"].mean().reindex(labels)
            axes.barh(place + shift, means, 0.36, color=colour, label=name)
        axes.set(xscale="log", xlim=(5e-5, 1), title=family, xlabel="DTW/500 [sizes of the motion]")
        axes.set_yticks(place, labels)
        axes.grid(axis="x", color="#DDDDDD", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def handwriting(shapes: Mapping[str, tuple[Sequence[Demonstration], Array]]) -> Figure:
    """Every shape: what was shown, the rollout from its start, and those from the other demonstrations' starts."""
    columns = 6 if len(shapes) > 4 else len(shapes)
    height = math.ceil(len(shapes) / columns)
    figure = Figure(figsize=(2.1 * columns, 2.2 * height + 0.4), dpi=plotting.DPI, layout="constrained")
    panels = figure.subplots(height, columns, squeeze=False).ravel()
    for axes in panels[len(shapes) :]:
        axes.set_axis_off()
    for axes, (name, (written, paths)) in zip(panels, shapes.items(), strict=False):
        for i, path in enumerate(paths[1:]):
            axes.plot(*path.T, color="#56B4E9", lw=0.8, label="" if i else "from the other six starts")
            axes.plot(*path[0], ".", color="#0072B2", ms=4)
        axes.plot(*paths[0].T, color=plotting.COLORS["TubeDS"], lw=2.2, label="from the demonstrated start")
        axes.plot(*written[0].positions.T, "--", color=plotting.SHOWN, lw=0.9, label="demonstration")
        axes.plot(*written[0].goal, "*", color="#E69F00", mec=plotting.SHOWN, mew=0.5, ms=9)
        axes.set_title(name, fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_color("#CCCCCC")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def growth(curves: pd.DataFrame) -> Figure:
    """Seconds of each call over points N and layers M, on log scales; columns grows, call, size and seconds."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axis, (grows, label) in zip(figure.subplots(1, 2), (("N", "points N"), ("M", "layers M")), strict=True):
        for call, curve in curves[curves["grows"] == grows].groupby("call"):
            axis.loglog(curve["size"], curve["seconds"], "o-", label=call, markersize=3)
        axis.set(xlabel=label, ylabel="seconds")
        axis.xaxis.set_minor_formatter("")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    return figure
