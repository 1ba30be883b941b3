"""The plan's motions, their tuning and the main comparison, each computed once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from baselines import SDSEF
from experiments.compared import RIVALS, greedy, spiral
from experiments.paper import tuning
from experiments.paper.held_out import held_out
from experiments.paper.plan import Plan
from experiments.published import TABLE_ONE, TABLE_TWO, Setting
from latentds import Demonstration
from latentds.benchmark import Cell, Outcome, RolloutProtocol, run
from latentds.fitting.tuning import Choice, Tried, choose

SDS_EF = ("SDS-EF", "SDS-EF official")
"""By our recipe, and by its authors'."""


class Study:
    """What several sections draw on.

    Args:
        plan: how much is done.
        out: folder of what is kept.
        jobs: processes.
        recorded: joint motions; made-up ones if there are none.
    """

    def __init__(self, plan: Plan, out: Path, jobs: int, recorded: Sequence[Demonstration] = ()) -> None:
        self.plan, self.jobs, self.recorded = plan, jobs, recorded
        self.store = out / "cells.sqlite"
        self.tuner = tuning.Tuner(out / "optuna.sqlite", jobs)
        self.spirals = [spiral(name) for name in plan.spirals]
        self._tuned: dict[tuple[str, str], tuple[list[Tried], list[Tried]]] = {}

    def tried(self, method: str, shown: Demonstration) -> tuple[list[Tried], list[Tried]]:
        """Of the grid, and of TPE."""
        key = method, shown.name
        if key not in self._tuned:
            self._tuned[key] = self.tuner.greedy(method, shown, self.plan.grid)
        return self._tuned[key]

    def choice(self, method: str, shown: Demonstration) -> Choice:
        return choose(self.tried(method, shown)[0])

    def setting(self, method: str, shown: Demonstration) -> Setting:
        """The paper's where it prints one, else its rule's with the least β."""
        return TABLE_ONE[method].get(shown.name) or tuning.setting(self.choice(method, shown).least_beta)

    def protocol(self, *, n_starts: int | None = None, radius: float = 0.1) -> RolloutProtocol:
        """The plan's; ``n_starts`` of its own if given."""
        return RolloutProtocol(self.plan.n_starts if n_starts is None else n_starts, radius, self.plan.n_points)

    def run(self, cells: Iterable[Cell], protocol: RolloutProtocol) -> list[Outcome]:
        return list(run(cells, protocol, n_jobs=self.jobs, progress=True, store=self.store))

    @cached_property
    def outcomes(self) -> list[Outcome]:
        """Of every method on every spiral, from the demonstrated start and those around it."""
        cells = [make(shown) for make in (self._official, self._tuned_recipe) for shown in self.spirals]
        for shown in self.spirals:
            for method in RIVALS:
                chosen = self.choice(method, shown)
                for label, setting in {
                    method: self.setting(method, shown),
                    f"{method}, least β": tuning.setting(chosen.least_beta),
                    f"{method}, least MSE": tuning.setting(chosen.least_mse),
                }.items():
                    cells.append(Cell(label, greedy(method, setting), shown))
        return self.run(cells, self.protocol())

    def _official(self, shown: Demonstration) -> Cell:
        """SDS-EF by its authors' recipe and the paper's split, with the paper's size where it prints one."""
        size = TABLE_TWO.get(shown.name, ())[:2] if self.plan.printed else ()
        n_layers, n_features = size or self.plan.official
        return held_out(shown, n_layers, n_features, self.plan.official_epochs, SDS_EF[1])

    def _tuned_recipe(self, shown: Demonstration) -> Cell:
        n_layers, n_features = self.plan.tuned
        factory = partial(SDSEF, n_layers=n_layers, n_features=n_features, epochs=self.plan.tuned_epochs)
        return Cell(SDS_EF[0], factory, shown)

    @cached_property
    def rows(self) -> pd.DataFrame:
        return rows(self.outcomes)

    def scores(self, score: str) -> dict[str, dict[str, NDArray[np.float64]]]:
        """{spiral: {method: its scores from the perturbed starts}}, the four methods of the figure."""
        near = self.rows[self.rows["start"] > 0].groupby(["demonstration", "method"])[score]
        return {d.name: {m: near.get_group((d.name, m)).to_numpy() for m in (*RIVALS, *SDS_EF)} for d in self.spirals}


def rows(outcomes: Iterable[Outcome]) -> pd.DataFrame:
    return pd.DataFrame([row for outcome in outcomes for row in outcome.rows])


def paths(outcomes: Iterable[Outcome], name: str, methods: Iterable[str]) -> dict[str, NDArray[np.float64]]:
    """{method: its rollouts} on the motion of that name."""
    moved = {o.method: o.paths for o in outcomes if o.demonstration == name}
    return {method: moved[method] for method in methods}
