"""Every method of the field under the same protocols: ranks, tables, pictures and a page.

    python -m experiments.field [--quick] [--data FILE …] [--out results/field] [--doc PAGE.md] [--jobs N] [--dask tcp://…]

LASA handwriting, which `make lasa` installs, is most of it; without that the spirals, joint motions and strokes remain.
Leaves rows.csv, summary.md, field.html and pictures in ``--out``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.console import Console

from experiments import report
from experiments.compared import cluster
from experiments.field import page
from experiments.field.methods import DRAWN_AT_RANDOM, METHODS, factory_of
from experiments.field.motions import FIVE, HELD_OUT, Motion, called, motions
from experiments.field.scores import measured, referred
from latentds.benchmark import Cell, Outcome, RolloutProtocol, run, table

PROTOCOL = RolloutProtocol(n_starts=0, n_points=100, fast_dtw=False)
"""Of the few figures that every comparison of the library has; the study's own are in ``scores``."""
SEEDS = (0, 1, 2)
PICTURED = tuple(f"{name} 4" for name in FIVE)


def main(
    quick: Annotated[bool, typer.Option(help="Five motions, one seed: a few minutes.")] = False,
    data: Annotated[list[Path] | None, typer.Option(help="Recordings of yours, or folders of them.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for rows, tables and pictures.")] = Path("results/field"),
    doc: Annotated[
        Path | None, typer.Option(help="A Markdown page to write, too; pictures go to images/field.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
    dask: Annotated[str | None, typer.Option(help="Scheduler of a Dask cluster, tcp://…, to run on.")] = None,
) -> None:
    """Compare every method of the field.

    Finished cells are kept in cells.sqlite beside the results: an interrupted run goes on where it stopped.
    """
    console = Console(width=None if sys.stdout.isatty() else 120)
    every = motions(quick, data or [])
    if not any(motion.protocol == HELD_OUT for motion in every):
        console.print("LASA handwriting is not installed (`make lasa`): spirals, joint motions and strokes alone.")
    out.mkdir(parents=True, exist_ok=True)
    cells = cells_of(every, SEEDS[:1] if quick else SEEDS)
    done: list[Outcome] = []
    with report.interruptible(console), cluster(dask):
        done.extend(run(cells, PROTOCOL, n_jobs=jobs, progress=True, store=out / "cells.sqlite"))
    rows = rows_of(every, cells, done)
    report.write(out / "rows.csv", rows.drop(columns="drawn", errors="ignore").to_csv(index=False))
    text = page.summary(rows, every)
    report.write(out / "summary.md", text)
    pictures = page.pictures(rows, every, out)
    page.write(out / "field.html", rows, every, pictures)
    if doc is not None:
        report.write(doc, page.document(text, page.pictures(rows, every, doc.parent / "images" / "field")))
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    console.print(f"wrote {out / 'field.html'}, with {len(pictures)} pictures")


def cells_of(every: Sequence[Motion], seeds: Sequence[int]) -> list[Cell]:
    """A fit for each method and motion, and further seeds where a fit draws from them; all figures of it at once."""
    return [
        Cell(
            label,
            factory_of(label, motion),
            called(motion.name, motion.shown),
            seed,
            judges=called(motion.name, motion.shown)[0],
            measure=partial(measured, motion=motion, pictured=seed == seeds[0] and is_pictured(motion)),
        )
        for motion in every
        for label in METHODS
        for seed in (seeds if motion.name in PICTURED and label in DRAWN_AT_RANDOM else seeds[:1])
    ]


def is_pictured(motion: Motion) -> bool:
    """Whether a motion's fits are drawn and certified: one of each kind is, and handwriting for the grid."""
    return motion.name in (*PICTURED, "unstable c=7", "arm 0", "hook")


def rows_of(every: Sequence[Motion], cells: Sequence[Cell], done: Sequence[Outcome]) -> pd.DataFrame:
    """A row for each fit, and for each curve that learns nothing, with the columns "motion" and "protocol"."""
    fits = table(cells, done)
    beside = [row | {"demonstration": motion.name, "seed": 0} for motion in every for row in referred(motion)]
    rows = pd.concat([fits, pd.DataFrame(beside)], ignore_index=True).rename(columns={"demonstration": "motion"})
    rows["protocol"] = rows["motion"].map({motion.name: motion.protocol for motion in every})
    return rows


if __name__ == "__main__":
    typer.run(main)
