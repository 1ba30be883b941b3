"""Several demonstrations of one motion: six methods trained on four and judged by the other three.

    python -m experiments.several [--quick] [--out results/several] [--jobs N]

Protocol C of :mod:`experiments.field.protocols` on the 26 shapes of LASA handwriting, which `make lasa` installs.
Prints the means over the shapes and TubeDS shape by shape, and leaves rows.csv and summary.md in ``--out``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.console import Console

from baselines import CLFDM, DMP, LPVDS, SEDS, ProMP
from experiments import report
from experiments.compared import handwriting
from experiments.field.protocols import protocol_c
from latentds import TubeDS
from latentds.benchmark import Outcome, RolloutProtocol, run, table

METHODS = {"TubeDS": TubeDS, "CLF-DM": CLFDM, "ProMP": ProMP, "DMP": DMP, "LPV-DS": LPVDS, "SEDS": SEDS}
FIGURES = {
    "test_rmse": "velocity RMSE [mm/s]",
    "test_e": "ė",
    "distance": "rollout [sizes]",
    "dtw": "DTWD [mm]",
    "command": "largest command",
}
"""What the tables have, by column; the last is over the largest speed shown, from a start that was shown."""
QUICK = ("Angle", "CShape", "Zshape")


def main(
    quick: Annotated[bool, typer.Option(help="Three shapes.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for rows and summary.")] = Path("results/several"),
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
) -> None:
    """Compare methods that learn from several demonstrations, on motions that they were not shown.

    Finished cells are kept in cells.sqlite beside the results: an interrupted run goes on where it stopped.
    """
    console, shapes = Console(width=120), handwriting()
    if not shapes:
        raise typer.BadParameter("LASA handwriting is not installed: run `make lasa` once")
    cells = [
        protocol_c(label, method, shape)
        for name, shape in shapes.items()
        for label, method in METHODS.items()
        if not quick or name in QUICK
    ]
    out.mkdir(parents=True, exist_ok=True)
    done: list[Outcome] = []
    with report.interruptible(console):
        protocol = RolloutProtocol(n_starts=0, n_points=500)
        done += run(cells, protocol, n_jobs=jobs, progress=True, store=out / "cells.sqlite")
    sizes = {one.name: one.size for cell in cells for one in cell.judges}
    rows = table(cells, done)
    rows["distance"] = rows["dtw_per_point"] / rows["judge"].map(sizes)
    report.write(out / "rows.csv", rows.to_csv(index=False))
    text = summary(rows)
    report.write(out / "summary.md", text)
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def summary(rows: pd.DataFrame) -> str:
    """Means and worst over the shapes of each method, then TubeDS beside the best other, shape by shape."""
    each = rows.groupby(["demonstration", "method"], sort=False)[list(FIGURES)].mean()
    each["command"] = rows.groupby(["demonstration", "method"], sort=False)["command"].max()
    methods = rows["method"].unique().tolist()
    of_methods = each.groupby("method")
    mean, worst = of_methods.mean(), of_methods.max()
    means = [[one, *(f"{mean[key][one]:.3g} ({worst[key][one]:.3g})" for key in FIGURES)] for one in methods]
    shapes = []
    for name in rows["demonstration"].unique():
        here = each.loc[name]
        others = here.drop("TubeDS", errors="ignore")["test_rmse"]
        best = f"{others.min():.3g} ({others.idxmin()})" if others.notna().any() else "—"
        shapes.append([name, *(f"{here.loc['TubeDS', key]:.3g}" for key in FIGURES), best])
    head = list(FIGURES.values())
    return "\n\n".join(
        [
            "Mean over the shapes, and the worst of them:",
            report.table(["method", *head], means),
            "TubeDS, and the least velocity RMSE of the others:",
            report.table(["shape", *head, "another's RMSE"], shapes),
        ]
    )


if __name__ == "__main__":
    typer.run(main)
