"""How much of the paper is reproduced, all of it or a quick part, and what several sections draw on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.compared import spiral
from experiments.paper import tuning
from experiments.published import TABLE_ONE, Setting
from latentds import Demonstration, datasets
from latentds.benchmark import Cell, Paths, RolloutProtocol, run, table
from latentds.fitting.tuning import Choice, Tried, choose


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        spirals, sensitive: names of spirals; the latter are varied.
        grid: of the greedy methods.
        official, tuned: SDS-EF's (L, n_f) where the paper prints none, by either recipe; ``printed`` whether its own
            are used where it does.
        official_epochs, tuned_epochs: most epochs of either recipe; None: the recipe's own.
        layers, features, epochs: SDS-EF's grid, and the epochs of its trials.
        strokes, lasa, arms: planar motions, shapes of handwriting and cases of the joint-space study.
        n_starts, n_points: of the protocol.
        quick: whether the report must say that it is not the whole.
    """

    spirals: tuple[str, ...] = tuple(d.name for d in datasets.spiral_suite(3))
    sensitive: tuple[str, ...] = ("unstable c=3", "unstable c=7", "unstable c=10", "stable c=3")
    grid: tuning.Grid = tuning.FULL
    official: tuple[int, int] = (10, 200)
    tuned: tuple[int, int] = (10, 200)
    printed: bool = True
    official_epochs: int = 5000
    tuned_epochs: int | None = None
    layers: tuple[int, ...] = (10, 20)
    features: tuple[int, ...] = (150, 300)
    epochs: int = 1000
    strokes: tuple[str, ...] = tuple(datasets.STROKES)
    lasa: tuple[str, ...] = ("GShape", "JShape", "Khamesh", "Sshape")
    arms: int = 6
    n_starts: int = 20
    n_points: int = 500
    quick: bool = False


FULL = Plan()
QUICK = Plan(
    spirals=("unstable c=1", "unstable c=7", "stable c=3"), sensitive=("unstable c=7",), grid=tuning.QUICK,
    official=(4, 40), tuned=(4, 60), printed=False, official_epochs=300, layers=(2, 4), features=(40,), epochs=100,
    strokes=("hook", "curl"), lasa=(), arms=2, quick=True,
)  # fmt: skip


class Study:
    """The plan's motions, their tuning, each computed once, and cells that are kept.

    Args:
        plan: how much is done.
        out: folder of what is kept.
        jobs: processes.
        recorded: joint motions; made-up ones if there are none.
    """

    def __init__(self, plan: Plan, out: Path, jobs: int, recorded: Sequence[Demonstration] = ()) -> None:
        self.plan, self.out, self.jobs, self.recorded = plan, out, jobs, recorded
        self.spirals = [spiral(name) for name in plan.spirals]
        self._tried: dict[tuple[str, str], tuple[list[Tried], list[Tried]]] = {}

    def tried(self, method: str, shown: Demonstration) -> tuple[list[Tried], list[Tried]]:
        """On the grid, and by TPE."""
        key = method, shown.name
        if key not in self._tried:
            self._tried[key] = tuning.tune(method, shown, self.plan.grid, self.out / "optuna.sqlite", self.jobs)
        return self._tried[key]

    def choice(self, method: str, shown: Demonstration) -> Choice:
        """By the paper's rule."""
        return choose(self.tried(method, shown)[0])

    def least_beta(self, method: str, shown: Demonstration) -> Setting:
        """The rule's with the least β."""
        return setting(self.choice(method, shown).least_beta)

    def setting(self, method: str, shown: Demonstration) -> Setting:
        """The paper's where it prints one, else its rule's with the least β."""
        return TABLE_ONE[method].get(shown.name) or self.least_beta(method, shown)

    def protocol(self, *, n_starts: int | None = None, radius: float = 0.1) -> RolloutProtocol:
        """The plan's; ``n_starts`` of its own if given."""
        return RolloutProtocol(self.plan.n_starts if n_starts is None else n_starts, radius, self.plan.n_points)

    def run(self, cells: Sequence[Cell], protocol: RolloutProtocol) -> tuple[pd.DataFrame, Paths]:
        """Their rows and rollouts; finished cells come from the store."""
        paths: Paths = {}
        outcomes = run(cells, protocol, n_jobs=self.jobs, progress=True, store=self.out / "cells.sqlite")
        return table(cells, outcomes, paths), paths


def setting(tried: Tried) -> Setting:
    return Setting(*tried[:4])


def brief(chosen: Setting) -> str:
    """A cell of the tables, "β / μ / M: MSE"."""
    return f"{chosen.beta:g} / {chosen.mu:g} / {chosen.n_layers}: {chosen.mse:.1e}"
