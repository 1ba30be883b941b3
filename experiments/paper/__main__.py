"""The paper, reproduced: its tables, figures and claims, set beside ours.

    python -m experiments.paper [--quick] [--out results/paper] [--doc docs/reproduction.md] [--data FOLDER] [--jobs N]

Writes the report ``--doc`` with its pictures, from this run's results only. Finished cells are kept in cells.sqlite and
tuning in optuna.sqlite, both in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import joblib
import typer
from rich.console import Console

from experiments import report
from experiments.compared import recordings
from experiments.paper.document import Document
from experiments.paper.plan import FULL, QUICK, Plan
from experiments.paper.sections import STEPS
from experiments.paper.study import Study
from latentds import Demonstration


def main(
    quick: Annotated[bool, typer.Option(help="Three spirals, small grids and budgets: a few minutes.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of what is kept; results/paper by default.")] = None,
    doc: Annotated[
        Path | None, typer.Option(help="The report; docs/reproduction.md, or with --quick in --out.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder or file of joint motions, for ours.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
) -> None:
    """Reproduce the paper. An interrupted run goes on where it stopped."""
    out = out or Path("results/paper-quick" if quick else "results/paper")
    doc = doc or (out / "reproduction.md" if quick else Path("docs/reproduction.md"))
    try:
        recorded = recordings([data] if data else [])
    except (ValueError, FileNotFoundError) as error:
        raise typer.BadParameter(str(error)) from None
    reproduce(QUICK if quick else FULL, out, doc, joblib.cpu_count() if jobs is None else jobs, recorded)


def reproduce(plan: Plan, out: Path, doc: Path, jobs: int, recorded: Sequence[Demonstration] = ()) -> None:
    """Write the report ``doc``; ``out`` is the folder of what is kept, ``recorded`` are joint motions for ours."""
    out.mkdir(parents=True, exist_ok=True)
    doc.parent.mkdir(parents=True, exist_ok=True)
    console, began = Console(), time.perf_counter()
    study = Study(plan, out, jobs, recorded)
    found = Document(doc.parent / "images" / "reproduction")
    try:
        for title, step in STEPS.items():
            since = time.perf_counter()
            found.add(f"## {title}")
            step(study, found)
            console.print(f"{title}: {time.perf_counter() - since:.0f} s")
    except KeyboardInterrupt:
        console.print("Interrupted; the same command goes on from here.")
        raise typer.Exit(130) from None
    seconds = time.perf_counter() - began
    report.write(doc, found.text(plan.quick, bool(recorded), seconds))
    report.write(out / "environment.json", report.environment())
    console.print(f"{doc}: written after {seconds:.0f} s")


if __name__ == "__main__":
    typer.run(main)
