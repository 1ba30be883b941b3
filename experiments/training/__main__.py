"""Stable systems inside other torch models: three scripts, each plain torch.

    python -m experiments.training [via-point] [density] [context] [--quick] [--seed 0] [--out results/training]

Leaves summary.md, picture.png, environment.json and checkpoint.pt in a folder of ``--out`` for each. A run that was
stopped, in whatever way, goes on from its checkpoint with the same command, and ends where it would have ended.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from experiments import report
from experiments.training import context, density, via_point
from experiments.training.loop import Learned


class Script(str, Enum):
    VIA_POINT = "via-point"
    DENSITY = "density"
    CONTEXT = "context"

    @property
    def learn(self) -> Callable[[bool, int, Path], Learned]:
        return {"via-point": via_point.learn, "density": density.learn, "context": context.learn}[self.value]


def main(
    scripts: Annotated[list[Script] | None, typer.Argument(help="Which; all by default.")] = None,
    quick: Annotated[bool, typer.Option(help="Small models and few steps: seconds.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is drawn.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder; results/training by default.")] = None,
) -> None:
    """Train. An interrupted run goes on where it stopped."""
    out, console = out or Path("results/training-quick" if quick else "results/training"), Console()
    for script in scripts or Script:
        with report.interruptible(console):
            learned = run(script, quick, seed, out)
        console.print(summary(learned), markup=False, highlight=False, soft_wrap=True)


def run(script: Script, quick: bool, seed: int, out: Path) -> Learned:
    folder = out / script.value
    folder.mkdir(parents=True, exist_ok=True)
    learned = script.learn(quick, seed, folder)
    report.write(folder / "summary.md", f"# {script.value}\n\n{summary(learned)}")
    report.write(folder / "environment.json", report.environment() | {"quick": quick, "seed": seed})
    learned.figure.savefig(folder / "picture.png")
    return learned


def summary(learned: Learned) -> str:
    steps = [f"{len(learned.history)} steps", ""]
    numbers = {"first loss": learned.history[0], "last loss": learned.history[-1], **learned.numbers}
    rows = [[what, f"{value:.3g}"] for what, value in numbers.items()]
    return f"{report.table(steps, rows)}\n\n{learned.notes}\n"


if __name__ == "__main__":
    typer.run(main)
