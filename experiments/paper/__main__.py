"""The paper, reproduced: its tables, figures and claims, set beside ours.

    python -m experiments.paper [--quick] [--out results/paper] [--doc docs/reproduction.md] [--data FOLDER] [--jobs N]

Writes the report ``--doc`` with its pictures, from this run's results only. Finished cells are kept in cells.sqlite and
tuning in optuna.sqlite, both in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import joblib
import typer
from rich.console import Console

from experiments import report
from experiments.compared import recordings
from experiments.paper.document import Document
from experiments.paper.framework import framework
from experiments.paper.joints import joints
from experiments.paper.latent_space import latent_space
from experiments.paper.maps import maps
from experiments.paper.planes import orbits, planes
from experiments.paper.sensitivity import sensitivity
from experiments.paper.similarity import replications, similarity
from experiments.paper.study import FULL, QUICK, Plan, Study
from experiments.paper.table_one import table_one, tuned
from experiments.paper.table_two import table_two
from experiments.paper.works import works
from latentds import Demonstration

SECTIONS: dict[str, Callable[[Study, Document], None]] = {
    "The framework": framework,
    "Table I: the paper's hyperparameters": table_one,
    "Tuning by the paper's rule": tuned,
    "Claims about the latent space": latent_space,
    "Another graph, another map": maps,
    "Two dimensions: Archimedean spiral and drawn characters": planes,
    "Joint space, Table III": joints,
    "Sensitivity": sensitivity,
    "Similarity scores and p-values": similarity,
    "Table II: SDS-EF": table_two,
    "Replications": replications,
    "DMP's forward orbits": orbits,
    "Every method that the paper cites": works,
}


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
    n_jobs = joblib.cpu_count() if jobs is None else jobs
    reproduce(QUICK if quick else FULL, out, doc, n_jobs, recordings([data] if data else []))


def reproduce(plan: Plan, out: Path, doc: Path, jobs: int, recorded: Sequence[Demonstration] = ()) -> None:
    """Write the report ``doc``; ``out`` is the folder of what is kept, ``recorded`` are joint motions for ours."""
    out.mkdir(parents=True, exist_ok=True)
    doc.parent.mkdir(parents=True, exist_ok=True)
    console, began = Console(), time.perf_counter()
    study = Study(plan, out, jobs, recorded)
    document = Document(doc.parent / "images" / "reproduction")
    with report.interruptible(console):
        for title, section in SECTIONS.items():
            since = time.perf_counter()
            document.add(f"## {title}")
            section(study, document)
            console.print(f"{title}: {time.perf_counter() - since:.0f} s")
    seconds = time.perf_counter() - began
    report.write(doc, document.text(plan.quick, bool(recorded), seconds))
    report.write(out / "environment.json", report.environment())
    console.print(f"{doc}: written after {seconds:.0f} s")


if __name__ == "__main__":
    typer.run(main)
