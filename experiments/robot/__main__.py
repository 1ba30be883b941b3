"""The paper's last section on a simulated arm: what was learned, run by torques, touched, and scored beside Table III.

    python -m experiments.robot [--quick] [--data FILE …] [--out results/robot] [--doc PAGE.md] [--jobs N]

Needs no display. Leaves rows.csv, robot.md and pictures in ``--out``.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from baselines import FDM
from experiments import report
from experiments.compared import recordings
from experiments.robot import page
from experiments.robot.arm import KINESTHETIC, Arm, archimedean, kinesthetic, unstable
from experiments.robot.runs import measured
from latentds import ChebyshevDS, Demonstration, TubeDS
from latentds.benchmark import Cell, Factory, Outcome, RolloutProtocol, run, table

PROTOCOL = RolloutProtocol(n_starts=0, n_points=100, fast_dtw=False)
METHODS: dict[str, Factory] = {
    "Chebyshev": partial(ChebyshevDS, n_layers=None),
    "FDM": partial(FDM, n_layers=None),
    "TubeDS": TubeDS,
}


def main(
    quick: Annotated[bool, typer.Option(help="Two motions: less than a minute.")] = False,
    data: Annotated[list[Path] | None, typer.Option(help="Recordings of yours, of seven joint angles in rad.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for rows, page and pictures.")] = Path("results/robot"),
    doc: Annotated[
        Path | None, typer.Option(help="A Markdown page to write, too; pictures go to images/robot.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
) -> None:
    """Run what was learned on the arm.

    Finished cells are kept in cells.sqlite beside the results: an interrupted run goes on where it stopped.
    """
    console = Console(width=None if sys.stdout.isatty() else 120)
    yours = recordings(data or [])
    if wrong := [one.name for one in yours if one.dim != 7]:
        raise typer.BadParameter(f"data: expected seven joint angles, got {', '.join(wrong)} of another dimension")
    every = motions(quick) + yours
    out.mkdir(parents=True, exist_ok=True)
    cells = [Cell(label, make, shown, measure=measured) for shown in every for label, make in METHODS.items()]
    done: list[Outcome] = []
    with report.interruptible(console):
        done.extend(run(cells, PROTOCOL, n_jobs=jobs, progress=True, store=out / "cells.sqlite"))
    rows = table(cells, done).rename(columns={"demonstration": "motion"})
    rows["dim"] = rows["motion"].map({one.name: one.dim for one in every})
    failed = rows[rows["status"] != "ok"]
    rows = rows[rows["status"] == "ok"]
    report.write(out / "rows.csv", rows.drop(columns="drawn").to_csv(index=False))
    folder = out if doc is None else doc.parent
    drawn = page.pictures(rows, every, folder / "images" / "robot")
    text = page.document(rows, drawn)
    report.write(out / "robot.md" if doc is None else doc, text)
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    for row in failed.to_dict("records"):
        console.print(f"failed: {row['method']} on {row['motion']}: {row['error']}", markup=False)


def motions(quick: bool) -> list[Demonstration]:
    """The paper's two of the tool, and six made-up ones of the joints."""
    arm = Arm()
    tools = [archimedean()] if quick else [archimedean(), unstable()]
    return [*tools, *(kinesthetic(arm, seed) for seed in range(1 if quick else len(KINESTHETIC)))]


if __name__ == "__main__":
    typer.run(main)
