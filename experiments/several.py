"""The study of methods that learn from several demonstrations of one motion, on handwriting.

    python -m experiments.several [PROTOCOLS] [--quick] [--out results/several] [--jobs N]

Four protocols on the 26 shapes of LASA, which `make lasa` installs: leave-one-out, one-to-others, A and C, all of them
unless some are named; ``PROTOCOLS`` below defines each. Prints a table for each, and leaves rows.csv of each and
summary.md in ``--out``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pandas as pd
import typer
from rich.console import Console

from baselines import CLFDM, DMP, LPVDS, SDSEF, SEDS, ProMP
from experiments import report
from experiments.compared import handwriting
from experiments.field.protocols import (
    leave_one_out,
    one_to_others,
    path_errors,
    protocol_a,
    protocol_c,
    thinned,
    velocity_errors,
)
from experiments.field.references import CURVES, nearest_velocity, plain_mean
from latentds import Demonstration, TubeDS, metrics
from latentds.benchmark import Cell, Factory, RolloutProtocol, run, table

ROLLOUT = RolloutProtocol(n_starts=0, n_points=500)
QUICK = ("Angle", "CShape", "Zshape")
QUICK_FOLDS = 1
"""Of a shape's seven, in leave-one-out and one-to-others."""
SLOW = {"SDS-EF": QUICK}
"""Methods too slow for all shapes, and those that they learn; a quick run leaves them out."""
NO_BETTER = 1.1
"""TubeDS is named where it is farther from the judges than so many times the plain mean."""


def curve_rows(cell: Cell) -> list[dict[str, Any]]:
    """What each curve of the references would score as the rollout of this cell."""
    return [
        {"method": label, "demonstration": cell.demonstration, "judge": judge.name}
        | {"dtw_per_point": metrics.dtw(path, ROLLOUT.reference(judge)) / ROLLOUT.n_points}
        for judge in cell.judges
        for label, curve in CURVES.items()
        for path in [curve(cell.shown, judge.start, ROLLOUT.times(judge))]
    ]


def in_sample_rows(cell: Cell) -> list[dict[str, Any]]:
    """What the plain mean would score in protocol A."""
    judges = [thinned(one, 10) for one in cell.shown]
    errors = path_errors([plain_mean(cell.shown, one.start, one.times) for one in judges], judges)
    return [{"method": "plain mean", "judge": cell.judges[0].name} | errors]


def velocity_rows(cell: Cell) -> list[dict[str, Any]]:
    """What the velocity of the nearest sample shown would score in protocol C, which has no rollouts of it."""
    errors = velocity_errors(partial(nearest_velocity, cell.shown), cell.judges)
    return [
        {"method": "nearest velocity", "judge": cell.judges[0].name}
        | {f"test_{what}": value for what, value in errors.items()}
    ]


class Protocol(NamedTuple):
    """What is shown, what judges, and which figures are told."""

    definition: str
    figures: dict[str, str]
    """What its table has, by column."""
    methods: dict[str, Factory]
    cells: Callable[[str, Factory, list[Demonstration]], list[Cell]]
    """Of a method and a shape."""
    references: Callable[[Cell], list[dict[str, Any]]]
    """Rows of what is no method, for what a cell shows and what judges it."""


PROTOCOLS = {
    "leave-one-out": Protocol(
        "Leave-one-out: six of the seven are fitted, and the seventh judges a motion from its start over its times; "
        "all seven folds. Rollout: exact DTW over 500 points / 500 / size of the demonstration that judges.",
        {"distance": "rollout [sizes]"},
        {"TubeDS": TubeDS, "ProMP": ProMP},
        lambda label, factory, shape: [leave_one_out(label, factory, shape, i) for i in range(len(shape))],
        curve_rows,
    ),
    "one-to-others": Protocol(
        "One to others: one is fitted, the starts and paths of the six others judge; all seven. Rollout as in "
        "leave-one-out; the plain mean of one is its own path.",
        {"distance": "rollout [sizes]"},
        {"TubeDS": TubeDS},
        lambda label, factory, shape: [one_to_others(label, factory, shape, i) for i in range(len(shape))],
        curve_rows,
    ),
    "A": Protocol(
        "Protocol A, in sample: all seven are fitted; from their starts, step k against sample k, samples 0, 10, …, "
        "990. RMSE: root of the mean over points and coordinates; DTWD: exact DTW / 100; FD: discrete Fréchet "
        "distance; means over the demonstrations.",
        {"rmse": "RMSE [mm]", "dtwd": "DTWD [mm]", "fd": "FD [mm]"},
        {"TubeDS": TubeDS, "ProMP": ProMP, "CLF-DM": CLFDM, "LPV-DS": LPVDS},
        lambda label, factory, shape: [protocol_a(label, factory, shape)],
        in_sample_rows,
    ),
    "C": Protocol(
        "Protocol C, held out: demonstrations 1 to 4 are fitted, 5 to 7 judge, every second sample. Velocity RMSE: "
        "mean over samples of the root of the mean over coordinates; ė: mean of 1 - cos; rollout as in leave-one-out; "
        "DTWD: exact DTW over 500 points, a raw sum; largest command: over the largest speed shown, from the starts "
        "shown.",
        {
            "test_rmse": "velocity RMSE [mm/s]",
            "test_e": "ė",
            "distance": "rollout [sizes]",
            "dtw": "DTWD [mm]",
            "command": "largest command",
        },
        {"TubeDS": TubeDS, "CLF-DM": CLFDM, "ProMP": ProMP, "DMP": DMP, "LPV-DS": LPVDS, "SEDS": SEDS, "SDS-EF": SDSEF},
        lambda label, factory, shape: [protocol_c(label, factory, shape)],
        velocity_rows,
    ),
}


