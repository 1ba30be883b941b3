"""The paper, reproduced: its tables, figures and claims, set beside ours.

    python -m experiments.paper [--quick] [--out results/paper] [--doc docs/reproduction.md] [--data FOLDER] [--jobs N]

Writes the report ``--doc`` with its pictures, from this run's results only. Finished cells are kept in cells.sqlite and
tuning in optuna.sqlite, both in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import joblib
import typer
from rich.console import Console

from experiments import report
from experiments.sections import STEPS
from experiments.study import FULL, QUICK, SIMILAR, Report, Study


def main(
    quick: Annotated[bool, typer.Option(help="Three spirals, small grids and budgets: a few minutes.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of what is kept; results/paper by default.")] = None,
    doc: Annotated[
        Path | None, typer.Option(help="The report; docs/reproduction.md, or with --quick in --out.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of .npz or .csv joint motions, for ours.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
) -> None:
    """Reproduce the paper. An interrupted run goes on where it stopped."""
    plan = QUICK if quick else FULL
    out = out or Path("results/paper-quick" if quick else "results/paper")
    doc = doc or (out / "reproduction.md" if quick else Path("docs/reproduction.md"))
    out.mkdir(parents=True, exist_ok=True)
    doc.parent.mkdir(parents=True, exist_ok=True)
    console, began = Console(), time.perf_counter()
    study = Study(plan, out, joblib.cpu_count() if jobs is None else jobs)
    found = Report(doc.parent / "images" / "reproduction")
    try:
        for title, step in STEPS.items():
            since = time.perf_counter()
            found.add(f"## {title}")
            step(study, found, data)
            console.print(f"{title}: {time.perf_counter() - since:.0f} s")
    except KeyboardInterrupt:
        console.print("Interrupted; the same command goes on from here.")
        raise typer.Exit(130) from None
    seconds = time.perf_counter() - began
    report.write(doc, text(found, quick, data, seconds))
    report.write(out / "environment.json", report.environment())
    console.print(f"{doc}: written after {seconds:.0f} s")


def text(found: Report, quick: bool, data: Path | None, seconds: float) -> str:
    """The report."""
    where = report.environment()
    packages = ", ".join(f"{name} {version}" for name, version in where["packages"].items())
    scope = (
        "**A quick run: fewer spirals, small grids, short training of SDS-EF. Its figures are not the full run's.**"
        if quick
        else "The full run."
    )
    return "\n\n".join(
        [
            "# The paper beside what we measure",
            f"Written by `make paper{' ARGS=--quick' if quick else ''}`; do not edit. {scope}",
            f"Took {seconds:.0f} s (less what an earlier run had kept) on {where['cores']} cores ({where['cpu']}), "
            f"{where['date'][:10]}, revision {where['revision']}; {packages}."
            + (" Joint motions: recordings given by `--data`." if data else ""),
            "The paper is Gupta, Nayak and Billard, *Learning High Dimensional Demonstrations Using Laplacian "
            f"Eigenmaps*. A figure counts as *reproduced* within a factor {SIMILAR:g} of the paper's, beyond it as "
            "*better* or *worse*. Where the paper is silent, our readings are in [corrections](corrections.md).",
            "## Summary",
            report.table(["what", "paper", "ours", "verdict"], [list(line) for line in found.findings]),
            *found.parts,
            "",
        ]
    )


if __name__ == "__main__":
    typer.run(main)
