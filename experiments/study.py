"""What the reproduction's sections draw on: how much is done, tuning and cells, each computed once, and the report."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from baselines import SDSEF
from experiments import claims, figures, tuning
from experiments.claims import KINDS
from experiments.spirals import CHEBYSHEV, RIVALS, STRAIGHT, Setting
from latentds import Demonstration, datasets
from latentds.benchmark import Cell, Outcome, Protocol, run

TABLE_ONE = {"Chebyshev": CHEBYSHEV, "FDM": STRAIGHT}
# The paper's Table II: L, n_f and MSE of SDS-EF.
TABLE_TWO = {
    "unstable c=1": (10, 250, 1.18e-2),
    "unstable c=3": (10, 150, 1.99e-2),
    "unstable c=7": (30, 350, 5.66e-2),
    "unstable c=10": (40, 200, 7.26e-2),
    "unstable c=15": (40, 300, 1.32e-1),
}
# The paper's Table III: FastDTW of six guided motions of an arm, 7-D.
TABLE_THREE = {"a": 25.92, "b": 19.28, "c": 81.25, "d": 9.52, "e": 9.74, "f": 18.31}
SDS_EF = ("SDS-EF", "SDS-EF official")
SIMILAR = 3.0
"""Factor within which a measured figure counts as reproduced."""
NEAR = 0.05
"""Radius of the ball of starts in the plane, in sizes of the motion; the paper's .1 on the spirals' sphere."""


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        spirals, sensitive: names of spirals; the latter are varied.
        grid: of the greedy methods.
        official, tuned: SDS-EF's (L, n_f) where the paper prints none, by either recipe; ``printed`` whether its own
            are used where it does.
        layers, features, epochs: SDS-EF's grid, and the epochs of its trials.
        strokes, arms: planar motions and cases of the joint-space study.
    """

    spirals: tuple[str, ...] = tuple(d.name for d in datasets.spiral_suite(3))
    sensitive: tuple[str, ...] = ("unstable c=3", "unstable c=7", "unstable c=10", "stable c=3")
    grid: tuning.Grid = tuning.FULL
    official: tuple[int, int] = (10, 200)
    tuned: tuple[int, int] = (10, 200)
    printed: bool = True
    patience: int = 5000
    """Most epochs of SDS-EF official."""
    layers: tuple[int, ...] = (10, 20)
    features: tuple[int, ...] = (150, 300)
    epochs: int = 1000
    strokes: tuple[str, ...] = tuple(datasets.STROKES)
    lasa: tuple[str, ...] = ("GShape", "JShape", "Khamesh", "Sshape")
    arms: int = 6


FULL = Plan()
QUICK = Plan(
    spirals=("unstable c=1", "unstable c=7", "stable c=3"),
    sensitive=("unstable c=7",),
    grid=tuning.QUICK,
    official=(4, 40),
    tuned=(4, 60),
    printed=False,
    patience=300,
    layers=(2, 4),
    features=(40,),
    epochs=100,
    strokes=("hook", "curl"),
    lasa=(),
    arms=2,
)


class Finding(NamedTuple):
    """One line of the summary."""

    what: str
    paper: str
    ours: str
    verdict: str


@dataclass
class Report:
    """What the run found so far: the report's text, its summary and its pictures."""

    pictures: Path
    parts: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, *parts: str) -> None:
        self.parts += parts

    def find(self, what: str, paper: str, ours: str, verdict: str) -> None:
        self.findings.append(Finding(what, paper, ours, verdict))

    def show(self, name: str, figure: Figure, caption: str) -> None:
        self.pictures.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.pictures / f"{name}.png", dpi=figures.DPI)
        self.add(f"![{caption}]({self.pictures.parent.name}/{self.pictures.name}/{name}.png)\n\n*{caption}*")


class Study:
    """The plan's motions, their tuning and their cells, each computed once."""

    def __init__(self, plan: Plan, out: Path, jobs: int) -> None:
        self.plan, self.out, self.jobs = plan, out, jobs
        self.tuner = tuning.Tuner(out / "optuna.sqlite", jobs)
        self.spirals = [claims.spiral(name) for name in plan.spirals]
        self._tuned: dict[tuple[str, str], tuple[list[tuning.Tried], list[tuning.Tried]]] = {}
        self._main: list[Outcome] | None = None

    def tried(self, method: str, shown: Demonstration) -> tuple[list[tuning.Tried], list[tuning.Tried]]:
        """Of the grid, and of TPE."""
        key = method, shown.name
        if key not in self._tuned:
            self._tuned[key] = self.tuner.greedy(method, shown, self.plan.grid)
        return self._tuned[key]

    def choice(self, method: str, shown: Demonstration) -> tuning.Choice:
        return tuning.choose(self.tried(method, shown)[0])

    def setting(self, method: str, shown: Demonstration) -> Setting:
        """The paper's where it prints one, else its rule's with the least β."""
        return TABLE_ONE[method].get(shown.name) or setting_of(self.choice(method, shown).least_beta)

    def run(self, cells: Iterable[Cell], protocol: Protocol) -> list[Outcome]:
        return list(run(cells, protocol, n_jobs=self.jobs, progress=True, store=self.out / "cells.sqlite"))

    def outcomes(self) -> list[Outcome]:
        """Of every method on every spiral, from the demonstrated start and 20 around it."""
        if self._main is None:
            cells = [make(shown) for make in (self.sdsef_cell, self.tuned_cell) for shown in self.spirals]
            for shown in self.spirals:
                for method in RIVALS:
                    chosen = self.choice(method, shown)
                    for label, setting in {
                        method: self.setting(method, shown),
                        f"{method}, least β": setting_of(chosen.least_beta),
                        f"{method}, least MSE": setting_of(chosen.least_mse),
                    }.items():
                        cells.append(greedy_cell(label, method, setting, shown))
            self._main = self.run(cells, Protocol())
        return self._main

    def sdsef_cell(self, shown: Demonstration) -> Cell:
        """SDS-EF by its authors' recipe and the paper's split, with the paper's size where it prints one."""
        size = TABLE_TWO.get(shown.name, ())[:2] if self.plan.printed else ()
        n_layers, n_features = size or self.plan.official
        return replace(tuning.held_out(shown, n_layers, n_features, self.plan.patience), method="SDS-EF official")

    def tuned_cell(self, shown: Demonstration) -> Cell:
        """SDS-EF by our recipe."""
        n_layers, n_features = self.plan.tuned
        return Cell("SDS-EF", lambda dim: SDSEF(dim, n_layers=n_layers, n_features=n_features), shown)

    def rows(self) -> pd.DataFrame:
        return pd.DataFrame([row for outcome in self.outcomes() for row in outcome.rows])

    def scores(self, score: str = "dtw_fast") -> dict[str, dict[str, np.ndarray]]:
        """{spiral: {method: its scores from the perturbed starts}}, the four methods of the figure."""
        rows = self.rows()
        near = rows[rows["start"] > 0]
        return {
            shown.name: {
                method: near[(near["demonstration"] == shown.name) & (near["method"] == method)][score].to_numpy()
                for method in (*RIVALS, *SDS_EF)
            }
            for shown in self.spirals
        }


def setting_of(tried: tuning.Tried) -> Setting:
    return Setting(tried.beta, tried.mu, tried.n_layers, tried.mse)


def greedy_cell(label: str, method: str, setting: Setting, shown: Demonstration) -> Cell:
    beta, mu, n_layers, _ = setting
    return Cell(label, lambda dim: KINDS[method](dim, n_layers=n_layers, beta=beta, mu=mu), shown)