def main(
    protocols: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(PROTOCOLS)}; all by default.")] = None,
    quick: Annotated[bool, typer.Option(help="Three shapes, a fold of each, no SDS-EF.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for rows and summary.")] = Path("results/several"),
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
) -> None:
    """Compare methods that learn from several demonstrations, on motions that they were shown or not.

    Finished cells are kept in cells.sqlite beside the results: an interrupted run goes on where it stopped.
    """
    chosen = list(dict.fromkeys(protocols or PROTOCOLS))
    if unknown := [name for name in chosen if name not in PROTOCOLS]:
        raise typer.BadParameter(f"protocols: expected some of {', '.join(PROTOCOLS)}, got {unknown[0]!r}")
    console, shapes = Console(width=120), numbered(handwriting())
    if not shapes:
        raise typer.BadParameter("LASA handwriting is not installed: run `make lasa` once")
    shapes = {name: shape for name, shape in shapes.items() if not quick or name in QUICK}
    out.mkdir(parents=True, exist_ok=True)
    told = []
    with report.interruptible(console):
        for name in chosen:
            console.print(name, highlight=False)
            rows = study(PROTOCOLS[name], shapes, quick, jobs, out / "cells.sqlite")
            report.write(out / f"{name} rows.csv", rows.to_csv(index=False))
            told.append(summary(name, rows))
    text = "\n\n".join(told)
    report.write(out / "summary.md", text)
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def numbered(shapes: dict[str, list[Demonstration]]) -> dict[str, list[Demonstration]]:
    """Every demonstration named by shape and number, so that cells of one shape have names of their own."""
    return {
        name: [replace(one, name=f"{name} {i}") for i, one in enumerate(shape, 1)] for name, shape in shapes.items()
    }


def study(
    protocol: Protocol, shapes: dict[str, list[Demonstration]], quick: bool, jobs: int | None, store: Path | None
) -> pd.DataFrame:
    """The rows of a protocol, of methods and references, with the columns "shape" and, of rollouts, "distance"."""
    cells = [
        cell
        for name, shape in shapes.items()
        for label, factory in protocol.methods.items()
        if label not in SLOW or (name in SLOW[label] and not quick)
        for cell in protocol.cells(label, factory, shape)[: QUICK_FOLDS if quick else None]
    ]
    done = list(run(cells, ROLLOUT, n_jobs=jobs, progress=True, store=store))
    first = next(iter(protocol.methods))
    beside = [row for cell in cells if cell.method == first for row in protocol.references(cell)]
    rows = pd.concat([table(cells, done), pd.DataFrame(beside)], ignore_index=True)
    rows["shape"] = rows["judge"].str.rsplit(" ", n=1).str[0]
    sizes = {judge.name: judge.size for cell in cells for judge in cell.judges}
    rows["distance"] = rows["dtw_per_point"] / rows["judge"].map(sizes)
    return rows


def summary(name: str, rows: pd.DataFrame) -> str:
    """A protocol's definition, mean and worst over the shapes of each method, and what else it is asked for."""
    protocol = PROTOCOLS[name]
    head, figures = list(protocol.figures.values()), list(protocol.figures)
    each = rows.groupby(["shape", "method"], sort=False)[figures].mean()
    of_methods = each.groupby("method")
    mean, worst = of_methods.mean(), of_methods.max()
    means = [
        [one, *("—" if pd.isna(mean[key][one]) else f"{mean[key][one]:.3g} ({worst[key][one]:.3g})" for key in figures)]
        for one in rows["method"].unique()
    ]
    parts = [
        protocol.definition,
        f"Mean over the {rows['shape'].nunique()} shapes, and the worst of them:",
        report.table(["method", *head], means),
        *partial_or_failed(rows),
    ]
    if name == "leave-one-out":
        ratio = each["distance"].xs("TubeDS", level="method") / each["distance"].xs("plain mean", level="method")
        worse = [f"{shape} {value:.2f}" for shape, value in ratio[ratio > NO_BETTER].items()]
        parts.append(
            f"TubeDS is more than 10 % farther off than the plain mean, times, on: {', '.join(worse) or 'none'}"
        )
    if name == "C":
        parts += ["TubeDS, and the least velocity RMSE of the others:", shape_by_shape(each, protocol.figures)]
    return "\n\n".join(parts)


def partial_or_failed(rows: pd.DataFrame) -> list[str]:
    """Which methods did not learn every shape, and whose rollouts are missing from the means."""
    count = rows["shape"].nunique()
    some = rows.groupby("method", sort=False)["shape"].unique()
    lines = [f"{one} learned {', '.join(shapes)} alone." for one, shapes in some.items() if len(shapes) < count]
    failed = rows[rows["status"].isin(("failed", "diverged"))].groupby("method").size()
    return [*lines, *(f"{one}: {number} rollouts failed and are left out." for one, number in failed.items())]


def shape_by_shape(each: pd.DataFrame, figures: dict[str, str]) -> str:
    """TubeDS beside the best other in velocity."""
    shapes = []
    for name in each.index.unique("shape"):
        here = each.loc[name]
        others = here.drop("TubeDS")["test_rmse"].dropna()
        best = f"{others.min():.3g} ({others.idxmin()})" if len(others) else "—"
        shapes.append([name, *(f"{here.loc['TubeDS', key]:.3g}" for key in figures), best])
    return report.table(["shape", *figures.values(), "another's RMSE"], shapes)


if __name__ == "__main__":
    typer.run(main)
