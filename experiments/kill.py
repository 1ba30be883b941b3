"""Kill real runs at random moments (SIGKILL), start them again, and look for rows that are lost, double or different.

python -m experiments.kill [--kills 20] [--seed 0]
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from baselines import FDM
from latentds import ChebyshevDS, datasets
from latentds.benchmark import Cell, RolloutProtocol, run
from latentds.cache import CellStore

PROTOCOL = RolloutProtocol(n_starts=2, n_points=60)
TIMES = ("fit_seconds", "rollout_seconds")


def cells(n_seeds: int) -> list[Cell]:
    """Many short ones, so that a random moment is often one of writing."""
    shown = [datasets.unstable_spiral(c, 100) for c in (1, 3, 7)]
    methods = {"Chebyshev": lambda dim: ChebyshevDS(dim, n_layers=10), "FDM": lambda dim: FDM(dim, n_layers=10)}
    return [Cell(m, f, d, seed) for seed in range(n_seeds) for d in shown for m, f in methods.items()]


def work(store: str | None, jobs: int, n_seeds: int) -> list[tuple]:
    """The run that is killed. Returns its rows without their times, sorted."""
    rows = [row for outcome in run(cells(n_seeds), PROTOCOL, n_jobs=jobs, store=store) for row in outcome.rows]
    return sorted(tuple((name, value) for name, value in row.items() if name not in TIMES) for row in rows)


def main(
    kills: Annotated[int, typer.Option(help="How many runs to kill, at least.")] = 20,
    seed: Annotated[int, typer.Option(help="Of the random moments.")] = 0,
    n_seeds: Annotated[int, typer.Option(help="A run has six cells of each.")] = 60,
) -> None:
    """Kill runs, then compare what they left with a run that nobody killed."""
    dice = random.Random(seed)
    undisturbed = work(None, 1, n_seeds)
    survived = rounds = 0
    while survived < kills:
        rounds += 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "cells.sqlite"
            survived += _disturb(path, dice, kills - survived, n_seeds)
            if work(str(path), 1, n_seeds) != undisturbed:
                raise SystemExit("kill: the rows are not those of an undisturbed run")
            with CellStore(path) as store:
                if len(store) != len(cells(n_seeds)):
                    raise SystemExit(f"kill: expected {len(cells(n_seeds))} cells in the file, got {len(store)}")
    print(
        f"{survived} runs killed in {rounds} files of {len(cells(n_seeds))} cells: every file opened, no cell lost or "
        f"double, all {len(undisturbed)} rows equal to those of an undisturbed run"
    )


def _disturb(path: Path, dice: random.Random, most: int, n_seeds: int) -> int:
    """Start the run and kill it, again and again, until it is done or ``most`` were killed. Returns how many were."""
    before: set[str] = set()
    for count in range(most):
        jobs = dice.choice((1, 2))
        command = f"from experiments.kill import work; work({str(path)!r}, {jobs}, {n_seeds})"
        child = subprocess.Popen([sys.executable, "-c", command], start_new_session=True)
        try:
            _wait_for_more_than(len(before), path, child)
            time.sleep(dice.uniform(0, 0.5))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # its workers, too
        killed = child.wait() == -signal.SIGKILL
        with CellStore(path) as store:
            after = store.keys()
        if not before <= after:
            raise SystemExit(f"kill: {len(before - after)} cells were lost")
        print(
            f"{'killed' if killed else 'ended'} with {jobs} jobs: {len(after)} cells, {len(after - before)} of them new"
        )
        before = after
        if not killed:
            return count
    return most


def _wait_for_more_than(n_cells: int, path: Path, child: subprocess.Popen) -> None:
    """Let the run come to where it writes; most of its time goes into starting Python."""
    while child.poll() is None:
        if path.exists():
            with CellStore(path) as store:
                if len(store) > n_cells:
                    return
        time.sleep(0.01)


if __name__ == "__main__":
    typer.run(main)
